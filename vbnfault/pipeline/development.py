"""Compute the images of one exposure with any set of its drawn faults.

All images share radiance, exposure and noise, so they differ by the faults alone. Results that several images share
are computed once. They are kept by the draws that they depend on, each identified by its fault class and attempt.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.quantities import RGBI, Electrons
from ..faults import MOSAIC_STEPS, Fault, FaultContext, FrameBefore, physical_order
from . import masks
from .spec import Draw, Images, Injection, SampleSpec, SceneExposure, stored_layers

Draws = Mapping[str, Draw]
Keys = tuple[tuple[str, int], ...]
Mask = NDArray[np.bool_]

_BEFORE_FULL_WELL = ("electrons", "light", "pixels", "charge")  # steps at which faults may change the charge


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
        self.rng, self._twins = rng, twins
        self._cameras: dict[Keys, Camera] = {(): exposure.camera}
        self._contexts: dict[Keys, FaultContext] = {(): context}
        self._signals: dict[Any, Electrons] = {}
        self._images: dict[Any, RGBI] = {}
        self._charges: dict[Any, NDArray[np.float32]] = {}
        self._raws: dict[Any, NDArray[np.uint16]] = {}
        self._effects: dict[Any, Mask] = {}

    @cached_property
    def noise(self) -> Any:
        """Return the variates of the exposure, which all its images share."""
        detector, time_s = self.exposure.camera.detector, self.context.time_s
        noise = detector.draw_noise(self.context.shape, lambda name: self.rng("detector", name))
        if time_s is None or detector.mosaic is None:
            return noise
        return replace(noise, sequence=(int(self.rng("sequence", "telegraph").integers(2**63)), time_s))

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
                signal = draw.fault.on_light(light, draw.params, context)
            else:
                signal = self._undisturbed(draws)
            if keep:
                self._signals[key] = signal
        return signal

    def forget_steps(self, draws: Draws) -> None:
        """Forget the signals with some of the drawn faults, which only the effects of faults need.

        The signals of the clean image, of the image with all drawn faults, and of the twins are kept.
        """
        sets = [draws, *(without(draws, name) for name in self._twins if name in draws)]
        keys = {(self._instrument(of), _acting_keys(of, acting_at(of, "electrons"))) for of in (*sets, {})}
        self._signals = {key: signal for key, signal in self._signals.items() if key in keys}

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
            self._images[key] = self.read_out(before, draws) if readout else before
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
            if camera.detector.mosaic is not None:
                raw = self.raw(draws, noisy=noisy, keep=keep_signals)
                self._images[key] = camera.mosaic.rgbi(raw, camera.exposure_s)
            else:
                signal = self.signal(draws, acting_at(draws, "electrons"), keep=keep_signals).merged
                noise = self.noise if noisy else None
                self._images[key] = camera.detector.develop(signal, camera.exposure_s, noise)
        return self._images[key]

    def read_out(self, image: RGBI, draws: Draws) -> RGBI:
        """Return the image with the drawn faults that act on the finished image."""
        for name in acting_at(draws, "rgbi"):
            draw = draws[name]
            image = draw.fault.apply(image, draw.params, self.context_of(draw.fault, draws))
        return image

    def acts(self, draws: Draws) -> dict[str, list[Callable[[Any], Any]]]:
        """Return the changes that the drawn faults make inside a detector with a mosaic, by its steps."""
        return {
            step: [
                draws[name].fault.act_at(step, draws[name].params, self.context_of(draws[name].fault, draws))
                for name in acting_at(draws, step)
            ]
            for step in MOSAIC_STEPS
        }

    def raw(self, draws: Draws, *, noisy: bool = True, keep: bool = True) -> NDArray[np.uint16]:
        """Return the raw mosaic of the image, uint16[y, x], before the faults that act on the finished image.

        It is kept, as are the signals that lead to it, if `keep` is set.
        """
        key = self._image_key(draws, noisy)
        raw = self._raws.get(key)
        if raw is None:
            camera, noise = self.camera_with(draws), self.noise if noisy else None
            charge = self._charge(draws, noisy=noisy, keep=keep)
            raw = camera.mosaic.device.read(charge, camera.exposure_s, noise, self.acts(draws))
            if keep:
                self._raws[key] = raw
        return raw

    def _charge(self, draws: Draws, *, noisy: bool = True, keep: bool = True) -> NDArray[np.float32]:
        """Return the charge at the output of a mosaic's sensor, float32[y, x] in e, before the full well.

        Images whose faults differ in the readout alone share it. It is kept as `raw` is.
        """
        camera = self.camera_with(draws)
        acting = _acting_keys(draws, [name for step in _BEFORE_FULL_WELL for name in acting_at(draws, step)])
        key = camera.mosaic.device.charge_key, camera.exposure_s, self._instrument(draws), acting, noisy
        charge = self._charges.get(key)
        if charge is None:
            signal = self.signal(draws, acting_at(draws, "electrons"), keep=keep).merged
            noise = self.noise if noisy else None
            charge = camera.mosaic.collected_e(signal, camera.exposure_s, noise, self.acts(draws))
            if keep:
                self._charges[key] = charge
        return charge

    def left_behind(self, draws: Draws) -> FrameBefore:
        """Return what the exposure leaves behind for the next frame of its sequence."""
        camera, held_e = self.camera_with(draws), None
        if camera.detector.mosaic is not None:
            held_e = np.minimum(self._charge(draws), np.float32(camera.detector.full_well_e))
        return FrameBefore(
            image=self.image(draws),
            light=self.signal(draws, []).merged,
            held_e=held_e,
            end_s=(self.context.time_s or 0.0) + camera.exposure_s,
        )

    def defects(self, draws: Draws) -> NDArray[np.uint8]:
        """Return the defects of the mosaic's pixels, uint8[y, x]: those of the device and those of the faults."""
        camera = self.exposure.camera
        defects = camera.mosaic.device.defects(camera.exposure_s, self.noise)
        for draw in draws.values():
            more = draw.fault.defects(draw.params, self.context_of(draw.fault, draws))
            if more is not None:
                defects |= more
        return moved(defects, draws, physical_order(draws))

    # --- effects ---------------------------------------------------------------------------------------------

    def effect(self, draws: Draws, name: str, least_dn: float = 1.0) -> Mask:
        """Return where the noise-free image changes by `least_dn` or more without one drawn fault, bool[y, x].

        The 8-bit image is digital, so every change is at least 1 DN.
        """
        key = (frozenset(_keys(draws, draws)), name, max(1.0, least_dn))
        if key not in self._effects:
            with_it = self.image(draws, noisy=False).array
            lacking = self.image(without(draws, name), noisy=False, keep_signals=name in self._twins).array
            self._effects[key] = masks.effect(with_it, lacking, least_dn)
        return self._effects[key]

    def joint_effect(self, draws: Draws, names: Collection[str]) -> Mask:
        """Return where the noise-free image changes by 1 DN or more without all of some drawn faults, bool[y, x].

        A pixel that two faults turn into the same value, such as white, is in the effect of neither, but in this.
        """
        others = {name: draw for name, draw in draws.items() if name not in names}
        lacking = self.image(others, noisy=False, keep_signals=False)
        return masks.effect(self.image(draws, noisy=False).array, lacking.array)


def _altering(draws: Draws) -> list[str]:
    """Return the drawn faults that may alter the camera, in physical order."""
    return [name for name in physical_order(draws) if type(draws[name].fault).alter is not Fault.alter]


def movers(draws: Draws, name: str) -> list[str]:
    """Return the drawn faults that move what one of them did to pixels of the mosaic, in physical order."""
    order = physical_order(draws)
    behind = [] if draws[name].fault.step == "rgbi" else order[order.index(name) + 1 :]
    return [other for other in behind if type(draws[other].fault).moved is not Fault.moved]


def moved(layer: NDArray[Any], draws: Draws, names: Iterable[str]) -> NDArray[Any]:
    """Return a layer, [y, x], after drawn faults that move its pixels."""
    for name in names:
        layer = draws[name].fault.moved(layer, draws[name].params)
    return layer


def informs(fault: Fault) -> bool:
    """Return whether a fault may inform other faults of its sample."""
    return type(fault).inform is not Fault.inform


def _informing(fault: Fault, draws: Draws) -> list[str]:
    """Return the drawn faults that inform a fault, in physical order."""
    return [name for name in physical_order(draws) if informs(draws[name].fault)] if fault.informed else []


def _acting_keys(draws: Draws, names: Iterable[str]) -> tuple[tuple[tuple[str, int], Keys], ...]:
    """Return the keys of some draws, each with the keys of the draws that inform its fault."""
    return tuple((draws[name].key, _keys(draws, _informing(draws[name].fault, draws))) for name in names)


def take_images(spec: SampleSpec, injection: Injection) -> Images:
    """Take the images that the scene stores. They share radiance, exposure and noise."""
    draws, development = injection.draws, injection.development
    layers = stored_layers(spec.scene, spec.faults)
    image = development.image(draws)
    twins = [layer.removeprefix("without_") for layer in layers if layer.startswith("without_")]
    return Images(
        image=image,
        clean=development.image({}),
        without={name: development.image(without(draws, name)) for name in twins},
        raw=development.raw(draws) if "raw" in layers else None,
        defects=development.defects(draws) if "defects" in layers else None,
    )
