"""Describe how the terrain of a patch is built, as numbers that can be checked, compared and hashed."""

from __future__ import annotations

from pydantic import Field

from ..core.tables import pair_within, table_class

# Boulders of 7 m or more. Pajola et al. (2015, A&A 583, A37) counted 3546 on 36.4 km²: 97.4 ± 1.6 per km², with the
# Poisson error of the count.
PER_KM2 = 98.0
INDEX = 3.6


@table_class()
class Fractured:
    """Shape the ground as layered and jointed rock with basins of dust, in place of rounded relief."""

    strata: float = Field(default=1.0, ge=0, le=3, description="factor on terraces and ledges")
    joints: float = Field(default=1.0, ge=0, le=3, description="factor on the blocks and cracks between fractures")
    dust_m: float = Field(default=1.5, ge=0, le=20, description="thickness of dust on level ground")
    dust_slope_deg: pair_within(0, 85) = Field(  # type: ignore[valid-type]
        default=(20.0, 42.0), description="slopes up to which all dust rests, and from which none does"
    )
    border_m: float = Field(default=1.5, gt=0, le=20, description="thickness over which the cover of dust grows")
    apron: float = Field(
        default=8.0,
        ge=1,
        le=50,
        description="density of boulders on debris at the feet of cliffs, over that of other ground",
    )


@table_class()
class PatchSpec:
    """Set how far and how finely a patch is refined, and what lies on it.

    The cumulative size law of boulders is N(>= D) = boulders_per_km2 · (D / 7 m)^-boulder_index over the whole
    patch; the defaults are those of 67P (Pajola et al. 2015). Diameters of craters are 3 to 48 m, with a cumulative
    index of 2. A value out of its range raises InputError.
    """

    seed: int = Field(ge=0, lt=2**63, description="seed of all random fields and boulders")
    facet_m: float = Field(
        default=0.12,
        ge=0.05,
        le=1e6,
        description="mean edge length within radius_m of the site. Beyond, it grows as the distance to the power "
        "1.1 until it reaches the facets of the global model; it is increased if the ground alone would take more "
        "than 66 % of max_triangles",
    )
    radius_m: float = Field(default=20.0, ge=1, le=1e8, description="radius within which facets have that size")
    relief: float = Field(
        default=1.0, ge=0, le=10, description="factor on the added heights; 0 leaves the interpolated model"
    )
    min_boulder_m: float = Field(
        default=0.25,
        ge=0.05,
        le=1e6,
        description="diameter of the smallest boulder near the site. It grows with the distance beyond "
        "boulder_near_m, and where boulders would cover the ground",
    )
    boulder_near_m: float = Field(
        default=20.0,
        ge=20,
        le=1e8,
        description="distance from the site up to which the smallest boulder has the diameter min_boulder_m",
    )
    max_triangles: int = Field(
        default=1_600_000,
        ge=1,
        description="upper bound, at least twice the number of the model's faces; to keep it, the boulders that "
        "look smallest are left out",
    )
    boulder_index: float = Field(default=INDEX, ge=0.5, le=6, description="of the cumulative size law")
    boulders_per_km2: float = Field(default=PER_KM2, ge=0, le=1e5, description="of 7 m or more")
    craters_per_km2: float = Field(default=60.0, ge=0, le=600, description="pits and craters of 10 m or more")
    hurst: float | None = Field(
        default=None,
        ge=0.3,
        le=1.2,
        description="exponent of the roughness below the model's facets; default: that measured on the model",
    )
    scarps: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="fraction of the way in which the slopes of the model are gathered into scarps",
    )
    intermittency: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="how much more relief lies on rough and steep ground than on smooth plains; 0: evenly",
    )
    angularity: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="part of the variance of the relief longer than 20 m that is of planes which meet in edges; "
        "the rest is of rounded waves",
    )
    fractured: Fractured | None = Field(
        default=None, description="layered and jointed rock; default: rounded relief"
    )
