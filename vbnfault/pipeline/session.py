"""Simulate the samples of one scene: check its faults, and keep plan, body and terrain for all samples."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..body import Body, Patch, PatchSpec, Site, Sites, cached_patch, choose_sites
from ..body.geometry import mean_edge_m
from ..body.refine import GROWTH_POWER
from ..camera import Camera
from ..core import tables
from ..core.errors import InputError, in_file, shown, under_key
from ..core.process import activity
from ..core.process.environment import MOST_THREADS, share_arenas
from ..core.quantities import Sample
from ..scene import config, plan
from ..scene.config import Scene, configure_faults
from ..scene.keyed_random import keyed_uniform
from ..scene.trajectory import (
    FLIGHTS,
    FlownPose,
    Trajectory,
    as_trajectory,
    load_trajectory,
    one_pose,
    place_in_sequence,
    with_rows,
)
from ..world import assemble, cameras, ephemeris
from ..world.coma import check_coma
from ..world.flights import fly
from ..world.ground import (
    GroundDetail,
    check_above_ground,
    ground_details,
    ground_of_sequence,
    sites_for_suns,
)
from ..world.spacecraft import SpacecraftMesh
from .record import to_sample
from .spec import Frame, SampleSpec, Terrain
from .stages import SharedViews, simulate_frame

if TYPE_CHECKING:
    from ..faults import Fault
    from ..render import TerrainMesh

    _Switched = tuple[Scene, dict[str, Fault], plan.Plan]

# Limit of the slope of an octave of the finest relief: steeper relief would look like needles.
_STEEPEST_DETAIL = 0.12
# Leaving out the smallest boulders is usual: the packaged scenes keep at least a quarter of those that are drawn. A
# smaller fraction than this one means that the ground takes nearly all triangles.
_FEWEST_KEPT = 0.05
# A shape file holds craters and boulders that are wider than so many of its edges.
_CRATER_EDGES, _BOULDER_EDGES = 2.0, 1.0
_KEPT_CALLS = 16  # sets of faults and exposure of `Session.take` whose scenes are kept


def simulate(
    scene: Scene | str | Path, sample: int = 0, *, poses: object = None, threads: int | None = None
) -> Sample:
    """Return one sample of a scene as the store would hold it.

    Each call makes the terrain and compiles the kernels anew; a `Session` keeps them for further samples.

    Parameters
    ----------
    scene
        A scene, the path of a scene file, or the name of a packaged scene.
    sample
        Index of the sample, from 0 to below `dataset.samples`, or a row of `poses`.
    poses
        Table of poses, each row of which is a sample: the path of a CSV or Parquet file, or a mapping from columns
        to values, such as a data frame. It replaces the table `[trajectory]` of the scene, which has these columns.
    threads
        Render threads; by default every core.

    Raises
    ------
    InputError
        If the scene cannot be used, or plans no such sample.
    """
    if not isinstance(scene, Scene):
        source, scene = str(scene), config.load_scene(scene)
    else:
        source = "scene"
    return Session(scene, threads=threads, source=source, poses=poses).simulate(sample)


class Session:
    """Hold a scene, its plan, and the terrain of the current site, and simulate its samples in any order.

    Parameters
    ----------
    scene
        The scene.
    blocks
        Sizes of the planned blocks; default: one block of `dataset.samples`.
    threads
        Render threads of this process.
    source
        Name of the scene in messages.
    poses
        Table of poses in place of that of the scene, as for `simulate`.

    Raises
    ------
    InputError
        The scene cannot be used, or plans more samples than its table of poses has rows.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        blocks: Sequence[int] | None = None,
        threads: int | None = None,
        source: str = "scene",
        poses: object = None,
    ) -> None:
        if not isinstance(scene, Scene):
            raise InputError(f"scene = {shown(scene)}: must be a Scene, as vbnfault.load_scene returns it")
        share_arenas()  # before terrain and renderer start their threads
        self.source = source
        if poses is not None:
            self.trajectory = as_trajectory(poses).repeated(scene.dataset.variants_per_view)
        with in_file(source):
            self.scene = scene = with_rows(scene, None if poses is None else self.trajectory)
        planned = sum(blocks or (scene.dataset.samples,))
        if (table := scene.trajectory) is not None:
            rows = sum(table.frames) or len(self.trajectory or ())
            if planned > rows:
                raise InputError(
                    f"{source}: {planned} samples are planned, but {table.file or FLIGHTS} has {rows} rows, and "
                    "each is a sample; append at most its further rows"
                )
        self.faults = configure_faults(scene, source)
        need_sun = [name for name, fault in self.faults.items() if fault.needs_sun]
        self.plan = self.plan_of_sites = plan.make_plan(scene, list(self.faults), blocks, need_sun=need_sun)
        if threads is not None and not 1 <= (tables.whole(threads) or 0) <= MOST_THREADS:
            raise InputError(f"threads = {shown(threads)}: must be a whole number from 1 to {MOST_THREADS}")
        self._threads = threads
        self._ground: dict[int, list[GroundDetail]] = {}  # of the rows of a sequence or of a shard
        self._terrain: Terrain | None = None
        self._terrain_key: int | GroundDetail | None = None
        self._model: Terrain | None = None
        self._shared_views = SharedViews()
        self._taken: dict[str, _Switched] = {}  # by faults and exposure
        self._compiled = False  # the first sample compiles the kernels

    @cached_property
    def base_camera(self) -> Camera:
        """Return the camera with the first architecture and readout direction of the scene, without an exposure."""
        with in_file(self.source):
            return cameras.base_camera(self.scene)

    @cached_property
    def body(self) -> Body:
        """Return the body, which is loaded at the first use."""
        activity.begin("shape of the body")
        with in_file(self.source):
            body = assemble.make_body(self.scene)
            given = self.scene.trajectory is not None and not self.scene.trajectory.flight
            if self.scene.coma is not None and given and self.trajectory is not None:
                for distance_au in (self.trajectory.sun_distance_au.min(), self.trajectory.sun_distance_au.max()):
                    check_coma(self.scene.coma, body, float(distance_au))
        return body

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """Return the table of poses, which is read or flown at the first use; None without a trajectory."""
        table = self.scene.trajectory
        if table is None:
            return None
        if table.file is None:
            activity.begin("flights")
            with in_file(self.source):
                return fly(self.scene, self.body)
        with in_file(self.source), under_key("trajectory.file"):
            return load_trajectory(table.file).repeated(self.scene.dataset.variants_per_view)

    def warn_of_doubts(self) -> None:
        """Warn of a body with values of another, named one, and of a frame that lens or spacecraft leave dark.

        Raises InputError if the spacecraft hides all of the frame, or if a trajectory passes through the ground.
        """
        with in_file(self.source):
            if self.trajectory is not None and self.trajectory.source != FLIGHTS:  # flights are checked
                check_above_ground(self.body, self.trajectory, len(self.plan))
            sentences = (
                assemble.values_of_another_body(self.scene, self.body),
                cameras.dark_corners(self.scene),
                cameras.scaled_lens(self.scene),
                assemble.much_hidden(self.scene, self.vehicle),
            )
        for sentence in sentences:
            if sentence:
                warnings.warn(sentence, stacklevel=2)

    @cached_property
    def vehicle(self) -> SpacecraftMesh | None:
        """Return the spacecraft that carries the camera, or None if the scene has none."""
        with in_file(self.source):
            return assemble.spacecraft(self.scene)

    @cached_property
    def sites(self) -> Sites:
        """Return the sites of the scene. Each is drawn at its first use."""
        if self.scene.spice.spacecraft:
            return ephemeris.trajectory_sites(self.scene, self.body)
        if self.scene.exchanges_views:
            return sites_for_suns(self.scene, self.body, self.plan_of_sites)
        return choose_sites(self.body, self.scene.dataset.sites, self.scene.dataset.seed)

    def terrain(self, of: int | GroundDetail) -> Terrain:
        """Return the terrain of a site, or the one refined for a pose. Only the last one is kept."""
        if self._terrain is None or self._terrain_key != of:
            self._terrain = None  # release the old one first: a small machine has no memory for two
            detail = None if isinstance(of, int) else of
            site = self.sites[of] if isinstance(of, int) else of.site(self.body, 0)
            self._terrain = self._new_terrain(site, detail)
            self._terrain_key = of
        return self._terrain

    def ground_detail(self, index: int) -> GroundDetail:
        """Return where and how finely the terrain of a row of the table of poses is refined."""
        trajectory = self.trajectory
        assert trajectory is not None
        number, row = divmod(index, self.scene.dataset.shard_samples)
        rows = self.scene.dataset.shard_samples
        if trajectory.frames:
            number, row = place_in_sequence(trajectory.frames, index)
            rows = trajectory.frames[number]
        if number not in self._ground:
            poses = [trajectory.pose(k) for k in range(index - row, min(index - row + rows, len(trajectory)))]
            if trajectory.frames:
                self._ground[number] = [ground_of_sequence(self.scene, self.body, poses)] * rows
            else:
                self._ground[number] = ground_details(self.scene, self.body, poses)
        return self._ground[number][row]

    def aimed_terrain(self, pose: FlownPose) -> Terrain:
        """Return the terrain for a pose of a camera that aims. Only the last one is kept."""
        return self.terrain(ground_details(self.scene, self.body, [pose])[0])

    def model_terrain(self, index: int) -> Terrain:
        """Return the shape model as it is as the terrain of a site. Only the last one is kept."""
        from .. import render

        if self._model is None or self._model.site.index != index:
            body, site = self.body, self.sites[index]
            vertices = ((body.vertices_m - site.position_T_m) @ site.T_from_L).astype(np.float32)
            smooth = np.zeros(len(body.faces), dtype=bool)
            vehicle = assemble.render_vehicle(self.scene, self.vehicle)
            surface = render.TerrainMesh(vertices, body.faces, smooth, vehicle=vehicle)
            self._model = Terrain(body=body, site=site, surface=surface, vehicle=self.vehicle)
        return self._model

    def _new_terrain(self, site: Site, detail: GroundDetail | None = None) -> Terrain:
        """Return the terrain of a site, for a pose of a table or of a camera that aims with its own detail."""
        from .. import render

        if self._threads is not None:
            render.set_threads(self._threads)
        activity.begin(f"terrain of site {site.index}")
        patch = self.patch(site, detail)
        return Terrain(body=self.body, site=patch.site, surface=self.surface(patch), vehicle=self.vehicle)

    def surface(self, patch: Patch) -> TerrainMesh:
        """Return the renderer's copy of a patch, with relief finer than its facets and the scene's spacecraft."""
        from .. import render

        law = self.body.roughness.at_least(self.scene.patch.roughness).with_hurst(self.scene.patch.hurst)
        fine = render.FineRelief(
            slope=0.0,
            facet_m=patch.facet_m,
            radius_m=patch.radius_m,
            growth=GROWTH_POWER,
            hurst=law.hurst if law.fine_hurst is None else law.fine_hurst,
        )
        # The slope of an octave of wavelength λ is 0.44 d / (λ/4), where d is the deviation over λ/4. The factor
        # 0.44 is the ratio of two integrals of the spectrum of a self-affine surface of Hurst exponent 0.85.
        length = fine.longest_m / 4
        slope = 0.44 * float(law.deviation_at(length)) / length
        slope = min(slope * self.scene.patch.relief, _STEEPEST_DETAIL)
        return render.TerrainMesh(
            patch.vertices_L_m,
            patch.faces,
            patch.face_is_flat,
            dust=patch.dust,
            vehicle=assemble.render_vehicle(self.scene, self.vehicle),
            fine=replace(fine, slope=slope),
            albedo=assemble.render_albedo(self.scene, patch.site),
        )

    def patch(self, site: Site, detail: GroundDetail | None = None) -> Patch:
        """Return the ground of a site, from the cache if it was built before.

        `detail`: facets and boulders for a pose of a table, in place of those of the scene.
        """
        table = self.scene.patch
        keys: dict[str, Any] = {key: v for key, v in table if key in PatchSpec.__dataclass_fields__}
        keys |= {
            "seed": self.scene.dataset.seed,
            "max_triangles": max(table.max_triangles, 2 * len(self.body.faces)),
        }
        near_m = []  # boulders lie as near as that
        if table.fractured is not None:
            near_m.append(table.radius_m)
        if table.regolith is not None:
            # none is wider than the mean radius: it would swallow the body
            crater_m = boulder_m = self.body.mean_radius_m
            if self.scene.body.shape != "ellipsoid":  # larger ones are in the shape
                edge_m = mean_edge_m(self.body.vertices_m, self.body.faces)
                crater_m, boulder_m = min(crater_m, _CRATER_EDGES * edge_m), min(boulder_m, _BOULDER_EDGES * edge_m)
            largest = {"largest_crater_m": min(table.regolith.largest_crater_m, crater_m)}
            keys["largest_boulder_m"] = min(table.largest_boulder_m, boulder_m)
            keys["regolith"] = table.regolith.model_copy(update=largest)
            near_m.append(table.radius_m)
        if detail is not None:
            keys |= {"facet_m": detail.facet_m, "radius_m": detail.radius_m, "min_boulder_m": detail.boulder_m}
            near_m.append(detail.radius_m)
        if not table.boulders:
            keys["min_boulder_m"] = 1e6
        spec = PatchSpec(**keys)
        spec = replace(spec, boulder_near_m=max(*near_m, spec.boulder_near_m)) if near_m else spec
        patch = cached_patch(self.body, site, spec)
        kept = len(patch.boulder_diameter_m)
        # for a pose, the number of triangles sets the facets, so more triangles would not keep all boulders either
        if detail is None and kept < _FEWEST_KEPT * patch.boulders_drawn:
            drawn, ground = patch.boulders_drawn, np.count_nonzero(~patch.face_is_boulder)
            warnings.warn(
                f"site {site.index}: {drawn - kept} of {drawn} boulders are left out, because the ground has "
                f"{ground} triangles, of {spec.max_triangles} at most; raise patch.max_triangles or patch.facet_m",
                stacklevel=2,
            )
        return patch

    def spec(self, index: int) -> SampleSpec:
        """Return everything that `simulate` needs for one sample.

        On a trajectory every view has its own date, and with a table of poses its own distance of the Sun.

        Raises
        ------
        InputError
            The scene plans no such sample.
        """
        with in_file(self.source):
            return self._spec(self._checked(index, "sample "))

    def _checked(self, index: Any, named: str) -> int:
        """Return the number of a sample of the plan. Raises InputError."""
        number = tables.whole(index)
        if number is None or not 0 <= number < len(self.plan):
            raise InputError(f"{named}{shown(index)}: must be a whole number from 0 to {len(self.plan) - 1}")
        return number

    def _spec(self, index: int, switched: _Switched | None = None, taken: FlownPose | None = None) -> SampleSpec:
        """Return what `spec` does; the messages of its errors do not name the scene.

        `switched` replaces scene, faults and plan of the session, and `taken` the pose of the table.
        """
        scene, faults, planned = switched or (self.scene, self.faults, self.plan)
        plan.check_time(scene)
        table, site = self.trajectory, int(planned.site[index])
        flown = table.pose(index) if table is not None and taken is None else taken
        if table is not None and (taken is None or table.frames):
            terrain = self.terrain(self.ground_detail(index))
        elif flown is not None:
            terrain = self.aimed_terrain(flown)
        else:
            terrain = self.model_terrain(site) if scene.is_aimed else self.terrain(site)
        delay = 0
        if flown is not None and taken is None and scene.camera.exposure_s == "auto":
            delay = min(scene.camera.metering_delay_frames, flown.frame)
        return SampleSpec(
            index=index,
            scene=_dated(scene, flown) if flown is not None else self.dated_scene(index),
            plan=planned,
            faults=faults,
            terrain=terrain,
            flown=flown,
            terrain_of=self.aimed_terrain if scene.is_aimed else None,
            before=partial(self._spec, index - 1, switched) if flown is not None and flown.frame > 0 else None,
            after=table.after(index) if table is not None and taken is None else None,
            metered_on=partial(self._spec, index - delay, switched) if delay else None,
        )

    def dated_scene(self, index: int) -> Scene:
        """Return the scene with the date of a sample's view, and with its distance of the Sun on a trajectory."""
        scene = self.scene
        if self.trajectory is not None:
            return _dated(scene, self.trajectory.pose(index))
        if scene.spice.spacecraft:
            first = np.array([self.plan.first_of_view(index)])
            fraction = float(keyed_uniform(scene.dataset.seed, first, "plan", "epoch")[0])
            return ephemeris.dated(
                scene, julian_date=ephemeris.epoch_jd(scene, int(self.plan.site[index]), fraction)
            )
        return scene

    def simulate(self, index: int) -> Sample:
        """Return one finished sample."""
        spec = self.spec(index)
        if not self._compiled:
            activity.begin("compiling of kernels, with the first sample")
        sample = to_sample(simulate_frame(spec, shared=self._shared_views))
        self._compiled = True
        return sample

    def take(
        self,
        pose: Mapping[str, Any] | Sequence[Any],
        *,
        sun: Sequence[float] | None = None,
        time: float | None = None,
        faults: Mapping[str, bool | Mapping[str, Any]] | None = None,
        exposure: float | None = None,
        sample: int = 0,
    ) -> Sample:
        """Return the sample of a pose that was not known before, as for a camera in a loop.

        It equals, bit for bit, row `sample` of a table of poses with as many rows as the scene has samples, all of
        them this pose. Body, kernels, faults and, where it serves, terrain stay from call to call. In a scene with
        sequences, it is frame `sample` from another pose than planned: terrain, device, time and the frame before
        are those of this frame, so near the ground, too, no terrain is built for a call.

        Parameters
        ----------
        pose
            Position of the camera in T in m, float[3], and the quaternion `camera_from_T`, w first, float[4]; or a
            mapping with the columns of a table of poses. With a `sequence`, all samples of the session are frames
            of it: dust, defects and wear stay from call to call, and events come at its `time_s`.
        sun
            Direction from the body to the Sun in T, float[3]; by default the mapping's, or the planned frame's.
        time
            Julian date, TDB; by default the mapping's, the planned frame's, or the scene's.
        faults
            Which faults the sample has: a class is on with True or with values of keys, such as
            `{"dust_on_optics": True, "straylight": {"veil_fraction": 0.01}}`, and all others are off. By default
            the plan chooses.
        exposure
            In s; by default as the scene says, metered on this frame whatever `camera.metering_delay_frames`.
        sample
            Number of the sample, from 0 to below `dataset.samples`: the key of its noise and of what is drawn.

        Raises
        ------
        InputError
            If the pose, a fault or a value cannot be used.
        """
        number, planned = self._checked(sample, "sample = "), None
        if self.trajectory is not None and self.trajectory.frames:
            planned = self.trajectory.pose(number)
        row = one_pose(
            pose,
            sun,
            time,
            planned or self.scene.sun.julian_date,
            lambda date: ephemeris.sun_distance_au(ephemeris.dated(self.scene, julian_date=date)),
        )
        flown = row.pose(0)
        if planned is not None:
            time_s = planned.time_s if np.isnan(flown.time_s) else flown.time_s
            flown = replace(flown, sequence=planned.sequence, frame=planned.frame, time_s=time_s)
        spec = self._spec(number, self._switched(None if planned else row, faults, exposure), flown)
        return to_sample(simulate_frame(spec))

    def _switched(
        self, row: Trajectory | None, faults: Mapping[str, bool | Mapping[str, Any]] | None, exposure: float | None
    ) -> _Switched:
        """Return the scene with a call's faults and exposure, its faults, and its plan.

        `row` is the call's pose, of which the plan is; without one, it is that of the session.
        """
        if not isinstance(faults, Mapping | None):
            raise InputError(
                f"faults = {shown(faults)}: must map names of classes to True, False or values of keys"
            )
        key = json.dumps([faults, exposure, row is not None and bool(row.frames)], sort_keys=True, default=repr)
        if key not in self._taken:
            scene = self.scene
            if faults is not None or exposure is not None:
                table = scene.resolved()
                table["camera"] |= {} if exposure is None else {"exposure_s": exposure}
                for name, values in (faults or {}).items():
                    if name not in table["faults"]:
                        known = ", ".join(table["faults"])
                        raise InputError(f"faults: {shown(name)} is no fault of {self.source}; it has {known}")
                    table["faults"][name] |= dict(values) if isinstance(values, Mapping) else {}
                scene = config.parse_scene(table, source=self.source)
            kept = {"trajectory": self.scene.trajectory, "dataset": self.scene.dataset}
            scene = scene.model_copy(update=kept) if row is None else with_rows(scene, row.repeated(len(self.plan)))
            parsed, planned = configure_faults(scene, self.source), self.plan
            if row is not None:
                need_sun = [name for name, fault in parsed.items() if fault.needs_sun]
                planned = plan.make_plan(scene, list(parsed), need_sun=need_sun)
            if faults is not None:
                on = [faults.get(name, False) is not False for name in planned.faults]
                planned = replace(planned, injected=np.tile(on, (len(planned), 1)))
            if len(self._taken) == _KEPT_CALLS:
                del self._taken[next(iter(self._taken))]
            self._taken[key] = scene, parsed, planned
        return self._taken[key]

    def frame(self, index: int) -> Frame:
        """Return one sample with the outcome of every stage, from its pose to its labels."""
        return simulate_frame(self.spec(index), shared=self._shared_views)


def _dated(scene: Scene, flown: FlownPose) -> Scene:
    """Return a scene at the date of a pose, and at its distance of the Sun."""
    return ephemeris.dated(scene, julian_date=flown.julian_date, distance_au=flown.sun_distance_au)
