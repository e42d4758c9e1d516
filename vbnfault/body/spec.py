"""Describe how the terrain of a patch is built, as numbers that can be compared and hashed.

`Fractured` and `Regolith` are tables of a scene file, too. `scene.target` states the ranges of the other numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from ..core.tables import Table, pair_within

# Boulders of 7 m or more. Pajola et al. (2015, A&A 583, A37) counted 3546 on 36.4 km²: 97.4 ± 1.6 per km², with the
# Poisson error of the count.
PER_KM2 = 98.0
INDEX = 3.6


class Fractured(Table):
    """Shape the ground as layered and jointed rock with basins of dust, as on 67P."""

    strata: float = Field(1.0, ge=0, le=3, description="factor on terraces and ledges")
    joints: float = Field(1.0, ge=0, le=3, description="factor on the blocks and cracks between fractures")
    dust_m: float = Field(1.5, ge=0, le=20, description="thickness of dust on level ground")
    dust_slope_deg: pair_within(0, 85) = Field(  # type: ignore[valid-type]
        (20.0, 42.0), description="slopes up to which all dust rests, and from which none does"
    )
    border_m: float = Field(1.5, gt=0, le=20, description="thickness over which the cover of dust grows")
    apron: float = Field(
        8.0,
        ge=1,
        le=50,
        description="density of boulders on debris at the feet of cliffs, over that of other ground",
    )


class Regolith(Table):
    """Shape the ground as on asteroids and moons: craters of all sizes, regolith, rubble, smooth low plains."""

    crater_index: float = Field(
        2.0, ge=0.5, le=5, description="of the cumulative size law of craters, until they reach equilibrium"
    )
    crater_depth: float = Field(0.12, ge=0.02, le=0.18, description="mean depth over diameter; fresh craters: 0.2")
    largest_crater_m: float = Field(
        300.0,
        ge=1,
        le=1e6,
        description="larger ones belong to the shape: those beyond its mean radius, or two edges of a shape file",
    )
    simple_crater_m: float = Field(
        1e9, ge=1, le=1e9, description="larger craters are complex: shallower, with level floors and central peaks"
    )
    equilibrium: float = Field(
        0.05, ge=0.001, le=0.2, description="most craters, over those of geometric saturation (Gault 1970)"
    )
    ponds: float = Field(0.0, ge=0, le=1, description="fraction of the craters that have level floors")
    smooth: float = Field(
        0.0,
        ge=0,
        le=0.9,
        description="fraction of the body, the lowest, that fine material levels where it is gentle",
    )
    rubble: float = Field(
        0.0, ge=0, le=1, description="fraction of the places of small stones that hold one; 1: heaps everywhere"
    )
    albedo_contrast: float = Field(
        0.1, ge=0, le=0.6, description="scale by which the albedos of ground and boulders depart from the mean"
    )


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
        alone would let lie there; 0: no more. Cover goes beyond bare and full ground by up to twice this factor.
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
