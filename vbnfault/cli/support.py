"""Define the commands that help to get started: what is packaged, what is installed, and what a file may hold."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Annotated

import typer

from .. import __version__
from ..core.errors import InputError
from .app import app
from .options import PluginOption, load_plugins

_PANEL = "Getting started"
_LIBRARIES = ("mitsuba", "drjit", "numpy", "zarr", "trimesh", "OpenEXR", "colour-science", "dask")


@app.command("list", rich_help_panel=_PANEL)
def list_(
    kind: Annotated[str, typer.Argument(help="One of scenes, lenses, detectors and faults.", metavar="KIND")],
    plugins: PluginOption = None,
) -> None:
    """List the packaged scenes, lenses or detectors, or the fault models with their keys."""
    from ..core import resources

    if kind == "faults":
        load_plugins(plugins)
        _list_faults()
        return
    folders = {"scenes": "scenes", "lenses": "scenes/lenses", "detectors": "scenes/detectors"}
    if kind not in folders:
        raise InputError(f"list {kind}: must be one of {', '.join(folders)}, faults")
    paths = resources.packaged(folders[kind])
    if not paths:
        typer.echo(f"no packaged {kind}")
    width = max((len(name) for name in paths), default=0)
    for name, path in paths.items():
        table = resources.read_toml(path)
        typer.echo(f"{name:<{width}}  {table.get('description') or table.get('name', '')}")


def _list_faults() -> None:
    """Print every fault model, and under it each key with its default and its meaning."""
    from .. import faults

    for name, models in faults.json_schema()["properties"].items():
        for schema_of_model in models.get("anyOf", [models]):
            keys = dict(schema_of_model["properties"])
            model = keys.pop("model")["const"]
            cls = faults.registry()[name][model]
            needs = " (needs camera.detector, a CCD)" if cls.needs_ccd else " (needs camera.detector)"
            typer.echo(f"{name} / {model}{needs if cls.needs_mosaic else ''}")
            for key, value in keys.items():
                default = json.dumps(value.get("default"))
                typer.echo(f"    {key} = {default}    {value['description']}")


@app.command(rich_help_panel=_PANEL)
def new(
    kind: Annotated[str, typer.Argument(help="One of scene, lens, sensor and fault.", metavar="KIND")],
    name: Annotated[
        str,
        typer.Argument(help="Name of the new thing and, with .toml or .py behind it, of its file.", metavar="NAME"),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the file.")] = Path("."),
    overwrite: Annotated[bool, typer.Option(help="Replace a file of this name.")] = False,
) -> None:
    """Write a commented scene, lens, sensor or fault model that works as it is, to start your own from."""
    from ..output.template_files import write_template

    typer.echo(str(write_template(kind, name, out, overwrite=overwrite)))


@app.command(rich_help_panel=_PANEL)
def schema(
    kind: Annotated[str, typer.Argument(help="One of scene, lens and sensor.", metavar="KIND")] = "scene",
    plugins: PluginOption = None,
) -> None:
    """Print the JSON Schema of a kind of TOML file, for editors that check and complete it."""
    from ..output.schemas import file_schema

    load_plugins(plugins)
    typer.echo(json.dumps(file_schema(kind), indent=2))


@app.command(rich_help_panel=_PANEL)
def doctor() -> None:
    """Print the installed versions and the LLVM that was found, and try a small render."""
    import importlib.metadata
    import platform

    from ..core import llvm, resources

    typer.echo(f"{'vbnfault':<15}{__version__}")
    typer.echo(f"{'python':<15}{platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores")
    for name in _LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            typer.echo(f"{name:<15}{importlib.metadata.version(name)}")
    for kind in ("scenes", "textures"):
        typer.echo(f"{kind:<15}{resources.data_dir(kind)}")
    for candidate in llvm.candidates():
        version = ".".join(map(str, candidate.version)) if candidate.version else "?"
        verdict = "usable" if candidate.usable else candidate.problem
        typer.echo(f"{f'LLVM {version}':<15}{candidate.path} ({candidate.origin}): {verdict}")
    typer.echo(f"{'LLVM in use':<15}{llvm.find().path}")
    from .. import render

    typer.echo(f"{'test render':<15}{render.self_test()}")
