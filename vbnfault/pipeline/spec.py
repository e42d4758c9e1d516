"""Define the data of a sample: terrain, pose, specification, and the frame that the stages fill."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site
from ..camera import Camera
from ..core.quantities import RGBI, Electrons, Radiance, Truth
from ..faults import Fault, FaultContext, Params
from ..render.description import Sunlight
from ..scene import keyed_random, plan
from ..scene.config import Scene
from ..world.spacecraft import SpacecraftMesh

if TYPE_CHECKING:
    from ..render import TerrainMesh

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """Hold a site, the renderer's copy of its patch, and the spacecraft above it if there is one."""

    body: Body
    site: Site
    surface: TerrainMesh
    vehicle: SpacecraftMesh | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """Hold the outcome of `resolve`: the position and attitude of the camera, and the Sun.

    `tries` counts the views drawn; this is the last of them. `variables` are the values of the plan, by the names
    of `plan.VARIABLES`. `resolved` says whether every condition is met. It is False only if SPICE places the
    camera, a fault of the sample needs the Sun, and the camera does not see the whole Sun ahead.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleSpec:
    """Hold one sample of a plan, with everything that `simulate` needs."""

    index: int
    scene: Scene
    plan: plan.Plan
    faults: Mapping[str, Fault]
    terrain: Terrain

    @property
    def seed(self) -> int:
        """Return the seed of the dataset."""
        return self.scene.dataset.seed

    @property
    def commanded(self) -> tuple[str, ...]:
        """Return the faults that the sample is commanded to carry, in dataset order."""
        return self.plan.commanded(self.index)

    def rng(self, stage: str, name: str) -> np.random.Generator:
        """Return the random generator of this sample for (stage, name)."""
        return keyed_random.rng(self.seed, self.index, stage, name)


@dataclass(kw_only=True, eq=False)
class Frame:
    """Hold the results of the stages, each of which adds to the frame.

    `views` counts the views of the sample that went through the stages, including this one. `first_try` is the
    number of views that were drawn before it.
    """

    spec: SampleSpec
    views: int = 1
    first_try: int = 0
    pose: Pose = field(init=False)
    camera: Camera = field(init=False)
    sunlight: Sunlight = field(init=False)
    radiance: Radiance = field(init=False)
    # rendered radiance and its open sky, including the guard band, if the render has another grid than the image
    rendered: Radiance | None = None
    open_sky: NDArray[np.bool_] | None = None
    truth: Truth = field(init=False)
    context: FaultContext = field(init=False)
    rate: Electrons = field(init=False)
    # `rate` with the Sun's direct image apart, as light past the rims; None if the Sun is not in view
    rate_apart: Electrons | None = None
    drawn: dict[str, Params] = field(default_factory=dict)
    rejected: list[Params] = field(default_factory=list)
    images: dict[str, RGBI] = field(default_factory=dict)
    raw: NDArray[np.uint16] | None = None
    defects: NDArray[np.uint8] | None = None
    contexts: dict[Any, FaultContext] = field(default_factory=dict)
    signals: dict[Any, Electrons] = field(default_factory=dict)
    pictures: dict[Any, RGBI] = field(default_factory=dict)
    samples_per_pixel: float = float("nan")
    noise_fraction_p99: float = float("nan")
    mask: NDArray[np.bool_] = field(init=False)
    effects: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def imaged(self) -> Radiance:
        """Return the radiance that enters the lens, on the grid of the render."""
        return self.radiance if self.rendered is None else self.rendered


def stored_layers(scene: Scene, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """Return the optional layers that the dataset stores.

    The default layers include a twin without straylight, which is left out if the scene has no straylight.
    """
    idle = "without_straylight" if plan.STRAYLIGHT not in faults else None
    return tuple(layer for layer in scene.dataset.layers if layer != idle)


def mask_any_faults(scene: Scene, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """Return the classes united in mask_any, in dataset order: the configured ones, else the localised ones."""
    chosen = scene.dataset.mask_any
    if chosen is not None:
        return tuple(name for name in faults if name in chosen)
    return tuple(name for name, fault in faults.items() if fault.localised)
