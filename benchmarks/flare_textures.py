"""Write the flare and glare textures of straylight/texture:  python benchmarks/flare_textures.py OUTDIR

The paper (Gallon et al.) shows ten flares and two glares but publishes none of them. These textures are our own,
computed from closed-form profiles. Flares 1-5 are dense orbs and discs close to the Sun. Flares 6-10 are rings,
iris polygons and a clipped pupil far from it. Each looks like the out-of-focus image of an aperture after two
reflections at coated surfaces:

- a tint from the coating,
- colours that separate at the rim, because the size of a ghost depends on wavelength,
- a bright or faint rim, where aberration concentrates or spreads the light,
- weak ripples of diffraction.

A texture covers [-1/FILL, 1/FILL]² around its centre, and the outline of the flare has radius 1. Its +x axis points
along the line from the Sun through the centre of the image. Values are linear in light, where 1 is white at
brightness 1. They are stored as 16 bit RGB PNG (65535 = 1) in steps of 1/4096.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vbnfault.faults.straylight import FILL

F64 = NDArray[np.float64]

SIZE_PX = 384
STEP = 16  # step of the stored values (65535 = 1): makes small files, and is far finer than one DN

# Change of a ghost's size in R, G, B per unit of dispersion.
_SPREAD = (1.0, 0.0, -1.0)


def _grid() -> tuple[F64, F64]:
    """Return x and y of the pixel centres, float64[y, x] each, in radii of the outline."""
    axis = ((np.arange(SIZE_PX) + 0.5) / SIZE_PX * 2 - 1) / FILL
    return np.meshgrid(axis, axis)


def _inside(signed_distance: F64, softness: float) -> F64:
    """Return 1 inside, 0 outside, with a smooth step of width 2·softness around signed distance 0."""
    t = np.clip(0.5 - signed_distance / (2 * softness), 0, 1)
    return t * t * (3 - 2 * t)


def _bump(x: F64, width: float) -> F64:
    """Return a Gaussian with maximum 1 at 0 and standard deviation `width`."""
    return np.exp(-0.5 * (x / width) ** 2)


def _polygon(x: F64, y: F64, sides: int, turn: float, bulge: float) -> F64:
    """Return the signed distance to an iris of `sides` blades with circumradius 1.

    `bulge` is 0 for straight blades and 1 for a circle.
    """
    angle = np.arctan2(y, x) - turn
    sector = 2 * np.pi / sides
    inner = np.cos(sector / 2)
    folded = np.mod(angle, sector) - sector / 2
    straight = np.hypot(x, y) * np.cos(folded) - inner
    # blending with the circle makes the blades round; the corners stay at radius 1
    return (1 - bulge) * straight / inner * (1 + inner) / 2 + bulge * (np.hypot(x, y) - 1)


def _coloured(tint: tuple[float, float, float], dispersion: float, shape: Callable[[F64, F64], F64]) -> F64:
    """Return `shape` in R, G and B, float64[y, x, 3]: each with its own gain and a slightly different size."""
    x, y = _grid()
    planes = []
    for gain, spread in zip(tint, _SPREAD, strict=True):
        size = 1 + dispersion * (spread - 1)  # red is largest and reaches radius 1
        planes.append(gain * shape(x / size, y / size))
    return np.stack(planes, axis=-1)


def _radius(x: F64, y: F64) -> F64:
    """Return the distance from the centre."""
    return np.hypot(x, y)


def _orb(x: F64, y: F64) -> F64:
    """Return an orb with a bright core."""
    r = _radius(x, y)
    return (0.35 + 0.65 * _bump(r, 0.38)) * _inside(r - 0.8, 0.2)


def _disc(x: F64, y: F64) -> F64:
    """Return a dense disc."""
    r = _radius(x, y)
    return (0.78 + 0.08 * x + 0.14 * r**4) * _inside(r - 0.94, 0.06)


def _limb_disc(x: F64, y: F64) -> F64:
    """Return a disc with a bright limb."""
    r = _radius(x, y)
    return (0.4 + 0.35 * r**2 + 0.25 * _bump(r - 0.86, 0.06)) * _inside(r - 0.93, 0.06)


def _leaning_orb(x: F64, y: F64) -> F64:
    """Return an orb whose core is shifted outwards."""
    r = _radius(x, y)
    return (0.45 + 0.55 * _bump(np.hypot(x - 0.35, y), 0.5)) * _inside(r - 0.9, 0.1)


def _cored_disc(x: F64, y: F64) -> F64:
    """Return a disc with a denser core."""
    r = _radius(x, y)
    return 0.45 * _inside(r - 0.93, 0.07) + 0.55 * _inside(r - 0.42, 0.14)


def _ring(x: F64, y: F64) -> F64:
    """Return a thin ring with weak ripples."""
    r = _radius(x, y)
    ripple = 0.05 * np.cos(95 * (1 - r**2)) * _bump(r - 0.8, 0.12)
    return (_bump(r - 0.93, 0.022) + (0.1 + ripple) * r**3) * _inside(r - 0.96, 0.04)


def _hexagon(x: F64, y: F64) -> F64:
    """Return the image of an iris with six blades and a bright edge."""
    d = _polygon(x, y, 6, 0.2, 0.12)
    lit = 0.42 + 0.2 * _radius(x, y) ** 2 - 0.12 * x  # fainter in the middle, brighter towards the Sun
    return (lit + 0.4 * _bump(d + 0.05, 0.035)) * _inside(d + 0.03, 0.025)


def _heptagon(x: F64, y: F64) -> F64:
    """Return the image of an iris with seven blades, brighter on one side."""
    d = _polygon(x, y, 7, 0.0, 0.3)
    return (0.65 + 0.3 * x + 0.15 * _bump(d + 0.06, 0.04)) * _inside(d + 0.04, 0.035)


def _halo(x: F64, y: F64) -> F64:
    """Return a double halo."""
    r = _radius(x, y)
    return (0.8 * _bump(r - 0.84, 0.055) + 0.3 * _bump(r - 0.6, 0.03) + 0.05 * _bump(r, 0.5)) * _inside(
        r - 0.95, 0.05
    )


def _crescent(x: F64, y: F64) -> F64:
    """Return a clipped pupil with a caustic."""
    # a second opening clips the rim of the pupil; the light is brightest along the caustic at its outer edge
    r = _radius(x, y)
    cut = np.hypot(x + 0.75, y) - 1.05
    return (0.35 + 0.65 * _bump(r - 0.9, 0.09)) * _inside(r - 0.94, 0.05) * _inside(-cut, 0.18)


def _soft_glare() -> F64:
    """Return a glare with a core and a soft skirt, float64[y, x, 3]."""
    x, y = _grid()
    r = _radius(x, y)
    fade = _inside(r - 0.55, 0.45)
    core, skirt = _bump(r, 0.045), 0.22 / (1 + (r / 0.07) ** 2) + 0.05 * np.exp(-r / 0.3)
    tint = np.array([1.0, 0.96, 0.9])
    return ((core + skirt) * fade)[..., None] * tint


def _starburst_glare() -> F64:
    """Return a glare with a core and a starburst of 14 rays, float64[y, x, 3]."""
    x, y = _grid()
    r = _radius(x, y)
    angle = np.arctan2(y, x)
    planes = []
    for wavelength in (1.15, 1.0, 0.85):  # diffraction spreads red light further
        q = r / wavelength
        # 14 rays of an iris with seven blades, each of constant width
        across = q * np.abs(np.sin(7 * angle + 0.4)) / 7
        rays = 0.5 * np.exp(-q / 0.2) * _bump(across, 0.006 + 0.004 * wavelength)
        glow = _bump(q, 0.04) + 0.16 / (1 + (q / 0.05) ** 2)
        planes.append((rays + glow) * _inside(r - 0.6, 0.38))
    return np.stack(planes, axis=-1) * np.array([1.0, 0.97, 0.93])


# name → (description, gains of R, G and B, dispersion, shape)
FLARES: dict[str, tuple[str, tuple[float, float, float], float, Callable[[F64, F64], F64]]] = {
    "flare_01": ("close: warm orb, bright core", (0.30, 0.27, 0.21), 0.02, _orb),
    "flare_02": ("close: dense green disc", (0.07, 0.15, 0.12), 0.02, _disc),
    "flare_03": ("close: amber disc, bright limb", (0.18, 0.135, 0.08), 0.025, _limb_disc),
    "flare_04": ("close: magenta orb, leaning outwards", (0.18, 0.10, 0.17), 0.02, _leaning_orb),
    "flare_05": ("close: blue disc with a denser core", (0.07, 0.14, 0.21), 0.03, _cored_disc),
    "flare_06": ("far: thin ring, colours parted", (0.17, 0.17, 0.18), 0.022, _ring),
    "flare_07": ("far: iris of six blades, bright edge", (0.06, 0.13, 0.10), 0.02, _hexagon),
    "flare_08": ("far: iris of seven blades, graded", (0.13, 0.08, 0.15), 0.025, _heptagon),
    "flare_09": ("far: double halo, colours parted", (0.14, 0.135, 0.13), 0.03, _halo),
    "flare_10": ("far: clipped pupil with a caustic", (0.16, 0.15, 0.20), 0.03, _crescent),
}
# name → (description, function that makes it)
TEXTURES: dict[str, tuple[str, Callable[[], F64]]] = {
    **{name: (how, partial(_coloured, *of)) for name, (how, *of) in FLARES.items()},
    "glare_1": ("glare: core and soft skirt", _soft_glare),
    "glare_2": ("glare: core and starburst of 14 rays", _starburst_glare),
}


def make(name: str) -> NDArray[np.uint16]:
    """Return one texture, uint16[y, x, 3] RGB, 65535 = 1."""
    values = TEXTURES[name][1]()
    steps = np.rint(np.clip(values, 0, 1) * (65536 / STEP))
    return np.minimum(steps * STEP, 65535).astype(np.uint16)


def write_all(folder: Path) -> None:
    """Write all textures and SOURCES.md into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, (how, _) in TEXTURES.items():
        path = folder / f"{name}.png"
        cv2.imwrite(str(path), make(name)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
        rows.append(f"| `{path.name}` | {how} | `{hashlib.sha256(path.read_bytes()).hexdigest()}` |")
    (folder / "SOURCES.md").write_text(_SOURCES.format(size=SIZE_PX, fill=FILL, rows="\n".join(rows)))


_SOURCES = """\
# Textures

Flares and glares of `straylight/texture`. All are our own work, computed from closed-form profiles by
`python benchmarks/flare_textures.py textures` (no photograph, no third party's texture), under the
project's licence.

Unit: share of white at brightness 1, linear in light, 65535 = 1; 16 bit RGB, {size} × {size} px. A flare's
outline lies at {fill} of the half size; its +x axis points along the line from the Sun through the centre of
the image. Flares 1-5 form the group `close` to the Sun, 6-10 the group `far` from it.

| file | how it was made | sha256 |
|---|---|---|
{rows}
"""


def main() -> None:
    """Run the command line with one argument, the folder for the textures."""
    import sys

    if len(sys.argv) != 2:
        raise SystemExit("usage: python benchmarks/flare_textures.py OUTDIR")
    write_all(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
