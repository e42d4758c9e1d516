"""Draw the layout of a prescription: surfaces, glass, stop, and rays of three field angles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .gaussian import first_order
from .prescription import Prescription
from .rays import real_pupil_diameter_mm, trace

_FIELDS = (0.0, 0.5, 1.0)  # fractions of the half field
_COLOURS = ("#2f6fb3", "#3c9a5f", "#c4632f")
_RAYS = 7
_GLASS = "#cfe3f2"


def draw(lens: Prescription, path: Path, *, half_field_deg: float = 20.0) -> None:
    """Write a drawing of the lens in its meridional plane to an image file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figures, vertex = first_order(lens), lens.vertices_mm
    figure = Figure(figsize=(10, 5), dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    edges = []
    for z, surface in zip(vertex, lens.surfaces, strict=True):
        height = np.linspace(-1, 1, 121) * surface.semi_diameter_mm
        edges.append((z + surface.sag_mm(height), height))
    for k, surface in enumerate(lens.surfaces):
        z, height = edges[k]
        if surface.stop:
            for side in (-1, 1):
                rim = side * surface.semi_diameter_mm
                axes.plot([vertex[k]] * 2, [rim, 1.5 * rim], color="black", lw=2.5)
            continue
        axes.plot(z, height, color="black", lw=0.9)
        if surface.medium.nd > 1:
            behind, there = edges[k + 1]
            axes.fill(np.append(z, behind[::-1]), np.append(height, there[::-1]), color=_GLASS, lw=0)
            for end in (0, -1):
                axes.plot([z[end], behind[end]], [height[end], there[end]], color="black", lw=0.9)
    pupil = real_pupil_diameter_mm(lens)
    for share, colour in zip(_FIELDS, _COLOURS, strict=True):
        slope = np.tan(np.radians(share * half_field_deg))
        height = np.linspace(-0.499, 0.499, _RAYS) * pupil
        # rays start on a plane in front of all surfaces and aim at the entrance pupil
        start = min(float(edge[0].min()) for edge in edges) - 0.12 * (vertex[-1] + figures.bfd_mm)
        origin = np.column_stack(
            [np.zeros(_RAYS), height - slope * (figures.entrance_pupil_mm - start), np.full(_RAYS, start)]
        )
        found = trace(lens, origin, np.tile([0.0, slope, 1.0], (_RAYS, 1)))
        for ray in np.moveaxis(found.points_mm[:, found.arrives], 1, 0):
            axes.plot(ray[:, 2], ray[:, 1], color=colour, lw=0.6)
    sensor = vertex[-1] + figures.bfd_mm
    half = figures.efl_mm * np.tan(np.radians(half_field_deg))
    axes.plot([sensor, sensor], [-half, half], color="black", lw=2)
    axes.set_aspect("equal")
    axes.set(xlabel="z / mm", ylabel="y / mm", title=f"{lens.name}, f = {figures.efl_mm:.2f} mm")
    figure.tight_layout()
    figure.savefig(path)
