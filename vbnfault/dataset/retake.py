"""Take a dataset again: with other faults, another lens or another detector, on the radiance of an existing store.

Nothing is rendered. Everything that the radiance depends on must be as in the store; `_FREE` lists what may differ.
The root attribute `retake` of the new store says where its views come from, so that `verify` can plan it again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import pipeline, store
from ..core.errors import InputError
from ..core.files import file_contents
from ..core.process import llvm
from ..pipeline.rendering import ANGLE_LAYERS
from ..pipeline.retaken import TRUTH_LAYERS, RetakeSession, StoredView
from ..scene import config, plan
from ..scene.config import Scene
from ..scene.trajectory import with_rows
from ..store import Store, StoreSpec
from . import build
from .from_scene import CheckedSession, render_threads, with_card
from .identity import (
    RETAKE,
    blocks_of_plan,
    check_described,
    plan_numbers,
    planned,
    scene_identity,
    store_spec,
    stored_plan,
)
from .resume import Difference, differences
from .tasks import SampleMaker

# What may differ from the scene of the store: whole tables, or these keys of a table.
_FREE: dict[str, frozenset[str] | None] = {
    "title": None,
    "description": None,
    "faults": None,
    "event": None,
    "plugins": None,
    "plan": frozenset({"mode", "faulty_fraction", "classes_per_sample", "on_invisible", "max_views"}),
    "dataset": frozenset(
        {
            "seed",
            "samples",
            "shard_samples",
            "variants_per_view",
            "layers",
            "radiance_dtype",
            "mask_any",
            "licence",
            "citation",
        }
    ),
}
# Of the camera, these keys may not differ; all others may.
_FIXED_OF_CAMERA = frozenset({"calibration", "fov_deg", "width_px", "height_px", "focus_distance_m"})
# These may not differ either, where the camera of the store moved during its exposures.
_FIXED_IN_MOTION = frozenset(
    {"exposure_s", "exposure_min_s", "exposure_max_s", "exposure_max_towards_sun_s", "exposure_stops"}
    | {"metering_level", "metering_percentile", "metering_delay_frames", "readout_directions"}
)
# Keys of the camera on which the renderer's aperture depends.
_OPTICS = ("lens", "focus", "f_number", "pixel_pitch_um", "detector")
_SAME_FOCAL_LENGTH = 1e-6  # as a fraction: 1e-3 px at the border of 2048 px


def retake(
    path: str | os.PathLike[str] | store.Url | Store,
    scene: Scene | str | Path,
    out: str | os.PathLike[str] | store.Url,
    options: build.BuildOptions | None = None,
    *,
    source: str | None = None,
    **keywords: Any,
) -> build.Summary:
    """Take the samples of a store again with another scene's faults, lens or detector, without rendering them.

    The finished samples of the store are taken, `variants_per_view` new ones for each of its views. The scene may
    differ in faults, plan of faults, seed, layers and camera; its geometry, body, light, resolution and bands must
    be those of the store. The same call resumes and repairs.

    Parameters
    ----------
    path : str, os.PathLike or Store
        Store with the layer `scene_radiance`, or with `radiance` if its lens is a thin one and it has no stars.
    scene : Scene, str or Path
        A scene, the path of a scene file, or the name of a packaged scene. Its `dataset.samples` does not count.
    out : str or os.PathLike
        Path of the new store.
    options : BuildOptions, optional
        How the work is done: number of processes, cluster, progress.
    source : str, optional
        Name of the scene in messages; by default the path or name that `scene` is.
    **keywords
        Fields of `BuildOptions`, such as `workers=2`; they replace those of `options`.

    Returns
    -------
    Summary
        What was done, or, with `dry_run`, what would be.

    Raises
    ------
    InputError
        If the store has no radiance, or if the scene asks for a view that is not the store's.
    BuildFailed, Interrupted, VbnfaultError
        As for `build`.
    """
    options = build.BuildOptions.of(options, keywords)
    if not isinstance(scene, Scene):
        source, scene = source or str(scene), config.load_scene(scene)
    source, target = source or "scene", store.located(out)
    opened = store.open_store(path)
    if target.absolute() == opened.path.absolute():
        raise InputError(f"--out {target}: is the store itself; choose another path")
    if not options.dry_run:
        llvm.find()
    factory, build_plan = _work(opened, scene, source, target, options)
    return with_card(target, build.build(factory, build_plan, target, options))


def _work(
    opened: Store, scene: Scene, source: str, out: store.Location, options: build.BuildOptions
) -> tuple[RetakeFactory, build.BuildPlan]:
    """Return what makes the sessions of workers, and what they shall make."""
    contents = file_contents.Contents()
    with contents.in_use():
        build_plan = _planned(opened, scene, source, out, options)
    contents.complete()
    factory = RetakeFactory(
        scene=scene,
        path=opened.path.absolute(),
        attributes=build_plan.spec.attributes,
        faults=build_plan.spec.faults,
        threads=options.threads,
        contents=contents,
    )
    return factory, build_plan


def _planned(
    opened: Store, scene: Scene, source: str, out: store.Location, options: build.BuildOptions
) -> build.BuildPlan:
    """Return what a retake builds. Raises InputError if store and scene do not belong together."""
    _check_radiance(opened)
    if scene.camera.metering_delay_frames:
        raise InputError(
            f"{source}: camera.metering_delay_frames = {scene.camera.metering_delay_frames}: a retake meters each "
            "frame itself; must be 0"
        )
    repeats = _repeats(opened, scene, source)
    of_source = _of_source(opened)
    attributes: dict[str, Any] = {RETAKE: {"repeats": repeats, "source": of_source}}
    blocks = blocks_of_plan(attributes)
    session = pipeline.Session(scene, blocks=blocks, source=source)
    _check_same_view(opened, session, source)
    samples = _samples(opened, out, options)
    attributes[RETAKE] = {
        "samples": store.runs(plan_numbers(opened.attributes)[samples].tolist()),
        "repeats": repeats,
        "source": {**of_source, "checksums_sha256": _checksums(opened, samples)},
    }
    spec = store_spec(session, (len(samples) * repeats,))
    _check_grid(opened, session, source)
    numbers = plan_numbers(attributes)
    names = [spec.sample_names[k] for k in numbers] if spec.sample_names else ()
    spec = StoreSpec(
        **{
            **spec.plain(),
            "sample_names": tuple(names),
            "attributes": {**spec.attributes, **attributes},
        }
    )
    _, table = stored_plan(spec.attributes, spec.faults)
    if not options.dry_run:
        for sentence in plan.shortcomings(scene, table):
            logging.getLogger("vbnfault").warning(sentence)
    return build.BuildPlan(
        spec=spec,
        site=table.site[numbers],
        blocks=(len(numbers),),
        planned_faults=table.injected[numbers],
        expected=planned(spec.attributes, spec.faults),
    )


# --- what the new store says about the old one -----------------------------------------------------------------


def _of_source(opened: Store) -> dict[str, Any]:
    """Return what identifies a store and its plan."""
    keys = ("title", "scene", "scene_hash", "fault_models", "blocks", "versions", "versions_of_samples", RETAKE)
    known = {key: opened.attributes[key] for key in keys if key in opened.attributes}
    return {**known, "faults": list(opened.spec.faults)}


def _checksums(opened: Store, samples: NDArray[np.int64]) -> str:
    """Return a digest of the stored checksums of samples: other data has another digest."""
    total = hashlib.sha256()
    size = opened.spec.shard_samples
    for number in np.unique(samples // size).tolist():
        chosen = samples[samples // size == number] - number * size
        try:
            total.update(opened.column("crc32c", number)[chosen].tobytes())
        except (OSError, ValueError) as error:
            raise InputError(
                f"{opened.path}: the checksums of shard {number} cannot be read ({error}); the command that built "
                "the store repairs it"
            ) from error
    return total.hexdigest()


def _samples(opened: Store, out: store.Location, options: build.BuildOptions) -> NDArray[np.int64]:
    """Return the samples of the store that are taken: the finished ones, or those that the new store began with."""
    done = [i for number in opened.begun() for i, finished in opened.done(number).items() if finished]
    if not done:
        raise InputError(f"{opened.path}: {opened.why_none_is_finished()}; the command that built it resumes")
    samples = np.array(sorted(done), dtype=np.int64)
    if store.is_store(out) and not options.overwrite and RETAKE in (begun := store.open_store(out).attributes):
        ranges = begun[RETAKE]["samples"]
        wanted = np.concatenate([np.arange(first, last + 1) for first, last in ranges])
        samples = np.flatnonzero(np.isin(plan_numbers(opened.attributes), wanted))
    if len(samples) < opened.samples:
        logging.getLogger("vbnfault").warning(
            f"{opened.path}: {len(samples)} of {opened.samples} samples are taken, those that were finished"
        )
    return samples


# --- what is refused -------------------------------------------------------------------------------------------


def _radiance_layer(spec: StoreSpec, attributes: Mapping[str, Any]) -> str:
    """Return the layer of a store that holds the radiance before the lens, or ""."""
    if "scene_radiance" in spec.layers:
        return "scene_radiance"
    scene = attributes["scene"]
    stars = scene.get("sky", {}).get("stars", "off") != "off"
    through_a_lens = bool(scene["camera"].get("lens"))
    return "radiance" if "radiance" in spec.layers and not stars and not through_a_lens else ""


def _check_radiance(opened: Store) -> None:
    """Raise InputError unless a store holds the radiance before the lens and without stars."""
    check_described(opened)
    if _radiance_layer(opened.spec, opened.attributes):
        return
    has = "stores no radiance"
    if "radiance" in opened.spec.layers:
        lens = opened.attributes["scene"]["camera"].get("lens")
        has = f"its radiance is {'on the distorted grid of its lens' if lens else 'that with stars'}"
    listed = ", ".join(f'"{name}"' for name in (*opened.spec.layers, "scene_radiance") if name != "radiance")
    raise InputError(
        f"{opened.path}: {has}, so nothing can be taken again; build it with dataset.layers = [{listed}]"
    )


def _repeats(opened: Store, scene: Scene, source: str) -> int:
    """Return how many new samples each sample of the store gives. Raises InputError if that is no whole number."""
    variants = scene.dataset.variants_per_view
    stored = opened.attributes["scene"]["dataset"].get("variants_per_view", 1)
    if variants % stored:
        raise InputError(
            f"{source}: dataset.variants_per_view = {variants}: {opened.path} has {stored} samples of each view, "
            f"so it must be a multiple of {stored}"
        )
    return int(variants // stored)


def _check_same_view(opened: Store, session: pipeline.Session, source: str) -> None:
    """Raise InputError if a scene asks for another view, ground, light or render than the store has."""
    for difference in _differing(opened.attributes["scene"], scene_identity(session)):
        text = difference.text(f"in {opened.path}", "now")
        raise InputError(
            f"{source}: {text}: a retake keeps view, ground, light and render; only faults, lens, detector and "
            "exposure may differ"
        )


def _differing(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> Iterator[Difference]:
    """Yield the values in which a scene may not differ from that of the store, but does."""
    fixed = _FIXED_OF_CAMERA | (_FIXED_IN_MOTION if stored.get("motion") else frozenset())
    for table in sorted({*stored, *wanted}):
        free = _FREE.get(table, frozenset())
        if free is None or (table.endswith("_sha256") and table != "shape_sha256"):
            continue
        pair = [tables.get(table, {}) for tables in (stored, wanted)]
        if isinstance(pair[0], Mapping) and isinstance(pair[1], Mapping):
            keep = [
                {k: v for k, v in values.items() if (k in fixed if table == "camera" else k not in free)}
                for values in pair
            ]
            yield from differences(keep[0], keep[1], table)
        else:
            yield from differences(pair[0], pair[1], table)


def _check_grid(opened: Store, session: pipeline.Session, source: str) -> None:
    """Raise InputError if the camera needs a render of another scale, or a wider one, than the store has."""
    camera = session.base_camera
    number = opened.begun()[0]
    stored = float(np.sqrt(opened.column("intrinsics", number)[:, :2].prod(axis=1)).max())
    lens = f"camera.lens = {session.scene.camera.lens!r}"
    if abs(camera.focal_length_px / stored - 1) > _SAME_FOCAL_LENGTH:
        raise InputError(
            f"{source}: {lens}, camera.focus = {session.scene.camera.focus!r}: its focal length is "
            f"{camera.focal_length_px:.6g} px, but the radiance of {opened.path} has {stored:.6g} px"
        )
    spec = opened.spec
    rows, columns = spec.rendered_shape or (spec.height, spec.width)
    had = (columns - spec.width) // 2, (rows - spec.height) // 2
    needed = camera.lens.guard_px
    if needed[0] > had[0] or needed[1] > had[1]:
        raise InputError(
            f"{source}: {lens}: needs light from {max(needed)} px around the frame, and {opened.path} has "
            f"{min(had)} px; take a lens with as much distortion or less, or none, or build the store with "
            "this lens"
        )


# --- sessions of workers ---------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class RetakeFactory:
    """Make the session of a retake in a worker; the object is a function that can be pickled.

    `path` is the store with the radiance; `attributes` and `faults` are those of the new store; for `threads` and
    `contents` see `SessionFactory`.
    """

    scene: Scene
    path: store.Location
    attributes: Mapping[str, Any]
    faults: Sequence[str]
    threads: int | None = None
    contents: file_contents.Contents = dataclasses.field(default_factory=file_contents.Contents)

    def __call__(self) -> SampleMaker:
        with self.contents.in_use():
            session = RetakeSession(
                with_rows(self.scene),
                stored_plan(self.attributes, self.faults)[1],
                blocks_of_plan(self.attributes[RETAKE]["source"]),
                _StoredViews(store.open_store(self.path), self.attributes["scene"]["camera"]),
                threads=render_threads(self.threads),
            )
        return CheckedSession(session, self.contents, plan_numbers(self.attributes))


class _StoredViews:
    """Read the stored view of a sample of the earlier plan."""

    def __init__(self, opened: Store, camera: Mapping[str, Any]) -> None:
        self._store = opened
        self._layer = _radiance_layer(opened.spec, opened.attributes)
        self._truth = [name for name in (*TRUTH_LAYERS, *sorted(ANGLE_LAYERS)) if name in opened.spec.layers]
        self._sample = {int(number): k for k, number in enumerate(plan_numbers(opened.attributes))}
        before = opened.attributes["scene"]["camera"]
        self._same_optics = all(before.get(key) == camera.get(key) for key in _OPTICS)

    def __call__(self, number: int) -> StoredView:
        """Return the stored view of the sample with a number of the earlier plan."""
        sample = self._store.read_sample(self._sample[number], [self._layer, *self._truth])
        return StoredView(
            scalars=sample.scalars,
            radiance=sample.layers[self._layer],
            truth={name: sample.layers[name] for name in self._truth},
            same_optics=self._same_optics,
        )
