"""Describe a camera for the tracing of beams, and fit other lenses to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.files import file_contents
from .adapt import OF_COATINGS, Change, changed, stopped_down
from .beams import Beams, beams
from .imaging import Lens, RealLens
from .paraxial import scaled_to_focal_length
from .prescription import Prescription
from .prescription_file import load_lens

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

DEFAULT_LENS = "nikkor_35_f2p8"

_MARGIN = 1.1  # beams are computed up to this multiple of the tangent of the frame's corner


@dataclass(frozen=True, kw_only=True)
class ImageFrame:
    """Describe a camera for the tracing of beams: its lens, and its image centred on the axis.

    The camera's own lens already has the `changes`, and another prescription gets all of them. Where `prescription`
    replaces the coatings of the own lens, it repeats the changes of coatings.
    """

    lens: Lens
    width_px: int
    height_px: int
    pixel_pitch_um: float
    changes: tuple[Change, ...] = ()

    def slopes(self, x_px: NDArray, y_px: NDArray) -> tuple[F32, F32]:
        """Return the tangents of the field angles of pixels, to the right and down, float32[y, x] each.

        `x_px` float64[x] and `y_px` float64[y] are the positions of columns and rows in the image.
        """
        per_px = self.pixel_pitch_um * 1e-3 / self.lens.focal_length_mm
        x, y = np.broadcast_arrays(
            ((x_px - self.width_px / 2) * per_px).astype(np.float32)[None, :],
            ((y_px - self.height_px / 2) * per_px).astype(np.float32)[:, None],
        )
        return self.lens.field_slopes(x, y)

    def nodes_px(self, step: int) -> tuple[F64, F64]:
        """Return x and y of nodes `step` px apart, from half a step outside; every pixel lies between nodes."""
        counts = (-(-size // step) + 2 for size in (self.width_px, self.height_px))
        x, y = (np.asarray((np.arange(count) - 0.5) * step) for count in counts)
        return x, y

    def between_nodes(self, values: F32, step: int) -> F32:
        """Interpolate float32[y, x] at `nodes_px` linearly to the pixels."""
        rows, columns = values.shape
        if step > 1:
            values = np.asarray(cv2.resize(values, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR))
        return np.ascontiguousarray(values[step : step + self.height_px, step : step + self.width_px])

    def real_lens(self, name: str) -> RealLens:
        """Return the camera's own lens if it is real and `name` is empty, else the named one, fitted to the camera.

        An empty name then stands for `DEFAULT_LENS`. The named lens is scaled to the camera's focal length, and its
        stop is closed to the camera's f-number where that is larger than its own.
        """
        own = self.lens
        if own.real is not None and not name:
            return own.real
        fitted = self._fitted(name)
        return _with_changes(fitted, self.changes) if self.changes else fitted

    def _fitted(self, name: str) -> RealLens:
        """Return a named lens fitted to the camera, without changes."""
        frame = replace(self, changes=()) if self.changes else self
        return _scaled(name or DEFAULT_LENS, self.lens.focal_length_mm, self.lens.f_number, frame)

    def prescription(self, name: str, coating: str) -> Prescription:
        """Return the prescription of `real_lens(name)` with a named coating on every surface between glass and air.

        With the coating `as_prescribed`, the coatings stay.
        """
        if coating == "as_prescribed":
            return self.real_lens(name).prescription
        changes = self.changes
        if self.lens.real is not None and not name:
            lens = self.lens.real.prescription
            changes = tuple(change for change in changes if change.quantity in OF_COATINGS)
        else:
            lens = self._fitted(name).prescription
        lens = _coated(lens, coating)
        return changed(lens, changes) if changes else lens

    def beams(self, name: str) -> Beams:
        """Return the beams of `real_lens(name)`, from the axis to slightly beyond the frame's corners."""
        slope = np.hypot(*self.slopes(np.array([0, self.width_px]), np.array([0, self.height_px])))
        lens = self.real_lens(name)
        return beams(lens.prescription, _MARGIN * float(slope.max()), lens.sensor_mm)


@file_contents.cached_with_contents(maxsize=8)
def _scaled(name: str, focal_length_mm: float, f_number: float, frame: ImageFrame) -> RealLens:
    """Return a packaged lens or a lens file fitted to a frame."""
    lens = scaled_to_focal_length(load_lens(name), focal_length_mm)
    return RealLens(
        prescription=stopped_down(lens, f_number),
        width_px=frame.width_px,
        height_px=frame.height_px,
        pixel_pitch_um=frame.pixel_pitch_um,
    )


@lru_cache(maxsize=4)
def _with_changes(lens: RealLens, changes: tuple[Change, ...]) -> RealLens:
    """Return a lens with a changed prescription."""
    return replace(lens, prescription=changed(lens.prescription, changes))


_coated = lru_cache(maxsize=8)(Prescription.coated)
