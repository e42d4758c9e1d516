"""Overwrite pixels of the image with a user's own texture, the general operation behind the paper's faults.

The texture file (PNG or TIFF, grey or RGB, with or without alpha) is stretched to the frame and
blended with the chosen channels. With t the texture and v the image, both 0-255:

    replace   v' = t              add       v' = v + t
    multiply  v' = v · t / 255    mixture   v' = (1 - strength) v + strength · t

If the texture has an alpha channel a, the result is v + a (v' - v). A grey texture is used for all channels. Of an
RGB texture, I uses the luminance. Channels "I" alone changes the intensity as in the paper: R, G and B are scaled
by the same ratio. Values are clipped to 0-255.

The mask holds the pixels that the texture can change: alpha is above 0, and in at least one of the chosen channels
the texture is above 0 (add), below 255 (multiply) or anything (replace, and mixture
with a strength above 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, shown
from ..core.files import user_files
from ..core.files.images import decoded_image
from ..core.quantities import CHANNELS, LUMINANCE
from .context import FaultContext, Params
from .contract import Fault
from .fields import choice, number, path, text
from .planes import scale_by_intensity

# A texture needs 32 bytes per pixel or more while it is decoded: 24 megapixels, as of a photograph, need 0.8 GB.
LARGEST_TEXTURE_PIXELS = 25_000_000

BLENDS = ("replace", "add", "multiply", "mixture")


@dataclass(frozen=True, kw_only=True)
class TextureOverwriting(Fault):
    """Blend a texture file with the digital image."""

    fault = "pixel_overwriting"
    model = "texture"
    default = True
    after = "transmission"
    step = "rgbi"
    per_exposure = True

    texture_file: str = path(content="texture", doc="path of a PNG or TIFF texture; required")
    channels: str = text("RGBI", doc='the channels to overwrite, such as "RGBI", "I" or "R"')
    blend: str = choice("replace", BLENDS, doc="how the texture joins the image")
    strength: float = number(0.5, limits=(0, 1), doc="weight of the texture in a mixture")

    def validate(self) -> None:
        """Raise ValueError if the texture cannot be read or the channels are invalid."""
        if not self.texture_file:
            raise ValueError("texture_file is missing: name a PNG or TIFF texture")
        try:
            load(self.texture_file)
        except InputError as error:
            raise ValueError(str(error).removeprefix(f"faults.{self.fault}.")) from None
        known = sorted(self.channels, key="RGBI".find)
        if not known or known != [c for c in CHANNELS if c in self.channels]:
            raise ValueError(f"channels = {self.channels!r}: must name some of R, G, B, I, each once")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the settings and the SHA-256 of the texture file. Nothing is random."""
        return {
            "sha256": user_files.sha256(user_files.read_input(self.texture_file, "texture")),
            "channels": self.channels,
            "blend": self.blend,
            "strength": float(self.strength),
        }

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the image with the texture blended in."""
        texture, alpha = _stretch(self.texture_file, params["sha256"], context.shape)
        where = np.flatnonzero(context.once(self._mask, params))
        out = quantity.array.copy()
        flat = out.reshape(-1, 4)
        before = flat[where].astype(np.float32)
        t, a = texture.reshape(-1, 4)[where], alpha.reshape(-1, 1)[where]
        blended = _blend(before, t, params["blend"], params["strength"])
        after = before + a * (blended - before)
        if params["channels"] == "I":
            intensity, grey = np.clip(after[:, 3], 0, 255), context.camera.is_monochrome
            flat[where] = scale_by_intensity(flat[where], intensity, monochrome=grey)
        else:
            for channel in params["channels"]:
                c = CHANNELS.index(channel)
                flat[where, c] = np.clip(np.rint(after[:, c]), 0, 255).astype(np.uint8)
        return quantity.with_array(out)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels that the texture can change, bool[y, x]."""
        return context.once(self._mask, params).copy()

    def _mask(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels that the texture can change, bool[y, x]."""
        # the parameters hold the hash of the texture, not its name, so a renamed file gives the same dataset
        texture, alpha = _stretch(self.texture_file, params["sha256"], context.shape)
        mask = alpha > 0
        used = texture[..., [CHANNELS.index(c) for c in params["channels"]]]
        if params["blend"] == "add":
            mask &= (used > 0).any(axis=-1)
        elif params["blend"] == "multiply":
            mask &= (used < 255).any(axis=-1)
        elif params["blend"] == "mixture" and params["strength"] == 0:
            mask[:] = False
        return mask


def _blend(v: NDArray[np.float32], t: NDArray[np.float32], blend: str, strength: float) -> NDArray[np.float32]:
    """Return v' of the module's equations, without alpha."""
    if blend == "add":
        return v + t
    if blend == "multiply":
        return v * t * np.float32(1 / 255)
    weight = np.float32(strength if blend == "mixture" else 1.0)
    return v + weight * (t - v)


@lru_cache(maxsize=2)
def _stretch(path: str, sha256: str, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return texture RGBI float32[y, x, 4] in 0-255 and alpha float32[y, x] in 0-1, at the frame's size."""
    texture, alpha = load(path, sha256)
    if texture.shape[:2] != shape:
        shrinks = texture.shape[0] > shape[0] and texture.shape[1] > shape[1]
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        texture, alpha = (
            np.asarray(cv2.resize(a, shape[::-1], interpolation=how), dtype=np.float32) for a in (texture, alpha)
        )
    return texture, alpha


def load(path: str, sha256: str | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a texture file as RGBI float32[y, x, 4] in 0-255 and alpha float32[y, x] in 0-1.

    Raises
    ------
    InputError
        The file is missing, is no PNG or TIFF image, has too many pixels, or its content does not match `sha256`.
    """
    where = f"faults.pixel_overwriting.texture_file = {shown(path)}"
    try:
        data = user_files.read_input(path, "texture")
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(f'{path}: ')}") from None
    if sha256 and user_files.sha256(data) != sha256:
        raise InputError(f"{where}: its content has changed since the parameters were drawn")
    try:
        colours, alpha = decoded_image(data, 4 * LARGEST_TEXTURE_PIXELS)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    height, width = colours.shape[:2]
    if height * width > LARGEST_TEXTURE_PIXELS:
        raise InputError(
            f"{where}: has {width} x {height} pixels; must have at most {LARGEST_TEXTURE_PIXELS} in all"
        )
    if not (colours.min() >= 0 and colours.max() <= 1):  # NaN is neither
        raise InputError(f"{where}: has values that are negative or above white")
    if alpha is None:
        alpha = np.ones((height, width), np.float32)
    rgb = np.broadcast_to(colours, (height, width, 3))
    intensity = rgb @ LUMINANCE if colours.shape[2] == 3 else colours[..., 0]
    return np.concatenate([rgb, intensity[..., None]], axis=2) * np.float32(255), np.ascontiguousarray(alpha)
