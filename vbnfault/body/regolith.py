"""Compute ground as on asteroids and moons: craters of all sizes in regolith, rubble, and smooth low plains.

Heights are added along the model's normal, as in `relief`. The ground consists of:

- undulations that continue the roughness of the model, rougher in some regions than in others;
- craters of the size law of `CraterLaw`, from fresh bowls with rims to ghosts, the later ones on top;
- fine material that levels low and gentle ground: ponds on Eros, the Muses Sea on Itokawa;
- rubble: stones too small to be boulders of their own, heaped on each other.

The albedo differs from its mean by units of the ground, is higher on steep ground, from which weathered material
has slid, and in the freshest craters.

References
----------
Gault 1970, Radio Science 5, 273: at geometric saturation, craters number 1.54 D^-2; at equilibrium between those
that form and those that are worn away, 1 to 10 % of that. Fassett & Thomson 2014, JGR Planets 119, 2255: fresh
simple craters are a fifth as deep as wide, with rims of 4 % of the diameter; wear by diffusion rounds and fills
them until nothing is left. Pike 1977, in Impact and Explosion Cratering, 489: depths and peaks of complex craters.
Murchie et al. 2002, Icarus 155, 145: steep walls on Eros are up to a third brighter. Miyamoto et al. 2007, Science
316, 1011: fine material gathers where the potential is low.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from .fields import Octaves, smooth_step
from .geometry import Float64
from .noise import Float32
from .spec import PatchSpec, Regolith

REFERENCE_M = 10.0
SATURATION = 1.54  # craters of the diameter D or more in an area of D², at geometric saturation
FRESH_DEPTH = 0.2  # of a fresh crater, over its diameter
_MOST_LAYERS = 4
_UNITS_M = (900.0, 300.0, 110.0, 40.0, 14.0, 5.0)  # wavelengths of units of the ground with albedos of their own
_LARGE_UNITS_M = (27e3, 8e3, 2.7e3)  # of bodies whose model has no units as small
_BRIGHT_DEG = (24.0, 38.0)  # on slopes from the second, no weathered material is left
_LEVEL_DEG = (8.0, 22.0)  # fine material levels slopes up to the first, and none from the second
_STONES_STAY_DEG = (33.0, 48.0)
_STREWN = 20.0  # how much denser boulders lie in the freshest craters: assumed
_REGIONS = 2.5  # size of rough and smooth regions, in longest octaves
_LARGEST_STONE, _MOST_STONE_M = 5.0, 20.0  # width of the largest stones of rubble, in the smallest boulders
_STONE_HEIGHT = 0.4  # per unit of their random level, over their width


@dataclass(frozen=True, kw_only=True)
class CraterLaw:
    """Describe the size law of craters.

    N(>= D) = per_m2 · (D / 10 m)^-index craters per m², but no more than the fraction `equilibrium` of geometric
    saturation; none exceeds `largest_m`. The depth over the diameter is 0.2 of fresh craters, 0 of ghosts, and
    `depth` in the mean. Those beyond `simple_m` are complex: shallower, with level floors and central peaks.
    """

    per_m2: float
    index: float
    largest_m: float
    equilibrium: float
    depth: float
    simple_m: float = 1e9

    def above(self, diameter_m: ArrayLike) -> Float64:
        """Return the number per square metre of craters of a diameter or more, without regard to `largest_m`."""
        d = np.asarray(diameter_m, dtype=np.float64)
        return np.minimum(self.per_m2 * (d / REFERENCE_M) ** -self.index, self.equilibrium * SATURATION / d**2)

    def octave(self, diameter_m: float) -> tuple[float, float]:
        """Return how many craters of D to 2 D a cell of the width 3 D holds, and the law's index there.

        The craters are those of spheres of diameters from D to 2 D, whose centres are spread evenly in space; the
        ground cuts them in circles, which are smaller. Spheres with densities of d^-(index + 2) dd give circles of
        the cumulative index, and 2 k I of these, with I = B(index / 2, 3 / 2) / 2, for k spheres.
        """
        here, beyond = (float(self.above(d)) for d in (diameter_m, 2 * diameter_m))
        index = float(np.log2(here / max(beyond, 1e-300)))
        share = (1 - 2.0 ** -(index + 1)) / (index + 1)
        circles = special.beta(index / 2, 1.5)
        return 54 * here * diameter_m**2 * share / circles, index

    @property
    def wear(self) -> float:
        """Return the power of a uniform number that is a crater's depth over a fresh one's."""
        return max(FRESH_DEPTH / self.depth - 1, 0.0)


def crater_law(per_km2: float, spec: Regolith) -> CraterLaw:
    """Return the size law of craters of a ground with so many of 10 m or more."""
    return CraterLaw(
        per_m2=1e-6 * per_km2,
        index=spec.crater_index,
        largest_m=spec.largest_crater_m,
        equilibrium=spec.equilibrium,
        depth=spec.crater_depth,
        simple_m=spec.simple_crater_m,
    )


def craters(noise: Octaves, law: CraterLaw, ponds: float) -> tuple[Float32, Float32]:
    """Return the height of all craters in metres, and where the freshest are bright, both float32[n]."""
    height, bright = (np.zeros(len(noise.facet_m), dtype=np.float32) for _ in range(2))
    age_m = np.full(len(height), np.inf, dtype=np.float32)
    diameter_m = 0.5 * law.largest_m
    number = 0
    while law.per_m2 and diameter_m > float(noise.facet_m[0]):
        cells, index = law.octave(diameter_m)
        layers = int(np.clip(np.ceil(cells), 1, _MOST_LAYERS))
        shape = (cells / layers, index + 1, law.wear, ponds, law.simple_m)
        *both, age_m = noise.impacts(3 * diameter_m, 2000 + number, age_m, layers, *shape)
        height, bright = height + both[0], bright + both[1]
        diameter_m, number = 0.5 * diameter_m, number + 1
    return height, bright


def surface(
    noise: Octaves,
    elevation_m: Float64,
    slope_deg: Float32,
    low_m: float,
    spec: PatchSpec,
) -> tuple[Float32, Float32, Float32, Float32]:
    """Return height without and with rubble in metres, fine material in [0, 1], and brightness of fresh craters.

    Each is float32[n].

    Parameters
    ----------
    elevation_m, slope_deg
        Of the model, float[n].
    low_m
        Elevation below which fine material gathers.
    spec
        With `regolith`.
    """
    kind = spec.regolith
    assert kind is not None
    shortest = max(1.8 * float(noise.facet_m[0]), 0.05)
    region = 0.5 + 0.9 * smooth_step(-1.0, 1.2, noise.gradient(_REGIONS * noise.longest_m, 210))
    rough = spec.relief * region * noise.fractal(noise.longest_m, shortest, 0, spec.angularity)
    pits, bright = craters(noise, crater_law(spec.craters_per_km2, kind), kind.ponds)
    fine = _fine(noise, elevation_m, slope_deg, low_m, kind)
    height = (1 - 0.93 * fine) * rough + (1 - 0.8 * fine) * pits
    rubble = (1 - fine) * _rubble(noise, kind.rubble, spec.min_boulder_m)
    return height, height + rubble, fine, bright


def _fine(noise: Octaves, elevation_m: Float64, slope_deg: Float32, low_m: float, spec: Regolith) -> Float32:
    """Return where fine material levels the ground, float32[n] in [0, 1]."""
    if not spec.smooth:
        return np.zeros(len(noise.facet_m), dtype=np.float32)
    depth = (low_m - elevation_m) / max(0.3 * noise.longest_m, 1.0)
    edge = depth + 0.35 * noise.gradient(4 * noise.longest_m, 240) + 0.15 * noise.gradient(noise.longest_m, 241)
    return smooth_step(-0.1, 0.25, edge) * (1 - smooth_step(*_LEVEL_DEG, slope_deg))


def _rubble(noise: Octaves, amount: float, smallest_boulder_m: float) -> Float32:
    """Return the height of stones that are smaller than boulders and heaped on each other, metres."""
    highest = np.zeros(len(noise.facet_m), dtype=np.float32)
    if not amount:
        return highest
    highest -= np.inf
    width = min(_LARGEST_STONE * smallest_boulder_m, _MOST_STONE_M)
    bent = noise.bent(np.column_stack([0.3 * width * noise.gradient(2 * width, 250 + axis) for axis in range(3)]))
    number = 0
    while width > 1.6 * float(noise.facet_m[0]):
        height = amount * _STONE_HEIGHT * width
        highest = np.maximum(highest, bent.blocks(width, height, 260 + number))
        width, number = width / 1.7, number + 1
    return np.asarray(np.where(np.isfinite(highest), highest, 0), dtype=np.float32)


def brightness(noise: Octaves, slope_deg: Float32, fine: Float32, bright: Float32, rubble: float) -> Float32:
    """Return how far the albedo departs from its mean, in units of its contrast, float32[n] from -1 to 1.5.

    Rubble has no weathered cover that could slide off its slopes.
    """
    widths = [width for width in _LARGE_UNITS_M if width < noise.longest_m] + list(_UNITS_M)
    units = sum(np.float32(0.08) * noise.gradient(width, 680 + k) for k, width in enumerate(widths[::-1]))
    fresh = (1 - rubble) * smooth_step(*_BRIGHT_DEG, slope_deg)
    return np.asarray(np.clip(units + 1.2 * fresh + 0.9 * bright - 0.2 * fine, -1, 1.5), dtype=np.float32)


def stony(slope_deg: Float32, fine: Float32, bright: Float32, rubble: float) -> Float32:
    """Return the density of boulders over that of level, bare ground, float32[n]; on heaps they lie steeper.

    Most boulders of cratered ground lie in and around the freshest craters.
    """
    low, high = (slope + 15 * rubble for slope in _STONES_STAY_DEG)
    strewn = 1 + _STREWN * (1 - rubble) * bright
    return np.asarray(strewn * (1 - 0.95 * fine) * (1 - smooth_step(low, high, slope_deg)), dtype=np.float32)
