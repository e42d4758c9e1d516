"""Measure the straylight of the whole scene: its cost beside a render, its error against every pixel as a source.

    python benchmarks/scene_straylight.py [--size 1024] [--figure FIGURE.png] [--every-pixel SIZE]

A half-lit 67P stands left of the middle, behind `nikkor_28_f2p8_camera` without coatings. The command prints how
long a render and the straylight of the scene take, the median of three rounds each, also by CPU time and with
`scene_diffraction`, and how long the first image of a lens takes, for which its response is traced, and the first
of another process, which reads it from disk.
`--figure` draws the image without and with straylight, on a logarithmic scale of four decades.

`--every-pixel` instead compares the ghosts of a half-lit disc in a frame of this many pixels with those of every
lit pixel as a source, traced with exact rays and counted in pixels. It takes minutes.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vbnfault.core.files.array_files import FOLDER_VARIABLE
from vbnfault.core.spectra import Bands
from vbnfault.lens import ThinLens, load_lens, paraxial_properties
from vbnfault.lens.straylight import ghost_response
from vbnfault.lens.straylight.bundles import Tracer
from vbnfault.lens.straylight.ghosts import boxes, lit_cells
from vbnfault.lens.straylight.scene import RenderGrid, SceneInLens
from vbnfault.lens.straylight.settings import SensorGrid, StraylightSettings
from vbnfault.pipeline import Session
from vbnfault.pipeline.rendering import render_view
from vbnfault.scene import config

POSE = {
    "name": ["limb"],
    "julian_date": [2457000.5],
    "camera_x_T_m": [2500.0],
    "camera_y_T_m": [800.0],
    "camera_z_T_m": [9000.0],
    "camera_from_T_w": [0.0],
    "camera_from_T_x": [1.0],
    "camera_from_T_y": [0.0],
    "camera_from_T_z": [0.0],
    "sun_x_T": [0.9],
    "sun_y_T": [0.1],
    "sun_z_T": [0.42426407],
    "sun_distance_au": [2.5],
}
DECADES = 4.0


def scene_of(size: int) -> config.Scene:
    """Return the scene of the measurement."""
    table: dict[str, Any] = {
        "title": "scene_straylight",
        "description": "A half-lit body behind a lens without coatings",
        "dataset": {"samples": 1, "layers": ["clean"]},
        "camera": {
            "lens": "nikkor_28_f2p8_camera",
            "lens_coating": "none",
            "fov_deg": 50.0,
            "width_px": size,
            "height_px": size,
        },
        "plan": {"faulty_fraction": 1.0},
        "faults": {"straylight": {"model": "traced", "sources": "scene", "veil_fraction": 0.002}},
    }
    return config.parse_scene(table, source="scene_straylight")


def timed(call: Any, *inputs: Any) -> tuple[float, Any]:
    """Return the seconds that a call took, and its result."""
    start = time.perf_counter()
    result = call(*inputs)
    return time.perf_counter() - start, result


def cpu_of(call: Any, *inputs: Any) -> float:
    """Return the CPU time of a call in s, of all threads: it depends on other load less than the duration does."""
    start = time.process_time()
    call(*inputs)
    return time.process_time() - start


def measure(size: int, figure: Path | None) -> None:
    """Print the times, and draw the figure."""
    session = Session(scene_of(size), poses=POSE)
    frame = session.frame(0)
    spec, draw = frame.spec, frame.injection.draws["straylight"]
    renders, straylight = [], []
    firsts = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ[FOLDER_VARIABLE] = folder
        for _ in range(2):
            ghost_response._response.cache_clear()
            firsts.append(timed(draw.fault.scene_light, draw.params, frame.context)[0])  # type: ignore[attr-defined]
    for _ in range(3):
        renders.append(timed(render_view, spec, frame.pose)[0])
        straylight.append(timed(draw.fault.scene_light, draw.params, frame.context)[0])  # type: ignore[attr-defined]
    own, other = statistics.median(straylight), statistics.median(renders)
    print(f"{size} px: render {other:.2f} s, straylight of the scene {own:.2f} s ({own / other:.2f} of the render)")
    print(f"the first image of a lens: {firsts[0]:.1f} s, with its response from disk: {firsts[1]:.1f} s")
    light, params = draw.fault.scene_light, {**draw.params, "scene_diffraction": True}  # type: ignore[attr-defined]
    first, rounds = cpu_of(light, params, frame.context), []
    for _ in range(3):
        times = cpu_of(render_view, spec, frame.pose), cpu_of(light, draw.params, frame.context)
        rounds.append((*times, cpu_of(light, params, frame.context)))
    render, plain, diffracted = (statistics.median(column) for column in zip(*rounds, strict=True))
    print(
        f"by CPU: render {render:.2f} s, straylight of the scene {plain:.2f} s ({plain / render:.2f} of it), with"
    )
    print(f"scene_diffraction {diffracted:.2f} s ({diffracted / render:.2f}), the first time {first:.2f} s")
    if figure is not None:
        development, draws = frame.injection.development, frame.injection.draws
        panels = []
        for names in ([], ["straylight"]):
            light = development.signal(draws, names).merged
            scale = np.log10(np.maximum(light.array / light.white_e, 1e-9)) / DECADES + 1
            panels.append((np.clip(scale[..., [2, 1, 0]], 0, 1) * 255).astype(np.uint8))
        cv2.imwrite(str(figure), np.hstack(panels))


def compare(size: int, within: int = 2, across: int = 64) -> None:
    """Print the difference of the ghosts from those of every lit pixel as a source."""
    lens = load_lens("tessar_50_f2p8")
    efl_mm = paraxial_properties(lens).efl_mm
    focal_px = float(size / 2 / np.tan(np.radians(17.5)))
    pitch_mm = efl_mm / focal_px
    scene = SceneInLens(
        lens=lens,
        bands=Bands.lines(550.0),
        of_nodes=np.eye(1),
        sensor=SensorGrid(shape=(size, size), pitch_mm=pitch_mm),
        render=RenderGrid(shape=(size, size), focal_px=focal_px),
        image=ThinLens(focal_length_mm=efl_mm, f_number=2.8),
        settings=StraylightSettings(),
        passed=np.ones(1),
    )
    row, column = (np.mgrid[:size, :size] + 0.5) / size
    lit = (np.hypot(column - 0.65, row - 0.4) < 0.12) * np.clip((column - 0.65) / 0.12, 0, 1)
    found = scene.straylight(lit[None].astype(np.float32), np.eye(1)).ghosts[0]
    made, halves = Tracer(lens, scene.bands.nodes_nm), np.zeros((2, size * size))
    offsets, rng = (np.arange(within) + 0.5) / within, np.random.default_rng(1)
    for i, j in zip(*np.nonzero(lit), strict=True):
        for point in range(within**2):
            x, y = j + offsets[point % within] - size / 2, i + offsets[point // within] - size / 2
            slope, azimuth = np.hypot(x, y) / focal_px, np.arctan2(y, x)
            rays, _ = boxes(made, float(np.degrees(np.arctan(slope))))
            # the same lattice for all sources would leave rings in the sum
            shift = rays.box_mm[:, 2:] * rng.uniform(-1, 1, (len(rays), 2)) / across
            rays = replace(rays, box_mm=rays.box_mm + np.pad(shift, ((0, 0), (0, 2))))
            spots = made.trace(rays, across, centred=True)
            solid_sr = (1 + slope**2) ** -1.5 / focal_px**2 / within**2
            cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2 / np.hypot(1, slope) * solid_sr * lit[i, j]
            light = (lit_cells(spots, across).numpy().reshape(len(rays), -1) * cell[:, None]).ravel()
            sx, sy = spots.x_mm.numpy() / pitch_mm, spots.y_mm.numpy() / pitch_mm
            px = np.floor(sx * np.cos(azimuth) - sy * np.sin(azimuth) + size / 2).astype(int)
            py = np.floor(sx * np.sin(azimuth) + sy * np.cos(azimuth) + size / 2).astype(int)
            seen = (px >= 0) & (px < size) & (py >= 0) & (py < size)
            half = halves[(point % within + point // within) % 2]
            half += np.bincount(py[seen] * size + px[seen], weights=light[seen], minlength=size * size)
    expected = halves.sum(axis=0).reshape(size, size) / pitch_mm**2
    # the halves have independent lattices, so that their difference has the noise of their sum
    noise = np.abs(halves[0] - halves[1]).sum() / halves.sum()
    apart = np.abs(found - expected).sum() / expected.sum()
    print(f"{size} px, {np.count_nonzero(lit)} lit: differs by {apart:.2%} of the ghosts' light, pixel by pixel")
    print(f"of which {noise:.2%} is the noise of the rays that are counted in pixels")
    print(f"sum over the pixels: {found.sum() / expected.sum():.4f} of every pixel as a source")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024, help="pixels along each side of the frame")
    parser.add_argument("--figure", type=Path, help="PNG of the image without and with straylight")
    parser.add_argument(
        "--every-pixel", type=int, metavar="SIZE", help="compare the ghosts in a frame of this size"
    )
    given = parser.parse_args()
    if given.every_pixel:
        compare(given.every_pixel)
    else:
        measure(given.size, given.figure)


if __name__ == "__main__":
    main()
