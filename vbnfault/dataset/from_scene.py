"""Plan, build and describe the dataset of a scene."""

from __future__ import annotations

import dataclasses
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import pipeline, store
from ..core import tables
from ..core.errors import InputError, shown
from ..core.files import file_contents
from ..core.process import environment, llvm
from ..core.quantities import Sample
from ..scene import config, plan
from ..scene.config import Scene
from ..scene.events import commanded_in_time
from ..scene.trajectory import Trajectory, with_rows
from . import build, card, describe
from .identity import is_exact, planned, store_spec
from .resume import blocks_of, planned_blocks
from .tasks import SampleMaker


@dataclasses.dataclass(frozen=True)
class SessionFactory:
    """Make the session of a scene in a worker; the object is a function that can be pickled.

    `threads`: render threads of the worker; VBNFAULT_THREADS by default. `contents`: the input files as they were
    when the build was planned. `flown`: the trajectory of the scene's flights, which takes seconds to compute.
    """

    scene: Scene
    blocks: tuple[int, ...]
    threads: int | None = None
    contents: file_contents.Contents = dataclasses.field(default_factory=file_contents.Contents)
    flown: Trajectory | None = None

    def __call__(self) -> SampleMaker:
        with self.contents.in_use():
            session = pipeline.Session(self.scene, blocks=self.blocks, threads=render_threads(self.threads))
            if self.flown is not None:
                session.trajectory = self.flown
        return CheckedSession(session, self.contents)


def render_threads(threads: int | None) -> int | None:
    """Return the number of render threads of a worker; None for those of the renderer."""
    return threads or environment.whole_number("VBNFAULT_THREADS", environment.MOST_THREADS) or None


@dataclasses.dataclass(frozen=True)
class CheckedSession:
    """Make samples as a session does, but fail if an input file changed after the build was planned.

    `numbers`: the number in the session's plan of each sample of the store; by default its index.
    """

    session: SampleMaker
    contents: file_contents.Contents
    numbers: NDArray[np.int64] | None = None

    def simulate(self, index: int) -> Sample:
        """Return a sample. Raises InputChanged if an input file has changed."""
        number = index if self.numbers is None else int(self.numbers[index])
        with self.contents.in_use():
            return dataclasses.replace(self.session.simulate(number), index=index)


def estimated_seconds(session: pipeline.Session) -> float:
    """Return the approximate duration of building the whole dataset on this machine, in seconds.

    The model follows the README's table and assumes that all cores work. In processor time, a sample takes 0.3 s.
    Each megapixel adds 1.2 s for truth, images, labels and the store, and 0.25 s for each ray of a pixel, times
    1 + bounces. The terrain of a site, or of a view that aims, takes 16 s for 1.6 million triangles. Adaptive
    sampling counts as four times the minimum number of rays, but not more than the maximum.
    """
    scene = session.scene
    render, camera = scene.render, scene.camera
    rays = render.samples_per_pixel
    if render.noise_fraction is not None:
        rays = min(4 * rays, max(rays, render.max_samples_per_pixel))
    megapixels = camera.width_px * camera.height_px / 1e6
    variants = scene.dataset.variants_per_view
    sample_s = 0.3 + megapixels * (1.2 + 0.25 * rays * (1 + render.bounces) / variants)
    patch_s = 16 * scene.patch.max_triangles / 1.6e6
    terrains = len(session.plan) // variants if scene.is_aimed else len(np.unique(session.plan.site))
    return (len(session.plan) * sample_s + terrains * patch_s) / environment.usable_cores()


def build_scene(
    scene: Scene | str | Path,
    out: str | os.PathLike[str] | store.Url,
    options: build.BuildOptions | None = None,
    *,
    samples: int | None = None,
    append: int | None = None,
    source: str | None = None,
    **keywords: Any,
) -> build.Summary:
    """Build, resume, repair or extend the store of a scene, and write its card when it is complete.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, the path of a scene file, or the name of a packaged scene.
    out : str or Path
        Path or URL of the store.
    options : BuildOptions, optional
        How the build does its work: number of processes, cluster, progress.
    samples : int, optional
        Number of samples, 1 to 10 000 000, in place of the scene's. An append to an existing store takes it from
        the first block of the store.
    append : int, optional
        Number of samples to add to an existing store.
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
        If a value is outside its range, if the scene and the store at `out` do not belong together, or if no
        scheduler answers.
    BuildFailed
        If samples failed; all others are built.
    Interrupted
        After Ctrl-C, SIGTERM or SIGHUP; the same call resumes.
    VbnfaultError
        If the files cannot be written, the disk is too small, or the cluster fails.
    """
    options = build.BuildOptions.of(options, keywords)
    if not isinstance(scene, Scene):
        source, scene = source or str(scene), config.load_scene(scene)
    source, out = source or "scene", store.located(out)
    if not options.dry_run:
        llvm.find()  # raises VbnfaultError: without LLVM every sample would fail
    if append and samples is None and not options.overwrite and store.is_store(out):
        samples = blocks_of(store.open_store(out))[0]
    scene = with_rows(_with_samples(scene, samples))
    blocks = planned_blocks(out, scene.dataset.samples, append=append or 0, overwrite=options.overwrite)
    factory, build_plan, description = _prepared(scene, blocks, source, options)
    summary = with_card(out, build.build(factory, build_plan, out, options))
    return dataclasses.replace(summary, description=tuple(description))


def with_card(out: store.Location, summary: build.Summary) -> build.Summary:
    """Write the card of a complete store that was built or has none, and return the summary of its build."""
    if summary.counts is not None:
        opened = store.open_store(out)
        complete = summary.shard_range is None or opened.finished() == opened.samples
        if complete and (summary.built or not card.has_card(opened)):
            card.write_card(opened)
    return summary


def _prepared(
    scene: Scene, blocks: tuple[int, ...], source: str, options: build.BuildOptions
) -> tuple[SessionFactory, build.BuildPlan, list[str]]:
    """Return what makes the sessions of a build, what it builds, and the lines of a dry run. Warns of doubts."""
    contents = file_contents.Contents()
    with contents.in_use():
        session = pipeline.Session(scene, blocks=blocks, source=source)
        session.warn_of_doubts()
        spec = store_spec(session, blocks)
        description = _description(session, spec) if options.dry_run else []
    contents.complete()
    if not options.dry_run:
        for sentence in plan.shortcomings(scene, session.plan):
            logging.getLogger("vbnfault").warning(sentence)
    build_plan = build.BuildPlan(
        spec=spec,
        site=session.plan.site,
        blocks=blocks,
        planned_faults=_commanded(session),
        expected=planned(spec.attributes, spec.faults),
        exact=is_exact(spec.attributes),
        estimated_seconds=estimated_seconds(session),
    )
    flown = session.trajectory if scene.trajectory is not None and scene.trajectory.flight else None
    return SessionFactory(scene, blocks, options.threads, contents, flown), build_plan, description


def _commanded(session: pipeline.Session) -> NDArray[np.bool_]:
    """Return the commanded faults bool[sample, fault], those of events at the times at which they are there."""
    table, trajectory = session.plan, session.trajectory
    if trajectory is None or not session.scene.event:
        return table.injected
    time_s = trajectory.time_s[: len(table)].tolist()
    return commanded_in_time(session.scene, table.faults, table.injected, table.state, time_s)


def _description(session: pipeline.Session, spec: store.StoreSpec) -> list[str]:
    """Return lines that describe what a session's scene will photograph."""
    return describe.describe(session, sample_bytes=spec.estimated_sample_bytes, seconds=estimated_seconds(session))


def _with_samples(scene: Scene, samples: int | None) -> Scene:
    """Return the scene with another number of samples, if one is given. Raises InputError outside its range."""
    if samples is None:
        return scene
    number = tables.whole(samples)
    if number is None or not 1 <= number <= environment.MOST_SAMPLES:
        raise InputError(f"--samples {shown(samples)}: must be a whole number from 1 to {environment.MOST_SAMPLES}")
    return scene.model_copy(update={"dataset": scene.dataset.model_copy(update={"samples": number})})


def describe_scene(scene: Scene, *, source: str) -> list[str]:
    """Return lines that describe what a scene will photograph; nothing is rendered.

    `source`: name of the scene in messages.
    """
    session = pipeline.Session(scene, source=source)
    session.warn_of_doubts()
    return _description(session, store_spec(session, (session.scene.dataset.samples,)))
