"""Hold a user's image as electrons of a camera, and change its numbers where the electrons change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.errors import InputError
from ..core.process.llvm import backend, empty, evaluated, flat, on_device
from ..core.quantities import LUMINANCE, RGBI, Electrons
from ..detector.demosaic import interpolate
from ..detector.mosaic import channel_of, sample
from ..detector.noise import draw_normals, normal_field, poisson
from ..detector.three_colour import compiled_with_luminance
from ..scene.instrument import ImageTable
from .response import Response, read_table

F32 = NDArray[np.float32]

_COLOURS = ("R", "G", "B")
# The search for the light that an image shows takes so many steps at most, and ends with one that changes it by
# less than this over white
_STEPS, _NEAR = 8, 1e-4
# Where black lies above 0, each number stands for at least this light over white. A fault that dims it changes it,
# so that a pixel at black gets the noise of that fault, too.
_FAINT = np.float32(1e-9)


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """Hold an image of a camera.

    Attributes
    ----------
    numbers
        The image as given, [y, x] or [y, x, channel].
    light
        Light that the numbers stand for over that of white, float32[y, x, channel of the image], not below 0.
    white_e
        Electrons at white, float32[channel of the image]. Grey images and raw mosaics have one channel, whose white
        is the full well over the gain.
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
    light: F32
    white_e: F32
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
        if numbers.ndim == 3 and detector.channels == ("W",):
            raise InputError(
                f"image: has {numbers.shape[2]} channels, but camera.detector {detector.name} sees no colours"
            )
        response, assumptions = _response(numbers.dtype, table, camera, raw=raw)
        top = min(response.white_dn, np.iinfo(numbers.dtype).max if numbers.dtype.kind in "ui" else np.inf)
        bottom = min(0, response.black_dn)
        lost = response.of_image(numbers, lambda n: ((n >= top) | (n <= bottom)).astype(np.uint8))
        least = _FAINT if response.black_dn > 0 else np.float32(0)
        light = response.of_image(numbers, lambda n: np.maximum(response.shown(n), least))
        light = np.atleast_3d(light)
        return cls(
            numbers=numbers,
            light=light,
            white_e=_white_e(light.shape[2], camera),
            response=response,
            camera=camera,
            raw=raw,
            unrecoverable=np.asarray(reduce(np.maximum, cv2.split(lost))).view(np.bool_),
            assumptions=assumptions,
        )

    @cached_property
    def below(self) -> F32 | None:
        """Return how far numbers lie below black, as light over that of white; None if none does.

        It is float32[y, x, channel of the image], not above 0: noise, which faults dim and blur with the light.
        """
        if self.numbers.dtype.kind == "u" and self.response.black_dn <= 0:
            return None
        below = self.response.of_image(self.numbers, lambda n: np.minimum(self.response.shown(n), 0))
        return np.atleast_3d(below) if below.any() else None

    @cached_property
    def electrons(self) -> Electrons:
        """Return the electrons of each pixel and channel of the camera whose light the numbers show.

        The numbers have passed the sensor, so what smear and measured responses made of the light is taken back:
        light that the sensor's model lacks or has too much is added or taken until the model makes the numbers
        (Landweber 1951, Am. J. Math. 73, 615), never below 0.
        """
        seen = self.seen(self.light)
        light, near_e = seen.array, _NEAR * float(seen.white_e.max())
        for _ in range(_STEPS if self.camera.detector.mosaic is not None else 0):
            made = self._collected(light)
            step = min(float(light.sum() / max(made.sum(), near_e)), 1.0)
            nearer = cv2.max(light + (seen.array - made) * np.float32(step), 0).reshape(light.shape)
            far_e, light = cv2.norm(nearer, light, cv2.NORM_INF), nearer
            if far_e <= near_e:
                break
        return seen.with_array(light)

    def collected(self, light_e: F32) -> F32:
        """Return light on the camera's channels as the image shows it, float32[y, x, channel of the image]."""
        return self.in_image(light_e if self.camera.detector.mosaic is None else self._collected(light_e))

    def _collected(self, light_e: F32) -> F32:
        """Return light as the pixels of the sensor collect it, float32[y, x, channel], others between them."""
        mosaic = self.camera.mosaic
        falls = sample(light_e, mosaic.sensor.pattern)
        beyond = mosaic.device.light_e(falls, self.camera.exposure_s) - falls
        return light_e + self.spread(beyond) if beyond.any() else light_e

    def seen(self, light: F32) -> Electrons:
        """Return light of the image, [y, x, channel of the image], as electrons of the camera's channels."""
        white = self.camera.detector.white_e
        if self.raw:
            return Electrons(array=self.spread(light[..., 0] * white.max()), white_e=white)
        mixed = cv2.transform(light, white[:, None] * self._mixing[0]).reshape(*light.shape[:2], len(white))
        return Electrons(array=mixed, white_e=white)

    def in_image(self, change_e: F32) -> F32:
        """Return a change of the camera's electrons as one of the image's light, float32[y, x, channel]."""
        if self.raw:
            return sample(change_e, self.camera.mosaic.sensor.pattern)[..., None] / self.white_e
        out = empty(self.light.shape)
        cv2.transform(change_e, self._mixing[1] / self.camera.detector.white_e, out)
        return out

    @cached_property
    def _mixing(self) -> tuple[F32, F32]:
        """Return the matrices from the image's channels to the camera's and back, for light over white."""
        return _mixing(self.light.shape[2], self.camera.detector.channels)

    def with_change(self, change: F32) -> NDArray[Any]:
        """Return the numbers with a change of light, float32[y, x, channel]; others stay as they are."""
        numbers, response = self.numbers, self.response
        change = change.reshape(numbers.shape)
        if numbers.dtype in (np.uint8, np.uint16) and response.table is None:
            be, moved = backend(), on_device(change)
            light = on_device(response.light(np.arange(np.iinfo(numbers.dtype).max + 1)))
            kind, wide = (be.UInt8, np.uint8) if numbers.dtype == np.uint8 else (be.UInt32, np.uint32)
            code = be.UInt32(kind(flat(numbers.astype(wide, copy=False))))
            value = be.dr.round(response.numbers(be.dr.gather(be.Float, light, code) + moved, be.dr))
            value = be.dr.select(moved != 0, be.dr.clip(value, 0, self._top_dn), be.Float(code))
            return evaluated(kind(value)).astype(numbers.dtype).reshape(numbers.shape)
        changed = change != 0
        out = numbers.copy()
        out[changed] = self._rounded(response.numbers(response.light(numbers[changed]) + change[changed]))
        return out

    def exposed(self, table: ImageTable, rng: Callable[[str, str], np.random.Generator]) -> Picture:
        """Return a noise-free image as the camera takes it; only the light that saturates it is unrecoverable.

        The light has the noise of its electrons, and the readout adds its own; `rng` returns the generator for
        (stage, name).
        """
        shape = self.light.shape
        electrons = poisson(self.light * self.white_e, draw_normals(shape, rng("inject", "shot")))
        electrons += self.camera.detector.read_noise_e_rms * normal_field(shape, rng("inject", "readout"))
        light = np.minimum(electrons / self.white_e, 1).reshape(self.numbers.shape)
        taken = Picture.of(self._rounded(self.response.numbers(light)), table, self.camera, raw=self.raw)
        return replace(taken, unrecoverable=taken.light.max(axis=2) >= 1)

    def spread(self, mosaic_e: F32) -> F32:
        """Return electrons of the mosaic, float32[y, x], in all channels, [y, x, channel]; their own stay exact."""
        pattern = self.camera.mosaic.sensor.pattern
        if len(pattern.channels) == 1:
            return mosaic_e[..., None]
        planes = np.stack([interpolate(mosaic_e, pattern, name) for name in pattern.channels], axis=-1)
        own = channel_of(pattern, mosaic_e.shape)[..., None].astype(np.intp)
        np.put_along_axis(planes, own, mosaic_e[..., None], axis=2)
        return planes

    def with_levels(self, numbers: NDArray[Any], before: RGBI, after: RGBI) -> NDArray[Any]:
        """Return numbers with the change of an image of 8 bits.

        A level of 0 or 255 becomes black or white; elsewhere the difference of the levels is added, so that numbers
        of more bits keep their last digits.
        """
        channels = 1 if numbers.ndim == 2 else numbers.shape[2]
        first = 3 if channels == 1 else 0  # grey is the intensity, which stands behind the colours
        pixels = np.flatnonzero(before.array.view(np.uint32) != after.array.view(np.uint32))
        old, new = (x.array.reshape(-1, 4)[pixels, first : first + channels] for x in (before, after))
        out = numbers.copy()
        rows = out.reshape(-1, channels)
        step = (self.response.white_dn - self.response.black_dn) / 255
        moved = rows[pixels] + (new.astype(np.float64) - old) * step
        moved = np.select([new == 0, new == 255], [self.response.black_dn, self.response.white_dn], moved)
        rows[pixels] = np.where(new == old, rows[pixels], self._rounded(moved))
        return out

    def _rounded(self, values: NDArray[np.float64]) -> NDArray[Any]:
        """Return values in the data type of the image: whole numbers rounded, clipped to white or the top code."""
        dtype = self.numbers.dtype
        if dtype.kind == "f":
            return values.astype(dtype)
        return np.clip(np.rint(values), np.iinfo(dtype).min, self._top_dn).astype(dtype)

    @cached_property
    def _top_dn(self) -> float:
        """Return the highest whole number: white, or that of a mosaic's converter, if the type holds it."""
        top = self.response.white_dn
        if self.raw:  # in proportion, where the numbers are not those of the sensor's own converter
            readout, black = self.camera.mosaic.sensor.readout, self.response.black_dn
            white = readout.system_gain_dn_per_e * readout.white_e
            top = black + (readout.top_dn - readout.bias_dn) * (top - black) / white
        return float(min(np.rint(top), np.iinfo(self.numbers.dtype).max))


def levels(numbers: NDArray[Any], response: Response) -> NDArray[np.uint8]:
    """Return numbers as an image of 8 bits, uint8[y, x, 4] with R, G, B and I."""
    eight = np.atleast_3d(response.of_image(numbers, response.levels))
    if eight.shape[2] == 1:
        eight = cv2.merge([eight] * 4)
    elif eight.shape[2] == 3:
        eight = compiled_with_luminance(eight)
    return np.ascontiguousarray(eight)


def check_levels(black_dn: float, white_dn: float) -> None:
    """Raise InputError unless white is above black."""
    if white_dn <= black_dn:
        raise InputError(f"image.white_dn = {white_dn:g}: must be above image.black_dn = {black_dn:g}")


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
    check_levels(black, white)
    largest = np.iinfo(dtype).max if dtype.kind in "ui" else np.inf
    if white > largest:
        raise InputError(f"image.white_dn = {white:g}: must be at most {largest}, the largest number of this image")
    curve = None if table.response != "table" else read_table(table.response_file)
    return (
        Response(black_dn=black, white_dn=white, curve=table.response, gamma=table.gamma, table=curve),
        tuple(assumed),
    )


def _white_e(channels: int, camera: Camera) -> F32:
    """Return the electrons at white of an image's channels, float32[channel]."""
    white = dict(zip(camera.detector.channels, camera.detector.white_e, strict=True))
    full = camera.detector.white_e.max()
    colours = [white.get(colour, full) for colour in _COLOURS]
    return np.array({1: [full], 3: colours, 4: [*colours, white.get("W", full)]}[channels], dtype=np.float32)


def _mixing(count: int, channels: tuple[str, ...]) -> tuple[F32, F32]:
    """Return the matrices from an image's channels to a camera's and back, for light over white.

    A grey image has the luminance of the colours, or what pixels without a filter see.
    """
    image = {1: ["I"], 3: list(_COLOURS), 4: [*_COLOURS, "I"]}[count]
    grey = [float(c == "W") for c in channels] if "W" in channels else LUMINANCE.tolist()
    back = [grey if c not in channels else [float(c == k) for k in channels] for c in image]
    if count == 1:
        return np.ones((len(channels), 1), np.float32), np.array(back, np.float32)
    luminance = [float(c == "I") for c in image] if count == 4 else LUMINANCE.tolist()
    forth = [luminance if c == "W" else [float(c == k) for k in image] for c in channels]
    return np.array(forth, np.float32), np.array(back, np.float32)
