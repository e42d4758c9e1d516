"""Define the work that the benchmarks time: the stages of one labelled sample, its frame filled with terrain."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from detector_chain import Chain, speckled

from vbnfault import dataset, pipeline, render, store
from vbnfault.body import Patch
from vbnfault.core import frames, spectra
from vbnfault.core.quantities import Sample
from vbnfault.core.spectra import Bands
from vbnfault.lens import load_lens, scaled_to_focal_length
from vbnfault.lens.straylight.irradiance import FlareModel
from vbnfault.lens.straylight.settings import SensorGrid
from vbnfault.pipeline.exposure import meter
from vbnfault.pipeline.images import take_images
from vbnfault.pipeline.injection import inject_faults
from vbnfault.pipeline.labels import label
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.rendering import describe
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import Frame, Pose, Rendering, SampleSpec, SceneLight, Terrain
from vbnfault.reflectance.hapke import hapke_at
from vbnfault.render.description import RenderInput
from vbnfault.render.runtime import dr, mi
from vbnfault.render.sampling import Optics, Pixels, Strata, SunDisc
from vbnfault.scene import config, plan

SCENE = "paper_example"  # for its six faults; the view is defined below
SHARD_SAMPLES = 8

# An oblique view of talus without sky. The Sun is ahead, above the frame: long shadows and visible flares.
CAMERA_HEIGHT_M = 80.0
CAMERA_AZIMUTH_DEG = 240.0
CAMERA_BELOW_HORIZON_DEG = 52.0
SUN_AZIMUTH_DEG = 225.0
SUN_ELEVATION_DEG = 24.0

FLARE_LENS = "nikkor_35_f2p8"
FLARE_SUN_DEG = 16.0
NM = np.linspace(400.0, 700.0, 301)


def clock(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return the duration of a call in s, including the work it queued on the render threads, and its result."""
    dr.sync_thread()
    start = time.perf_counter()
    result = function()
    dr.sync_thread()
    return time.perf_counter() - start, result


@dataclass(frozen=True, eq=False)
class Workload:
    """A terrain, a pose above it, and a sample of the scene with this pose."""

    session: pipeline.Session
    patch: Patch
    spec: SampleSpec
    pose: Pose

    @classmethod
    def load(cls, size_px: int, *, facet_m: float | None = None) -> Workload:
        """Return the workload for an image of `size_px` × `size_px`; `facet_m` gives coarser terrain."""
        overrides: dict[str, Any] = {
            "camera.width_px": size_px,
            "camera.height_px": size_px,
            "dataset.layers": ["clean"],
            "dataset.samples": SHARD_SAMPLES,
            "dataset.shard_samples": SHARD_SAMPLES,
            "faults.optics_degradation.scale_with_resolution": False,  # otherwise too fine to show in small images
        }
        if facet_m is not None:
            overrides |= {"patch.facet_m": facet_m, "patch.min_boulder_m": 4 * facet_m}
        session = pipeline.Session(config.load_scene(SCENE, overrides))
        patch = session.patch(session.sites[0])
        surface = session.surface(patch)
        terrain = Terrain(body=session.body, site=patch.site, surface=surface)
        spec = SampleSpec(index=0, scene=session.scene, plan=session.plan, faults=session.faults, terrain=terrain)
        return cls(session, patch, spec, _pose(surface))

    @cached_property
    def scene(self) -> RenderInput:
        """The input of the renderer."""
        return describe(self.spec, self.pose)

    def bound(self) -> None:
        """Trace the same rays as the render in the same order, one closest hit and one shadow ray each.

        This is the lower bound of the render's duration: one kernel that writes one byte a sample, without bands,
        shading and sums over pixels.
        """
        view, traced = self.scene.view, self.spec.terrain.surface.scene
        optics, sun = Optics(view), SunDisc(self.scene.sun)
        strata = Strata(Pixels(view.width_px * view.height_px), self.scene.samples_per_pixel, self.scene.key)
        rays = optics.camera_rays(strata)
        found = traced.ray_intersect_preliminary(rays, coherent=True)
        # towards the Sun's centre from just before the hit, which needs neither a normal nor a point on the disc
        shadow = mi.Ray3f(rays(found.t * (1 - 1e-4)), sun.direction)
        lit = found.is_valid() & ~traced.ray_test(shadow, True, found.is_valid())
        dr.eval(lit)

    def grey(self) -> np.ndarray:
        """Return the middle band of the render as linear grey, float32[y, x]."""
        array = render.radiance(self.spec.terrain.surface, self.scene).array
        return array[len(array) // 2]

    def labelled_sample(self, folder: store.Store) -> tuple[dict[str, float], Frame]:
        """Return the duration in s of each stage of a sample from proposal to disk, and its frame.

        `store` is the time per sample of encoding and writing a shard of 8. The other renders, the flare and the
        detector chains are timed in between, but are not part of the sample.
        """
        seconds: dict[str, float] = {}
        surface = self.spec.terrain.surface
        spec, pose, scene = self.spec, self.pose, self.scene
        seconds["resolve"], _ = clock(lambda: resolve(spec))
        seconds["render"], radiance = clock(lambda: render.radiance(surface, scene))
        seconds["truth"], truth = clock(lambda: render.truth(surface, scene.view, scene.sun))
        light = SceneLight(lens=spec.camera.lens, rendered=radiance)
        rendering = Rendering(
            scene=scene,
            light=light,
            truth=truth,
            open_sky=None,
            samples_per_pixel=float(scene.samples_per_pixel),
        )
        seconds["meter"], exposure = clock(lambda: meter(spec, rendering))
        seconds["inject_faults"], injection = clock(lambda: inject_faults(spec, pose, rendering, exposure))
        seconds["take_images"], images = clock(lambda: take_images(spec, injection))
        seconds["label"], labels = clock(lambda: label(spec, injection))
        frame = Frame(
            spec=spec,
            views=1,
            pose=pose,
            rendering=rendering,
            starless=None,
            exposure=exposure,
            injection=injection,
            images=images,
            labels=labels,
        )
        # the same view with the photometry of the physical scenes
        physical = replace(scene, reflectance=hapke_at(scene.wavelength_nm))
        seconds["hapke"], _ = clock(lambda: render.radiance(surface, physical))
        lit = replace(physical, bounces=1)
        seconds["bounce"], _ = clock(lambda: render.radiance(surface, lit, truth))
        seconds["flare"], _ = clock(self.flare)
        for name, chain in self.chains.items():
            seconds[name], _ = clock(chain.expose)
        seconds["to_sample"], sample = clock(lambda: to_sample(frame))
        shard, _ = clock(lambda: write_shard(folder, sample))
        seconds["store"] = shard / SHARD_SAMPLES
        return seconds, frame

    @cached_property
    def flares(self) -> FlareModel:
        """The model of all ghosts of an 11-surface lens in the channels of the camera, on the camera's sensor."""
        camera = self.session.base_camera
        lens = scaled_to_focal_length(load_lens(FLARE_LENS), camera.lens.focal_length_mm)
        return FlareModel(
            lens,
            Bands.of(NM, camera.detector.electron_rates(NM) * spectra.solar_irradiance_W_m2_nm(NM)),
            SensorGrid(shape=(camera.height_px, camera.width_px), pitch_mm=camera.detector.pixel_pitch_um * 1e-3),
            sun_radius_rad=self.scene.sun.angular_radius_rad,
        )

    def flare(self) -> np.ndarray:
        """Return a full flare frame, the irradiance of all ghosts, float32[band, y, x]."""
        return self.flares.image(FLARE_SUN_DEG, 30.0)

    @cached_property
    def chains(self) -> dict[str, Chain]:
        """A CCD's and a CMOS sensor's chain with every effect on."""
        light = speckled(self.session.base_camera.width_px)
        return {
            "chain_ccd": Chain.of("frame_transfer_ccd", "malvar", light),
            "chain_cmos": Chain.of("cmos", "malvar", light),
        }

    def empty_store(self, path: Path) -> store.Store:
        """Create a store for one shard of samples at `path` and return it."""
        return store.create(path, dataset.store_spec(self.session, [SHARD_SAMPLES]), SHARD_SAMPLES)


def write_shard(folder: store.Store, sample: Sample) -> None:
    """Encode and write the sample eight times, as a build writes a shard."""
    store.write_samples(folder, (replace(sample, index=i) for i in range(SHARD_SAMPLES)))


def _pose(surface: render.TerrainMesh) -> Pose:
    """Return the benchmark's pose above the site, with the Sun at its direction."""
    ground = float(render.ground_height_m(surface, np.zeros(1), np.zeros(1), 300.0)[0])
    z = frames.direction_L(CAMERA_AZIMUTH_DEG, -CAMERA_BELOW_HORIZON_DEG)
    x = np.cross([0.0, 0.0, 1.0], z)  # no roll: y of the image points down
    x /= np.linalg.norm(x)
    return Pose(
        position_L_m=np.array([0.0, 0.0, -(ground + CAMERA_HEIGHT_M)]),
        L_from_C=np.column_stack([x, np.cross(z, x), z]),
        sun_L=frames.direction_L(SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG),
        sun_azimuth_deg=SUN_AZIMUTH_DEG,
        sun_elevation_deg=SUN_ELEVATION_DEG,
        sun_visible_fraction=1.0,
        tries=1,
        variables=dict.fromkeys(plan.VARIABLES, 0.0),  # placed by hand, not drawn
        resolved=True,
    )


def medians(rounds: list[Mapping[str, float]]) -> dict[str, float]:
    """Return the median of every entry over the rounds."""
    return {name: float(np.median([r[name] for r in rounds])) for name in rounds[0]}
