"""Render with Mitsuba 3 (LLVM, spectral). This is the only package that imports Mitsuba.

Mitsuba is loaded when the first name is taken from this package. `description` holds the input of a render as plain
data and loads without Mitsuba.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..core.lazy_names import load_name

if TYPE_CHECKING:
    from .albedo import AlbedoMap
    from .atmosphere import TOP_SCALE_HEIGHTS, Air, air_light
    from .bounces import indirect
    from .cells import Cells, direct_in_cells
    from .detail import FineRelief
    from .earth import EarthAlbedo
    from .facets import thin_parts
    from .integrate import radiance
    from .layers import truth
    from .light import Sampled, direct, direct_by_sample, sun_in_view
    from .resolve import (
        first_ground,
        first_hit_m,
        ground_height_m,
        hidden_points,
        is_between,
        is_clear,
        sun_visible_fraction,
        sunlit_ground,
    )
    from .runtime import set_threads
    from .sun_heights import heights_towards_sun
    from .surface import TerrainMesh
    from .unresolved import CloseUp, close_up
    from .vehicle import Vehicle

# public name → the module that defines it, which loads Mitsuba
_HOMES = {
    "Air": "atmosphere",
    "AlbedoMap": "albedo",
    "Cells": "cells",
    "CloseUp": "unresolved",
    "EarthAlbedo": "earth",
    "FineRelief": "detail",
    "Sampled": "light",
    "TOP_SCALE_HEIGHTS": "atmosphere",
    "TerrainMesh": "surface",
    "Vehicle": "vehicle",
    "air_light": "atmosphere",
    "close_up": "unresolved",
    "direct": "light",
    "first_ground": "resolve",
    "first_hit_m": "resolve",
    "direct_by_sample": "light",
    "direct_in_cells": "cells",
    "ground_height_m": "resolve",
    "heights_towards_sun": "sun_heights",
    "hidden_points": "resolve",
    "indirect": "bounces",
    "is_between": "resolve",
    "is_clear": "resolve",
    "radiance": "integrate",
    "set_threads": "runtime",
    "sun_in_view": "light",
    "sun_visible_fraction": "resolve",
    "sunlit_ground": "resolve",
    "thin_parts": "facets",
    "truth": "layers",
}


if not TYPE_CHECKING:  # a type checker that saw the function would accept every misspelled name

    def __getattr__(name: str) -> Any:
        """Return a public name from the module that defines it, which loads Mitsuba."""
        return load_name(__name__, name, _HOMES)


def self_test() -> str:
    """Render a Lambert square that faces the Sun and return a sentence that compares its radiance with ρE/π."""
    import numpy as np

    from ..reflectance.disc import Lambert
    from .description import RenderInput, Sunlight, View
    from .integrate import radiance
    from .surface import TerrainMesh

    square = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], dtype=np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32)
    up = np.array([0.0, 0.0, -1.0])
    sun = Sunlight(direction_L=up, angular_radius_rad=0.005, irradiance_W_m2_nm=np.array([1.5]))
    view = View(
        position_L_m=5 * up,
        L_from_C=np.eye(3),
        intrinsics=np.array([16.0, 16, 8, 8]),
        width_px=16,
        height_px=16,
    )
    scene = RenderInput(
        view=view,
        sun=sun,
        wavelength_nm=np.array([550.0]),
        reflectance=Lambert().at(np.array([550.0]), np.array([0.06])),
        samples_per_pixel=4,
        key=0,
    )
    got = float(radiance(TerrainMesh(square, faces, np.ones(2, dtype=bool)), scene).array.mean())
    want = 0.06 * 1.5 / np.pi
    verdict = "as it should be" if abs(got / want - 1) < 1e-3 else "WRONG"
    return f"radiance {got:.6f} W m-2 sr-1 nm-1, expected {want:.6f}: {verdict}"


__all__ = [
    "TOP_SCALE_HEIGHTS",
    "Air",
    "AlbedoMap",
    "Cells",
    "CloseUp",
    "EarthAlbedo",
    "FineRelief",
    "Sampled",
    "TerrainMesh",
    "Vehicle",
    "air_light",
    "close_up",
    "direct",
    "direct_by_sample",
    "direct_in_cells",
    "first_ground",
    "first_hit_m",
    "ground_height_m",
    "heights_towards_sun",
    "hidden_points",
    "indirect",
    "is_between",
    "is_clear",
    "radiance",
    "self_test",
    "set_threads",
    "sun_in_view",
    "sun_visible_fraction",
    "sunlit_ground",
    "thin_parts",
    "truth",
]
