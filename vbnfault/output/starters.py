"""Give what a user's file starts from: a commented template (`vbnfault new`), and its JSON Schema for editors."""

from __future__ import annotations

import keyword
import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from .. import faults, reflectance
from ..core import tables
from ..core.errors import InputError, shown
from ..core.files.path_checks import check_folder
from ..core.files.whole_files import own, write_whole, writing
from ..detector import Sensor, effects
from ..lens.prescription_file import PrescriptionFile
from ..scene import config
from ..study.spec import StudySpec

_FOLDER = Path(__file__).parent / "templates"
# Kind of file → its template. In a template, my_KIND stands for the user's name, and MyKind for that of the class.
_TEMPLATES = {
    "scene": "scene.toml",
    "lens": "lens.toml",
    "sensor": "sensor.toml",
    "fault": "fault.py.txt",
    "effect": "effect.py.txt",
    "reflectance": "reflectance.py.txt",
}
KINDS = tuple(_TEMPLATES)
SCHEMAS = ("scene", "lens", "sensor", "study")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
# The name of a plug-in's class is a key of TOML files, and its file a Python module.
_PLUGIN_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


def _taken(kind: str) -> Collection[str]:
    """Return the names that a plug-in's class of this kind may not have."""
    if kind == "fault":
        return {name for name, models in faults.registry().items() if any(map(faults.is_packaged, models.values()))}
    if kind not in ("effect", "reflectance"):
        return ()
    kinds = effects if kind == "effect" else reflectance
    return {name for name, cls in kinds.registry().items() if kinds.is_packaged(cls)}


def write_template(kind: str, name: str, folder: Path, *, overwrite: bool = False) -> Path:
    """Write a commented file that works as it is, and return its path.

    Parameters
    ----------
    kind
        One of `KINDS`.
    name
        Name of the thing and, with its ending, of the file: letters, digits, hyphens and underscores. For a fault,
        an effect or a reflectance: lower-case letters, digits and underscores.
    folder
        Folder of the file; made if missing.
    overwrite
        Replace a file of this name.

    Raises
    ------
    InputError
        If kind or name cannot be used or is vbnfault's own, the file exists, or it cannot be written.
    """
    if kind not in _TEMPLATES:
        raise InputError(f"new {shown(kind)}: must be one of {', '.join(_TEMPLATES)}")
    source = _FOLDER / _TEMPLATES[kind]
    ending = Path(source.stem).suffix or source.suffix  # fault.py.txt becomes .py
    if ending == ".py" and not (_PLUGIN_NAME.fullmatch(name) and not keyword.iskeyword(name)):
        raise InputError(
            f"new {kind} {shown(name)}: must be lower-case letters, digits and underscores, beginning with a "
            "letter, and no keyword of Python"
        )
    if not _NAME.fullmatch(name):
        raise InputError(f"new {kind} {shown(name)}: must be letters, digits, hyphens and underscores, at most 64")
    if name in _taken(kind):
        raise InputError(f"new {kind} {shown(name)}: vbnfault has one of this name already; choose another name")
    text = source.read_text(encoding="utf-8").replace(f"my_{kind}", name)
    class_name = "".join(word.capitalize() for word in name.split("_"))
    path = folder / f"{name}{ending}"
    if os.path.lexists(path) and not overwrite:
        raise InputError(f"{path}: exists already; --overwrite replaces it, or choose another name")
    check_folder(folder)
    with writing(path):
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(own(path), text.replace(f"My{kind.capitalize()}", class_name))
    return path


def file_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a kind of file; that of the scene includes all registered faults.

    Rules that tie several keys together, such as that every number of a sensor has a source, are no part of it.

    Raises
    ------
    InputError
        The kind is none of `SCHEMAS`.
    """
    if kind not in SCHEMAS:
        raise InputError(f"schema {shown(kind)}: must be one of {', '.join(SCHEMAS)}")
    if kind == "scene":
        return config.json_schema(faults.json_schema())
    return tables.json_schema({"lens": PrescriptionFile, "sensor": Sensor, "study": StudySpec}[kind])
