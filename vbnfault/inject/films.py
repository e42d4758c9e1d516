"""Take films apart into images, and put images together as a film in FFV1, which loses nothing.

The frames lie on the disk as PNG, so that memory does not grow with the length of a film, and an interrupted batch
continues as with any other images.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import user_files
from ..core.files.films import pyav
from ..core.files.images import png_numbers, write_png
from ..core.files.tiff import check_values
from ..core.files.whole_files import replacing, write_json
from ..core.process.interrupts import check

# By the ending, the only format that is looked for: playlists, which name other files, are none of them.
_FORMATS = {".mp4": "mov", ".mov": "mov", ".mkv": "matroska", ".avi": "avi"}
ENDINGS = tuple(_FORMATS)
_RECORD = "film.json"
# Formats of pixels by channels and bits: of the images, and of FFV1, which holds RGB without a matrix
_FORMATS_OF_PIXELS = {
    (1, 8): ("gray", "gray"),
    (1, 16): ("gray16le", "gray16le"),
    (3, 8): ("rgb24", "bgr0"),
    (3, 16): ("rgb48le", "gbrp16le"),
}

_GREY_LEVELS = 4  # of 255, between the channels: lossy codecs give grey a colour of 2
# Version 3 of FFV1 has checksums; slices are coded alone, so that the number of threads does not matter.
_CODER = {"level": "3", "slices": "4", "slicecrc": "1", "threads": "1"}


@dataclass(frozen=True, kw_only=True)
class Film:
    """Describe the frames of a film.

    Attributes
    ----------
    sha256
        Digest of its file.
    frames
        Number of frames that were decoded.
    rate
        Frames a second, as a fraction.
    ended
        Where and why it ended before its last frame, a sentence; "" if it did not.
    """

    sha256: str
    frames: int
    rate: str
    ended: str


def unpack(path: Path, folder: Path, most_values: int) -> Film:
    """Write the frames of a film as PNG, `000001.png` and so on, and return what the film is.

    Frames that an earlier call wrote of the same file are kept. Raises InputError if the file cannot be read at
    all, or PyAV is not installed.
    """
    av = pyav()
    sha256 = user_files.sha256_of_input(path, "film")
    record = folder / _RECORD
    try:
        known = Film(**json.loads(record.read_text(encoding="utf-8")))
        if known.sha256 == sha256:
            return known
    except (OSError, ValueError, TypeError):
        pass
    record.unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    grey = _is_grey(path, most_values)
    number, rate, ended = 0, Fraction(25), ""
    try:
        with _opened(path, most_values) as (container, stream):
            rate, last = stream.average_rate or rate, None
            for frame in container.decode(stream):
                check()
                if frame.is_corrupt:
                    ended = "is damaged"
                    break
                last, number = frame, number + 1
                write_png(frame_path(folder, number), _pixels(frame, stream, grey=grey))
            else:
                ended = _lack(container, stream, number, last)
    except av.error.FFmpegError as error:
        ended = f"cannot be decoded: {error.strerror}"
    if ended:
        ended = f"{path}: frame {number + 1} {ended}; what comes before it is made"
    film = Film(sha256=sha256, frames=number, rate=str(rate), ended=ended)
    write_json(record, asdict(film))
    return film


def frame_path(folder: Path, number: int) -> Path:
    """Return the path of a frame, counted from 1."""
    return folder / f"{number:06d}.png"


def assemble(folder: Path, path: Path, film: Film) -> None:
    """Write the frames of a folder as a film in FFV1; equal frames give equal bytes."""
    av = pyav()
    with (
        replacing(path) as temporary,
        av.open(str(temporary), "w", format="matroska", options={"fflags": "+bitexact"}) as container,
    ):
        stream = None
        for number in range(1, film.frames + 1):
            check()
            image = np.squeeze(png_numbers(frame_path(folder, number).read_bytes(), 2**40))
            given, coded = _FORMATS_OF_PIXELS[3 if image.ndim == 3 else 1, 8 * image.itemsize]
            if stream is None:
                stream = container.add_stream("ffv1", rate=Fraction(film.rate), options=_CODER)
                stream.height, stream.width, stream.pix_fmt = *image.shape[:2], coded
            frame = av.VideoFrame.from_ndarray(image, format=given)
            container.mux(stream.encode(frame.reformat(format=coded)))
        if stream is not None:
            container.mux(stream.encode())


@contextmanager
def _opened(path: Path, most_values: int) -> Iterator[tuple[Any, Any]]:
    """Open a film, and give its container and its stream of images. Raises InputError, or FFmpegError of PyAV."""
    with pyav().open(str(path), format=_FORMATS[path.suffix.lower()], metadata_errors="replace") as container:
        stream = next(iter(container.streams.video), None)
        if stream is None or stream.codec_context is None:
            raise InputError(f"{path}: has no images, or images of an unknown codec")
        try:
            check_values(stream.height, stream.width, 3, most_values)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        stream.codec_context.options = {"err_detect": "explode"}  # a damaged frame is an error and not guessed
        yield container, stream


def _is_grey(path: Path, most_values: int) -> bool:
    """Return whether no frame of a film has a colour: many codecs know colours only, and grey cameras use them."""
    with suppress(pyav().error.FFmpegError), _opened(path, most_values) as (container, stream):
        for frame in container.decode(stream):
            levels = frame.reformat(format="rgb24").to_ndarray()
            if (np.ptp(levels, axis=2) > _GREY_LEVELS).any():
                return False
    return True


def _pixels(frame: Any, stream: Any, *, grey: bool) -> NDArray[Any]:
    """Return a frame as grey [y, x] or RGB [y, x, 3], of 16 bits where the film has more than 8."""
    bits = 16 if max(part.bits for part in frame.format.components) > 8 else 8
    given, _ = _FORMATS_OF_PIXELS[1 if grey else 3, bits]
    return np.asarray(frame.reformat(stream.width, stream.height, given).to_ndarray())


def _lack(container: Any, stream: Any, number: int, last: Any) -> str:
    """Return what is wrong if a film is longer than its frames, by what its header says; "" if it is whole.

    Frames that an edit cuts off are counted in the header, too, so its duration must not be reached either.
    """
    if number == 0:
        return "is missing"
    length_s = None
    if stream.duration:
        length_s = float((stream.start_time or 0) + stream.duration) * float(stream.time_base)
    elif container.duration and len(container.streams) == 1:
        length_s = container.duration / 1e6
    if length_s is None or last.time is None:
        return f"is missing: the film has {stream.frames}" if number < stream.frames else ""
    # a whole film ends one step after its last frame begins, where the steps are equal
    steps = (length_s - last.time) * float(stream.average_rate or 25)
    if steps > 2 or (steps > 1.5 and number < stream.frames):
        return f"is missing: the film lasts {length_s:.2f} s"
    return ""
