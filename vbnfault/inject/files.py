"""Read images of users' files, and write them back with other numbers: size, depth and metadata stay.

PNG and TIFF of 8 and 16 bits (TIFF of 32 bits, too), FITS of any BITPIX with its BZERO, BSCALE and BLANK,
OpenEXR, images of planetary archives (PDS3, PDS4), and numpy's NPY. Each kind says how it is read and how it is
written in one class.
"""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import images, tiff, user_files
from ..core.files.whole_files import write_whole
from . import planetary

MOST_VALUES = 4 * 10**8  # pixels times channels of one image
_COLOURS = {1: "grey", 3: "RGB"}
_SKY_M = 1e9  # Blender gives 1e10 where no surface is


class ImageFile(ABC):
    """Hold an image of a file: `numbers` [y, x] or [y, x, 3]; alpha is kept, and faults do not touch it."""

    endings: ClassVar[tuple[str, ...]]
    numbers: NDArray[Any]
    depth_m: NDArray[Any] | None = None

    @abstractmethod
    def __init__(self, path: Path) -> None:
        """Read a file. Raises InputError, whose message goes on from the file's name."""

    @abstractmethod
    def write(self, path: Path, numbers: NDArray[Any], text: str) -> None:
        """Write a file like this one with other numbers; `text` is added to its metadata where that is possible."""


class _Samples(ImageFile):
    """Hold samples [y, x, channel], of which the last may be alpha."""

    def _split(self, samples: NDArray[Any]) -> None:
        count = samples.shape[2]
        colours = count - (count in (2, 4))
        self._alpha = samples[..., colours:]
        self.numbers = samples[..., 0] if colours == 1 else samples[..., :colours]
        if colours not in _COLOURS:
            raise InputError(f"has {count} channels; must be grey or RGB, with or without alpha")

    def _joined(self, numbers: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([np.atleast_3d(numbers), self._alpha], axis=2)


class Png(_Samples):
    """PNG of 8 or 16 bits."""

    endings = (".png",)

    def __init__(self, path: Path) -> None:
        """Read a PNG file."""
        self._data = user_files.read_input(path, "image")
        self._split(images.png_numbers(self._data, MOST_VALUES))

    def write(self, path: Path, numbers: NDArray[Any], text: str) -> None:
        """Write a PNG file with the chunks of this one."""
        write_whole(path, images.with_png_numbers(self._data, self._joined(numbers), text))


class Tiff(_Samples):
    """TIFF or BigTIFF, in strips or tiles."""

    endings = (".tif", ".tiff")

    def __init__(self, path: Path) -> None:
        """Read a TIFF file."""
        self._data = user_files.read_input(path, "image")
        self._split(tiff.tiff_numbers(self._data, MOST_VALUES))

    def write(self, path: Path, numbers: NDArray[Any], text: str) -> None:
        """Write a TIFF file with the tags of this one."""
        write_whole(path, tiff.with_numbers(self._data, self._joined(numbers), text))


class Npy(ImageFile):
    """Array of numpy."""

    endings = (".npy",)

    def __init__(self, path: Path) -> None:
        """Read an array."""
        try:
            self.numbers = np.load(io.BytesIO(user_files.read_input(path, "image")), allow_pickle=False)
        except Exception as error:  # a damaged header fails anywhere in numpy's parser
            raise InputError(f"is no array of numpy: {error}") from None

    def write(self, path: Path, numbers: NDArray[Any], text: str) -> None:
        """Write an array."""
        buffer = io.BytesIO()
        np.save(buffer, numbers, allow_pickle=False)
        write_whole(path, buffer.getvalue())


class Fits(ImageFile):
    """First image of a FITS file; pixels that BLANK or NaN mark as missing stay so, and are black for faults."""

    endings = (".fits", ".fit", ".fts")

    def __init__(self, path: Path) -> None:
        """Read a FITS file."""
        fits = _astropy_fits()
        self._data = user_files.read_input(path, "image")
        try:
            with fits.open(io.BytesIO(self._data), do_not_scale_image_data=True, memmap=False) as file:
                number = next((k for k, part in enumerate(file) if part.is_image and part.data is not None), None)
                if number is None:
                    raise InputError("is a FITS file without an image")
                file.verify("silentfix+ignore")  # as writing does, so that what it cannot do ends here
                part = file[number]
                stored, blank = part.data, part.header.get("BLANK")
                scale, zero = float(part.header.get("BSCALE", 1)), float(part.header.get("BZERO", 0))
        except InputError:
            raise
        except Exception:  # a damaged file fails anywhere in astropy
            raise InputError("is a damaged FITS file") from None
        self._number, self._scale = number, (scale, zero)
        if stored.ndim == 3 and stored.shape[0] == 3:
            raise InputError("is a FITS file of three planes; save the grey image, or each plane alone")
        if stored.ndim != 2:
            raise InputError(f"is a FITS file with an image of {stored.ndim} axes; must have 2")
        kind, size = stored.dtype.kind, stored.dtype.itemsize
        self._missing = ~np.isfinite(stored) if kind == "f" else np.zeros(stored.shape, bool)
        if kind != "f" and blank is not None:
            self._missing = stored == blank
        unsigned = kind == "i" and zero == 2.0 ** (8 * size - 1)
        if kind != "f" and scale == 1 and size <= 4 and (zero == 0 or unsigned):
            values: NDArray[Any] = stored.astype(np.int64) + int(zero)
            values = values.astype(f"u{size}" if unsigned else stored.dtype)
        else:
            values = stored.astype(np.float64) * scale + zero
        self.numbers = np.where(self._missing, 0, values).astype(values.dtype.newbyteorder("="))

    def write(self, path: Path, numbers: NDArray[Any], text: str) -> None:
        """Write a FITS file with the header of this one and a line of history."""
        fits = _astropy_fits()
        changed = (numbers != self.numbers) & ~self._missing
        scale, zero = self._scale
        back = (numbers[changed].astype(np.float64) - zero) / scale
        buffer = io.BytesIO()
        with fits.open(io.BytesIO(self._data), do_not_scale_image_data=True, memmap=False) as file:
            part = file[self._number]
            if part.data.dtype.kind in "ui":
                limits = np.iinfo(part.data.dtype)
                back = np.clip(np.rint(back), limits.min, limits.max)
            part.data[changed] = back
            if isinstance(part, fits.CompImageHDU):  # other compressions may round numbers
                part.compression_type, part.quantize_level = "GZIP_2", 0
            part.header["HISTORY"] = text[:70]
            file.verify("silentfix+ignore")  # a card that is against the standard stays as it is
            for key, update in (("DATASUM", part.add_datasum), ("CHECKSUM", part.add_checksum)):
                if key in part.header:
                    update("updated by vbnfault")  # not the time, so that the same faults give the same bytes
            file.writeto(buffer, output_verify="ignore")
        write_whole(path, buffer.getvalue())


def _astropy_fits() -> Any:
    """Return astropy's module of FITS files. Raises InputError if it is not installed."""
    try:
        from astropy.io import fits  # takes half a second to import
    except ImportError as error:
        raise InputError("needs astropy: pip install 'vbnfault[fits]'") from error
    return fits


class Exr(ImageFile):
    """OpenEXR with the channels R, G, B or Y; Z, where it is given, is depth along the boresight.

    Of a file with layers, such as `ViewLayer.Combined.R` of Blender, the first with these channels counts.
    """

    endings = (".exr",)

    def __init__(self, path: Path) -> None:
        """Read an OpenEXR file."""
        user_files.read_input(path, "image")  # no folder, pipe or device
        self._file, channels = images.read_exr(path)
        layers = dict.fromkeys(name[: name.rfind(".") + 1] for name in sorted(channels))
        choices = [[layer + name for name in kind] for kind in ("RGB", "Y") for layer in layers]
        names = next((choice for choice in choices if channels.keys() >= set(choice)), None)
        if names is None:
            known = ", ".join(channels)
            raise InputError(f"is an OpenEXR file with the channels {known}; must have R, G and B, or Y")
        self._names = names
        stack = np.stack([channels[name] for name in names], axis=-1)
        self.numbers = stack[..., 0] if len(names) == 1 else stack
        depth = next((channels[layer + "Z"] for layer in layers if layer + "Z" in channels), None)
        if depth is not None:
            self.depth_m = np.where(depth >= _SKY_M, np.inf, depth).astype(np.float32)

    def write(self, path: Path, numbers: NDArray[Any], text: str) -> None:
        """Write an OpenEXR file with the other channels, parts and attributes of this one."""
        planes = np.moveaxis(np.atleast_3d(numbers), -1, 0)
        images.write_exr_like(path, self._file, dict(zip(self._names, planes, strict=True)), text)


class Pds(ImageFile):
    """Image of PDS3 or PDS4; the label stays byte for byte, and pixels that it calls missing stay so.

    The data may have any ending if a label of the same name lies beside them.
    """

    endings = (".img",)

    def __init__(self, path: Path) -> None:
        """Read the image of a data file and its label."""
        self._path, self._data = path, user_files.read_input(path, "image")
        self._block = planetary.find_block(path, self._data, MOST_VALUES)
        stored = self._block.view(self._data)
        self._missing = np.isin(stored, np.array(self._block.missing)) | ~np.isfinite(stored)
        self.numbers = np.where(self._missing, 0, stored).astype(stored.dtype.newbyteorder("="))

    def write(self, path: Path, numbers: NDArray[Any], text: str) -> None:
        """Write the data with other numbers, and a label beside them as it was."""
        data = bytearray(self._data)
        np.copyto(self._block.view(data), numbers, casting="same_kind", where=~self._missing)
        label = planetary.label_of(self._path)
        if label is not None:
            write_whole(path.with_name(label.name), label.read_bytes())
        write_whole(path, bytes(data))


_KINDS = {ending: kind for kind in (Png, Tiff, Npy, Fits, Exr, Pds) for ending in kind.endings}
ENDINGS = tuple(_KINDS)


def source_files(path: Path) -> tuple[Path, ...]:
    """Return the file of an image, and its label where that lies beside."""
    label = planetary.label_of(path) if _kind(path) is Pds else None
    return (path,) if label is None else (path, label)


def _kind(path: Path) -> type[ImageFile] | None:
    """Return how a file is read."""
    return _KINDS.get(path.suffix.lower(), Pds if planetary.label_of(path) else None)


def read_image(path: Path) -> ImageFile:
    """Return the image of a file. Raises InputError, which names the file, if it cannot be used."""
    kind = _kind(path)
    if kind is None:
        lossy = path.suffix.lower() in (".jpg", ".jpeg", ".webp")
        why = "; its compression would change every pixel again, so save it as PNG or TIFF" if lossy else ""
        raise InputError(f"{path}: must end with one of {', '.join(ENDINGS)}{why}")
    try:
        return kind(path)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None
