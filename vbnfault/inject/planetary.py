"""Find the block of an image in the files of planetary archives: PDS3 with its label attached or beside, and PDS4.

The readers `pdr` and `pds4_tools` read label and image. They do not write, so the place of the numbers is computed
from the label too, and taken only where it has the numbers that the reader read.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import user_files
from ..core.files.tiff import check_values

_LABELS = (".xml", ".XML", ".lbl", ".LBL")
_MOST_LABEL_BYTES = 16 * user_files.MIB
# Special constants of labels (PDS3 data dictionary; PDS4's Special_Constants). What PDS4 calls valid or saturated
# is light.
_PDS3_MISSING = ("MISSING", "INVALID", "NULL", "UNKNOWN", "NOT_APPLICABLE", "CORE_NULL", "SAMPLE_NULL")
_PDS4_MISSING = ("missing", "invalid", "error", "unknown", "not_applicable")


@dataclass(frozen=True, kw_only=True)
class Block:
    """Describe where the numbers of an image lie in a file.

    Attributes
    ----------
    offset_bytes, line_bytes
        Place of the first pixel, and bytes from a line to the next.
    shape, dtype
        Lines and samples of a line, and their data type with its order of bytes.
    missing
        Numbers that the label gives to pixels without a value.
    """

    offset_bytes: int
    line_bytes: int
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    missing: tuple[float, ...] = ()

    def view(self, data: bytes | bytearray) -> NDArray[Any]:
        """Return the numbers of a file's bytes, [y, x] in the order of its lines, as a view of them."""
        strides = (self.line_bytes, self.dtype.itemsize)
        last = self.offset_bytes + (self.shape[0] - 1) * strides[0] + self.shape[1] * strides[1]
        if last > len(data):
            raise InputError(f"ends before its last pixel: has {len(data)} bytes, and the label says {last}")
        return np.ndarray(self.shape, self.dtype, data, self.offset_bytes, strides)


def label_of(path: Path) -> Path | None:
    """Return the label beside the data of an image; None if the file itself must hold it."""
    return next((p for ending in _LABELS if (p := path.with_suffix(ending)).is_file() and p != path), None)


def find_block(path: Path, data: bytes, most_values: int) -> Block:
    """Return where the numbers of an image lie in its file, whose bytes are `data`.

    Raises
    ------
    InputError
        Label and file do not fit, or the image is of a kind that cannot be written. The message goes on from the
        file's name.
    """
    label = label_of(path)
    if label is not None:
        user_files.read_input(label, "image", limit_bytes=_MOST_LABEL_BYTES)
    is_pds4 = label is not None and label.suffix.lower() == ".xml"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            block, read = (_pds4 if is_pds4 else _pds3)(path, label or path)
            check_values(*block.shape, 1, most_values)
            numbers = block.view(data)
            if not np.array_equal(numbers, read(), equal_nan=block.dtype.kind == "f"):
                raise InputError("has an image whose place in the file is not what its label says")
        except InputError:
            raise
        except Exception as error:  # a damaged label fails anywhere in the readers
            what = f"its label {label.name}" if label else "its label"
            raise InputError(f"is no image of PDS that can be read: {what}: {_line(error)}") from None
    return block


def _pds3(path: Path, label: Path) -> tuple[Block, Any]:
    """Return the block of an image with a label of PDS3, and what reads it by another way."""
    try:
        import pdr
        from pdr.datatypes import sample_types
        from pdr.loaders.queries import data_start_byte, get_block, get_target
    except ImportError as error:
        raise InputError(_MISSING_PACKAGES) from error

    product = pdr.read(str(label))
    images = {name: get_target(product, name) for name in product.index if name.endswith("IMAGE")}
    names = [name for name, target in images.items() if _file_of(target, label).lower() == path.name.lower()]
    if not names:
        raise InputError(
            f"has no IMAGE in the label {label.name}; it must be in the file itself or lie beside it with "
            "the same name and the ending .lbl or .xml"
        )
    name = "IMAGE" if "IMAGE" in names else names[0]
    table, target = get_block(product, name), images[name]
    bands, kind = table.get("BANDS", 1), str(table["SAMPLE_TYPE"])
    if bands != 1:
        raise InputError(f"has an image of {bands} bands; save the one that is meant alone")
    if "ENCODING_TYPE" in table and str(table["ENCODING_TYPE"]) != "N/A":
        raise InputError(f"has an image that is compressed, {table['ENCODING_TYPE']}; decompress it")
    dtype = np.dtype(sample_types(kind, table["SAMPLE_BITS"] // 8, for_numpy=True))
    _check_kind(dtype, kind, table["SAMPLE_BITS"])
    before, after = (table.get(f"LINE_{side}_BYTES", 0) for side in ("PREFIX", "SUFFIX"))
    start = data_start_byte(product.identifiers, table, target, str(path))
    named = (table.get(f"{key}_CONSTANT", table.get(key)) for key in _PDS3_MISSING)
    return Block(
        offset_bytes=start + before,
        line_bytes=before + table["LINE_SAMPLES"] * dtype.itemsize + after,
        shape=(table["LINES"], table["LINE_SAMPLES"]),
        dtype=dtype,
        missing=_numbers(named),
    ), lambda: product[name]


def _pds4(path: Path, label: Path) -> tuple[Block, Any]:
    """Return the block of an image with a label of PDS4, and what reads it by another way."""
    try:
        import pds4_tools
    except ImportError as error:
        raise InputError(_MISSING_PACKAGES) from error

    every = pds4_tools.read(str(label), lazy_load=True, quiet=True, no_scale=True)
    arrays = [part for part in every if part.is_array() and Path(part.parent_filename).name == path.name]
    if not arrays:
        raise InputError(f"has no array in the label {label.name}")
    part = next((array for array in arrays if array.meta_data.num_axes() == 2), None)
    if part is None:
        raise InputError(f"has an array of {arrays[0].meta_data.num_axes()} axes; must have 2")
    meta, kind = part.meta_data, str(part.meta_data.data_type())
    rows, columns = (int(n) for n in meta.dimensions())
    dtype = np.dtype(pds4_tools.reader.data_types.pds_to_numpy_type(kind))
    _check_kind(dtype, kind, 8 * dtype.itemsize)
    constants = meta.get("Special_Constants") or {}
    return Block(
        offset_bytes=int(meta["offset"]),
        line_bytes=columns * dtype.itemsize,
        shape=(rows, columns),
        dtype=dtype,
        missing=_numbers(constants.get(f"{name}_constant") for name in _PDS4_MISSING),
    ), lambda: np.asarray(part.data)


_MISSING_PACKAGES = "needs pdr and pds4_tools: pip install 'vbnfault[pds]'"


def _check_kind(dtype: np.dtype[Any], kind: str, bits: int) -> None:
    """Raise InputError for samples that are no plain numbers."""
    exotic = any(word in kind for word in ("VAX_REAL", "IBM_REAL"))
    if exotic or dtype.kind not in "uif" or 8 * dtype.itemsize != bits:
        raise InputError(f"has samples of the type {kind} of {bits} bits; must be integers or IEEE reals")


def _file_of(target: Any, label: Path) -> str:
    """Return the name of the file to which a pointer of PDS3 points: `"A.IMG"`, `("A.IMG", 4)`, or a record."""
    first = target[0] if isinstance(target, Sequence) and not isinstance(target, str) else target
    return first if isinstance(first, str) else label.name


def _numbers(values: Any) -> tuple[float, ...]:
    """Return those values of a label that are numbers."""
    found = []
    for value in values:
        try:
            found.append(float(value))
        except (TypeError, ValueError):
            continue
    return tuple(found)


def _line(error: Exception) -> str:
    """Return the message of a reader in one line."""
    text = " ".join(str(error).split())[:200] or type(error).__name__
    return f"{text} is missing or unknown" if isinstance(error, KeyError) else text
