"""Time a frame of a sequence against a single sample, stage by stage.

    python benchmarks/sequence_cost.py [--size 512] [--frames 40] [--scene descent67p]

The single sample is the first of a new session, with body, flights, terrain and detector made for it; kernels are
compiled and terrain is in the cache before. The last line is the cost of `Session.take`: its median time for the
same frames less that of the frames themselves.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import vbnfault
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.stages import simulate_frame


class Timer:
    """Call stages, and keep the seconds of each by its name."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def __call__(self, stage: Any, /, *inputs: Any, **options: Any) -> Any:
        started = time.perf_counter()
        out = stage(*inputs, **options)
        self.seconds[stage.__name__].append(time.perf_counter() - started)
        return out


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--scene", default="descent67p")
    options = parser.parse_args()
    changes = {"camera.width_px": options.size, "camera.height_px": options.size}
    scene = vbnfault.load_scene(options.scene, changes)
    vbnfault.Session(scene).simulate(0)
    started = time.perf_counter()
    session = vbnfault.Session(scene)
    session.simulate(0)
    alone_s = time.perf_counter() - started
    timer, frames_s, taken_s = Timer(), [], []
    for k in range(1, options.frames):
        pose = row(session.trajectory.pose(k))
        started = time.perf_counter()
        to_sample(simulate_frame(session.spec(k), timer))
        between = time.perf_counter()
        session.take(pose, sample=k)
        frames_s.append(between - started)
        taken_s.append(time.perf_counter() - between)
    frame_s = float(np.median(frames_s))
    print(f"single sample {alone_s:.2f} s, frame of the sequence {frame_s:.2f} s: {frame_s / alone_s:.2f}")
    for name, seconds in timer.seconds.items():
        print(f"  {name:16} {1e3 * float(np.median(seconds)):7.1f} ms")
    print(f"Session.take: {1e3 * float(np.median(np.array(taken_s) - frames_s)):+.0f} ms")


def row(pose: Any) -> dict[str, Any]:
    """Return a pose as the row of a table."""
    vectors = {
        "camera_{}_T_m": pose.camera_position_T_m,
        "sun_{}_T": pose.sun_direction_T,
        "velocity_{}_T_m_s": pose.velocity_T_m_s,
        "rate_{}_C_rad_s": pose.rate_C_rad_s,
    }
    quaternion = Rotation.from_matrix(pose.T_from_C.T).as_quat(scalar_first=True)
    return {
        "name": pose.name,
        "julian_date": pose.julian_date,
        "sun_distance_au": pose.sun_distance_au,
        "sequence": "s",
        "time_s": pose.time_s,
        **{name.format(a): v for name, of in vectors.items() for a, v in zip("xyz", of.tolist(), strict=True)},
        **{f"camera_from_T_{a}": v for a, v in zip("wxyz", quaternion.tolist(), strict=True)},
    }


if __name__ == "__main__":
    main()
