"""Compute what a store must hold according to its scene.

`store_spec` returns the spec of the store, which includes the root attributes. `scene_identity` returns the part of
the root attributes that identifies the scene. `planned` computes the scalars of each sample that the plan sets; it
reads the root attributes of an existing store. `verify` compares a store with all of this.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import operator
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__, pipeline, reflectance, store
from ..camera import Camera
from ..core.errors import InputError, VbnfaultError, in_file
from ..core.files import file_contents, resources, user_files
from ..core.process import llvm
from ..detector import Detector, load_sensor
from ..faults import Fault, belongs_here, is_packaged, loaded_plugin, plugins_of, registry
from ..lens import load_lens
from ..pipeline import masks
from ..pipeline.record import proposal
from ..pipeline.spec import mask_any_faults, stored_layers
from ..scene import config, plan
from ..scene.config import Scene
from ..scene.instrument import OF_THE_DETECTOR
from ..scene.sampling import OF_AN_AIM
from ..scene.target import EARTH
from ..scene.trajectory import place_in_sequence
from ..store import StoreSpec
from ..world import assemble, ephemeris

# A new version of one of these libraries may change pixel values.
_LIBRARIES = ("mitsuba", "drjit", "numpy", "scipy", "trimesh", "scikit-image", "colour-science", "zarr")
# Root attribute of a store whose samples were taken again from the radiance of another: `samples`, the ranges
# [first, last] of the other's plan that it holds; `repeats`, how often it holds each; `source`, what identifies the
# other store and its plan.
RETAKE = "retake"
# Root attribute of a store of images into which faults were put: digests of their files, and where the Sun is.
IMAGES = "images"
# Keys that came after version 0.1 of the store: a scene that has their defaults has the identity of before.
_LEFT_OUT_AT_DEFAULT = (
    "body.atmosphere",
    "body.albedo_map.projection",
    "body.sharpen",
    "body.volume_km3",
    "coma",
    "camera.black",
    "camera.calibration",
    "camera.point_spread",
    "camera.stretch",
    "camera.exposure_max_towards_sun_s",
    "camera.exposure_stops",
    "camera.metering_delay_frames",
    "dataset.variants_per_view",
    "event",
    "dataset.radiance_dtype",
    "image",
    "image.frames",
    "motion",
    "trajectory.flight",
    "trajectory.frames",
    "patch.airfall",
    "patch.fractured",
    "patch.contour_scarps",
    "patch.facet_px",
    "patch.largest_boulder_m",
    "patch.preset",
    "patch.regolith",
    "patch.roughness",
    "plan.order",
    "plan.unusable_views",
    "sky.bodies",
    "trajectory",
)
_OPENCV = ("opencv-python-headless", "opencv-python")


def versions() -> dict[str, str]:
    """Return the versions of vbnfault and of every library that affects pixel values, and the machine type."""
    numbers = {"vbnfault": __version__}
    for name in (*_LIBRARIES, *_OPENCV):
        try:
            numbers[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    with contextlib.suppress(VbnfaultError):  # plans and checks work without LLVM, so a missing LLVM is no error
        version = llvm.find().version or ()
        numbers["llvm"] = ".".join(map(str, version))
    return numbers | {"machine": platform.machine()}


def scene_identity(session: pipeline.Session) -> dict[str, Any]:
    """Return the resolved scene, in which a digest of each file's contents replaces the path of the file.

    The result omits the number of samples, because the identity must not change when samples are appended.
    """
    with in_file(session.source):
        return _identity(session)


def _identity(session: pipeline.Session) -> dict[str, Any]:
    """Return what `scene_identity` does; the messages of its errors do not name the scene."""
    scene = with_contents(session.scene, session.faults)
    scene["body"]["shape_sha256"] = session.body.content_hash
    if session.scene.body.shape not in ("embedded", "ellipsoid"):
        scene["body"]["shape"] = _digest(session.scene.body.shape, "shape")
    if session.scene.camera.detector:
        for key in OF_THE_DETECTOR:
            del scene["camera"][key]  # the value in the detector's file overrides this key
    for folder in {fault.packaged_images for fault in session.faults.values()} - {""}:
        images = sorted(resources.data_dir(folder).glob("*.png"))
        data = b"".join(user_files.read_input(path, "texture") for path in images)
        scene[f"{folder}_sha256"] = user_files.sha256(data)
    if session.scene.trajectory is not None and session.scene.trajectory.file is not None:
        scene["trajectory"]["file"] = _digest(session.scene.trajectory.file, "trajectory")
    _leave_out_unused(scene, session.scene)
    del scene["dataset"]["samples"]
    return scene


def with_contents(scene: Scene, faults: Mapping[str, Fault]) -> dict[str, Any]:
    """Return a resolved scene in which digests replace the paths of the files of faults, camera and sky."""
    plain = scene.resolved()
    plain["faults"] = {name: fault.to_dict() for name, fault in faults.items()}
    for name, table in plain["faults"].items():
        _contents_of_fault(table, faults[name], scene)
    _contents_of_files(plain, scene)
    _identify_plugins(plain, scene, faults)
    return plain


def _leave_out_unused(identity: dict[str, Any], scene: Scene) -> None:
    """Delete what a scene does not use, and keys at their defaults, so that earlier stores keep their identity."""
    for key in _LEFT_OUT_AT_DEFAULT:
        *tables, name = key.split(".")
        holder: Any = functools.reduce(getattr, tables, scene)
        if holder is not None and getattr(holder, name) == type(holder).model_fields[name].default:
            del functools.reduce(operator.getitem, tables, identity)[name]
    if spread := scene.camera.point_spread:
        unused = () if spread.core_y_urad else ("core_y_urad",)
        for key in unused if spread.wing_fraction else (*unused, "wing_fraction", "wing_urad", "wing_index"):
            del identity["camera"]["point_spread"][key]
    del identity["event_camera"]  # no sample depends on it
    if not scene.is_aimed:
        for key in OF_AN_AIM:
            del identity["geometry"][key]


def _identify_plugins(identity: dict[str, Any], scene: Scene, faults: Mapping[str, Fault]) -> None:
    """Replace the names of plug-ins by the digests of their sources and the models that the scene has of them."""
    del identity["plugins"]
    plugins = plugins_of(faults, scene.plugins)
    if plugins:
        identity["plugins"] = {
            plugin.name: {
                "sha256": plugin.sha256,
                "models": plugin.model_names,
                "needs_sun": sorted({cls.fault for cls in plugin.models if _needs_sun(cls, faults)}),
            }
            for plugin in plugins
        }


def _needs_sun(cls: type[Fault], faults: Mapping[str, Fault]) -> bool:
    """Return whether a model needs the Sun, with its keys in the scene if the scene has it."""
    fault = faults.get(cls.fault)
    return fault.needs_sun if type(fault) is cls else cls.needs_sun


def _contents_of_fault(table: dict[str, Any], fault: Fault, scene: Scene) -> None:
    """Replace each path in the table of a fault by a digest of the file's contents."""
    for f in dataclasses.fields(fault):
        if f.metadata["kind"] == "paths" and f.name in table:
            table[f.name] = [_digest(path, f.metadata["content"]) for path in table[f.name]]
        elif f.metadata["kind"] == "path" and table[f.name]:
            content, packaged, path = f.metadata["content"], f.metadata["packaged"], table[f.name]
            if content == "lens":
                table[f.name] = _lens_digest(path)
            else:
                table[f.name] = _digest(resources.find(packaged, path) if packaged else path, content)
    if fault.lens_of_thin_camera and not scene.camera.lens and not table["lens"]:
        table["lens"] = _lens_digest(fault.lens_of_thin_camera)


def _digest(path: str | Path, what: str) -> str:
    """Return `sha256:` followed by the digest of a file's contents; the digest does not depend on its name."""
    return f"sha256:{user_files.sha256(user_files.read_input(path, what))}"


def _lens_digest(name: str) -> str:
    """Return `sha256:` and the digests of a lens file and of the glass catalogues it refers to, joined by +."""
    with file_contents.noting() as digests:
        load_lens(name)
    return f"sha256:{'+'.join(digests)}"


def _contents_of_files(identity: dict[str, Any], scene: Scene) -> None:
    """Replace the paths in a scene by digests: lens, detector, spacecraft model and SPICE kernels.

    If the scene has stars, the digest of the star catalogue is added.
    """
    if scene.camera.lens:
        identity["camera"]["lens"] = _lens_digest(scene.camera.lens)
    if scene.camera.detector:
        path = resources.find("scenes/detectors", scene.camera.detector)
        measured = load_sensor(path).measured
        identity["camera"]["detector"] = "+".join(
            [_digest(path, "detector"), *(measured.digests if measured else ())]
        )
    if scene.body.albedo_map is not None and scene.body.albedo_map.file != EARTH:
        identity["body"]["albedo_map"]["file"] = _digest(scene.body.albedo_map.file, "texture")
    if scene.image is not None and scene.image.response_file:
        identity["image"]["response_file"] = _digest(scene.image.response_file, "response")
    if scene.spacecraft.model not in ("none", "default"):
        with (
            file_contents.noting() as digests
        ):  # a glTF file may refer to other files, whose digests are needed too
            assemble.spacecraft(scene)
        identity["spacecraft"]["model"] = f"sha256:{'+'.join(digests)}"
    if scene.spice.kernels:
        # the text of a meta-kernel only lists other kernels, so the digest is that of the resulting ephemeris
        sun_J_au, T_from_J = ephemeris.ephemeris(scene)
        follows = [*sun_J_au.tolist(), *T_from_J.ravel().tolist()]
        if scene.spice.spacecraft:
            for k in range(scene.dataset.sites):
                pose = ephemeris.spacecraft_pose(scene, ephemeris.epoch_jd(scene, k, 0.5))
                follows += [*pose.camera_position_T_m.tolist(), *pose.T_from_C.ravel().tolist()]
        numbers = content_hash(follows)
        identity["spice"]["kernels"] = [f"ephemeris:{numbers}"]
    if scene.sky.stars != "off":
        identity["sky"]["catalogue"] = _digest(resources.data_dir("catalogues") / "stars.npz", "star catalogue")


def store_spec(session: pipeline.Session, blocks: Sequence[int]) -> StoreSpec:
    """Return the spec of the store of a scene whose samples are planned in `blocks`.

    Parameters
    ----------
    session
        Session of the scene.
    blocks
        Number of samples in each block: the first block, then the appended blocks in order.

    Raises
    ------
    InputError
        The scene asks for a layer that its world does not provide, or worker processes cannot load a fault.
    """
    scene = session.scene
    plan.check_time(scene)
    dataset, camera = scene.dataset, session.base_camera  # base_camera first: it reports an unusable lens
    layers = tuple(name for name in stored_layers(scene, session.faults) if name != "clean")
    individuals = scene.camera.individuals
    _check_origins(session.faults)
    kinds = tuple(masks.kind(fault, camera) for fault in session.faults.values())
    references = ephemeris.attitude_references(scene)
    return StoreSpec(
        height=camera.height_px,
        width=camera.width_px,
        faults=tuple(session.faults),
        mask_any_faults=mask_any_faults(scene, session.faults),
        mask_any_joint=True,
        localised_faults=tuple(name for name, fault in session.faults.items() if fault.localised),
        mask_kinds=kinds,
        mask_rules=tuple(
            _mask_rule(kind, fault) for kind, fault in zip(kinds, session.faults.values(), strict=True)
        ),
        soft_layers=tuple(fault.soft_layer for fault in session.faults.values()),
        wavelength_nm=tuple(float(w) for w in ephemeris.wavelengths_nm(scene)),
        layers=layers,
        site_names=tuple(f"site_{k:05d}" for k in range(dataset.sites)),
        lens_names=(camera.lens.name,),
        distortion_residual_px=camera.lens.distortion_residual_px,
        distortion_valid_to_deg=camera.lens.distortion_valid_to_deg,
        **_calibrated(camera),
        attitude_references=references,
        centre_of_mass_T_m=tuple(session.body.centre_of_mass_T_m.tolist()) if "centre" in references else None,
        detector_names=tuple(f"{camera.detector.name} {k}" for k in range(individuals))
        if individuals > 1
        else (camera.detector.name,),
        radiance_dtype=dataset.radiance_dtype,
        rendered_shape=_rendered_shape(camera) if "scene_radiance" in layers else (),
        shard_samples=dataset.shard_samples,
        sample_names=() if session.trajectory is None else session.trajectory.name,
        sequence_names=() if session.trajectory is None else session.trajectory.sequence_names,
        attributes=_root_attributes(session, blocks),
    )


def _calibrated(camera: Camera) -> dict[str, Any]:
    """Return the fields of a store that describe the calibration of its camera; {} without one."""
    calibration = camera.lens.calibration
    if calibration is None:
        return {}
    return {
        "distortion_model": calibration.model,
        "coefficients": tuple(calibration.stored_coefficients),
        "skew_px": calibration.skew,
    }


def _rendered_shape(camera: Camera) -> tuple[int, int]:
    """Return rows and columns of a render, with the guard band that the camera's lens needs."""
    guard_x, guard_y = camera.lens.guard_px
    return camera.height_px + 2 * guard_y, camera.width_px + 2 * guard_x


def _root_attributes(session: pipeline.Session, blocks: Sequence[int]) -> dict[str, Any]:
    """Return the root attributes of the store of a scene whose samples are planned in `blocks`."""
    scene, camera = session.scene, session.base_camera
    identity, made_with = scene_identity(session), versions()
    if scene.spice.kernels:
        made_with["spiceypy"] = importlib.metadata.version("spiceypy")
    return {
        "title": scene.title,
        "description": scene.description,
        "scene": identity,
        "scene_hash": content_hash(identity, made_with),
        "seed": scene.dataset.seed,
        "blocks": list(blocks),
        "versions": made_with,
        "licence": scene.dataset.licence,
        "citation": scene.dataset.citation,
        "intensity_channel": _intensity(camera.detector),
        "optics": camera.lens.figures,
        "detector": camera.detector.description,
        "fault_models": {name: fault.model for name, fault in session.faults.items()},
    }


def _check_origins(faults: Mapping[str, Fault]) -> None:
    """Raise InputError if worker processes cannot load a fault, for example a fault defined in a notebook."""
    for name, fault in faults.items():
        if not belongs_here(fault):
            cls = type(fault)
            raise InputError(
                f"faults.{name}.model = {fault.model!r}: its class {cls.__qualname__} is defined in "
                f"{cls.__module__}, which worker processes cannot load; put it in a file and name that in plugins"
            )


def _mask_rule(kind: str, fault: Fault) -> str:
    """Return the rule by which the mask of a fault class is made, as text."""
    if kind == "effect":
        return store.EFFECT_RULE
    rule = masks.footprint_rule(fault)
    if kind == "strong effect":
        return rule
    return f"{rule}; or {store.EFFECT_RULE}" if "effect" in kind else rule


def _intensity(detector: Detector) -> str:
    """Return a text that names the source of the intensity channel."""
    if "W" in detector.channels:
        return "pixels without a colour filter"
    return "luminance of RGB, Rec. 709 weights"


def check_described(opened: store.Store) -> None:
    """Raise InputError unless the root attributes of a store have the tables of a scene that can be planned."""
    attributes = opened.attributes
    while True:
        scene = attributes.get("scene", {})
        lacks = [key for key in ("scene", "blocks", "fault_models") if key not in attributes]
        lacks = lacks or [f"scene.{key}" for key in ("body", "camera", "dataset", "faults") if key not in scene]
        if lacks:
            raise InputError(
                f"{opened.path}: its root attributes lack {', '.join(lacks)}, so its views are not known; it was "
                "not built from a scene, or another program changed them"
            )
        if RETAKE not in attributes:
            return
        attributes = attributes[RETAKE]["source"]


def is_exact(attributes: Mapping[str, Any]) -> bool:
    """Return whether a stored scene must inject every commanded fault.

    A fault that is invisible in a view can be injected only if the view is drawn again. The result is therefore
    False if `plan.on_invisible` is not `redraw_view`, if SPICE or a table of poses places the camera, or if
    `geometry.sun_visibility` is `as_drawn`, or if the store was taken again from the views of another.
    """
    scene = attributes["scene"]
    redraws = scene.get("plan", {}).get("on_invisible") == "redraw_view"
    as_drawn = scene.get("geometry", {}).get("sun_visibility") == "as_drawn"
    flown = scene.get("spice", {}).get("spacecraft") or scene.get("trajectory")
    return bool(redraws and not as_drawn and not flown and not {RETAKE, IMAGES} & set(attributes))


def stored_scene(attributes: Mapping[str, Any]) -> Scene:
    """Return the scene of a store from its root attributes, without the digests that `scene_identity` added."""
    scene = attributes["scene"]
    stored = {key: value for key, value in scene.items() if key != "plugins" and not key.endswith("_sha256")}
    stored["body"] = {key: value for key, value in stored["body"].items() if key != "shape_sha256"}
    if stored["body"].get("photometry", {}).get("model") not in reflectance.registry():
        stored["body"].pop("photometry", None)  # the model is a plug-in's; no plan depends on the photometry
    # `scene_identity` adds a key that is not valid in a scene
    stored["sky"] = {key: value for key, value in stored.get("sky", {}).items() if key != "catalogue"}
    if stored["camera"].get("lens"):
        # earlier versions also stored these two keys of a thin lens here; the keys had no effect on any plan
        unused = ("f_number", "transmission")
        stored["camera"] = {key: value for key, value in stored["camera"].items() if key not in unused}
    stored["dataset"] = {**stored["dataset"], "samples": attributes["blocks"][0]}
    return config.parse_scene(stored, source="the store's own scene")


def classes_that_need_sun(attributes: Mapping[str, Any]) -> list[str]:
    """Return the sorted names of a store's fault classes whose samples must face the Sun.

    The store lists such classes of plug-ins by name. For packaged classes, the registry decides.
    """
    plugins = attributes["scene"].get("plugins", {})
    classes = {name for plugin in plugins.values() for name in plugin.get("needs_sun", ())}
    for name, model in attributes["fault_models"].items():
        cls = registry().get(name, {}).get(model)
        if cls is not None and is_packaged(cls) and cls.needs_sun_with(attributes["scene"]["faults"].get(name, {})):
            classes.add(name)
    return sorted(classes)


def stored_plan(attributes: Mapping[str, Any], faults: Sequence[str]) -> tuple[Scene, plan.Plan]:
    """Return the scene of a store and its plan, from the root attributes and the fault axis of the store.

    In a store that was taken again, `plan_numbers` are the samples of this plan that it holds.
    """
    scene = stored_scene(attributes)
    need_sun, blocks = classes_that_need_sun(attributes), blocks_of_plan(attributes)
    if RETAKE not in attributes:
        return scene, plan.make_plan(scene, faults, blocks, need_sun=need_sun)
    views = earlier_views(attributes)
    return scene, plan.make_retaken_plan(scene, faults, views, blocks, need_sun=need_sun)


def earlier_views(attributes: Mapping[str, Any]) -> plan.EarlierViews:
    """Return the views of the store from which a store was taken again, from the root attributes of the latter."""
    retake = attributes[RETAKE]
    scene, table = stored_plan(retake["source"], retake["source"]["faults"])
    return plan.EarlierViews(scene=scene, plan=table, repeats=retake["repeats"])


def blocks_of_plan(attributes: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the numbers of samples that the plan of a store drew together."""
    if RETAKE not in attributes:
        return tuple(attributes["blocks"])
    retake = attributes[RETAKE]
    return tuple(size * retake["repeats"] for size in blocks_of_plan(retake["source"]))


def plan_numbers(attributes: Mapping[str, Any]) -> NDArray[np.int64]:
    """Return the number in the plan of each sample of a store, int64[sample].

    It is the sample's index, unless the store was taken again from one that was not complete.
    """
    if RETAKE not in attributes:
        return np.arange(sum(attributes["blocks"]), dtype=np.int64)
    retake = attributes[RETAKE]
    first = [np.arange(low, high + 1, dtype=np.int64) for low, high in retake["samples"]]
    repeats = retake["repeats"]
    return np.asarray((np.concatenate(first)[:, None] * repeats + np.arange(repeats)).ravel())


def planned(attributes: Mapping[str, Any], faults: Sequence[str]) -> Callable[[int, int], dict[str, Any]]:
    """Return a function that computes the planned scalars of a sample; `store.examine` calls this function.

    The function takes the index of a sample and the stored number of tries, which selects the view. The function
    returns the scalars that rendering cannot change. Its key `injected` holds the commanded faults, bool[fault].

    Parameters
    ----------
    attributes
        Root attributes of the store.
    faults
        The fault axis of the store.
    """
    scene, table = stored_plan(attributes, faults)
    numbers = plan_numbers(attributes)
    frames = () if scene.trajectory is None else scene.frames

    def expected(sample: int, tries: int) -> dict[str, Any]:
        index = int(numbers[sample])
        drawn = table.view(scene, index, tries - 1)
        # the plan does not set these angles if a trajectory places camera and Sun, or if the camera aims
        names = ("sun_azimuth_deg", "sun_elevation_deg", "roll_deg", "pitch_deg", "yaw_deg")
        angles = () if scene.is_flown or scene.is_aimed or IMAGES in attributes else names
        return {
            **{name: drawn[name] for name in angles},
            "stratum": int(table.stratum[index]),
            "site": int(table.site[index]),
            "split": plan.SPLITS[table.split[index]],
            "detector_individual": int(table.individual[index]),
            "proposal": proposal(scene, table, index, drawn),
            "injected": table.injected[index],
            **(dict(zip(("sequence", "frame"), place_in_sequence(frames, index), strict=True)) if frames else {}),
        }

    return expected


def missing_plugins(attributes: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each plug-in of a store that is not installed, or not with the same source."""
    sentences = []
    for name, stored in attributes.get("scene", {}).get("plugins", {}).items():
        plugin = loaded_plugin(name)
        sha256 = str(stored.get("sha256", "unknown"))
        if plugin is None or plugin.sha256 != sha256:
            state = "not loaded" if plugin is None else "loaded in another version"
            sentences.append(
                f"the scene uses the plug-in {name} (sha256 {sha256[:12]}"
                + "".join(f", {model}" for model in stored.get("models", ()))
                + f"), which is {state} here; the check does not need it"
            )
    return sentences


def verify(path: str | Path | store.Store, progress: Callable[[int], None] | None = None) -> store.Report:
    """Return what is wrong with a store, how its faults are counted, and its digest.

    Parameters
    ----------
    path
        Path of the store, or the open store.
    progress
        Called with the number of samples that were checked since its last call.

    Returns
    -------
    store.Report
        `problems` is empty if every sample is whole, labelled and as planned.

    Raises
    ------
    InputError
        If there is no store at `path`, or one of another format.
    """
    opened = store.open_store(path)
    attributes = opened.spec.attributes
    check_described(opened)
    with in_file(str(opened.path)):
        expected = planned(attributes, opened.spec.faults)
    return store.examine(
        opened,
        expected=expected,
        exact=is_exact(attributes),
        progress=progress,
    )


def content_hash(*parts: Any) -> str:
    """Return the SHA-256 (hex) over JSON-able parts and bytes in order; the keys of a dictionary are sorted."""
    digest = hashlib.sha256()
    for part in parts:
        data = part if isinstance(part, bytes) else json.dumps(part, sort_keys=True).encode()
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()
