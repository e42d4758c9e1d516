"""Gaussian dust grains against their closed form."""

from __future__ import annotations

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.core.errors import InputError
from vbnfault.faults.dust import GaussianDust, transmission

# The paper's figure of four grains.
PEAKS = [100, 133, 166, 200]
VARIANCES = [3, 4, 5, 6]


def grains(x: list[float], y: list[float], unit: float = 4.5, **columns: list[float]) -> dict[str, object]:
    n = len(x)
    defaults = {"peak_dn": [200.0] * n, "sigma_xx": [4.0] * n, "sigma_yy": [4.0] * n, "sigma_xy": [0.0] * n}
    return {"x_px": x, "y_px": y} | defaults | columns | {"pixels_per_grid_unit": unit, "mask_level_dn": 1.0}


def test_the_papers_four_grains() -> None:
    context = make_context(256, 64)
    centres = [32, 96, 160, 224]
    columns = {"peak_dn": PEAKS, "sigma_xx": VARIANCES, "sigma_yy": VARIANCES}
    params = grains([c + 0.5 for c in centres], [32.5] * 4, **columns)  # type: ignore[arg-type]
    clean = flat_electrons(context)
    dusty = GaussianDust().apply(clean, params, context)
    ratio = dusty.array / clean.array
    for x, peak, variance in zip(centres, PEAKS, VARIANCES, strict=True):
        # float32 throughout: a few units of 2⁻²⁴
        assert ratio[32, x] == pytest.approx([1 - peak / 255] * 3, rel=1e-6)
        # 9 px = 2 grid units from the centre
        off = 1 - peak / 255 * np.exp(-0.5 * 4 / variance)
        for pixel in (ratio[32, x + 9], ratio[32, x - 9], ratio[41, x], ratio[23, x]):
            assert pixel == pytest.approx([off] * 3, rel=1e-6)
    mask = GaussianDust().footprint(params, context)
    # a grain ends at radius σ √(2 ln(peak / 1 DN)): its area is π times that squared, ±1 px along the rim
    for x, peak, variance in zip(centres[:3], PEAKS[:3], VARIANCES[:3], strict=True):
        radius = 4.5 * np.sqrt(2 * variance * np.log(peak))
        # the window of ±32 px cuts off less than a pixel's width of the third
        assert abs(mask[:, x - 32 : x + 32].sum() - np.pi * radius**2) < 2 * np.pi * radius


def test_covariance_entries_set_the_shape() -> None:
    context = make_context(128)
    wide = transmission(grains([64.5], [64.5], sigma_xx=[6.0], sigma_yy=[3.0]), context.shape)
    dark = 1 - wide.astype(float)
    y, x = np.mgrid[:128, :128] - 64.0
    # second moments of a Gaussian cut where it has fallen by e^-q, q = ln 200: 1 - q e^-q / (1 - e^-q) =
    # 0.973 of the whole one's; sampling adds nothing visible at σ = 7.8 px and more
    q = np.log(200)
    share = 1 - q * np.exp(-q) / (1 - np.exp(-q))
    assert (dark * x**2).sum() / dark.sum() / 4.5**2 == pytest.approx(6 * share, rel=2e-3)
    assert (dark * y**2).sum() / dark.sum() / 4.5**2 == pytest.approx(3 * share, rel=2e-3)
    # +xy leans towards +x +y
    leaning = 1 - transmission(grains([64.5], [64.5], sigma_xy=[2.0]), context.shape).astype(float)
    assert (leaning * x * y).sum() / leaning.sum() / 4.5**2 == pytest.approx(2 * share, rel=2e-3)


def test_transmissions_multiply_in_any_order() -> None:
    shape = (64, 64)
    one, two = grains([30.5], [32.5]), grains([36.5], [32.5], peak_dn=[120.0])
    both = grains([30.5, 36.5], [32.5, 32.5], peak_dn=[200.0, 120.0])
    back = grains([36.5, 30.5], [32.5, 32.5], peak_dn=[120.0, 200.0])
    product = transmission(one, shape) * transmission(two, shape)
    assert np.array_equal(transmission(both, shape), product)
    assert np.array_equal(transmission(back, shape), product)


def test_draw_stays_within_the_table() -> None:
    context = make_context(1024, 512)
    counts = set()
    for seed in range(40):
        params = make("dust_on_optics").draw(context, rng(seed))
        counts.add(len(params["x_px"]))
        assert 0 <= min(params["x_px"]) <= max(params["x_px"]) <= 1024
        assert 0 <= min(params["y_px"]) <= max(params["y_px"]) <= 512
        for name, lo, hi in (
            ("peak_dn", 100, 200),
            ("sigma_xx", 3, 6),
            ("sigma_yy", 3, 6),
            ("sigma_xy", 0, 0),
        ):
            assert lo <= min(params[name]) <= max(params[name]) <= hi
    assert min(counts) >= 30
    assert max(counts) <= 100
    assert len(counts) > 20
    assert len(make("dust_on_optics", count=50).draw(context, rng())["x_px"]) == 50


def test_grains_scale_with_the_resolution() -> None:
    area = {}
    for width in (512, 1024):
        context = make_context(width)
        fault = make("dust_on_optics", count=1, peak_dn=200, sigma_xx=4, sigma_yy=4)
        params = fault.draw(context, rng()) | {"x_px": [width / 2], "y_px": [width / 2]}
        mask = fault.footprint(params, context)
        assert mask is not None
        area[width] = mask.sum() / width**2
    assert area[512] == pytest.approx(area[1024], rel=0.03)  # the rim of 94 px counts whole pixels
    fixed = make("dust_on_optics", scale_with_resolution=False)
    assert fixed.draw(make_context(256), rng())["pixels_per_grid_unit"] == 4.5


def test_singular_covariance_is_refused() -> None:
    with pytest.raises(InputError, match=r"faults\.dust_on_optics: sigma_xy"):
        make("dust_on_optics", sigma_xy=[-3, 3])
