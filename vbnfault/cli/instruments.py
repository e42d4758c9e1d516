"""Define the commands that examine a lens or a sensor on its own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.files.whole_files import writing
from .app import app
from .options import (
    MOST_SEED,
    FieldOption,
    FocalLengthOption,
    LensArgument,
    PluginOption,
    SensorWidthOption,
    check_image_path,
    check_written,
    grouped,
    load_plugins,
    local_path,
    number,
    progress_bar,
    whole,
)

if TYPE_CHECKING:
    from ..lens.straylight.ghosts import Ghost

_PANEL = "Lenses and sensors"
_BRIGHTEST = 10  # ghosts that `flare` prints


@dataclasses.dataclass(frozen=True, kw_only=True)
class LensOptions:
    """Hold the options that change a lens; the fields of `lens.adapt.LensRequest`."""

    vary_seed: Annotated[
        int | None,
        whole(0, MOST_SEED, "Seed of a random relative that replaces the lens.", unset="the lens as it is"),
    ] = None
    spread: Annotated[
        float,
        number(
            0,
            0.3,
            "How much a relative differs: standard deviation of the logarithm of its curvatures, thicknesses and "
            "diameters.",
        ),
    ] = 0.03
    focal_length_mm: FocalLengthOption = None
    fov_deg: FieldOption = None
    sensor_width_mm: SensorWidthOption = None
    f_number: Annotated[
        float | None, number(0.1, 200, "F-number to which the stop is closed.", unset="as prescribed")
    ] = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Hold the options of the frame to whose distortion OpenCV's model is fitted."""

    fit_opencv: Annotated[
        bool,
        typer.Option(
            "--fit-opencv",
            help="Print the lens's distortion as OpenCV's coefficients, with the residual.",
        ),
    ] = False
    width_px: Annotated[int, whole(16, 16384, "Width in pixels of the image for --fit-opencv.")] = 1024
    height_px: Annotated[
        int | None, whole(16, 16384, "Height in pixels of the image for --fit-opencv.", unset="as wide as it is")
    ] = None


@app.command(rich_help_panel=_PANEL)
@grouped
def lens(
    lens: LensArgument,
    options: LensOptions,
    fit: FitOptions,
    out: Annotated[
        Path | None,
        local_path("PNG file for the drawing.", unset="the lens's name, in the working folder"),
    ] = None,
    json_: Annotated[
        Path | None,
        local_path("JSON file for the table; null stands for a value that is infinite.", "--json"),
    ] = None,
    toml: Annotated[
        Path | None, local_path("TOML file for the prescription with all changes, such as a relative.")
    ] = None,
) -> None:
    """Print a lens's focal length, pupils and f-number, and draw it with the numbers of its rows."""
    from ..lens.adapt import LensRequest, adapted_lens
    from ..lens.prescription_file import write_lens
    from ..output import lens_sheet

    path = Path(f"{Path(lens).stem}.png") if out is None else out
    check_written(lens, {"--json": json_, "--toml": toml, "--out": path})
    request = LensRequest(lens=lens, **vars(options))
    prescription = adapted_lens(request)
    check_image_path(path, ".png")
    source = f", {prescription.source}" if prescription.source else ""
    typer.echo(f"{prescription.name}: {len(prescription.surfaces)} surfaces{source}")
    for name, value in lens_sheet.figures(prescription).items():
        typer.echo(f"  {name:<28}{value:10.4f}")
    field_deg = request.field_deg(prescription, 40.0)
    if fit.fit_opencv:
        height_px = fit.width_px if fit.height_px is None else fit.height_px
        typer.echo(lens_sheet.opencv_fit(prescription, field_deg, fit.width_px, height_px))
    if json_ is not None:
        with writing(json_):
            lens_sheet.write_table(prescription, json_)
        typer.echo(str(json_))
    if toml is not None:
        with writing(toml):
            write_lens(prescription, toml)
        typer.echo(str(toml))
    with writing(path):
        lens_sheet.draw(prescription, path, half_field_deg=field_deg / 2)
    typer.echo(str(path))


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlareOptions:
    """Hold the options that describe the Sun and the image; fields of `output.flare_images.FlareRequest`."""

    sun_deg: Annotated[float, number(0, 90, "Angle of the Sun from the optical axis in degrees, below 90.")]
    azimuth_deg: Annotated[
        float, number(-360, 360, "Direction of the Sun in the image in degrees: 0 is to the right, 90 is down.")
    ] = 0.0
    model: Annotated[str, typer.Option(help="Model of the ghosts: traced, paraxial or texture.")] = "traced"
    pixels: Annotated[int, whole(16, 4096, "Width and height of the image in pixels.")] = 1024
    sun_distance_au: Annotated[
        float, number(0.01, 1000, "Distance of the Sun in au; it sets the size of the Sun's disc.")
    ] = 1.0
    reflections: Annotated[
        int, whole(2, 4, "Reflections of a ghost: 2, or 4 to add ghosts of four reflections.")
    ] = 2
    roughness_nm: Annotated[float, number(0, 50, "Roughness of each surface in nm rms.")] = 1.0
    cleanliness_level: Annotated[
        float,
        number(0, 1000, "Particles on each surface, as a cleanliness level of IEST-STD-CC1246; 0 means none."),
    ] = 0.0
    veil_fraction: Annotated[
        float, number(0, 0.5, "Fraction of the light that mount, barrel and edges scatter as a veil.")
    ] = 0.01


@app.command(rich_help_panel=_PANEL)
@grouped
def flare(
    lens: LensArgument,
    out: Annotated[Path, local_path("Image file: .png, or .exr with every band and no exposure.")],
    options: FlareOptions,
    wavelength_nm: Annotated[
        float | None,
        number(
            250, 2500, "A single wavelength in nm.", unset="the Sun's spectrum in eight bands from 400 to 700 nm"
        ),
    ] = None,
    coating: Annotated[
        str | None,
        typer.Option(
            help="Coating of every surface between glass and air: none, mgf2, v or bbar.",
            show_default="as prescribed",
        ),
    ] = None,
    focal_length_mm: FocalLengthOption = None,
    fov_deg: FieldOption = None,
    sensor_width_mm: SensorWidthOption = None,
    white: Annotated[
        float | None,
        number(
            1e-12,
            1e6,
            "Irradiance on the sensor that a PNG shows as white, as a fraction of the Sun's irradiance at the "
            "lens's entrance (no unit, like 'peak E/E0' in the table). Images with the same level can be compared. "
            "For the model texture: fraction of the camera's white.",
            unset="the 99.7th percentile of ghosts, glare and veil; for texture 1",
        ),
    ] = None,
    json_: Annotated[
        Path | None, local_path("JSON file with every ghost; null stands for an undefined value.", "--json")
    ] = None,
) -> None:
    """Compute ghosts, starburst and glare of the Sun in a lens, as an image and as a table of every ghost."""
    check_written(lens, {"--json": json_, "--out": out})
    check_image_path(out, ".png", ".exr")
    from ..lens.adapt import LensRequest, adapted_lens
    from ..output import flare_images

    named = LensRequest(
        lens=lens,
        coating=coating,
        focal_length_mm=focal_length_mm,
        fov_deg=fov_deg,
        sensor_width_mm=sensor_width_mm,
    )
    prescription = adapted_lens(named)
    request = flare_images.FlareRequest(
        lens=prescription,
        fov_deg=named.field_deg(prescription, 65.0),
        wavelength_nm=flare_images.wavelengths_nm(wavelength_nm),
        white=white,
        **vars(options),
    )
    with progress_bar(request.steps, "ghosts and image") as bar:
        result = flare_images.compute(request, bar.update)
    if result.ghosts:
        _print_ghosts(request.lens.name, result.ghosts)
    if json_ is not None:
        with writing(json_):
            flare_images.write_table(result, json_)
        typer.echo(str(json_))
    with writing(out):
        flare_images.write_picture(result, out)
    if out.suffix.lower() == ".png" and white is None:
        typer.echo(
            f"white level {result.white:.3g}; --white {result.white:.3g} gives another image the same exposure"
        )
    typer.echo(str(out))


def _print_ghosts(name: str, ghosts: tuple[Ghost, ...]) -> None:
    """Print the total flux of all ghosts and a table of the brightest."""
    total = sum(ghost.flux_fraction for ghost in ghosts)
    typer.echo(f"{name}: {len(ghosts)} ghosts hold {total:.3e} of the light that enters the pupil")
    if len(ghosts) > _BRIGHTEST:
        typer.echo(f"  the {_BRIGHTEST} with the highest peaks (--json writes all):")
    typer.echo("  rows        flux      peak E/E0     x mm      y mm   rms mm")
    for ghost in sorted(ghosts, key=lambda g: -g.peak_irradiance_fraction)[:_BRIGHTEST]:
        x, y = ghost.centroid_mm
        pair, peak = "-".join(map(str, ghost.pair)), ghost.peak_irradiance_fraction
        typer.echo(
            f"  {pair:<9}{ghost.flux_fraction:9.2e}  {peak:9.2e}  {x:9.3f} {y:9.3f}{ghost.rms_radius_mm:9.3f}"
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """Hold the options that describe the measurement of a sensor; see `output.sensor_report`."""

    seed: Annotated[
        int,
        whole(0, MOST_SEED, "Seed of the device that is measured: each has its own defects."),
    ] = 1
    pixels: Annotated[
        int,
        whole(64, 4096, "Width and height in pixels of the part that is measured, at most the sensor."),
    ] = 512
    wavelength_nm: Annotated[
        float | None, number(300, 1100, "Wavelength of the light in nm.", unset="the best one of each channel")
    ] = None
    temperature_k: Annotated[
        float | None, number(100, 400, "Temperature of the sensor in kelvin.", unset="that of its file")
    ] = None
    points: Annotated[int, whole(8, 2000, "Number of light levels of the photon transfer.")] = 40
    stack: Annotated[int, whole(2, 2000, "Number of images that are averaged for DSNU, PRNU and spectra.")] = 24


@app.command(rich_help_panel=_PANEL)
@grouped
def detector(
    detector: Annotated[str, typer.Argument(help="Path of a sensor file, or name of a packaged detector.")],
    out: Annotated[Path, local_path("Folder for emva1288.json and emva1288.png.")],
    options: DetectorOptions,
    plugins: PluginOption = None,
) -> None:
    """Characterise a virtual sensor as EMVA 1288 defines, with plots."""
    from ..camera.characterise import Settings, pictures
    from ..output import sensor_report

    load_plugins(plugins)
    # a sensor file that is refused leaves no folder behind
    device = sensor_report.device_of(
        detector, options.seed, pixels=options.pixels, temperature_K=options.temperature_k
    )
    settings = Settings(points=options.points, stack=options.stack)
    images = pictures(settings)
    with writing(out):  # before the work
        out.mkdir(parents=True, exist_ok=True)
    with progress_bar(images, f"{images} images") as bar:
        report = sensor_report.measure(device, settings, options.wavelength_nm, bar.update)
    typer.echo(report.title)
    for line in report.lines():
        typer.echo(line)
    with writing(out):
        for path in report.write(out):
            typer.echo(str(path))
