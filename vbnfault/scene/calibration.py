"""Define the table `[camera.calibration]` of a scene file: a calibrated camera, in numbers or from a file."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal

from pydantic import Field, model_validator

from ..core.calibration import COEFFICIENTS, LIMITS, Calibration
from ..core.errors import InputError
from ..core.tables import Table

_POINT = ("fx", "fy", "cx", "cy")
_MOST_PX = 1_000_000


def _number(key: str, text: str, default: float | None = 0.0) -> Any:
    """Return the field of a number of a calibration, within its limits."""
    low, high = LIMITS[key]
    return Field(default, ge=low, le=high, description=text)


class CalibrationTable(Table):
    """Give the camera the rays of a calibration; the lens stays a thin one, with its blur and its f-number."""

    file: str = Field(
        "",
        description="camera_info YAML of ROS, camchain YAML of Kalibr, FileStorage of OpenCV, COLMAP's cameras.txt",
    )
    camera: str = Field("", description="which camera of a file of several, such as cam1")
    model: Literal["", "opencv", "fisheye", "brown_conrady"] = Field(
        "", description="of the numbers below, or of an OpenCV file that does not state it; default: opencv"
    )
    sense: Literal["", "distorting", "undistorting"] = Field(
        "",
        description="of brown_conrady: whether its polynomial takes directions to the image, as OpenCV's does, or "
        "the image to directions",
    )
    scale_to_frame: bool = Field(
        False, description="whether to scale the calibration of another image size of the same shape to the frame"
    )
    width_px: int | None = Field(
        None, ge=1, le=_MOST_PX, description="width of the calibrated image; default: the frame's"
    )
    height_px: int | None = Field(
        None, ge=1, le=_MOST_PX, description="height of the calibrated image; default: the frame's"
    )
    origin: Literal["pixel_centre", "pixel_corner"] = Field(
        "pixel_centre",
        description="where cx and cy are 0: at the centre of the first pixel, as for OpenCV, ROS and Kalibr, or at "
        "its corner, as for COLMAP and the arrays of a dataset",
    )
    fx: float | None = _number("fx", "focal length across in px", None)
    fy: float | None = _number("fy", "focal length down in px; default: fx", None)
    cx: float | None = _number("cx", "principal point in px", None)
    cy: float | None = _number("cy", "principal point in px", None)
    circle_deg: float | None = _number(
        "circle_deg",
        "full angle of the image circle, beyond which the frame is dark; default: all of it is lit",
        None,
    )
    skew: float = _number("skew", "shift to the right for a step of one focal length down, in px")
    k1: float = _number("k1", "radial, of r² (of a fisheye: of θ³)")
    k2: float = _number("k2", "radial, of r⁴ (θ⁵)")
    k3: float = _number("k3", "radial, of r⁶ (θ⁷)")
    k4: float = _number("k4", "radial, of r² in the denominator (of a fisheye: of θ⁹)")
    k5: float = _number("k5", "radial, of r⁴ in the denominator")
    k6: float = _number("k6", "radial, of r⁶ in the denominator")
    p1: float = _number("p1", "tangential, OpenCV's: 2 p1 x y across")
    p2: float = _number("p2", "tangential, OpenCV's: p2 (r² + 2 x²) across")
    s1: float = _number("s1", "thin prism, of r² across")
    s2: float = _number("s2", "thin prism, of r⁴ across")
    s3: float = _number("s3", "thin prism, of r² down")
    s4: float = _number("s4", "thin prism, of r⁴ down")
    tau_x: float = _number("tau_x", "tilt of the sensor about x, in rad")
    tau_y: float = _number("tau_y", "tilt of the sensor about y, in rad")

    @model_validator(mode="after")
    def _whole(self) -> CalibrationTable:
        given = self.model_fields_set
        if self.file:
            for key in ("sense", "origin", *_POINT, "skew", *COEFFICIENTS["opencv"]):
                if key in given and getattr(self, key) != type(self).model_fields[key].default:
                    raise ValueError(f"{key}: comes from the file; leave it or file out")
            if (self.width_px is None) != (self.height_px is None):
                raise ValueError("width_px, height_px: give both or none")
            return self
        if self.camera:
            raise ValueError(f"camera = {self.camera!r}: chooses a camera of a file; needs file")
        for key in ("fx", "cx", "cy"):
            if getattr(self, key) is None:
                raise ValueError(f"{key}: is missing; give fx, cx and cy, or file")
        if (self.model == "brown_conrady") != bool(self.sense):
            raise ValueError(
                f"sense = {self.sense!r}: must be distorting or undistorting with model = 'brown_conrady', and "
                "left out with another model"
            )
        known = COEFFICIENTS[self.of_lens]
        for key in COEFFICIENTS["opencv"]:
            if key not in known and getattr(self, key):
                raise ValueError(f"{key} = {getattr(self, key):g}: the model {self.of_lens} has {', '.join(known)}")
        return self

    @property
    def of_lens(self) -> str:
        """Return the name of the model that `lens.Calibration` has for it."""
        return (
            "undistorting" if self.sense == "undistorting" else self.model.replace("brown_conrady", "") or "opencv"
        )

    def calibration(self, width_px: int, height_px: int) -> Calibration:
        """Return the calibration as it is; `width_px` and `height_px` are the frame's. Raises InputError."""
        if self.file:
            size = None if self.width_px is None or self.height_px is None else (self.width_px, self.height_px)
            model = self.of_lens if self.model else ""
            found = Calibration.read(self.file, camera=self.camera, model=model, size_px=size)
            return replace(found, circle_deg=self.circle_deg)
        fx, cx, cy = (float(getattr(self, key)) for key in ("fx", "cx", "cy"))
        shift = 0.5 if self.origin == "pixel_centre" else 0.0
        return Calibration(
            model=self.of_lens,
            width_px=width_px if self.width_px is None else self.width_px,
            height_px=height_px if self.height_px is None else self.height_px,
            fx=fx,
            fy=fx if self.fy is None else self.fy,
            cx=cx + shift,
            cy=cy + shift,
            skew=self.skew,
            circle_deg=self.circle_deg,
            coefficients=tuple(getattr(self, key) for key in COEFFICIENTS[self.of_lens]),
        )

    def in_numbers(self, width_px: int, height_px: int) -> CalibrationTable:
        """Return the table with the numbers of its file, so that a scene does not depend on the file's name."""
        found = self.calibration(width_px, height_px)
        undistorting = found.model == "undistorting"
        return CalibrationTable(
            model="brown_conrady" if undistorting else found.model,  # type: ignore[arg-type]
            sense="undistorting" if undistorting else "",
            scale_to_frame=self.scale_to_frame,
            width_px=found.width_px,
            height_px=found.height_px,
            origin="pixel_corner",
            fx=found.fx,
            fy=found.fy,
            cx=found.cx,
            cy=found.cy,
            skew=found.skew,
            circle_deg=found.circle_deg,
            **dict(zip(COEFFICIENTS[found.model], found.coefficients, strict=True)),
        )


@lru_cache(maxsize=16)
def of_frame(table: CalibrationTable, width_px: int, height_px: int) -> Calibration:
    """Return the calibration of a frame. Raises InputError for another size, and if it folds inside the frame."""
    found = table.calibration(width_px, height_px)
    if (found.width_px, found.height_px) != (width_px, height_px):
        if not table.scale_to_frame:
            raise InputError(
                f"is of an image of {found.width_px} x {found.height_px} px, and the camera has {width_px} x "
                f"{height_px} px; set scale_to_frame = true if the camera bins or scales that image, or change "
                "camera.width_px and height_px"
            )
        found = found.scaled_to(width_px, height_px)
    return found.checked()
