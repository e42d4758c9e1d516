"""Compare images of a camera in motion with the mean of brute-force sub-frames, and give the time of each.

    python benchmarks/motion_blur.py [--size 128] [--sub-frames 256] [--repeats 6] [--cycles]

A camera 150 m above ground of 67P stands still, turns, flies sideways, or flies down. Its image is a part of a
frame of 512 px and 30°, a quarter of the frame from its middle, so that what flies down moves by as much in all of
it; with `--size 512` it is the frame. For each kind and length of motion, a line gives the error of the signal
over the noise of the sensor: its median with its sign, and its root mean square, of all lit pixels and of the best
99 % of them; then that of single pixels over frames with samples of their own: its median, its 99th percentile,
and the fraction below 0.3, also of the pixels that get new rays; the error of the sub-frames' mean; and the time
of the moved frame, from the render to its electrons, over that of a still one.

With --cycles, Blender renders the same frames of smooth, Lambertian ground with as many samples per pixel (see
`blender_cycles.py`), and a second line gives its time, and how far the two images differ.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from blender_cycles import Cycles, interpreter
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault import render
from vbnfault.pipeline import motion
from vbnfault.pipeline.exposure import meter
from vbnfault.pipeline.noise_budget import green_per_second
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import Pose, Rendering, SampleSpec, SceneExposure
from vbnfault.render.description import View
from vbnfault.scene.config import parse_scene
from vbnfault.scene.trajectory import FlownPose

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

HEIGHT_M, EXPOSURE_S = 150.0, 0.003
FRAME_PX, FRAME_DEG, OFF_AXIS_DEG = 512, 30.0, 7.5
SAMPLES = 256  # of a pixel in each sub-frame
UP_T = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])


def session_above_ground(size: int, render: dict[str, Any], count: int, **more: Any) -> vbnfault.Session:
    """Return a session of one view of a thin-lens camera near the vertical, with the Sun 50° from the zenith."""
    camera = {"width_px": size, "height_px": size, "fov_deg": field_deg(size), "exposure_s": EXPOSURE_S}
    table = {
        "title": "motion",
        "camera": {**camera, "detector": "cmv4000"},
        "sun": {"limb_darkening": True},
        "render": {"bounces": 0, **render},
        "motion": {},
        "dataset": {"samples": count, "shard_samples": count},
        **more,
    }
    scene = parse_scene(table, source="motion")
    vertices_m = vbnfault.Session(scene).body.vertices_m
    camera_m = vertices_m[np.argmax(vertices_m @ UP_T)] + HEIGHT_M * UP_T
    right, *_ = np.linalg.svd(UP_T[None])[2][1:]
    T_from_C = np.stack([right, np.cross(-UP_T, right), -UP_T], axis=1)
    if size < FRAME_PX:
        T_from_C = T_from_C @ Rotation.from_euler("y", OFF_AXIS_DEG, degrees=True).as_matrix()
    sun = UP_T + 1.2 * right
    values = [*camera_m, *Rotation.from_matrix(T_from_C.T).as_quat(scalar_first=True), *(sun / np.linalg.norm(sun))]
    names = (
        [f"camera_{a}_T_m" for a in "xyz"] + [f"camera_from_T_{a}" for a in "wxyz"] + [f"sun_{a}_T" for a in "xyz"]
    )
    row = {"julian_date": 2457000.0, "sun_distance_au": 2.0, **dict(zip(names, values, strict=True))}
    poses = {"name": [str(k) for k in range(count)], **{name: [value] * count for name, value in row.items()}}
    return vbnfault.Session(scene, poses=poses)


def field_deg(size: int) -> float:
    """Return the width of the field of so many pixels."""
    return float(2 * np.degrees(np.arctan(size / FRAME_PX * np.tan(np.radians(FRAME_DEG / 2)))))


def motions(flown: FlownPose, lengths_px: list[float]) -> Iterator[tuple[str, FlownPose]]:
    """Yield the kinds of motion that move the ground by these lengths during the exposure."""
    pixel_rad, away = np.radians(FRAME_DEG) / FRAME_PX, np.radians(OFF_AXIS_DEG)
    for px in lengths_px:
        rad_s = px * pixel_rad / EXPOSURE_S
        sideways = flown.T_from_C @ np.array([0.8, 0.6, 0.0]) * rad_s * HEIGHT_M
        kinds = {
            "turn": {"rate_C_rad_s": rad_s * np.array([0.36, -0.92, 0.15])},
            "sideways": {"velocity_T_m_s": sideways},
            "down": {"velocity_T_m_s": -UP_T * rad_s * HEIGHT_M / away},
        }
        for kind, values in kinds.items():
            yield f"{kind:8} {px:4g} px", replace(flown, **values)


def exposed(spec: SampleSpec, pose: Pose) -> tuple[Rendering, SceneExposure, float]:
    """Return the render of a sample, its exposure, and the seconds that both take once kernels are compiled."""
    for _ in range(2):  # the first compiles
        started = time.perf_counter()
        rendered = render_view(spec, pose)
        exposure = motion.move(spec, rendered, meter(spec, rendered))
        seconds = time.perf_counter() - started
    return rendered, exposure, seconds


def pose_at(view: View, time_s: float) -> tuple[F64, F64]:
    """Return position and axes of the camera at a time after the middle of the exposure."""
    if view.motion is None:
        return view.position_L_m, view.L_from_C
    turn = Rotation.from_rotvec(view.motion.rate_C_rad_s * time_s).as_matrix()
    return view.position_L_m + view.motion.velocity_L_m_s * time_s, view.L_from_C @ turn


def beside_cycles(session: vbnfault.Session, rendered: Rendering, got: F64, noise: F64, lit: Mask) -> str:
    """Return how long Blender takes for the same frame, and how far its image, scaled to ours, is from ours."""
    patch, view = session.patch(session.spec(0).terrain.site, session.ground_detail(0)), rendered.scene.view
    with Cycles(
        interpreter(),
        vertices_m=patch.vertices_L_m,
        faces=patch.faces,
        flat=patch.face_is_flat,
        position_L_m=view.position_L_m,
        L_from_C=view.L_from_C,
        fov_deg=field_deg(view.width_px),
        size_px=view.width_px,
        samples_per_pixel=round(rendered.samples_per_pixel),
        sun_direction_L=rendered.scene.sun.direction_L,
        sun_angular_radius_rad=rendered.scene.sun.angular_radius_rad,
        threads=os.cpu_count() or 1,
        poses=[pose_at(view, t) for t in (-EXPOSURE_S / 2, EXPOSURE_S / 2)] if view.motion is not None else (),
    ) as blender:
        blender.render()
        seconds, theirs = blender.render(), blender.picture()
    theirs = theirs * (got[lit].sum() / theirs[lit].sum())
    size = np.abs((theirs - got) / noise)[lit]
    return (
        f"Cycles: {seconds:.2f} s; images correlate by {np.corrcoef(theirs[lit], got[lit])[0, 1]:.5f}, differ by "
        f"{np.median(size):.3f} (median) and {np.percentile(size, 99):.3f} (p99) of the sensor's noise"
    )


def brute_force(rendered: Rendering, spec: SampleSpec, count: int) -> tuple[F64, F64]:
    """Return the mean radiance of sub-frames with samples of their own, and of every second one."""
    middle = rendered.scene.view
    halves = np.zeros((2, *rendered.light.rendered.array.shape))
    for k in range(count):
        t = ((k + 0.5) / count - 0.5) * EXPOSURE_S
        position_L_m, L_from_C = pose_at(middle, t)
        view = replace(middle, position_L_m=position_L_m, L_from_C=L_from_C, motion=None)
        key = (rendered.scene.key + 7919 * (k + 1)) & 0xFFFFFFFF
        scene = replace(rendered.scene, view=view, key=key, samples_per_pixel=SAMPLES)
        halves[k % 2] += render.direct(spec.terrain.surface, scene).array
    return halves.sum(axis=0) / count, 2 * halves[0] / count


def root_mean_square(values: F64) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt((values**2).mean()))


def below(rms: F64, chosen: Mask) -> str:
    """Return which percentage of the chosen pixels keeps below 0.3, and how many of all they are."""
    if not chosen.any():
        return "none"
    return f"{100 * (rms[chosen] < 0.3).mean():.2f} % of {100 * chosen.mean():.1f} %"


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--sub-frames", type=int, default=256)
    parser.add_argument("--noise-fraction", type=float, default=0.3)
    parser.add_argument("--max-samples", type=int, default=256)
    parser.add_argument("--lengths", type=float, nargs="+", default=[1, 5, 20])
    parser.add_argument("--repeats", type=int, default=6)
    parser.add_argument("--cycles", action="store_true")
    options = parser.parse_args()
    plain: dict[str, Any] = {
        "body": {"reflectance": 0.06},
        "patch": {"relief": 0.0},
        "sun": {"limb_darkening": False},
    }
    limits = {"noise_fraction": options.noise_fraction, "max_samples_per_pixel": options.max_samples}
    session = session_above_ground(options.size, limits, options.repeats, **plain if options.cycles else {})
    specs = [session.spec(k) for k in range(options.repeats)]
    pose = resolve(specs[0])
    assert specs[0].flown is not None
    still, _, still_s = exposed(specs[0], pose)
    print(f"still frame: {still_s:.2f} s, noise of sampling {still.noise_fraction_p99:.2f} of the sensor's")
    weights, detector = green_per_second(specs[0]) * EXPOSURE_S, specs[0].camera.detector
    stands = ("still        ", specs[0].flown)
    for name, flown in [stands, *motions(specs[0].flown, options.lengths)]:
        frames = [exposed(replace(spec, flown=flown), pose) for spec in specs]
        rendered, seconds = frames[0][0], float(np.median([frame[2] for frame in frames]))
        arrays = [exposure.light.rendered.array for _, exposure, _ in frames]
        total, half = brute_force(rendered, specs[0], options.sub_frames)
        *several, true, second = (np.einsum("b,byx->yx", weights, array) for array in (*arrays, total, half))
        got = np.mean(several, axis=0)
        lit = (true > 0.01 * detector.full_well_e) & (true < detector.full_well_e)
        noise = np.sqrt(np.maximum(true, 0) + detector.read_noise_e_rms**2)
        errors = np.array([(image - true) / noise for image in several])
        of_true = np.abs(second - true) / noise  # the halves differ by twice the error of their mean
        rms = np.sqrt((errors**2).mean(axis=0))  # of each pixel
        view, new_rays = rendered.scene.view, np.zeros_like(lit)
        if view.motion is not None:
            new_rays = motion.Paths.of(view, rendered.truth, EXPOSURE_S).appearing(rendered.truth)
        of_pixels = np.sort(rms[lit])
        best = of_pixels[: int(0.99 * len(of_pixels))]
        print(
            f"{name}: {np.median(errors[:, lit]):+.3f}, rms {root_mean_square(of_pixels):.3f}, of the best 99 % "
            f"{root_mean_square(best):.3f}; of a pixel: median {np.median(of_pixels):.3f}, p99 {best[-1]:.3f}, "
            f"below 0.3: {below(rms, lit)}, with new rays {below(rms, lit & new_rays)}; sub-frames "
            f"{root_mean_square(of_true[lit]):.3f}; {seconds / still_s:.2f} of a still frame",
            flush=True,
        )
        if options.cycles:
            print(f"    ours: {seconds:.2f} s; " + beside_cycles(session, rendered, got, noise, lit), flush=True)


if __name__ == "__main__":
    main()
