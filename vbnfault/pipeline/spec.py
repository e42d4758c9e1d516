"""Define the data of a sample: its specification, and the frozen output of every stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site
from ..camera import Camera
from ..core.quantities import RGBI, Electrons, FarSource, Radiance, Truth
from ..core.shared_results import SharedResults
from ..faults import Fault, FaultContext, Params
from ..lens import Lens
from ..render.description import RenderInput
from ..scene import keyed_random, plan
from ..scene.config import Scene
from ..scene.events import Event, events_of_sequence, striking, strongest
from ..scene.sampling import DEFAULT_TWINS
from ..scene.trajectory import FlownPose
from ..world import cameras
from ..world.spacecraft import SpacecraftMesh

if TYPE_CHECKING:
    from ..render import TerrainMesh
    from .development import Development

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """Hold a site, the renderer's copy of its patch, and the spacecraft above it if there is one.

    `of_shard` keeps what the samples of a shard need that exchange views.
    """

    body: Body
    site: Site
    surface: TerrainMesh
    vehicle: SpacecraftMesh | None = None
    of_shard: SharedResults = field(default_factory=lambda: SharedResults(kept=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """Hold the outcome of `resolve`: the position and attitude of the camera, and the Sun.

    `tries` counts the views drawn; this is the last of them. `variables` are the values of the plan, by the names
    of `redraw.VARIABLES`. `resolved` says whether every condition is met. It is False only if a trajectory places
    the camera, a fault of the sample needs the Sun, and the camera does not see the whole Sun ahead. `terrain` is
    the terrain that was made for this pose, if it is not that of the specification. `time_s` is its time in a
    sequence, if it is of one.
    """

    position_L_m: F64
    L_from_C: F64
    sun_L: F64
    sun_azimuth_deg: float
    sun_elevation_deg: float
    sun_visible_fraction: float
    tries: int
    variables: Mapping[str, float]
    resolved: bool
    terrain: Terrain | None = None
    time_s: float | None = None

    @property
    def sees_sun(self) -> bool:
        """Return whether the whole Sun is visible before the camera."""
        return self.sun_visible_fraction == 1.0 and float(self.L_from_C[:, 2] @ self.sun_L) > 0


class Drawing(Protocol):
    """Hold the faults of a sample and its keyed random numbers."""

    @property
    def faults(self) -> Mapping[str, Fault]:
        """Return the faults by class, in dataset order."""

    @property
    def shares_state(self) -> bool:
        """Return whether other images have the same state of the instrument, as the frames of a sequence do."""

    def rng(self, stage: str, name: str) -> np.random.Generator:
        """Return the random generator of the sample for (stage, name)."""

    def fraction(self, fault: str) -> float:
        """Return which fraction of a fault is active: 0 is none of it, 1 all of it."""


def is_state(drawing: Drawing, fault: str) -> bool:
    """Return whether a fault is a state of the instrument, which lasts from image to image of a sequence."""
    return fault in drawing.faults and not drawing.faults[fault].per_exposure


def lasts(drawing: Drawing, stage: str, name: str) -> bool:
    """Return whether the random numbers of (stage, name) are those of all images of a sequence."""
    return stage == "sequence" or (stage == "fault" and is_state(drawing, name.partition("/")[0]))


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleSpec:
    """Hold one sample of a plan, with everything that `simulate` needs.

    `flown` is the pose of the sample if a table of poses gives it. If the camera aims, `terrain` is the shape model
    as it is, and `terrain_of` makes the terrain of a pose. `taken_with` is a camera in place of the scene's.
    `before` returns the frame before in a sequence. With `is_before`, the sample is taken as the frame before
    another one, and without the faults that use one. `after` is the pose of the frame after, if there is one.
    `metered_on` returns the earlier frame whose metering sets the exposure; None: the sample is metered itself.
    """

    index: int
    scene: Scene
    plan: plan.Plan
    faults: Mapping[str, Fault]
    terrain: Terrain
    flown: FlownPose | None = None
    terrain_of: Callable[[FlownPose], Terrain] | None = None
    taken_with: Camera | None = None
    before: Callable[[], SampleSpec] | None = None
    is_before: bool = False
    after: FlownPose | None = None
    metered_on: Callable[[], SampleSpec] | None = None

    def at(self, pose: Pose) -> SampleSpec:
        """Return the specification with the terrain of a pose."""
        return self if pose.terrain is None else replace(self, terrain=pose.terrain)

    @property
    def seed(self) -> int:
        """Return the seed of the dataset."""
        return self.scene.dataset.seed

    @property
    def commanded(self) -> tuple[str, ...]:
        """Return the faults that the sample is commanded to carry now, in dataset order."""
        planned = (name for name in self.plan.commanded(self.index) if self.fraction(name) > 0)
        return tuple(name for name in planned if not (self.is_before and self.faults[name].uses_before))

    @property
    def commanded_in_view(self) -> tuple[str, ...]:
        """Return the faults that any sample of the view is commanded to carry now, in dataset order."""
        return tuple(name for name in self.plan.commanded_in_view(self.index) if self.fraction(name) > 0)

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """Return the events that strike the sample's sequence; () for a sample of no sequence."""
        if not self.shares_state:
            return ()
        drawn = events_of_sequence(self.scene, int(self.plan.state[self.index]))
        return striking(drawn, self.plan.commanded(self.index))

    def event_of(self, fault: str) -> Event | None:
        """Return the event that brings a fault now; None if the fault needs none."""
        return strongest(self.events, fault, self.flown.time_s) if self.flown is not None else None

    def fraction(self, fault: str) -> float:
        """Return which fraction of a fault is active in this sample: 0 is none of it, 1 all of it."""
        event = self.event_of(fault)
        return 1.0 if event is None or self.flown is None else event.fraction(self.flown.time_s)

    @property
    def of_view(self) -> SampleSpec:
        """Return the specification of the first of the samples that share the view: it draws and renders it."""
        first = self.plan.first_of_view(self.index)
        return self if first == self.index else replace(self, index=first)

    def rng(self, stage: str, name: str) -> np.random.Generator:
        """Return the random generator of this sample for (stage, name); states of the instrument last."""
        index = self.plan.state[self.index] if lasts(self, stage, name) else self.index
        return keyed_random.rng(self.seed, int(index), stage, name)

    @property
    def shares_state(self) -> bool:
        """Return whether the sample is a frame of a sequence, whose frames share the state of the instrument."""
        return self.flown is not None and self.flown.sequence >= 0

    @cached_property
    def camera(self) -> Camera:
        """Return the camera of the sample before an exposure is set."""
        return self.taken_with or cameras.base_camera(
            self.scene,
            architecture=int(self.plan.architecture[self.index]),
            readout_direction=int(self.plan.readout_direction[self.index]),
            individual=int(self.plan.individual[self.index]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneLight:
    """Hold the radiance that reaches the lens.

    `rendered` is on the grid of the render. With a lens prescription this grid is that of a pinhole camera with a
    guard band.
    """

    lens: Lens
    rendered: Radiance

    @cached_property
    def on_image(self) -> Radiance:
        """Return the same radiance on the grid of the image: distorted, but without losses or blur."""
        return self.lens.on_frame(self.rendered)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """Hold the outcome of `render_view`.

    Attributes
    ----------
    scene
        Input of the renderer: the view and its sunlight.
    light
        Radiance without stars; in a finished frame that with stars.
    truth
        Truth at the chief rays of the image's pixel centres.
    open_sky
        bool[y, x] on the grid of the render: pixels that see neither the body nor the Sun. None if the scene has no
        stars.
    samples_per_pixel
        Mean number of samples of a pixel.
    noise_fraction_p99
        99th percentile over the lit pixels of the sampling noise as a fraction of the sensor's noise. NaN if
        `render.noise_fraction` is not set.
    cells
        float16[y·n, x·n]: signal of n × n cells of each pixel of the render over that of a white, perpendicular
        facet, of direct light; None unless the camera moves.
    direct
        float32[band, y, x]: sunlight reflected once and the Sun's disc, without a body of few pixels; None unless
        the camera moves.
    shows_ground
        False if the body has few pixels, whose light `Radiance.fine` holds.
    surroundings
        Radiance around the render, for the faults that need it; empty if the scene has none.
    far_sources
        Light of bright bodies beside the target, for the same faults.
    shared
        Results of later stages that the samples of the view share.
    """

    scene: RenderInput
    light: SceneLight
    truth: Truth
    open_sky: Mask | None
    samples_per_pixel: float
    noise_fraction_p99: float = float("nan")
    cells: NDArray[np.float16] | None = None
    direct: NDArray[np.float32] | None = None
    shows_ground: bool = True
    surroundings: tuple[Radiance, ...] = ()
    far_sources: tuple[FarSource, ...] = ()
    shared: SharedResults = field(default_factory=SharedResults)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneExposure:
    """Hold the outcome of `meter`, to which `add_stars` adds the stars.

    `camera` has its exposure. `rate` are the electrons expected after one second of `light`; `Electrons.past_rims`
    holds those of the Sun's disc. `metered_s` is what the metering of the frame gives, before the factor of
    `camera.exposure_stops` and whatever the camera exposes; None: nothing was metered.
    """

    camera: Camera
    light: SceneLight
    rate: Electrons
    metered_s: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """Hold one draw of a fault.

    `attempt` counts the draws of this fault for the sample over all its views. So the fault's class and `attempt`
    together identify the draw.
    """

    fault: Fault
    attempt: int
    params: Params

    @property
    def key(self) -> tuple[str, int]:
        """Return the fault class and the attempt, which identify the draw within its sample."""
        return self.fault.fault, self.attempt


@dataclass(frozen=True, kw_only=True, eq=False)
class Injection:
    """Hold the outcome of `inject_faults`: the draws of the faults that are in the image, by class.

    `development` computes images of the exposure with any of these faults. `in_vain` are the commanded faults that
    no draw can show in this view. If they ask for another view, no fault is drawn in this one.
    """

    draws: Mapping[str, Draw]
    development: Development
    in_vain: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Images:
    """Hold the outcome of `take_images`.

    `without` holds the twins that lack one fault, by the fault's class. `raw` uint16[y, x] is the mosaic, `defects`
    uint8[y, x] are the bits of `quantities.DEFECTS`; both are None if the scene does not store them.
    """

    image: RGBI
    clean: RGBI
    without: Mapping[str, RGBI]
    raw: NDArray[np.uint16] | None = None
    defects: NDArray[np.uint8] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Labels:
    """Hold the outcome of `label`.

    Attributes
    ----------
    masks
        bool[fault, y, x]: the mask of each class of the scene, in dataset order.
    mask_any
        bool[y, x]: the pixels that the classes of `mask_any_faults` mark, or change together.
    effects
        bool[y, x]: the pixels of the noise-free image that change by 1 DN or more without a fault, by class, for
        the injected faults whose effect is stored or needed by their mask.
    strengths
        [y, x]: how strongly a fault acts on each pixel, by the names of the stored soft layers.
    """

    masks: Mask
    mask_any: Mask
    effects: Mapping[str, Mask]
    strengths: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Hold the outcome of every stage of one sample.

    `views` counts the views that were rendered for it. `starless` is the radiance of the render without stars, if
    the scene stores `scene_radiance`.
    """

    spec: SampleSpec
    views: int
    pose: Pose
    rendering: Rendering
    starless: Radiance | None
    exposure: SceneExposure
    injection: Injection
    images: Images
    labels: Labels

    @property
    def camera(self) -> Camera:
        """Return the camera with its exposure and without faults."""
        return self.exposure.camera

    @property
    def context(self) -> FaultContext:
        """Return the sample as its faults see it."""
        return self.injection.development.context

    @property
    def drawn(self) -> dict[str, Params]:
        """Return the parameters of the faults that are in the image, by class."""
        return {name: draw.params for name, draw in self.injection.draws.items()}


def stored_layers(scene: Scene, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """Return the optional layers that the dataset stores.

    The default layers include the twin without one class, which is left out if the scene lacks this class.
    """
    present = {f"without_{name}" for name in faults}
    return tuple(layer for layer in scene.dataset.layers if layer not in DEFAULT_TWINS - present)


def mask_any_faults(scene: Scene, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """Return the classes united in mask_any, in dataset order: the configured ones, else the localised ones."""
    chosen = scene.dataset.mask_any
    if chosen is not None:
        return tuple(name for name in faults if name in chosen)
    return tuple(name for name, fault in faults.items() if fault.localised)
