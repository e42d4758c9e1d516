"""Compute the images of one exposure with any set of its drawn faults.

All images share radiance, exposure and noise, so they differ by the faults alone. Results that several images share
are computed once. They are kept by the draws that they depend on, each identified by its fault class and attempt.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import buffers
from ..core.quantities import RGBI, Electrons
from ..detector.blocks import pool
from ..faults import MOSAIC_STEPS, Fault, FaultContext, act, physical_order
from . import masks
from .spec import Draw, SceneExposure

Draws = Mapping[str, Draw]
Keys = tuple[tuple[str, int], ...]
Mask = NDArray[np.bool_]

# Of the pixels. Above these fractions it takes longer to choose pixels than to develop all of them.
_MOST_CHANGED = 0.6
_MOST_CHANGED_NOISE_FREE = 0.4

# Their light, noise and image stay in the cache.
_PIXELS_AT_ONCE = 1 << 15


def acting_at(draws: Draws, step: str) -> list[str]:
    """Return the drawn faults that act at a step, in physical order."""
    return [name for name in physical_order(draws) if step in draws[name].fault.steps]


def without(draws: Draws, left_out: str) -> dict[str, Draw]:
    """Return the draws without those of one fault."""
    return {name: draw for name, draw in draws.items() if name != left_out}


def _keys(draws: Draws, names: Iterable[str]) -> Keys:
    """Return the keys of some draws."""
    return tuple(draws[name].key for name in names)


class Development:
    """Develop images of one exposure, each with its own set of drawn faults.

    Parameters
    ----------
    exposure
        Camera and light.
    context
        The sample as its faults see it, before a fault informs others.
    rng
        Function that returns the random generator of the sample for (stage, name).
    twins
        Classes without which an image will be taken: the light of these twins is kept.

    All methods take the draws by fault class. Two draws with equal keys must be the same draw.
    """

    def __init__(
        self,
        *,
        exposure: SceneExposure,
        context: FaultContext,
        rng: Callable[[str, str], np.random.Generator],
        twins: Collection[str] = (),
    ) -> None:
        self.exposure = exposure
        self.context = context
        self._rng, self._twins = rng, twins
        self._cameras: dict[Keys, Camera] = {(): exposure.camera}
        self._contexts: dict[Keys, FaultContext] = {(): context}
        self._signals: dict[Any, Electrons] = {}
        self._images: dict[Any, RGBI] = {}
        self._raws: dict[Any, NDArray[np.uint16]] = {}
        self._effects: dict[Any, Mask] = {}
        self._differences: dict[Any, NDArray[np.intp]] = {}

    @cached_property
    def noise(self) -> Any:
        """Return the variates of the exposure, which all its images share."""
        return self.exposure.camera.detector.draw_noise(
            self.context.shape, lambda name: self._rng("detector", name)
        )

    # --- camera and context ----------------------------------------------------------------------------------

    def camera_with(self, draws: Draws) -> Camera:
        """Return the camera as the drawn faults alter it."""
        altering = _altering(draws)
        key = _keys(draws, altering)
        if key not in self._cameras:
            camera = self.exposure.camera
            for name in altering:
                camera = draws[name].fault.alter(camera, draws[name].params)
            self._cameras[key] = camera
        return self._cameras[key]

    def leaves_camera(self, draws: Draws) -> bool:
        """Return whether the drawn faults leave the camera unaltered."""
        return self.camera_with(draws) == self.exposure.camera

    def context_of(self, fault: Fault, draws: Draws) -> FaultContext:
        """Return the context in which a fault acts beside the drawn ones."""
        informing = _informing(fault, draws)
        key = _keys(draws, informing)
        if key not in self._contexts:
            context = self.context
            for name in informing:
                context = draws[name].fault.inform(context, draws[name].params)
            self._contexts[key] = context
        return self._contexts[key]

    # --- light -----------------------------------------------------------------------------------------------

    def signal(self, draws: Draws, names: Sequence[str], *, keep: bool = True) -> Electrons:
        """Return the expected electrons with the optical faults `names`, in physical order, of those drawn.

        A signal takes 25 to 38 MB for 1024 pixels. It is kept if `keep` is set. Of those that lead to it, each with
        one fault more, only the ones that lead to all drawn faults are kept, because every effect needs some of
        them.
        """
        key = (self._instrument(draws), _acting_keys(draws, names))
        signal = self._signals.get(key)
        if signal is None:
            if names:
                *before, last = names
                draw, context = draws[last], self.context_of(draws[last].fault, draws)
                leads = before == acting_at(draws, "electrons")[: len(before)]
                light = self.signal(draws, before, keep=keep and leads)
                signal = act(draw.fault, light, draw.params, context)
            else:
                signal = self._undisturbed(draws)
            if keep:
                self._signals[key] = signal
        return signal

    def _instrument(self, draws: Draws) -> Keys:
        """Return the keys of the faults that alter the camera, if its expected electrons differ for them."""
        if self.camera_with(draws).optics == self.exposure.camera.optics:
            return ()
        return _keys(draws, _altering(draws))

    def _undisturbed(self, draws: Draws) -> Electrons:
        """Return the expected electrons of the camera as the drawn faults alter it, without their own light."""
        camera = self.camera_with(draws)
        if self._instrument(draws):
            return camera.expose(self.exposure.light.rendered, camera.exposure_s)
        rate, exposure_s = self.exposure.rate, camera.exposure_s
        # the rate itself is the key, so that it exists as long as what was made of it
        return self.context.of_view.once("clean signal", (rate, exposure_s), lambda: rate.scaled(exposure_s))

    # --- images ----------------------------------------------------------------------------------------------

    def image(self, draws: Draws, *, noisy: bool = True, keep_signals: bool = True) -> RGBI:
        """Return the finished image with the drawn faults, with or without the noise of the exposure.

        Images are kept; the signals that lead to them are kept if `keep_signals` is set.
        """
        readout = acting_at(draws, "rgbi")
        key = (*self._image_key(draws, noisy), _keys(draws, readout))
        if key not in self._images:
            before = self._before_readout(draws, noisy, keep_signals)
            self._images[key] = self._read_out(before, draws) if readout else before
        return self._images[key]

    def _image_key(self, draws: Draws, noisy: bool) -> tuple[Any, ...]:
        """Return a key of everything on which the image before readout faults depends."""
        inside = [name for step in ("electrons", *MOSAIC_STEPS) for name in acting_at(draws, step)]
        return _keys(draws, _altering(draws)), _acting_keys(draws, inside), noisy

    def _before_readout(self, draws: Draws, noisy: bool, keep_signals: bool = True) -> RGBI:
        """Return the image with the drawn faults, except those that act on the finished image."""
        key = (*self._image_key(draws, noisy), ())
        if key not in self._images:
            camera = self.camera_with(draws)
            signal = self.signal(draws, acting_at(draws, "electrons"), keep=keep_signals).merged
            noise = self.noise if noisy else None
            if noisy and camera.detector.mosaic is not None:
                raw = camera.mosaic.raw(signal, camera.exposure_s, noise, self._acts(draws))
                self._raws[key] = raw  # a fifth of the memory of the image, and needed by `raw`
                self._images[key] = camera.mosaic.rgbi(raw, camera.exposure_s)
            else:
                patched = self._patched_clean(draws, signal) if noisy else None
                self._images[key] = patched or camera.detector.develop(
                    signal, camera.exposure_s, noise, self._acts(draws)
                )
        return self._images[key]

    def _patched_clean(self, draws: Draws, signal: Electrons) -> RGBI | None:
        """Return the noisy image of a signal, made from the clean image; None if too many of its pixels differ."""
        clean = self._images.get((*self._image_key({}, True), ()))
        if clean is None or not (self.exposure.camera.detector.local and self.leaves_camera(draws)):
            return None
        lit = self.signal({}, []).merged.array
        if _differing_fraction(signal.array, lit) > _MOST_CHANGED:
            return None
        changed = _differing_pixels(signal.array, lit)
        return RGBI(array=self._patched(clean.array, signal, changed, noisy=True))

    def twin(self, draws: Draws, name: str) -> RGBI:
        """Return `image` without one drawn fault; only the pixels that this fault changes are developed for it."""
        others = without(draws, name)
        key = (*self._image_key(others, True), ())
        if key not in self._images and self.is_local(draws, name):
            part, base = self._part(draws, name), self._before_readout(draws, noisy=True).array
            changed = self._changed(draws, name, part, _MOST_CHANGED)
            if changed is not None:
                self._images[key] = RGBI(array=self._patched(base, part, changed, noisy=True))
        return self.image(others)

    def _read_out(self, image: RGBI, draws: Draws) -> RGBI:
        """Return the image with the drawn faults that act on the finished image."""
        for name in acting_at(draws, "rgbi"):
            draw = draws[name]
            image = draw.fault.apply(image, draw.params, self.context_of(draw.fault, draws))
        return image

    def _acts(self, draws: Draws) -> dict[str, list[Callable[[Any], Any]]]:
        """Return the changes that the drawn faults make inside a detector with a mosaic, by its steps."""
        return {
            step: [
                draws[name].fault.act_at(step, draws[name].params, self.context_of(draws[name].fault, draws))
                for name in acting_at(draws, step)
            ]
            for step in MOSAIC_STEPS
        }

    def raw(self, draws: Draws) -> NDArray[np.uint16]:
        """Return the raw mosaic of the image, uint16[y, x], before the faults that act on the finished image."""
        self._before_readout(draws, noisy=True)
        return self._raws[(*self._image_key(draws, True), ())]

    def defects(self, draws: Draws) -> NDArray[np.uint8]:
        """Return the defects of the mosaic's pixels, uint8[y, x]: those of the device and those of the faults."""
        camera = self.exposure.camera
        defects = camera.mosaic.device.defects(camera.exposure_s, self.noise)
        for draw in draws.values():
            more = draw.fault.defects(draw.params, self.context_of(draw.fault, draws))
            if more is not None:
                defects |= more
        return defects

    # --- effects ---------------------------------------------------------------------------------------------

    def effect(self, draws: Draws, name: str, least_dn: float = 1.0) -> Mask:
        """Return where the noise-free image changes by `least_dn` or more without one drawn fault, bool[y, x].

        The 8-bit image is digital, so every change is at least 1 DN.
        """
        key = (frozenset(_keys(draws, draws)), name, max(1.0, least_dn))
        if key not in self._effects:
            self._effects[key] = self._effect(draws, name, least_dn)
        return self._effects[key]

    def _effect(self, draws: Draws, name: str, least_dn: float) -> Mask:
        """Return `effect`, computed anew."""
        others = without(draws, name)
        if not self.is_local(draws, name):
            with_it = self.image(draws, noisy=False).array
            lacking = self.image(others, noisy=False, keep_signals=name in self._twins).array
            return masks.effect(with_it, lacking, least_dn)
        part = self._part(draws, name)
        changed = self._changed(draws, name, part, _MOST_CHANGED_NOISE_FREE)
        if changed is not None and not len(changed):
            return np.zeros(self.context.shape, dtype=bool)
        with_it = self.image(draws, noisy=False).array
        if changed is None:
            camera = self.exposure.camera
            before = camera.detector.develop(part, camera.exposure_s, None)
        else:
            base = self._before_readout(draws, False).array
            before = RGBI(array=self._patched(base, part, changed, noisy=False))
        return masks.effect(with_it, self._read_out(before, others).array, least_dn)

    def _part(self, draws: Draws, name: str) -> Electrons:
        """Return the expected electrons without one drawn fault."""
        optical = acting_at(draws, "electrons")
        return self.signal(without(draws, name), [n for n in optical if n != name], keep=name in self._twins).merged

    def _changed(self, draws: Draws, name: str, part: Electrons, most: float) -> NDArray[np.intp] | None:
        """Return the flat indices of the pixels whose expected electrons differ from `part`, without one fault.

        No other pixel of a local detector's image can change. Return None if they are more than a fraction `most`.
        """
        whole = self.signal(draws, acting_at(draws, "electrons")).merged
        if _differing_fraction(whole.array, part.array) > most:
            return None
        key = (frozenset(_keys(draws, draws)), name)
        if key not in self._differences:
            self._differences[key] = _differing_pixels(whole.array, part.array)
        return self._differences[key]

    def _patched(
        self, image: NDArray[np.uint8], signal: Electrons, pixels: NDArray[np.intp], *, noisy: bool
    ) -> NDArray[np.uint8]:
        """Return a copy of an image in which some pixels, by their flat indices, show another signal."""
        out, camera = buffers.copy(image), self.exposure.camera
        lit, words = signal.array.reshape(-1, signal.array.shape[2]), out.view(np.uint32).reshape(-1)

        def patch(start: int) -> None:
            some = pixels[start : start + _PIXELS_AT_ONCE]
            noise = self.noise.of_pixels(some[None]) if noisy else None
            light = signal.with_array(np.take(lit, some[None], axis=0))  # one row of these pixels
            developed = camera.detector.develop(light, camera.exposure_s, noise).array
            words[some] = developed.view(np.uint32).reshape(-1)  # four channels of 8 bits move as one word

        list(pool().map(patch, range(0, len(pixels), _PIXELS_AT_ONCE)))
        return out

    def is_local(self, draws: Draws, name: str) -> bool:
        """Return whether a drawn fault changes only those pixels whose expected electrons it changes."""
        detector = self.exposure.camera.detector
        return "electrons" in draws[name].fault.steps and self.leaves_camera(draws) and detector.local


def _differing_fraction(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Return the fraction of the pixels in which any channel differs, estimated from every sixteenth row."""
    rows = slice(len(a) // 32, None, 16)
    return float(np.count_nonzero(_differ(a[rows], b[rows])) / max(1, a[rows, :, 0].size))


def _differing_pixels(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the flat indices of the pixels in which any channel differs, intp[n]."""
    height, width = a.shape[:2]
    step, parts = 64, []
    for start in range(0, max(1, height), step):  # blocks of rows stay in the cache
        differ = _differ(a[start : start + step], b[start : start + step])
        parts.append(np.flatnonzero(differ))
        parts[-1] += start * width
    return np.concatenate(parts)


def _differ(a: NDArray[np.float32], b: NDArray[np.float32]) -> Mask:
    """Return whether any channel of each pixel differs, bool[pixel]."""
    differ = (a != b).reshape(-1)
    channels = a.shape[2]
    last = differ.size - channels + 1
    out = differ[:last].copy()  # of any value and those behind it: faster than to take each channel apart
    for k in range(1, channels):
        out |= differ[k : last + k]
    return np.ascontiguousarray(out[::channels])


def _altering(draws: Draws) -> list[str]:
    """Return the drawn faults that may alter the camera, in physical order."""
    return [name for name in physical_order(draws) if type(draws[name].fault).alter is not Fault.alter]


def informs(fault: Fault) -> bool:
    """Return whether a fault may inform other faults of its sample."""
    return type(fault).inform is not Fault.inform


def _informing(fault: Fault, draws: Draws) -> list[str]:
    """Return the drawn faults that inform a fault, in physical order."""
    return [name for name in physical_order(draws) if informs(draws[name].fault)] if fault.informed else []


def _acting_keys(draws: Draws, names: Iterable[str]) -> tuple[tuple[tuple[str, int], Keys], ...]:
    """Return the keys of some draws, each with the keys of the draws that inform its fault."""
    return tuple((draws[name].key, _keys(draws, _informing(draws[name].fault, draws))) for name in names)
