"""Write the description of a dataset: `README.md`, the card for people, and `croissant.json`, for programs.

Both lie in the store beside its arrays. They follow from the store, hold no date and belong to no digest; `verify`
does not read them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .. import store as stores
from ..core.html_page import rendered
from ..core.tables import flat
from ..faults import registry
from ..scene import config
from ..scene.bodies import named_body
from ..store import Location, Store, Url, disk
from .croissant import store_croissant
from .statistics import Statistics, statistics

README = "README.md"
CROISSANT = "croissant.json"
_LONGEST_VALUE = 80
_SOFTWARE = "vbnfault, physically based, labelled, fault-injected camera images (CITATION.cff of the project)"
_PAPER = (
    "R. Gallon, F. Schiemenz, A. Menicucci, E. Gill: Addressing Camera Sensors Faults in Vision-Based Navigation: "
    "Simulation and Dataset Development"
)


def write_card(path: str | os.PathLike[str] | Url | Store) -> list[Location]:
    """Write the card and the Croissant description into a store and return their paths.

    Raises
    ------
    InputError
        If there is no store at `path`.
    VbnfaultError
        If scalars cannot be read or the files cannot be written.
    """
    store = stores.open_store(path)
    numbers = statistics(store)
    files = {README: card(store, numbers), CROISSANT: to_json(store_croissant(store))}
    with disk.explained(store.path, "writing the card"):
        store.files.write((name, text.encode()) for name, text in files.items())
    return [store.path / name for name in files]


def has_card(store: Store) -> bool:
    """Return whether a store holds its card and its Croissant description."""
    return all(store.files.exists(name) for name in (README, CROISSANT))


def to_json(document: Mapping[str, Any]) -> str:
    """Return a document as the text of a JSON file."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def card(store: Store, numbers: Statistics) -> str:
    """Return the card of a store as Markdown, which says how to read the store."""
    rows = [["array", "dimensions", "dtype", "unit", "meaning"]]
    rows += [
        [f"`{name}`", ", ".join(row.dims), row.dtype, row.units, row.long_name]
        for name, row in store.spec.arrays.items()
    ]
    return rendered("dataset/card.md", arrays=markdown_table(rows), **described(store, numbers))


def described(store: Store, numbers: Statistics) -> dict[str, Any]:
    """Return what the template `described.md` shows, which the cards of a store and of its exports share."""
    attributes = store.attributes
    sources = attributes.get("detector", {}).get("sensor", {}).get("sources") or {}
    rows = [["value of the sensor", "source"], *([key, str(text)] for key, text in sources.items())]
    return {
        "store": store,
        "attributes": attributes,
        "software": _SOFTWARE,
        "paper": _PAPER,
        "classes": markdown_table(_classes(store)),
        "statistics": numbers.lines(),
        "provenance": markdown_table([["parameter", "value", "from"], *_provenance(attributes)]),
        "sources": markdown_table(rows) if sources else [],
        "optics": attributes.get("optics", {}).get("summary"),
        "versions": markdown_table([["component", "version"], *_versions(store)]),
    }


def _classes(store: Store) -> list[list[str]]:
    """Return the rows of the table of fault classes."""
    spec, models = store.spec, store.attributes.get("fault_models", {})
    rows = [["index", "class", "model", "localised", "mask", "rule of the mask"]]
    for k, fault in enumerate(spec.faults):
        kind = spec.mask_kinds[k] if spec.mask_kinds else ""
        rule = spec.mask_rules[k] if spec.mask_rules else ""
        local = "yes" if fault in (spec.localised_faults or ()) else "no"
        rows.append([str(k), fault, str(models.get(fault, "")), local, kind, rule])
    return rows


def _versions(store: Store) -> list[list[str]]:
    """Return name and version of everything that affects pixels, and what identifies the data."""
    attributes = store.attributes
    rows = [[name, str(version)] for name, version in attributes.get("versions", {}).items()]
    rows += [["format of the store", str(store.root_attributes.get("format_version"))]]
    rows += [[key, str(attributes[key])] for key in ("seed", "scene_hash", "blocks") if key in attributes]
    if "versions_of_samples" in attributes:
        rows.append(["samples of other versions", "see the root attribute versions_of_samples"])
    return rows


def markdown_table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows, the first of which is the head, as a Markdown table."""
    lines = ["| " + " | ".join(" ".join(cell.replace("|", " ").split()) for cell in row) + " |" for row in rows]
    return [lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]


# --- provenance ---------------------------------------------------------------------------------------------


def _provenance(attributes: Mapping[str, Any]) -> Iterator[list[str]]:
    """Yield parameter, value and origin of every value of the stored scene."""
    scene = attributes.get("scene", {})
    defaults = flat(config.parse_scene({"title": "defaults"}, source="defaults").resolved())
    body = scene.get("body", {})
    packaged = named_body(str(body.get("name", ""))) if isinstance(body, Mapping) else None
    tables = {name: getattr(packaged, name, None) or {} for name in ("body", "orbit", "spice")}
    of_body = flat({name: table for name, table in tables.items() if table})
    for fault, table in scene.get("faults", {}).items() if isinstance(scene.get("faults"), Mapping) else ():
        cls = registry().get(fault, {}).get(str(table.get("model")))
        if cls is not None:
            defaults |= {f"faults.{fault}.{key}": value for key, value in flat(cls().to_dict()).items()}
    for key, value in flat(scene).items():
        if key.endswith("sha256"):
            origin = "contents of the files"
        elif key in of_body and json.dumps(of_body[key]) == json.dumps(value):
            origin = f"packaged table of {packaged.name if packaged else ''}"
        elif key in defaults and json.dumps(defaults[key]) == json.dumps(value):
            origin = "default"
        elif key == "camera.fov_deg" and scene["camera"].get("calibration"):
            origin = "of the calibration, at most 140"
        else:
            origin = "set"
        text = json.dumps(value, ensure_ascii=False)
        yield [key, text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}...", origin]
