"""Describe how the terrain of a patch is built, as numbers that can be compared and hashed.

The tables of a scene file (`scene.target`) state the range of each number and check it.
"""

from __future__ import annotations

from dataclasses import dataclass

# Boulders of 7 m or more. Pajola et al. (2015, A&A 583, A37) counted 3546 on 36.4 km²: 97.4 ± 1.6 per km², with the
# Poisson error of the count.
PER_KM2 = 98.0
INDEX = 3.6


@dataclass(frozen=True, kw_only=True)
class Fractured:
    """Shape the ground as layered and jointed rock with basins of dust, in place of rounded relief.

    Attributes
    ----------
    strata, joints
        Factors on terraces and ledges, and on the blocks and cracks between fractures.
    dust_m
        Thickness of dust on level ground.
    dust_slope_deg
        Slopes up to which all dust rests, and from which none does.
    border_m
        Thickness over which the cover of dust grows.
    apron
        Density of boulders on debris at the feet of cliffs, over that of other ground.
    """

    strata: float = 1.0
    joints: float = 1.0
    dust_m: float = 1.5
    dust_slope_deg: tuple[float, float] = (20.0, 42.0)
    border_m: float = 1.5
    apron: float = 8.0


@dataclass(frozen=True, kw_only=True)
class Regolith:
    """Shape the ground as that of asteroids and moons: craters of all sizes, regolith, rubble, smooth low plains.

    Attributes
    ----------
    crater_index
        Exponent of the cumulative size law of craters, until they reach equilibrium.
    crater_depth
        Mean depth over diameter; fresh craters have 0.2.
    largest_crater_m
        Larger craters belong to the shape model.
    simple_crater_m
        Larger craters are complex: shallower, with level floors and central peaks.
    equilibrium
        Fraction of geometric saturation that the number of craters does not exceed.
    ponds
        Fraction of the craters that have level floors.
    smooth
        Fraction of the body, the lowest, that fine material levels where it is gentle.
    rubble
        Fraction of the places of small stones that hold one; 1: heaps without any ground between.
    albedo_contrast
        Scale by which the albedo of units of the ground and of boulders departs from its mean, over the mean.
    """

    crater_index: float = 2.0
    crater_depth: float = 0.12
    largest_crater_m: float = 300.0
    simple_crater_m: float = 1e9
    equilibrium: float = 0.05
    ponds: float = 0.0
    smooth: float = 0.0
    rubble: float = 0.0
    albedo_contrast: float = 0.1


@dataclass(frozen=True, kw_only=True)
class PatchSpec:
    """Set how far and how finely a patch is refined, and what lies on it.

    The cumulative size law of boulders is N(>= D) = boulders_per_km2 · (D / 7 m)^-boulder_index over the whole
    patch; the defaults are those of 67P (Pajola et al. 2015). Without `regolith`, diameters of craters are
    3 to 48 m, with a cumulative index of 2.

    Attributes
    ----------
    seed
        Seed of all random fields and boulders, 0 to below 2⁶³.
    facet_m, radius_m
        Mean edge length within `radius_m` of the site. Beyond, it grows as the distance to the power 1.1 until it
        reaches the facets of the global model; it is increased if the ground alone would take more than 66 % of
        `max_triangles`.
    relief
        Factor on the added heights; 0 leaves the interpolated model.
    min_boulder_m, boulder_near_m
        Diameter of the smallest boulder within `boulder_near_m` of the site. It grows with the distance beyond, and
        where boulders would cover the ground.
    max_triangles
        Upper bound, at least twice the number of the model's faces; to keep it, the boulders that look smallest are
        left out.
    boulder_index, boulders_per_km2, craters_per_km2
        Exponent of the size law, boulders of 7 m or more, and pits and craters of 10 m or more.
    roughness
        Least deviation of heights over distance below the model's facets, where the model is smoother.
    hurst
        Exponent of the roughness below the model's facets; None: that measured on the model.
    scarps
        Fraction of the way in which the slopes of the model are gathered into scarps.
    contour_scarps
        Factor on scarps along the contours of the ground, where layers crop out; 0: none.
    intermittency
        How much more relief lies on rough and steep ground than on smooth plains; 0: evenly.
    angularity
        Part of the variance of the relief longer than 20 m that is of planes which meet in edges; the rest is of
        rounded waves.
    airfall
        How much more dust covers low and level ground, and how much less high and steep ground, than the relief
        alone would let lie there; 0: no more.
    largest_boulder_m
        Diameter of the largest boulder.
    fractured
        Layered and jointed rock; None: rounded relief.
    regolith
        Ground of asteroids and moons in place of a comet's; `fractured`, `scarps` and `contour_scarps` do not count
        then. None: a comet's.
    """

    seed: int
    facet_m: float = 0.12
    radius_m: float = 20.0
    relief: float = 1.0
    min_boulder_m: float = 0.25
    boulder_near_m: float = 20.0
    max_triangles: int = 1_600_000
    boulder_index: float = INDEX
    boulders_per_km2: float = PER_KM2
    craters_per_km2: float = 60.0
    roughness: float = 0.0
    hurst: float | None = None
    scarps: float = 0.0
    contour_scarps: float = 0.0
    intermittency: float = 0.0
    angularity: float = 0.0
    airfall: float = 0.0
    largest_boulder_m: float = 45.0
    fractured: Fractured | None = None
    regolith: Regolith | None = None
