"""Write one sample as files that other programs open: EXR for radiance and truth, PNG for images, and JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.files.images import write_exr, write_png
from ..core.files.whole_files import own, write_json, writing
from ..core.quantities import Sample, soft_kind
from ..pipeline import masks
from ..pipeline.labels import strength
from ..pipeline.record import to_sample
from ..pipeline.spec import Frame
from . import contact_sheet
from .export.regions import flare_discs

_MARKED_GHOSTS = 10


def write_frame(frame: Frame, folder: Path) -> list[Path]:
    """Write one simulated frame to `folder` (made if missing) and return the paths of the files.

    - `sample.exr`: `radiance.<wavelength>nm` (W m⁻² sr⁻¹ nm⁻¹), `depth.Z` (m), `normal.X/Y/Z` (C frame),
      `semantic`, and how strongly each drawn fault acts (`straylight_added`, …).
    - `image.png`, `clean.png`, `without_<fault>.png`: RGB. The intensity channel of each is in
      `<name>_intensity.png`.
    - `mask_<fault>.png`, `mask_effect_<fault>.png`, `mask_any.png`.
    - `straylight_added.png`, `vignetting_factor.png`, `dust_opacity.png`: how strongly a drawn fault acts on each
      pixel, 255 for white or for 1; the numbers are in the EXR.
    - `annotated_<fault>.png`: the image with one class marked, see `annotated`.
    - `parameters.json`: every scalar of the dataset, null where it is not a finite number.

    Raises InputError if a file cannot be written.
    """
    sample = to_sample(frame)
    strengths = {
        fault.soft_layer: strength(fault, frame.injection)
        for name, fault in frame.spec.faults.items()
        if fault.soft_layer and (name in frame.drawn or fault.soft_layer in sample.layers)
    }
    with writing(folder, within=True):
        folder.mkdir(parents=True, exist_ok=True)
        files = [_write_exr(frame, strengths, own(folder / "sample.exr"))]
        for name, values in strengths.items():
            white = 255 if soft_kind(name).units == "1" else 1
            shown = np.clip(np.rint(values * white), 0, 255).astype(np.uint8)
            files.append(write_png(own(folder / f"{name}.png"), shown))
        for name, layer in sample.layers.items():
            if layer.ndim == 3 and layer.shape[-1] == 4:
                files.append(write_png(own(folder / f"{name}.png"), layer[..., :3]))
                files.append(write_png(own(folder / f"{name}_intensity.png"), layer[..., 3]))
        for layer_name, prefix in (("mask", "mask_"), ("mask_effect", "mask_effect_")):
            for fault, mask in zip(frame.spec.faults, sample.layers.get(layer_name, ()), strict=False):
                files.append(write_png(own(folder / f"{prefix}{fault}.png"), mask.astype(np.uint8) * 255))
        union = sample.layers["mask_any"].astype(np.uint8) * 255
        files.append(write_png(own(folder / "mask_any.png"), union))
        for name in frame.drawn:
            files.append(write_png(own(folder / f"annotated_{name}.png"), annotated(frame, name)))
        path = folder / "parameters.json"
        write_json(own(path), _scalars(sample))
    return [*files, path]


def annotated(frame: Frame, fault: str) -> NDArray[np.uint8]:
    """Return the image with one fault class marked by the outline of its mask, uint8[y, x, 3] R, G, B.

    For straylight, also draw the line from the Sun through the principal point, and the centre and radius of every
    flare or bright ghost.
    """
    names = list(frame.spec.faults)
    colour = contact_sheet.COLOURS[names.index(fault) % len(contact_sheet.COLOURS)]
    picture = np.ascontiguousarray(frame.images.image.array[..., :3])
    picture[masks.outline(frame.labels.masks[names.index(fault)])] = colour
    params, sun = frame.drawn[fault], frame.context.sun_xy_px
    marks = _marks(params, sun, frame.camera.width_px, frame.camera.height_px)
    if marks and sun is not None:
        centre = frame.camera.intrinsics[2:]

        def pixel(point: NDArray[np.float64]) -> tuple[int, int]:
            # pixel centres lie at +0.5 here and at 0 in OpenCV, which counts in 1/16 px with shift = 4
            return round(float(point[0] - 0.5) * 16), round(float(point[1] - 0.5) * 16)

        far = sun + 2.2 * (centre - sun)
        cv2.line(picture, pixel(sun), pixel(far), (255, 255, 255), 1, cv2.LINE_AA, 4)
        cv2.circle(picture, pixel(sun), 10 * 16, (255, 255, 255), 1, cv2.LINE_AA, 4)
        for name, middle, radius in marks:
            cv2.circle(picture, pixel(middle), round(radius * 16), colour, 1, cv2.LINE_AA, 4)
            x, y = (round(float(v) - 0.5) for v in middle)
            cv2.drawMarker(picture, (x, y), colour, cv2.MARKER_CROSS, 13, 1)
            cv2.putText(picture, name, (x + 8, y - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1)
    return picture


def _marks(
    params: Mapping[str, Any], sun: NDArray[np.float64] | None, width: int, height: int
) -> list[tuple[str, NDArray[np.float64], float]]:
    """Return name, position and radius in pixels of straylight's textures or of a lens's brightest ghosts.

    The radius of a ghost is that of a uniform disc with the same rms radius.
    """
    if sun is None:
        return []
    discs = flare_discs(params, sun, (height, width))
    named = zip((str(flare["index"]) for flare in params.get("flares", ())), discs, strict=False)  # not the glare
    marks = [(name, disc[:2], float(disc[2])) for name, disc in named]
    for ghost in params.get("ghosts", ())[:_MARKED_GHOSTS]:
        position = np.array([ghost["x_px"], ghost["y_px"]])
        if np.abs(position - np.array([width, height]) / 2).max() < width and ghost["rms_radius_px"] < width:
            marks.append(("-".join(map(str, ghost["pair"])), position, np.sqrt(2) * ghost["rms_radius_px"]))
    return marks


def _scalars(sample: Sample) -> dict[str, Any]:
    """Return the index and the scalars of a sample; arrays become flat lists."""
    flat = {n: v.ravel().tolist() if isinstance(v, np.ndarray) else v for n, v in sample.scalars.items()}
    return {"sample": sample.index, **flat}


def _write_exr(frame: Frame, strengths: Mapping[str, NDArray[Any]], path: Path) -> Path:
    """Write radiance, truth and the strengths of faults to one EXR file and return its path."""
    truth, radiance = frame.rendering.truth, frame.exposure.light.on_image
    channels: dict[str, NDArray[Any]] = {
        f"radiance.{wavelength:.1f}nm": np.ascontiguousarray(band)
        for wavelength, band in zip(radiance.wavelength_nm, radiance.array, strict=True)
    }
    channels["depth.Z"] = truth.depth_m
    normal = truth.normal.astype(np.float32)
    channels |= {f"normal.{axis}": np.ascontiguousarray(normal[..., k]) for k, axis in enumerate("XYZ")}
    channels["semantic"] = truth.semantic.astype(np.uint32)
    return write_exr(path, {**channels, **strengths})
