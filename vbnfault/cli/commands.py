"""The command line. It parses, calls and prints; no physics here, and nothing heavy is imported before its use.

Exit codes: 0 done, 1 a failed run, 2 bad input, 130 interrupted by Ctrl-C (143 by SIGTERM, 129 by SIGHUP), 141
where the reader of standard output left. A user's mistake never shows a traceback.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .. import __version__
from ..core import interrupts, streams
from ..core.errors import InputError, VbnfaultError, shown

if TYPE_CHECKING:
    from ..scene.config import Scene

app = typer.Typer(
    name="vbnfault",
    help="Labelled, fault-injected camera images for vision-based navigation near comets.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

SceneArgument = Annotated[str, typer.Argument(help="path of a scene file, or the name of a packaged scene")]
StoreArgument = Annotated[Path, typer.Argument(help="path of a Zarr store")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="replace a value of the scene, e.g. body.shape=comet.obj"),
]
_INTERRUPTED = "interrupted; what was written stays; repeat the command to go on"
MOST_SAMPLES = 10_000_000
MOST_PROCESSES = 1024
MOST_SEED = 2**63 - 1
SeedOption = Annotated[int | None, typer.Option(min=0, max=MOST_SEED, help="replace the scene's seed")]


def _finite(value: float | None) -> float | None:
    """An option's number. `nan` lies within any minimum and maximum to click."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


def main() -> None:
    """Entry point: turns errors into one sentence and an exit code."""
    if len(os.environ.get("COLUMNS", "")) > 4:  # no terminal is that wide; tables would fill the memory with blanks
        del os.environ["COLUMNS"]
    warnings.showwarning = lambda message, *_, **__: typer.echo(f"warning: {message}", err=True)
    with streams.steady(), interrupts.interruptible():
        try:
            code, stopped = _exit_code(), False
        except (interrupts.Stopped, KeyboardInterrupt, typer.Abort) as stop:
            code, stopped = interrupts.exit_code(stop), not streams.is_unread(stop)
            if stopped:
                with interrupts.finishing():
                    typer.echo(f"vbnfault: {_INTERRUPTED}", err=True)
    if stopped:
        interrupts.ignore()  # a second Ctrl-C while Python ends
    sys.exit(code)


def _exit_code() -> int:
    """Run the command of the command line, and turn its errors into a sentence."""
    try:
        code = app(standalone_mode=False)  # a command's typer.Exit comes back as its exit code
        interrupts.check()
    except VbnfaultError as error:
        typer.echo(f"vbnfault: {error}", err=True)
        return error.exit_code
    except typer.Abort:
        raise
    except OSError as error:  # of what no command expects, such as a full disk under standard output
        where = f"{error.filename}: " if error.filename else ""
        typer.echo(f"vbnfault: {where}{error.strerror or error}", err=True)
        return 1
    except MemoryError:
        typer.echo("vbnfault: not enough memory", err=True)
        return 1
    except Exception as error:
        interrupts.check()
        # click's own usage errors (bad option, missing argument) know how to print themselves
        show = getattr(error, "show", None)
        if show is None:
            raise
        show()
        return int(getattr(error, "exit_code", 2))
    return code if isinstance(code, int) else 0


def _version(show: bool) -> None:
    if show:
        typer.echo(f"vbnfault {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version and exit")
    ] = False,
) -> None:
    """Labelled, fault-injected camera images for vision-based navigation near comets."""
    try:
        os.getcwd()
    except OSError:
        raise InputError("the working folder does not exist any more; change to another one") from None


def _overrides(settings: list[str] | None, **named: Any) -> dict[str, Any]:
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
    return values | {key.replace("__", "."): value for key, value in named.items() if value is not None}


def _scene(name: str, settings: list[str] | None, **named: Any) -> Scene:
    from ..scene import config

    return config.load_scene(name, _overrides(settings, **named))


@app.command()
def build(
    scene: SceneArgument,
    out: Annotated[Path, typer.Option(help="path of the Zarr store to make, or to resume")],
    samples: Annotated[
        int | None, typer.Option(min=1, max=MOST_SAMPLES, help="number of samples, in place of the scene's")
    ] = None,
    seed: SeedOption = None,
    workers: Annotated[int, typer.Option(min=1, max=MOST_PROCESSES, help="processes on this machine")] = 1,
    threads: Annotated[
        int | None,
        typer.Option(min=1, max=MOST_PROCESSES, help="render threads a worker; default: the cores shared out"),
    ] = None,
    scheduler: Annotated[str | None, typer.Option(help="address of a Dask scheduler to run on")] = None,
    append: Annotated[
        int | None, typer.Option(min=1, max=MOST_SAMPLES, help="add a block of M samples to the store")
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="delete an existing store first")] = False,
    dry_run: Annotated[bool, typer.Option(help="plan and print, render nothing")] = False,
    accept_versions: Annotated[
        bool, typer.Option(help="complete a store that other versions of the libraries made, and note it there")
    ] = False,
    settings: SetOption = None,
) -> None:
    """Build a dataset, or resume one: a store of the same scene is completed and mended where it is damaged."""
    from .. import dataset

    options = dataset.BuildOptions(
        workers=workers,
        threads=threads,
        scheduler=scheduler,
        overwrite=overwrite,
        accept_versions=accept_versions,
        dry_run=dry_run,
    )
    source = _scene(scene, settings, dataset__seed=seed)
    summary = dataset.build_scene(source, out, options, samples=samples, append=append, source=scene)
    for line in summary.lines():
        typer.echo(line)


@app.command()
def describe(
    scene: SceneArgument,
    samples: Annotated[
        int | None, typer.Option(min=1, max=MOST_SAMPLES, help="number of samples, in place of the scene's")
    ] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
) -> None:
    """Say what a scene will photograph: samples by class and split, geometry, camera, size and time."""
    from .. import dataset

    source = _scene(scene, settings, dataset__samples=samples, dataset__seed=seed)
    for line in dataset.describe_scene(source, source=scene):
        typer.echo(line)


@app.command()
def verify(store: StoreArgument) -> None:
    """Check a store: exit code 0 only if every sample is whole, labelled and as planned."""
    from .. import dataset
    from .. import store as stores

    opened = stores.open_store(store)
    with typer.progressbar(length=opened.samples, label="samples", file=sys.stderr) as bar:
        report = dataset.verify(opened, progress=bar.update)
    for problem in report.problems:
        typer.echo(f"{store}: {problem}", err=True)
    for line in report.counts.lines():
        typer.echo(line)
    if report.problems:
        many = f"{len(report.problems)} problems" if len(report.problems) > 1 else "1 problem"
        typer.echo(f"vbnfault: {store}: {many}; the build command mends them", err=True)
        raise typer.Exit(1)
    if report.counts.missing:
        typer.echo(report.counts.missing_text())
    typer.echo(f"{store}: {opened.samples} samples, whole, labelled and as planned")
    typer.echo(f"digest {report.digest}")


@app.command()
def digest(store: StoreArgument) -> None:
    """Print the digest of a store's decoded arrays: equal for equal datasets, however they were built."""
    from .. import store as stores

    opened = stores.open_store(store)
    with typer.progressbar(length=opened.samples, label="samples", file=sys.stderr) as bar:
        typer.echo(stores.digest(opened, progress=bar.update))


@app.command()
def preview(
    store: StoreArgument,
    out: Annotated[Path, typer.Option(help="PNG to write")],
    samples: Annotated[int, typer.Option(min=1, max=400, help="at most this many samples")] = 16,
    masks: Annotated[bool, typer.Option(help="overlay the masks")] = True,
) -> None:
    """Contact sheet of a store, masks overlaid."""
    from ..output import contact_sheet

    contact_sheet.preview(store, out, max_samples=samples, masks=masks)
    typer.echo(str(out))


@app.command()
def render(
    scene: SceneArgument,
    out: Annotated[Path, typer.Option(help="folder to write to")],
    sample: Annotated[int, typer.Option(min=0, max=100 * MOST_SAMPLES, help="index of the sample")] = 0,
    samples: Annotated[int | None, typer.Option(min=1, max=MOST_SAMPLES, help="number of samples planned")] = None,
    append: Annotated[
        list[int] | None, typer.Option(min=1, max=MOST_SAMPLES, help="blocks appended to the store, in order")
    ] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
) -> None:
    """Render one sample of a scene as EXR, PNG and JSON; equal to the stored one bit for bit."""
    from ..core import llvm

    source = _scene(scene, settings, dataset__samples=samples, dataset__seed=seed)
    blocks = (source.dataset.samples, *(append or ()))
    if sample >= sum(blocks):
        raise InputError(f"--sample {sample}: {scene} plans samples 0 to {sum(blocks) - 1}; --samples plans more")
    llvm.find()
    from .. import pipeline
    from ..output import sample_files

    session = pipeline.Session(source, blocks=blocks, source=scene)
    session.warn_of_assumptions()
    with _written(out):  # before the work
        out.mkdir(parents=True, exist_ok=True)
    for path in sample_files.write_frame(session.frame(sample), out):
        typer.echo(str(path))


@app.command()
def lens(
    lens: Annotated[str, typer.Argument(help="path of a prescription, or the name of a packaged lens")],
    out: Annotated[Path | None, typer.Option(help="PNG of the layout [default: the lens's name, here]")] = None,
    json_: Annotated[Path | None, typer.Option("--json", help="the table as JSON")] = None,
    vary_seed: Annotated[
        int | None,
        typer.Option(min=0, max=MOST_SEED, help="a random relative of the lens in its place, by this seed"),
    ] = None,
    spread: Annotated[
        float,
        typer.Option(
            callback=_finite,
            min=0,
            max=0.5,
            help="of the relative's curvatures, thicknesses and rims, as a share of each",
        ),
    ] = 0.03,
    toml: Annotated[Path | None, typer.Option(help="write the prescription, such as a relative's")] = None,
    focal_length_mm: Annotated[
        float | None,
        typer.Option(
            callback=_finite, min=0.01, max=1e5, help="scale it to this focal length [default: as prescribed]"
        ),
    ] = None,
    fov_deg: Annotated[
        float | None,
        typer.Option(callback=_finite, min=0.01, max=140, help="scale it to this field; needs --sensor-width-mm"),
    ] = None,
    sensor_width_mm: Annotated[
        float | None, typer.Option(callback=_finite, min=1e-3, max=1e4, help="width that --fov-deg spans")
    ] = None,
    f_number: Annotated[
        float | None,
        typer.Option(
            callback=_finite, min=0.1, max=200, help="close its stop to this f-number [default: as prescribed]"
        ),
    ] = None,
) -> None:
    """First-order table of a lens (EFL, BFD, f-number, pupils), scaled and stopped down if asked, and a drawing."""
    from dataclasses import asdict

    import numpy as np

    from .. import lens as optics
    from ..lens.drawing import draw
    from ..lens.family import relative, write_lens

    prescription = optics.load_lens(lens)
    if vary_seed is not None:
        prescription = relative(prescription, np.random.default_rng(vary_seed), spread=spread)
    if (fov_deg is None) != (sensor_width_mm is None):
        given = f"--fov-deg {fov_deg}" if sensor_width_mm is None else f"--sensor-width-mm {sensor_width_mm}"
        raise InputError(f"{given}: --fov-deg and --sensor-width-mm go together")
    if focal_length_mm is not None and fov_deg is not None:
        raise InputError(f"--focal-length-mm {focal_length_mm:g}: leave it out, or --fov-deg")
    if focal_length_mm is not None:
        prescription = optics.scaled_to_focal_length(prescription, focal_length_mm)
    if fov_deg is not None and sensor_width_mm is not None:
        prescription = optics.scaled_to_field(prescription, fov_deg, sensor_width_mm)
    if f_number is not None:
        prescription = optics.closed_to(prescription, f_number, "--f-number")
    real = optics.open_f_number(prescription)
    figures = asdict(optics.first_order(prescription)) | {"real_f_number": real, "scale": prescription.scale}
    path = Path(f"{Path(lens).stem}.png") if out is None else out
    if path.suffix.lower() != ".png" or not path.absolute().parent.is_dir():
        raise InputError(f"--out {path}: must be a .png in a folder that exists")
    typer.echo(f"{prescription.name}: {len(prescription.surfaces)} surfaces, {prescription.source}")
    for name, value in figures.items():
        typer.echo(f"  {name:<28}{value:10.4f}")
    if json_ is not None:
        table = {"name": prescription.name, "source": prescription.source, **figures}
        with _written(json_):
            json_.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    if toml is not None:
        with _written(toml):
            write_lens(prescription, toml)
        typer.echo(str(toml))
    with _written(path):
        draw(prescription, path)
    typer.echo(str(path))


@app.command()
def flare(
    lens: Annotated[str, typer.Argument(help="path of a prescription, or the name of a packaged lens")],
    out: Annotated[Path, typer.Option(help="picture: .png, or .exr with every band")],
    sun_deg: Annotated[
        float, typer.Option(callback=_finite, min=0, max=90, help="angle of the Sun from the axis, 0 to below 90")
    ],
    azimuth_deg: Annotated[
        float,
        typer.Option(
            callback=_finite, min=-360, max=360, help="of the Sun in the picture: 0 to the right, 90 down"
        ),
    ] = 0.0,
    model: Annotated[str, typer.Option(help="of the ghosts: traced, paraxial or texture")] = "traced",
    wavelength_nm: Annotated[
        float | None,
        typer.Option(
            callback=_finite,
            min=250,
            max=2500,
            help="one wavelength [default: the Sun's spectrum in the camera's bands]",
        ),
    ] = None,
    json_: Annotated[Path | None, typer.Option("--json", help="every ghost as JSON")] = None,
    coating: Annotated[
        str | None, typer.Option(help="of all surfaces in air: none, mgf2, v or bbar [default: as prescribed]")
    ] = None,
    focal_length_mm: Annotated[
        float | None,
        typer.Option(callback=_finite, min=0.01, max=1e5, help="scale the lens to it [default: as prescribed]"),
    ] = None,
    fov_deg: Annotated[
        float, typer.Option(callback=_finite, min=0.1, max=140, help="across the picture's width")
    ] = 65.0,
    pixels: Annotated[int, typer.Option(min=16, max=4096, help="width and height of the picture")] = 1024,
    sun_distance_au: Annotated[
        float, typer.Option(callback=_finite, min=0.01, max=1000, help="sets the size of the Sun's disc")
    ] = 1.0,
    reflections: Annotated[int, typer.Option(min=2, max=4, help="of a ghost: 2, or 4 for those of four too")] = 2,
    roughness_nm: Annotated[
        float, typer.Option(callback=_finite, min=0, max=50, help="rms roughness of the surfaces")
    ] = 1.0,
    cleanliness_level: Annotated[
        float,
        typer.Option(callback=_finite, min=0, max=1000, help="particles on the surfaces, IEST-STD-CC1246; 0: none"),
    ] = 0.0,
    veil_fraction: Annotated[
        float,
        typer.Option(
            callback=_finite, min=0, max=0.5, help="of the light, that mount, barrel and edges scatter as a veil"
        ),
    ] = 0.01,
) -> None:
    """Ghosts, starburst and glare of the Sun through a lens: a picture, and a table of every ghost."""
    if out.suffix.lower() not in (".png", ".exr") or not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: must be a .png or .exr in a folder that exists")
    if sun_deg == 90:
        raise InputError(f"--sun-deg {sun_deg:g}: must be from 0 to below 90")
    if reflections not in (2, 4):
        raise InputError(f"--reflections {reflections}: must be 2 or 4")
    from .. import lens as optics
    from ..output import flare_images

    if model not in flare_images.MODELS:
        raise InputError(f"--model {model}: must be one of {', '.join(flare_images.MODELS)}")
    prescription = optics.load_lens(lens)
    if focal_length_mm is not None:
        prescription = optics.scaled_to_focal_length(prescription, focal_length_mm)
    optics.first_order(prescription)  # refuses a lens that no ray passes
    view = flare_images.FlareRequest(
        lens=prescription if coating is None else prescription.coated(coating),
        sun_deg=sun_deg,
        azimuth_deg=azimuth_deg,
        fov_deg=fov_deg,
        pixels=pixels,
        wavelength_nm=flare_images.wavelengths_nm(wavelength_nm),
        sun_distance_au=sun_distance_au,
        model=model,
        reflections=reflections,
        roughness_nm=roughness_nm,
        cleanliness_level=cleanliness_level,
        veil_fraction=veil_fraction,
    )
    bands = 0 if model == "texture" else len(view.wavelength_nm)
    with typer.progressbar(length=bands + 1, label="ghosts and picture", file=sys.stderr) as bar:
        found = flare_images.ghosts(view, bar.update) if bands else ()
        light = flare_images.layers(view)
        bar.update(1)
    if bands:
        total = sum(ghost.flux_fraction for ghost in found)
        typer.echo(f"{prescription.name}: {len(found)} ghosts hold {total:.3e} of the light that enters the pupil")
        brightest = sorted(found, key=lambda g: -g.peak_irradiance_fraction)[:10]
        typer.echo("  rows        flux      peak E/E0     x mm      y mm   rms mm")
        for g in brightest:
            x, y = g.centroid_mm
            typer.echo(
                f"  {'-'.join(map(str, g.pair)):<9}{g.flux_fraction:9.2e}  {g.peak_irradiance_fraction:9.2e}"
                f"  {x:9.3f} {y:9.3f}{g.rms_radius_mm:9.3f}"
            )
    if json_ is not None:
        with _written(json_):
            flare_images.write_table(view, found, json_)
        typer.echo(str(json_))
    with _written(out):
        flare_images.write_picture(view, light, out)
    typer.echo(str(out))


@app.command()
def detector(
    detector: Annotated[str, typer.Argument(help="path, or name of a packaged detector")],
    out: Annotated[Path, typer.Option(help="folder for the report and its plots")],
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="which individual of the sensor")] = 1,
    pixels: Annotated[
        int, typer.Option(min=64, max=4096, help="side of the part that is measured, at most the sensor")
    ] = 512,
    wavelength_nm: Annotated[
        float | None,
        typer.Option(callback=_finite, min=300, max=1100, help="of the light; default: each channel's best"),
    ] = None,
    temperature_k: Annotated[
        float | None, typer.Option(callback=_finite, min=100, max=400, help="of the sensor; default: its file's")
    ] = None,
    points: Annotated[int, typer.Option(min=8, max=2000, help="exposures of the photon transfer")] = 40,
    stack: Annotated[int, typer.Option(min=2, max=2000, help="pictures for DSNU, PRNU and spectra")] = 24,
) -> None:
    """EMVA 1288 characterisation of a virtual detector, with plots."""
    from ..camera import characterise
    from ..detector.chain import Device
    from ..detector.sensor import load_sensor

    sensor = load_sensor(detector)
    with _written(out):  # before the work
        out.mkdir(parents=True, exist_ok=True)
    shape = min(pixels, sensor.height_px), min(pixels, sensor.width_px)
    camera = characterise.VirtualCamera(
        Device(sensor, seed, shape=shape, temperature_K=temperature_k), wavelength_nm=wavelength_nm
    )
    settings = characterise.Settings(points=points, stack=stack)
    with typer.progressbar(length=characterise.pictures(settings), label="pictures", file=sys.stderr) as bar:
        found = characterise.characterise(
            camera,
            sites=camera.sites,
            photons_at_saturation=camera.photons_at_saturation,
            settings=settings,
            progress=bar.update,
        )
    title = f"{sensor.name}, individual {seed}, {camera.device.temperature_K:g} K"
    if wavelength_nm is not None:
        title += f", {wavelength_nm:g} nm"
    with _written(out):
        report = {"detector": sensor.name, "individual": seed, "temperature_K": camera.device.temperature_K}
        report |= {"wavelength_nm": wavelength_nm, "channels": [one.to_dict() for one in found.values()]}
        (out / "emva1288.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
        characterise.draw(found, title, out / "emva1288.png")
    typer.echo(title)
    for line in characterise.table(found):
        typer.echo(line)
    typer.echo(str(out / "emva1288.png"))


@contextlib.contextmanager
def _written(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


@app.command("list")
def list_(
    what: Annotated[str, typer.Argument(help="scenes, lenses, detectors or faults", metavar="KIND")],
) -> None:
    """List what is packaged: scenes, lenses, detectors, or the fault models with their keys."""
    from ..core import resources

    if what == "faults":
        _list_faults()
        return
    kinds = {"scenes": "scenes", "lenses": "scenes/lenses", "detectors": "scenes/detectors"}
    if what not in kinds:
        raise InputError(f"list {what}: must be one of {', '.join(kinds)}, faults")
    found = resources.packaged(kinds[what])
    if not found:
        typer.echo(f"no packaged {what}")
    width = max((len(name) for name in found), default=0)
    for name, path in found.items():
        table = resources.read_toml(path)
        typer.echo(f"{name:<{width}}  {table.get('description') or table.get('name', '')}")


def _list_faults() -> None:
    from .. import faults

    for name, models in faults.json_schema()["properties"].items():
        for model in models.get("anyOf", [models]):
            keys = dict(model["properties"])
            model = keys.pop("model")["const"]
            kind = faults.registry()[name][model]
            needs = " (needs camera.detector, a CCD)" if kind.needs_ccd else " (needs camera.detector)"
            typer.echo(f"{name} / {model}{needs if kind.needs_mosaic else ''}")
            for key, value in keys.items():
                default = json.dumps(value.get("default"))
                typer.echo(f"    {key} = {default}    {value['description']}")


@app.command()
def schema() -> None:
    """Print the JSON Schema of the scene file."""
    from .. import faults
    from ..scene import config

    typer.echo(json.dumps(config.json_schema(faults.json_schema()), indent=2))


@app.command()
def doctor() -> None:
    """What is installed, which LLVM was found, and whether a small render works."""
    import importlib.metadata
    import platform

    from ..core import llvm, resources

    typer.echo(f"vbnfault   {__version__}")
    typer.echo(f"python     {platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores")
    for name in ("mitsuba", "drjit", "numpy", "zarr", "trimesh", "OpenEXR", "colour-science", "dask"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            typer.echo(f"{name:<15}{importlib.metadata.version(name)}")
    for kind in ("scenes", "textures"):
        typer.echo(f"{kind:<15}{resources.data_dir(kind)}")
    for candidate in llvm.candidates():
        version = ".".join(map(str, candidate.version)) if candidate.version else "?"
        verdict = "usable" if candidate.usable else candidate.problem
        typer.echo(f"LLVM {version:<10}{candidate.path} ({candidate.origin}): {verdict}")
    typer.echo(f"LLVM in use    {llvm.find().path}")
    from .. import render

    typer.echo(f"test render    {render.self_test()}")


if __name__ == "__main__":
    main()
