"""Compute the numbers of an image that faults struck, with the noise that their change of the light has.

An image holds noise already: N electrons in a pixel where λ were expected. A fault that lets the fraction t of the
light through leaves a mean of t λ, and the variance must be t λ plus that of the readout, σ². Scaling the image
alone leaves t² (λ + σ²). What is missing is t (1 - t) λ + (1 - t²) σ²: the variance of the thinning of N, and of
the readout. So the noise that is added has, in each pixel, the variance

    S' + σ² - v

where S' are the electrons after the fault and v is the variance that the fault leaves of the image's own noise. It
is measured: the same draws act on the image with a small perturbation of known variance. Light that a fault adds
gets its own shot noise in this way, and light that it leaves alone none. A pixel that no fault changes keeps its
number. Where the camera names its sensor, changed light passes through this, too: it smears and overflows as the
sensor's charge does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.process.llvm import backend, empty, evaluated, flat, on_device
from ..core.quantities import RGBI, Electrons
from ..detector.mosaic import sample
from ..detector.noise import codes_on_device, draw_normals, poisson, poisson_of_codes, poisson_quantile
from ..faults import MOSAIC_STEPS
from ..pipeline.development import Development, Draws, acting_at
from .picture import Picture, levels

F32 = NDArray[np.float32]
Rng = Callable[[str, str], np.random.Generator]

# Pixels over which the variance of noise that a fault mixes is averaged, and fraction of them whose perturbation
# must have changed its sign for that
_NEARBY_PX, _MIXED = 15, 0.01


def struck(
    picture: Picture, development: Development, draws: Draws, of: Callable[[Electrons], Development]
) -> tuple[NDArray[Any], F32 | None]:
    """Return the numbers of an image with the drawn faults, and its electrons, float32[y, x, channel].

    The electrons are None where a fault acts inside the sensor or on the finished image. `of` returns the same
    development of other electrons.
    """
    rng = development.rng
    before, optical = picture.electrons, acting_at(draws, "electrons")
    inside, on_image = any(acting_at(draws, step) for step in MOSAIC_STEPS), bool(acting_at(draws, "rgbi"))
    through_sensor = inside or (bool(optical) and development.exposure.camera.detector.mosaic is not None)
    if optical:
        shared = after = development.signal(draws, optical).merged.array
        change = picture.in_image(after - before.array)

        def moved(more: Electrons) -> F32:
            """Return what the faults make of more light, float32[y, x, channel]."""
            light = before.with_array(cv2.add(before.array, more.array).reshape(shared.shape))
            made = of(light).signal(draws, optical).merged.array
            return cv2.subtract(made, shared).reshape(shared.shape)

        below = None if picture.below is None else picture.seen(picture.below)
        of_below = None if below is None else picture.in_image(moved(below) - below.array)
        seen = change if of_below is None else change + of_below
        noise = _missing_noise(picture, seen, picture.collected(after), moved, rng)
        if (through_sensor or not on_image) and noise.any():
            after = after + picture.seen(noise).array
        change = np.add(change, noise, out=noise)
    else:
        after, change, of_below = before.array, np.zeros_like(picture.light), None
    if through_sensor:
        change = picture.in_image(_through_sensor(picture, development, draws, after, rng))
    numbers = picture.with_change(change if of_below is None else change + of_below)
    if on_image:
        shown = RGBI(array=levels(numbers, picture.response))
        numbers = picture.with_levels(numbers, shown, development.read_out(shown, draws))
    return numbers, None if inside or on_image else after


def _missing_noise(picture: Picture, change: F32, after: F32, act: Callable[[Electrons], F32], rng: Rng) -> F32:
    """Return the noise of the light that faults took away or added, over white, float32[y, x, channel].

    `after` is the light that the pixels collect with the faults, as the image would show it; `act` returns what
    the faults make of more electrons in the image.
    """
    if not change.any():
        return np.zeros_like(change)
    be, shape = backend(), change.shape
    dr, normal = be.dr, draw_normals(shape, rng("inject", "noise"))
    code = codes_on_device(normal)(dr.arange(be.UInt32, change.size))
    white = dr.tile(on_device(picture.white_e), change.size // len(picture.white_e))
    read2 = dr.opaque(be.Float, picture.camera.detector.read_noise_e_rms**2)
    light, moved = on_device(picture.light), on_device(change)
    # the lowest bit of a variate's number says nothing of its size, and serves as the sign of the perturbation
    signs = be.Float(1 - 2 * be.Int32(code & 1))
    probe = evaluated(dr.sqrt(light * white + read2) / white * signs).reshape(shape)
    left = on_device(picture.in_image(act(picture.seen(probe)))) * white
    variance = left * left
    # a fault that acts on each pixel alone keeps the signs; a blur mixes them, and its variance varies slowly
    turned = be.UInt8(dr.select(left * signs < 0, be.UInt32(255), be.UInt32(0)))
    dr.eval(variance, turned)
    if evaluated(turned).any():
        near, smooth = (
            cv2.blur(evaluated(of).reshape(shape), (_NEARBY_PX, _NEARBY_PX), empty(shape, kind))
            for of, kind in ((turned, np.uint8), (variance, np.float32))
        )
        mixed = be.UInt8(flat(near)) > round(255 * _MIXED)
        variance = dr.select(mixed, on_device(smooth), variance)
    missing = dr.maximum(dr.maximum(on_device(after), 0) * white + read2 - variance, 0)
    noise = dr.select(moved != 0, (poisson_of_codes(missing, code) - missing) / white, 0)
    dr.eval(noise, missing)
    out = evaluated(noise)
    # the outermost numbers stand for variates of their own
    tail = be.UInt32(normal.tail.astype(np.uint32))
    mean, per_e = (dr.gather(be.Float, of, tail).numpy() for of in (missing, dr.select(moved != 0, 1 / white, 0)))
    out[normal.tail] = (poisson_quantile(mean, normal.tail_values) - mean) * per_e
    return out.reshape(shape)


def _through_sensor(picture: Picture, development: Development, draws: Draws, after: F32, rng: Rng) -> F32:
    """Return the change of electrons, float32[y, x, channel], where faults act inside the sensor, too.

    The noise-free sensor takes the image with and without the faults, so that what both share cancels. Charge that
    a fault adds gets its shot noise.
    """
    plain, sensor = development.exposure.camera.mosaic, development.camera_with(draws).mosaic
    exposure_s, acts = development.exposure.camera.exposure_s, development.acts(draws)
    struck_light = picture.electrons.with_array(np.maximum(after, 0).astype(np.float32))
    without = development.raw({}, noisy=False).astype(np.float32)
    if acting_at(draws, "electrons"):  # the light has noise of its own
        with_it = sensor.raw(struck_light, exposure_s, None, acts).astype(np.float32)
    else:
        with_it = development.raw(draws, noisy=False).astype(np.float32)
    light = sample(struck_light.array, sensor.sensor.pattern)
    change = (with_it - without) / np.float32(plain.sensor.readout.system_gain_dn_per_e)
    if acts["light"]:  # the only step at which faults change the charge that is expected
        added = sensor.device.expected_e(light, exposure_s, acts) - sensor.device.expected_e(light, exposure_s)
        added = np.maximum(added, 0).astype(np.float32)
        change += poisson(added, draw_normals(added.shape, rng("inject", "charge"))) - added
    # the difference lacks what the plain sensor adds to the image, but a saturated pixel is white
    seen = picture.seen(picture.light)
    room = sample(seen.white_e - seen.array, sensor.sensor.pattern)
    full = (with_it >= sensor.device.saturated_dn) & (with_it != without)
    # light that the sensor only lets through keeps its place; what the sensor makes of it beyond is interpolated
    passed = sample(struck_light.array - picture.electrons.array, sensor.sensor.pattern)
    beyond = np.where(full, np.maximum(change, room), change) - passed
    return after - picture.electrons.array + picture.spread(beyond)
