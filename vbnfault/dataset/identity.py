"""What the store of a scene holds: its schema, its root attributes, and what `verify` may expect of a sample."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import json
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, pipeline, store
from ..core import llvm, resources
from ..core.errors import VbnfaultError
from ..core.quantities import Sample
from ..detector import Detector, MosaicDetector
from ..faults import Fault
from ..pipeline import labels
from ..pipeline.record import proposal
from ..pipeline.spec import mask_any_faults, stored_layers
from ..scene import config, plan
from ..scene.config import Scene
from ..store import StoreSpec
from ..world import assemble
from . import build, describe

# Libraries whose version may change a pixel.
_LIBRARIES = ("mitsuba", "drjit", "numpy", "scipy", "trimesh", "scikit-image", "colour-science", "zarr")
_OPENCV = ("opencv-python-headless", "opencv-python")


def versions() -> dict[str, str]:
    """Versions of vbnfault and of every library that affects pixels, and the machine type."""
    found = {"vbnfault": __version__}
    for name in (*_LIBRARIES, *_OPENCV):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    with contextlib.suppress(VbnfaultError):  # planning and verifying need no LLVM
        version = llvm.find().version or ()
        found["llvm"] = ".".join(map(str, version))
    return found | {"machine": platform.machine()}


def scene_identity(session: pipeline.Session) -> dict[str, Any]:
    """The resolved scene with the contents, not the paths, of what it names; sizes of blocks left out."""
    scene = session.scene.resolved()
    scene["body"]["shape_sha256"] = session.body.content_hash
    if session.scene.body.shape not in ("embedded", "ellipsoid"):
        scene["body"]["shape"] = _digest(session.scene.body.shape, "shape")
    if session.scene.camera.detector:
        for key in config.OF_THE_DETECTOR:
            del scene["camera"][key]  # the detector has its own
    scene["faults"] = {name: fault.to_dict() for name, fault in session.faults.items()}
    for name, table in scene["faults"].items():
        if table.get("texture_file"):
            table["texture_file"] = _digest(table["texture_file"], "texture")
        lens = table.get("lens") or ("" if session.scene.camera.lens else session.faults[name].lens_of_thin_camera)
        if lens:
            table["lens"] = _digest(resources.find("scenes/lenses", lens), "lens")
    _contents_of_files(scene, session.scene)
    if "straylight" in session.faults:
        textures = sorted(resources.data_dir("textures").glob("*.png"))
        data = b"".join(resources.read_input(path, "texture") for path in textures)
        scene["textures_sha256"] = resources.sha256(data)
    del scene["dataset"]["samples"]  # a block more makes no other scene
    return scene


def _digest(path: str | Path, what: str) -> str:
    """`sha256:` and the digest of a file's contents, which stand for its name: renamed, it is the same."""
    return f"sha256:{resources.sha256(resources.read_input(path, what))}"


def _contents_of_files(identity: dict[str, Any], scene: Scene) -> None:
    """Put the sha256 of what lens, spacecraft, kernels and stars are read from in the place of paths."""
    if scene.camera.lens:
        identity["camera"]["lens"] = _digest(resources.find("scenes/lenses", scene.camera.lens), "lens")
    if scene.camera.detector:
        identity["camera"]["detector"] = _digest(
            resources.find("scenes/detectors", scene.camera.detector), "detector"
        )
    if scene.spacecraft.model not in ("none", "default"):
        with resources.noting() as digests:  # a glTF names files beside it
            assemble.spacecraft(scene)
        identity["spacecraft"]["model"] = f"sha256:{'+'.join(digests)}"
    if scene.spice.kernels:
        # a meta-kernel only names others: what follows from them all says more than its own text
        sun_J_au, T_from_J = assemble.ephemeris(scene)
        follows = [*sun_J_au.tolist(), *T_from_J.ravel().tolist()]
        if scene.spice.spacecraft:
            for k in range(scene.dataset.sites):
                pose = assemble.spacecraft_pose(scene, assemble.epoch_jd(scene, k, 0.5))
                follows += [*pose.camera_position_T_m.tolist(), *pose.T_from_C.ravel().tolist()]
        numbers = config.content_hash(follows)
        identity["spice"]["kernels"] = [f"ephemeris:{numbers}"]
    if scene.sky.stars != "off":
        identity["sky"]["catalogue"] = _digest(resources.data_dir("catalogues") / "stars.npz", "star catalogue")


def store_spec(session: pipeline.Session, blocks: Sequence[int]) -> StoreSpec:
    """The store of a scene, planned in `blocks`. Raises InputError for layers this world cannot give."""
    scene = session.scene
    dataset, camera = scene.dataset, session.base_camera  # first of all: a lens that cannot be had is told here
    layers = tuple(name for name in stored_layers(scene, session.faults) if name != "clean")
    individuals = scene.camera.individuals
    kinds = tuple(labels.kind(fault, is_ccd=camera.is_ccd) for fault in session.faults.values())
    identity, made_with = scene_identity(session), versions()
    if scene.spice.kernels:
        made_with["spiceypy"] = importlib.metadata.version("spiceypy")
    attributes: dict[str, Any] = {
        "title": scene.title,
        "description": scene.description,
        "scene": identity,
        "scene_hash": config.content_hash(identity, made_with),
        "seed": dataset.seed,
        "blocks": list(blocks),
        "versions": made_with,
        "licence": dataset.licence,
        "citation": dataset.citation,
        "intensity_channel": _intensity(camera.detector),
        "optics": camera.lens.figures,
        "detector": _detector(camera.detector),
        "fault_models": {name: fault.model for name, fault in session.faults.items()},
    }
    return StoreSpec(
        height=camera.height_px,
        width=camera.width_px,
        faults=tuple(session.faults),
        mask_any_faults=mask_any_faults(scene, session.faults),
        localised_faults=tuple(name for name, fault in session.faults.items() if fault.localised),
        mask_kinds=kinds,
        mask_rules=tuple(
            _mask_rule(kind, fault) for kind, fault in zip(kinds, session.faults.values(), strict=True)
        ),
        soft_layers=tuple(fault.soft_layer for fault in session.faults.values()),
        wavelength_nm=tuple(float(w) for w in assemble.wavelengths_nm(scene)),
        layers=layers,
        site_names=tuple(f"site_{k:05d}" for k in range(dataset.sites)),
        lens_names=(camera.lens_name,),
        distortion_residual_px=camera.distortion_residual_px,
        attitude_references=assemble.attitude_references(scene),
        detector_names=tuple(f"{camera.detector.name} {k}" for k in range(individuals))
        if individuals > 1
        else (camera.detector.name,),
        radiance_dtype="float32",
        shard_samples=dataset.shard_samples,
        attributes=attributes,
    )


def _mask_rule(kind: str, fault: Fault) -> str:
    if kind == "effect":
        return store.EFFECT_RULE
    rule = labels.footprint_rule(fault)
    if kind == "strong effect":
        return rule
    return f"{rule}; or {store.EFFECT_RULE}" if "effect" in kind else rule


def _intensity(detector: Detector | MosaicDetector) -> str:
    if "W" in detector.channels:
        return "pixels without a colour filter"
    return "luminance of RGB, Rec. 709 weights"


def _detector(detector: Detector | MosaicDetector) -> dict[str, Any]:
    """What a user of the raw mosaic, or of noise, must know of the sensor."""
    plain: dict[str, Any] = {
        "name": detector.name,
        "pixel_pitch_um": detector.pixel_pitch_um,
        "full_well_e": detector.full_well_e,
        "read_noise_e_rms": detector.read_noise_e_rms,
    }
    if isinstance(detector, Detector):
        return plain | {
            "bits": detector.adc_bits,
            "bias_dn": detector.bias_dn,
            "gain_dn_per_e": detector.gain_dn_per_e,
        }
    sensor = detector.sensor
    readout, tile = sensor.readout, sensor.pattern.tile
    return plain | {
        "architecture": sensor.architecture,
        "shutter": sensor.shutter,
        "mosaic": [[sensor.pattern.channels[k] for k in row] for row in tile],
        "bits": readout.bits,
        "bias_dn": readout.bias_dn,
        "gain_dn_per_e": readout.system_gain_dn_per_e,
        "nodes": readout.nodes,
        "node_gains": list(readout.node_gains),
        "node_offsets_dn": list(readout.node_offsets_dn),
        "white_balance": dict(zip(detector.channels, detector.white_balance.tolist(), strict=True)),
        "temperature_K": sensor.temperature_K,
        "row_readout_s": sensor.transfer.row_readout_s,
        "demosaic": sensor.method,
        # the whole file, with the sources of its numbers
        "sensor": json.loads(json.dumps(dataclasses.asdict(sensor))),
    }


def is_exact(attributes: Mapping[str, Any]) -> bool:
    """Return whether the plan of a stored scene is met exactly: every commanded fault is injected.

    It is not where another view may not be taken: as `plan.on_invisible` says, where SPICE places the camera, and
    where the Sun stays as drawn.
    """
    scene = attributes["scene"]
    redraws = scene.get("plan", {}).get("on_invisible") == "redraw_view"
    as_drawn = scene.get("geometry", {}).get("sun_visibility") == "as_drawn"
    return bool(redraws and not as_drawn and not scene.get("spice", {}).get("spacecraft"))


def stored_scene(attributes: Mapping[str, Any]) -> Scene:
    """Return the scene that a store was planned from, without the contents of the files that it names."""
    stored = {key: value for key, value in attributes["scene"].items() if key != "textures_sha256"}
    stored["body"] = {key: value for key, value in stored["body"].items() if key != "shape_sha256"}
    # what is added to the tables of a scene's identity is no key of a scene
    for name, added in (("sky", "catalogue"),):
        stored[name] = {key: value for key, value in stored.get(name, {}).items() if key != added}
    if stored["camera"].get("lens"):
        # earlier versions stored those of a thin lens here, which did nothing; no plan depends on them
        unused = ("f_number", "transmission")
        stored["camera"] = {key: value for key, value in stored["camera"].items() if key not in unused}
    stored["dataset"] = {**stored["dataset"], "samples": attributes["blocks"][0]}
    return config.parse_scene(stored, source="the store's own scene")


def planned(attributes: Mapping[str, Any], faults: Sequence[str]) -> Callable[[int, int], dict[str, Any]]:
    """What the plan of a stored scene says of a sample that kept the view of so many `tries`: the scalars that
    rendering cannot change, and the commanded faults as `injected`."""
    scene = stored_scene(attributes)
    table = plan.make_plan(scene, faults, attributes["blocks"])

    def expected(index: int, tries: int) -> dict[str, Any]:
        drawn = table.view(scene, index, tries - 1)
        # where SPICE places camera and Sun, they are not the plan's
        names = ("sun_azimuth_deg", "sun_elevation_deg", "roll_deg", "pitch_deg", "yaw_deg")
        angles = () if scene.spice.spacecraft else names
        return {
            **{name: drawn[name] for name in angles},
            "stratum": int(table.stratum[index]),
            "site": int(table.site[index]),
            "split": plan.SPLITS[table.split[index]],
            "detector_individual": int(table.individual[index]),
            "proposal": proposal(scene, table, index, drawn),
            "injected": table.injected[index],
        }

    return expected


@dataclasses.dataclass(frozen=True)
class SessionFactory:
    """Makes the session of a scene in a worker; picklable. `threads`: render threads of that worker."""

    scene: Scene
    blocks: tuple[int, ...]
    threads: int | None = None
    contents: resources.Contents = dataclasses.field(default_factory=resources.Contents)

    def __call__(self) -> build.SampleMaker:
        threads = self.threads or resources.environment_whole("VBNFAULT_THREADS", resources.MOST_THREADS) or None
        with self.contents.in_use():
            return _Session(pipeline.Session(self.scene, blocks=self.blocks, threads=threads), self.contents)


@dataclasses.dataclass(frozen=True)
class _Session:
    """Run a session whose input files must hold what they held when the build was planned."""

    session: pipeline.Session
    contents: resources.Contents

    def simulate(self, index: int) -> Sample:
        with self.contents.in_use():
            return self.session.simulate(index)


def estimated_seconds(session: pipeline.Session) -> float:
    """Return about how long the whole dataset takes on this machine, in seconds.

    The model follows the README's table. A sample takes 0.3 s of processor time, and each of its megapixels 1.2 s
    for truth, pictures, labels and the store and 0.25 s for each ray of a pixel and each bounce. A new patch of
    terrain takes 16 s for 1.6 million triangles. Adaptive sampling counts as four times the least rays. All cores
    work.
    """
    scene = session.scene
    render, camera = scene.render, scene.camera
    rays = render.samples_per_pixel
    if render.noise_fraction is not None:
        rays = min(4 * rays, max(rays, render.max_samples_per_pixel))
    megapixels = camera.width_px * camera.height_px / 1e6
    sample_s = 0.3 + megapixels * (1.2 + 0.25 * rays * (1 + render.bounces))
    patch_s = 16 * scene.patch.max_triangles / 1.6e6
    sites = len(np.unique(session.plan.site))
    return (len(session.plan) * sample_s + sites * patch_s) / (os.cpu_count() or 1)


def build_scene(
    scene: Scene | str | Path,
    out: str | Path,
    *,
    source: str | None = None,
    workers: int = 1,
    threads: int | None = None,
    scheduler: str | None = None,
    append: int | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
    accept_versions: bool = False,
    samples_given: bool = True,
) -> build.Summary:
    """Build, resume, mend or extend the store of a scene at `out`; see `build.build` for what is raised.

    `scene` is a scene, the path of a scene file, or the name of a packaged scene; `source` names it in errors. With
    `append` and no samples given, the store's own first block counts.
    """
    if not isinstance(scene, Scene):
        source, scene = source or str(scene), config.load_scene(scene)
    source, out = source or "scene", Path(out)
    samples = scene.dataset.samples
    if append and not samples_given and store.is_store(out):
        samples = int(store.open_store(out).attributes["blocks"][0])
    blocks = build.planned_blocks(out, samples, append=append or 0, overwrite=overwrite)
    contents = resources.Contents()
    with contents.in_use():
        session = pipeline.Session(scene, blocks=blocks, source=source)
        session.warn_of_assumptions()
        counts = {name: int(session.plan.injects(name).sum()) for name in session.faults}
        spec = store_spec(session, blocks)
        description: list[str] = []
        if dry_run:
            description = describe.describe(
                session, sample_bytes=spec.estimated_sample_bytes, seconds=estimated_seconds(session)
            )
    contents.complete()
    if not dry_run:
        for sentence in plan.shortcomings(scene, session.plan):
            print(f"warning: {sentence}", file=sys.stderr)
    summary = build.build(
        SessionFactory(scene, blocks, threads, contents),
        spec,
        out,
        site=session.plan.site,
        blocks=blocks,
        workers=workers,
        scheduler=scheduler,
        threads=threads,
        overwrite=overwrite,
        dry_run=dry_run,
        accept_versions=accept_versions,
        fault_counts=counts,
        planned_faults=session.plan.injected,
        estimated_seconds=estimated_seconds(session),
        expected=planned(spec.attributes, spec.faults),
        exact=is_exact(spec.attributes),
    )
    return dataclasses.replace(summary, description=tuple(description))


def describe_scene(scene: Scene, *, source: str) -> list[str]:
    """Return what a scene will photograph, as lines; nothing is rendered. `source` names it in errors."""
    session = pipeline.Session(scene, source=source)
    spec = store_spec(session, (scene.dataset.samples,))
    return describe.describe(session, sample_bytes=spec.estimated_sample_bytes, seconds=estimated_seconds(session))
