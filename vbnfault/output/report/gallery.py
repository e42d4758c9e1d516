"""Make the gallery of a report: images with a mask for each fault, their clean twins and their parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core import images
from ...core.html_page import data_url, escaped, grouped_digits, with_minus
from ...core.quantities import Sample
from ...store import Store
from ..contact_sheet import COLOURS, resized, resized_mask
from .measure import Scalars, parsed, readable, spread

U8 = NDArray[np.uint8]

_SIDES_PX = (640, 512, 400, 320, 256, 192, 128)  # of the images; the first whose files fit is taken
_MOST_BYTES = 11_500_000  # of all images, before base64 adds a third
_LOSSLESS_PX = 160  # smaller images are PNG
_QUALITY = 88
_FILL, _FAINT_FILL = (
    77,
    36,
)  # opacity of a mask's inside: 0.30 as in the contact sheet, less for a class without place
_WHOLE_FRAME = 0.98
_FIRST = 6  # numbers of a list that are written
_MOST_ROWS = 30  # of a table of parameters


@dataclass(frozen=True, kw_only=True, eq=False)
class _Picked:
    """Hold the layers of a sample of the gallery: image and clean [y, x, 3] or None, mask [fault, y, x]."""

    position: int
    index: int
    image: U8
    clean: U8 | None
    mask: NDArray[np.bool_]
    parameters: Mapping[str, Any]
    scalars: Mapping[str, Any]


def pick(scalars: Scalars, most: int) -> list[int]:
    """Return the positions of up to `most` samples: of each class in each split at least one where there is room.

    The rest is spaced evenly over the store.
    """
    chosen: set[int] = set()
    injected = scalars.injected
    if injected.shape[1]:
        for k in range(injected.shape[1]):
            for split in range(len(scalars.split_names)):
                having = np.flatnonzero(injected[:, k] & (scalars.split == split))
                if having.size and len(chosen) < most * 2 // 3 and not chosen & set(having.tolist()):
                    chosen.add(int(having[len(having) // 2]))
    rest = [position for position in range(len(scalars.samples)) if position not in chosen]
    chosen |= {rest[k] for k in spread(len(rest), most - len(chosen)).tolist()}
    return sorted(chosen)


def gallery(store: Store, scalars: Scalars, most: int, unread: dict[int, str]) -> tuple[str, int]:
    """Return the gallery as markup, and the number of its samples.

    The reasons why samples cannot be read are added to `unread`, by position.
    """
    names = [name for name in ("image", "clean", "mask") if name in store.spec.pixel_layers]
    picked = [_picked(k, sample) for k, sample in readable(store, scalars, pick(scalars, most), names, unread)]
    if not picked:
        return "<p>No sample could be read.</p>", 0
    files: list[_Files] = []
    for side in _SIDES_PX:
        files = [_encoded(store, sample, side) for sample in picked]
        if sum(f.size for f in files) <= _MOST_BYTES:
            break
    cards = "".join(_card(store, scalars, s, f) for s, f in zip(picked, files, strict=True))
    shown = {k for s in picked for k in np.flatnonzero(scalars.injected[s.position]).tolist()}
    return f'{_tools(store, scalars, sorted(shown), len(picked))}<ul class="gallery">{cards}</ul>{_DIALOG}', len(
        picked
    )


def _picked(position: int, sample: Sample) -> _Picked:
    """Return a sample of the gallery."""
    clean = sample.layers.get("clean")
    return _Picked(
        position=position,
        index=sample.index,
        image=sample.layers["image"][..., :3],
        clean=None if clean is None else clean[..., :3],
        mask=sample.layers["mask"].astype(bool),
        parameters=parsed(sample.scalars["parameters"]),
        scalars=sample.scalars,
    )


@dataclass(frozen=True, kw_only=True)
class _Files:
    """Hold the images of a sample as addresses within the page; masks by the index of the fault."""

    image: str
    clean: str
    masks: Mapping[int, str]
    areas: Mapping[int, float]

    @property
    def size(self) -> int:
        """Return the bytes of all images before base64, about."""
        return (len(self.image) + len(self.clean) + sum(map(len, self.masks.values()))) * 3 // 4


def _encoded(store: Store, sample: _Picked, side_px: int) -> _Files:
    """Return the images of a sample, with at most `side_px` pixels on the longer side."""
    spec = store.spec
    scale = min(1.0, side_px / max(spec.height, spec.width))
    size = (max(1, round(spec.width * scale)), max(1, round(spec.height * scale)))

    def picture(rgb: U8 | None) -> str:
        if rgb is None:
            return ""
        small = resized(rgb, size)
        if max(size) <= _LOSSLESS_PX:
            return data_url(images.encoded(small, ".png"), "image/png")
        return data_url(images.encoded(small, ".webp", _QUALITY), "image/webp")

    masks, areas = {}, {}
    for k in range(len(spec.faults)):
        if sample.mask[k].any():
            localised = spec.faults[k] in (spec.localised_faults or spec.faults)
            masks[k] = data_url(
                _mask_png(resized_mask(sample.mask[k], size), COLOURS[k % len(COLOURS)], localised), "image/png"
            )
            areas[k] = float(sample.mask[k].mean())
    return _Files(image=picture(sample.image), clean=picture(sample.clean), masks=masks, areas=areas)


def _mask_png(mask: NDArray[np.bool_], colour: tuple[int, int, int], localised: bool) -> bytes:
    """Return a mask as a transparent PNG: tinted inside, with an outline."""
    padded = np.pad(mask, 1).astype(np.uint8)  # so that a mask has an outline at the edge of the frame, too
    inside = cv2.erode(padded, np.ones((3, 3), np.uint8))[1:-1, 1:-1].astype(bool)
    values = np.where(mask & ~inside, 2, mask.astype(np.uint8)).astype(np.uint8)
    fill = _FILL if localised and mask.mean() < _WHOLE_FRAME else _FAINT_FILL
    return images.indexed_png(values, ((0, 0, 0, 0), (*colour, fill), (*colour, 235)))


# --- markup -------------------------------------------------------------------------------------------------


def _tools(store: Store, scalars: Scalars, shown: Sequence[int], count: int) -> str:
    """Return the buttons above the gallery: one for each mask, the flip, and two filters."""
    buttons = []
    for key, k in enumerate(shown, 1):
        fault = store.spec.faults[k]
        pressed = "true" if fault in (store.spec.localised_faults or store.spec.faults) else "false"
        hint = f"<kbd>{key}</kbd>" if key <= 9 else ""
        buttons.append(
            f'<button type="button" class="toggle" data-fault="{k}" aria-pressed="{pressed}" '
            f'style="--c:var(--f{k})"><i></i>{_words(fault)}{hint}</button>'
        )
    splits = "".join(f'<option value="{k}">{escaped(name)}</option>' for k, name in enumerate(scalars.split_names))
    classes = "".join(
        f'<option value="{k}">{escaped(store.spec.faults[k].replace("_", " "))}</option>' for k in shown
    )
    every = '<option value="">all</option>'
    return (
        f'<div class="tools" role="toolbar" aria-label="Gallery"><div class="toggles">{"".join(buttons)}'
        '<button type="button" class="toggle flip" aria-pressed="false" style="--c:var(--ink)"><i></i>clean twin'
        f"<kbd>c</kbd></button>{_BRIGHTER}</div>"
        f'<div class="filters"><label>split <select id="g-split">{every}{splits}</select></label>'
        f'<label>class <select id="g-class">{every}{classes}<option value="none">no fault</option></select></label>'
        f'<output id="g-count">{count} shown</output></div></div>'
    )


def _card(store: Store, scalars: Scalars, sample: _Picked, files: _Files) -> str:
    """Return one sample of the gallery."""
    spec = store.spec
    faults = np.flatnonzero(scalars.injected[sample.position]).tolist()
    split, stratum = scalars.split_names[scalars.split[sample.position]], scalars.stratum(sample.position)
    words = ", ".join(spec.faults[k].replace("_", " ") for k in faults) or "no fault"
    size = f'width="{spec.width}" height="{spec.height}"'
    coarse = " coarse" if max(spec.width, spec.height) <= _LOSSLESS_PX else ""
    layers = f'<img class="image" alt="Sample {sample.index}: {escaped(words)}" {size} src="{files.image}">'
    if files.clean:
        layers += f'<img class="clean" alt="" {size} src="{files.clean}">'
    for k, source in files.masks.items():
        layers += f'<img class="mask" data-fault="{k}" alt="" {size} src="{source}">'
    dots = "".join(f'<i style="background:var(--f{k})" title="{escaped(spec.faults[k])}"></i>' for k in faults)
    return (
        f'<li class="card" data-split="{scalars.split[sample.position]}" '
        f'data-faults="{" ".join(map(str, faults))}">'
        f'<button type="button" class="open" aria-label="Open sample {sample.index}: {escaped(words)}">'
        f'<span class="frame{coarse}">{layers}</span></button>'
        f"<p><b>{sample.index}</b> <span>{escaped(split)}, {escaped(stratum)}</span>"
        f'<span class="dots-of">{dots}</span></p>'
        f"<template>{_details(store, scalars, sample, files, faults)}</template></li>"
    )


def _details(store: Store, scalars: Scalars, sample: _Picked, files: _Files, faults: Sequence[int]) -> str:
    """Return what the open sample shows beside its image."""
    spec, values = store.spec, sample.scalars
    split, stratum = scalars.split_names[scalars.split[sample.position]], scalars.stratum(sample.position)
    site = int(values.get("site", -1))
    facts = {
        "split": split,
        "stratum": stratum,
        "site": spec.site_names[site] if 0 <= site < len(spec.site_names) else str(site),
        "exposure": f"{number_text(values.get('exposure_s'))} s",
        "Sun elevation": f"{number_text(values.get('sun_elevation_deg'))}°",
        "Sun azimuth": f"{number_text(values.get('sun_azimuth_deg'))}°",
        "Sun visible": number_text(values.get("sun_visible_fraction")),
    }
    listed = "".join(f"<div><dt>{escaped(k)}</dt><dd>{escaped(v)}</dd></div>" for k, v in facts.items())
    parts = [f'<h3 tabindex="-1">Sample {sample.index}</h3><dl class="short">{listed}</dl>']
    if not faults:
        parts.append("<p>No fault is injected.</p>")
    for k in faults:
        area = f"{100 * files.areas[k]:.2g}\N{NO-BREAK SPACE}% of the frame" if k in files.areas else "no mask"
        parts.append(
            f'<details open class="fault" style="--c:var(--f{k})"><summary><i></i>{_words(spec.faults[k])}'
            f" <span>{area}</span></summary>{parameter_table(sample.parameters.get(spec.faults[k], {}))}</details>"
        )
    return "".join(parts)


def parameter_table(drawn: Any) -> str:
    """Return the drawn parameters of a fault as tables; long lists are shortened to their range."""
    if not isinstance(drawn, Mapping) or not drawn:
        return "<p>no parameters</p>"
    rows, tables = [], []
    for name, value in list(drawn.items())[:_MOST_ROWS]:
        if isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            tables.append(_list_of_tables(name, value))
        elif isinstance(value, Mapping):
            tables.append(f"<h4>{escaped(name)}</h4>{parameter_table(value)}")
        else:
            rows.append(f"<tr><th>{escaped(name)}</th><td>{escaped(_value_text(value))}</td></tr>")
    return f'<table class="drawn">{"".join(rows)}</table>{"".join(tables)}'


def _list_of_tables(name: str, entries: Sequence[Mapping[str, Any]]) -> str:
    """Return entries of one kind, such as flares, as a table with a column for each of their keys."""
    keys = list(dict.fromkeys(key for entry in entries for key in entry))[:8]
    head = "".join(f"<th>{escaped(key)}</th>" for key in keys)
    body = "".join(
        "<tr>" + "".join(f"<td>{escaped(_value_text(entry.get(key)))}</td>" for key in keys) + "</tr>"
        for entry in entries[:_MOST_ROWS]
    )
    more = f"<p>and {len(entries) - _MOST_ROWS} more</p>" if len(entries) > _MOST_ROWS else ""
    table = f'<div class="scroll"><table class="drawn many"><tr>{head}</tr>{body}</table></div>'
    return f"<h4>{escaped(name)} ({len(entries)})</h4>{table}{more}"


def _value_text(value: Any) -> str:
    """Return a drawn value as short text."""
    if isinstance(value, bool) or value is None:
        return {None: "–", True: "yes", False: "no"}[value]
    if isinstance(value, int | float):
        return number_text(value)
    if isinstance(value, list):
        numbers = [v for v in value if type(v) in (int, float)]
        if len(value) <= _FIRST or len(numbers) != len(value):
            return (
                ", ".join(_value_text(v) for v in value[:_FIRST]) + (", …" if len(value) > _FIRST else "") or "none"
            )
        return f"{len(numbers)} values, {number_text(min(numbers))} to {number_text(max(numbers))}"
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def number_text(value: Any) -> str:
    """Return a number with four digits, – for none."""
    if value is None or not np.isfinite(float(value)):
        return "–"
    number = float(value)
    if number == int(number) and abs(number) < 1e6:
        return with_minus(grouped_digits(int(number)))
    return with_minus(f"{number:.4g}")


def _words(fault: str) -> str:
    """Return the name of a class as words, as markup."""
    return escaped(fault.replace("_", " "))


# With this filter a browser shows the square root of the values, black and white as they are.
_BRIGHTER_FILTER = (
    '<svg class="filter" width="0" height="0" aria-hidden="true"><filter id="root" '
    'color-interpolation-filters="sRGB"><feComponentTransfer>'
    + "".join(f'<feFunc{channel} type="gamma" exponent="0.5"/>' for channel in "RGB")
    + "</feComponentTransfer></filter></svg>"
)
_BRIGHTER = (
    '<button type="button" class="toggle brighter" aria-pressed="false" style="--c:currentColor" '
    'title="show the square root of the values"><i></i>brighter<kbd>b</kbd></button>'
)
_DIALOG = f"""{_BRIGHTER_FILTER}
<dialog id="sample" aria-label="Sample"><div class="stage"><div class="holder"></div><div class="bar">
<button type="button" data-step="-1" aria-label="Previous sample">previous <kbd>←</kbd></button>
<button type="button" data-step="1" aria-label="Next sample">next <kbd>→</kbd></button>
<button type="button" class="toggle flip" aria-pressed="false" style="--c:#fff">
<i></i>clean twin<kbd>c</kbd></button>{_BRIGHTER}<span class="masks"></span><span class="spacer"></span>
<button type="button" data-close>close <kbd>Esc</kbd></button></div></div>
<aside></aside></dialog>
"""
