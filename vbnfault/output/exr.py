"""Write OpenEXR files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..core.errors import VbnfaultError


def write_exr(path: Path, channels: Mapping[str, NDArray[Any]]) -> None:
    """Write named channels, float16, float32 or uint32 [y, x] of one size, to a file.

    Raises OSError if the file cannot be opened, and VbnfaultError if writing fails later, as on a full disk.
    """
    import OpenEXR

    path.write_bytes(b"")  # raises OSError with the system's reason; OpenEXR raises RuntimeError
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        # OpenEXR accepts writeable arrays only
        OpenEXR.File(header, {name: array.copy() for name, array in channels.items()}).write(str(path))
    except RuntimeError as error:
        raise VbnfaultError(f"{path}: cannot be written: {error}") from None
