"""Characterise a camera from its raw images as EMVA 1288 (release 4.0, linear model) defines.

Pairs of flat and dark images at several exposures give the system gain K, quantum efficiency, temporal dark noise,
dark current, saturation and linearity. Stacks of images give DSNU, PRNU and the spectra of the spatial variation.
The analysis does not depend on how the images are made: a `MeasuredCamera` takes them. `VirtualCamera` takes them
with a device of a simulated sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..detector.chain import Device, MosaicNoise, by_channel, channel_sites

F64 = NDArray[np.float64]
Site = tuple[slice, slice]

_QUANTISATION_DN2 = 1 / 12  # variance of rounding, EMVA 1288 eq. 11
_LINEAR_RANGE = 0.7  # fraction of saturation up to which gain and response are fitted (section 6.6)
_LINEARITY_RANGE = 0.05, 0.95  # fractions of saturation that bound the test of linearity (section 6.7)


class MeasuredCamera(Protocol):
    """Take raw images of evenly lit pixels, for a characterisation."""

    def take(self, photons: float, exposure_s: float, number: int) -> NDArray[np.uint16]:
        """Return a raw image uint16[y, x] for a mean of `photons` per pixel.

        `number` counts the images, each of which has its own noise.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Set the extent of the measurement: `points` levels of flats, `stack` images for the spatial variation."""

    points: int = 40
    stack: int = 24
    exposure_s: float = 0.01
    dark_exposures_s: tuple[float, ...] = (0.01, 0.5, 1.0, 2.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class PhotonTransfer:
    """Hold the photon transfer: means and temporal variances of flats, and of darks at the same exposure."""

    photons: F64
    mean_dn: F64
    variance_dn2: F64
    dark_mean_dn: float
    dark_variance_dn2: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectrum:
    """Hold spectra along rows and columns of the mean flat at half saturation and of the mean dark.

    The spectra are the root of the mean power, in DN rms per frequency. Frequencies are in cycles per pixel of the
    channel.
    """

    frequency: dict[str, F64]
    flat_dn: dict[str, F64]
    dark_dn: dict[str, F64]


@dataclass(frozen=True, kw_only=True)
class Result:
    """Hold the camera's parameters as EMVA 1288 defines them, in electrons (e), digital numbers (DN) and seconds.

    `saturation_e` is the signal at the largest variance, `full_well_e` the largest signal.
    """

    gain_dn_per_e: float
    quantum_efficiency: float
    dark_noise_e: float
    dark_noise_dn: float
    saturation_e: float
    full_well_e: float
    saturation_photons: float
    snr_max: float
    dynamic_range: float
    linearity_error_percent: float
    dark_current_mean_e_s: float
    dark_current_variance_e_s: float
    dsnu_e: float
    prnu_percent: float
    black_level_dn: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Characterisation:
    """Hold the result of one colour channel and the data behind the result."""

    channel: str
    result: Result
    transfer: PhotonTransfer
    dark_mean_dn: F64
    dark_variance_dn2: F64
    dark_exposure_s: F64
    spectrum: Spectrum
    dsnu_map_dn: F64
    prnu_map: F64

    def to_dict(self) -> dict[str, Any]:
        """Return the result and the photon transfer as plain data."""
        transfer = {k: np.asarray(v).tolist() for k, v in vars(self.transfer).items()}
        return {"channel": self.channel, **asdict(self.result), "photon_transfer": transfer}


def characterise(
    camera: MeasuredCamera,
    *,
    sites: Mapping[str, Site],
    photons_at_saturation: float,
    settings: Settings | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, Characterisation]:
    """Characterise the channels of a camera.

    Parameters
    ----------
    camera
        The camera that takes the images.
    sites
        Slices of rows and columns that select the regular grid of each channel's pixels.
    photons_at_saturation
        About the number of photons per pixel at which the first channel saturates; flats go to 1.25 times as many.
    settings
        Extent of the measurement; default: `Settings()`.
    progress
        Function that is called with 1 after each image.

    Returns
    -------
    characterisations
        One for each channel of `sites`.

    Raises
    ------
    InputError
        `settings` has fewer than 8 points, 2 images in a stack or 2 dark exposures, or a channel saturates within
        the first three levels, or its signal or variance does not rise with the light.
    """
    use = Settings() if settings is None else settings
    if use.points < 8 or use.stack < 2 or len(use.dark_exposures_s) < 2:
        raise InputError(
            f"points = {use.points}, stack = {use.stack}, {len(use.dark_exposures_s)} dark exposures: must be at "
            "least 8, 2 and 2"
        )
    number = 0

    def take(photons: float, exposure_s: float) -> F64:
        nonlocal number
        picture = camera.take(photons, exposure_s, number).astype(np.float64)
        number += 1
        if progress is not None:
            progress(1)
        return picture

    photons = np.linspace(0, 1.25 * photons_at_saturation, use.points + 1)[1:]
    flats = [_pair(take, p, use.exposure_s, sites) for p in photons]
    darks = [_pair(take, 0.0, t, sites) for t in (use.exposure_s, *use.dark_exposures_s)]
    half = _half_saturation(photons, flats, next(iter(sites)))
    stacks = {"flat": _stack(take, half, use), "dark": _stack(take, 0.0, use)}
    return {name: _characterisation(name, site, photons, flats, darks, stacks, use) for name, site in sites.items()}


def pictures(settings: Settings) -> int:
    """Return how many images `characterise` takes."""
    return 2 * (settings.points + 1 + len(settings.dark_exposures_s)) + 2 * settings.stack


Pair = dict[str, tuple[float, float]]
Take = Callable[[float, float], F64]


def _pair(take: Take, photons: float, exposure_s: float, sites: Mapping[str, Site]) -> Pair:
    """Return mean and temporal variance of each channel from two images (eq. 12-14).

    The spatial variation cancels in the difference of the two images.
    """
    first, second = take(photons, exposure_s), take(photons, exposure_s)
    out = {}
    for name, site in sites.items():
        a, b = first[site], second[site]
        step = a.mean() - b.mean()
        out[name] = (float((a.mean() + b.mean()) / 2), float(np.mean((a - b) ** 2) / 2 - step**2 / 2))
    return out


def _half_saturation(photons: F64, flats: list[Pair], channel: str) -> float:
    """Return half the number of photons at which the variance of a channel is largest."""
    variance = np.array([pair[channel][1] for pair in flats])
    return float(photons[int(np.argmax(variance))] / 2)


def _stack(take: Take, photons: float, use: Settings) -> tuple[F64, F64]:
    """Return the mean image of a stack, and the temporal variance of each pixel."""
    total = square = np.zeros(())
    for _ in range(use.stack):
        picture = take(photons, use.exposure_s)
        total, square = total + picture, square + picture * picture
    mean = total / use.stack
    return mean, np.maximum(square / use.stack - mean * mean, 0) * use.stack / (use.stack - 1)


def _result(
    channel: str,
    transfer: PhotonTransfer,
    light_dn: float,
    dark_slopes: Sequence[float],
    spatial_dn2: Sequence[float],
) -> Result:
    """Return the parameters of one channel. Raises InputError if no line fits its signal and its variance.

    Parameters
    ----------
    light_dn
        Mean signal of the light in the flat image of the stack.
    dark_slopes
        How mean and variance of darks grow with the exposure, in DN/s and DN²/s.
    spatial_dn2
        Spatial variances of the flat and of the dark image of the stacks, without those of the temporal noise.
    """
    photons, signal = transfer.photons, transfer.mean_dn - transfer.dark_mean_dn
    dark_variance = transfer.dark_variance_dn2
    # saturation: where the variance is largest (section 6.6)
    last = int(np.argmax(transfer.variance_dn2))
    if last < 3:
        raise InputError(
            f"channel {channel}: it saturates within the first three exposures, so that no line can be fitted"
        )
    before = np.arange(len(signal)) <= last
    linear = before & (signal <= _LINEAR_RANGE * signal[last])
    low, high = (fraction * signal[last] for fraction in _LINEARITY_RANGE)
    tested = before & (signal >= low) & (signal <= high)
    if min(linear.sum(), tested.sum()) < 2 or min(signal[last], light_dn) <= 0:
        raise InputError(
            f"channel {channel}: its signal does not rise with the light up to {signal[last]:.4g} DN, "
            "where its variance is largest, so that no line can be fitted"
        )
    gain, response = _slopes(photons[linear], signal[linear], (transfer.variance_dn2 - dark_variance)[linear])
    if min(gain, response) <= 0:
        raise InputError(f"channel {channel}: its variance does not rise with its signal, so that it has no gain")
    efficiency = response / gain
    dark_noise_e = float(np.sqrt(max(dark_variance - _QUANTISATION_DN2, 0.0)) / gain)
    saturation_photons = float(photons[last])
    saturation_e = efficiency * saturation_photons
    least = (np.sqrt(dark_noise_e**2 + _QUANTISATION_DN2 / gain**2 + 0.25) + 0.5) / efficiency
    flat_spatial, dark_spatial = spatial_dn2
    prnu_dn = np.sqrt(max(flat_spatial - dark_spatial, 0.0))
    return Result(
        gain_dn_per_e=gain,
        quantum_efficiency=efficiency,
        dark_noise_e=dark_noise_e,
        dark_noise_dn=float(np.sqrt(max(dark_variance, 0.24))),  # below this, rounding hides the noise (eq. 56)
        saturation_e=saturation_e,
        full_well_e=float(signal.max() / gain),
        saturation_photons=saturation_photons,
        snr_max=float(np.sqrt(saturation_e)),
        dynamic_range=float(saturation_photons / least),
        linearity_error_percent=_linearity(photons[tested], signal[tested]),
        dark_current_mean_e_s=float(dark_slopes[0] / gain),
        dark_current_variance_e_s=float(dark_slopes[1] / gain**2),
        dsnu_e=float(np.sqrt(dark_spatial) / gain),
        prnu_percent=float(100 * (prnu_dn / light_dn)),
        black_level_dn=transfer.dark_mean_dn,
    )


def _characterisation(
    name: str,
    site: Site,
    photons: F64,
    flats: list[Pair],
    darks: list[Pair],
    stacks: dict[str, tuple[F64, F64]],
    use: Settings,
) -> Characterisation:
    """Return what the pairs and stacks of images give for one channel. Raises InputError as `_result` does."""
    mean, variance = (np.array([pair[name][k] for pair in flats]) for k in (0, 1))
    dark_means, dark_variances = (np.array([pair[name][k] for pair in darks]) for k in (0, 1))
    transfer = PhotonTransfer(
        photons=photons,
        mean_dn=mean,
        variance_dn2=variance,
        dark_mean_dn=float(dark_means[0]),
        dark_variance_dn2=float(dark_variances[0]),
    )
    (flat, flat_var), (dark, dark_var) = ((v[site] for v in stacks[kind]) for kind in ("flat", "dark"))
    spatial_dn2 = [
        max(float(v.var(ddof=1) - in_time.mean() / use.stack), 0.0)
        for v, in_time in ((flat, flat_var), (dark, dark_var))
    ]
    exposure_s = np.array([use.exposure_s, *use.dark_exposures_s])
    slopes = [np.polyfit(exposure_s, of_darks, 1)[0] for of_darks in (dark_means, dark_variances)]
    light_dn = float(flat.mean() - dark.mean())
    return Characterisation(
        channel=name,
        result=_result(name, transfer, light_dn, slopes, spatial_dn2),  # refuses what the maps could not divide by
        transfer=transfer,
        dark_mean_dn=dark_means,
        dark_variance_dn2=dark_variances,
        dark_exposure_s=exposure_s,
        spectrum=_spectrum(flat, dark),
        dsnu_map_dn=dark - dark.mean(),
        prnu_map=(flat - dark) / light_dn - 1,
    )


def _slopes(photons: F64, signal: F64, noise: F64) -> tuple[float, float]:
    """Return the slopes through the origin of the variance over the signal and of the signal over the photons."""
    return float(signal @ noise / (signal @ signal)), float(photons @ signal / (photons @ photons))


def _linearity(photons: F64, signal: F64) -> float:
    """Return the mean relative deviation from the line with the best relative fit, in % (section 6.7)."""
    slope, offset = np.polyfit(photons, signal, 1, w=1 / signal)
    return float(100 * np.mean(np.abs(signal - (offset + slope * photons)) / (offset + slope * photons)))


def _spectrum(flat: F64, dark: F64) -> Spectrum:
    """Return the spectra of the mean images under light and in the dark."""
    frequency = {
        k: np.asarray(np.fft.rfftfreq(flat.shape[axis]), dtype=np.float64)
        for k, axis in (("rows", 1), ("columns", 0))
    }
    return Spectrum(frequency=frequency, flat_dn=_spectra(flat), dark_dn=_spectra(dark))


def _spectra(image: F64) -> dict[str, F64]:
    """Return the root of the mean power spectrum over the rows, and over the columns (section 8.6)."""
    flat = image - image.mean()
    out = {}
    for name, along in (("rows", flat), ("columns", flat.T)):
        power = np.abs(np.fft.rfft(along, axis=1)) ** 2 / along.shape[1]
        out[name] = np.sqrt(power.mean(axis=0))
    return out


# --- a sensor's device -------------------------------------------------------------------------------------------


class VirtualCamera:
    """Take raw images with a device under even light.

    The light has one wavelength. With None, each channel gets the same number of photons at the wavelength to which
    it responds most. Raises InputError where no channel responds to the light.
    """

    def __init__(self, device: Device, wavelength_nm: float | None = None, seed: int = 0) -> None:
        self.device, self.seed = device, seed
        sensor = device.sensor
        nodes = np.arange(300.0, 1100.0) if wavelength_nm is None else np.array([wavelength_nm])
        peaks = sensor.efficiency.at(nodes).max(axis=1)
        self.efficiency = {name: float(v) for name, v in zip(sensor.pattern.channels, peaks, strict=True)}
        self.sites = {name: site for name, site in channel_sites(sensor).items() if self.efficiency[name] > 0}
        if not self.sites:
            raise InputError(f"wavelength_nm = {wavelength_nm}: no channel of {sensor.name} responds to it")

    @property
    def photons_at_saturation(self) -> float:
        """Return the photons per pixel that saturate the channel with the highest quantum efficiency."""
        return self.device.sensor.readout.white_e / max(self.efficiency.values())

    def take(self, photons: float, exposure_s: float, number: int) -> NDArray[np.uint16]:
        """Return a raw image, as `MeasuredCamera` defines."""
        shape = self.device.shape
        light = by_channel(self.device.sensor, shape, [photons * eta for eta in self.efficiency.values()])
        shot, read, row = (np.random.default_rng([self.seed, number, k]) for k in range(3))
        return self.device.raw(light, exposure_s, MosaicNoise.draw(shape, shot, read, row))
