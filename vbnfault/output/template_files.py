"""Write commented files to start from: a scene, a lens, a sensor, or a fault model (`vbnfault new`)."""

from __future__ import annotations

import re
from pathlib import Path

from ..core.errors import InputError, shown

_FOLDER = Path(__file__).parent / "templates"
# Kind of file → its template, the ending of the file, and the name that stands in the template for the user's.
_KINDS = {
    "scene": ("scene.toml", ".toml", "my_scene"),
    "lens": ("lens.toml", ".toml", "my_lens"),
    "sensor": ("sensor.toml", ".toml", "my_sensor"),
    "fault": ("fault.py.txt", ".py", "my_fault"),
}
KINDS = tuple(_KINDS)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
# The name of a fault class is a key of scene files, and its file a Python module.
_FAULT_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


def write_template(kind: str, name: str, folder: Path, *, overwrite: bool = False) -> Path:
    """Write a commented file that works as it is, and return its path.

    Parameters
    ----------
    kind
        scene, lens, sensor or fault.
    name
        Name of the thing and, with its ending, of the file: letters, digits, hyphens and underscores. For a fault:
        lower-case letters, digits and underscores.
    folder
        Folder of the file; made if missing.
    overwrite
        Replace a file of this name.

    Raises
    ------
    InputError
        If kind or name cannot be used, the file exists, or it cannot be written.
    """
    if kind not in _KINDS:
        raise InputError(f"new {shown(kind)}: must be one of {', '.join(_KINDS)}")
    source, ending, placeholder = _KINDS[kind]
    if kind == "fault" and not _FAULT_NAME.fullmatch(name):
        raise InputError(
            f"new fault {shown(name)}: must be lower-case letters, digits and underscores, beginning with a letter"
        )
    if not _NAME.fullmatch(name):
        raise InputError(f"new {kind} {shown(name)}: must be letters, digits, hyphens and underscores, at most 64")
    text = (_FOLDER / source).read_text(encoding="utf-8").replace(placeholder, name)
    class_name = "".join(word.capitalize() for word in name.split("_"))
    path = folder / f"{name}{ending}"
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists already; --overwrite replaces it, or choose another name")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace("MyFault", class_name), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    return path
