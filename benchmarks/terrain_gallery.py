"""Pictures of the terrain: sites × heights × Sun, for looking at.

python benchmarks/terrain_gallery.py --out FOLDER [--shape FILE] [--sites N] [--first K] [--size PX]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vbnfault import frames, render
from vbnfault.body import EMBEDDED, Patch, build_patch, choose_sites, load_body
from vbnfault.photometry import hapke_at
from vbnfault.scene import Scene, Sunlight, View

SUNS_DEG = {"low": 15.0, "high": 50.0}
# name → height above ground in m, degrees below the horizon
VIEWS = {
    "h005_horizon": (5.0, 12.0),
    "h015_oblique": (15.0, 32.0),
    "h050_horizon": (50.0, 24.0),
    "h050_nadir": (50.0, 90.0),
    "h100_oblique": (100.0, 45.0),
    "h100_horizon": (100.0, 20.0),
}
FOV_DEG = 65.0
DUST_CONTRAST = 0.12
SUN_TO_VIEW_DEG = 100.0  # the Sun from the side: relief shows
SUN_TRIES_DEG = (35.0, -35.0, 0.0, 70.0, -70.0, 105.0, -105.0, 180.0)  # from downhill, until the site is lit


def view_at(surface: render.Surface, height_m: float, below_deg: float, azimuth_deg: float, size: int) -> View:
    """A level camera that height above the ground, moved off the site against its heading."""
    heading = frames.direction_L(azimuth_deg, 0.0)
    foot = -0.35 * height_m * heading
    ground = float(render.ground_height_m(surface, foot[:1], foot[1:2], 400.0)[0])
    z = frames.direction_L(azimuth_deg, -min(below_deg, 89.99))
    x = np.cross([0.0, 0.0, 1.0], heading)
    x /= np.linalg.norm(x)
    focal = 0.5 * size / np.tan(np.radians(FOV_DEG / 2))
    return View(
        position_L_m=np.array([foot[0], foot[1], -(ground + height_m)]),
        L_from_C=np.column_stack([x, np.cross(z, x), z]),
        intrinsics=np.array([focal, focal, size / 2, size / 2]),
        width_px=size,
        height_px=size,
    )


def sunlit_azimuth(surface: render.Surface, patch: Patch) -> float:
    """From where a low Sun reaches most of the ground around the site: near downhill."""
    near = np.linalg.norm(patch.vertices_L_m[patch.faces[:, 0]], axis=1) < 60.0
    a, b, c = (
        patch.vertices_L_m[patch.faces[near & ~patch.face_is_boulder, k]].astype(np.float64) for k in range(3)
    )
    north, east, _ = np.cross(b - a, c - a).sum(axis=0)
    downhill = float(np.degrees(np.arctan2(east, north)))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-40, 40, 7), np.linspace(-40, 40, 7)))
    height = render.ground_height_m(surface, x, y, 400.0) + 0.5
    lit = []
    for turn in SUN_TRIES_DEG:
        sun = Sunlight(
            direction_L=frames.direction_L(downhill + turn, SUNS_DEG["low"]),
            angular_radius_rad=0.002,
            irradiance_W_m2_nm=np.ones(1),
        )
        places = np.column_stack([x, y, -height])
        lit.append(float(render.sun_visible_fraction(surface, places, [sun] * len(places)).mean()))
        if lit[-1] > 0.75:
            break
    return downhill + SUN_TRIES_DEG[int(np.argmax(lit))]


def picture(surface: render.Surface, view: View, sun_azimuth_deg: float, sun_elevation_deg: float) -> NDArray:
    """uint8[y, x]: exposed for the brightest 0.3 %, gamma 2.2."""
    sun = Sunlight(
        direction_L=frames.direction_L(sun_azimuth_deg, sun_elevation_deg),
        angular_radius_rad=np.radians(0.12),
        irradiance_W_m2_nm=np.ones(1),
    )
    scene = Scene(
        view=view,
        sun=sun,
        wavelength_nm=np.array([550.0]),
        photometry=hapke_at(np.array([550.0])),
        dust_contrast=np.array([DUST_CONTRAST]),
        samples_per_pixel=16,
        key=1,
    )
    grey = render.radiance(surface, scene).array[0]
    white = max(float(np.percentile(grey, 99.7)), 1e-9)
    return np.round(255 * np.clip(grey / white, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--shape", default=EMBEDDED)
    parser.add_argument("--sites", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--views", nargs="*", default=list(VIEWS), choices=list(VIEWS))
    parser.add_argument("--suns", nargs="*", default=list(SUNS_DEG), choices=list(SUNS_DEG))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    body = load_body(arguments.shape)
    for site in choose_sites(body, arguments.first + arguments.sites, arguments.seed)[arguments.first :]:
        start = time.perf_counter()
        patch: Patch = build_patch(body, site, seed=arguments.seed)
        built = time.perf_counter()
        surface = render.Surface(patch.vertices_L_m, patch.faces, patch.face_is_flat, patch.dust)
        sun_azimuth = sunlit_azimuth(surface, patch)
        azimuth = sun_azimuth + SUN_TO_VIEW_DEG * (-1) ** site.index
        for name in arguments.views:
            view = view_at(surface, *VIEWS[name], azimuth, arguments.size)
            for sun in arguments.suns:
                image = picture(surface, view, sun_azimuth, SUNS_DEG[sun])
                cv2.imwrite(str(arguments.out / f"{body.name}_{site.index}_{name}_{sun}.png"), image)
        print(
            f"{body.name} site {site.index}: built in {built - start:.1f} s, {patch.triangles} triangles, "
            f"{len(patch.boulder_diameter_m)} boulders, dust {patch.dust.mean():.2f}"
        )


if __name__ == "__main__":
    main()
