"""Compute metrics of straylight in an image, in electrons before the converter.

Symbols: S is the expected signal of the scene and the Sun's direct image with straylight, D☉ the part of S that is
the Sun's direct image, V the light that straylight adds (that of the Sun and the veil of the scene), G the ghosts
in V, S₀ the signal without straylight, all in electrons per pixel and channel. A number "per pixel" is the mean of
the channels of the sensor (R, G, B, or those of the mosaic, each with the same weight). No noise is drawn: the
noise of a pixel is the detector's own model,

    σ² = S + V + D + r²,

with the dark signal D and the read noise r in electrons. A mosaic is not sampled, and no offset, non-linearity or
code of the converter acts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeGuard

import numpy as np
from numpy.typing import NDArray

from .spec import Metric, returned

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_GHOST = re.compile(r"ghost_([1-9][0-9]?)_flux_e")


@dataclass(frozen=True, kw_only=True, eq=False)
class LitImage:
    """Hold the expected light of one evaluation, all signals float32[channel, y, x] in electrons.

    Attributes
    ----------
    clean, kept
        S₀ and S: the signal without straylight, and what straylight leaves of it.
    added
        V: the light that straylight adds.
    parts_e
        Totals over the frame and the mean of the channels, in electrons, of `ghosts`, `starburst` and `glare`;
        empty for a model that does not separate them.
    ghosts_e
        Flux of single ghosts on the unbounded sensor plane in electrons, the mean of the channels, in the order of
        the paths that the study follows.
    lit
        int[n]: indices, in the flattened frame, of the pixels that show sunlit ground.
    dark_e
        D, float32: one number, or float32[y, x].
    read_noise_e, full_well_e
        Read noise, and the signal at which a pixel is full.
    white_e
        float32[channel]: signal that the 8-bit image shows as 255.
    mask_level_dn
        Change of the 8-bit image from which a pixel belongs to the mask.
    direct
        D☉, what straylight leaves of the Sun's direct image, which `kept` contains; None out of view.
    ghosts, traced_ghosts
        float32[y, x]: G per pixel, and that of exact rays through the same lens; None for a model that does not
        separate ghosts, and where no metric needs them.
    """

    clean: F32
    kept: F32
    added: F32
    parts_e: Mapping[str, float]
    ghosts_e: tuple[float, ...]
    lit: NDArray[np.intp]
    dark_e: F32 | float
    read_noise_e: float
    full_well_e: float
    white_e: F32
    mask_level_dn: float
    direct: F32 | None = None
    ghosts: F32 | None = None
    traced_ghosts: F32 | None = None

    @cached_property
    def added_mean(self) -> F32:
        """Return V per pixel, float32[y, x]."""
        return np.asarray(self.added.mean(axis=0))

    @cached_property
    def clean_mean(self) -> F32:
        """Return S₀ per pixel, float32[y, x]."""
        return np.asarray(self.clean.mean(axis=0))

    @cached_property
    def on_lit(self) -> tuple[F32, F32, F32]:
        """Return S, V and the noise variance without the signal, of the lit pixels, float32[n] each."""
        flat = (v.reshape(len(v), -1)[:, self.lit].mean(axis=0) for v in (self.kept, self.added))
        kept, added = flat
        dark = self.dark_e.ravel()[self.lit] if isinstance(self.dark_e, np.ndarray) else np.float32(self.dark_e)
        return kept, added, np.broadcast_to(dark + np.float32(self.read_noise_e**2), kept.shape)


Value = Callable[[LitImage], float]
_ALL: dict[str, tuple[Metric, Value]] = {}


def _metric(unit: str, source: str = "", better: Literal["low", "high"] = "low") -> Callable[[Value], Value]:
    """Return a decorator that adds a function to the metrics; its docstring describes the metric."""

    def add(value: Value) -> Value:
        name, words = value.__name__, returned(value)
        description = words[:1].upper() + words[1:]
        _ALL[name] = Metric(name=name, unit=unit, description=description, source=source, better=better), value
        return value

    return add


@_metric("electrons")
def straylight_total_e(image: LitImage) -> float:
    """Return the light that straylight adds, Σ V over the frame."""
    return float(image.added_mean.sum(dtype=np.float64))


@_metric("electrons")
def straylight_peak_e(image: LitImage) -> float:
    """Return the most light that straylight adds to a pixel, max V."""
    return float(image.added_mean.max())


@_metric("electrons", "Hullin et al. 2011")
def ghost_total_e(image: LitImage) -> float:
    """Return the light of all ghosts in the frame."""
    return image.parts_e.get("ghosts", float("nan"))


@_metric("electrons")
def ghost_peak_e(image: LitImage) -> float:
    """Return the most light of ghosts in a pixel, max G."""
    return float(image.ghosts.max()) if _has_light(image.ghosts) else float("nan")


@_metric("1", "EMVA 1288")
def ghost_area(image: LitImage) -> float:
    """Return the fraction of pixels to which ghosts alone add more than the noise without straylight, G > √(S₀
    + D + r²).
    """
    return _above(image.ghosts, image) if _has_light(image.ghosts) else float("nan")


@_metric("px")
def ghost_offset_px(image: LitImage) -> float:
    """Return the distance of the centre of brightness of all ghosts, Σ G r / Σ G, from the middle of the frame."""
    return _moments(image.ghosts)[0] if _has_light(image.ghosts) else float("nan")


@_metric("px")
def ghost_spread_px(image: LitImage) -> float:
    """Return the root mean square distance of the ghosts' light from its centre of brightness."""
    return _moments(image.ghosts)[1] if _has_light(image.ghosts) else float("nan")


@_metric("1")
def ghost_difference(image: LitImage) -> float:
    """Return the difference of the ghosts, pixel by pixel, from those of exact rays through the same lens, Σ |G
    − G traced| / Σ G traced; 0 for the model traced, and up to 2.
    """
    ghosts, traced = image.ghosts, image.traced_ghosts
    if not (_has_light(ghosts) and _has_light(traced)):
        return float("nan")
    return float(np.abs(ghosts - traced).sum(dtype=np.float64) / traced.sum(dtype=np.float64))


@_metric("electrons")
def starburst_total_e(image: LitImage) -> float:
    """Return the light in the frame that the stop diffracts."""
    return image.parts_e.get("starburst", float("nan"))


@_metric("electrons", "Peterson 2004")
def glare_total_e(image: LitImage) -> float:
    """Return the light in the frame that surfaces scatter."""
    return image.parts_e.get("glare", float("nan"))


@_metric("electrons", "ISO 9358:1994")
def veil_median_e(image: LitImage) -> float:
    """Return the veil: the median over the frame of V."""
    values = image.added_mean.ravel()
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


@_metric("1", "ISO 9358:1994")
def contrast_loss(image: LitImage) -> float:
    """Return the loss of contrast of the sunlit ground, the median over its pixels of V / (S + V): a modulation
    m of the ground appears as m S / (S + V).
    """
    if not len(image.lit):
        return float("nan")
    kept, added, _ = image.on_lit
    return float(np.median(added / np.maximum(kept + added, np.float32(1e-30))))


@_metric("1", "ISO 9358:1994")
def veiling_glare_index(image: LitImage) -> float:
    """Return the light that straylight adds to the sunlit ground over all light there, Σ V / Σ (S + V): the
    standard's ratio of the flux of veiling glare to the whole flux, for this scene in place of a uniform field.
    """
    if not len(image.lit):
        return float("nan")
    kept, added, _ = image.on_lit
    veil = float(added.sum(dtype=np.float64))
    return veil / (veil + float(kept.sum(dtype=np.float64)))


@_metric("1")
def straylight_over_signal(image: LitImage) -> float:
    """Return the light that straylight adds over that of the scene without the Sun's direct image, Σ V / Σ (S −
    D☉).
    """
    signal = float(image.kept.mean(axis=0).sum(dtype=np.float64)) - sun_direct_e(image)
    return straylight_total_e(image) / signal if signal > 0 else float("nan")


@_metric("electrons", better="high")
def sun_direct_e(image: LitImage) -> float:
    """Return the light of the Sun's direct image that straylight leaves, Σ D☉; it is no part of V."""
    return 0.0 if image.direct is None else float(image.direct.mean(axis=0).sum(dtype=np.float64))


@_metric("1")
def pixels_above_1dn(image: LitImage) -> float:
    """Return the fraction of pixels to which straylight adds 1 DN of the 8-bit image or more in a channel."""
    level = image.white_e / np.float32(255)
    return _fraction(image.added >= level[:, None, None])


@_metric("1", "EMVA 1288")
def pixels_above_noise(image: LitImage) -> float:
    """Return the fraction of pixels to which straylight adds more than the noise without it, V > √(S₀ + D + r²)."""
    return _above(image.added_mean, image)


@_metric("1")
def pixels_saturated(image: LitImage) -> float:
    """Return the fraction of pixels of which a channel reaches the full well, S + V + D ≥ full well."""
    dark = np.asarray(image.dark_e, dtype=np.float32)
    return _fraction(image.kept + image.added + dark >= np.float32(image.full_well_e))


@_metric("1", "EMVA 1288", "high")
def snr(image: LitImage) -> float:
    """Return the signal-to-noise ratio of the sunlit ground, the median over its pixels of S / √(S + V + D +
    r²).
    """
    if not len(image.lit):
        return float("nan")
    kept, added, rest = image.on_lit
    return float(np.median(kept / np.sqrt(np.maximum(kept + added + rest, np.float32(1e-30)))))


@_metric("1", "Gallon et al.")
def mask_area(image: LitImage) -> float:
    """Return the fraction of pixels whose expected 8-bit value changes by mask_level_dn or more in a channel."""
    white = image.white_e[:, None, None]
    after = np.minimum(image.kept + image.added, white)
    after -= np.minimum(image.clean, white)
    return _fraction(np.abs(after) >= white * np.float32(image.mask_level_dn / 255))


def _has_light(ghosts: F32 | None) -> TypeGuard[F32]:
    """Return whether the ghosts are known, and there are any."""
    return ghosts is not None and bool(ghosts.any())


def _moments(ghosts: F32) -> tuple[float, float]:
    """Return the distance of the centre of brightness from the frame's middle, and the rms radius, in pixels."""
    weights = ghosts.astype(np.float64) / ghosts.sum(dtype=np.float64)
    total, square = 0.0, 0.0
    for axis, size in enumerate(weights.shape):
        of_axis, place = weights.sum(axis=1 - axis), np.arange(size) - (size - 1) / 2
        mean = float(of_axis @ place)
        total += mean**2
        square += float(of_axis @ (place - mean) ** 2)
    return float(np.sqrt(total)), float(np.sqrt(square))


def _above(light: F32, image: LitImage) -> float:
    """Return the fraction of pixels whose light exceeds the noise without straylight, √(S₀ + D + r²)."""
    dark = np.asarray(image.dark_e, dtype=np.float32) + np.float32(image.read_noise_e**2)
    variance = np.asarray(image.clean_mean + dark)
    return float(np.count_nonzero(light * light > variance) / light.size)


def _fraction(of_channels: NDArray[np.bool_]) -> float:
    """Return the fraction of pixels of which any channel is true."""
    return float(np.count_nonzero(of_channels.any(axis=0)) / of_channels[0].size)


NAMES = (*_ALL, "ghost_<k>_flux_e")


def ghost_rank(name: str) -> int | None:
    """Return k of `ghost_<k>_flux_e`; None for another name."""
    match = _GHOST.fullmatch(name)
    return int(match[1]) if match else None


def is_image_metric(name: str) -> bool:
    """Return whether a metric is one of this module."""
    return name in _ALL or ghost_rank(name) is not None


def metric(name: str, pair: tuple[int, ...] | None = None) -> Metric:
    """Return the description of a metric; `pair` holds the reflecting rows of the path of a single ghost."""
    rank = ghost_rank(name)
    if rank is None:
        return _ALL[name][0]
    path = "" if pair is None else f", rows {' and '.join(map(str, pair))}"
    place = f"number {rank} in flux of the nominal lens{path}"
    return Metric(
        name=name,
        unit="electrons",
        description=f"Flux, on the unbounded sensor plane, of the path that is {place}",
        source="Hullin et al. 2011",
    )


def value(name: str, image: LitImage) -> float:
    """Return the value of a metric; nan where it has none."""
    rank = ghost_rank(name)
    if rank is None:
        return _ALL[name][1](image)
    return image.ghosts_e[rank - 1] if len(image.ghosts_e) >= rank else float("nan")
