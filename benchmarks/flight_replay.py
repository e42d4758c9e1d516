"""Replay flight images: render a table of poses and compare each image with the real frame of its row.

    python benchmarks/flight_replay.py --frames FOLDER --shape SHAPE --out replay
    python benchmarks/flight_replay.py --frames FOLDER --out replay --rows 0,5,18 --set render.bounces=1
    python benchmarks/flight_replay.py --frames FOLDER --poses other.csv --scene my_scene.toml --out replay

FOLDER holds `poses.csv` (the columns of `[trajectory]`) and for each row an 8-bit image NAME.png. The camera is
that of the scene, by default `navcam67p` with its detector; of faults it has `SPOTS` alone. It renders `BINNING`
times the size of the frames, which are half native size, and the raw image is developed as they were
(`developed`): the square root of the digital numbers over the bias, halved, in 8 bits.
The labels of flight images are some pixels off, so every image is aligned first, by a shift of whole native
pixels, which leaves its noise as it is.

`--mend-poses 1` mends more than the shift: the similarity that correlates image and frame best gives the camera's
attitude and distance, and the image is rendered again. In 11 of the frames the labels are off by up to 0.6° of turn
about the line of sight, and the frames ask for a nucleus some 0.5 % larger than `67p_18k.obj`, or as much nearer:
its volume is 18.41 km³, published are 18.56 (Preusker et al. 2017, A&A 607, L1) and 18.8 (Jorda et al. 2016,
Icarus 277, 257). The figures then tell the errors of scene and shape from those of the table.

The stretch of the frames is not documented. That it is the square root of the 12 bits shows in their noise: it
falls from 0.92 at a sky of 2.5 to 0.52 at 14, by the same curve in all frames. Of 255 (DN/4095)^g the exponent 0.5
fits it best, and the sunlit body, compared with the rendered one percentile by percentile, asks for 0.52 to 0.58.
Where a frame is overexposed, it reaches 255. The frames were halved before they were rounded to 8 bits: the
variance of their sky falls evenly, from 0.69 at 4.5 to 0.31 at 11, where rounding first would give a trough at 6.5
and a peak at 9.5. Three frames in a row have 1.9 times the noise of the others at the same brightness: the camera
has two gains, and a frame is rendered with the one that its noise asks for. The exposure is metered so that the
rendered body is as bright as the frame's; an overexposed frame is metered on a part that is not yet white.
Brightness is compared as (image - background) / (bright - background): `background` is the median of the sky,
`bright` the 99th percentile of the body, all after the stretch. Printed are, over all frames, the median and the
worst 5 % of:

- `iou`: lit silhouettes, intersection over union. Lit is a brightness above 0.12.
- `limb_px`: median distance between the bright limbs, both ways.
- `rank`: Spearman's correlation of brightness where both are lit.
- `power_2_4` to `power_32_64`: rendered over real variance of brightness at wavelengths of that many pixels.
- `sky`, `glow_0.5` to `glow_3`: background level, and brightness of the sky at distances of so many nucleus radii,
  as fractions of `bright`; rendered and real. Frames whose sky is clipped to 0 are left out.
- `noise`, `column`: deviation of the sky from its local median, and of its columns' medians from a smooth curve, as
  fractions of `bright`.
- `tracks`: bright spots and streaks in the sky, of 2 px or more.

Of the spots in the sky of a real frame, 10 in the median, 2 of them of 2 px or more, stay where they are over at
least three frames: warm pixels. The others, 20 and 14 of 2 px or more, lie where hardly another frame has one.
Their number and sizes are those of tracks of protons in the exposure and the readout of 4.2 s, some of which are
long. Their charge spreads over three decades: at the 4.65 e/DN of the sensor a quarter fits protons that cross the
layer, the others are fainter, as of electrons from the housing that end there. The catalogue of stars has nine
brighter than magnitude 7 in such a field, of which about four show. `SPOTS` gives the rendered frames the same
tracks, and the grains of the coma at 3.6 au. Stars and warm pixels come from scene and sensor.

A shape file is sharpened as far as its own roughness asks for (`body.sharpen`). One of 67P is scaled to 18.7 km³,
and its ground has the relief of `GROUND`. Its dust has no contrast, since random dust lies elsewhere than on the
comet.

`rank` and the texture ask for different things. What the shape does not know, the renderer has to make up, and any
made-up texture lowers the correlation with the frame, also one with the right statistics: the frames' own texture
shorter than 2 pixels or so, turned by 180° and laid over images without random relief, raised the variance at 2 to
4 pixels from 0.29 to 1.15 of the real one and lowered `rank` from 0.804 to 0.757 (medians of 6 frames). `GROUND`
has a third of the real variance there; it is for figures that compare places. With `--texture`, the ground is
`TEXTURE`, for figures that compare statistics, as those of `flight_classifier.py`: facets of half a native pixel,
rougher at short wavelengths, with scarps, uneven, of planes that meet in edges, and with dust of another albedo.
What matters most is the size of the facets: relief shorter than two of them is not shown, so facets of a native
pixel blur what the camera resolves. Next come the edges, which rounded waves lack.

With `--texture`, an image is also taken a second time, with the black that the sky of its frame asks for: bias and
dark signal at a date are no more in the table than exposure and gain are. `sky` and `glow` then tell nothing of the
level. Without it the noise, which depends on the level after the stretch, tells skies apart, since biases and
temperatures that are drawn put the level up to 1.7 DN off. On the 33 frames:

| ground    | `rank` | variance at 2-4, 4-8, 8-16, 16-32, 32-64 px | body   | limb   | sky    |
|-----------|--------|---------------------------------------------|--------|--------|--------|
| `GROUND`  | 0.806  | 0.36, 0.51, 0.73, 0.92, 0.84 of the real    | 97.5 % | 95.2 % | 74.7 % |
| `TEXTURE` | 0.739  | 0.92, 0.88, 0.93, 1.06, 1.00 of the real    | 74.9 % | 74.0 % | 70.8 % |

The last three columns are the patches that the classifier tells, with `--splits 4` and for `TEXTURE` `--draws 8`;
50 % would be none. Single draws of the body have 72 to 78 %. One classifier for all places tells 72.0 %. Before
overexposed frames were metered below white, the body of `TEXTURE` had 75.2 %. Without scarps it had 75.3 %, and
76.5 % with `patch.scarps = 0.3`; with 0.5, it had 78.0 % in the first four of the eight draws, where `TEXTURE` had
74.6 %. The settings were chosen by the classifier on the same frames, so others may be told more often. What had
given the images away most were mottled plains and a core of the point spread that was too wide: real ground is
either smooth or rough, and boulders and shadows on it are sharp. Obliquely lit ground is still too rough in its
smoothest tenth, and real scarps throw thin dark lines where ours throw spots.

The sky of 31 frames is the sum of six parts, fitted by least squares to means over 8 px: the halo of the limb;
light scattered farther, 0.5 % of that of the body (0.4 to 0.8 % in four fifths of the frames; the wings of the
point spread); smear of both directions, 1.15e-6 of a column's light; dark signal that rises along the columns by
2.0 DN (1.5 to 3.0); a bias that differs by 0.8 DN between the first twenty and the last eleven; and a coma (`HAZE`,
unless the scene has one). Coma and wings are told apart by little else than the side of the Sun: without a coma the
wings hold 0.9 % of the light, and the fit is worse by a tenth. With the Afρ here an aperture of 10,000 km would see
some 6 times the light of the nucleus; until June 2014 the comet exceeded it only somewhat (Tubiana et al. 2015, A&A
573, A62). `--afrho-cm 0` leaves it out.

`replay.json` holds all figures, `sheet.png` the pairs real | rendered at full size, with the same stretch, and
`pairs` the aligned images, which `flight_classifier.py` tries to tell apart.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from flight_frames import (
    Look,
    compare,
    look,
    read_frame,
    reduced,
    shift_between,
    shifted,
    similarity_between,
    summary,
)
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault.body import load_body
from vbnfault.cli import options
from vbnfault.core.files import resources
from vbnfault.detector.sensor import load_sensor
from vbnfault.scene.trajectory import FlownPose, Trajectory, load_trajectory

_SEARCH_PX = 16  # largest shift, for frames of 512 px
BINNING = 2  # the frames have half the native size
# Weights of native pixels in each axis of the halving. Noise of neighbours in the sky of the frames correlates by
# 0.07, which asks for 0.035 at the ends; limb and ground are sharper and ask for less.
_HALVING = (0.0325, 0.4675, 0.4675, 0.0325)
_WHITE_DN = 4095  # of 12 bits
_STRETCH = 255 / _WHITE_DN**0.5  # of a root of DN
# Variance of the sky by its level s, both after stretch and halving: of the rounding, of photons, and dark / s²
_SKY_VARIANCE = (0.08, 0.16, 8.0)
_NOISY = 1.45  # times this variance: 28 frames have 0.88 to 1.17, three in a row 1.7 to 2.0
HIGH_GAIN = 1.4  # over the low one: what noise of 1.9 times the variance asks for; 1.7 in visnav
# A frame whose `bright` reaches this level is overexposed. It is metered on one of these percentiles.
_WHITE, _LOWER_PERCENTILES = 250, (95.0, 90.0, 80.0, 70.0, 60.0, 50.0, 40.0, 30.0, 20.0, 10.0)
_MOST_BLACK_DN = 4.0  # more is light: of 32 frames the black differs by 1.7 DN at most
AFRHO_CM = 50.0  # chosen beside halo and wings of the point spread for the sky of 31 frames
# What leaves spots and tracks in the sky. Protons: flux, energies, depth and `ending_fraction` fitted to the peaks,
# sums and sizes of the spots of 28 frames, diffusion to those of 11; in quiet time CREME96 has 4.67 at the
# Sun-Earth point L2. Grains: the density at 100 km in August 2014, see `vbnfault.faults.particles`.
SPOTS: dict[str, dict[str, Any]] = {
    "cosmic_rays": {
        "model": "tracks",
        "flux_per_cm2_s": 17.0,
        "energy_MeV": [60.0, 5000.0],
        "ending_fraction": 0.9,
        "thickness_um": 9.0,
        "diffusion_um": 4.0,
    },
    "particles": {"model": "coma_grains", "density_per_m3": 6e-4},
}
# Random relief lowers the rank correlation: this is about the least with the texture within a factor of 2.
GROUND: dict[str, Any] = {
    "body.sharpen": "auto",
    "patch.relief": 0.2,
    # dust lies where random fields put it, and not where it lies on the comet: its contrast would only disagree
    "body.photometry.dust_contrast": 0.0,
}
# Of 67P: the frames ask for 0.5 % more length than that of 67p_18k.obj, 18.41 km³; published: 18.56 and 18.8
_VOLUME_KM3, _SAME_BODY = 18.7, 0.05
# In place of `GROUND`: relief with nearly the variance of the frames at 2 to 8 px. Shading alone makes features too
# long across the Sun's direction; the contrast of dust, chosen for the classifier, makes others that are not.
# Boulders stand for all that is sharp and small: of 13 m or more there are some 14 times as many as Pajola et al.
# (2015, A&A 583, A37) counted. Smaller ones, less than a pixel of the frames, are left out.
TEXTURE: dict[str, Any] = {
    **GROUND,
    "body.photometry.dust_contrast": 0.22,
    "patch.relief": 0.36,
    "patch.hurst": 0.42,
    "patch.scarps": 0.15,
    "patch.intermittency": 1.0,
    "patch.angularity": 1.0,
    "patch.boulders_per_km2": 600.0,
    "patch.boulder_index": 2.3,
    "patch.min_boulder_m": 13.0,
    "patch.facet_px": 0.5,
    "patch.max_triangles": 8_000_000,
}
HAZE = {"reference_au": 3.6, "sunlit_fraction": 0.4, "distance_exponent": 0.0}


def aligned_pose(pose: FlownPose, similarity: NDArray[np.float64], fov_deg: float, size: tuple[int, int]) -> Any:
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


def developed(raw_dn: NDArray[Any], bias_dn: float) -> NDArray[np.uint8]:
    """Return a raw image as the frames show it: stretched by a root in 8 bits, then halved, uint8[y, x].

    A pixel at the largest digital number is white, as in an overexposed frame.
    """
    over_black = np.clip(np.asarray(raw_dn, dtype=np.float32) - np.float32(bias_dn), 0, None)
    shown = np.minimum(np.float32(_STRETCH) * np.sqrt(over_black), 255)
    shown[np.asarray(raw_dn) >= _WHITE_DN] = 255
    for axis in (0, 1):
        size = shown.shape[axis]
        shown = np.pad(shown, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="symmetric")
        taken = [shown.take(np.arange(k, k + size, BINNING), axis=axis) for k in range(len(_HALVING))]
        shown = sum(np.float32(weight) * part for weight, part in zip(_HALVING, taken, strict=True))
    return np.asarray(np.floor(shown + np.float32(0.5)), dtype=np.uint8)


# --- rendering ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Hold a real frame, the image rendered for it and moved onto it, and their figures."""

    name: str
    real: Look
    rendered: Look
    figures: dict[str, float]
    shift_xy: tuple[float, float]
    seconds: float


def replay_scene(
    name: str, size_px: tuple[int, int], overrides: Mapping[str, Any], ground: Mapping[str, Any] = GROUND
) -> vbnfault.Scene:
    """Return a scene whose only faults are `SPOTS`, for frames of (width, height) in px, that stores raw images.

    A shape file gets the keys of `ground`, and one of 67P the volume that the frames ask for.
    """
    values: dict[str, Any] = {"camera.width_px": BINNING * size_px[0], "camera.height_px": BINNING * size_px[1]}
    if "body.shape" in overrides:
        values |= ground
        volume_km3 = 1e-9 * load_body(overrides["body.shape"], unit=overrides.get("body.unit", "auto")).volume_m3
        if abs(volume_km3 / _VOLUME_KM3 - 1) < _SAME_BODY:
            values["body.volume_km3"] = _VOLUME_KM3
    scene = vbnfault.load_scene(name, {**values, "dataset.layers": ["raw"], **overrides})
    dataset = scene.dataset.model_copy(update={"layers": ("raw",), "mask_any": None})
    plan = scene.plan.model_copy(update={"mode": "per_sample", "faulty_fraction": 1.0, "on_invisible": "drop"})
    return scene.model_copy(update={"faults": dict(SPOTS), "plan": plan, "dataset": dataset})


def noise_excess(real: Look) -> float:
    """Return the noise variance of a real frame's sky over what `_SKY_VARIANCE` expects; NaN without sky."""
    calm = real.sky & (np.abs(real.image - ndimage.median_filter(real.image, 9)) < 4)
    calm[1:] &= calm[:-1]  # along columns, whose pattern and smear are no noise
    calm[0] = False
    if real.clipped or calm.sum() < 1000:
        return float("nan")
    variance = np.diff(real.image, axis=0, prepend=0)[calm].var() / 2
    rounding, photons, dark = _SKY_VARIANCE
    return float((variance - rounding) / (photons + dark / real.image[calm].mean() ** 2))


def write_high_gain(detector: str, folder: Path) -> Path:
    """Write the sensor file `detector` with a gain `HIGH_GAIN` times as high, and return its path."""
    path = resources.find("scenes/detectors", detector)
    gain = load_sensor(path).readout.system_gain_dn_per_e * HIGH_GAIN
    text = path.read_text(encoding="utf-8").replace("[readout]\n", f"[readout]\ngain_dn_per_e = {gain:.6g}\n")
    text = text.replace("[sources]\n", '[sources]\n"readout.gain_dn_per_e" = "benchmarks/flight_replay.py"\n')
    folder.mkdir(parents=True, exist_ok=True)
    high = folder / f"{path.stem}_high_gain.toml"
    high.write_text(text, encoding="utf-8")
    return high


def black_excess_dn(real: Look, rendered: Look) -> float:
    """Return by how many DN the sky of a real frame is brighter than that of an aligned rendered one.

    0 where the real sky is clipped, or so bright that its light is no black.
    """
    sky = real.sky & rendered.sky
    if real.clipped or not sky.any():
        return 0.0
    # the levels are whole numbers, so means first; tracks hardly move the median of these
    levels = [float(np.median(ndimage.uniform_filter(one.image, 9)[sky])) for one in (real, rendered)]
    excess_dn = (levels[0] ** 2 - levels[1] ** 2) / _STRETCH**2
    return excess_dn if abs(excess_dn) < _MOST_BLACK_DN else 0.0


def with_black(scene: vbnfault.Scene, excess_dn: float, folder: Path) -> vbnfault.Scene:
    """Return a scene whose black is higher by `excess_dn`; its sensor file is written into a folder."""
    path = resources.find("scenes/detectors", str(scene.camera.detector))
    offsets_dn = [offset_dn + excess_dn for offset_dn in load_sensor(path).readout.node_offsets_dn]
    lines = path.read_text(encoding="utf-8").splitlines()
    k = next(k for k, line in enumerate(lines) if line.startswith("node_offsets_dn = "))
    lines[k] = f"node_offsets_dn = [{', '.join(f'{offset_dn:.4f}' for offset_dn in offsets_dn)}]"
    folder.mkdir(parents=True, exist_ok=True)
    # a name of its own, since files that were read are kept
    black = folder / f"{path.stem}_{1000 * excess_dn:+.0f}_mdn.toml"
    black.write_text("\n".join(lines) + "\n", encoding="utf-8")
    camera = scene.camera.model_copy(update={"detector": str(black.resolve())})
    return scene.model_copy(update={"camera": camera})


def exposed_as(scene: vbnfault.Scene, real: Look, detectors: Sequence[str]) -> vbnfault.Scene:
    """Return a scene whose exposure is metered so that the body is as bright as in a real frame.

    Its sensor is the first of `detectors`, or the second, of a higher gain, where the frame's noise asks for it.
    """
    percentile, brightness = metered_on(real)
    metering = {"metering_level": min((brightness / 255) ** 2, 1.0), "metering_percentile": percentile}
    camera = scene.camera.model_copy(update={**metering, "detector": detectors[noise_excess(real) > _NOISY]})
    return scene.model_copy(update={"camera": camera})


def metered_on(real: Look) -> tuple[float, float]:
    """Return a percentile of the lit pixels of a real frame, and its brightness.

    It is the 99th, which is `bright`; in an overexposed frame, the highest one that is below white.
    """
    if real.bright < _WHITE:
        return 99.0, real.bright
    for percentile in _LOWER_PERCENTILES:
        brightness = float(np.percentile(real.image[real.lit], percentile))
        if brightness < _WHITE:
            break
    return percentile, brightness


def replay(
    session: vbnfault.Session,
    trajectory: Trajectory,
    row: int,
    frame: NDArray[np.uint8],
    detectors: Sequence[str],
    mendings: int = 0,
    black_in: Path | None = None,
) -> Pair:
    """Render a row with one of the sensor files, align it with its real frame by a shift, and compare the two.

    Before, the pose is mended `mendings` times by the similarity between the images. With a folder `black_in`, the
    image is taken again with the frame's own black, by a sensor file written there.
    """
    start = time.perf_counter()
    real = look(frame)
    session.scene = exposed_as(session.scene, real, detectors)
    bias_dn = float(session.base_camera.detector.description["bias_dn"])
    search_px = max(4, round(_SEARCH_PX * frame.shape[1] / 512))
    session.trajectory = trajectory
    for step in range(mendings + 1):
        raw_dn = session.simulate(row).layers["raw"]
        before = look(developed(raw_dn, bias_dn))
        shift = shift_between(real, before, search_px=search_px)
        if step < mendings:
            similarity = similarity_between(real, before, shift)
            trajectory = with_pose(
                trajectory,
                row,
                *aligned_pose(trajectory.pose(row), similarity, session.scene.camera.fov_deg, frame.shape),
            )
            session.trajectory = trajectory
    native = round(BINNING * shift[0]), round(BINNING * shift[1])
    rendered = look(developed(shifted(raw_dn, native), bias_dn))
    excess_dn = 0.0 if black_in is None else black_excess_dn(real, rendered)
    if black_in is not None and excess_dn:
        session.scene = with_black(session.scene, excess_dn, black_in)
        raw_dn = session.simulate(row).layers["raw"]
        rendered = look(developed(shifted(raw_dn, native), bias_dn))
    seconds = time.perf_counter() - start
    pose = trajectory.pose(row)
    sun_C = pose.T_from_C.T @ pose.sun_direction_T
    sun_xy = sun_C[:2] / max(float(np.linalg.norm(sun_C[:2])), 1e-9)
    return Pair(
        name=trajectory.name[row],
        real=real,
        rendered=rendered,
        figures=compare(real, rendered, sun_xy),
        shift_xy=(native[0] / BINNING, native[1] / BINNING),
        seconds=seconds,
    )


def with_pose(trajectory: Trajectory, row: int, position_T_m: Any, camera_from_T: Any) -> Trajectory:
    """Return a table with another position in m and quaternion camera_from_T in one row."""
    positions, turns = trajectory.camera_position_T_m.copy(), trajectory.camera_from_T.copy()
    positions[row], turns[row] = position_T_m, camera_from_T
    return replace(trajectory, camera_position_T_m=positions, camera_from_T=turns)


def sheet(pairs: Sequence[Pair], across: int = 3) -> NDArray[np.uint8]:
    """Return the pairs real | rendered at full size, uint8[y, x], with the same stretch and their names."""
    cells = []
    for pair in pairs:
        halves = [
            np.clip(0.85 * one.image / max(one.bright, 1e-6), 0, 1) * 255 for one in (pair.real, pair.rendered)
        ]
        cell = np.hstack(halves).astype(np.uint8)
        f = pair.figures
        text = f"{pair.name}  IoU {f['iou']:.3f}  rank {f['rank']:.2f}  limb {f['limb_px']:.1f} px"
        cv2.putText(cell, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255, 1, cv2.LINE_AA)
        cells.append(cv2.copyMakeBorder(cell, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(90,)))
    cells += [np.zeros_like(cells[0])] * (-len(cells) % across)
    rows = [np.hstack(cells[k : k + across]) for k in range(0, len(cells), across)]
    return np.asarray(np.vstack(rows), dtype=np.uint8)


def write_pair(folder: Path, pair: Pair) -> None:
    """Write NAME_real.png and NAME_rendered.png, aligned, in 8 bits."""
    folder.mkdir(parents=True, exist_ok=True)
    for which, one in (("real", pair.real), ("rendered", pair.rendered)):
        cv2.imwrite(str(folder / f"{pair.name}_{which}.png"), one.image.astype(np.uint8))


def table(figures: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the summary as lines of text."""
    lines = [f"{'figure':<16}{'median':>10}{'worst 5 %':>11}"]
    lines += [
        f"{name:<16}{median:>10.4g}{worst:>11.4g}"
        for name, (median, worst) in figures.items()
        if not name.endswith((" real", " rendered"))
    ]
    lines.append(f"{'of the sky':<16}{'real':>10}{'rendered':>11}")
    for name in figures:
        if name.endswith(" real"):
            plain = name.removesuffix(" real")
            lines.append(f"{plain:<16}{figures[name][0]:>10.4g}{figures[f'{plain} rendered'][0]:>11.4g}")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Replay the frames of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=Path, required=True, help="folder of NAME.png and poses.csv")
    parser.add_argument("--poses", type=Path, help="table of poses; default: poses.csv in the folder")
    parser.add_argument("--shape", help="shape model of the body; default: that of the scene")
    parser.add_argument("--scene", default="navcam67p", help="scene with camera and ground")
    parser.add_argument(
        "--texture", action="store_true", help="ground as rough as the real one, which lowers the rank correlation"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a key of the scene")
    parser.add_argument(
        "--afrho-cm", type=float, default=AFRHO_CM, help="of the haze; 0: none (default %(default)s)"
    )
    parser.add_argument("--rows", help="rows to replay, such as 0,5,18; default: all")
    parser.add_argument("--width", type=int, help="width in px; default: that of the frames")
    parser.add_argument(
        "--mend-poses", type=int, default=0, metavar="N", help="mend each pose N times by a similarity (default: 0)"
    )
    parser.add_argument("--threads", type=int, help="render threads; default: every core")
    parser.add_argument("--out", type=Path, required=True, help="folder for replay.json and sheet.png")
    given = parser.parse_args(arguments)

    trajectory = load_trajectory(str((given.poses or given.frames / "poses.csv").resolve()))
    rows = [int(k) for k in given.rows.split(",")] if given.rows else list(range(len(trajectory)))
    overrides = options.overrides(given.set)
    if given.shape:
        overrides["body.shape"] = given.shape
    frames = {row: read_frame(given.frames, trajectory.name[row]) for row in rows}
    if given.width:
        frames = {row: reduced(frame, given.width) for row, frame in frames.items()}
    height, width = frames[rows[0]].shape
    if given.afrho_cm and vbnfault.load_scene(given.scene).coma is None:
        overrides = {"coma": {**HAZE, "afrho_cm": given.afrho_cm}, **overrides}
    scene = replay_scene(given.scene, (width, height), overrides, TEXTURE if given.texture else GROUND)
    session = vbnfault.Session(scene, threads=given.threads, poses=trajectory)
    detectors = [scene.camera.detector, str(write_high_gain(scene.camera.detector, given.out).resolve())]
    black_in = given.out / "sensors" if given.texture else None
    pairs = []
    for row in rows:
        pair = replay(session, trajectory, row, frames[row], detectors, given.mend_poses, black_in)
        f = pair.figures
        print(
            f"{pair.name}: IoU {f['iou']:.4f}, rank {f['rank']:.3f}, limb {f['limb_px']:.2f} px, shift "
            f"{pair.shift_xy[0]:+.1f} {pair.shift_xy[1]:+.1f} px, {pair.seconds:.1f} s",
            file=sys.stderr,
            flush=True,
        )
        pairs.append(pair)
        write_pair(given.out / "pairs", pair)
    figures = summary([pair.figures for pair in pairs])
    result = {
        "summary": {name: list(pair) for name, pair in figures.items()},
        "frames": {pair.name: {**pair.figures, "shift_xy_px": pair.shift_xy} for pair in pairs},
    }
    (given.out / "replay.json").write_text(json.dumps(result, indent=1))
    cv2.imwrite(str(given.out / "sheet.png"), sheet(pairs))
    print("\n".join(table(figures)))


if __name__ == "__main__":
    main()
