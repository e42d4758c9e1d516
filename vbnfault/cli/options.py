"""Define the arguments and options that several commands share, and groups of options as dataclasses."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import math
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from ..core.errors import InputError, shown
from ..core.files.path_checks import real
from ..core.process.environment import MOST_SAMPLES, MOST_THREADS

if TYPE_CHECKING:
    from ..scene.config import Scene

MOST_PROCESSES = MOST_THREADS
MOST_SEED = 2**63 - 1

_A_SCENE = "Path of a scene file, or name of a packaged scene."
SceneArgument = Annotated[str, typer.Argument(help=_A_SCENE)]
SceneOption = Annotated[str, typer.Option(help=_A_SCENE)]
OutStoreOption = Annotated[str, typer.Option(help="Path or URL of the Zarr store to make or to resume.")]
StoreArgument = Annotated[str, typer.Argument(help="Path or URL (s3://, gs://, az://, file://) of a Zarr store.")]
PluginOption = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        metavar="MODULE",
        help="Plug-in with further faults, detector effects or reflectances: the name of a module, or the path of "
        "a file; may be repeated.",
        show_default=False,
    ),
]
LensArgument = Annotated[str, typer.Argument(help="Path of a prescription, or name of a packaged lens.")]


def _limited(
    kind: type[int] | type[float], low: float, high: float, text: str, names: tuple[str, ...], unset: str | None
) -> Any:
    """Return an option that takes a whole number (`kind` is int) or any number (float) from `low` to `high`."""
    limits = f"{low} to {high}" if kind is int else f"{low:g} to {high:g}"

    def parsed(given: str | float) -> float:
        """Return the number that a text holds, or a default, which is one. Raises BadParameter for other texts."""
        text = str(given)
        try:
            value = kind(text) if text.isascii() and "_" not in text else math.nan
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            noun = "whole number" if kind is int else "number"
            raise typer.BadParameter(f"{shown(given)} must be a {noun} from {limits}")
        return value

    metavar = f"{'INTEGER' if kind is int else 'NUMBER'} ({limits})"
    return typer.Option(*names, parser=parsed, metavar=metavar, help=text, show_default=unset or True)


def number(low: float, high: float, text: str, *names: str, unset: str | None = None) -> Any:
    """Return an option that takes a finite number from `low` to `high`.

    `unset` says in the help what holds without the option, where its default is None.
    """
    return _limited(float, low, high, text, names, unset)


def on_this_machine(param: typer.CallbackParam, value: Path | None) -> Path | None:
    """Return the path that an option was given. Raises InputError for a URL such as s3://bucket."""
    scheme, colon, rest = str(value or "").partition(":/")  # a path keeps one of two slashes
    if colon and re.fullmatch(r"[A-Za-z][A-Za-z0-9+.-]+", scheme):
        raise InputError(f"{param.opts[0]} {scheme}://{rest}: is a URL; must be a path on this machine")
    return value


def local_path(text: str, *names: str, unset: str | None = None) -> Any:
    """Return an option that takes the path of a file or folder to write; `unset` as `number` says it."""
    return typer.Option(
        *names, parser=_path, metavar="PATH", callback=on_this_machine, help=text, show_default=unset or True
    )


def _path(given: str | Path) -> Path:
    """Return a path that an option was given. Raises BadParameter for an empty one and for the root folder."""
    if not str(given).strip():  # it would be the working folder
        raise typer.BadParameter(f"{shown(given)} must be a path, and not empty")
    if Path(given).root and not Path(given).name:
        raise typer.BadParameter(f"{shown(given)} is the root folder; choose a folder in it")
    return Path(given)


def replaced(what: str, example: str) -> Any:
    """Return the option that replaces values of a file: of what, and an example."""
    text = f"Replace a value of the {what}, such as {example}; may be repeated."
    return typer.Option("--set", metavar="KEY=VALUE", help=text)


def shard_range(text: str) -> range:
    """Return the range of `--shard-range A:B`; `BuildOptions` checks their order. Raises InputError."""
    match = re.fullmatch(r"(\d{1,12}):(\d{1,12})", text.strip(), re.ASCII)
    if match is None:
        raise InputError(f"--shard-range {shown(text)}: must be A:B, whole numbers with 0 <= A < B, such as 0:4")
    return range(int(match[1]), int(match[2]))


def whole(low: int, high: int, text: str, *, unset: str | None = None) -> Any:
    """Return an option that takes a whole number from `low` to `high`; for `unset` see `number`."""
    return _limited(int, low, high, text, (), unset)


FocalLengthOption = Annotated[
    float | None, number(0.01, 1e5, "Focal length in mm to which the lens is scaled.", unset="as prescribed")
]
FieldOption = Annotated[
    float | None,
    number(
        0.1,
        140,
        "Field of view in degrees across the width of the image; with --sensor-width-mm, the lens is scaled so "
        "that the sensor spans it.",
        unset="of the sensor, or else 40 for lens and 65 for flare",
    ),
]
SensorWidthOption = Annotated[float | None, number(1e-3, 1e4, "Width of the sensor in mm.", unset="none")]


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose parameters of a dataclass type are replaced by the fields of the dataclass.

    Each field becomes an option of the command, with the field's annotation and default. The command gets the
    dataclass.
    """
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []

    def add(name: str, default: Any, annotation: Any) -> None:
        parameters.append(
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        )

    for name, parameter in inspect.signature(command).parameters.items():
        if not dataclasses.is_dataclass(hints[name]):
            add(name, parameter.default, hints[name])
            continue
        groups[name] = hints[name]
        annotations = get_type_hints(hints[name], include_extras=True)
        for field in dataclasses.fields(hints[name]):
            missing = field.default is dataclasses.MISSING
            add(field.name, inspect.Parameter.empty if missing else field.default, annotations[field.name])

    @functools.wraps(command)
    def flat(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in dataclasses.fields(group)})
        command(**values)

    del flat.__wrapped__  # type: ignore[attr-defined]  # typer must read the parameters below
    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": None}
    return flat


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneValues:
    """Hold the options that replace values of a scene file, whose number of samples is given by something else."""

    seed: Annotated[
        int | None,
        whole(0, MOST_SEED, "Seed of all random numbers.", unset="the scene's"),
    ] = None
    settings: Annotated[
        list[str] | None,
        replaced("scene", "body.shape=comet.obj"),
    ] = None

    def load(self, scene: str) -> Scene:
        """Return the scene with these values."""
        from ..scene import config

        return config.load_scene(scene, self._values())

    def _values(self) -> dict[str, Any]:
        """Return the values of all options, by key of the scene."""
        own = {f"dataset.{name}": getattr(self, name, None) for name in ("seed", "samples")}
        return overrides(self.settings) | {key: value for key, value in own.items() if value is not None}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneOptions(SceneValues):
    """Hold the options that replace values of a scene file."""

    samples: Annotated[
        int | None,
        whole(1, MOST_SAMPLES, "Number of samples to plan.", unset="the scene's"),
    ] = None
    scale: Annotated[
        float, number(0.01, 1, "Factor on the image's width and height, for a preview with the same field of view.")
    ] = 1.0

    def load(self, scene: str) -> Scene:
        """Return the scene with these values; a scaled one has fewer pixels over the same field of view."""
        from ..scene import config

        loaded = super().load(scene)
        if self.scale == 1:
            return loaded
        camera = loaded.camera
        size = {f"camera.{k}": max(16, round(self.scale * getattr(camera, k))) for k in ("width_px", "height_px")}
        field: dict[str, Any] = {"camera.fov_deg": camera.fov_deg, "camera.focal_length_mm": None}
        if camera.calibration is not None:
            numbers = camera.calibration.model_dump(exclude_none=True)
            field = {"camera.calibration": numbers | {"scale_to_frame": True}}
        return config.load_scene(scene, self._values() | size | field)


def overrides(settings: list[str] | None) -> dict[str, Any]:
    """Return the values of `--set KEY=VALUE` by key. A value that is not TOML is a text. Raises InputError."""
    values: dict[str, Any] = {}
    for setting in settings or ():
        key, equals, text = setting.partition("=")
        if not equals or not key.strip():
            raise InputError(f"--set {shown(setting)}: must be KEY=VALUE, such as body.shape=comet.obj")
        try:
            values[key.strip()] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            values[key.strip()] = text.strip()  # a bare word or path
        except (ValueError, RecursionError):  # a number of thousands of digits; lists within lists
            raise InputError(f"--set {shown(setting)}: the value is out of range or nested too deep") from None
    return values


def load_plugins(names: list[str] | None) -> None:
    """Load the plug-ins of `--plugin`; their paths start from the working folder. Raises InputError."""
    from .. import faults
    from ..core.files import path_checks

    faults.load_plugins([path_checks.absolute(n, "--plugin") if n.endswith(".py") else n for n in names or ()])


def progress_bar(length: int, label: str) -> Any:
    """Return a progress bar on standard error: a context manager whose `update` takes the steps just done.

    Without a length, or where standard error is no terminal, it shows nothing; click would print the label alone.
    """
    hidden = not length or not sys.stderr.isatty()
    return typer.progressbar(length=length, label=label, file=sys.stderr, hidden=hidden)


@contextlib.contextmanager
def advancing(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows how many of how many steps are done; a smaller number begins a new bar."""
    with contextlib.ExitStack() as stack:
        bars: list[Any] = []

        def advance(done: int, count: int) -> None:
            if not bars or done < bars[-1].pos:
                stack.close()
                bars.append(stack.enter_context(progress_bar(count, label)))
            bars[-1].update(done - bars[-1].pos)

        yield advance


def check_written(read: str, written: Mapping[str, Path | None]) -> None:
    """Check, before the work, the paths of the files that options ask to write. Raises InputError.

    Two options may not name one file, none the file which is read, and all folders must exist.
    """
    taken = {real(read): "the input"} if Path(read).is_file() else {}
    for option, path in written.items():
        if path is None:
            continue
        other = taken.setdefault(real(path), option)
        if other != option:
            raise InputError(f"{option} {path}: is also the file of {other}; choose another path")
        if not path.absolute().parent.is_dir():
            raise InputError(f"{option} {path}: must be in a folder that exists")


def check_image_path(path: Path, *endings: str) -> None:
    """Refuse a path before the work unless it has one of the endings and its folder exists. Raises InputError."""
    if path.suffix.lower() not in endings or not path.absolute().parent.is_dir():
        raise InputError(f"--out {path}: must be a {' or '.join(endings)} in a folder that exists")
