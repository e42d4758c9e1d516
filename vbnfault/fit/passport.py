"""Say how real a scene's images are for a camera: statistics, a two-sample test, and what may be concluded.

A passport compares frames with the images that a scene renders for their poses (`replay`). Some frames are kept
back: settings are chosen on the others, and the kept-back ones are looked at once, at the end. For each statistic
of `frames` it gives the first Wasserstein distance between the values of the real frames and those of the rendered
ones, over the interquartile range of the real values: at 0.5 the rendered values lie half of the real spread away.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Any, Literal

import cv2
import numpy as np
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from scipy import stats

from .. import __version__
from ..core.errors import InputError, in_file, shown
from ..core.figures import inline_svg, panels, svg_text
from ..core.files.images import encoded
from ..core.files.whole_files import own, own_folder, write_json, write_whole
from ..core.html_page import image_url, number_text, write_page
from ..dataset.build import BuildOptions, do_tasks
from ..dataset.progress import Progress
from ..dataset.work import SingleItems, Tick, attempt
from ..scene.config import Scene, load_scene
from ..scene.trajectory import Trajectory, load_trajectory
from .frames import F32, read_frame
from .replay import Replay
from .two_samples import FEWEST_FRAMES, PLACES, kinds, two_sample_test

PAGE, FILE, PAIRS = "passport.html", "passport.json", "pairs"
Part = Literal["shown", "kept_back", "all"]
GOOD, TOLD = 0.5, 0.65  # of W1 / IQR, and of the classifiers: what may be concluded at or below

# name → what it is, unit, and what rests on it
STATISTICS: dict[str, tuple[str, str, str]] = {
    "sky": ("level of the sky", "of bright", "thresholds on the sky"),
    "glow_0.5": ("sky within 0.5 radii of the body", "of bright", "the glow around the body"),
    "glow_1": ("sky at 0.5 to 1 radii", "of bright", "the glow around the body"),
    "glow_2": ("sky at 1 to 2 radii", "of bright", "the glow around the body"),
    "glow_3": ("sky at 2 to 3 radii", "of bright", "the glow around the body"),
    "noise": ("noise of the sky", "of bright", "detection of faint points"),
    "noise_lit": ("noise of the smoothest lit ground", "of bright", "noise of features"),
    "column": ("pattern of columns", "of bright", "detection of lost lines"),
    "tracks": ("spots and streaks of 2 px or more", "a frame", "false stars and tracks"),
    "ee50": ("radius of half the light of stars", "px", "point spread and centroids of stars"),
    "ee80": ("radius of 80 % of the light of stars", "px", "point spread and centroids of stars"),
    "spikes": ("spikes on lit ground", "in 10,000 px", "false features"),
    "floor": ("fraction of the outline in the dark", "1", "shadows"),
    "stretch": ("median brightness of lit ground", "of bright", "photometry and exposure"),
    "limb_rise": ("rise across the bright limb, 10 to 90 %", "px", "limb detection"),
    "edge_rise": ("reciprocal of the steepest gradients", "px", "edges and corners"),
    **{
        f"power_{low}_{high}": (f"texture at {low} to {high} px", "variance", "features and matching")
        for low, high in ((2, 4), (4, 8), (8, 16), (16, 32), (32, 64))
    },
}
OF_PAIRS = {
    "iou": "overlap of lit silhouettes",
    "limb_px": "distance of the limbs in px",
    "rank": "rank correlation",
}
OF_PAIRS |= {"rank_smooth": "rank correlation, smoothed to the shape's plates"}
_RESAMPLES = 1000
_SHEET_PAIRS, _PAIR_PX = 12, 560
_SHOWN = "metering_level", "gain", "black_dn", "transmission"  # of what each frame set


@dataclass(frozen=True, kw_only=True)
class Statistic:
    """Compare a statistic of real and rendered frames: medians, and W1 over the real interquartile range."""

    name: str
    real_median: float
    rendered_median: float
    distance: float
    low: float
    high: float
    frames: int

    @classmethod
    def of(cls, name: str, real: NDArray[np.float64], rendered: NDArray[np.float64]) -> Statistic:
        """Return the comparison of two values of each frame; the interval of 95 % is a bootstrap over frames.

        Distance and interval are NaN where the middle half of the real values has no spread.
        """
        known = np.isfinite(real) & np.isfinite(rendered)
        real, rendered = real[known], rendered[known]
        count = len(real)
        if count < 2:
            return cls(
                name=name,
                real_median=math.nan,
                rendered_median=math.nan,
                distance=math.nan,
                low=math.nan,
                high=math.nan,
                frames=count,
            )
        distance = low = high = math.nan
        spread = float(np.subtract(*np.percentile(real, (75, 25))))
        if spread > 0:
            drawn = np.random.default_rng(count).integers(0, count, (_RESAMPLES, count))
            distance = _distance(real, rendered, spread)
            low, high = np.percentile([_distance(real[k], rendered[k], spread) for k in drawn], (2.5, 97.5))
        return cls(
            name=name,
            real_median=float(np.median(real)),
            rendered_median=float(np.median(rendered)),
            distance=distance,
            low=float(low),
            high=float(high),
            frames=count,
        )


def _distance(real: NDArray[np.float64], rendered: NDArray[np.float64], spread: float) -> float:
    return float(stats.wasserstein_distance(real, rendered)) / spread


@dataclass(frozen=True, kw_only=True)
class PassportOptions:
    """Say what a passport compares.

    Attributes
    ----------
    part
        "shown": frames that are not kept back, on which settings may be chosen; "kept_back"; or "all".
    kept_back
        Fraction of the frames that is kept back, by their names.
    gains, mendings
        As of `replay.Replay`.
    draws
        Of the classifiers' patches.
    workers, threads
        Number of processes that compare frames, and render threads of each; by default all cores.
    """

    part: Part = "shown"
    kept_back: float = 0.33
    gains: tuple[float, ...] = (1.0,)
    mendings: int = 1
    draws: int = 4
    workers: int = 1
    threads: int | None = None


def passport(
    frames: Path,
    scene: str,
    out: Path,
    options: PassportOptions = PassportOptions(),
    *,
    overrides: Mapping[str, Any] | None = None,
    poses: Path | None = None,
    advance: Callable[[int, int], Any] = lambda done, of: None,
) -> dict[str, Any]:
    """Compare the frames of a folder with a scene, and write `passport.json`, `passport.html` and all pairs.

    A frame that was compared before by the same scene, pose and frame is not rendered again.

    Parameters
    ----------
    frames
        Folder of NAME.png or NAME.tif.
    scene
        Packaged scene or path of a scene file, with a monochrome detector file.
    out
        Folder of the results.
    poses
        Table of poses, one row for each frame; default: `poses.csv` in the folder.
    advance
        Called with the number of finished steps and of all: each frame is one, and each draw of a classifier.

    Returns
    -------
    dict
        What `passport.json` holds.

    Raises
    ------
    InputError
        Wrong scene, table or frame.
    """
    table = load_trajectory(str((poses or frames / "poses.csv").resolve()))
    for row, name in enumerate(table.name, 1):
        if name == ".." or PureWindowsPath(name).name != name:  # it knows both kinds of slashes
            raise InputError(f"{table.source}: row {row}: name = {shown(name)}: must be a name without a folder")
    rows = _chosen(table.name, options)
    if not rows:
        raise InputError(f"{frames}: has no frame in the part {options.part}; of {len(table)} rows none is left")
    images = {row: read_frame(frames, table.name[row]) for row in rows}
    loaded = load_scene(scene, dict(overrides or {}))
    make = partial(_Comparison, frames, loaded, table, out, options)
    comparison = make()
    for row in rows:
        with in_file(str(frames / table.name[row])):
            comparison.replay.check(images[row])
    own_folder(out)
    own_folder(out / PAIRS)
    draws = len(PLACES) * options.draws if len(rows) >= FEWEST_FRAMES else 0
    steps = itertools.count()

    def step() -> None:
        advance(next(steps), len(rows) + draws)

    step()
    left = [row for row in rows if comparison.kept(row) is None]
    for _ in range(len(rows) - len(left)):
        step()
    grounds = [comparison.replay.session.ground_detail(row) for row in left]
    job = _Frames(out, _Steps(step), {row: grounds.index(one) for row, one in zip(left, grounds, strict=True)})
    do_tasks(make, job, BuildOptions(workers=options.workers, threads=options.threads), lambda: comparison)
    job.raise_failures(of=f" of {len(rows)}")
    found = {table.name[row]: comparison.kept(row) or {} for row in rows}
    figures, settings = ({name: one[part] for name, one in found.items()} for part in ("figures", "settings"))
    pairs = [(name, _written(out, name, "real"), _written(out, name, "rendered")) for name in figures]
    told, pictures = (
        two_sample_test([pair[1:] for pair in pairs], draws=options.draws, advance=step) if draws else ({}, {})
    )
    result = {
        "vbnfault": __version__,
        "scene": scene,
        "overrides": dict(overrides or {}),
        "part": options.part,
        "kept_back_fraction": options.kept_back,
        "frames": {name: {"figures": figures[name], "settings": settings[name]} for name in figures},
        "pairs": {name: _median([one[name] for one in figures.values()]) for name in OF_PAIRS},
        "statistics": [asdict(one) for one in statistics(list(figures.values()))],
        "classifiers": told,
        "kinds": kinds(),
    }
    result["conclusions"] = conclusions(result)
    write_json(own(out / FILE), result)
    _write_page(out, result, pairs, pictures)
    return result


class _Comparison:
    """Compare frames in one process, each by its row of the table."""

    def __init__(self, frames: Path, scene: Scene, table: Trajectory, out: Path, options: PassportOptions) -> None:
        self._frames, self._table, self._out, self._options = frames, table, out, options
        self.replay = Replay(scene, table, gains=options.gains, mendings=options.mendings, threads=options.threads)
        # the scene names its files, whose contents count
        files = self.replay.session.body.content_hash, self.replay.session.base_camera.detector.description
        self._resolved = json.dumps([self.replay.scene.resolved(), files], sort_keys=True, default=str)

    def do(self, task: int, tick: Tick) -> None:
        """Compare a frame, and write the pair."""
        if attempt(task, self._compared, tick):
            tick(task, "built", "")

    def _compared(self, row: int) -> bool:
        name, image = self._table.name[row], read_frame(self._frames, self._table.name[row])
        with in_file(str(self._frames / name)):
            pair = self.replay.pair(row, image)
        for which, one in (("real", pair.real), ("rendered", pair.rendered)):
            write_whole(own(self._out / PAIRS / f"{name}_{which}.png"), encoded(one.image.astype(np.uint8), ".png"))
        kept = {"identity": self._identity(row, image), "figures": pair.figures, "settings": pair.settings}
        write_json(own(self._out / PAIRS / f"{name}.json"), kept)
        return True

    def _identity(self, row: int, image: F32) -> str:
        """Return the sha256 (hex) of all that determines what becomes of a frame."""
        key = [
            self._resolved,
            *(repr(np.asarray(value).tolist()) for value in vars(self._table.pose(row)).values()),
            hashlib.sha256(image.tobytes()).hexdigest(),
            repr((self._options.gains, self._options.mendings)),
            __version__,
        ]
        return hashlib.sha256("\n".join(key).encode()).hexdigest()

    def kept(self, row: int) -> dict[str, Any] | None:
        """Return what an earlier run left of a frame; None if it was of something else, or if a part is no more."""
        name = self._table.name[row]
        try:
            found = json.loads((self._out / PAIRS / f"{name}.json").read_text(encoding="utf-8"))
            for which in ("real", "rendered"):
                _written(self._out, name, which)
        except (OSError, ValueError, InputError):
            return None
        identity = self._identity(row, read_frame(self._frames, name))
        if not isinstance(found, dict) or found.get("identity") != identity:
            return None
        if not all(isinstance(found.get(part), dict) for part in ("figures", "settings")):
            return None
        figures = {name: math.nan if value is None else value for name, value in found["figures"].items()}
        return {**found, "figures": figures}


class _Frames(SingleItems):
    """Hand out the frames of a passport, those of one terrain to one process."""

    noun, task_noun, item_noun = "passport", "frame", "frame"


class _Steps(Progress):
    """Pass each finished frame on to who shows the progress."""

    def __init__(self, step: Callable[[], None]) -> None:
        super().__init__(0, shown=False)
        self._step = step

    def advance(self, built: bool) -> None:
        """Count a frame."""
        self._step()


def statistics(figures: Sequence[Mapping[str, float]]) -> list[Statistic]:
    """Return the comparison of each statistic over the frames, from the figures of `frames.compare`."""
    return [
        Statistic.of(
            name, *(np.array([one[f"{name} {which}"] for one in figures]) for which in ("real", "rendered"))
        )
        for name in STATISTICS
    ]


def conclusions(result: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return sentences on what may be concluded from such images, what is undecided, and what may not."""
    may: list[str] = []
    not_: list[str] = []
    undecided: list[str] = []
    for one in result["statistics"]:
        what, _, rests = STATISTICS[one["name"]]
        if one["frames"] < FEWEST_FRAMES:
            not_.append(f"{what}: nothing, since too few frames show it")
        elif not math.isfinite(one["distance"]):
            not_.append(f"{what}: nothing, since the frames do not differ")
        elif one["high"] <= GOOD:
            may.append(f"{what}: rendered as in the frames, W1/IQR {one['distance']:.2g}; holds for {rests}")
        elif one["distance"] <= GOOD:
            undecided.append(
                f"{what}: too few frames to tell, W1/IQR {one['distance']:.2g}, up to {one['high']:.2g} within the "
                f"interval; would hold for {rests}"
            )
        else:
            not_.append(
                f"{what}: {number_text(one['rendered_median'])} in place of {number_text(one['real_median'])}, "
                f"W1/IQR {one['distance']:.2g}; nothing that rests on {rests}"
            )
    for place in PLACES:
        accuracies = [
            v[0] for name, v in result["classifiers"].get(place, {}).items() if name.endswith(", all features")
        ]
        if accuracies:
            (may if max(accuracies) <= TOLD else not_).append(
                f"patches of {place}: a classifier tells {100 * max(accuracies):.0f} % of them from real ones"
                + ("" if max(accuracies) <= TOLD else "; a network may learn what gives them away")
            )
    if result["part"] != "kept_back":
        not_.append("frames on which settings were chosen flatter the scene; judge by the part kept_back")
    return {"may": may, "undecided": undecided, "may_not": not_}


def _chosen(names: Sequence[str], options: PassportOptions) -> list[int]:
    """Return the rows of the part of the frames that is asked for; which are kept back follows from their names."""
    if not 0 <= options.kept_back < 1:
        raise InputError(f"kept_back = {shown(options.kept_back)}: must be from 0 to below 1")
    order = sorted(range(len(names)), key=lambda row: hashlib.sha256(names[row].encode()).digest())
    kept = set(order[: round(options.kept_back * len(names))])
    return [
        row for row in range(len(names)) if options.part == "all" or (row in kept) == (options.part == "kept_back")
    ]


def _written(out: Path, name: str, which: str) -> NDArray[np.uint8]:
    """Return an image of a pair as it was written."""
    return read_frame(out / PAIRS, f"{name}_{which}").astype(np.uint8)


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan


# --- page ---------------------------------------------------------------------------------------------------------


def _write_page(
    out: Path, result: Mapping[str, Any], pairs: Sequence[tuple[str, Any, Any]], pictures: Mapping[str, Any]
) -> None:
    """Write the page, with the distributions, the pairs and the patches that were told most surely."""
    figures = [one["figures"] for one in result["frames"].values()]
    drawing = svg_text(_distributions(figures))
    rows = [
        [
            STATISTICS[one["name"]][0],
            STATISTICS[one["name"]][1],
            number_text(one["real_median"]),
            number_text(one["rendered_median"]),
            number_text(one["distance"], 2),
            f"{number_text(one['low'], 2)} to {number_text(one['high'], 2)}",
            one["frames"],
        ]
        for one in result["statistics"]
    ]
    chosen = pairs[:: max(1, -(-len(pairs) // _SHEET_PAIRS))]
    write_page(
        own(out / PAGE),
        "fit/passport.html",
        result=result,
        distributions=inline_svg(drawing, "distributions", "distributions of the statistics"),
        rows=rows,
        of_pairs=[[text, number_text(result["pairs"][name])] for name, text in OF_PAIRS.items()],
        told=[
            [place, name, *(f"{100 * v:.1f}\u00a0%" for v in values)]
            for place, figures in result["classifiers"].items()
            for name, values in figures.items()
        ],
        settings=[
            [name, *(number_text(one["settings"].get(key, math.nan), 4) for key in _SHOWN)]
            for name, one in result["frames"].items()
        ],
        pairs=[(name, image_url(_side_by_side(real, rendered), 2 * _PAIR_PX)) for name, real, rendered in chosen],
        patches={place: image_url(np.asarray(image), 2000) for place, image in pictures.items()},
    )


def _side_by_side(real: NDArray[np.uint8], rendered: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a pair beside each other, with one stretch, cut to what the real frame shows."""
    high = max(float(np.percentile(real, 99.8)), 1.0)
    y, x = np.nonzero(cv2.medianBlur(real, 5) > 0.15 * high)
    if len(y):
        inner = slice(max(y.min() - 12, 0), y.max() + 13), slice(max(x.min() - 12, 0), x.max() + 13)
        real, rendered = real[inner], rendered[inner]
    both = np.hstack([real, np.full((len(real), 6), 128, np.uint8), rendered]).astype(np.float32)
    return np.asarray(np.clip(both * (255 / high), 0, 255), dtype=np.uint8)


def _distributions(figures: Sequence[Mapping[str, float]]) -> Any:
    """Return a figure with the cumulative distribution of each statistic, real and rendered."""
    across = 4
    kinds_of_line = {"real": ("#222222", "-"), "rendered": ("#c1272d", "--")}
    legend = [Line2D([], [], color=c, ls=style, label=which) for which, (c, style) in kinds_of_line.items()]
    with panels("", (-(-len(STATISTICS) // across), across), (130, 80), legend=legend) as (figure, axes):
        for one, (name, (text, unit, _)) in zip(axes, STATISTICS.items(), strict=False):
            for which, (colour, style) in kinds_of_line.items():
                values = np.sort([f[f"{name} {which}"] for f in figures])
                values = values[np.isfinite(values)]
                if len(values):
                    one.step(
                        values, (np.arange(len(values)) + 1) / len(values), color=colour, ls=style, where="post"
                    )
            one.set_title(text.replace(", ", ",\n"), fontsize=7)
            one.set_xlabel(unit, fontsize=7)
        for one in axes[len(STATISTICS) :]:
            one.set_axis_off()
    return figure
