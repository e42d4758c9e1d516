"""Run the stages that turn one planned sample into one labelled frame, in physical order.

    resolve ▶ render_view ▶ meter ▶ move ▶ add_stars ▶ inject_faults ▶ take_images ▶ label

Each stage is a function from frozen inputs to a frozen output. All twins share one expensive render, and so do the
samples of a view (`dataset.variants_per_view`). If a commanded fault cannot be visible in a view, the stages up to
`inject_faults` run again with the next view of the sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import ParamSpec, Protocol, TypeVar

from ..core.errors import VbnfaultError
from ..core.quantities import Radiance
from ..core.shared_results import SharedResults
from ..faults import FrameBefore
from .development import take_images
from .exposure import add_stars, meter
from .injection import asking_for_another_view, inject_faults
from .labels import label
from .motion import move
from .rendering import render_view
from .resolve import resolve
from .spec import Frame, Injection, Pose, Rendering, SampleSpec, SceneExposure

P = ParamSpec("P")
T = TypeVar("T")

_MOSTLY = 0.5  # fraction of an image that may be why a fault cannot be seen


class StageRunner(Protocol):
    """Call a stage with its inputs and return its output, for example to measure how long it takes."""

    def __call__(self, stage: Callable[P, T], /, *inputs: P.args, **options: P.kwargs) -> T: ...


def run_stage(stage: Callable[P, T], /, *inputs: P.args, **options: P.kwargs) -> T:
    """Call a stage with its inputs and return its output."""
    return stage(*inputs, **options)


@dataclass(frozen=True, kw_only=True, eq=False)
class _RenderedView:
    """Hold the outcomes of the stages that run for every view of a sample; `spec` has the terrain of the pose."""

    spec: SampleSpec
    pose: Pose
    rendering: Rendering
    starless: Radiance | None
    exposure: SceneExposure
    injection: Injection


class SharedViews:
    """Render views, and keep the last ones for the samples that share them.

    A view belongs to the first of its samples. So its pose and its render depend on no other sample, and not on the
    order in which the samples are made.

    `metered_s` holds what the metering of samples gave, by their numbers, for the later frames of their sequence.
    """

    def __init__(self, metered_s: dict[int, float] | None = None) -> None:
        self.metered_s = {} if metered_s is None else metered_s
        self._first_sample = -1
        self._kept: dict[int, tuple[Pose, Rendering]] = {}

    def take(self, spec: SampleSpec, run: StageRunner, first_try: int) -> tuple[Pose, Rendering]:
        """Return pose and render of a sample's view; `first_try` views of the plan were drawn before it."""
        shared = spec.of_view
        if shared.index != self._first_sample:
            self._kept.clear()
            self._first_sample = shared.index
        if first_try in self._kept:
            return self._kept[first_try]
        pose = run(resolve, shared, first_try)
        rendering = run(render_view, shared.at(pose), pose)
        if spec.plan.variants > 1:
            rendering.truth.frozen()
            rendering = replace(rendering, shared=SharedResults(kept=True))
            for older in [key for key in self._kept if key]:  # of the later views, the last one is enough
                del self._kept[older]
            self._kept[first_try] = pose, rendering
        return pose, rendering


def simulate_frame(spec: SampleSpec, run: StageRunner = run_stage, shared: SharedViews | None = None) -> Frame:
    """Run all stages of one sample and return its frame.

    If a commanded fault cannot be visible in a view, the sample's next view is used, up to `plan.max_views` views.

    Parameters
    ----------
    spec
        The sample.
    run
        Function that calls each stage.
    shared
        Views that other samples have rendered, and where new ones are kept. The result does not depend on them.

    Raises
    ------
    VbnfaultError
        Names the sample and the faults that no view shows.
    """
    views, shared = 1, shared or SharedViews()
    view = _take_view(spec, run, shared, views=1, first_try=0)
    while unseen := _unseen(spec, view.injection):
        if views == spec.scene.plan.max_views:
            raise VbnfaultError(
                f"sample {spec.index}: {', '.join(unseen)} cannot be seen in the last of plan.max_views = {views} "
                f"views that were rendered{_why_unseen(view)}; change the bounds of the fault or of [geometry], "
                f"raise max_views, or set plan.on_invisible = 'drop'"
            )
        views, first_try = views + 1, view.pose.tries
        del view  # release its memory before the next render
        view = _take_view(spec, run, shared, views=views, first_try=first_try)
    return _frame(view, views, run)


def simulate_stored_view(spec: SampleSpec, pose: Pose, rendering: Rendering, views: int) -> Frame:
    """Run the stages behind the render for one sample, whose view is given, and return its frame.

    A commanded fault that is not visible is left out, since there is no other view.

    Parameters
    ----------
    spec
        The sample, with the terrain of the pose.
    pose, rendering
        The outcomes of `resolve` and `render_view`.
    views
        Number of views that were rendered for the sample; each has its own draws of the faults.
    """
    return _frame(_expose(spec, run_stage, SharedViews(), pose, rendering, views), views, run_stage)


def _frame(view: _RenderedView, views: int, run: StageRunner) -> Frame:
    """Run the last stages of a sample, whose view is kept, and return its frame."""
    return Frame(
        **vars(view),
        views=views,
        images=run(take_images, view.spec, view.injection),
        labels=run(label, view.spec, view.injection),
    )


def _take_view(
    spec: SampleSpec, run: StageRunner, shared: SharedViews, *, views: int, first_try: int
) -> _RenderedView:
    """Run the stages of one view; `first_try` views of the plan were drawn before it."""
    pose, rendering = shared.take(spec, run, first_try)
    if not any(spec.faults[name].needs_sun for name in spec.commanded):
        pose = replace(pose, resolved=True)  # only another sample of the view needs the Sun
    return _expose(spec.at(pose), run, shared, pose, rendering, views, redrawn=True)


def _expose(
    spec: SampleSpec,
    run: StageRunner,
    shared: SharedViews,
    pose: Pose,
    rendering: Rendering,
    views: int,
    *,
    redrawn: bool = False,
) -> _RenderedView:
    """Run the stages from the exposure of a rendered view to its faults.

    `redrawn` says whether another view may take the place of this one.
    """
    exposure = run(meter, spec, rendering, _earlier_metering_s(spec, shared))
    if exposure.metered_s is not None and spec.scene.camera.metering_delay_frames:
        shared.metered_s[spec.index] = exposure.metered_s
    if rendering.scene.view.motion is not None:
        exposure = run(move, spec, rendering, exposure)
    starless = exposure.light.rendered if "scene_radiance" in spec.scene.dataset.layers else None
    exposure = run(add_stars, spec, pose, rendering, exposure)
    # a second copy of the light without stars takes 37 MB for 1024 pixels
    rendering = replace(rendering, light=exposure.light)
    before = cache(partial(_frame_before, spec.before, shared)) if spec.before and not spec.is_before else None
    injection = run(inject_faults, spec, pose, rendering, exposure, views, redrawn=redrawn, before=before)
    return _RenderedView(
        spec=spec, pose=pose, rendering=rendering, starless=starless, exposure=exposure, injection=injection
    )


def _earlier_metering_s(spec: SampleSpec, shared: SharedViews) -> float | None:
    """Return what the metering of the earlier frame gave that sets the exposure; None if the sample's own does.

    A frame that this process has not metered is rendered anew, so that no order of the samples matters.
    """
    if spec.metered_on is None:
        return None
    earlier = spec.metered_on()
    if earlier.index not in shared.metered_s:
        pose, rendering = SharedViews().take(earlier, run_stage, 0)
        metered_s = meter(earlier.at(pose), rendering).metered_s
        assert metered_s is not None
        shared.metered_s[earlier.index] = metered_s
    return shared.metered_s[earlier.index]


def _frame_before(spec_of: Callable[[], SampleSpec], shared: SharedViews) -> FrameBefore:
    """Return what the frame before left behind; it is made anew, so that no order of the samples matters."""
    spec = replace(spec_of(), is_before=True)
    injection = _take_view(spec, run_stage, SharedViews(shared.metered_s), views=1, first_try=0).injection
    return injection.development.left_behind(injection.draws)


def _why_unseen(view: _RenderedView) -> str:
    """Return a clause that says so if most of a view's image is white or black, and with which faults."""
    draws = view.injection.draws
    levels = view.injection.development.image(draws).array[..., :3]
    named = f" with {', '.join(draws)}" if draws else ""
    for level, word in ((255, "white"), (0, "black")):
        share = float((levels == level).all(axis=-1).mean())
        if share > _MOSTLY:
            return f", whose image is {word} in {100 * share:.0f} % of its pixels{named}"
    return ""


def _unseen(spec: SampleSpec, injection: Injection) -> list[str]:
    """Return the commanded faults that are not in the image, but that another view of the sample might show."""
    unseen = asking_for_another_view(spec, injection.in_vain)
    return unseen or asking_for_another_view(spec, [name for name in spec.commanded if name not in injection.draws])
