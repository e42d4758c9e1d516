"""What a sample is while it is made: its terrain, pose and specification, and the frame that the stages fill."""

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
from ..scene import config, plan
from ..scene.config import Scene
from ..world.spacecraft import SpacecraftMesh

if TYPE_CHECKING:
    from ..render import TerrainMesh

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """A site with its patch and the renderer's copy of it, and the spacecraft above it, if there is one."""

    body: Body
    site: Site
    surface: TerrainMesh
    vehicle: SpacecraftMesh | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """The outcome of `resolve`: where the camera and the Sun are.

    `tries` counts the views drawn, of which this is the last; `variables` are the plan's for it, by the names of
    `plan.VARIABLES`. `resolved`: every condition is met; False only where SPICE places a camera whose sample has a
    fault that needs the Sun, and the Sun is hidden.
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
    """One sample of a plan, with all that `simulate` needs."""

    index: int
    scene: Scene
    plan: plan.Plan
    faults: Mapping[str, Fault]
    terrain: Terrain

    @property
    def seed(self) -> int:
        return self.scene.dataset.seed

    @property
    def commanded(self) -> tuple[str, ...]:
        """Return the faults that the sample is commanded to carry, in dataset order."""
        return self.plan.commanded(self.index)

    def rng(self, stage: str, name: str) -> np.random.Generator:
        """The generator of this sample for (stage, name)."""
        return config.rng(self.seed, self.index, stage, name)


@dataclass(kw_only=True, eq=False)
class Frame:
    """What the stages add to, one after the other.

    `views` counts the views of the sample that were photographed, this one included; `first_try` is the number of
    views that were drawn before it.
    """

    spec: SampleSpec
    views: int = 1
    first_try: int = 0
    pose: Pose = field(init=False)
    camera: Camera = field(init=False)
    sunlight: Sunlight = field(init=False)
    radiance: Radiance = field(init=False)
    # what was rendered and where it shows open sky, guard band included, where the picture has another grid
    rendered: Radiance | None = None
    open_sky: NDArray[np.bool_] | None = None
    truth: Truth = field(init=False)
    context: FaultContext = field(init=False)
    rate: Electrons = field(init=False)
    # the same with the Sun's direct image past the rims; None where all light is the scene's
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
        """What the lens takes: radiance on the grid of the render."""
        return self.radiance if self.rendered is None else self.rendered


def stored_layers(scene: Scene, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """The optional layers of the scene; the default asks for a twin without straylight, which a scene that has
    no straylight does without."""
    idle = "without_straylight" if plan.STRAYLIGHT not in faults else None
    return tuple(layer for layer in scene.dataset.layers if layer != idle)


def mask_any_faults(scene: Scene, faults: Mapping[str, Fault]) -> tuple[str, ...]:
    """Return the classes united in mask_any, in dataset order: those configured, else the localised ones."""
    chosen = scene.dataset.mask_any
    if chosen is not None:
        return tuple(name for name in faults if name in chosen)
    return tuple(name for name, fault in faults.items() if fault.localised)
