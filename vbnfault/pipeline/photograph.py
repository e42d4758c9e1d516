"""Draw the faults of a sample and take its images: `image`, the clean twin, and `without_<fault>`.

All images share radiance, exposure and noise, so they differ by the faults alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.quantities import RGBI, Electrons, soft_kind
from ..faults import MOSAIC_STEPS, Fault, FaultContext, Params, act, physical_order
from . import labels
from .spec import Frame, stored_layers

_DRAW_TRIES = 8
# If a step changes a pixel by this many DN, the change survives every later optical step within the paper's tables
# (cos⁴ at 255 → 105 keeps 41 %). Such a fault counts as visible without a full comparison.
_CLEARLY_VISIBLE_DN = 6.0


def photograph(frame: Frame) -> None:
    """Draw the commanded faults and take the images: `clean`, `image` and the twins that the scene asks for.

    A drawn fault without a visible effect is drawn again a few times, then left out. So `frame.drawn` lists the
    faults that are in the image, and labels never claim more.
    """
    spec = frame.spec
    commanded = list(spec.commanded)
    if not frame.pose.resolved or frame.pose.sun_visible_fraction == 0:
        commanded = [name for name in commanded if not spec.faults[name].needs_sun]
    # noise and the clean image use one core, the optics of the faults another
    undisturbed = _signal(frame, {}, [])
    with ThreadPoolExecutor(1) as aside:
        exposed = aside.submit(_expose_clean, frame, undisturbed)
        _draw(frame, commanded, attempt=0)
        optical = _in_order(frame, frame.drawn, "electrons")
        _signal(frame, frame.drawn, optical)
        for name in [n for n in optical if spec.faults[n].effect_mask]:
            _signal(frame, frame.drawn, [n for n in optical if n != name])
        noise, frame.images["clean"] = exposed.result()
    frame.pictures[frame.camera, (), (), False] = frame.images["clean"]
    attempt = 0
    while invisible := _invisible(frame, noise):
        # rejected draws are kept: cache keys use their id, which a new draw could otherwise reuse
        frame.rejected += [frame.drawn.pop(name) for name in invisible]
        attempt += 1
        if attempt < _DRAW_TRIES:
            _draw(frame, commanded, attempt)
    frame.images["image"] = develop(frame, frame.drawn, noise)
    if "raw" in spec.scene.dataset.layers:
        frame.raw = _raw(frame, noise)
    if "defects" in spec.scene.dataset.layers:
        frame.defects = _defects(frame, noise)
    twins = [layer for layer in stored_layers(spec.scene, spec.faults) if layer.startswith("without_")]
    for layer in twins:
        name = layer.removeprefix("without_")
        if name in frame.drawn:
            frame.images[layer] = develop(frame, _but(frame.drawn, name), noise)
        else:
            frame.images[layer] = frame.images["image"]


def _expose_clean(frame: Frame, signal: Electrons) -> tuple[Any, RGBI]:
    """Return the variates of the exposure, and the clean image."""
    spec, camera = frame.spec, frame.camera
    noise = camera.detector.draw_noise(frame.context.shape, lambda name: spec.rng("detector", name))
    return noise, camera.detector.develop(signal.merged, camera.exposure_s, noise)


def _draw(frame: Frame, commanded: Sequence[str], attempt: int) -> None:
    """Draw the commanded faults that are not drawn yet, beginning with those that inform others.

    Every view of the sample uses new draws: a draw that is invisible in one view is not tried again in the next.
    """
    faults = frame.spec.faults
    attempt += (frame.views - 1) * _DRAW_TRIES
    for name in sorted(commanded, key=lambda n: type(faults[n]).inform is Fault.inform):
        if name not in frame.drawn:
            generator = frame.spec.rng("fault", f"{name}/{attempt}")
            frame.drawn[name] = faults[name].draw(_context(frame, frame.drawn)[1], generator)


def _but(drawn: Mapping[str, Params], left_out: str) -> dict[str, Params]:
    """Return the drawn faults without one of them."""
    return {name: params for name, params in drawn.items() if name != left_out}


def _in_order(frame: Frame, drawn: Mapping[str, Params], step: str) -> list[str]:
    """Return the drawn faults that act at a step, in physical order."""
    return [name for name in physical_order(drawn) if step in frame.spec.faults[name].steps]


def _altered(frame: Frame, drawn: Mapping[str, Params]) -> Camera:
    """Return the camera as the drawn faults alter it."""
    camera = frame.camera
    for name in physical_order(drawn):
        camera = frame.spec.faults[name].alter(camera, drawn[name])
    return camera


def _context(frame: Frame, drawn: Mapping[str, Params]) -> tuple[Any, FaultContext]:
    """Return a key of the faults that inform others, and the context that they have changed."""
    faults = frame.spec.faults
    informing = [name for name in drawn if type(faults[name]).inform is not Fault.inform]
    key = _key(drawn, informing)
    if key and key not in frame.contexts:
        context = frame.context
        for name in informing:
            context = faults[name].inform(context, drawn[name])
        frame.contexts[key] = context
    return key, frame.contexts[key] if key else frame.context


def _key(drawn: Mapping[str, Params], names: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """Return a key of some drawn faults, from the identity of their parameters."""
    return tuple((name, id(drawn[name])) for name in names)


def _signal(frame: Frame, drawn: Mapping[str, Params], names: Sequence[str]) -> Electrons:
    """Return the expected electrons with the optical faults `names` of those drawn. Twins share common results."""
    camera = _altered(frame, drawn)
    same = camera.optics == frame.camera.optics
    if not same:
        cached: dict[Any, Electrons] = {}  # another instrument, whose results must not enter the shared cache
    else:
        cached = frame.signals
    state, context = _context(frame, drawn)
    key = state if names else (), _key(drawn, names)
    if key not in cached:
        if names:
            *before, last = names
            signal = _signal(frame, drawn, before)
            cached[key] = act(frame.spec.faults[last], signal, drawn[last], context)
        else:
            if same:
                signal = (frame.rate_apart or frame.rate).scaled(camera.exposure_s)
            else:
                signal = camera.expose(frame.imaged, camera.exposure_s)
            cached[key] = signal
    return cached[key]


def develop(frame: Frame, drawn: Mapping[str, Params], noise: Any) -> RGBI:
    """Return the finished image with the faults `drawn`; noise-free if `noise` is None."""
    readout = _key(drawn, _in_order(frame, drawn, "rgbi"))
    picture = _before_readout(frame, drawn, noise)
    if not readout:
        return picture
    key = id(picture), readout
    if key not in frame.pictures:
        frame.pictures[key] = _read_out(frame, picture, drawn)
    return frame.pictures[key]


def _before_readout(frame: Frame, drawn: Mapping[str, Params], noise: Any) -> RGBI:
    """Return the image with the faults `drawn`, except those that act on the finished image."""
    optical = _in_order(frame, drawn, "electrons")
    inside = [name for step in MOSAIC_STEPS for name in _in_order(frame, drawn, step)]
    camera = _altered(frame, drawn)
    key = (camera, _context(frame, drawn)[0], _key(drawn, [*optical, *inside]), noise is None)
    if key not in frame.pictures:
        signal, acts = _signal(frame, drawn, optical), _acts(frame, drawn)
        frame.pictures[key] = camera.detector.develop(signal.merged, camera.exposure_s, noise, acts)
    return frame.pictures[key]


def _raw(frame: Frame, noise: Any) -> NDArray[np.uint16]:
    """Return the raw mosaic of the image, uint16[y, x], before the faults that act on the finished image."""
    camera = _altered(frame, frame.drawn)
    signal = _signal(frame, frame.drawn, _in_order(frame, frame.drawn, "electrons")).merged
    return camera.mosaic.raw(signal, camera.exposure_s, noise, _acts(frame, frame.drawn))


def _defects(frame: Frame, noise: Any) -> NDArray[np.uint8]:
    """Return the defects of the mosaic's pixels, uint8[y, x]: those of the device and those of the drawn faults."""
    context = _context(frame, frame.drawn)[1]
    out = frame.camera.mosaic.device.defects(frame.camera.exposure_s, noise)
    for name, params in frame.drawn.items():
        more = frame.spec.faults[name].defects(params, context)
        if more is not None:
            out |= more
    return out


def _acts(frame: Frame, drawn: Mapping[str, Params]) -> dict[str, list[Callable[[Any], Any]]]:
    """Return the changes that the drawn faults make inside a mosaic detector, by its steps."""
    context = _context(frame, drawn)[1]

    return {
        step: [frame.spec.faults[name].act_at(step, drawn[name], context) for name in _in_order(frame, drawn, step)]
        for step in MOSAIC_STEPS
    }


def _read_out(frame: Frame, picture: RGBI, drawn: Mapping[str, Params]) -> RGBI:
    """Return the image with the drawn faults that act on the finished image."""
    for name in _in_order(frame, drawn, "rgbi"):
        picture = frame.spec.faults[name].apply(picture, drawn[name], frame.context)
    return picture


# --- visible effects ---------------------------------------------------------------------------------------


def _invisible(frame: Frame, noise: Any) -> list[str]:
    """Return the drawn faults without any effect on the noise-free image."""
    if "mask_effect" in frame.spec.scene.dataset.layers:  # all effects are stored, so no cheaper test is needed
        frame.effects = {name: effect_of(frame, name) for name in frame.drawn}
        return [name for name in frame.drawn if not mask_effect_of(frame, name).any()]
    doubtful = sorted(_doubtful(frame, noise))
    return [n for n in doubtful if not (_shows_on_some_rows(frame, n) or mask_effect_of(frame, n).any())]


def _shows_on_some_rows(frame: Frame, name: str) -> bool:
    """Return whether an optical fault is already visible in every eighth row of the noise-free image.

    False does not mean that the fault is invisible.
    """
    faults, drawn = frame.spec.faults, frame.drawn
    optical, readout = (_in_order(frame, drawn, step) for step in ("electrons", "rgbi"))
    if name not in optical or _altered(frame, drawn) != frame.camera or not frame.camera.detector.local:
        return False
    rows = slice(frame.context.shape[0] // 32, None, 8)
    detector, exposure = frame.camera.detector, frame.camera.exposure_s
    pictures = []
    for names in (optical, [n for n in optical if n != name]):
        signal = _signal(frame, drawn, names).merged
        some = signal.with_array(np.ascontiguousarray(signal.array[rows]))
        pictures.append(detector.develop(some, exposure, None).array)
    seen = labels.effect(pictures[0], pictures[1], faults[name].effect_level_dn)
    for other in readout:
        over = faults[other].footprint(drawn[other], frame.context)
        if over is not None:
            seen &= ~over[rows]
    return bool(seen.any())


def mask_effect_of(frame: Frame, name: str) -> NDArray[np.bool_]:
    """Return where the change is as large as the fault's effect mask requires, bool[y, x]."""
    least_dn = frame.spec.faults[name].effect_level_dn
    if least_dn > 1:
        return effect_of(frame, name, least_dn)
    return frame.effects[name] if name in frame.effects else effect_of(frame, name)


def effect_of(frame: Frame, name: str, least_dn: float = 1.0) -> NDArray[np.bool_]:
    """Return where the noise-free image changes by `least_dn` or more without one drawn fault, bool[y, x]."""
    drawn, others = frame.drawn, _but(frame.drawn, name)
    optical = _in_order(frame, drawn, "electrons")
    if name not in optical or _altered(frame, drawn) != frame.camera or not frame.camera.detector.local:
        return labels.effect(develop(frame, drawn, None).array, develop(frame, others, None).array, least_dn)
    # only pixels whose signal differs can change, so only these are developed
    whole, part = (_signal(frame, d, [n for n in optical if n in d]).merged for d in (drawn, others))
    differ = whole.array != part.array
    changed = np.flatnonzero(np.logical_or.reduce([differ[..., k] for k in range(differ.shape[2])]))
    if not len(changed):
        return np.zeros(frame.context.shape, dtype=bool)
    with_it = develop(frame, drawn, None).array
    array = _before_readout(frame, drawn, None).array.copy()
    # arrange these pixels as the rows of an image, and fill up the last row
    width = frame.context.shape[1]
    filled = np.resize(changed, (-(-len(changed) // width), width))
    pixels = part.array.reshape(-1, part.array.shape[2])[filled]
    developed = frame.camera.detector.develop(part.with_array(pixels), frame.camera.exposure_s, None).array
    array.reshape(-1, 4)[changed] = developed.reshape(-1, 4)[: len(changed)]
    return labels.effect(with_it, _read_out(frame, RGBI(array=array), others).array, least_dn)


def soft_layer(frame: Frame, name: str) -> NDArray[Any]:
    """Return how strongly a fault acts on each pixel, [y, x], in the data type of its soft layer."""
    fault = frame.spec.faults[name]
    kind = soft_kind(fault.soft_layer)
    if name not in frame.drawn:
        return np.full(frame.context.shape, kind.neutral, dtype=kind.dtype)
    strength = fault.soft(frame.drawn[name], _context(frame, frame.drawn)[1])
    return np.asarray(strength).astype(kind.dtype)


def _doubtful(frame: Frame, noise: Any) -> set[str]:
    """Return the drawn faults that a cheap test does not show to be clearly visible."""
    faults, drawn = frame.spec.faults, frame.drawn
    if _altered(frame, drawn) != frame.camera:
        return set(drawn)
    out = {
        name for name in drawn if faults[name].effect_mask or not set(MOSAIC_STEPS).isdisjoint(faults[name].steps)
    }
    optical, readout = (_in_order(frame, drawn, step) for step in ("electrons", "rgbi"))
    # these pixels are enough to see a clearly visible fault; `effect_of` decides about the others
    some = (slice(frame.context.shape[0] // 32, None, 16), slice(None, None, 4))
    for k, name in enumerate(optical):
        a, b = (
            np.minimum(q.array[some], q.white_e) * (255 / q.white_e)
            for q in (_signal(frame, drawn, optical[:k]).merged, _signal(frame, drawn, optical[: k + 1]).merged)
        )
        if np.abs(b - a).max(initial=0) < _CLEARLY_VISIBLE_DN:
            out.add(name)
    picture = develop(frame, {name: drawn[name] for name in optical}, noise)
    touched = []
    for name in readout:
        after = faults[name].apply(picture, drawn[name], frame.context)
        where = np.flatnonzero(labels.effect(after.array, picture.array))
        a, b = (q.array.reshape(-1, 4)[where].astype(np.int16) for q in (picture, after))
        touched.append((name, where[(np.abs(b - a) >= _CLEARLY_VISIBLE_DN).any(axis=1)]))
        picture = after
    overwritten = np.zeros(frame.context.shape[0] * frame.context.shape[1], dtype=bool)
    for name, where in reversed(touched):  # changes that a later fault overwrites do not count
        if overwritten[where].all():
            out.add(name)
        overwritten[where] = True
    return out
