"""Define the tables of a scene file that say how samples are drawn and what a store holds."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from ..core.quantities import SOFT_KINDS
from ..core.tables import Table, each_once, ordered, pair_within

_LAYERS = (
    "clean|depth_m|normal|semantic|raw|defects|radiance|scene_radiance|mask_effect|"
    "point_T_m|flow|incidence_deg|emission_deg|phase_deg|albedo|without_[a-z0-9_]+|"
    + "|".join(f"[a-z0-9_]+_{kind}" for kind in SOFT_KINDS)
)
Layer = Annotated[str, Field(pattern=f"^({_LAYERS})$")]


class SplitTable(Table):
    """Set the fraction of the sites in each split."""

    train: float = Field(0.7, ge=0, le=1, description="fraction of the sites for training")
    val: float = Field(0.15, ge=0, le=1, description="fraction of the sites for validation")
    test: float = Field(0.15, ge=0, le=1, description="fraction of the sites for the test")

    @model_validator(mode="after")
    def _sum(self) -> SplitTable:
        if abs(self.train + self.val + self.test - 1) > 1e-6:
            raise ValueError(f"train = {self.train:g}, val = {self.val:g}, test = {self.test:g}: must add up to 1")
        return self


# The layers of a scene that names none. The twin is left out where the scene lacks its fault.
DEFAULT_LAYERS = ("clean", "without_straylight", "mask_effect", "depth_m", "normal", "semantic")
DEFAULT_TWINS = frozenset(layer for layer in DEFAULT_LAYERS if layer.startswith("without_"))


class DatasetTable(Table):
    """Set the size of the dataset and what it stores."""

    samples: int = Field(16, ge=1, le=10_000_000, description="number of samples")
    seed: int = Field(
        1, ge=0, le=2**63 - 1, description="of all random draws: the same seed gives the same dataset"
    )
    sites: int = Field(32, ge=1, le=100_000, description="sites on the body; samples are grouped by site")
    shard_samples: int = Field(
        8, ge=1, le=16, description="samples a shard, all of one site: what a kill can lose at most"
    )
    variants_per_view: int = Field(
        1,
        ge=1,
        le=16,
        description="consecutive samples that share a view, its terrain and its radiance, and differ in faults, "
        "device of the detector, noise and, with camera.exposure_stops, exposure; must divide samples and "
        "shard_samples",
    )
    layers: Annotated[tuple[Layer, ...], AfterValidator(each_once)] = Field(
        DEFAULT_LAYERS, description="optional layers that are stored"
    )
    radiance_dtype: Literal["float32", "float16"] = Field(
        "float32",
        description="data type of the layers radiance and scene_radiance; float16 takes half the bytes and rounds "
        "by up to 0.05 %",
    )
    mask_any: tuple[str, ...] | None = Field(
        None,
        description="classes of the scene whose masks mask_any unites; []: none; default: the localised ones",
    )
    split: SplitTable = SplitTable()
    licence: str = Field("CC-BY-4.0", description="licence of the dataset, as text")
    citation: str = Field("", description="how to cite the dataset, as text")

    @model_validator(mode="after")
    def _whole_views(self) -> DatasetTable:
        if self.shard_samples % self.variants_per_view:
            raise ValueError(
                f"variants_per_view = {self.variants_per_view}, shard_samples = {self.shard_samples}: "
                "shard_samples must be a multiple of variants_per_view, since one process makes a whole view"
            )
        return self


class StratumTable(Table):
    """Set the bounds of one stratum of the sampling (Gallon et al., Table of bounds). Angles are in degrees.

    Roll and pitch tilt the boresight away from the reference direction; yaw turns the camera about the boresight.
    At the site, the Sun's elevation counts from the horizon upwards and its azimuth from north towards east.
    """

    sun_azimuth_deg: pair_within(-360, 720) | None = Field(  # type: ignore[valid-type]
        None, description="of the Sun at the site, from north towards east; default: any"
    )
    sun_elevation_deg: pair_within(-90, 90) | None = Field(  # type: ignore[valid-type]
        None, description="of the Sun above the site's horizon; default: the paper's bounds"
    )
    roll_deg: pair_within(-360, 720) | None = Field(  # type: ignore[valid-type]
        None,
        description="tilt of the boresight from the reference about the image's x; default: the paper's bounds",
    )
    pitch_deg: pair_within(-360, 720) | None = Field(  # type: ignore[valid-type]
        None,
        description="tilt of the boresight from the reference about the image's y; default: the paper's bounds",
    )
    yaw_deg: pair_within(-360, 720) | None = Field(  # type: ignore[valid-type]
        None, description="turn of the camera about the boresight; default: any"
    )
    reference: Literal["sun", "nadir", "centre"] = Field(
        "sun",
        description="where the boresight points at zero roll and pitch: the Sun, straight down as a plumb line at "
        "the site, or the body's centre of mass",
    )
    min_lit_fraction: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None, description="default: that of [geometry]"
    )


class AimTable(Table):
    """Mix what the camera aims at, by weights: a weight of 2 gives twice as many samples as a weight of 1.

    `geometry.aim = "limb"` is short for the weight 1 of `limb` alone.
    """

    sun: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="from above the site, with the Sun anywhere in the frame and the body's limb near it. Samples "
        "whose faults need the Sun have this aim, even if they are more",
    )
    nadir: float = Field(0.0, ge=0, le=1e6, description="straight down at the site, from above it")
    limb: float = Field(
        0.0, ge=0, le=1e6, description="at the body's outline in any direction, from above the site"
    )
    site: float = Field(0.0, ge=0, le=1e6, description="at the site, from a direction within zenith_deg")
    random: float = Field(
        0.0, ge=0, le=1e6, description="in any direction that leaves some of the body in the frame"
    )

    @model_validator(mode="after")
    def _some(self) -> AimTable:
        if not any(self.model_dump().values()):
            raise ValueError("all weights are 0; one of sun, nadir, limb, site, random must be above 0")
        return self


class GeometryTable(Table):
    """Set where the camera is and looks. Unset bounds follow the paper's table for the camera's field of view.

    Without `aim`, positions and attitudes are drawn within bounds, as in the paper. With `aim`, the camera flies at
    `distance_m` from a site and looks at what `aim` names, and terrain is as fine as the pixels from any distance.
    """

    x_m: pair_within(-1e9, 1e9) = Field(  # type: ignore[valid-type]
        (-150.0, 150.0), description="the camera's position north of the site"
    )
    y_m: pair_within(-1e9, 1e9) = Field(  # type: ignore[valid-type]
        (-150.0, 150.0), description="the camera's position east of the site"
    )
    height_m: pair_within(0, 1e12) = Field(  # type: ignore[valid-type]
        (0.0, 100.0), description="the camera's height, see height_reference"
    )
    height_reference: Literal["local_ground", "site"] = Field(
        "local_ground", description="height_m counts from the ground below the camera, or from the site's level"
    )
    clearance_m: float = Field(0.5, ge=0, le=1e9, description="least distance to any surface, else drawn again")
    sun_visibility: Literal["required", "as_drawn"] = Field(
        "required",
        description="of the Sun in samples with straylight: required whole and before the camera, else the view is "
        "drawn again; or left as drawn, and straylight is not injected where the Sun is hidden",
    )
    min_lit_fraction: float = Field(
        0.0,
        ge=0,
        le=1,
        description="least fraction of the frame that shows sunlit ground, by a grid of rays, else drawn again; "
        "not for cameras that SPICE places",
    )
    max_tries: int = Field(
        256, ge=1, le=100_000, description="views drawn until one meets all conditions; the sample fails after them"
    )
    aim: Literal["sun", "nadir", "limb", "site", "random"] | AimTable | None = Field(
        None,
        description="what the camera looks at: one name, or a table of weights. Default: bounds of roll, pitch and "
        "yaw, as in the paper. With it, x_m, y_m, height_m, height_reference, sun_facing and sun_averted do not "
        "apply",
    )
    distance_m: pair_within(0.1, 1e10) = Field(  # type: ignore[valid-type]
        (100.0, 10e3),
        description="with aim: from the camera to the site; equally many samples in each octave",
    )
    zenith_deg: pair_within(0, 89) = Field(  # type: ignore[valid-type]
        (0.0, 60.0), description="with aim 'site': angle at the site from straight up to the camera"
    )
    phase_deg: pair_within(0, 180) = Field(  # type: ignore[valid-type]
        (0.0, 120.0), description="with aim, but not 'sun': angle at the site between camera and Sun"
    )
    sun_elongation_deg: pair_within(0, 180) | None = Field(  # type: ignore[valid-type]
        None,
        description="with aim, but not 'sun': allowed angle between boresight and Sun, else drawn again; default: "
        "from the angle that keeps the Sun out of the frame to 180",
    )
    pointing_error_deg: float = Field(
        0.1,
        ge=0,
        le=20,
        description="with aim: standard deviation of the boresight from its target, about x and about y each",
    )
    sun_facing: StratumTable | None = Field(None, description="bounds of the samples that face the Sun")
    sun_averted: StratumTable | None = Field(None, description="bounds of the samples that do not face the Sun")


# The keys of [geometry] that only matter for a camera that aims.
OF_AN_AIM = ("aim", "distance_m", "zenith_deg", "phase_deg", "sun_elongation_deg", "pointing_error_deg")


class PlanTable(Table):
    """Set the fault matrix and the choice of views."""

    mode: Literal["per_class", "per_sample"] = Field(
        "per_sample",
        description="per_class: each class is in faulty_fraction of the samples; per_sample: so many have faults",
    )
    faulty_fraction: float = Field(0.5, ge=0, le=1, description="the paper's percentage p")
    classes_per_sample: Annotated[
        tuple[Annotated[int, Field(ge=1, le=64)], Annotated[int, Field(ge=1, le=64)]],
        AfterValidator(ordered),
    ] = Field((1, 6), description="least and most classes of a faulty sample, with mode = 'per_sample'")
    sun_facing_nominal_fraction: float = Field(
        0.0, ge=0, le=1, description="fraction of all samples that face the Sun without a fault that needs it"
    )
    on_invisible: Literal["redraw_view", "drop"] = Field(
        "redraw_view",
        description="where a commanded fault cannot show in a view: another view is drawn and rendered, or the "
        "fault is recorded as not injected; where SPICE places the camera there is no other view",
    )
    max_views: int = Field(16, ge=1, le=1000, description="views rendered for a sample; it fails after them")
    order: Literal["shuffled", "sun_first"] = Field(
        "shuffled",
        description="of the samples: shuffled over the shards; or, as in the paper, those that face the Sun first",
    )
    unusable_views: Literal["redraw", "exchange"] = Field(
        "redraw",
        description="where a drawn view cannot be used: redraw all its values, which bends their distribution; or "
        "keep what was drawn: sites are chosen for the Suns drawn there, the samples of a shard exchange positions "
        "(Sun-facing) or views (Sun-averted), and only where this fails is a value drawn again",
    )
    pair_strata: bool = Field(
        False,
        description="Sun-facing and Sun-averted samples share a target attitude in pairs, as in the paper; needs "
        "geometry.sun_visibility = 'as_drawn' or unusable_views = 'exchange', since the Sun of a pair is not drawn "
        "again",
    )
