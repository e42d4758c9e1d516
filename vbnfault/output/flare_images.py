"""Compute the straylight of a lens alone, as an image on black and as a table of every ghost: `vbnfault flare`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import spectra
from ..core.errors import InputError
from ..core.quantities import Electrons
from ..detector import ThreeColourDetector
from ..faults import FaultContext, registry
from ..lens import Prescription, ThinLens, first_order, load_lens
from ..lens.straylight.paraxial import Ghost, axial_transmittance, mean_ghost, paraxial_ghosts
from ..lens.straylight.total import VEIL_FRACTION, Cleanliness, straylight
from ..scene import keyed_random
from .exr import write_exr

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

MODELS = ("traced", "paraxial", "texture")
# field of a request, least and greatest value
_RANGES = (
    ("sun_deg", 0, 90),
    ("azimuth_deg", -360, 360),
    ("fov_deg", 0.1, 140),
    ("pixels", 16, 4096),
    ("sun_distance_au", 0.01, 1000),
    ("roughness_nm", 0, 50),
    ("cleanliness_level", 0, 1000),
    ("veil_fraction", 0, 0.5),
)
_BANDS = 8
_ACROSS_SPECTRUM = 192
_SHOWN_PERCENTILE = 99.7


@dataclass(frozen=True, kw_only=True, eq=False)
class FlareRequest:
    """A lens, the direction of the Sun, and an image whose centre lies on the optical axis.

    Attributes
    ----------
    sun_deg, azimuth_deg
        Angle of the Sun from the axis; its direction in the image: 0 to the right, 90 down.
    fov_deg
        Field of view across the width of the image.
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

    def __post_init__(self) -> None:
        for name, lowest, highest in _RANGES:
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise InputError(f"{name} = {value}: must be from {lowest:g} to {highest:g}")
        if self.sun_deg == 90:
            raise InputError("sun_deg = 90: must be from 0 to below 90")
        if self.model not in MODELS:
            raise InputError(f"model = {self.model!r}: must be one of {', '.join(MODELS)}")
        if self.reflections not in (2, 4):
            raise InputError(f"reflections = {self.reflections}: must be 2 or 4")

    @property
    def pitch_mm(self) -> float:
        """Pixel pitch of the image on the sensor plane, in mm."""
        return 2 * first_order(self.lens).efl_mm * float(np.tan(np.radians(self.fov_deg / 2))) / self.pixels

    @property
    def sun_xy_mm(self) -> tuple[float, float]:
        """Position of the Sun's direct image on the sensor plane, f tan θ from the axis, in mm."""
        radius, turn = (
            first_order(self.lens).efl_mm * np.tan(np.radians(self.sun_deg)),
            np.radians(self.azimuth_deg),
        )
        return float(radius * np.cos(turn)), float(radius * np.sin(turn))


def wavelengths_nm(one: float | None = None) -> F64:
    """Return the wavelength `one`, or the nodes of the cameras' default bands; float64[band].

    Raises InputError for a wavelength outside 250 to 2500 nm.
    """
    if one is None:
        return spectra.band_nodes_nm(400.0, 700.0, _BANDS)
    if not 250 <= one <= 2500:
        raise InputError(f"--wavelength-nm {one:g}: must be from 250 to 2500")
    return np.array([float(one)])


def layers(view: FlareRequest) -> dict[str, F32]:
    """Return the irradiance of each kind of straylight, divided by the Sun's irradiance at the lens's entrance.

    Returns
    -------
    dict
        float32[band, y, x] each: `sun`, `ghosts`, `starburst`, `glare`, `veil`. `sun` is the direct image of the
        Sun: the light that the lens transmits, minus the light that starburst, glare and veil scatter
        (`lens.straylight`). For the model `texture`: `sun`, with nothing subtracted, and `texture`,
        float32[3, y, x] in units of white.
    """
    sun = _direct_image(view)
    if view.model == "texture":
        return {"sun": sun, "texture": _textures(view)}
    found = straylight(
        view.lens,
        model=view.model,
        wavelength_nm=view.wavelength_nm,
        shape=(view.pixels, view.pixels),
        pitch_mm=view.pitch_mm,
        sun_deg=view.sun_deg,
        azimuth_deg=view.azimuth_deg,
        sun_radius_rad=spectra.sun_angular_radius_rad(view.sun_distance_au),
        cleanliness=Cleanliness(roughness_nm=view.roughness_nm, level=view.cleanliness_level),
        reflections=view.reflections,
        veil_fraction=view.veil_fraction,
    )
    sun *= found.direct_fraction[:, None, None].astype(np.float32)
    return {
        "sun": sun,
        "ghosts": found.ghosts,
        "starburst": found.starburst,
        "glare": found.glare,
        "veil": found.veil,
    }


def ghosts(view: FlareRequest, progress: Callable[[int], None] | None = None) -> tuple[Ghost, ...]:
    """Return every ghost of a point-like Sun; over several bands, means weighted by the Sun's spectrum.

    `progress` is called with 1 after each wavelength.
    """
    weight = spectra.solar_band_irradiance_W_m2_nm(view.wavelength_nm, 1.0)
    weight = weight / weight.sum()
    found: dict[tuple[int, ...], list[tuple[float, Ghost]]] = {}
    for nm, share in zip(view.wavelength_nm, weight, strict=True):
        for ghost in _ghosts_at(view, float(nm), alone=len(weight) == 1):
            found.setdefault(ghost.pair, []).append((float(share), ghost))
        if progress is not None:
            progress(1)
    return tuple(mean_ghost(rows) for _, rows in sorted(found.items()))


@dataclass(frozen=True, kw_only=True, eq=False)
class Flare:
    """What the Sun does in a lens.

    `layers`: irradiance on the sensor over the Sun's at the entrance, float32[band, y, x] each, as `layers` returns
    them. `ghosts`: flux, centroid and size of every ghost; empty for the model `texture`.
    """

    request: FlareRequest
    layers: dict[str, F32]
    ghosts: tuple[Ghost, ...]


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
        `reflections`, `roughness_nm`, `cleanliness_level`, `veil_fraction`.

    Raises
    ------
    InputError
        If the lens cannot be read or a value is out of its range.
    """
    prescription = lens if isinstance(lens, Prescription) else load_lens(lens)
    request = FlareRequest(
        lens=prescription, sun_deg=sun_deg, wavelength_nm=wavelengths_nm(wavelength_nm), **settings
    )
    return Flare(
        request=request,
        layers=layers(request),
        ghosts=() if request.model == "texture" else ghosts(request),
    )


def _ghosts_at(view: FlareRequest, wavelength_nm: float, *, alone: bool) -> tuple[Ghost, ...]:
    """Return every ghost at one wavelength; `alone`: the only one, traced with the default number of rays."""
    from ..lens.straylight.ghosts import traced_ghosts

    if view.model == "paraxial":
        return paraxial_ghosts(view.lens, view.sun_deg, azimuth_deg=view.azimuth_deg, wavelength_nm=wavelength_nm)
    return traced_ghosts(
        view.lens,
        view.sun_deg,
        azimuth_deg=view.azimuth_deg,
        wavelength_nm=wavelength_nm,
        reflections=view.reflections,
        across=None if alone else _ACROSS_SPECTRUM,
    )


def _direct_image(view: FlareRequest) -> F32:
    """Return the Sun's direct image as a uniform disc of at least one pixel's area, float32[band, y, x].

    Its power divided by the Sun's irradiance is T(λ) A cos θ. T is the transmittance of the image path, A the area
    of the paraxial entrance pupil. The fluxes of the ghosts refer to the same A cos θ.
    """
    optics = first_order(view.lens)
    radius_px = max(
        optics.efl_mm * spectra.sun_angular_radius_rad(view.sun_distance_au) / view.pitch_mm, np.sqrt(1 / np.pi)
    )
    x, y = (v / view.pitch_mm + view.pixels / 2 for v in view.sun_xy_mm)
    # the whole disc is drawn first, so that its sum is right if the image border cuts it
    reach = int(np.ceil(radius_px)) + 1
    columns, rows = (int(np.floor(v)) + np.arange(-reach, reach + 1) for v in (x, y))
    cover = np.clip(radius_px - np.hypot(columns[None, :] + 0.5 - x, rows[:, None] + 0.5 - y) + 0.5, 0, 1)
    cover /= cover.sum() * view.pitch_mm**2
    inside = [(v >= 0) & (v < view.pixels) for v in (rows, columns)]
    out = np.zeros((len(view.wavelength_nm), view.pixels, view.pixels), dtype=np.float32)
    power = axial_transmittance(view.lens, view.wavelength_nm) * np.cos(np.radians(view.sun_deg))
    power *= np.pi / 4 * optics.entrance_pupil_diameter_mm**2
    within = cover[np.ix_(*inside)]
    out[:, rows[inside[0]][:, None], columns[inside[1]]] = power[:, None, None] * within
    return out


def _textures(view: FlareRequest) -> F32:
    """Draw the texture model once, with the Sun at the same position; R, G, B in units of white."""
    focal_px = first_order(view.lens).efl_mm / view.pitch_mm
    detector = ThreeColourDetector(width_px=view.pixels, height_px=view.pixels)
    lens = ThinLens(focal_length_mm=focal_px * detector.pixel_pitch_um * 1e-3, f_number=4.0)
    x, y = (v / view.pitch_mm + view.pixels / 2 for v in view.sun_xy_mm)
    context = FaultContext(
        camera=Camera(lens=lens, detector=detector), sun_xy_px=np.array([x, y]), sun_visible_fraction=1.0
    )
    fault = registry()["straylight"]["texture"]()
    params = fault.draw(context, keyed_random.rng(0, 0, "flare", "texture"))
    black = np.zeros((view.pixels, view.pixels, 3), dtype=np.float32)
    drawn = fault.apply(Electrons(array=black, white_e=detector.white_e), params, context)
    return np.ascontiguousarray(np.moveaxis(drawn.array / detector.white_e, -1, 0))


def colours(view: FlareRequest, irradiance: F32) -> F32:
    """Return linear R, G, B of an irradiance float32[band, y, x] for the default detector, float32[y, x, 3].

    The scale is such that an irradiance of 1 in every band gives 1. A single wavelength gives grey.
    """
    if len(view.wavelength_nm) == 1:
        return np.repeat(irradiance[0][..., None], 3, axis=2)
    detector = ThreeColourDetector()
    sun = spectra.solar_band_irradiance_W_m2_nm(view.wavelength_nm, 1.0)
    weight = detector.electron_rate_weights(view.wavelength_nm) * sun
    weight = weight / weight.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("cb,byx->yxc", weight, irradiance), dtype=np.float32)


def picture(view: FlareRequest, found: dict[str, F32], white: float | None = None) -> NDArray[np.uint8]:
    """Return the sum of the layers as an sRGB image, uint8[y, x, 3].

    `white`: the irradiance shown as white. By default it is a high percentile of ghosts, glare and veil; for the
    model `texture` it is 1.
    """
    if "texture" in found:
        linear = np.moveaxis(found["texture"], 0, -1) + 1e3 * (colours(view, found["sun"]) > 0)
        white = 1.0 if white is None else white
    else:
        linear = colours(view, sum(found.values(), np.zeros_like(found["sun"])))
        if white is None:
            ghosts_ = colours(view, found["ghosts"] + found["glare"] + found["veil"]).max(axis=2)
            white = max(float(np.percentile(ghosts_, _SHOWN_PERCENTILE)), 1e-30)
    level = np.clip(linear / np.float32(white), 0, 1)
    shown = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * shown), dtype=np.uint8)


def write_picture(view: FlareRequest, found: dict[str, F32], path: Path) -> None:
    """Write the layers as `.png`, or as `.exr` with linear R, G, B and `<layer>.<wavelength>nm` of every band."""
    if path.suffix.lower() == ".png":
        ok, data = cv2.imencode(".png", picture(view, found)[..., ::-1])
        assert ok
        path.write_bytes(data.tobytes())
        return
    channels: dict[str, Any] = {}
    for name, layer in found.items():
        labels = "RGB" if name == "texture" else [f"{nm:.1f}nm" for nm in view.wavelength_nm]
        channels |= {f"{name}.{label}": band for label, band in zip(labels, layer, strict=True)}
    if "texture" in found:
        rgb = np.moveaxis(found["texture"], 0, -1)
    else:
        rgb = colours(view, sum(found.values(), np.zeros_like(found["sun"])))
    channels |= {c: np.ascontiguousarray(rgb[..., k]) for k, c in enumerate("RGB")}
    write_exr(path, channels)


def table(view: FlareRequest, found: tuple[Ghost, ...]) -> dict[str, Any]:
    """Return the ghosts, the lens and the Sun's direction as plain data."""
    optics = first_order(view.lens)
    return {
        "lens": view.lens.name,
        "model": view.model,
        "sun_deg": view.sun_deg,
        "azimuth_deg": view.azimuth_deg,
        "wavelength_nm": [float(nm) for nm in view.wavelength_nm],
        "efl_mm": optics.efl_mm,
        "entrance_pupil_diameter_mm": optics.entrance_pupil_diameter_mm,
        "sun_xy_mm": list(view.sun_xy_mm),
        "total_flux_fraction": float(sum(ghost.flux_fraction for ghost in found)),
        "ghosts": [asdict(ghost) for ghost in found],
    }


def write_table(view: FlareRequest, found: tuple[Ghost, ...], path: Path) -> None:
    """Write `table` as JSON."""
    path.write_text(json.dumps(table(view, found), indent=2) + "\n", encoding="utf-8")
