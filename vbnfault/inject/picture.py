"""Hold a user's image as electrons of a camera, and change its numbers where the electrons change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.errors import InputError
from ..core.quantities import LUMINANCE, RGBI, Electrons
from ..detector.demosaic import interpolate
from ..detector.interface import with_luminance
from ..detector.mosaic import channel_of
from ..scene.instrument import ImageTable
from .response import Response, read_table

F32 = NDArray[np.float32]

_COLOURS = ("R", "G", "B")


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """Hold an image of a camera.

    Attributes
    ----------
    numbers
        The image as given, [y, x] or [y, x, channel].
    electrons
        Electrons of each pixel and channel of the camera that its numbers stand for, not below 0.
    response
        How the numbers follow from light.
    camera
        Camera of the image.
    raw
        Whether the numbers are those of the sensor's mosaic.
    unrecoverable
        bool[y, x]: pixels at or above white, or at the lowest number.
    assumptions
        What was assumed of the response, a sentence each.
    """

    numbers: NDArray[Any]
    electrons: Electrons
    response: Response
    camera: Camera
    raw: bool
    unrecoverable: NDArray[np.bool_]
    assumptions: tuple[str, ...]

    @classmethod
    def of(cls, numbers: NDArray[Any], table: ImageTable, camera: Camera, *, raw: bool) -> Picture:
        """Return an image of a camera. Raises InputError if its channels do not fit the camera's."""
        detector = camera.detector
        if raw and (detector.mosaic is None or numbers.ndim != 2):
            what = "camera.detector names no sensor" if detector.mosaic is None else "it has several channels"
            raise InputError(f"image: cannot be a raw mosaic: {what}")
        response, assumptions = _response(numbers.dtype, table, camera, raw=raw)
        light = response.light(numbers)
        highest = np.iinfo(numbers.dtype).max if numbers.dtype.kind in "ui" else np.inf
        lost = (numbers >= min(response.white_dn, highest)) | (numbers <= np.minimum(0, response.black_dn))
        if numbers.ndim == 3:
            lost = lost.any(axis=2)
        planes = _unmixed(light, camera) if raw else _to_camera(light, camera)
        white = detector.white_e
        electrons = (np.maximum(planes, 0) * white).astype(np.float32)
        return cls(
            numbers=numbers,
            electrons=Electrons(array=electrons, white_e=white),
            response=response,
            camera=camera,
            raw=raw,
            unrecoverable=lost,
            assumptions=assumptions,
        )

    def with_change(self, change_e: F32) -> NDArray[Any]:
        """Return the numbers with a change of electrons, float32[y, x, channel]; others stay as they are."""
        fraction = change_e / self.camera.detector.white_e
        if self.raw:
            own = channel_of(self.camera.mosaic.sensor.pattern, fraction.shape[:2])
            change = np.take_along_axis(fraction, own[..., None].astype(np.intp), 2)[..., 0]
        else:
            change = _to_image(fraction, self.camera, 1 if self.numbers.ndim == 2 else self.numbers.shape[2])
            change = change.reshape(self.numbers.shape)
        changed = change != 0
        out = self.numbers.copy()
        out[changed] = self._rounded(
            self.response.numbers(self.response.light(self.numbers[changed]) + change[changed])
        )
        return out

    def spread(self, change_e: F32) -> F32:
        """Return a change of the mosaic's electrons, float32[y, x], as that of all channels, [y, x, channel]."""
        pattern = self.camera.mosaic.sensor.pattern
        return np.stack([interpolate(change_e, pattern, name) for name in pattern.channels], axis=-1)

    def with_levels(self, numbers: NDArray[Any], before: RGBI, after: RGBI) -> NDArray[Any]:
        """Return numbers with the change of an image of 8 bits.

        A level of 0 or 255 becomes black or white; elsewhere the difference of the levels is added, so that numbers
        of more bits keep their last digits.
        """
        channels = 1 if numbers.ndim == 2 else numbers.shape[2]
        pick = [3] if channels == 1 else list(range(channels))
        old, new = (x.array[..., pick].reshape(numbers.shape).astype(np.float64) for x in (before, after))
        step = (self.response.white_dn - self.response.black_dn) / 255
        moved = numbers.astype(np.float64) + (new - old) * step
        moved = np.where(new == 0, self.response.black_dn, np.where(new == 255, self.response.white_dn, moved))
        out = numbers.copy()
        changed = new != old
        out[changed] = self._rounded(moved[changed])
        return out

    def _rounded(self, values: NDArray[np.float64]) -> NDArray[Any]:
        """Return values in the data type of the image: whole numbers rounded, clipped to white and the range."""
        dtype = self.numbers.dtype
        if dtype.kind == "f":
            return values.astype(dtype)
        limits = np.iinfo(dtype)
        return np.clip(np.rint(values), limits.min, min(self.response.white_dn, limits.max)).astype(dtype)


def levels(numbers: NDArray[Any], response: Response) -> NDArray[np.uint8]:
    """Return numbers as an image of 8 bits, uint8[y, x, 4] with R, G, B and I."""
    code = 255 * (numbers.astype(np.float64) - response.black_dn) / (response.white_dn - response.black_dn)
    eight = np.atleast_3d(np.clip(np.rint(code), 0, 255).astype(np.uint8))
    if eight.shape[2] == 1:
        eight = np.repeat(eight, 4, axis=2)
    elif eight.shape[2] == 3:
        eight = with_luminance(eight)
    return np.ascontiguousarray(eight)


def _response(
    dtype: np.dtype[Any], table: ImageTable, camera: Camera, *, raw: bool
) -> tuple[Response, tuple[str, ...]]:
    """Return the response of an image, and what was assumed of it."""
    assumed = []
    black, white = table.black_dn, table.white_dn
    if raw:
        readout = camera.mosaic.sensor.readout
        default_black = float(readout.bias_dn)
        default_white = default_black + readout.system_gain_dn_per_e * readout.white_e
    else:
        default_black, default_white = 0.0, float(np.iinfo(dtype).max) if dtype.kind in "ui" else 1.0
    if black is None:
        black = default_black
        assumed.append(f"image.black_dn = {black:g}: " + ("the sensor's bias" if raw else "assumed"))
    if white is None:
        white = default_white
        assumed.append(f"image.white_dn = {white:g}: " + ("the sensor's white" if raw else "assumed"))
    if "response" not in table.model_fields_set:
        assumed.append("image.response = 'linear': assumed")
    if white <= black:
        raise InputError(f"image.white_dn = {white:g}: must be above image.black_dn = {black:g}")
    curve = None if table.response != "table" else read_table(table.response_file)
    return (
        Response(black_dn=black, white_dn=white, curve=table.response, gamma=table.gamma, table=curve),
        tuple(assumed),
    )


def _to_camera(light: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return the light of an image in the camera's channels, [y, x, channel]."""
    channels, planes = camera.detector.channels, np.atleast_3d(light)
    given = planes.shape[2]
    if given == 1:
        return np.repeat(planes, len(channels), axis=2)
    if channels == ("W",):
        raise InputError(f"image: has {given} channels, but camera.detector {camera.detector.name} sees no colours")
    white = planes[..., 3] if given == 4 else planes[..., :3] @ LUMINANCE.astype(np.float64)
    return np.stack([planes[..., _COLOURS.index(c)] if c in _COLOURS else white for c in channels], axis=-1)


def _to_image(light: F32, camera: Camera, count: int) -> F32:
    """Return light in the camera's channels as that of an image with 1, 3 or 4 channels, [y, x, channel]."""
    channels = camera.detector.channels
    planes = {name: light[..., k] for k, name in enumerate(channels)}
    if "W" in planes:
        intensity = planes["W"]
    else:
        intensity = sum(w * planes[c] for c, w in zip(_COLOURS, LUMINANCE, strict=True))  # type: ignore[assignment]
    colours = [planes.get(c, intensity) for c in _COLOURS]
    return np.stack({1: [intensity], 3: colours, 4: [*colours, intensity]}[count], axis=-1)


def _unmixed(light: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return the light of a raw mosaic in all channels: its own where it was seen, elsewhere interpolated.

    The numbers of a channel are those without white balance, so white is that of the sensor for all of them.
    """
    pattern, detector = camera.mosaic.sensor.pattern, camera.detector
    balance = detector.white_e.max() / detector.white_e
    plane = light.astype(np.float32)
    own = channel_of(pattern, plane.shape)
    out = np.stack([interpolate(plane, pattern, name) for name in pattern.channels], axis=-1).astype(np.float64)
    np.put_along_axis(out, own[..., None].astype(np.intp), light[..., None], axis=2)
    return out * balance
