"""Light from beside the field: its level against a Lambertian surface, its gradient, and where it acts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.core import spectra
from vbnfault.core.quantities import Radiance
from vbnfault.faults import FaultContext

SIZE = 96
CORNER = float(np.tan(np.radians(20.0)) * np.sqrt(2))  # tangent of the corner's field angle at 40 degrees


def context(x: float, y: float, z: float = 1.0, visible: float = 1.0) -> FaultContext:
    """A Sun in the direction (x, y, z) of the camera, at 1 au."""
    where = make_context(SIZE, exposure_s=0.01)
    nodes = spectra.band_nodes_nm(400.0, 700.0, 8)
    return replace(
        where,
        sun_direction_C=np.array([x, y, z]) / np.linalg.norm([x, y, z]),
        sun_visible_fraction=visible,
        wavelength_nm=nodes,
        sun_irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0),
    )


def veil(where: FaultContext, **keys: Any) -> Any:
    """Electrons that the fault adds, float32[y, x, channel]."""
    fault: Any = make("straylight", model="surroundings", **({"reflectance": 0.02, "shadow_chance": 0.0} | keys))
    params = fault.draw(where, rng())
    grey = flat_electrons(where, 0.1)
    added = fault.apply(grey, params, where).array - grey.array
    light = fault.on_light(grey, params, where)
    np.testing.assert_array_equal(light.array, grey.array)
    # the addition rounds to 2⁻²⁴ of the grey
    np.testing.assert_allclose(light.past_rims, added, atol=2**-23 * grey.array.max())
    return light.past_rims


def test_its_level_is_that_of_a_lambertian_surface() -> None:
    where = context(CORNER, 0.0)
    found = veil(where, falloff=1.0)
    surface = 0.02 * where.sun_irradiance_W_m2_nm / np.pi  # type: ignore[operator]
    radiance = Radiance(
        array=np.broadcast_to(surface[:, None, None], (8, SIZE, SIZE)).astype(np.float32),
        wavelength_nm=where.wavelength_nm,  # type: ignore[arg-type]
    )
    # spectra between the nodes are integrated in two ways: 1 %
    np.testing.assert_allclose(found, where.camera.expose(radiance, 0.01).array, rtol=0.01)


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, -1)])
def test_it_falls_from_the_side_of_the_sun(direction: tuple[int, int]) -> None:
    where = context(3 * direction[0], 3 * direction[1])
    level = veil(where, falloff=9.0)[..., 1].astype(np.float64)
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    along = (x * direction[0] + y * direction[1]) / np.hypot(*direction) / (SIZE / np.sqrt(2))
    # 9 from corner to corner along the diagonal
    np.testing.assert_allclose(np.log(level / level.max()), np.log(9) / 2 * (along - along.max()), atol=1e-4)


def test_the_farther_off_the_sun_the_less() -> None:
    at = [float(veil(context(tangent, 0.0)).max()) for tangent in (0.4, CORNER, 2 * CORNER, 20 * CORNER)]
    # full up to the corner's angle, then as 1 / tan θ
    assert at == pytest.approx([at[1], at[1], at[1] / 2, at[1] / 20], rel=1e-3)
    assert veil(context(CORNER, 0.0, visible=0.5)).max() == pytest.approx(at[1] / 2, rel=1e-3)
    assert veil(context(0.1, 0.0)).max() == pytest.approx(at[1])  # in the frame
    # behind the camera, behind the ground
    for nothing in (context(1.0, 0.0, -0.1), context(1.0, 0.0, visible=0.0)):
        assert not veil(nothing).any()


def test_the_shadow_of_the_rim_lies_on_the_far_side() -> None:
    where = context(2.0, 0.0)
    whole = veil(where, falloff=1.0)[..., 1]
    part = veil(where, falloff=1.0, shadow_chance=1.0, shadow_depth=0.8, shadow_softness=0.05)[..., 1] / whole
    assert part[SIZE // 2, -1] == pytest.approx(1.0, abs=1e-3)
    assert part.min() == pytest.approx(0.2, abs=1e-3)
    assert (np.diff(part[SIZE // 2]) > -1e-6).all()
