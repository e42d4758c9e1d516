"""Bring the frames of a study to the metrics of navigation: a short sequence of views of one site, and the values.

A metric needs one view, two views or ten. The further views lie on a straight track from the first, with the same
attitude and Sun, so that they are rendered once and serve all faults, optics and detectors. A fault is a state of
the instrument, so it has the same draw in all views; the noise of each view is its own.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .. import navigation
from ..camera import Camera
from ..core.errors import VbnfaultError
from ..core.quantities import BODY, SKY, Truth
from ..pipeline.development import Development, informs
from ..pipeline.injection import draw_faults, fault_context
from ..pipeline.spec import Draw, Injection, Pose, Rendering, SampleSpec, SceneExposure, lasts
from ..scene import keyed_random
from .spec import Metric, returned

F64 = NDArray[np.float64]

VIEWS = 10
# Fraction of a view's surface pixels that the next view shows, too; images for mapping overlap by 80 to 90 %.
OVERLAP = 0.85
# Times that a step is halved where the ground is in the way.
_HALVINGS = 6
_BISECTIONS = 40
_GRID = 64  # points along each side of the frame that measure the overlap


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationFrame:
    """Hold one view of a sequence: the clean twin and the faulted image, and the truth.

    `clean` and `image` are uint8[y, x, 4]; `body` and `sky` are bool[y, x], the pixels that truly show them.
    """

    clean: NDArray[np.uint8]
    image: NDArray[np.uint8]
    view: navigation.CameraView
    body: NDArray[np.bool_]
    sky: NDArray[np.bool_]


# --- sequences of views ------------------------------------------------------------------------------------------


def views_needed(names: Iterable[str]) -> int:
    """Return how many views the named metrics need: 0 where no metric of navigation is named, else 1, 2 or 10."""
    return max((_NEEDS[name] for name in names if name in _NEEDS), default=0)


def sequence(spec: SampleSpec, pose: Pose, rendering: Rendering, count: int = VIEWS) -> list[Pose]:
    """Return `count` poses on a straight track of equal steps, the first of which is `pose`.

    Attitude and Sun stay the same, as of a spacecraft that points inertially. The track is level; it runs along
    that axis of the image which is more level, or against it, or across it. Each step leaves 85 % of the first
    view's surface pixels in the frame, or more: where a position of the track is in the ground, within
    `geometry.clearance_m` of it, or in its shadow, the next direction is tried, and then steps of half the length.

    Parameters
    ----------
    spec
        The sample.
    pose, rendering
        Its pose, and what was rendered there.
    count
        Number of views, at least 1.

    Raises
    ------
    VbnfaultError
        No track is free.
    """
    if count <= 1:
        return [pose]
    track = _directions(pose)
    lengths = [_step_m(spec.camera, pose, rendering.truth, direction) for direction in track]
    for halving in range(_HALVINGS + 1):
        for direction, length in zip(track, lengths, strict=True):
            steps = np.arange(1, count)[:, None] * (length / 2**halving) * direction
            positions = pose.position_L_m + steps
            visible = _sun_visible(spec, pose, positions)
            if _is_free(spec, positions) and (visible >= pose.sun_visible_fraction).all():
                return [
                    pose,
                    *(
                        replace(pose, position_L_m=position, sun_visible_fraction=float(sun))
                        for position, sun in zip(positions, visible, strict=True)
                    ),
                ]
    raise VbnfaultError(
        f"sample {spec.index}: no straight track of {count} views is free of the ground and of its shadow, for the "
        "metrics of navigation that need several views; leave the sample out, or raise the camera"
    )


def spec_of_view(spec: SampleSpec, view: int) -> SampleSpec:
    """Return the sample as it is in one view of its sequence, counted from 0.

    Its faults are drawn as in the first view, except those whose class says `per_exposure`. Noise and the jitter of
    rays are drawn anew.
    """
    if view == 0:
        return spec
    return _LaterView(view=view, **{f.name: getattr(spec, f.name) for f in fields(SampleSpec)})


@dataclass(frozen=True, kw_only=True, eq=False)
class _LaterView(SampleSpec):
    """Hold a sample in a later view of its sequence, with the random numbers of that view."""

    view: int

    def rng(self, stage: str, name: str) -> np.random.Generator:
        """Return the random generator of this view for (stage, name); that of the sample for lasting faults."""
        if lasts(self, stage, name):
            return super().rng(stage, name)
        return keyed_random.rng(self.seed, self.index, stage, f"{name}/view/{self.view}")


def continue_faults(
    spec: SampleSpec, pose: Pose, rendering: Rendering, exposure: SceneExposure, first: Injection
) -> Injection:
    """Return the faults of the first view in a later one.

    The faults have the same draws, as far as these do not depend on the view. All faults of the first view are
    kept, whether or not they show, except those that need a Sun which is hidden here.

    Parameters
    ----------
    spec, pose, rendering, exposure
        The later view; `spec` is that of `spec_of_view`.
    first
        Outcome of `inject_faults` in the first view.
    """
    development = Development(exposure=exposure, context=fault_context(pose, rendering, exposure), rng=spec.rng)
    names = [n for n in first.draws if pose.sun_visible_fraction > 0 or not spec.faults[n].needs_sun]
    draws: dict[str, Draw] = {}
    for name in sorted(names, key=lambda n: not informs(spec.faults[n])):
        draws = draw_faults(spec, development, [name], draws, first.draws[name].attempt)
    return Injection(draws={name: draws[name] for name in names}, development=development)


def navigation_frame(
    pose: Pose, truth: Truth, camera: Camera, clean: NDArray[np.uint8], image: NDArray[np.uint8]
) -> NavigationFrame:
    """Return a frame as the metrics need it.

    Parameters
    ----------
    pose, truth
        Pose and truth of the view.
    camera
        The nominal camera: the model that the navigator believes.
    clean, image
        uint8[y, x, 4]: the clean twin and the faulted image.
    """
    return NavigationFrame(
        clean=clean,
        image=image,
        view=_view(camera, pose, truth),
        body=truth.semantic == BODY,
        sky=truth.semantic == SKY,
    )


def _view(camera: Camera, pose: Pose, truth: Truth) -> navigation.CameraView:
    """Return the camera model and the true pose. The ground's frame is L."""
    calibration = camera.lens.calibration
    return navigation.CameraView(
        intrinsics=camera.intrinsics,
        distortion=camera.lens.distortion,
        model="opencv" if calibration is None else calibration.model,
        skew_px=0.0 if calibration is None else calibration.skew,
        valid_to_deg=camera.lens.distortion_valid_to_deg,
        camera_from_T=pose.L_from_C.T,
        camera_position_T_m=pose.position_L_m,
        depth_m=np.where(truth.semantic == BODY, truth.depth_m, np.inf),
    )


def _directions(pose: Pose) -> list[F64]:
    """Return level unit directions in L: along the more level image axis, against it, then across it."""
    level = pose.L_from_C[:, :2] * [[1.0], [1.0], [0.0]]
    length = np.linalg.norm(level, axis=0)
    k = int(np.argmax(length))
    along = level[:, k] / length[k]
    across = np.array([-along[1], along[0], 0.0])
    return [along, -along, across, -across]


def _step_m(camera: Camera, pose: Pose, truth: Truth, direction: F64) -> float:
    """Return the step in m along a direction in L that keeps the fraction OVERLAP of the surface pixels."""
    view = _view(camera, pose, truth)
    height, width = truth.semantic.shape
    x, y = np.meshgrid((np.arange(_GRID) + 0.5) * width / _GRID, (np.arange(_GRID) + 0.5) * height / _GRID)
    points = view.points_T_m(np.column_stack([x.ravel(), y.ravel()]))
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return 0.0

    def overlap(step: float) -> float:
        moved = replace(view, camera_position_T_m=pose.position_L_m + step * direction)
        xy = moved.project(points)
        with np.errstate(invalid="ignore"):
            return float(((xy >= 0) & (xy < (width, height))).all(axis=1).mean())

    low, high = 0.0, float(np.median(np.linalg.norm(points - pose.position_L_m, axis=1)))
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if overlap(middle) >= OVERLAP else (low, middle)
    return low


def _is_free(spec: SampleSpec, positions: F64) -> bool:
    """Return whether positions float64[n, 3] in L lie above the ground and clear of it."""
    from .. import render

    surface = spec.terrain.surface
    x, y, height = positions[:, 0], positions[:, 1], -positions[:, 2]
    above = max(300.0, 2 * float(np.abs(positions).max()))
    ground = render.ground_height_m(surface, x, y, above)
    if not (height >= ground).all():
        return False
    return bool(np.all(render.is_clear(surface, positions, spec.scene.geometry.clearance_m)))


def _sun_visible(spec: SampleSpec, pose: Pose, positions: F64) -> F64:
    """Return the visible fraction of the Sun's disc at positions float64[n, 3] in L, float64[n]."""
    from .. import render
    from ..world import ephemeris

    suns = [ephemeris.sunlight(spec.scene, pose.sun_L)] * len(positions)
    axes = np.repeat(pose.L_from_C[None], len(positions), axis=0)
    return np.asarray(render.sun_visible_fraction(spec.terrain.surface, positions, suns, axes))


# --- values ------------------------------------------------------------------------------------------------------


class ViewedImages:
    """Compute what the metrics need of the images of a sequence of views, each value once.

    Those of the clean twins serve all faults on them.
    """

    def __init__(self, images: Sequence[NDArray[np.uint8]], views: Sequence[navigation.CameraView]) -> None:
        self.images, self.views = images, views

    @cached_property
    def matches(self) -> navigation.Matches:
        """Return the matches of the first two."""
        return navigation.match(*self.images[:2])

    @cached_property
    def precision(self) -> float:
        """Return the fraction of these matches that are right."""
        return navigation.match_precision(self.matches, *self.views[:2])

    @cached_property
    def pose_error(self) -> navigation.RelativePoseError:
        """Return the errors of the relative pose from these matches."""
        return navigation.relative_pose_error(self.matches, *self.views[:2])

    @cached_property
    def lifetime_views(self) -> float:
        """Return the mean lifetime of a feature in views."""
        return navigation.feature_lifetime(self.images[:VIEWS], self.views[:VIEWS]).mean_views


def clean_twins(frames: Sequence[NavigationFrame]) -> ViewedImages:
    """Return the clean twins of a sequence of frames."""
    return ViewedImages([frame.clean for frame in frames], [frame.view for frame in frames])


@dataclass(frozen=True, eq=False)
class _Frames:
    """Hold the first frame of a sequence, and the faulted images and the clean twins of all."""

    first: NavigationFrame
    faulted: ViewedImages
    clean: ViewedImages


_LIMB = "Christian 2017, J. Spacecraft and Rockets 54, 708"
_CENTRE = "Owen 2011, AAS 11-215"
_REPEATABILITY = "Schmid, Mohr and Bauckhage 2000, IJCV 37, 151; Mikolajczyk and Schmid 2005, IEEE TPAMI 27, 1615"
_CORNERS = "Shi and Tomasi 1994, CVPR, 593; " + _REPEATABILITY
_ORB = "Rublee et al. 2011, ICCV, 2564; " + _REPEATABILITY
_PRECISION = "Mikolajczyk and Schmid 2005, IEEE TPAMI 27, 1615"
_FIVE_POINTS = "Nistér 2004, IEEE TPAMI 26, 756"
_TRACKS = "Lucas and Kanade 1981, IJCAI, 674; Shi and Tomasi 1994, CVPR, 593"

_NEEDS: dict[str, int] = {}
_COMPUTED: dict[str, Callable[[_Frames], float]] = {}
_METRICS: list[Metric] = []


def _metric(
    unit: str, source: str, *, better: Literal["low", "high"] = "low", views: int = 1
) -> Callable[[Callable[[_Frames], float]], Callable[[_Frames], float]]:
    """Return a decorator that adds a function to the metrics; its docstring describes the metric.

    `views`: how many views it needs.
    """

    def add(value: Callable[[_Frames], float]) -> Callable[[_Frames], float]:
        name = value.__name__
        _METRICS.append(Metric(name=name, unit=unit, description=returned(value), source=source, better=better))
        _NEEDS[name], _COMPUTED[name] = views, value
        return value

    return add


@_metric("px", _LIMB)
def limb_error_px(of: _Frames) -> float:
    """Return the error of the lit limb along its normals, RMS of the edges' positions, image minus clean twin."""
    first = of.first
    return navigation.limb_error(first.clean, first.image, first.body, sky=first.sky).rms_px


@_metric("px", _CENTRE)
def centroid_shift_px(of: _Frames) -> float:
    """Return the shift of the centre of brightness from the clean twin's."""
    return navigation.centroid_shift(of.first.clean, of.first.image).distance_px


@_metric("1", _CORNERS, better="high")
def corner_repeatability(of: _Frames) -> float:
    """Return the fraction of the clean twin's corners found again within 1.5 px."""
    return navigation.corner_repeatability(of.first.clean, of.first.image).fraction


@_metric("1", _ORB, better="high")
def orb_repeatability(of: _Frames) -> float:
    """Return the fraction of the clean twin's ORB features found again within 1.5 px of their level."""
    return navigation.orb_repeatability(of.first.clean, of.first.image).fraction


@_metric("1", _PRECISION, better="high", views=2)
def match_precision(of: _Frames) -> float:
    """Return the fraction of the ORB matches of two views within 3 px of the true reprojection."""
    return of.faulted.precision


@_metric("1", _PRECISION, views=2)
def matches_lost(of: _Frames) -> float:
    """Return the fraction of the right ORB matches of two clean twins that the faulted images lack."""
    return navigation.matches_lost(of.clean.matches, of.faulted.matches, *of.clean.views[:2])


@_metric("deg", _FIVE_POINTS, views=2)
def rotation_error_deg(of: _Frames) -> float:
    """Return the error of the rotation between two views, from their matches, faulted images minus clean twins."""
    return of.faulted.pose_error.rotation_deg - of.clean.pose_error.rotation_deg


@_metric("deg", _FIVE_POINTS, views=2)
def translation_error_deg(of: _Frames) -> float:
    """Return the error of the direction of translation between two views, faulted images minus clean twins."""
    return of.faulted.pose_error.translation_deg - of.clean.pose_error.translation_deg


@_metric("views", _TRACKS, better="high", views=VIEWS)
def feature_lifetime_views(of: _Frames) -> float:
    """Return the mean number of consecutive views, of ten, in which corners are tracked within 3 px of the
    truth.
    """
    return of.faulted.lifetime_views


@_metric("1", _PRECISION, views=2)
def match_precision_lost(of: _Frames) -> float:
    """Return the fraction of right ORB matches of two views, clean twins minus faulted images."""
    return of.clean.precision - of.faulted.precision


@_metric("views", _TRACKS, views=VIEWS)
def feature_lifetime_lost_views(of: _Frames) -> float:
    """Return the mean number of consecutive views, of ten, in which corners are tracked, clean twins minus
    faulted images.
    """
    return of.clean.lifetime_views - of.faulted.lifetime_views


METRICS = tuple(_METRICS)


def navigation_values(
    frames: Sequence[NavigationFrame], names: Collection[str], clean: ViewedImages | None = None
) -> dict[str, float]:
    """Return the named metrics of a sequence of views by name; nan where a metric has no value.

    Only what the names ask for is computed; names of other metrics are left out.

    Parameters
    ----------
    frames
        At least `views_needed(names)` views, in the order of `sequence`.
    names
        Names of metrics.
    clean
        Their clean twins, where several faults are compared on the same views.
    """
    if not views_needed(names):
        return {}
    faulted = ViewedImages([frame.image for frame in frames], [frame.view for frame in frames])
    computed = _Frames(frames[0], faulted, clean or clean_twins(frames))
    return {name: float(_COMPUTED[name](computed)) for name in names if name in _COMPUTED}
