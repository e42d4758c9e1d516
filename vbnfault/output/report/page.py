"""Put the report of a dataset together; the template `report.html` holds the words."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ...core import tables
from ...core.errors import InputError, VbnfaultError, shown
from ...core.files.path_checks import path_of
from ...core.files.whole_files import writing
from ...core.html_page import data_url, image_url, with_minus, write_page
from ...core.quantities import Sample
from ...dataset.statistics import Statistics, statistics
from ...store import STRATA, Store, open_store
from ..contact_sheet import COLOURS, abbreviations, film_strips, resized_mask, spread
from . import charts
from .measure import (
    Drawn,
    PixelResults,
    Scalars,
    geometry_bounds,
    key_bounds,
    key_unit,
    read_drawn,
    read_pixels,
    read_scalars,
    readable,
)

F64 = NDArray[np.float64]

_LEAST_AREA = 1e-6  # a smaller area is drawn at the left end of the axis
# scalar → title and unit of its histogram
_VIEW = {
    "x_m": ("position, north", "m"),
    "y_m": ("position, east", "m"),
    "height_m": ("height above the site", "m"),
    "sun_azimuth_deg": ("Sun azimuth", "deg"),
    "sun_elevation_deg": ("Sun elevation", "deg"),
    "roll_deg": ("roll", "deg"),
    "pitch_deg": ("pitch", "deg"),
    "yaw_deg": ("yaw", "deg"),
}
_AREAS = {
    "mask": ("Footprints", "where the fault is, by the rule of its class (array mask)"),
    "mask_effect": ("Effects", "where it changes the image (array mask_effect)"),
}
_WORDS = {"image": "images", "clean": "clean twins"}

_SIDES_PX = (640, 400, 256, 128)  # of the images; the first whose files fit is taken
_MOST_BYTES = 15_000_000  # of all images
_FILL, _FAINT_FILL = 77, 36  # opacity of a mask's inside, less for a class that is not localised
_WHOLE_FRAME = 0.98

_STRIPS = (4, 32, 8)  # film strips, frames in all of them, and frames in one, at most

# The gallery shows at most so many samples, and the pixels of at most so many are read.
MOST_SHOWN, MOST_READ = 200, 1_000_000


def write_report(
    store: str | os.PathLike[str] | Store,
    out: str | os.PathLike[str],
    *,
    samples: int = 36,
    pixels: int = 400,
) -> Path:
    """Write the report of a store as one page that needs no other file, of at most 20 MB, and return its path.

    The page holds a gallery, the classes planned and realised, their co-occurrence, the Sun's directions, the drawn
    parameters with their bounds, exposure and saturation, and the areas of the masks, by split.

    Parameters
    ----------
    store
        A store or its path; it may be unfinished.
    out
        The page to write; its name must end in .html.
    samples
        Largest number of samples in the gallery, 1 to 200.
    pixels
        Largest number of samples whose pixels are read, 1 to 1,000,000.

    Raises
    ------
    InputError
        If there is no store or no finished sample, or the page cannot be written there.
    """
    for name, value, most in (("samples", samples, MOST_SHOWN), ("pixels", pixels, MOST_READ)):
        if not 1 <= (tables.whole(value) or 0) <= most:
            raise InputError(f"{name} = {shown(value)}: must be a whole number from 1 to {most}")
    store, path = open_store(store), path_of(out, "out")
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: the report is a page, so its name must end in .html")
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder; must be the name of the page to write")
    scalars = read_scalars(store)
    if not len(scalars.samples):
        why = store.why_none_is_finished()
        if scalars.unreadable:
            why = f"the scalars of all {scalars.unreadable} finished samples cannot be read"
        raise InputError(f"{store.path}: {why}, so there is nothing to show")
    values = _values(store, scalars, int(samples), int(pixels))
    with writing(path):
        write_page(path, "output/report/report.html", **values)
    return path


def _values(store: Store, scalars: Scalars, shown_samples: int, read_samples: int) -> dict[str, Any]:
    """Return what the template shows: at most `shown_samples` images, the pixels of at most `read_samples`."""
    unread: dict[int, str] = {}
    pixels = read_pixels(store, scalars, read_samples, unread)
    drawn, read = read_drawn(store, scalars)
    try:
        numbers = statistics(store)
    except VbnfaultError:  # damaged scalars: the report shows what can be read, and says what cannot
        numbers = None
    groups = [pick(scalars, shown_samples)]
    if store.spec.sequence_names:
        groups += [strip.tolist() for strip in film_strips(scalars.columns["sequence"], *_STRIPS)]
    sheet, *strips = cards(store, scalars, groups, unread)
    if unread:
        more = f"; the same is true of {len(unread) - 1} samples more" if len(unread) > 1 else ""
        left_out = "leaves out what it cannot read" if pixels.positions.size else "shows no images"
        warnings.warn(f"{list(unread.values())[-1]}{more}; the report {left_out}", stacklevel=4)
    attributes, spec = store.attributes, store.spec
    return {
        "store": store,
        "name": store.path.name,
        "attributes": attributes,
        "scalars": scalars,
        "pixels": pixels,
        "cards": sheet,
        "strips": [strip for strip in strips if strip],
        "coloured": [(k, f, _colour(k), f in (spec.localised_faults or ())) for k, f in enumerate(spec.faults)],
        "splits": charts.legend(scalars.split_names),
        "balance": _balance(store, scalars, numbers) if spec.faults else None,
        "together": _together(store, scalars),
        "short": abbreviations(spec.faults),
        "sun": _sun(scalars),
        "view": _view(store, scalars),
        "parameters": _parameters(
            scalars, drawn, numbers.bounds if numbers else {}, attributes.get("fault_models", {})
        ),
        "parameters_read": read,
        "percent": charts.percent,
        "exposure": _exposure(scalars, pixels),
        "areas": _areas(store, scalars, pixels),
    }


def _colour(k: int) -> str:
    """Return the colour of the fault number `k`."""
    return "#{:02x}{:02x}{:02x}".format(*COLOURS[k % len(COLOURS)])


def _balance(store: Store, scalars: Scalars, numbers: Statistics | None) -> dict[str, Any]:
    """Return the classes planned and realised by split, and the numbers of faults and of strata."""
    injected, rows = scalars.injected, []
    is_planned = numbers is not None and numbers.has_plan
    for k, fault in enumerate(store.spec.faults):
        splits = []
        for s, name in enumerate(scalars.split_names):
            inside = scalars.split == s
            asked = numbers.counts.planned(fault, name) if numbers is not None and is_planned else None
            splits.append((name, (int(injected[inside, k].sum()), asked, int(inside.sum()))))
        rows.append((fault.replace("_", " "), _colour(k), splits))
    counts = injected.sum(axis=1).astype(np.float64)
    ends, strata = (-0.5, max(float(counts.max()), 1) + 0.5), scalars.strata.astype(np.float64)
    last = len(STRATA) - 0.5
    return {
        "is_planned": is_planned,
        "drawn": charts.balance(rows),
        "rows": rows,
        "beside": [
            charts.histogram("faults in a sample", "", scalars.by_split(counts), limits=ends),
            charts.histogram("stratum", "", scalars.by_split(strata), limits=(-0.5, last), labels=STRATA),
        ],
    }


def _together(store: Store, scalars: Scalars) -> list[Markup]:
    """Return the co-occurrence of the classes, in all samples and by split."""
    injected, short = scalars.injected.astype(np.int64), [*abbreviations(store.spec.faults).values()]
    groups = {"all": np.ones(len(injected), bool)}
    if len(scalars.split_names) > 1:
        groups |= {name: scalars.split == k for k, name in enumerate(scalars.split_names)}
    if not short:
        return []
    return [charts.matrix(n, short, injected[i].T @ injected[i], int(i.sum())) for n, i in groups.items()]


def _sun(scalars: Scalars) -> list[Markup]:
    """Return the directions of the Sun on maps, and what is known of its light."""
    (north, east, down), (right, below, ahead) = scalars.sun_L.T, scalars.sun_C.T
    maps = [
        ("Sun above the site", "azimuth from north (centre) towards east, elevation", (north, east, -down)),
        ("Sun before the camera", "boresight in the centre, right and up as in the image", (ahead, right, -below)),
    ]
    drawn = []
    for title, about, (x, y, z) in maps:
        angles = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(np.clip(z, -1, 1)))
        by_split = [scalars.by_split(angle) for angle in angles]
        groups = [(name, (lon, lat)) for (name, lon), (_, lat) in zip(*by_split, strict=True)]
        drawn.append(charts.directions(title, about, groups))
    angle = np.degrees(np.arccos(np.clip(ahead, -1, 1)))
    visible, distance = (scalars.columns[name] for name in ("sun_visible_fraction", "sun_distance_au"))
    return [
        *drawn,
        charts.histogram("Sun from the boresight", "deg", scalars.by_split(angle), limits=(0, 180)),
        charts.histogram("visible part of the Sun", "", scalars.by_split(visible), limits=(0, 1)),
        charts.histogram("distance of the Sun", "au", scalars.by_split(distance)),
    ]


def _view(store: Store, scalars: Scalars) -> list[Markup]:
    """Return the histograms of the view."""
    position = scalars.columns["position_L_m"].reshape(len(scalars.samples), 3)
    values = {"x_m": position[:, 0], "y_m": position[:, 1], "height_m": -position[:, 2], **scalars.columns}
    return [
        charts.histogram(title, unit, scalars.by_split(values[name]), bounds=geometry_bounds(store, name))
        for name, (title, unit) in _VIEW.items()
    ]


def _parameters(
    scalars: Scalars,
    drawn: Sequence[Drawn],
    bounds: Mapping[str, Mapping[str, tuple[float, float]]],
    models: Mapping[str, str],
) -> dict[str, list[Markup]]:
    """Return the histograms of the drawn parameters of each fault, without those that are constant."""
    histograms: dict[str, list[Markup]] = {}
    for one in drawn:
        groups = [(n, one.values[one.split == k]) for k, n in enumerate(scalars.split_names)]
        groups = [(name, values[np.isfinite(values)]) for name, values in groups]
        pair = key_bounds(bounds, one)
        if (one.values == one.values[0]).all() and (pair is None or pair[0] == pair[1]):
            continue
        histograms.setdefault(one.fault, []).append(
            charts.histogram(
                one.name,
                key_unit(models, one),
                groups,
                section=one.fault,
                bounds=[("", pair)] if pair is not None else [],
                logarithmic=charts.is_wide(groups),
            )
        )
    return histograms


def _exposure(scalars: Scalars, pixels: PixelResults) -> list[Markup]:
    """Return exposure times, and the saturated fraction and mean level of the images."""
    exposure, at = scalars.by_split(scalars.columns["exposure_s"]), pixels.positions
    return [
        charts.histogram("exposure time", "s", exposure, logarithmic=charts.is_wide(exposure)),
        *(
            charts.histogram(f"saturated part of the {_WORDS[n]}", "", scalars.by_split(v, at), logarithmic=True)
            for n, v in pixels.saturated.items()
        ),
        *(
            charts.histogram(f"mean level of the {_WORDS[n]}", "DN", scalars.by_split(v, at), limits=(0, 255))
            for n, v in pixels.mean_dn.items()
        ),
    ]


def _areas(store: Store, scalars: Scalars, pixels: PixelResults) -> list[tuple[str, str, Markup]]:
    """Return the distributions of the masks' areas, each with its heading and what it is."""
    parts, injected = [], scalars.injected[pixels.positions]
    for name, areas in pixels.areas.items():
        rows = []
        for k, fault in enumerate(store.spec.faults):
            values = np.where(injected[:, k], areas[:, k], np.nan)
            rows.append((fault.replace("_", " "), _colour(k), scalars.by_split(values, pixels.positions)))
        least = max(float(areas[injected & (areas > 0)].min(initial=0.01)), _LEAST_AREA)
        drawn = charts.boxes(f"areas-{name}", rows, 10.0 ** np.floor(np.log10(least) + 1e-9))
        parts.append((*_AREAS[name], drawn))
    return parts


# --- the gallery ---------------------------------------------------------------------------------------------


def pick(scalars: Scalars, most: int) -> list[int]:
    """Return the positions of up to `most` samples: of each class in each split at least one where there is room.

    The rest is spaced evenly over the store.
    """
    chosen: set[int] = set()
    injected = scalars.injected
    for k in range(injected.shape[1]):
        for split in range(len(scalars.split_names)):
            having = np.flatnonzero(injected[:, k] & (scalars.split == split))
            if having.size and len(chosen) < most * 2 // 3 and not chosen & set(having.tolist()):
                chosen.add(int(having[len(having) // 2]))
    rest = [position for position in range(len(scalars.samples)) if position not in chosen]
    chosen |= {rest[k] for k in spread(len(rest), most - len(chosen)).tolist()}
    return sorted(chosen)


def cards(
    store: Store, scalars: Scalars, groups: Sequence[Sequence[int]], unread: dict[int, str]
) -> list[list[dict[str, Any]]]:
    """Return the samples of some groups of positions as the template shows them.

    The reasons why samples cannot be read are added to `unread`, by position.
    """
    names = [name for name in ("image", "clean", "mask") if name in store.spec.pixel_layers]
    picked = dict(readable(store, scalars, sorted({k for group in groups for k in group}), names, unread))
    made: list[list[dict[str, Any]]] = []
    for side in _SIDES_PX:
        of = {position: _card(store, scalars, position, sample, side) for position, sample in picked.items()}
        made = [[of[position] for position in group if position in of] for group in groups]
        if sum(len(url) for group in made for card in group for url in card["urls"].values()) <= _MOST_BYTES:
            break
    return made


def _card(store: Store, scalars: Scalars, position: int, sample: Sample, side_px: int) -> dict[str, Any]:
    """Return one sample: its number, what it is, and its images, at most `side_px` wide and high, as addresses."""
    spec, layers = store.spec, sample.layers
    scale = min(1.0, side_px / max(spec.height, spec.width))
    size = (max(1, round(spec.width * scale)), max(1, round(spec.height * scale)))
    urls = {name: image_url(layers[name][..., :3], side_px) for name in ("image", "clean") if name in layers}
    for k, fault in enumerate(spec.faults):
        if layers["mask"][k].any():
            is_localised = fault in (spec.localised_faults or ())
            colour = COLOURS[k % len(COLOURS)]
            urls[f"mask m{k}"] = _mask_url(resized_mask(layers["mask"][k].astype(bool), size), colour, is_localised)
    faults = np.flatnonzero(scalars.injected[position]).tolist()
    return {
        "index": sample.index,
        "words": ", ".join(spec.faults[k].replace("_", " ") for k in faults) or "no fault",
        "faults": faults,
        "where": f"{scalars.split_names[scalars.split[position]]}, {scalars.stratum(position)}",
        **_in_sequence(store, scalars, position),
        "coarse": max(size) <= _SIDES_PX[-1],
        "urls": urls,
    }


def _in_sequence(store: Store, scalars: Scalars, position: int) -> dict[str, str]:
    """Return the name of a sample's sequence and its time; empty for a store without sequences."""
    names = store.spec.sequence_names
    if not names:
        return {}
    sequence, time_s = (scalars.columns[name][position] for name in ("sequence", "time_s"))
    name = names[sequence] if 0 <= sequence < len(names) else f"sequence {sequence}"
    return {"sequence": name, "time": with_minus(f"{time_s:.6g}\N{NO-BREAK SPACE}s")}


def _mask_url(mask: NDArray[np.bool_], colour: tuple[int, int, int], is_localised: bool) -> str:
    """Return a mask as a transparent image within the page: tinted inside, with an outline."""
    padded = np.pad(mask, 1).astype(np.uint8)  # so that a mask has an outline at the edge of the frame, too
    inside = cv2.erode(padded, np.ones((3, 3), np.uint8))[1:-1, 1:-1].astype(bool)
    fill = _FILL if is_localised and mask.mean() < _WHOLE_FRAME else _FAINT_FILL
    values = np.zeros((*mask.shape, 4), np.uint8)
    values[mask] = (*colour[::-1], 235)
    values[mask & inside, 3] = fill
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101]
    return data_url(cv2.imencode(".webp", values, lossless)[1].tobytes(), "image/webp")
