"""Render each row of a table of poses as the frame of that row was taken, and align the image with the frame.

Pose, exposure, gain and black of a real frame are never known well enough, so each image takes them from its frame:

- the attitude and the distance, where asked for: the similarity that correlates image and frame best moves the
  camera, and the image is rendered again; then the image moves by whole native pixels, which leaves its noise as it
  is;
- the exposure, metered so that the rendered body is as bright as the frame's in its median; an overexposed frame is
  metered on a percentile that is not yet white;
- where its columns are smeared: a transmission with which an exposure as bright smears as much, since a camera has
  more than one way to let in less light, and a shorter exposure smears more;
- the gain, of those that the camera has, whose noise in the sky is nearest to the frame's;
- the black: the difference of the median levels of the skies; where a part of the frame is clipped, what leaves as
  much of the image at 0.

All else is of the scene. Frames that are smaller than the camera's image by a whole factor are means of as many
stretched pixels. So are Rosetta's: between 6 and 7 of 255 levels the variance of their noise falls as that of
single pixels of few DN does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from ..body.geometry import mean_edge_m
from ..core.errors import InputError
from ..pipeline import Session
from ..scene.config import Scene
from ..scene.trajectory import FlownPose, Trajectory
from .frames import F32, Look, compare, look, shift_between, shifted, similarity_between

_SEARCH_PX = 16  # largest shift, for frames of 512 px
# A pixel of a halved frame also holds these fractions of the levels of its neighbours: the first of each above and
# below it, the second of each at its sides. Noise of neighbours in Rosetta's skies correlates by twice as much.
_LEAKS = 0.022, 0.026
# The exposure is metered on the first of these percentiles whose level is below the given one.
_WHITE, _PERCENTILES = 250, (50.0, 40.0, 30.0, 20.0, 10.0)
_MOST_BLACK = 1e-3  # of white: more is light. Of 32 frames of Rosetta's the black differs by 4e-4
# Where more of the sky than this is 0, the frame's black is brighter than a part of its sky. Lost lines are fewer.
_FEW_DARK = 0.25
# A frame that smears more than its image by the first factor had a shorter exposure; lost columns do not smear. The
# search stops at the second, a relative error; it changes the light by the third at most, and renders at most the
# fourth times.
_SMEARED, _SAME_SMEAR, _MOST_LIGHT, _MOST_TRIES = 2.0, 0.02, 20.0, 8
# A body is brighter than the darkest part by this many deviations of the noise. Medians of 25 pixels of noise alone
# span three; those of Rosetta's frames span 29 and more.
_LEAST_CONTRAST = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Hold a real frame, the image rendered for it and moved onto it, their figures, and what was set for it."""

    name: str
    real: Look
    rendered: Look
    figures: dict[str, float]
    settings: dict[str, Any]


def replay_scene(scene: Scene) -> Scene:
    """Return a scene that stores raw mosaics of one individual and gives every sample each of its faults.

    Raises InputError for a camera without a detector file.
    """
    if not scene.camera.detector:
        raise InputError("camera.detector: is missing; frames are compared with raw images of a sensor file")
    count = len(scene.faults)
    plan = {"mode": "per_sample", "faulty_fraction": float(count > 0), "on_invisible": "drop"}
    plan |= {"classes_per_sample": (count, count)} if count else {}
    dataset = {"layers": ("raw",), "mask_any": None}
    parts = {"plan": plan, "dataset": dataset, "camera": {"individuals": 1}}
    return scene.model_copy(
        update={name: getattr(scene, name).model_copy(update=values) for name, values in parts.items()}
    )


@dataclass(frozen=True, kw_only=True)
class Display:
    """Turn digital numbers into levels, as the frames show them: 255 times a power of the fraction of white.

    `step` is the distance of levels that a frame tells apart: 1 with 8 bits, 1/257 with 16.
    """

    bias_dn: float
    top_dn: float
    stretch: float
    step: float = 1.0

    def developed(self, raw: NDArray[Any], factor: int, black_dn: float = 0.0) -> F32:
        """Return a raw image stretched, then reduced by a whole factor, in levels of 0 to 255, float32[y, x].

        `black_dn` is how far the black of the frame lies below the bias. A pixel at the top code is white.
        """
        above = raw.astype(np.float32) - np.float32(self.bias_dn - black_dn)
        above[raw >= self.top_dn] = self.top_dn - self.bias_dn
        of_white = np.clip(above / np.float32(self.top_dn - self.bias_dn), 0, 1)
        levels = self._rounded(255 * of_white ** np.float32(self.stretch))
        return levels if factor == 1 else self._rounded(reduced(levels, factor))

    def _rounded(self, levels: F32) -> F32:
        """Return levels rounded to the steps that the frame tells apart."""
        step = np.float32(self.step)
        return np.asarray(step * np.floor(levels / step + np.float32(0.5)))

    def fraction(self, level: float) -> float:
        """Return the fraction of white that a level stands for."""
        return min((level / 255) ** (1 / self.stretch), 1.0)

    def black_excess_dn(self, real: Look, rendered: Look) -> float:
        """Return by how many DN the sky of a frame is brighter than that of an aligned image.

        Of a clipped frame it follows from the fraction of its pixels at 0. It is 0 where the frame has no sky, or
        one so much brighter that its light is no black.
        """
        sky, dark = real.sky & rendered.sky, real.image == 0
        if not sky.any():
            return 0.0
        if dark[sky].mean() > _FEW_DARK:
            level = float(np.quantile(rendered.image, dark.mean()))
            return -self.fraction(level) * (self.top_dn - self.bias_dn)
        # levels are whole numbers, so means first; tracks hardly move the median of these
        levels = [float(np.median(ndimage.uniform_filter(one.image, 9)[sky])) for one in (real, rendered)]
        excess = self.fraction(levels[0]) - self.fraction(levels[1])
        return excess * (self.top_dn - self.bias_dn) if abs(excess) < _MOST_BLACK else 0.0


class Replay:
    """Render the rows of a table for their frames.

    Parameters
    ----------
    scene
        See `replay_scene`.
    trajectory
        A table whose rows are the frames.
    gains
        Factors on the detector's gain that the camera has; the first is tried first.
    mendings
        How often each pose is mended by the similarity between image and frame.
    threads
        Of the renderer; default: every core.
    """

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        *,
        gains: Sequence[float] = (1.0,),
        mendings: int = 0,
        threads: int | None = None,
    ) -> None:
        self.session = Session(replay_scene(scene), threads=threads, poses=trajectory)
        self.scene, self.trajectory = self.session.scene, trajectory
        self.gains, self.mendings = tuple(gains), mendings
        sensor = self.session.base_camera.mosaic.sensor
        if len(sensor.pattern.channels) > 1:
            raise InputError(
                f"camera.detector = {scene.camera.detector!r}: must be monochrome to compare grey frames"
            )
        readout = sensor.readout
        self.display = Display(bias_dn=readout.bias_dn, top_dn=readout.top_dn, stretch=sensor.stretch)

    @cached_property
    def _plate_m(self) -> float:
        return mean_edge_m(self.session.body.vertices_m, self.session.body.faces)

    def pair(self, row: int, frame: F32) -> Pair:
        """Render a row, align the image with its frame, float32[y, x] from 0 to 255, and compare the two.

        Raises InputError for a frame whose size is no whole fraction of the camera's.
        """
        real, factor = look(frame), self.reduction(frame)
        self.display = replace(self.display, step=step_of(frame))
        trajectory, search_px = self.trajectory, max(4, round(_SEARCH_PX * frame.shape[1] / 512))
        percentile, brightness = metered_on(real)
        settings: dict[str, Any] = {
            "metering_level": self.display.fraction(brightness),
            "metering_percentile": percentile,
        }
        raw = self._raw(row, trajectory, settings | {"gain": self.gains[0]})
        for _ in range(self.mendings):
            before = look(self.display.developed(raw, factor))
            similarity = similarity_between(real, before, shift_between(real, before, search_px=search_px))
            pose = trajectory.pose(row)
            moved = mended_pose(pose, similarity, self.scene.camera.fov_deg, frame.shape)
            trajectory = with_pose(trajectory, row, *moved)
            raw = self._raw(row, trajectory, settings | {"gain": self.gains[0]})
        if real.smeared:
            raw = self._smeared(row, trajectory, real, raw, factor, settings)
        gain, raw = self._nearest_gain(row, trajectory, real, raw, factor, settings)
        before = look(self.display.developed(raw, factor))
        shift = shift_between(real, before, search_px=search_px)
        native = round(factor * shift[0]), round(factor * shift[1])
        rendered = look(self.display.developed(shifted(raw, native), factor))
        black = self.display.black_excess_dn(real, rendered)
        if black:
            rendered = look(self.display.developed(shifted(raw, native), factor, black))
        pose = trajectory.pose(row)
        settings |= {"gain": gain, "black_dn": black, "shift_px": (native[0] / factor, native[1] / factor)}
        settings |= {"camera_T_m": pose.camera_position_T_m.tolist()}
        sun_C = pose.T_from_C.T @ pose.sun_direction_T
        sun_xy = sun_C[:2] / max(float(np.linalg.norm(sun_C[:2])), 1e-9)
        pixel_m = (
            float(np.linalg.norm(pose.camera_position_T_m)) * 2 * np.tan(np.radians(self.scene.camera.fov_deg) / 2)
        )
        plate_px = self._plate_m / (pixel_m / frame.shape[1])
        figures = compare(real, rendered, sun_xy, plate_px, self.display.stretch)
        return Pair(name=trajectory.name[row], real=real, rendered=rendered, figures=figures, settings=settings)

    def _smeared(
        self, row: int, trajectory: Trajectory, real: Look, raw: NDArray[Any], factor: int, settings: dict[str, Any]
    ) -> NDArray[Any]:
        """Return a raw image whose columns smear as the frame's do, and set the `transmission` that makes them.

        A value above 1 stands for a wider stop. The `metering_level` is set anew, since smear adds to the body. The
        image is returned as it is where the frame hardly smears more, and where the lens has its own transmission.
        Body and sky are those of the frame: strong smear passes for a part of the body.
        """
        lens, stretch, display = self.session.base_camera.lens, self.display.stretch, self.display

        def seen(raw: NDArray[Any], black_dn: float = 0.0) -> Look:
            """Return the developed image with the body and the sky that the frame shows."""
            return replace(real, image=display.developed(raw, factor, black_dn))

        plain = seen(raw)
        wanted = smear(real, stretch) if lens.real is None else 0.0
        if wanted <= _SMEARED * smear(plain, stretch):
            return raw
        transmission, level = lens.transmission, settings["metering_level"]
        for _ in range(_MOST_TRIES):
            one = seen(raw, display.black_excess_dn(real, seen(raw)))
            bright = float(np.percentile(one.image[one.lit], settings["metering_percentile"]))
            # what the lens scatters into the sky goes with the light of columns, too, so the next one is nearer
            found, brighter = smear(one, stretch), level / display.fraction(bright)
            ratio = min(wanted / found, _MOST_LIGHT) if found > 0 else _MOST_LIGHT
            if max(abs(ratio - 1), abs(brighter - 1)) < _SAME_SMEAR:
                break
            settings["transmission"] = transmission = ratio * transmission
            settings["metering_level"] *= brighter
            raw = self._raw(row, trajectory, settings | {"gain": self.gains[0]})
        return raw

    def _nearest_gain(
        self, row: int, trajectory: Trajectory, real: Look, raw: NDArray[Any], factor: int, settings: dict[str, Any]
    ) -> tuple[float, NDArray[Any]]:
        """Return the gain with which the noise of the sky is nearest to the frame's, and its raw image.

        `raw` has the first of the gains. How noise grows with the gain depends on how much of it is of photons,
        whose noise grows least. Another gain is rendered where the frame's noise differs by more than half of that.
        """
        wanted, tried = noise_variance(real, self.display.stretch), {self.gains[0]: raw}

        def lacks(gain: float) -> float:
            """Return the logarithm of the factor that the variance lacks with a gain that was tried."""
            image = look(self.display.developed(tried[gain], factor))
            with np.errstate(divide="ignore", invalid="ignore"):  # a dark sky may have no noise
                return float(np.log(np.divide(wanted, noise_variance(image, self.display.stretch))))

        nearest = self.gains[0]
        for gain in () if real.clipped else self.gains[1:]:
            step = np.log(gain / nearest)
            if lacks(nearest) * step > 0.5 * step**2:
                tried[gain] = self._raw(row, trajectory, settings | {"gain": gain})
                nearest = min(tried, key=lambda gain: abs(lacks(gain)))
        return nearest, tried[nearest]

    def _raw(self, row: int, trajectory: Trajectory, settings: dict[str, Any]) -> NDArray[Any]:
        camera = self.scene.camera.model_copy(update=settings)
        self.session.scene = self.scene.model_copy(update={"camera": camera})
        self.session.trajectory = trajectory
        return self.session.simulate(row).layers["raw"]

    def check(self, frame: F32) -> None:
        """Raise InputError for a frame of another size or without a lit body."""
        self.reduction(frame)
        smooth = ndimage.median_filter(frame, 5)  # tracks and stars are no body
        faint = np.ptp(smooth) <= _LEAST_CONTRAST * np.std(frame - smooth)
        if faint or not look(frame).lit.any():
            raise InputError("the frame shows no lit body")

    def reduction(self, frame: F32) -> int:
        """Return by what the camera's image is larger than a frame. Raises InputError if by no whole factor."""
        width, height = self.scene.camera.width_px, self.scene.camera.height_px
        factor = width // frame.shape[1]
        if frame.shape != (height // max(factor, 1), width // max(factor, 1)) or factor * frame.shape[1] != width:
            raise InputError(
                f"the frame has {frame.shape[1]}x{frame.shape[0]} px, and the camera {width}x{height}: must be as "
                "many or a whole fraction of them"
            )
        return factor


def step_of(frame: F32) -> float:
    """Return the distance of the levels that a frame of 0 to 255 tells apart: 1 with 8 bits, 1/257 with 16."""
    return 1.0 if np.array_equal(frame, np.round(frame)) else 1 / 257


def smear(one: Look, stretch: float) -> float:
    """Return how much the mean light of a column's sky grows with the sum of light of the body in that column.

    It is the slope of a regression over the body's columns, at least 0, and 0 where the body leaves no sky in them.
    """
    light = one.image.astype(np.float64) ** (1 / stretch)
    body, sky = (np.where(mask, light, 0).sum(axis=0) for mask in (one.lit, one.sky))
    rows = one.sky.sum(axis=0)
    columns = one.lit.any(axis=0) & (rows > 0)
    if len(np.unique(body[columns])) < 2:
        return 0.0
    return max(float(np.polyfit(body[columns], sky[columns] / rows[columns], 1)[0]), 0.0)


def noise_variance(one: Look, stretch: float) -> float:
    """Return the variance of the temporal noise of light in the sky, whatever its black.

    It is taken along columns, whose pattern and smear are no noise.
    """
    calm = one.sky & (np.abs(one.image - ndimage.median_filter(one.image, 9)) < 4)
    calm[1:] &= calm[:-1]
    calm[0] = False
    light = one.image.astype(np.float64) ** (1 / stretch)
    return float(np.diff(light, axis=0, prepend=0)[calm].var() / 2) if calm.sum() > 1000 else float("nan")


def metered_on(real: Look) -> tuple[float, float]:
    """Return a percentile of the lit pixels of a real frame, and its brightness.

    It is the median; in an overexposed frame, the highest one that is below white.
    """
    for percentile in _PERCENTILES:
        brightness = float(np.percentile(real.image[real.lit], percentile))
        if brightness < _WHITE:
            break
    return percentile, brightness


def mended_pose(pose: FlownPose, similarity: NDArray[np.float64], fov_deg: float, size: tuple[int, ...]) -> Any:
    """Return the camera's position in m and the quaternion camera_from_T of a pose whose image a similarity moves.

    `size` is (height, width) of the image in px. A scale moves the camera along its line to the origin of T.
    """
    focal_px = 0.5 * size[1] / np.tan(np.radians(fov_deg) / 2)
    middle = 0.5 * np.array(size[::-1]) - 0.5
    off = similarity[:, :2] @ middle + similarity[:, 2] - middle
    scale = float(np.sqrt(np.linalg.det(similarity[:, :2])))
    turn = float(np.arctan2(similarity[1, 0], similarity[0, 0]))
    towards = np.array([off[0], off[1], focal_px]) / np.linalg.norm([*off, focal_px])
    # moves the boresight to where its image has moved; small angles, so that the axis is z x towards
    tilt = Rotation.from_rotvec(np.cross([0.0, 0.0, 1.0], towards))
    moved = tilt * Rotation.from_rotvec([0.0, 0.0, turn]) * Rotation.from_matrix(pose.T_from_C.T)
    return pose.camera_position_T_m / scale, moved.as_quat(scalar_first=True)


def with_pose(trajectory: Trajectory, row: int, position_T_m: Any, camera_from_T: Any) -> Trajectory:
    """Return a table with another position in m and quaternion camera_from_T in one row."""
    positions, turns = trajectory.camera_position_T_m.copy(), trajectory.camera_from_T.copy()
    positions[row], turns[row] = position_T_m, camera_from_T
    return replace(trajectory, camera_position_T_m=positions, camera_from_T=turns)


def reduced(image: F32, factor: int) -> F32:
    """Return the means of squares of pixels, with the light of neighbours that published frames show."""
    if factor == 1:
        return image
    for axis, leak in enumerate(_LEAKS):
        weights = [leak, *[(1 - 2 * leak) / factor] * factor, leak]
        size = image.shape[axis]
        padded = np.pad(image, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="symmetric")
        taken = [padded.take(np.arange(k, k + size, factor), axis=axis) for k in range(factor + 2)]
        image = np.sum([np.float32(weight) * part for weight, part in zip(weights, taken, strict=True)], axis=0)
    return np.asarray(image, dtype=np.float32)
