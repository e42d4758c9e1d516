"""The plan: which sample sees what, and which faults it carries. A plain table, drawn before any rendering.

Stratified sampling after Gallon et al.: the first `n_straylight` samples face the Sun, the others are averted
(`sun_facing_nominal_fraction` adds Sun-facing samples without straylight after the first ones). Every number
is keyed by its sample, so a plan of more samples does not change those of a shorter one within a block, except
for the fault matrix, which is balanced over its whole block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import config, frames
from .config import SceneConfig, StratumTable
from .errors import InputError

STRATA = ("sun-facing", "sun-averted")
SPLITS = ("train", "val", "test")
SUN_FACING, SUN_AVERTED = 0, 1
STRAYLIGHT = "straylight"

VARIABLES = (
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "roll_deg",
    "pitch_deg",
    "yaw_deg",
    "x_m",
    "y_m",
    "height_m",
)
_MAX_ATTITUDE_TRIES = 1000


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """One row a sample. `variables` float64[n] by the names of VARIABLES, the proposals; `injected`
    bool[n, fault] in the order of `faults`; `stratum`, `site`, `split`, `architecture`, `readout_direction`,
    `individual` (device of the detector) integer[n]; `attitude_tries` int32[n], draws of the attitude until the Sun
    was out of view.
    """

    faults: tuple[str, ...]
    variables: dict[str, NDArray[np.float64]]
    injected: NDArray[np.bool_]
    stratum: NDArray[np.uint8]
    site: NDArray[np.int32]
    split: NDArray[np.uint8]
    architecture: NDArray[np.uint8]
    readout_direction: NDArray[np.uint8]
    individual: NDArray[np.int32]
    attitude_tries: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.stratum)

    def injects(self, fault: str) -> NDArray[np.bool_]:
        """bool[n]: samples commanded to carry the fault; all False where the scene does not have it."""
        if fault not in self.faults:
            return np.zeros(len(self), dtype=bool)
        column: NDArray[np.bool_] = self.injected[:, self.faults.index(fault)]
        return column


def make_plan(scene: SceneConfig, faults: Sequence[str], blocks: Sequence[int] | None = None) -> Plan:
    """Draw the plan of all blocks (default: one of `dataset.samples`), each with its own fault matrix.

    Raises InputError where the fractions leave no room (`sun_facing_nominal_fraction`).
    """
    sizes = [scene.dataset.samples] if blocks is None else list(blocks)
    seed = scene.dataset.seed
    starts = np.concatenate([[0], np.cumsum(sizes)])
    parts = [_block(scene, tuple(faults), b, int(starts[b]), n) for b, n in enumerate(sizes)]
    injected = np.concatenate([p[0] for p in parts])
    stratum = np.concatenate([p[1] for p in parts])
    samples = np.arange(len(stratum))
    variables = propose(scene, samples, stratum)
    tries = _keep_sun_out_of_view(scene, samples, stratum, variables)
    site = _sites(scene, samples)
    split = site_split(scene)[site]
    return Plan(
        faults=tuple(faults),
        variables=variables,
        injected=injected,
        stratum=stratum,
        site=site,
        split=split,
        architecture=_pick(seed, samples, "architecture", len(scene.camera.architectures)),
        readout_direction=_pick(seed, samples, "readout_direction", len(scene.camera.readout_directions)),
        individual=_individuals(scene, samples, split),
        attitude_tries=tries,
    )


def propose(
    scene: SceneConfig,
    samples: NDArray[np.int64],
    stratum: NDArray[np.uint8],
    names: Sequence[str] = VARIABLES,
    attempt: int = 0,
) -> dict[str, NDArray[np.float64]]:
    """Uniform draws within the bounds of each sample's stratum; `attempt` > 0 are the redraws."""
    seed = scene.dataset.seed
    drawn = {}
    for name in names:
        lo, hi = _bounds(scene, name)
        u = config.keyed_uniform(seed, samples, "plan", f"{name}/{attempt}")
        drawn[name] = lo[stratum] + u * (hi - lo)[stratum]
    return drawn


def least_sun_angle_deg(scene: SceneConfig) -> float:
    """Sun-averted boresights stay farther than this from the Sun: √2·FoV/2 as the paper's square frame has it,
    and the half diagonal of a frame that is higher than wide."""
    camera = scene.camera
    diagonal = np.hypot(1.0, camera.height_px / camera.width_px) * np.tan(np.radians(camera.fov_deg) / 2)
    return float(max(np.sqrt(2) * camera.fov_deg / 2, np.degrees(np.arctan(diagonal))))


def strata(scene: SceneConfig) -> tuple[StratumTable, StratumTable]:
    """The bounds of the Sun-facing and the Sun-averted stratum, defaults filled in."""
    facing, averted = scene.geometry.sun_facing, scene.geometry.sun_averted
    assert facing is not None
    assert averted is not None
    return facing, averted


def _bounds(scene: SceneConfig, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    tables = (scene.geometry, scene.geometry) if name in ("x_m", "y_m", "height_m") else strata(scene)
    lo, hi = zip(*(getattr(t, name) for t in tables), strict=True)
    return np.array(lo), np.array(hi)


def _block(
    scene: SceneConfig, faults: tuple[str, ...], block: int, start: int, n: int
) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    rng = config.rng(scene.dataset.seed, start, "plan", f"fault_matrix/{block}")
    make = fault_matrix_per_class if scene.plan.mode == "per_class" else fault_matrix_per_sample
    lo, hi = scene.plan.classes_per_sample
    injected = make(n, faults, scene.plan.faulty_fraction, rng, (lo, hi))
    straylight = int(injected[:, faults.index(STRAYLIGHT)].sum()) if STRAYLIGHT in faults else 0
    nominal = round(scene.plan.sun_facing_nominal_fraction * n)
    if straylight + nominal > n:
        raise InputError(
            f"plan.sun_facing_nominal_fraction = {scene.plan.sun_facing_nominal_fraction:g}: with {straylight} of "
            f"{n} samples in straylight it must be at most {(n - straylight) / n:g}"
        )
    stratum = np.full(n, SUN_AVERTED, dtype=np.uint8)
    stratum[: straylight + nominal] = SUN_FACING
    return injected, stratum


def fault_matrix_per_class(
    n: int, faults: tuple[str, ...], p: float, rng: np.random.Generator, sizes: tuple[int, int] = (1, 6)
) -> NDArray[np.bool_]:
    """bool[n, fault]: every class in exactly round(p·n) samples, straylight in the first of them."""
    count = round(p * n)
    matrix = np.zeros((n, len(faults)), dtype=bool)
    for f, name in enumerate(faults):
        rows = np.arange(count) if name == STRAYLIGHT else rng.permutation(n)[:count]
        matrix[rows, f] = True
    return matrix


def fault_matrix_per_sample(
    n: int, faults: tuple[str, ...], p: float, rng: np.random.Generator, sizes: tuple[int, int] = (1, 6)
) -> NDArray[np.bool_]:
    """bool[n, fault]: exactly round(p·n) faulty samples, each with a non-empty subset of the classes.

    Subset sizes are uniform in `sizes` (at most the number of classes). Classes are dealt from shuffled decks
    that hold each class once, so their counts differ by at most one. Rows with straylight come first.
    """
    classes = len(faults)
    matrix = np.zeros((n, classes), dtype=bool)
    faulty = round(p * n)
    if classes == 0 or faulty == 0:
        return matrix
    lo, hi = (min(s, classes) for s in sizes)
    rows = np.zeros((faulty, classes), dtype=bool)
    deck = np.empty(0, dtype=int)
    for row, size in zip(rows, rng.integers(lo, hi, faulty, endpoint=True), strict=True):
        row[deck[:size]] = True
        short = size - len(deck)
        if short > 0:  # a new deck: cards the row already holds go to the back of it
            new = rng.permutation(classes)
            new = np.concatenate([new[~row[new]], rng.permutation(new[row[new]])])
            row[new[:short]] = True
            deck = rng.permutation(new[short:])
        else:
            deck = deck[size:]
    first = rows[:, faults.index(STRAYLIGHT)] if STRAYLIGHT in faults else np.zeros(faulty, dtype=bool)
    with_straylight = int(first.sum())
    matrix[:with_straylight] = rng.permutation(rows[first])
    places = with_straylight + rng.permutation(n - with_straylight)[: faulty - with_straylight]
    matrix[places] = rows[~first]
    return matrix


def _keep_sun_out_of_view(
    scene: SceneConfig,
    samples: NDArray[np.int64],
    stratum: NDArray[np.uint8],
    variables: dict[str, NDArray[np.float64]],
) -> NDArray[np.int32]:
    # The literal bounds leave 8 % of the Sun-averted draws looking at the Sun: roll and pitch both near half a
    # turn. Where the angles count from the Sun, it is a matter of roll and pitch alone and is settled here.
    tries = np.ones(len(samples), dtype=np.int32)
    if strata(scene)[SUN_AVERTED].reference != "sun":
        return tries
    names = ("roll_deg", "pitch_deg")
    least = least_sun_angle_deg(scene)
    for attempt in range(1, _MAX_ATTITUDE_TRIES):
        angle = frames.boresight_angle_deg(variables["roll_deg"], variables["pitch_deg"])
        again = np.flatnonzero((stratum == SUN_AVERTED) & (angle < least))
        if not len(again):
            return tries
        for name, value in propose(scene, samples[again], stratum[again], names, attempt).items():
            variables[name][again] = value
        tries[again] += 1
    raise InputError(
        f"geometry.sun_averted: its roll_deg and pitch_deg keep the Sun within {least:.1f} deg of the boresight; "
        "widen them"
    )


def _sites(scene: SceneConfig, samples: NDArray[np.int64]) -> NDArray[np.int32]:
    # All samples of a shard share a site, so that a task loads one patch; sites come in shuffled rounds.
    shard = samples // scene.dataset.shard_samples
    turn, place = np.divmod(shard, scene.dataset.sites)
    site = np.empty(len(samples), dtype=np.int32)
    for t in np.unique(turn):
        order = config.rng(scene.dataset.seed, int(t), "plan", "sites").permutation(scene.dataset.sites)
        site[turn == t] = order[place[turn == t]]
    return site


def site_split(scene: SceneConfig) -> NDArray[np.uint8]:
    """Split of every site, uint8[sites]: whole sites only, so that no terrain is in two splits."""
    return _shares(scene, scene.dataset.sites, "split")


def individual_split(scene: SceneConfig) -> NDArray[np.uint8] | None:
    """Split of every device of the detector, uint8[individuals]: no device is in two splits, and each split that
    has sites has one; None where there are too few for that, and all splits share them."""
    used = np.unique(site_split(scene))
    count = scene.camera.individuals
    if count < len(used):
        return None
    out = _shares(scene, count, "individual split")
    for missing in used[~np.isin(used, out)]:
        # from a split without sites, else from the one that has most
        idle = np.flatnonzero(~np.isin(out, used))
        donors = idle if len(idle) else np.flatnonzero(out == np.bincount(out).argmax())
        out[donors[-1]] = missing
    return out


def _shares(scene: SceneConfig, count: int, name: str) -> NDArray[np.uint8]:
    """Splits of `count` things by the scene's fractions, shuffled."""
    split = scene.dataset.split
    edges = np.rint(np.cumsum([split.train, split.val]) * count).astype(int)
    order = config.rng(scene.dataset.seed, 0, "plan", name).permutation(count)
    out = np.empty(count, dtype=np.uint8)
    out[order] = np.searchsorted(edges, np.arange(count), side="right")
    return out


def _individuals(scene: SceneConfig, samples: NDArray[np.int64], split: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Which device takes each sample, of those of its split."""
    of_split = individual_split(scene)
    u = config.keyed_uniform(scene.dataset.seed, samples, "plan", "individual")
    if of_split is None:
        return (u * scene.camera.individuals).astype(np.int32)
    out = np.zeros(len(samples), dtype=np.int32)
    for s in np.unique(split):
        devices = np.flatnonzero(of_split == s)
        here = split == s
        out[here] = devices[(u[here] * len(devices)).astype(np.intp)]
    return out


def _pick(seed: int, samples: NDArray[np.int64], name: str, options: int) -> NDArray[np.uint8]:
    return (config.keyed_uniform(seed, samples, "plan", name) * options).astype(np.uint8)
