"""cos⁴ vignetting against its closed form."""

from __future__ import annotations

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.lens.thin import cos4_map


@pytest.mark.parametrize("e0", [0.0, 105.0, 255.0])
def test_factor_at_centre_edge_and_corner(e0: float) -> None:
    width, height = 1025, 513  # odd: a pixel's centre lies on the axis
    context = make_context(width, height)
    fault = make("vignetting", on_axis_illuminance_dn=e0)
    params = fault.draw(context, rng())
    assert params["on_axis_illuminance_dn"] == e0
    clean = flat_electrons(context)
    ratio = fault.apply(clean, params, context).array / clean.array
    tangent = np.tan(np.radians(40.0 / 2))  # at the frame's edge, 512.5 px from the axis

    def expected(x_px: float, y_px: float) -> float:
        theta = np.arctan(tangent * np.hypot(x_px, y_px) / 512.5)
        return float(e0 / 255 * np.cos(theta) ** 4)

    # float32 map and product: 2e-7
    assert ratio[256, 512] == pytest.approx([expected(0, 0)] * 3, rel=1e-6)
    assert ratio[256, 0] == pytest.approx([expected(512, 0)] * 3, rel=1e-6)
    for corner in (ratio[0, 0], ratio[0, -1], ratio[-1, 0], ratio[-1, -1]):
        assert corner == pytest.approx([expected(512, 256)] * 3, rel=1e-6)


def test_mask_starts_at_the_stated_loss() -> None:
    context = make_context(512)
    fault = make("vignetting", on_axis_illuminance_dn=255, mask_loss=0.1)
    params = fault.draw(context, rng())
    mask = fault.footprint(params, context)
    # cos⁴θ = 0.9 at tan²θ = 0.9^-½ - 1; f = 256 / tan 20°
    radius = 256 / np.tan(np.radians(20)) * np.sqrt(0.9**-0.5 - 1)
    y, x = np.mgrid[:512, :512] + 0.5 - 256
    clear = np.abs(np.hypot(x, y) - radius) > 1e-3
    assert np.array_equal(mask[clear], (np.hypot(x, y) > radius)[clear])  # type: ignore[index]
    assert (
        make("vignetting", on_axis_illuminance_dn=200)
        .footprint({"on_axis_illuminance_dn": 200.0, "mask_loss": 0.1}, context)
        .all()
    )  # type: ignore[union-attr]


def test_draws_fill_the_table() -> None:
    values = [make("vignetting").draw(make_context(64), rng(s))["on_axis_illuminance_dn"] for s in range(200)]
    assert 105 <= min(values) < 115
    assert 245 < max(values) <= 255


def test_map_is_shared_and_protected() -> None:
    assert cos4_map((64, 64), 90.0) is cos4_map((64, 64), 90.0)
    with pytest.raises(ValueError, match="read-only"):
        cos4_map((64, 64), 90.0)[0, 0] = 0
