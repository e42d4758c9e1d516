"""Choose sites on the surface and compute their local-level frame L."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import InputError
from .body import Body
from .geometry import Float64, face_normals_areas

MAX_SLOPE_DEG = 35.0
_ATTEMPTS = 1000
# Sine of the angle to the pole. Below it, "north" is rounding noise, and T's +x replaces the pole.
_POLE_SIN = 1e-6
_STREAM = 0x51735  # separates these draws from other uses of the same seed


@dataclass(frozen=True, kw_only=True, eq=False)
class Site:
    """Describe a position on the body and its local-level frame.

    Attributes
    ----------
    index
        Number of the site in its set.
    position_T_m
        float64[3], on the surface of the global model, body-fixed axes.
    T_from_L
        float64[3, 3] rotation; its columns are L's axes in T: x north, y east, z down (effective gravity).
    """

    index: int
    position_T_m: Float64
    T_from_L: Float64


class Sites(Sequence[Site]):
    """Hold the sites of a scene; each site is computed when it is first used, and then kept.

    A site costs about 9 ms on a shape of 20,000 facets, and a worker process visits only a few.

    Parameters
    ----------
    count
        Number of sites, >= 0.
    make
        Function that returns the site of an index, always the same one, whatever was requested before.
    """

    def __init__(self, count: int, make: Callable[[int], Site]) -> None:
        self._count, self._make = count, make
        self._made: dict[int, Site] = {}

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> Site: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Site, ...]: ...
    def __getitem__(self, index: int | slice) -> Site | tuple[Site, ...]:
        number = range(self._count)[index]
        if isinstance(number, range):
            return tuple(self[k] for k in number)
        if number not in self._made:
            self._made[number] = self._make(number)
        return self._made[number]


def local_level(effective_gravity_m_s2: ArrayLike) -> Float64:
    """Return T_from_L, float64[3, 3], from the effective gravity float64[3] in T.

    The axis z points along gravity. The axis x, north, is T's +z (the pole) projected onto the horizontal plane;
    within 1e-6 rad of the pole, T's +x is projected instead. The axis y = z × x points east.
    """
    gravity = np.asarray(effective_gravity_m_s2, dtype=np.float64)
    down = gravity / np.sqrt(np.sum(gravity**2))
    north = np.array([0.0, 0.0, 1.0]) - down[2] * down
    if np.sqrt(np.sum(north**2)) < _POLE_SIN:
        north = np.array([1.0, 0.0, 0.0]) - down[0] * down
    north /= np.sqrt(np.sum(north**2))
    # A second projection is needed: near the pole, the first leaves a rounding error of 1e-16 / _POLE_SIN.
    north -= np.sum(north * down) * down
    north /= np.sqrt(np.sum(north**2))
    return np.column_stack([north, np.cross(down, north), down])


def site_at(body: Body, index: int, position_T_m: ArrayLike) -> Site:
    """Return the site at a given position, float64[3] metres in T."""
    position = np.array(position_T_m, dtype=np.float64)
    gravity = body.effective_gravity(position)[0]
    return Site(index=index, position_T_m=position, T_from_L=local_level(gravity))


def choose_sites(body: Body, count: int, seed: int, *, max_slope_deg: float = MAX_SLOPE_DEG) -> Sites:
    """Return random sites, uniform over the surface area that is no steeper than `max_slope_deg`.

    A site is drawn when it is first used. Site k depends on (body, seed, k, max_slope_deg) only, so a longer list
    begins with the shorter one.

    Parameters
    ----------
    count
        Number of sites, >= 0.
    seed
        Non-negative integer.
    max_slope_deg
        Largest angle, above 0 and at most 90°, between the facet's normal and up (against effective gravity).
        Steeper ground would not fill the lower half of a level camera's view.

    Raises
    ------
    InputError
        A site raises it at its first use if 1000 draws give no position.
    """
    normals, areas = face_normals_areas(body.vertices_m, body.faces)
    cumulative = np.cumsum(areas)
    cos_bound = np.cos(np.radians(max_slope_deg))
    return Sites(count, lambda index: _draw(body, index, seed, normals, cumulative, cos_bound))


def _draw(body: Body, index: int, seed: int, normals: Float64, cumulative: Float64, cos_bound: float) -> Site:
    """Return the first drawn position of a site whose facet is not too steep."""
    lifted = 0  # draws where the spin throws off what lies there
    for attempt in range(_ATTEMPTS):
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence((seed, _STREAM, index, attempt))))
        pick, u, v = rng.random(3)
        face = min(int(np.searchsorted(cumulative, pick * cumulative[-1], side="right")), len(normals) - 1)
        root = np.sqrt(u)
        weights = np.array([1.0 - root, root * (1.0 - v), root * v])
        site = site_at(body, index, np.sum(weights[:, None] * body.vertices_m[body.faces[face]], axis=0))
        up = -float(np.sum(normals[face] * site.T_from_L[:, 2]))
        if up >= cos_bound:
            return site
        lifted += up < 0
    found = (
        f"{body.name}: none of {_ATTEMPTS} random positions is level enough for site {index}: all slope by more "
        f"than {np.degrees(np.arccos(cos_bound)):g} degrees"
    )
    if 2 * lifted > _ATTEMPTS:
        raise InputError(
            f"{found}, since at {lifted} of them the spin is faster than gravity holds: body.rotation_period_h = "
            f"{body.rotation_period_s / 3600:g}, body.density_kg_m3 = {body.density_kg_m3:g}; raise one of them"
        )
    raise InputError(f"{found}; smooth the shape")
