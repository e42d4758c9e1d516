"""Put the report of a dataset together from its sections."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import tables
from ...core.errors import InputError, VbnfaultError, shown
from ...core.html_page import Page, Section, escaped, grouped_digits, html_table
from ...core.path_checks import path_of
from ...core.whole_files import unwritable
from ...dataset.statistics import Statistics, statistics
from ...store import STRATA, Store, open_store
from ..contact_sheet import COLOURS, abbreviations
from . import charts
from .gallery import gallery
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
)
from .sphere import sphere

F64 = NDArray[np.float64]

_LEAST_AREA = 1e-6  # a smaller area is drawn at the left end of the axis
_SPREAD = 15.0  # positive values whose 99th percentile is so many medians get a logarithmic axis
# scalar → title and unit of its histogram, and whether the scene draws it within bounds of the same name
_VIEW = {
    "sun_azimuth_deg": ("Sun azimuth", "deg"),
    "sun_elevation_deg": ("Sun elevation", "deg"),
    "roll_deg": ("roll", "deg"),
    "pitch_deg": ("pitch", "deg"),
    "yaw_deg": ("yaw", "deg"),
}
_PLACE = {
    "x_m": ("position, north", "m"),
    "y_m": ("position, east", "m"),
    "height_m": ("height above the site", "m"),
}


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
    page = _page(store, scalars, int(samples), int(pixels))
    try:
        page.write(path)
    except OSError as error:
        raise unwritable(path, error) from error
    return path


def _page(store: Store, scalars: Scalars, shown_samples: int, read_samples: int) -> Page:
    """Return the page. Its gallery has at most `shown_samples`; the pixels of at most `read_samples` are read."""
    unread: dict[int, str] = {}
    pixels = read_pixels(store, scalars, read_samples, unread)
    drawn, read = read_drawn(store, scalars)
    try:
        numbers = statistics(store)
    except VbnfaultError:  # damaged scalars: the report shows what can be read, and says what cannot
        numbers = None
    sections = [_gallery(store, scalars, shown_samples, unread)]
    if unread:
        more = f"; the same is true of {len(unread) - 1} samples more" if len(unread) > 1 else ""
        left_out = "leaves out what it cannot read" if pixels.positions.size else "shows no images"
        warnings.warn(f"{list(unread.values())[-1]}{more}; the report {left_out}", stacklevel=3)
    if store.spec.faults:
        sections += [_balance(store, scalars, numbers), _together(store, scalars)]
    sections += [_sun(scalars), _view(store, scalars)]
    if drawn:
        models = store.attributes.get("fault_models", {})
        sections.append(_parameters(scalars, drawn, numbers.bounds if numbers else {}, models, read))
    sections.append(_exposure(store, scalars, pixels))
    if store.spec.faults:
        sections.append(_areas(store, scalars, pixels))
    sections.append(_about(store, scalars, pixels))
    style = resources.files(__package__).joinpath("report.css").read_text(encoding="utf-8")
    colours = "".join(f"--f{k}:rgb{COLOURS[k % len(COLOURS)]};" for k in range(len(store.spec.faults)))
    return Page(
        title=str(store.attributes.get("title") or store.path.name),
        description=str(store.attributes.get("description") or ""),
        facts=_facts(store, scalars),
        sections=sections,
        style=f":root{{{colours}}}{style}",
        script=resources.files(__package__).joinpath("report.js").read_text(encoding="utf-8"),
    )


def _facts(store: Store, scalars: Scalars) -> dict[str, str]:
    """Return the numbers below the title."""
    spec, finished = store.spec, len(scalars.samples) + scalars.unreadable
    some = f" of {grouped_digits(store.samples)}" if finished < store.samples else ""
    by_split = [int((scalars.split == k).sum()) for k in range(len(scalars.split_names))]
    return {
        "Samples": grouped_digits(finished) + (f"{some} finished" if some else ""),
        "Frame": f"{spec.width} × {spec.height} px",
        "Fault classes": str(len(spec.faults)),
        **{n: grouped_digits(count) for n, count in zip(scalars.split_names, by_split, strict=True)},
        "Without fault": _percent((~scalars.injected.any(axis=1)).mean()) if spec.faults else "",
        "Licence": str(store.attributes.get("licence") or "not stated"),
    }


def _percent(fraction: float) -> str:
    """Return a fraction in per cent."""
    return f"{100 * fraction:.0f}\N{NO-BREAK SPACE}%"


def _how(text: str) -> str:
    """Return a paragraph that says what a section shows."""
    return f'<p class="how">{escaped(text)}</p>'


# --- sections -----------------------------------------------------------------------------------------------


def _gallery(store: Store, scalars: Scalars, most: int, unread: dict[int, str]) -> Section:
    """Return the gallery. The reasons why samples cannot be read are added to `unread`, by position."""
    markup, count = gallery(store, scalars, most, unread)
    every = "All finished samples"
    total = len(scalars.samples)
    if count < total:
        every = (
            f"{count} of {grouped_digits(total)} finished samples, chosen so that each class of each split is "
            "among them where there is room, and otherwise evenly spaced"
        )
    return Section(
        "gallery", "Samples", _how(f"{every}. Select an image to enlarge it and to see its parameters.") + markup
    )


def _balance(store: Store, scalars: Scalars, numbers: Statistics | None) -> Section:
    """Return the classes planned and realised by split, and the numbers of faults and of strata."""
    injected, planned = scalars.injected, numbers is not None and numbers.has_plan
    rows = []
    for k, fault in enumerate(store.spec.faults):
        splits = []
        for s, name in enumerate(scalars.split_names):
            inside = scalars.split == s
            asked = numbers.counts.planned(fault, name) if numbers is not None and planned else None
            splits.append((name, int(injected[inside, k].sum()), asked, int(inside.sum())))
        rows.append((fault, f"var(--f{k})", splits))
    mark = (
        "The mark is the planned fraction. The number over a histogram is the fraction of its highest bin."
        if planned
        else "The plan is not known, because the scene in the store cannot be planned here."
    )
    how = f"Fraction of each split's samples in which a class is in the pixels, with the number of samples. {mark}"
    counts = injected.sum(axis=1).astype(np.float64)
    ends = (-0.5, max(float(counts.max()), 1) + 0.5)
    strata = scalars.strata.astype(np.float64)
    small = [
        charts.Histogram(title="faults in a sample", unit="", groups=scalars.by_split(counts), limits=ends),
        charts.Histogram(
            title="stratum",
            unit="",
            groups=scalars.by_split(strata),
            limits=(-0.5, len(STRATA) - 0.5),
            labels=STRATA,
        ),
    ]
    drawn = f'<div class="wide">{charts.balance(rows)}</div>'
    beside = f'<div class="beside">{charts.legend(scalars.split_names)}{"".join(h.markup() for h in small)}</div>'
    return Section("balance", "Balance", f'{_how(how)}<div class="two">{drawn}{beside}</div>')


def _charts(scalars: Scalars, histograms: Sequence[charts.Histogram]) -> str:
    """Return histograms with the legend of the splits above them."""
    drawn = "".join(histogram.markup() for histogram in histograms)
    return f'{charts.legend(scalars.split_names)}<div class="charts">{drawn}</div>'


def _together(store: Store, scalars: Scalars) -> Section:
    """Return the co-occurrence of the classes, in all samples and by split."""
    injected, short = scalars.injected.astype(np.int64), abbreviations(store.spec.faults)
    parts = []
    groups = [("all", np.ones(len(injected), bool))]
    if len(scalars.split_names) > 1:
        groups += [(name, scalars.split == k) for k, name in enumerate(scalars.split_names)]
    for name, inside in groups:
        counts = injected[inside].T @ injected[inside]
        parts.append(charts.matrix(name, store.spec.faults, short, counts, int(inside.sum())))
    named = ", ".join(f"{short[fault]} {fault.replace('_', ' ')}" for fault in store.spec.faults)
    how = f"Samples in which two classes occur together; the diagonal counts each class. {named}."
    return Section("together", "Co-occurrence", _how(how) + f'<div class="charts">{"".join(parts)}</div>')


def _sun(scalars: Scalars) -> Section:
    """Return the directions of the Sun on spheres."""
    level, camera = scalars.sun_L * (1, -1, -1), scalars.sun_C[:, [2, 0, 1]] * (1, -1, -1)
    x, y, z = np.eye(3)
    drawn = sphere(
        "Sun above the site",
        "Direction of the Sun at the site: N, E and up are those of the local level frame.",
        _groups(scalars, level),
        [("N", x), ("E", -y), ("up", z)],
        (-35.0, 25.0),
    )
    drawn += sphere(
        "Sun before the camera",
        "Direction of the Sun in the camera's frame, seen from the front: z is the boresight, x right, y down.",
        _groups(scalars, camera),
        [("z", x), ("x", -y), ("y", -z)],
        (35.0, 20.0),
    )
    angle = np.degrees(np.arccos(np.clip(scalars.sun_C[:, 2], -1, 1)))
    small = [
        charts.Histogram(
            title="Sun from the boresight", unit="deg", groups=scalars.by_split(angle), limits=(0, 180)
        ),
        charts.Histogram(
            title="visible part of the Sun",
            unit="",
            groups=scalars.by_split(scalars.columns["sun_visible_fraction"]),
            limits=(0, 1),
        ),
        charts.Histogram(
            title="distance of the Sun", unit="au", groups=scalars.by_split(scalars.columns["sun_distance_au"])
        ),
    ]
    how = (
        "Each dot is a sample; those on the far side are faint. Drag a sphere, or focus it and use the arrow keys."
    )
    histograms = "".join(histogram.markup() for histogram in small)
    globes = f'<div class="globes">{drawn}<div class="stack">{histograms}</div></div>'
    return Section("sun", "Sun geometry", _how(how) + charts.legend(scalars.split_names) + globes)


def _groups(scalars: Scalars, vectors: F64) -> list[tuple[str, F64]]:
    """Return finite vectors by split."""
    finite = np.isfinite(vectors).all(axis=1)
    return [(name, vectors[finite & (scalars.split == k)]) for k, name in enumerate(scalars.split_names)]


def _view(store: Store, scalars: Scalars) -> Section:
    """Return the histograms of the view."""
    position = scalars.columns["position_L_m"].reshape(len(scalars.samples), 3)
    values = {"x_m": position[:, 0], "y_m": position[:, 1], "height_m": -position[:, 2]}
    values |= {name: scalars.columns[name] for name in _VIEW}
    histograms = [
        charts.Histogram(
            title=title, unit=unit, groups=scalars.by_split(values[name]), bounds=geometry_bounds(store, name)
        )
        for name, (title, unit) in (_PLACE | _VIEW).items()
    ]
    how = (
        "Fraction of each split in each bin; the number at the right is that of the highest bin. The shaded band "
        "spans the bounds of the scene; where those of the strata differ, bars above show both. Heights here are "
        "above the site, so heights that the scene gives above the local ground may leave the band."
    )
    return Section("view", "Views", _how(how) + _charts(scalars, histograms))


def _parameters(
    scalars: Scalars,
    drawn: Sequence[Drawn],
    bounds: Mapping[str, Mapping[str, tuple[float, float]]],
    models: Mapping[str, str],
    read: int,
) -> Section:
    """Return the histograms of the drawn parameters of the faults."""
    some = "" if read == len(scalars.samples) else f" They are from {grouped_digits(read)} samples, evenly spaced."
    how = (
        "Every number that was drawn for the injected faults; entries of a list count one by one. The band spans "
        f"the bounds in the scene, where it has a key of the same name.{some}"
    )
    parts = []
    for fault in dict.fromkeys(d.fault for d in drawn):
        histograms = []
        for one in (d for d in drawn if d.fault == fault):
            groups = [(n, one.values[one.split == k]) for k, n in enumerate(scalars.split_names)]
            groups = [(name, values[np.isfinite(values)]) for name, values in groups]
            pair = key_bounds(bounds, one)
            if all((values == one.values[0]).all() for _, values in groups) and (
                pair is None or pair[0] == pair[1]
            ):
                continue  # a constant
            histograms.append(_histogram(one.name, groups, pair, unit=key_unit(models, one)))
        if histograms:
            short = "".join(histogram.markup() for histogram in histograms)
            parts.append(f'<h3>{escaped(fault.replace("_", " "))}</h3><div class="charts">{short}</div>')
    return Section(
        "parameters", "Drawn parameters", _how(how) + charts.legend(scalars.split_names) + "".join(parts)
    )


def _histogram(
    name: str, groups: list[tuple[str, F64]], pair: tuple[float, float] | None, title: str = "", unit: str = ""
) -> charts.Histogram:
    """Return a histogram whose axis is logarithmic where its values ask for it."""
    values = np.concatenate([v for _, v in groups])
    wide = bool(values.size and values.min() > 0 and np.quantile(values, 0.99) > _SPREAD * np.median(values))
    bounds = [("", pair)] if pair is not None else []
    return charts.Histogram(title=title or name, unit=unit, groups=groups, bounds=bounds, logarithmic=wide)


def _exposure(store: Store, scalars: Scalars, pixels: PixelResults) -> Section:
    """Return exposure times, and the saturated fraction and mean level of the images."""
    exposure = scalars.by_split(scalars.columns["exposure_s"])
    histograms = [_histogram("", exposure, None, "exposure time", "s")]
    words = {"image": "images", "clean": "clean twins"}
    for name, values in pixels.saturated.items():
        groups = scalars.by_split(values, pixels.positions)
        title = f"saturated part of the {words[name]}"
        histograms.append(charts.Histogram(title=title, unit="", groups=groups, logarithmic=True))
    for name, values in pixels.mean_dn.items():
        groups = scalars.by_split(values, pixels.positions)
        title = f"mean level of the {words[name]}"
        histograms.append(charts.Histogram(title=title, unit="DN", groups=groups, limits=(0, 255)))
    how = (
        f"A pixel is saturated if a colour is at 255 DN. Levels and saturation are {_of_pixels(scalars, pixels)}. "
        "The bar at 0 counts the images without a saturated pixel."
    )
    return Section("exposure", "Exposure and saturation", _how(how) + _charts(scalars, histograms))


def _of_pixels(scalars: Scalars, pixels: PixelResults) -> str:
    """Return from which samples the pixels are."""
    read, total = len(pixels.positions), len(scalars.samples)
    return "of all finished samples" if read == total else f"of {grouped_digits(read)} samples, evenly spaced"


def _areas(store: Store, scalars: Scalars, pixels: PixelResults) -> Section:
    """Return the distributions of the masks' areas."""
    titles = {"mask": "Footprints", "mask_effect": "Effects"}
    about = {
        "mask": "where the fault is, by the rule of its class (array mask)",
        "mask_effect": "where it changes the image (array mask_effect)",
    }
    parts = []
    injected = scalars.injected[pixels.positions]
    for name, areas in pixels.areas.items():
        rows = []
        for k, fault in enumerate(store.spec.faults):
            values = np.where(injected[:, k], areas[:, k], np.nan)
            rows.append((fault, f"var(--f{k})", scalars.by_split(values, pixels.positions)))
        positive = areas[injected & (areas > 0)]
        least = max(float(positive.min(initial=0.01)), _LEAST_AREA)
        drawn = charts.boxes(rows, 10.0 ** np.floor(np.log10(least) + 1e-9))
        parts.append(f'<h3>{titles[name]}</h3>{_how(f"Area {about[name]}.")}<div class="wide">{drawn}</div>')
    how = (
        f"Fraction of the frame that the mask of an injected fault covers, {_of_pixels(scalars, pixels)}. A box "
        "holds the middle half, its line nine tenths, its mark the median; few values are dots. At the right "
        "stands the number of samples."
    )
    return Section("areas", "Areas of the masks", _how(how) + "".join(parts))


def _about(store: Store, scalars: Scalars, pixels: PixelResults) -> Section:
    """Return what identifies the store, and what the report could not read."""
    attributes = store.attributes
    rows = [
        [escaped(name), f"<code>{escaped(value)}</code>"]
        for name, value in (
            ("store", store.path.name),
            ("scene", attributes.get("scene_hash", "")),
            ("seed", attributes.get("seed", "")),
            ("citation", attributes.get("citation") or "not stated"),
            ("versions", ", ".join(f"{k} {v}" for k, v in attributes.get("versions", {}).items())),
        )
    ]
    left_out = ""
    if scalars.unreadable or pixels.unreadable:
        left_out = (
            f'<p class="warning">{scalars.unreadable} finished samples whose scalars cannot be read and '
            f"{pixels.unreadable} whose pixels cannot be read are left out; the build command repairs them.</p>"
        )
    models = attributes.get("fault_models", {})
    spec = store.spec
    kinds = html_table(
        ["class", "model", "mask", "rule of the mask"],
        [
            [
                f'<i class="swatch" style="background:var(--f{k})"></i>{escaped(fault.replace("_", " "))}',
                escaped(models.get(fault, "")),
                escaped(spec.mask_kinds[k] if spec.mask_kinds else ""),
                escaped(spec.mask_rules[k] if spec.mask_rules else ""),
            ]
            for k, fault in enumerate(spec.faults)
        ],
    )
    return Section(
        "about", "About the data", f"{left_out}{kinds if spec.faults else ''}{html_table(['', ''], rows)}"
    )
