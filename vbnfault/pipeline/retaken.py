"""Take the images of stored views again, with other faults, another lens or another detector, without a render.

The radiance of a view is read. Its pose follows from the plan, and what is stored of its truth is used as it is.
The terrain is made only for what is not stored: the parts of the Sun's disc that ground or spacecraft hide, truth
for a lens that maps the pixels to other directions, where a body of few pixels and thin parts of the spacecraft lie
within pixels, and the coarse surroundings that scene straylight needs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..body import Site
from ..core import frames
from ..core.errors import VbnfaultError
from ..core.quantities import SKY, Radiance, Sample, Truth
from ..core.sundisc import add_mean
from ..render.description import RenderInput, may_see_sun
from ..scene.config import Scene
from ..scene.plan import EarlierViews, Plan
from ..scene.redraw import strata
from ..scene.trajectory import FlownPose
from ..world import ephemeris
from ..world.aiming import aimed_view
from .record import to_sample
from .rendering import (
    ANGLE_LAYERS,
    body_of_few_pixels,
    describe,
    far_sources,
    seen_truth,
    surroundings,
    with_body,
)
from .resolve import in_local_frame, references_L
from .session import Session
from .spec import Frame, Pose, Rendering, SampleSpec, SceneLight, Terrain
from .stages import simulate_stored_view

if TYPE_CHECKING:
    from ..render import TerrainMesh

# The recomputed attitude is that of the store but for the rounding of a quaternion. Another one means that the
# store was planned by other code.
_SAME_ATTITUDE = 1e-9
_FEW_PX = 128  # a body wider than this, seen from its nearest vertex, needs no close-up
TRUTH_LAYERS = ("depth_m", "normal", "semantic")


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredView:
    """Hold what a store has of a view.

    Attributes
    ----------
    scalars
        The scalars of the sample that was made of it, by name.
    radiance
        float16 or float32[band, y, x]: radiance on the grid of the render, without stars.
    truth
        Layers of truth [y, x, ...], by name.
    same_optics
        Whether the camera that takes it again has the lens, the f-number and the pixels of the one that it was
        rendered for.
    """

    scalars: Mapping[str, Any]
    radiance: NDArray[np.floating[Any]]
    truth: Mapping[str, NDArray[Any]]
    same_optics: bool


class _TerrainOnDemand(Terrain):
    """Hold a terrain whose surface is made when it is first used."""

    def __init__(self, world: Session, site: Site, make: Callable[[], Terrain]) -> None:
        self.__dict__.update(body=world.body, site=site, vehicle=world.vehicle, make=make)

    @cached_property
    def surface(self) -> TerrainMesh:  # type: ignore[override]
        """Return the renderer's copy of the patch."""
        return self.__dict__["make"]().surface  # type: ignore[no-any-return]


class RetakeSession:
    """Take the samples of a plan whose views are stored, in any order.

    Parameters
    ----------
    scene
        The scene of the new samples.
    plan
        Their plan, which takes over earlier views.
    blocks
        Numbers of samples that the earlier plan drew together.
    read
        Function that returns the stored view of a sample of the earlier plan.
    threads
        Render threads of this process.
    """

    def __init__(
        self,
        scene: Scene,
        plan: Plan,
        blocks: tuple[int, ...],
        read: Callable[[int], StoredView],
        *,
        threads: int | None = None,
    ) -> None:
        assert plan.views is not None
        self._scene, self._plan, self._views, self._read = scene, plan, plan.views, read
        self._world = Session(_world_of(scene, plan.views), blocks=blocks, threads=threads)
        of_sites = plan
        while of_sites.views is not None:
            of_sites = of_sites.views.plan
        self._world.plan_of_sites = of_sites
        self._last: tuple[int, SampleSpec, Pose, Rendering, int] | None = None

    def simulate(self, number: int) -> Sample:
        """Return the sample with a number of the plan."""
        return to_sample(self.frame(number))

    def frame(self, number: int) -> Frame:
        """Return the sample with a number of the plan, with the outcome of every stage behind the render."""
        of_view, pose, rendering, views = self._view(number // self._views.repeats)
        faults = self._world.faults
        spec = replace(
            of_view,
            index=number,
            scene=self._scene.model_copy(update={"sun": of_view.scene.sun}),
            plan=self._plan,
        )
        if self._scene.geometry.sun_visibility == "required" or self._scene.is_flown:
            needs_sun = any(faults[name].needs_sun for name in spec.commanded)
            pose = replace(pose, resolved=pose.sees_sun or not needs_sun)
        return simulate_stored_view(spec, pose, rendering, views)

    def _view(self, earlier: int) -> tuple[SampleSpec, Pose, Rendering, int]:
        """Return specification, pose and radiance of an earlier sample, and the number of views rendered for it."""
        if self._last is None or self._last[0] != earlier:
            self._last = None
            stored = self._read(earlier)
            spec, pose = self._placed(earlier, stored.scalars)
            rendering = _rendering(spec, pose, stored)
            self._last = earlier, spec, pose, rendering, int(stored.scalars["views"])
        return self._last[1:]

    def _placed(self, earlier: int, scalars: Mapping[str, Any]) -> tuple[SampleSpec, Pose]:
        """Return the specification of a stored view, whose plan draws it, and its pose."""
        world, plan, attempt = self._world, self._views.plan, int(scalars["tries"]) - 1
        scene = world.dated_scene(earlier)
        site = Site(
            index=int(scalars["site"]),
            position_T_m=np.asarray(scalars["site_T_m"]),
            T_from_L=np.asarray(scalars["T_from_L"]),
        )
        variables = plan.view(self._views.scene, earlier, attempt)
        flown: FlownPose | None = None
        if world.trajectory is not None:
            flown = world.trajectory.pose(earlier)
        elif scene.is_flown:
            flown = ephemeris.flown_pose(scene)
        elif scene.is_aimed:
            of_model = world.sites[site.index]
            flown = aimed_view(scene, world.body, of_model, plan.aim_of(earlier), variables).pose

        def made() -> Terrain:
            if world.trajectory is not None:
                return world.terrain(world.ground_detail(earlier))
            return world.aimed_terrain(flown) if scene.is_aimed and flown is not None else world.terrain(site.index)

        terrain = _TerrainOnDemand(world, site, made)
        pose = (
            in_local_frame(site, flown)
            if flown is not None
            else _drawn_pose(scene, terrain, int(plan.stratum[earlier]), variables, scalars)
        )
        pose = replace(
            pose,
            variables=variables,
            tries=attempt + 1,
            sun_visible_fraction=float(scalars["sun_visible_fraction"]),
            resolved=True,
        )
        attitude = frames.quaternion((site.T_from_L @ pose.L_from_C).T)
        if not np.allclose(attitude, scalars["camera_from_T"], rtol=0, atol=_SAME_ATTITUDE):
            raise VbnfaultError(
                f"sample {earlier} of the earlier dataset: its stored attitude is not that of its plan, as if it "
                "had been planned by other code; build that dataset again"
            )
        first = world.plan.first_of_view(earlier)
        return (
            SampleSpec(
                index=first,
                scene=scene,
                plan=world.plan,
                faults=world.faults,
                terrain=terrain,
                flown=flown,
                after=None if world.trajectory is None else world.trajectory.after(earlier),
            ),
            pose,
        )


def _world_of(scene: Scene, views: EarlierViews) -> Scene:
    """Return a scene with the sampling of earlier views, which says where ground and views are."""
    keys = ("seed", "samples", "shard_samples", "variants_per_view")
    sampling = {key: getattr(views.scene.dataset, key) for key in keys}
    return scene.model_copy(update={"dataset": scene.dataset.model_copy(update=sampling)})


def _drawn_pose(
    scene: Scene, terrain: Terrain, stratum: int, variables: Mapping[str, float], scalars: Mapping[str, Any]
) -> Pose:
    """Return the pose of a view whose attitude is drawn within bounds; its position depends on the ground."""
    sun_L = frames.direction_L(variables["sun_azimuth_deg"], variables["sun_elevation_deg"])
    reference = strata(scene)[stratum].reference
    position = np.asarray(scalars["position_L_m"])
    (towards,) = references_L(reference, terrain, position[None], [sun_L])
    angles = (variables[name] for name in ("roll_deg", "pitch_deg", "yaw_deg"))
    return Pose(
        position_L_m=position,
        L_from_C=frames.L_from_C(towards, *angles, north_up=reference == "centre"),
        sun_L=sun_L,
        sun_azimuth_deg=variables["sun_azimuth_deg"],
        sun_elevation_deg=variables["sun_elevation_deg"],
        sun_visible_fraction=1.0,
        tries=1,
        variables=variables,
        resolved=True,
    )


# --- the outcome of `render_view` ------------------------------------------------------------------------------


def _rendering(spec: SampleSpec, pose: Pose, stored: StoredView) -> Rendering:
    """Return the outcome of `render_view` for a stored view."""
    from .. import render

    scene, camera = describe(spec, pose), spec.camera
    truth = _stored_truth(spec, stored)
    needs_body = (truth is None or camera.lens.resamples) and _may_be_small(spec, scene)
    body = body_of_few_pixels(spec, pose, scene) if needs_body else None
    radiance = _radiance(spec, scene, stored)
    if camera.lens.resamples and (body is not None or spec.terrain.vehicle is not None):
        parts = render.thin_parts(
            spec.terrain.surface, scene if body is None else replace(scene, shows_ground=False)
        )
        light = None if body is None else body.light
        radiance = replace(radiance, fine=light if parts is None else parts.joined(light))
    if truth is None:
        truth = seen_truth(spec, scene)
        truth = truth if body is None else with_body(truth, body, camera.projection)
    open_sky = None
    if spec.scene.sky.stars != "off":
        on_grid = truth
        if camera.lens.resamples:
            on_grid = render.truth(spec.terrain.surface, scene.view, scene.sun)
        open_sky = on_grid.semantic == SKY
    return Rendering(
        scene=scene,
        light=SceneLight(lens=camera.lens, rendered=radiance),
        truth=truth.frozen(),
        open_sky=open_sky,
        samples_per_pixel=float(stored.scalars["samples_per_pixel"]),
        noise_fraction_p99=float(stored.scalars["noise_fraction_p99"]),
        surroundings=surroundings(spec, scene),
        far_sources=far_sources(spec, pose),
    )


def _may_be_small(spec: SampleSpec, scene: RenderInput) -> bool:
    """Return whether the body may have so few pixels that it needs a close-up, from its shape alone."""
    vertices, site, view = spec.terrain.body.vertices_m, spec.terrain.site, scene.view
    camera_T_m = site.position_T_m + site.T_from_L @ view.position_L_m
    distance_m = float(np.linalg.norm(vertices - camera_T_m, axis=1).min())
    return bool(np.ptp(vertices, axis=0).max() * view.intrinsics[0] < _FEW_PX * distance_m)


def _stored_truth(spec: SampleSpec, stored: StoredView) -> Truth | None:
    """Return the stored truth, or None if the camera maps pixels to other directions, or if layers are missing."""
    camera, layers = spec.camera, set(spec.scene.dataset.layers)
    for name, now in (("intrinsics", camera.intrinsics), ("distortion", camera.lens.distortion)):
        if not np.array_equal(stored.scalars[name], now):
            return None
    # albedo needs the dust and the materials that pixels show, which are not stored
    angles = sorted(ANGLE_LAYERS & layers)
    if "albedo" in layers or not {*TRUTH_LAYERS, *angles} <= stored.truth.keys():
        return None
    return Truth(**{name: stored.truth[name] for name in (*TRUTH_LAYERS, *angles)})


def _radiance(spec: SampleSpec, scene: RenderInput, stored: StoredView) -> Radiance:
    """Return the stored radiance on the grid of the camera's render, and in it the part of the Sun's disc."""
    view, array = scene.view, stored.radiance
    border_y, border_x = (
        (a - b) // 2 for a, b in zip(array.shape[1:], (view.height_px, view.width_px), strict=True)
    )
    array = array[:, border_y : border_y + view.height_px, border_x : border_x + view.width_px]
    exact = array.dtype == np.float32 and stored.same_optics
    array = np.array(array, dtype=np.float32)
    disc, sun = None, None
    if may_see_sun(view, scene.sun):
        from .. import render

        disc = render.sun_in_view(spec.terrain.surface, view, scene.sun)
    if disc is not None:
        sun = np.zeros(array.shape, np.float32)
        if add_mean(sun, disc, view.pixel_map, range(len(array))) is None:
            sun = disc = None
    if sun is not None and not exact:
        # the stored sum does not say how bright the scene is in these pixels: it is as if it were dark
        np.copyto(array, sun, where=sun > 0)
    return Radiance(array=array, wavelength_nm=scene.wavelength_nm, sun=sun, disc=disc)
