"""Render images of the terrain for visual inspection: several sites, views and Suns, and one sheet a site.

python benchmarks/terrain_gallery.py --out FOLDER [--scene SCENE] [--shape FILE] [--sites 0 1 2] [--size PX]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vbnfault import render
from vbnfault.body import EMBEDDED
from vbnfault.core import frames
from vbnfault.core.files.images import write_png
from vbnfault.pipeline import Session
from vbnfault.pipeline.exposure import meter
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.spec import Pose
from vbnfault.render.description import Sunlight
from vbnfault.scene import config, redraw

SUNS_DEG = {"low": 12.0, "high": 50.0}
# name → height above ground in m, degrees below the horizon
VIEWS = {
    "h002_oblique": (2.0, 35.0),
    "h008_horizon": (8.0, 14.0),
    "h030_oblique": (30.0, 32.0),
    "h060_nadir": (60.0, 90.0),
    "h100_horizon": (100.0, 22.0),
}
SUN_TO_VIEW_DEG = 100.0  # light from the side makes the relief visible
# Sun azimuths tried from the downhill direction, until the site is lit
SUN_TRIES_DEG = (35.0, -35.0, 0.0, 70.0, -70.0, 105.0, -105.0, 180.0)
GAMMA = 2.2


def pose_at(
    surface: render.TerrainMesh, height_m: float, below_deg: float, azimuth_deg: float, sun: tuple[float, float]
) -> Pose:
    """Return the pose of a camera without roll, `height_m` above the ground, behind the site as the camera looks.

    Parameters
    ----------
    below_deg
        Angle of the boresight below the horizon.
    azimuth_deg
        Azimuth of the boresight, from north towards east.
    sun
        Azimuth and elevation of the Sun in degrees.
    """
    heading = frames.direction_L(azimuth_deg, 0.0)
    foot = -0.35 * height_m * heading
    ground = float(render.ground_height_m(surface, foot[:1], foot[1:2], 400.0)[0])
    z = frames.direction_L(azimuth_deg, -min(below_deg, 89.99))
    x = np.cross([0.0, 0.0, 1.0], heading)
    x /= np.linalg.norm(x)
    return Pose(
        position_L_m=np.array([foot[0], foot[1], -(ground + height_m)]),
        L_from_C=np.column_stack([x, np.cross(z, x), z]),
        sun_L=frames.direction_L(*sun),
        sun_azimuth_deg=sun[0],
        sun_elevation_deg=sun[1],
        sun_visible_fraction=1.0,
        tries=1,
        variables=dict.fromkeys(redraw.VARIABLES, 0.0),  # placed by hand, not drawn
        resolved=True,
    )


def sunlit_azimuth(surface: render.TerrainMesh) -> float:
    """Return the Sun azimuth in degrees at which a low Sun lights most of the ground around the site."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-40, 40, 7), np.linspace(-40, 40, 7)))
    height = render.ground_height_m(surface, x, y, 400.0) + 0.5
    fit = np.linalg.lstsq(np.column_stack([x, y, np.ones_like(x)]), height, rcond=None)[0]
    downhill = float(np.degrees(np.arctan2(-fit[1], -fit[0])))
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


def picture(session: Session, site: int, pose: Pose) -> NDArray:
    """Return the image of the scene's camera without faults and noise, with gamma 2.2, uint8[y, x, 3]."""
    spec = session.spec(int(np.flatnonzero(session.plan.site == site)[0]))
    exposure = meter(spec, render_view(spec, pose))
    rate, camera = exposure.rate.merged, exposure.camera
    exposed = rate.with_array(rate.array * np.float32(camera.exposure_s))
    image = camera.detector.develop(exposed, camera.exposure_s, None).array[..., :3]
    return np.round(255 * (image / 255.0) ** (1 / GAMMA)).astype(np.uint8)


def main() -> None:
    """Write the images and sheets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="physical67p")
    parser.add_argument("--shape", default=EMBEDDED)
    parser.add_argument("--sites", type=int, nargs="*", default=list(range(8)))
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--views", nargs="*", default=list(VIEWS), choices=list(VIEWS))
    parser.add_argument("--suns", nargs="*", default=list(SUNS_DEG), choices=list(SUNS_DEG))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    scene = config.load_scene(
        arguments.scene,
        {
            "camera.width_px": arguments.size,
            "camera.height_px": arguments.size,
            "body.shape": arguments.shape,
            "spacecraft.model": "none",
            "dataset.samples": 2048,  # some for every site
        },
    )
    scene = scene.model_copy(update={"render": scene.render.model_copy(update={"noise_fraction": None})})
    session = Session(scene)
    for site in arguments.sites:
        start = time.perf_counter()
        surface = session.terrain(site).surface
        built = time.perf_counter()
        sun_azimuth = sunlit_azimuth(surface)
        azimuth = sun_azimuth + SUN_TO_VIEW_DEG * (-1) ** site
        rows = []
        for sun in arguments.suns:
            row = []
            for name in arguments.views:
                pose = pose_at(surface, *VIEWS[name], azimuth, (sun_azimuth, SUNS_DEG[sun]))
                row.append(picture(session, site, pose))
                write_png(arguments.out / f"site{site:02d}_{name}_{sun}.png", row[-1])
            rows.append(np.hstack(row))
        sheet = cv2.resize(np.vstack(rows), None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
        write_png(arguments.out / f"site{site:02d}_sheet.png", sheet)
        print(
            f"site {site}: terrain in {built - start:.1f} s, {len(arguments.suns) * len(arguments.views)} pictures"
        )


if __name__ == "__main__":
    main()
