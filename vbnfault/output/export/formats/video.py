"""Export the sequences of a store as films: H.264 in MP4, by PyAV."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ....core.files.films import pyav
from ....core.quantities import Sample
from ....store import Store, StoreSpec
from ... import contact_sheet
from ..contract import FPS, Closing, Entry, ExportPart, Finished, Format
from ..folder import Folder

U8 = NDArray[np.uint8]

_UNEVEN = 0.01  # steps of time that differ by more, relative to their median, are said
_NAME = re.compile(r"[^A-Za-z0-9.-]+")  # what names of files do not take from names of sequences
_LONGEST = 100  # of a file's name that is a sequence's
# A rate factor of 12 is nearly without loss: 23 would smooth noise and single pixels away. A whole frame at least
# every 25 lets players step backward. With one thread and no code of a CPU's own, equal frames give equal bytes:
# otherwise 14 of 30 films differed where three coders ran side by side (x264's `mbtree`).
_CODER = {"crf": "12", "preset": "medium", "g": "25", "threads": "1", "x264-params": "cpu-independent=1"}


class Video(Format):
    """H.264 films (MP4) of the sequences: the images as they are, and with their masks for the eye.

    - `SPLIT/image/NUMBER_NAME.mp4`: the images of a sequence (R, G, B), a frame for each, in the order of time.
    - `SPLIT/masks/NUMBER_NAME.mp4`: the same frames with the masks in the colours of `vbnfault preview`, and below
      them the sample, the time and the faults. Images below 320 px are enlarged.
    - NUMBER and NAME are index and name of the sequence; characters other than letters, digits, points and hyphens
      become `_`.
    - H.264 holds even numbers of columns and rows: an odd last one is repeated. It is a codec with loss, of about
      1 DN in brightness, and four pixels share the mean of their colours: measure on the store, or on the format
      `png`.
    - Frames are evenly spaced. `time_s` and `frame` of each are in `samples.jsonl`.
    """

    name = "video"
    media_type = "video/mp4"
    pattern = "*/image/*.mp4"
    croissant_image: ClassVar = {}  # a reader takes no frames out of films
    by_sequence = True

    def __init__(self) -> None:
        pyav()  # without it, nothing is written

    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return images and masks."""
        return ("image", "mask") if spec.faults else ("image",)

    def write_part(self, store: Store, part: ExportPart, samples: Iterable[Sample], folder: Folder) -> list[Entry]:
        """Write the films of a sequence side by side, a frame at a time."""
        spec, rate = store.spec, _rate(store, part)
        image, masks = (f"{part.split}/{what}/{_stem(store, part)}.mp4" for what in ("image", "masks"))
        entries: list[Entry] = []

        def write(image_path: Path, masks_path: Path) -> None:
            with _film(image_path, rate) as add, _film(masks_path, rate) as add_drawn:
                for sample in samples:
                    add(sample.layers["image"][..., :3])
                    add_drawn(_drawn(spec, sample))
                    entries.append(Entry(sample.index, image))

        folder.put_with(masks, lambda masks_path: folder.put_with(image, lambda path: write(path, masks_path)))
        return entries

    def finish(self, finished: Finished) -> Closing:
        """Return the frame rate of each film for the card, and warn of time that is not as in the sequence."""
        lines, warnings = [], []
        for part in finished.parts:
            name, rate = _stem(finished.store, part), float(_rate(finished.store, part))
            lines.append(f"- `{part.split}/*/{name}.mp4`: {len(part.samples)} frames, {rate:.6g} a second.")
            steps = np.diff(_times(finished.store, part))
            if part.fps is None and len(steps) and not np.allclose(steps, 1 / rate, rtol=_UNEVEN):
                warnings.append(
                    f"{name}: frames are {steps.min():.6g} to {steps.max():.6g} s apart in the sequence, and "
                    f"{1 / rate:.6g} s in the film; --fps sets another rate"
                )
        if len(warnings) > 1:
            warnings = [f"{warnings[0]}; the same is true of {len(warnings) - 1} films more"]
        return Closing(lines=lines, warnings=warnings)


def _times(store: Store, part: ExportPart) -> NDArray[np.float64]:
    """Return `time_s` of the samples of a part, float64[sample]."""
    first = part.samples[0]
    times: NDArray[np.float64] = store.read("time_s", first, part.samples[-1] + 1)
    return times[np.array(part.samples) - first]


def _rate(store: Store, part: ExportPart) -> Fraction:
    """Return the frames a second of a film: as asked, or by the median step of time; one for a single frame."""
    steps = np.diff(_times(store, part))
    rate = part.fps or (1 / np.median(steps) if len(steps) else 1.0)
    return Fraction(float(np.clip(rate, *FPS))).limit_denominator(1000)


def _stem(store: Store, part: ExportPart) -> str:
    """Return the name of a sequence's films without its ending."""
    number = int(store.read("sequence", part.samples[0], part.samples[0] + 1)[0])
    return stem_of_sequence(number, store.spec.sequence_names)


def stem_of_sequence(number: int, names: Sequence[str]) -> str:
    """Return the name of a file of a sequence without its ending: its number and what a file's name takes of it."""
    name = _NAME.sub("_", names[number])[:_LONGEST] if 0 <= number < len(names) else ""
    return f"{number:0{len(str(len(names) - 1))}d}_{name}"


def _drawn(spec: StoreSpec, sample: Sample) -> U8:
    """Return the image with its masks and a caption."""
    longer = max(spec.height, spec.width)
    side_px = longer * -(-contact_sheet.TILE_PX // longer)
    names = contact_sheet.names_that_fit(spec.faults, round(side_px * spec.width / longer))
    return contact_sheet.tile(spec, sample, names, side_px)


def _yuv420(rgb: U8) -> U8:
    """Return an image uint8[y, x, RGB] of even sides as planes: brightness, and colour at half the resolution."""
    height, width = rgb.shape[:2]
    # OpenCV takes the colour of the first of four pixels, which would lose coloured defects or make them larger
    means = cv2.resize(rgb, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    planes = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
    planes[height:] = cv2.cvtColor(means.repeat(2, 0).repeat(2, 1), cv2.COLOR_RGB2YUV_I420)[height:]
    return np.asarray(planes, np.uint8)


@contextmanager
def _film(path: Path, rate: Fraction) -> Iterator[Callable[[U8], None]]:
    """Begin a film and yield what adds a frame, uint8[y, x, RGB]; equal frames give equal bytes."""
    av, frames = pyav(), itertools.count()
    options = {"fflags": "+bitexact", "movflags": "+faststart"}  # faststart: a browser plays it while it loads
    with av.open(str(path), "w", format="mp4", options=options) as container:
        stream = container.add_stream("libx264", rate=rate, options=_CODER)
        codec = stream.codec_context
        codec.pix_fmt, codec.flags = "yuv420p", codec.flags | av.codec.context.Flags.bitexact
        # by the numbers of ITU-T H.273: limited range, matrix of BT.601 as OpenCV uses it, the rest of BT.709
        codec.color_range, codec.colorspace, codec.color_primaries, codec.color_trc = 1, 6, 1, 1

        def add(rgb: U8) -> None:
            height, width = rgb.shape[:2]
            even = np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(_yuv420(even), format="yuv420p")
            if not codec.is_open:
                codec.width, codec.height = frame.width, frame.height
            frame.pts, frame.time_base = next(frames), 1 / rate
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode())
