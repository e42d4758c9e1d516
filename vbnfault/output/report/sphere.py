"""Draw directions on a sphere as SVG; the page's script turns it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...core.html_page import embedded_json, escaped
from .charts import split_colour, svg

F64 = NDArray[np.float64]

_RADIUS, _SIZE = 138.0, 300.0
_MOST_POINTS = 1500  # in one drawing, of all splits


def sphere(
    title: str,
    note: str,
    groups: list[tuple[str, F64]],
    labels: list[tuple[str, F64]],
    view_deg: tuple[float, float],
) -> str:
    """Return a sphere with directions as dots, those on its far side faint.

    Parameters
    ----------
    title, note
        Text above and below it.
    groups
        Name and unit vectors [n, 3] of each split; x, y, z are right-handed and z points up on the page.
    labels
        Text and direction of the marked axes.
    view_deg
        Azimuth from x towards y and elevation from which the sphere is seen, in degrees.
    """
    total = sum(len(vectors) for _, vectors in groups)
    every = -(-total // _MOST_POINTS) if total else 1
    kept = [vectors[::every] for _, vectors in groups]
    names = [name for name, _ in groups]
    parts = [f'<circle class="globe" cx="{_SIZE / 2}" cy="{_SIZE / 2}" r="{_RADIUS}"/>']
    lines = graticule()
    for kind in ("far", "near"):
        parts.append(f'<path class="graticule {kind}" d="{_lines(lines, view_deg, kind == "near")}"/>')
        for k, vectors in enumerate(kept):
            style = f"stroke:{split_colour(k)}"
            parts.append(
                f'<path class="dots {kind}" style="{style}" d="{_dots(vectors, view_deg, kind == "near")}"/>'
            )
    for text, direction in labels:
        x, y, depth = (float(c[0]) for c in projected(np.atleast_2d(direction) * 1.0, view_deg))
        faint = "" if depth >= 0 else ' style="opacity:.35"'
        parts.append(
            f'<text class="axis-name" x="{x:.1f}" y="{y:.1f}" text-anchor="middle"{faint}>{escaped(text)}</text>'
        )
    data = {
        "view": view_deg,
        "radius": _RADIUS,
        "size": _SIZE,
        "points": [np.round(v, 3).tolist() for v in kept],
        "labels": [np.asarray(direction, dtype=float).tolist() for _, direction in labels],
    }
    words = ", ".join(f"{name} {len(v)}" for name, v in zip(names, kept, strict=True))
    label = f"{title}: {words} directions; arrow keys turn the sphere"
    drawn = svg(_SIZE, _SIZE, "".join(parts), label, ' class="sphere" tabindex="0"')
    some = f" Every {every}th sample is drawn." if every > 1 else ""
    script = f'<script type="application/json">{embedded_json(data)}</script>'
    caption = f"<figcaption>{escaped(title)}</figcaption>"
    return f'<figure class="chart globe-figure">{caption}{drawn}{script}<p>{escaped(note + some)}</p></figure>'


def graticule() -> list[F64]:
    """Return meridians and parallels every 30 degrees as lines of unit vectors."""
    turn, half = np.radians(np.arange(0, 361, 6)), np.radians(np.arange(-90, 91, 6))
    lines = []
    for azimuth in np.radians(np.arange(0, 360, 30)):
        lines.append(
            np.stack([np.cos(half) * np.cos(azimuth), np.cos(half) * np.sin(azimuth), np.sin(half)], axis=1)
        )
    for elevation in np.radians((-60, -30, 0, 30, 60)):
        z = np.full(len(turn), math.sin(elevation))
        lines.append(np.stack([math.cos(elevation) * np.cos(turn), math.cos(elevation) * np.sin(turn), z], axis=1))
    return lines


def projected(vectors: F64, view_deg: tuple[float, float]) -> tuple[F64, F64, F64]:
    """Return x and y on the page and the height above it of unit vectors, orthographic, seen from `view_deg`."""
    azimuth, elevation = np.radians(view_deg)
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    right = -np.sin(azimuth) * x + np.cos(azimuth) * y
    ahead = np.cos(azimuth) * x + np.sin(azimuth) * y
    up = -np.sin(elevation) * ahead + np.cos(elevation) * z
    depth = np.cos(elevation) * ahead + np.sin(elevation) * z
    return _SIZE / 2 + _RADIUS * right, _SIZE / 2 - _RADIUS * up, depth


def _dots(vectors: F64, view_deg: tuple[float, float], near: bool) -> str:
    """Return the dots of one side of the sphere as a path of points."""
    if not len(vectors):
        return ""
    x, y, depth = projected(vectors, view_deg)
    chosen = (depth >= 0) == near
    return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x[chosen], y[chosen], strict=True))


def _lines(lines: list[F64], view_deg: tuple[float, float], near: bool) -> str:
    """Return the parts of lines on one side of the sphere as a path."""
    parts = []
    for line in lines:
        x, y, depth = projected(line, view_deg)
        drawing = False
        for a, b, d in zip(x, y, depth, strict=True):
            visible = (d >= 0) == near
            if visible:
                parts.append(f"{'L' if drawing else 'M'}{a:.1f} {b:.1f}")
            drawing = visible
    return "".join(parts)
