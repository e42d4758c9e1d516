"""Show a prescription: its paraxial properties as a table, and its layout as a figure (`vbnfault lens`)."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from ..core.calibration import COEFFICIENTS
from ..core.files.path_checks import real
from ..core.files.whole_files import replacing, write_json
from ..lens import Prescription, RealLens, open_f_number, paraxial_properties
from ..lens.rays import real_pupil_diameter_mm, trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

F64 = NDArray[np.float64]

_FIELDS = (0.0, 0.5, 1.0)  # fractions of the half field
_COLOURS = ("#2f6fb3", "#3c9a5f", "#c4632f")
_RAYS = 7
_GLASS = "#cfe3f2"
_FAINT = "#777777"
_FONT_PT = 7
_NUMBER_GAP_PT = 11  # between the centres of two row numbers; two digits are 9 pt wide


def figures(lens: Prescription) -> dict[str, float]:
    """Return the paraxial properties of a lens, the f-number of its real beam, and its scale."""
    return asdict(paraxial_properties(lens)) | {"real_f_number": open_f_number(lens), "scale": lens.scale}


def write_table(lens: Prescription, path: Path) -> None:
    """Write name, source and `figures` as JSON; null for a value that is infinite, such as a pupil's position."""
    write_json(path, {"name": lens.name, "source": lens.source, **figures(lens)})


def opencv_fit(lens: Prescription, fov_deg: float, width_px: int, height_px: int) -> str:
    """Return the lens's distortion as a table `[camera.calibration]` of OpenCV's rational model, with the residual.

    The image of `width_px` x `height_px` pixels has the field of view `fov_deg` across its width, without
    distortion. Raises InputError if no model reaches its corners, or if the lens cannot image such a frame.
    """
    f_px = width_px / 2 / float(np.tan(np.radians(fov_deg) / 2))
    pitch_um = paraxial_properties(lens).efl_mm * 1e3 / f_px
    real_lens = RealLens(prescription=lens, width_px=width_px, height_px=height_px, pixel_pitch_um=pitch_um)
    _ = real_lens.guard_px  # raises InputError where light comes into the corners from beyond the traced field
    rms, most = real_lens.distortion_residual_px
    values = {
        "model": '"opencv"',
        "width_px": width_px,
        "height_px": height_px,
        "fx": f"{f_px:.10g}",
        "cx": f"{width_px / 2 - 0.5:.10g}",
        "cy": f"{height_px / 2 - 0.5:.10g}",
    }
    coefficients = zip(COEFFICIENTS["opencv"][:8], real_lens.distortion.tolist(), strict=True)
    values |= {name: f"{value:.12g}" for name, value in coefficients if name[0] == "k"}
    return "\n".join(
        [
            "[camera.calibration]",
            *(f"{key} = {value}" for key, value in values.items()),
            f"# residual over the lit frame: {rms:.4f} px rms, {most:.4f} px at most; "
            f"holds to {real_lens.distortion_valid_to_deg:.2f} deg from the axis",
        ]
    )


def draw(lens: Prescription, path: Path, *, half_field_deg: float = 20.0) -> None:
    """Write `layout` to an image file."""
    with replacing(real(path)) as temporary:
        layout(lens, half_field_deg=half_field_deg).savefig(temporary, bbox_inches="tight", format="png")


def layout(lens: Prescription, *, half_field_deg: float = 20.0) -> Figure:
    """Return a drawing of the lens in its meridional plane.

    Each surface carries its row number, counted from 0 at the front with the stop included, as in the pairs of
    `vbnfault flare`. Rays come from the axis, half of `half_field_deg`, and the whole of it. The angle of each
    bundle stands beside the sensor.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    optics = paraxial_properties(lens)
    figure = Figure(figsize=(10, 5.6), dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw_rays(axes, lens, half_field_deg)
    outline = _draw_surfaces(axes, lens)
    if lens.hood is not None:
        rim = lens.surfaces[0]
        for side in (-1, 1):
            z = [-lens.hood.length_mm, float(rim.sag_mm(rim.semi_diameter_mm))]
            axes.plot(z, [side * lens.hood.radius_mm, side * rim.semi_diameter_mm], color="black", lw=2.5)
    sensor = lens.vertices_mm[-1] + optics.bfd_mm
    half = optics.efl_mm * np.tan(np.radians(half_field_deg))
    axes.plot([sensor, sensor], [-half, half], color="black", lw=2)
    axes.set_aspect("equal")
    _draw_row_numbers(axes, outline)
    axes.set(
        xlabel="z / mm",
        ylabel="y / mm",
        title=f"{lens.name}, f = {optics.efl_mm:.2f} mm, f/{open_f_number(lens):.2f}",
    )
    return figure


def _edges(lens: Prescription) -> list[tuple[F64, F64]]:
    """Return the profile of each surface: z and y in mm, from its lower to its upper rim."""
    profiles = []
    for z, surface in zip(lens.vertices_mm, lens.surfaces, strict=True):
        height = np.linspace(-1, 1, 121) * surface.semi_diameter_mm
        profiles.append((z + surface.sag_mm(height), height))
    return profiles


def _draw_surfaces(axes: Any, lens: Prescription) -> list[tuple[float, float]]:
    """Draw glass and stop; return the (z, y) of each row's upper end in mm, to which its number belongs."""
    profiles, ends = _edges(lens), []
    for k, surface in enumerate(lens.surfaces):
        z, height = profiles[k]
        if surface.stop:
            rim = surface.semi_diameter_mm
            for side in (-1, 1):
                axes.plot([lens.vertices_mm[k]] * 2, [side * rim, side * 1.5 * rim], color="black", lw=2.5)
            ends.append((float(lens.vertices_mm[k]), 1.5 * rim))
            continue
        ends.append((float(z[-1]), float(height[-1])))
        axes.plot(z, height, color="black", lw=0.9)
        if surface.medium.nd > 1 and k + 1 < len(profiles):
            back_z, back_height = profiles[k + 1]
            axes.fill(np.append(z, back_z[::-1]), np.append(height, back_height[::-1]), color=_GLASS, lw=0)
            for end in (0, -1):
                axes.plot([z[end], back_z[end]], [height[end], back_height[end]], color="black", lw=0.9)
    return ends


def _draw_rays(axes: Any, lens: Prescription, half_field_deg: float) -> None:
    """Draw the rays of each field that come past the hood and reach the sensor."""
    optics, pupil = paraxial_properties(lens), real_pupil_diameter_mm(lens)
    front = min(float(z.min()) for z, _ in _edges(lens))
    if lens.hood is not None:
        front = min(front, -lens.hood.length_mm)
    # rays start on a plane in front of all surfaces and aim at the entrance pupil
    start = front - 0.12 * (lens.vertices_mm[-1] + optics.bfd_mm)
    for fraction, colour in zip(_FIELDS, _COLOURS, strict=True):
        slope = np.tan(np.radians(fraction * half_field_deg))
        height = np.linspace(-0.499, 0.499, _RAYS) * pupil
        origin = np.column_stack(
            [np.zeros(_RAYS), height - slope * (optics.entrance_pupil_mm - start), np.full(_RAYS, start)]
        )
        traced = trace(lens, origin, np.tile([0.0, slope, 1.0], (_RAYS, 1)))
        axes.annotate(
            f"{fraction * half_field_deg:g}°",
            (lens.vertices_mm[-1] + optics.bfd_mm, optics.efl_mm * slope),
            xytext=(4, 0),
            textcoords="offset points",
            fontsize=_FONT_PT + 1,
            va="center",
            color=colour,
        )
        arrives = traced.arrives
        if lens.hood is not None:
            at_hood = origin[:, 1] - slope * (origin[:, 2] + lens.hood.length_mm)
            arrives = arrives & (np.abs(at_hood) <= lens.hood.radius_mm)
        for ray in np.moveaxis(traced.points_mm[:, arrives], 1, 0):
            axes.plot(ray[:, 2], ray[:, 1], color=colour, lw=0.6)


def _draw_row_numbers(axes: Any, ends: list[tuple[float, float]]) -> None:
    """Write the row numbers in one line above the drawing, each joined to the upper end of its surface.

    The numbers keep a distance from each other; within that, each is as near to its surface as possible.
    """
    z, y = np.array(ends).T
    low, high = axes.get_ylim()
    left, right = axes.get_xlim()
    line = high + 0.04 * (high - low)
    axes.set_ylim(low, line + 0.06 * (high - low))
    axes.apply_aspect()
    width_pt = axes.get_window_extent().width * 72 / axes.figure.dpi
    steps = _NUMBER_GAP_PT / width_pt * (right - left) * np.arange(len(z))
    spread = isotonic_regression(z - steps).x + steps
    for row, (at_z, at_y, number_z) in enumerate(zip(z, y, spread, strict=True)):
        axes.plot([number_z, at_z], [line, at_y], color=_FAINT, lw=0.4)
        axes.text(number_z, line, str(row), fontsize=_FONT_PT, ha="center", va="bottom", color="black")
