"""Define the commands that compare a camera's own frames with a scene, and fit a sensor to them."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Literal

import typer

from ..core.errors import InputError
from .app import app
from .options import (
    MOST_PROCESSES,
    SceneOption,
    advancing,
    check_written,
    local_path,
    number,
    overrides,
    replaced,
    whole,
)

_PANEL = "Your camera"


@app.command(rich_help_panel=_PANEL)
def passport(
    frames: Annotated[Path, typer.Argument(help="Folder of NAME.png or NAME.tif and poses.csv.")],
    scene: SceneOption,
    out: Annotated[
        Path, local_path("Folder for passport.html, passport.json and the pairs, to make or to continue.")
    ],
    poses: Annotated[
        Path | None, typer.Option(help="Table of poses, a row for each frame.", show_default="poses.csv of FRAMES")
    ] = None,
    part: Annotated[
        Literal["shown", "kept_back", "all"],
        typer.Option(help="Frames to compare: choose settings on those shown, and judge by those kept back."),
    ] = "shown",
    kept_back: Annotated[float, number(0, 0.9, "Fraction of the frames that is kept back, by their names.")] = 0.33,
    gain: Annotated[
        list[float] | None,
        number(1, 1000, "Factor on the detector's gain that the camera has; may be repeated.", unset="1"),
    ] = None,
    mend_poses: Annotated[int, whole(0, 5, "How often each pose is mended by its frame.")] = 1,
    workers: Annotated[int, whole(1, MOST_PROCESSES, "Number of processes that compare frames.")] = 2,
    threads: Annotated[int | None, whole(1, MOST_PROCESSES, "Render threads.", unset="every core")] = None,
    settings: Annotated[list[str] | None, replaced("scene", "body.shape=comet.obj")] = None,
) -> None:
    """Say how real a scene is for a camera: compare its frames with images rendered for their poses, by statistics
    and by classifiers, and list what may be concluded. The same command continues an interrupted comparison.
    """
    from ..fit.passport import PAGE, PassportOptions
    from ..fit.passport import passport as compare

    options = PassportOptions(
        part=part,
        kept_back=kept_back,
        gains=tuple(gain or (1.0,)),
        mendings=mend_poses,
        workers=workers,
        threads=threads,
    )
    with advancing("frames and classifiers") as advance:
        result = compare(frames, scene, out, options, overrides=overrides(settings), poses=poses, advance=advance)
    for name in ("may", "undecided", "may_not"):
        for text in result["conclusions"][name]:
            typer.echo(f"{name.replace('_', ' ')}: {text}")
    typer.echo(f"page: {out / PAGE}")


@app.command(rich_help_panel=_PANEL)
def inject(
    images: Annotated[
        list[str],
        typer.Argument(
            help="Images, films, folders and globs: PNG, TIFF, FITS, PDS, EXR, NPY, MP4, MKV, …", metavar="IMAGE..."
        ),
    ],
    scene: SceneOption,
    out: Annotated[Path, local_path("Folder for the images, masks and parameters, to make or to continue.")],
    labels: Annotated[
        Literal["png", "zarr"],
        typer.Option(help="Masks as PNG beside the images, and a store that holds all, if zarr."),
    ] = "png",
    sun: Annotated[
        str | None,
        typer.Option(
            help="Position of the Sun: auto, none, X,Y in pixels, or X,Y,Z in the camera's axes.",
            show_default="image.sun of the scene",
        ),
    ] = None,
    sequence: Annotated[
        bool,
        typer.Option(
            "--sequence", help="The images follow each other: dust, defects and lens stay as they are through all."
        ),
    ] = False,
    seed: Annotated[int | None, whole(0, 2**63 - 1, "Seed.", unset="the scene's")] = None,
    workers: Annotated[int, whole(1, MOST_PROCESSES, "Number of processes.")] = 1,
    settings: Annotated[list[str] | None, replaced("scene", "camera.fov_deg=5")] = None,
) -> None:
    """Put the faults of a scene into images of one's own, with a mask for each fault and its parameters. Size,
    depth and metadata of the images stay. The same command continues after an interruption.
    """
    from ..inject.batch import inject_files
    from ..scene.config import load_scene

    changes = overrides(settings)
    if seed is not None:
        changes["dataset.seed"] = seed
    batch = inject_files(
        images,
        load_scene(scene, changes),
        out,
        labels=labels,
        sun=_sun(sun),
        sequence=sequence,
        workers=workers,
    )
    for sentence in batch.report():
        typer.echo(sentence)
    typer.echo(f"{len(batch.names)} images: {out}")


def _sun(text: str | None) -> str | tuple[float, ...] | None:
    """Return what --sun says. Raises InputError if it is neither a word nor two or three numbers."""
    if text is None or text in ("auto", "none"):
        return text
    with contextlib.suppress(ValueError):
        numbers = tuple(map(float, text.split(",")))
        if len(numbers) in (2, 3):
            return numbers
    raise InputError(f"--sun {text}: must be auto, none, X,Y in pixels, or X,Y,Z in the camera's axes")


@app.command(rich_help_panel=_PANEL)
def fit(
    out: Annotated[Path, local_path("Sensor file to write.")],
    frames: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders or files of ordinary frames, such as of sky, ground and limbs.", metavar="FRAMES"
        ),
    ] = None,
    darks: Annotated[list[Path] | None, typer.Option(help="Folder or file of darks; may be repeated.")] = None,
    flats: Annotated[list[Path] | None, typer.Option(help="Folder or file of flats; may be repeated.")] = None,
    stars: Annotated[
        list[Path] | None, typer.Option(help="Folder or file of star fields; may be repeated.")
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="Sensor file, or name of a packaged detector, that says what frames do not: filters, pitch, bits.",
            show_default="monochrome, assumed",
        ),
    ] = None,
    stretch: Annotated[
        float | None,
        number(0.3, 1, "Frames are 8 bit images that show this power of the signal, maybe reduced.", unset="raw"),
    ] = None,
    plot: Annotated[Path | None, local_path("PNG of the photon transfer to write.", unset="none")] = None,
) -> None:
    """Fit a sensor to a camera's own frames: gain, noise, dark current, patterns, defects and response, each with
    an interval of 95 %, and what could not be fitted. A folder may hold frames.csv with the frames' exposures.
    """
    from ..core.files import resources
    from ..core.files.path_checks import real
    from ..core.files.whole_files import write_whole, writing
    from ..fit.exposures import TABLE, Kind, read_exposures
    from ..fit.sensor_file import draw_transfer, sensor_text
    from ..fit.sensor_fit import fit_sensor

    check_written("", {"--out": out, "--plot": plot})
    given: dict[Kind, list[Path]] = {
        "dark": darks or [],
        "flat": flats or [],
        "star": stars or [],
        "frame": frames or [],
    }
    exposures = read_exposures(given)
    read = {real(one.name) for one in exposures} | {real(path / TABLE) for some in given.values() for path in some}
    if sensor is not None:
        read.add(real(resources.find("scenes/detectors", sensor)))
    for option, path in (("--out", out), ("--plot", plot)):
        if path is not None and real(path) in read:
            raise InputError(f"{option} {path}: is a file that the fit reads; choose another path")
    result = fit_sensor(exposures, sensor, stretch)
    text = sensor_text(result)
    if plot is not None:
        draw_transfer(result, plot)
    with writing(out):
        write_whole(out, text)
    for key, one in result.estimates.items():
        typer.echo(f"{key:<36}{one.value:>11.5g}   {one.low:.4g} to {one.high:.4g}   {one.method}")
    for key, why in result.missing.items():
        typer.echo(f"not fitted: {key} {why}")
    typer.echo(f"sensor file: {out}")
