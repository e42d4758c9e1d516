"""Compute the straylight of a lens alone, as an image on black and as a table of every ghost: `vbnfault flare`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import spectra, tables
from ..core.errors import InputError, shown
from ..core.files.images import srgb8, write_exr, write_png
from ..core.files.whole_files import write_json
from ..core.quantities import Electrons
from ..core.spectra import Bands
from ..detector import ThreeColourDetector
from ..faults import FaultContext, registry
from ..lens import Prescription, ThinLens, load_lens, paraxial_properties
from ..lens.rays import axial_transmittance
from ..lens.straylight.ghosts import Ghost
from ..lens.straylight.irradiance import traced_ghosts
from ..lens.straylight.scatter import Cleanliness
from ..lens.straylight.settings import VEIL_FRACTION, GhostSettings, SensorGrid, StraylightSettings, SunSource
from ..lens.straylight.total import SunInLens
from ..scene import keyed_random

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

MODELS = ("traced", "paraxial", "texture")
# Field of a request, least and greatest value.
RANGES = (
    ("sun_deg", 0, 90),
    ("azimuth_deg", -360, 360),
    ("fov_deg", 0.1, 140),
    ("pixels", 16, 4096),
    ("sun_distance_au", 0.01, 1000),
    ("roughness_nm", 0, 50),
    ("cleanliness_level", 0, 1000),
    ("veil_fraction", 0, 0.5),
    ("white", 1e-12, 1e6),
)
_BANDS = 8
_ACROSS_SPECTRUM = 192
_SHOWN_PERCENTILE = 99.7


@dataclass(frozen=True, kw_only=True, eq=False)
class FlareRequest:
    """Hold a lens, the direction of the Sun, and the size of an image whose centre lies on the optical axis.

    Attributes
    ----------
    sun_deg, azimuth_deg
        Angle of the Sun from the axis; its direction in the image: 0 to the right, 90 down.
    fov_deg
        Field of request across the width of the image.
    pixels
        Width and height of the image.
    wavelength_nm
        Wavelengths of the bands, float64[band].
    model
        `traced`, `paraxial` or `texture`.
    reflections
        Reflections of a traced ghost: 2, or 4 to add ghosts of four reflections.
    roughness_nm, cleanliness_level, veil_fraction
        Scatter of the surfaces, see `lens.straylight`.
    white
        Irradiance on the sensor that `picture` shows as white, as a fraction of the Sun's irradiance at the lens's
        entrance; for the model `texture`, as a fraction of the camera's white. None: see `Flare.white`.
    """

    lens: Prescription
    sun_deg: float
    azimuth_deg: float = 0.0
    fov_deg: float = 65.0
    pixels: int = 1024
    wavelength_nm: F64
    sun_distance_au: float = 1.0
    model: str = "traced"
    reflections: int = 2
    roughness_nm: float = 1.0
    cleanliness_level: float = 0.0
    veil_fraction: float = VEIL_FRACTION
    white: float | None = None

    def __post_init__(self) -> None:
        for name, lowest, highest in RANGES:
            value = getattr(self, name)
            if name != "white" or value is not None:
                _check_number(name, value, lowest, highest)
        if tables.whole(self.pixels) is None:
            raise InputError(f"pixels = {shown(self.pixels)}: must be a whole number")
        if self.sun_deg == 90:
            raise InputError("sun_deg = 90: must be from 0 to below 90")
        if self.model not in MODELS:
            raise InputError(f"model = {self.model!r}: must be one of {', '.join(MODELS)}")
        if self.reflections not in (2, 4):
            raise InputError(f"reflections = {self.reflections}: must be 2 or 4")

    @property
    def steps(self) -> int:
        """Return how many steps of progress `compute` reports."""
        return 1 + (0 if self.model == "texture" else len(self.bands.nodes_nm))

    @property
    def bands(self) -> Bands:
        """Return the bands in which the Sun's light is computed; a single wavelength is a line."""
        return Bands.sunlit(self.wavelength_nm)

    @property
    def pitch_mm(self) -> float:
        """Return the pixel pitch of the image on the sensor plane, in mm."""
        return 2 * paraxial_properties(self.lens).efl_mm * float(np.tan(np.radians(self.fov_deg / 2))) / self.pixels

    @property
    def sun(self) -> SunSource:
        """Return the Sun as the lens sees it."""
        return SunSource(
            angle_deg=self.sun_deg,
            azimuth_deg=self.azimuth_deg,
            radius_rad=spectra.sun_angular_radius_rad(self.sun_distance_au),
        )

    @property
    def sun_xy_mm(self) -> tuple[float, float]:
        """Return the position of the Sun's direct image on the sensor plane, f tan θ from the axis, in mm."""
        return self.sun.xy_mm(paraxial_properties(self.lens).efl_mm)


def wavelengths_nm(single_nm: float | None = None) -> F64:
    """Return a single wavelength, or the nodes of the cameras' default bands; float64[band].

    Raises InputError for a wavelength outside 250 to 2500 nm.
    """
    if single_nm is None:
        return spectra.band_nodes_nm(400.0, 700.0, _BANDS)
    _check_number("wavelength_nm", single_nm, 250, 2500)
    return np.array([float(single_nm)])


def _check_number(name: str, value: Any, lowest: float, highest: float) -> None:
    """Raise InputError if the value is not a number, or is outside the range."""
    if not isinstance(value, Real):
        raise InputError(f"{name} = {shown(value)}: must be from {lowest:g} to {highest:g}, and a number")
    if not lowest <= float(value) <= highest:
        raise InputError(f"{name} = {float(value):g}: must be from {lowest:g} to {highest:g}")


def layers(request: FlareRequest) -> dict[str, F32]:
    """Return the irradiance of each kind of straylight, divided by the Sun's irradiance at the lens's entrance.

    Returns
    -------
    dict
        float32[band, y, x] each: `sun`, `ghosts`, `starburst`, `glare`, `veil`. `sun` is the direct image of the
        Sun: the light that the lens transmits, minus the light that starburst, glare and veil scatter
        (`lens.straylight`). For the model `texture`: `sun`, with nothing subtracted, and `texture`,
        float32[3, y, x] in units of white.
    """
    sun = _direct_image(request)
    if request.model == "texture":
        return {"sun": sun, "texture": _textures(request)}
    light = SunInLens(
        lens=request.lens,
        bands=request.bands,
        sensor=SensorGrid(shape=(request.pixels, request.pixels), pitch_mm=request.pitch_mm),
        sun=request.sun,
        settings=StraylightSettings(
            ghosts=GhostSettings(model=request.model, reflections=request.reflections),
            cleanliness=Cleanliness(roughness_nm=request.roughness_nm, level=request.cleanliness_level),
            veil_fraction=request.veil_fraction,
        ),
    ).straylight()
    sun *= light.direct_fraction[:, None, None].astype(np.float32)
    return {"sun": sun, **light.parts()}


def ghosts(request: FlareRequest, progress: Callable[[int], None] | None = None) -> tuple[Ghost, ...]:
    """Return every ghost of a point-like Sun; over several bands, means weighted by the Sun's spectrum.

    `progress` is called with 1 after each wavelength.
    """
    nm = request.wavelength_nm
    return traced_ghosts(
        request.lens,
        request.sun_deg,
        azimuth_deg=request.azimuth_deg,
        bands=Bands.sunlight(float(nm[0]), float(nm[-1])),
        model=request.model,
        reflections=request.reflections,
        across=None if len(nm) == 1 else _ACROSS_SPECTRUM,
        progress=progress,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Flare:
    """Hold what the Sun does in a lens.

    Attributes
    ----------
    layers
        Irradiance on the sensor over the Sun's at the entrance, float32[band, y, x] each; see `layers`.
    ghosts
        Flux, centroid and size of every ghost; empty for the model `texture`.
    """

    request: FlareRequest
    layers: dict[str, F32]
    ghosts: tuple[Ghost, ...] = ()

    @property
    def white(self) -> float:
        """Return the irradiance that `picture` shows as white, over the Sun's at the entrance.

        It is `request.white`, or else a high percentile of ghosts, glare and veil. The model `texture` counts in
        units of the camera's white, and has 1.
        """
        if self.request.white is not None:
            return self.request.white
        if "texture" in self.layers:
            return 1.0
        scattered = self.layers["ghosts"] + self.layers["glare"] + self.layers["veil"]
        brightness = colours(self.request, scattered).max(axis=2)
        return max(float(np.percentile(brightness, _SHOWN_PERCENTILE)), 1e-12)


def compute(request: FlareRequest, progress: Callable[[int], None] | None = None) -> Flare:
    """Return layers and ghosts of a request; `progress` is called with 1 after each of `request.steps` steps."""
    all_ghosts = () if request.model == "texture" else ghosts(request, progress)
    flare = Flare(request=request, layers=layers(request), ghosts=all_ghosts)
    if progress is not None:
        progress(1)
    return flare


def trace_flare(
    lens: Prescription | str | Path, sun_deg: float, *, wavelength_nm: float | None = None, **settings: Any
) -> Flare:
    """Return the ghosts, starburst, glare and veil of the Sun in a lens.

    Parameters
    ----------
    lens
        A prescription, the path of a lens file, or the name of a packaged lens.
    sun_deg
        Angle of the Sun from the axis, degrees, from 0 to below 90.
    wavelength_nm
        A single wavelength from 250 to 2500; by default the nodes of eight bands from 400 to 700 nm.
    **settings
        Further fields of `FlareRequest`: `azimuth_deg`, `fov_deg`, `pixels`, `sun_distance_au`, `model`,
        `reflections`, `roughness_nm`, `cleanliness_level`, `veil_fraction`, `white`.

    Raises
    ------
    InputError
        If the lens cannot be read or a value is out of its range.
    """
    prescription = lens if isinstance(lens, Prescription) else load_lens(lens)
    request = FlareRequest(
        lens=prescription, sun_deg=sun_deg, wavelength_nm=wavelengths_nm(wavelength_nm), **settings
    )
    return compute(request)


def _direct_image(request: FlareRequest) -> F32:
    """Return the Sun's direct image as a uniform disc of at least one pixel's area, float32[band, y, x].

    Its power divided by the Sun's irradiance is T(λ) A cos θ. T is the transmittance of the image path, A the area
    of the paraxial entrance pupil. The fluxes of the ghosts refer to the same A cos θ.
    """
    optics = paraxial_properties(request.lens)
    radius_px = max(
        optics.efl_mm * spectra.sun_angular_radius_rad(request.sun_distance_au) / request.pitch_mm,
        np.sqrt(1 / np.pi),
    )
    x, y = (v / request.pitch_mm + request.pixels / 2 for v in request.sun_xy_mm)
    # the whole disc is drawn first, so that its sum is right if the image border cuts it
    reach = int(np.ceil(radius_px)) + 1
    columns, rows = (int(np.floor(v)) + np.arange(-reach, reach + 1) for v in (x, y))
    cover = np.clip(radius_px - np.hypot(columns[None, :] + 0.5 - x, rows[:, None] + 0.5 - y) + 0.5, 0, 1)
    cover /= cover.sum() * request.pitch_mm**2
    inside = [(v >= 0) & (v < request.pixels) for v in (rows, columns)]
    out = np.zeros((len(request.wavelength_nm), request.pixels, request.pixels), dtype=np.float32)
    bands = request.bands
    passed = bands.mean(axial_transmittance(request.lens, bands.wavelength_nm))
    power = passed * np.cos(np.radians(request.sun_deg))
    power *= np.pi / 4 * optics.entrance_pupil_diameter_mm**2
    within = cover[np.ix_(*inside)]
    out[:, rows[inside[0]][:, None], columns[inside[1]]] = power[:, None, None] * within
    return out


def _textures(request: FlareRequest) -> F32:
    """Draw the texture model once, with the Sun at the same position; R, G, B in units of white."""
    focal_px = paraxial_properties(request.lens).efl_mm / request.pitch_mm
    detector = ThreeColourDetector(width_px=request.pixels, height_px=request.pixels)
    lens = ThinLens(focal_length_mm=focal_px * detector.pixel_pitch_um * 1e-3, f_number=4.0)
    x, y = (v / request.pitch_mm + request.pixels / 2 for v in request.sun_xy_mm)
    context = FaultContext(
        camera=Camera(lens=lens, detector=detector), sun_xy_px=np.array([x, y]), sun_visible_fraction=1.0
    )
    fault = registry()["straylight"]["texture"]()
    params = fault.draw(context, keyed_random.rng(0, 0, "flare", "texture"))
    black = np.zeros((request.pixels, request.pixels, 3), dtype=np.float32)
    drawn = fault.apply(Electrons(array=black, white_e=detector.white_e), params, context)
    return np.ascontiguousarray(np.moveaxis(drawn.array / detector.white_e, -1, 0))


def colours(request: FlareRequest, irradiance: F32) -> F32:
    """Return linear R, G, B of an irradiance float32[band, y, x] for the default detector, float32[y, x, 3].

    The scale is such that an irradiance of 1 in every band gives 1. A single wavelength gives grey.
    """
    if len(request.wavelength_nm) == 1:
        return np.repeat(irradiance[0][..., None], 3, axis=2)
    detector = ThreeColourDetector()
    sun = spectra.solar_band_irradiance_W_m2_nm(request.wavelength_nm, 1.0)
    weight = detector.electron_rate_weights(request.wavelength_nm) * sun
    weight = weight / weight.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("cb,byx->yxc", weight, irradiance), dtype=np.float32)


def picture(flare: Flare) -> NDArray[np.uint8]:
    """Return the sum of the layers as an sRGB image, uint8[y, x, 3], with `flare.white` as white."""
    linear = np.clip(_sum_of_layers(flare) / np.float32(flare.white), 0, 1)
    if "texture" in flare.layers:
        linear[colours(flare.request, flare.layers["sun"]) > 0] = 1
    return srgb8(linear)


def _sum_of_layers(flare: Flare) -> F32:
    """Return the sum of the layers as linear R, G, B, float32[y, x, 3]; the texture alone for its model."""
    if "texture" in flare.layers:
        return np.moveaxis(flare.layers["texture"], 0, -1)
    return colours(flare.request, sum(flare.layers.values(), np.zeros_like(flare.layers["sun"])))


def write_picture(flare: Flare, path: Path) -> None:
    """Write the layers as `.png`, or as `.exr` with linear R, G, B and `<layer>.<wavelength>nm` of every band."""
    if path.suffix.lower() == ".png":
        write_png(path, picture(flare))
        return
    channels: dict[str, Any] = {}
    for name, layer in flare.layers.items():
        labels = "RGB" if name == "texture" else [f"{nm:.1f}nm" for nm in flare.request.wavelength_nm]
        channels |= {f"{name}.{label}": band for label, band in zip(labels, layer, strict=True)}
    rgb = _sum_of_layers(flare)
    channels |= {c: np.ascontiguousarray(rgb[..., k]) for k, c in enumerate("RGB")}
    write_exr(path, channels)


def table(flare: Flare) -> dict[str, Any]:
    """Return the ghosts, the lens and the Sun's direction as plain data."""
    request = flare.request
    optics = paraxial_properties(request.lens)
    return {
        "lens": request.lens.name,
        "model": request.model,
        "sun_deg": request.sun_deg,
        "azimuth_deg": request.azimuth_deg,
        "wavelength_nm": [float(nm) for nm in request.wavelength_nm],
        "efl_mm": optics.efl_mm,
        "entrance_pupil_diameter_mm": optics.entrance_pupil_diameter_mm,
        "sun_xy_mm": list(request.sun_xy_mm),
        "total_flux_fraction": float(sum(ghost.flux_fraction for ghost in flare.ghosts)),
        "ghosts": [asdict(ghost) for ghost in flare.ghosts],
    }


def write_table(flare: Flare, path: Path) -> None:
    """Write `table` as JSON, null where a value is undefined, such as the centroid of a ghost without light."""
    write_json(path, table(flare))
