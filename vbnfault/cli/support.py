"""Define the commands that help to get started: what is packaged, what is installed, and what a file may hold."""

from __future__ import annotations

import contextlib
import inspect
import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from .. import __version__
from ..core.errors import InputError
from .app import app
from .options import PluginOption, load_plugins, local_path

_PANEL = "Getting started"
_LIBRARIES = ("mitsuba", "drjit", "numpy", "zarr", "trimesh", "OpenEXR", "colour-science", "dask")


@app.command("list", rich_help_panel=_PANEL)
def list_(
    kind: Annotated[
        str | None,
        typer.Argument(
            help="One of scenes, bodies, lenses, detectors, studies, benchmarks, faults, effects, reflectances and "
            "glasses.",
            metavar="KIND",
            show_default=False,
        ),
    ] = None,
    plugins: PluginOption = None,
) -> None:
    """List packaged files, such as scenes and lenses, or faults, effects and reflectances with their keys."""
    from ..core.files import resources, toml_files

    registered = {
        "faults": _list_faults,
        "effects": _list_effects,
        "reflectances": _list_reflectances,
        "glasses": _list_glasses,
    }
    folders = {
        "scenes": "scenes",
        **{name: f"scenes/{name}" for name in ("bodies", "lenses", "detectors", "studies", "benchmarks")},
    }
    if kind in registered:
        load_plugins(plugins)
        registered[kind]()
        return
    if kind not in folders:
        raise InputError(f"list {kind or 'KIND'}: must be one of {', '.join((*folders, *registered))}")
    paths = resources.packaged(folders[kind])
    if not paths:
        typer.echo(f"no packaged {kind}")
    width = max((len(name) for name in paths), default=0)
    for name, path in paths.items():
        table = toml_files.read_toml(path)
        text = table.get("description") or table.get("name", "")
        typer.echo(f"{name:<{width}}  {text}{_size_and_filters(path) if kind == 'detectors' else ''}")


def _size_and_filters(path: Path) -> str:
    """Return the size of a packaged sensor and its colour filter array, as the end of its line."""
    from ..detector.sensor import load_sensor

    sensor = load_sensor(str(path))
    filters = "monochrome" if len(sensor.pattern.channels) == 1 else f"{sensor.pattern.name} filters"
    return f": {sensor.width_px} x {sensor.height_px} px, {filters}"


def _list_faults() -> None:
    """Print every fault model, and under it each key with its default and its meaning."""
    from .. import faults

    for name, models in faults.json_schema()["properties"].items():
        for schema_of_model in models.get("anyOf", [models]):
            keys = dict(schema_of_model["properties"])
            model = keys.pop("model")["const"]
            cls = faults.registry()[name][model]
            notes = ["default model"] if cls.default else []
            if cls.needs_mosaic:
                notes.append("needs camera.detector, a CCD" if cls.needs_ccd else "needs camera.detector")
            note = f" ({'; '.join(notes)})" if notes else ""
            typer.echo(f"{name} / {model}{note}")
            _list_keys(keys, [key for key in schema_of_model.get("required", ()) if key in keys])


def _list_effects() -> None:
    """Print the effects of a detector in the order of the chain, with the keys of those that have some."""
    from ..detector import effects

    classes = effects.registry()
    width = max(map(len, classes))
    for name in effects.order():
        cls = classes[name]
        typer.echo(f"{name:<{width}}  {_summary(cls)}{_origin(effects.is_packaged(cls))}")
        schema = cls.model_json_schema()
        _list_keys(schema.get("properties", {}), schema.get("required", ()))


def _list_reflectances() -> None:
    """Print every ground reflectance, and under it each key with its default and its meaning."""
    from .. import reflectance

    for name, cls in reflectance.registry().items():
        typer.echo(f"{name}: {_summary(cls)}{_origin(reflectance.is_packaged(cls))}")
        schema = cls.model_json_schema()
        keys = {key: value for key, value in schema["properties"].items() if key != "model"}
        _list_keys(keys, schema.get("required", ()))


def _list_glasses() -> None:
    """Print every glass that a lens file may name, with its index and Abbe number at the d line."""
    from ..lens.glass import GLASSES

    width = max(map(len, GLASSES))
    for name, glass in GLASSES.items():
        typer.echo(f"{name:<{width}}  nd {glass.nd:.5f}  Abbe number {glass.vd:.2f}  formula {glass.formula}")


def _list_keys(properties: Mapping[str, Any], required: Collection[str]) -> None:
    """Print the keys of a table, from the properties of its JSON Schema, with default and meaning."""
    for key, value in properties.items():
        value_text = " must be given" if key in required else ""
        if "default" in value:
            value_text = f" = {json.dumps(value['default'])}"
        typer.echo(f"    {key}{value_text}    {value.get('description', '')}".rstrip())


def _summary(cls: type) -> str:
    """Return the first paragraph of a class's docstring in one line."""
    return " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].split())


def _origin(is_packaged: bool) -> str:
    """Return the mark of a class that a plug-in defines, as the end of its line."""
    return "" if is_packaged else " (of a plug-in)"


@app.command(rich_help_panel=_PANEL)
def new(
    kind: Annotated[
        str, typer.Argument(help="One of scene, lens, sensor, fault, effect and reflectance.", metavar="KIND")
    ],
    name: Annotated[
        str,
        typer.Argument(help="Name of the new thing and, with .toml or .py behind it, of its file.", metavar="NAME"),
    ],
    out: Annotated[Path, local_path("Folder for the file.")] = Path("."),
    overwrite: Annotated[bool, typer.Option(help="Replace a file of this name.")] = False,
) -> None:
    """Write a commented file that works as it is, to start your own from."""
    from ..output.starters import write_template

    typer.echo(str(write_template(kind, name, out, overwrite=overwrite)))


@app.command(rich_help_panel=_PANEL)
def shape(
    body: Annotated[str, typer.Argument(help="Name of a packaged body (`vbnfault list bodies`).", metavar="BODY")],
    out: Annotated[Path, local_path("Folder for the file and for shapes.lock, which keeps its checksum.")] = (
        Path(".")
    ),
    url: Annotated[
        str | None, typer.Option(help="Another address, such as that of a mirror.", show_default="the body's")
    ] = None,
) -> None:
    """Download the published shape model of a body and check its SHA-256, or check the file that lies there."""
    from ..body.download import LOCK, fetch_shape
    from ..scene.bodies import body_to_download

    known = body_to_download(body)
    fetched = fetch_shape(known.url if url is None else url, out, sha256=known.sha256)
    typer.echo(f"{fetched.path}: {'downloaded' if fetched.is_new else 'lies there already'}, {known.source}")
    typer.echo(f"{fetched.pin.size_bytes} bytes, SHA-256 {fetched.pin.sha256}")
    if fetched.was_known:
        typer.echo("the checksum is the one that was known")
    else:
        typer.echo(f"nobody published a checksum; {out / LOCK} keeps this one, and later downloads must have it")
    typer.echo(f'in the scene: [body] name = "{body}", shape = "{fetched.path}"')


@app.command(rich_help_panel=_PANEL)
def schema(
    kind: Annotated[str, typer.Argument(help="One of scene, lens, sensor and study.", metavar="KIND")] = "scene",
    plugins: PluginOption = None,
) -> None:
    """Print the JSON Schema of a kind of TOML file, for editors that check and complete it."""
    from ..output.starters import file_schema

    load_plugins(plugins)
    typer.echo(json.dumps(file_schema(kind), indent=2))


@app.command(rich_help_panel=_PANEL)
def doctor() -> None:
    """Print the installed versions and the LLVM that was found, and try a small render."""
    import importlib.metadata
    import platform

    from ..core.files import resources
    from ..core.process import llvm

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
