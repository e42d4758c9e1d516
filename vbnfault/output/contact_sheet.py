"""Draw the contact sheet of a dataset: `vbnfault preview`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files.images import write_png
from ..core.files.whole_files import writing
from ..core.quantities import Sample
from ..dataset.statistics import finished_scalars
from ..store import STRATA, Store, StoreSpec, open_store

U8 = NDArray[np.uint8]

# R, G, B of each fault class in dataset order: distinct on dark images and for colour-blind readers (after Okabe
# and Ito).
COLOURS = (
    (240, 228, 66),
    (86, 200, 255),
    (255, 94, 77),
    (255, 160, 20),
    (0, 190, 140),
    (204, 121, 200),
    (190, 200, 210),
    (120, 140, 255),
    (150, 230, 60),
    (255, 130, 190),
    (0, 205, 215),
    (200, 150, 100),
    (165, 95, 255),
    (250, 250, 250),
    (60, 110, 255),
)
_BACKGROUND, _PANEL, _TEXT, _FAINT = (18, 20, 24), (30, 33, 39), (225, 228, 232), (150, 156, 166)
TILE_PX = 320  # longer side of a tile
_CAPTION_GROWS_PX = 640  # from this longer side of a tile on
_GAP_PX, _CAPTION_PX, _LINE_PX = 14, 46, 24
_FILL = 0.30  # opacity of a mask
_WHOLE_FRAME = 0.98  # a localised class whose mask covers more than this fraction is drawn as a border, too


def preview(
    store: str | os.PathLike[str] | Store,
    out_png: str | os.PathLike[str],
    *,
    max_samples: int = 16,
    masks: bool = True,
) -> int:
    """Write a contact sheet of up to `max_samples` finished samples, spread evenly over the store.

    Each tile shows the image, tinted by the mask of every injected fault in the fault's colour. The caption gives
    sample, stratum, site and faults. Frames of sequences are film strips, a row for each of some sequences, with
    their times.

    Parameters
    ----------
    store
        A store or its path.
    out_png
        File to write; its name must end in .png.
    masks
        Whether to draw the masks.

    Returns
    -------
    int
        Number of tiles.

    Raises
    ------
    InputError
        If there is no store or no finished sample, or the file name or its folder cannot be used.
    VbnfaultError
        If the file cannot be written for another reason.
    """
    store = open_store(store)
    if max_samples < 1:
        raise InputError(f"max_samples = {max_samples}: must be at least 1")
    done = [i for number in range(store.shards) for i, whole in store.done(number).items() if whole]
    if not done:
        raise InputError(f"{store.path}: {store.why_none_is_finished()}, so there is nothing to show")
    short = abbreviations(store.spec.faults)
    if store.spec.sequence_names:
        parts = [(samples, of["sequence"]) for samples, of in finished_scalars(store, ("sequence",))]
        samples, sequence = (np.concatenate(column) for column in zip(*parts, strict=True))
        found = film_strips(sequence, max(1, round(np.sqrt(max_samples / 3))), max_samples)
        strips = [samples[positions].tolist() for positions in found]
        columns = max(map(len, strips))
    else:
        strips = [[done[k] for k in spread(len(done), max_samples)]]
        columns = min(len(strips[0]), max(1, round(np.sqrt(len(strips[0]) * 1.25))))
    layers = ("image", "mask") if masks and store.spec.faults else ("image",)
    tiles = [[tile(store.spec, store.read_sample(i, layers), short, TILE_PX) for i in strip] for strip in strips]
    body = np.vstack([_grid(strip, columns)[0 if k == 0 else _GAP_PX :] for k, strip in enumerate(tiles)])
    count = sum(map(len, tiles))
    name = f"{store.path.name}: {count} of {store.samples} samples"
    sheet = np.vstack([_header(name, store.spec.faults, short, body.shape[1]), body])
    if Path(out_png).suffix.lower() != ".png":
        raise InputError(f"{out_png}: the sheet is a PNG, so its name must end in .png")
    with writing(out_png):
        write_png(Path(out_png), sheet)
    return count


def film_strips(
    sequence: NDArray[np.integer], most_sequences: int, most_frames: int, longest: int | None = None
) -> list[NDArray[np.int64]]:
    """Return the positions of frames of some sequences, evenly spaced in each; `sequence`: that of each sample.

    A strip has at most `longest` frames, and all of them together at most `most_frames`.
    """
    order = np.argsort(sequence, kind="stable")
    frames = np.split(order, 1 + np.flatnonzero(np.diff(sequence[order])))
    shown = spread(len(frames), most_sequences)
    most = most_frames // len(shown)
    return [frames[k][spread(len(frames[k]), min(most, longest or most))] for k in shown]


def spread(count: int, most: int) -> NDArray[np.int64]:
    """Return up to `most` of the numbers 0 to `count` - 1, evenly spaced and ascending."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))[:count]


def abbreviations(faults: Sequence[str]) -> dict[str, str]:
    """Return an abbreviation of each fault's name: the initials of its words (`dust_on_optics`: DO).

    If two faults have the same initials, one gets more letters.
    """
    short: dict[str, str] = {}
    for fault in faults:
        words = [w for w in fault.split("_") if w not in ("on", "of", "the")]
        for n in range(1, len(fault) + 1):
            candidate = "".join(w[:1] for w in words[:-1]).upper() + words[-1][:n].capitalize()
            if n == 1:
                candidate = candidate.upper() if len(words) > 1 else words[0][:2].capitalize()
            if candidate not in short.values():
                break
        short[fault] = candidate
    return short


def names_that_fit(faults: Sequence[str], width_px: int) -> dict[str, str]:
    """Return the name of each fault, or abbreviations where all names do not fit in a caption of a tile's width."""
    words = {fault: fault.replace("_", " ") for fault in faults}
    needed = 16 + sum(22 + _text_width(name, 0.4) for name in words.values())
    return words if needed <= min(width_px, _CAPTION_GROWS_PX) else abbreviations(faults)


def overlay(
    rgb: U8,
    mask: NDArray[np.bool_],
    injected: Sequence[bool],
    localised: Sequence[bool] | None = None,
    line_px: int | None = None,
) -> U8:
    """Return an RGB image with the masks of the injected faults drawn on it, each as a tint and an outline.

    A class that is not localised, such as banding, and a mask that covers nearly the whole image are drawn as a
    border instead, so that the image and the other masks stay visible. Several borders are nested.

    Parameters
    ----------
    rgb
        Image, uint8[y, x, 3]; not changed.
    mask
        Masks, bool[fault, y, x].
    injected
        Which faults are injected, bool[fault].
    localised
        Which classes mark parts of an image, bool[fault]; by default all.
    line_px
        Width of the outlines; by default a 300th of the image's longer side.
    """
    out = rgb.copy()
    height, width = rgb.shape[:2]
    line = line_px or max(1, round(max(height, width) / 300))
    borders = 0
    for k in sorted(np.flatnonzero(injected).tolist(), key=lambda k: -int(mask[k].sum())):
        colour = COLOURS[k % len(COLOURS)]
        whole = localised is not None and not localised[k]
        if whole or mask[k].mean() > _WHOLE_FRAME:
            inset = borders * 3 * line + line
            cv2.rectangle(out, (inset, inset), (width - 1 - inset, height - 1 - inset), colour, 2 * line)
            borders += 1
            continue
        veil = out[mask[k]] * (1 - _FILL) + np.array(colour) * _FILL
        out[mask[k]] = veil.astype(np.uint8)
        contours, _ = cv2.findContours(mask[k].astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, contours, -1, colour, line, cv2.LINE_AA)
    return out


def tile(spec: StoreSpec, sample: Sample, names: Mapping[str, str], side_px: int) -> U8:
    """Draw a sample with its masks, if it was read with them, and below it a caption with its faults' `names`.

    Parameters
    ----------
    side_px
        Longer side of the image within the tile. The caption grows with it from 640 px on.
    """
    scale, k = side_px / max(spec.height, spec.width), max(1.0, side_px / _CAPTION_GROWS_PX)
    size = (max(1, round(spec.width * scale)), max(1, round(spec.height * scale)))
    # a shrunk mask is True where any of its pixels is, so that a single broken pixel stays visible
    rgb = resized(sample.layers["image"][..., :3], size)
    injected = sample.scalars["injected"].astype(bool)
    if "mask" in sample.layers:
        small = np.stack([resized_mask(m, size) for m in sample.layers["mask"]])
        localised = [fault in (spec.localised_faults or ()) for fault in spec.faults]
        rgb = overlay(rgb, small, injected.tolist(), localised, max(1, round(side_px / 700)))
    drawn = np.full((size[1] + round(k * _CAPTION_PX), size[0], 3), _PANEL, np.uint8)
    drawn[: size[1]] = rgb

    def at(x: float, y: float) -> tuple[int, int]:
        return round(x), size[1] + round(k * y)

    _write(drawn, f"#{sample.index}", at(8 * k, 19), _TEXT, 0.48 * k)
    right = _of_tile(spec, sample)
    _write(drawn, right, at(size[0] - 8 * k - _text_width(right, 0.4 * k), 19), _FAINT, 0.4 * k)
    x = 8 * k
    for fault in np.flatnonzero(injected):
        name = names[spec.faults[fault]]
        cv2.circle(drawn, at(x + 4 * k, 34), round(4 * k), COLOURS[fault % len(COLOURS)], -1, cv2.LINE_AA)
        _write(drawn, name, at(x + 12 * k, 38), _TEXT, 0.4 * k)
        x += 22 * k + _text_width(name, 0.4 * k)
    if not injected.any():
        _write(drawn, "no fault", at(8 * k, 38), _FAINT, 0.4 * k)
    return drawn


def _of_tile(spec: StoreSpec, sample: Sample) -> str:
    """Return what a caption says of a sample: sequence and time, or else stratum and site."""
    scalars = sample.scalars
    if spec.sequence_names:
        sequence, time_s = int(scalars["sequence"]), float(scalars["time_s"])
        return f"{spec.sequence_names[sequence]}  {time_s:.6g} s" if sequence < len(spec.sequence_names) else ""
    site = int(scalars["site"])
    name = spec.site_names[site] if 0 <= site < len(spec.site_names) else f"site {site}"
    return f"{STRATA[int(scalars['stratum'])]}  {name}"


def resized(image: U8, size: tuple[int, int]) -> U8:
    """Return an image at a size (width, height): shrunk by averaging, enlarged without interpolation."""
    shrinks = size[0] <= image.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(np.ascontiguousarray(image), size, interpolation=how), dtype=np.uint8)


def resized_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask at a size (width, height); a new pixel is True if any mask pixel inside it is."""
    if size[0] > mask.shape[1]:
        return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1e-6


def _grid(tiles: Sequence[U8], columns: int) -> U8:
    """Return the tiles in rows of `columns`, with gaps between them."""
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    shape = (rows * (height + _GAP_PX) + _GAP_PX, columns * (width + _GAP_PX) + _GAP_PX, 3)
    sheet = np.full(shape, _BACKGROUND, np.uint8)
    for k, tile in enumerate(tiles):
        y = (k // columns) * (height + _GAP_PX) + _GAP_PX
        x = (k % columns) * (width + _GAP_PX) + _GAP_PX
        sheet[y : y + height, x : x + width] = tile
    return sheet


def _header(name: str, faults: Sequence[str], short: Mapping[str, str], width: int) -> U8:
    """Draw the name of the store and the legend, which takes as many lines as it needs."""
    entries = [(k, f"{short[f]}  {f.replace('_', ' ')}") for k, f in enumerate(faults)]
    positions, x, line = [], _GAP_PX, 0
    for _, text in entries:
        needed = _text_width(text, 0.42) + 38
        if x > _GAP_PX and x + needed > width - _GAP_PX:
            x, line = _GAP_PX, line + 1
        positions.append((x, line))
        x += needed
    header = np.full((46 + (line + 1) * _LINE_PX, width, 3), _BACKGROUND, np.uint8)
    _write(header, name, (_GAP_PX, 30), _TEXT, 0.6)
    for (k, text), (x, line) in zip(entries, positions, strict=True):
        y, colour = 44 + line * _LINE_PX, COLOURS[k % len(COLOURS)]
        veil = tuple(int(c * 0.55) for c in colour)
        cv2.rectangle(header, (x, y), (x + 14, y + 14), veil, -1)
        cv2.rectangle(header, (x, y), (x + 14, y + 14), colour, 1, cv2.LINE_AA)
        _write(header, text, (x + 22, y + 12), _TEXT, 0.42)
    return header


def _write(image: U8, text: str, position: tuple[int, int], colour: tuple[int, int, int], scale: float) -> None:
    """Draw text into an image; `at`: the lower left corner (x, y)."""
    plain = text.encode("ascii", "replace").decode()  # OpenCV's font has ASCII characters only
    cv2.putText(
        image, plain, position, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, max(1, round(2 * scale)), cv2.LINE_AA
    )


def _text_width(text: str, scale: float) -> int:
    """Return the width of text in pixels."""
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0])
