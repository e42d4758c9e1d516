"""Starbursts against closed forms, the Fourier transform of the sampled pupil and direct averages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import j0, j1

from vbnfault.core import spectra
from vbnfault.core.spectra import Bands
from vbnfault.lens import Prescription, load_lens, paraxial_properties, parse_lens, scaled_to_focal_length
from vbnfault.lens.prescription import Surface
from vbnfault.lens.straylight.settings import SensorGrid
from vbnfault.lens.straylight.starburst import StarburstFrame, starburst

F64 = NDArray[np.float64]

NM = 550.0
DIAMETER_MM = 5.0


def lens_with(
    blades: int = 0, rounding: float = 0.0, rotation_deg: float = 0.0, efl_mm: float = 100.0
) -> Prescription:
    """A stop of 5 mm that is its own entrance pupil, before a lens."""
    stop = {"stop": True, "diameter_mm": DIAMETER_MM, "thickness_mm": 0.0}
    blade = {"blades": blades, "blade_rounding": rounding, "rotation_deg": rotation_deg}
    front = {"radius_mm": 100.0, "thickness_mm": 2.0, "nd": 1.5, "diameter_mm": 20.0}
    lens = parse_lens({"surface": [stop | blade, front, {"radius_mm": -100.0, "diameter_mm": 20.0}]}, source="t")
    scaled = scaled_to_focal_length(lens, efl_mm)
    rows = tuple(replace(s, semi_diameter_mm=DIAMETER_MM / 2) if s.stop else s for s in scaled.surfaces)
    return replace(scaled, surfaces=rows)


def frame_at(
    sun_xy_mm: Sequence[float] | F64,
    wavelength_nm: F64,
    shape: tuple[int, int],
    pitch_mm: float,
    *,
    half_width_nm: float | None = None,
) -> StarburstFrame:
    """Return a frame with the Sun's image at a position in mm from its middle."""
    return StarburstFrame(
        sun_xy_mm=(float(sun_xy_mm[0]), float(sun_xy_mm[1])),
        bands=bands_of(wavelength_nm, half_width_nm),
        sensor=SensorGrid(shape=shape, pitch_mm=pitch_mm),
    )


def bands_of(nodes_nm: F64, half_width_nm: float | None) -> Bands:
    """Lines for a width of 0, triangles of this half width, or those between the nodes, all in even light."""
    if half_width_nm == 0:
        return Bands.lines(*nodes_nm)
    if half_width_nm is None:
        nm = spectra.fine_nodes_nm(nodes_nm)
        return Bands.of(nm, spectra.hat_weights(nodes_nm, nm))
    nm = np.linspace(nodes_nm[0] - half_width_nm, nodes_nm[-1] + half_width_nm, 601)
    return Bands.of(nm, np.maximum(1 - np.abs(nm - nodes_nm[:, None]) / half_width_nm, 0))


def distance_and_angle(shape: tuple[int, int], pitch: float = 1.0) -> tuple[F64, F64]:
    """From the middle sample of the frame of odd size, the angle from +x towards +y (down)."""
    y, x = np.mgrid[: shape[0], : shape[1]] - (np.array(shape)[:, None, None] - 1) / 2
    return np.hypot(x, y) * pitch, np.arctan2(y, x)


def count_spikes(profile: F64) -> int:
    """Maxima of a profile round a circle that rise above a quarter of the highest."""
    above = profile > profile.max() / 4
    return int(np.sum(above & ~np.roll(above, 1)))


def fraunhofer_psf(
    stop: Surface, wavelength_nm: float, *, samples: int = 1024, across: int = 256
) -> tuple[F64, float]:
    """The point spread of the sampled stop behind a lens of 100 mm, its sum 1, and its pitch in mm.

    `across` samples span the pupil; each is the mean of 4 by 4 points.
    """
    fine = 4
    side = (np.arange(across * fine) + 0.5) * 2 / (across * fine) - 1
    x, y = side[None, :], side[:, None]
    open_ = (np.hypot(x, y) * stop.semi_diameter_mm <= stop.rim_mm(np.arctan2(y, x))).astype(np.float64)
    mask = np.zeros((samples, samples))
    mask[:across, :across] = open_.reshape(across, fine, across, fine).mean(axis=(1, 3))
    # the mean over each sample dims the far field, so divide by the transform of that mean
    turn = np.pi * np.fft.fftshift(np.fft.fftfreq(samples)) + 1e-12
    mean = np.sin(turn) / (fine * np.sin(turn / fine))
    power = np.abs(np.fft.fftshift(np.fft.fft2(mask)) / (mean * mean[:, None])) ** 2
    return power / power.sum(), wavelength_nm * 1e-6 * 100.0 * across / (samples * DIAMETER_MM)


# --- a point source ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blades", [5, 6, 7, 8, 9])
def test_even_blades_give_as_many_spikes_and_odd_ones_twice_as_many(blades: int) -> None:
    expected = blades * (1 + blades % 2)
    stop = lens_with(blades).surfaces[0]
    psf, _ = fraunhofer_psf(stop, NM, samples=512, across=128)
    angle = np.linspace(0, 2 * np.pi, 1440, endpoint=False)
    radius = np.arange(100.0, 180.0)[:, None]  # 25 to 45 fringes of the whole pupil, averaged
    rings = map_coordinates(psf, [256 + radius * np.sin(angle), 256 + radius * np.cos(angle)], order=1)
    assert count_spikes((rings * radius**2).mean(axis=0)) == expected
    frame = starburst(lens_with(blades), sun_radius_rad=1e-3, table=(224, 1024)).image(
        frame_at((0, 0), np.array([NM]), (401, 401), 0.02)
    )[0]
    circle = map_coordinates(frame, [200 + 180 * np.sin(angle), 200 + 180 * np.cos(angle)], order=1)
    assert count_spikes(circle) == expected


def test_the_pattern_grows_with_the_wavelength_and_turns_with_the_stop() -> None:
    stop = lens_with().surfaces[0]
    dark = []
    for nm in (450.0, 675.0):
        psf, pitch = fraunhofer_psf(stop, nm, samples=1024, across=64)
        dark.append((10 + int(np.argmin(psf[512, 522:540]))) * pitch)
    # 1.2197 λ f / D, found to half a sample of λ f / 16 D
    assert dark == pytest.approx([1.2197 * nm * 1e-6 * 100 / DIAMETER_MM for nm in (450.0, 675.0)], rel=0.03)
    assert dark[1] / dark[0] == pytest.approx(1.5, rel=1e-9)
    # three blades, the first corner at 17°: normals of edges at 77° and every 60° from there on
    turned = lens_with(3, rotation_deg=17.0)
    psf, _ = fraunhofer_psf(turned.surfaces[0], NM, samples=513, across=128)
    frame = starburst(turned, sun_radius_rad=1e-3, table=(224, 1024)).image(
        frame_at((0, 0), np.array([NM]), (513, 513), 0.02)
    )[0]
    for picture in (psf, frame):
        r, angle = distance_and_angle(picture.shape)
        ring = (r > 120) & (r < 200)
        bright = np.angle(np.sum((picture * r**2)[ring] * np.exp(6j * angle[ring]))) / 6
        assert math.degrees(bright) % 60 == pytest.approx(17.0, abs=0.5)


# --- the Sun's disc against the transform of the pupil ----------------------------------------------------------

ACROSS, SAMPLES = 256, 1024  # four samples to λ / D


def by_transform(lens: Prescription, sun_airy: float) -> tuple[F64, float]:
    """What `Starburst.image` gives, for a Sun in the middle with a radius in λ / D, from the pupil itself: its
    autocorrelation times 2 J₁(y) / y; the frame is float64[481, 481]."""
    stop = lens.surfaces[0]
    psf, pitch = fraunhofer_psf(stop, NM, samples=SAMPLES, across=ACROSS)
    side = np.fft.fftfreq(SAMPLES)
    y = 2 * np.pi * sun_airy * SAMPLES / ACROSS * np.hypot(side, side[:, None])
    coherence = np.where(y > 0, 2 * j1(y) / np.where(y > 0, y, 1), 1)
    spread = np.fft.fftshift(np.fft.ifft2(np.fft.fft2(np.fft.ifftshift(psf)) * coherence).real)
    angle = np.linspace(0, 2 * np.pi, 7200, endpoint=False)
    area = np.pi * np.mean(stop.rim_mm(angle) ** 2)
    return spread[272:753, 272:753] * area / pitch**2, pitch


def frame_of(lens: Prescription, sun_airy: float, pitch: float) -> F64:
    sun = sun_airy * NM * 1e-6 / DIAMETER_MM
    burst = starburst(lens, sun_radius_rad=sun, table=(224, 1024))  # 30 to σ / θ at the corners
    return burst.image(frame_at((0, 0), np.array([NM]), (481, 481), pitch, half_width_nm=0))[0].astype(np.float64)


@pytest.mark.parametrize(
    ("blades", "rounding", "sun", "loosest"),
    [(0, 0.0, 6.0, 0.02), (6, 0.0, 6.0, 0.2), (7, 0.5, 6.0, 0.03), (8, 0.15, 6.0, 0.2), (6, 0.9, 3.0, 0.04)],
)
def test_the_average_over_the_disc_agrees_with_the_transform_of_the_pupil(
    blades: int, rounding: float, sun: float, loosest: float
) -> None:
    """Left out are powers of coherence / edge, λ / (2π σ L) = 1/15 for a Sun of 6 λ / D and 8 blades, on the flanks
    of narrow spikes, 0.2 in the worst of 48 sectors; means, spikes and wide fans hold to the square of that,
    and the transform to 2 %: squares of its sampled rim show in the outermost ring."""
    lens = lens_with(blades, rounding, 10.0)
    expected, pitch = by_transform(lens, sun)
    found = frame_of(lens, sun, pitch)
    r, angle = distance_and_angle(found.shape, pitch * DIAMETER_MM / (NM * 1e-6 * 100.0))
    bins = 48 if blades else 8
    sector = np.mod(angle - math.radians(10.0), 2 * np.pi / max(blades, 1)) / (2 * np.pi / max(blades, 1)) * bins
    for low, high in ((7, 8), (10, 12), (16, 18), (28, 31), (38, 42)):
        ring = (r > low) & (r < high)
        assert found[ring].mean() == pytest.approx(expected[ring].mean(), rel=0.02)
        if low < 10:
            continue  # as few pixels as bins
        profiles = [np.bincount(sector[ring].astype(int), v[ring], bins) for v in (found, expected)]
        assert profiles[0].max() == pytest.approx(profiles[1].max(), rel=0.03)
        np.testing.assert_allclose(profiles[0], profiles[1], rtol=loosest)
        # the dark middle between two normals, whence only corners send light
        if blades == 6 and low > 12:
            assert profiles[0][:3].mean() == pytest.approx(profiles[1][:3].mean(), rel=0.06)


# --- closed forms -----------------------------------------------------------------------------------------------


def test_the_flux_beyond_a_radius_of_a_round_stop() -> None:
    """1 - J₀² - J₁² of the flux lies within v, so 2 / πv beyond it on average (Born & Wolf, 8.5.2)."""
    sun, pitch, f = 1e-3, 0.02, 100.0
    frame = starburst(lens_with(), sun_radius_rad=sun).image(
        frame_at((0, 0), np.array([NM]), (401, 401), pitch, half_width_nm=0)
    )
    r, _ = distance_and_angle(frame[0].shape, pitch / f)
    v = math.pi * DIAMETER_MM / (NM * 1e-6) * np.array([0.01, 0.04])
    swing = v[:, None] + np.linspace(-np.pi, np.pi, 64, endpoint=False)
    beyond = np.mean(j0(swing) ** 2 + j1(swing) ** 2, axis=1)
    flux = frame[0][(r > 0.01) & (r < 0.04)].sum() * pitch**2 / (math.pi / 4 * DIAMETER_MM**2)
    # the disc moves (σ / r)² / 4 of it across, the pixels on the circle 1 / 200 of their own share at random
    assert flux == pytest.approx(beyond[0] - beyond[1], rel=0.01)


def test_the_strength_of_a_spike_and_of_a_fan() -> None:
    """∫ |A|² dk_t = 2πL / k² across a straight edge's spike; 2πρ / k³ from each point of a bent one that sends."""
    sun, pitch, f, row = 1e-3, 0.01, 100.0, 200
    k0 = 2e6 * math.pi / NM
    spiky = starburst(lens_with(6, rotation_deg=30.0), sun_radius_rad=sun, table=(224, 2048))
    frame = spiky.image(frame_at((-4.0, 0), np.array([NM]), (401, 401), pitch, half_width_nm=0))[0]
    theta = (np.arange(401) - 200) * pitch / f + 4.0 / f
    strength = frame[row - 25 : row + 26].sum(axis=0) * pitch * k0 / f * (NM * 1e-6 * f) ** 2
    edge = DIAMETER_MM / 2
    # the sum misses the wings beyond 2.5 σ, 2 / (π L · 2.5 σ k₀) of it, and the disc adds (σ / θ)²
    lost = 2 / (math.pi * edge * 2.5 * sun * k0)
    np.testing.assert_allclose(strength, (1 - lost) * 2 * 2 * math.pi * edge / (k0 * theta) ** 2, rtol=0.01)

    half = math.pi / 6
    apothem = DIAMETER_MM / 2 * (0.5 * math.cos(half) + 0.5)
    bend = apothem**2 / (0.5 * DIAMETER_MM / 2)  # of r = R (½ cos h / cos β + ½) at β = 0
    fan = starburst(lens_with(6, 0.5, 30.0), sun_radius_rad=sun, table=(224, 1024))
    frame = fan.image(frame_at((-4.0, 0), np.array([NM]), (401, 401), pitch, half_width_nm=0))[0]
    expected = 2 * 2 * math.pi * bend / (k0 * theta) ** 3 / (NM * 1e-6 * f) ** 2
    # the mean of 1/θ³ over the disc, and the curvature that falls towards the corners: some (σ / θ)² = 1/400 each
    np.testing.assert_allclose(frame[row], expected, rtol=0.02)


def test_wide_angles_and_a_pupil_that_is_not_the_stop() -> None:
    """E = cos θ_sun cos⁴θ / f² · 4πa / (k₀³ |Δu|³ λ²) from a round stop, u the direction cosines."""
    lens = scaled_to_focal_length(load_lens("nikkor_35_f2p8"), 8.0)
    f, radius = 8.0, paraxial_properties(lens).entrance_pupil_diameter_mm / 2
    assert radius != pytest.approx(lens.surfaces[lens.stop].semi_diameter_mm, rel=0.02)
    sun = np.array([-6.0, 2.0])
    frame = starburst(lens, sun_radius_rad=2e-3).image(
        frame_at(sun, np.array([NM]), (241, 321), 0.03, half_width_nm=0)
    )[0]
    y, x = np.mgrid[:241, :321]
    place = np.stack([(x - 160) * 0.03, (y - 120) * 0.03], axis=-1)
    cosine = f / np.sqrt(f**2 + np.sum(place**2, axis=-1))
    sun_cosine = f / math.sqrt(f**2 + sun @ sun)
    apart = np.linalg.norm(place / f * cosine[..., None] - sun / f * sun_cosine, axis=-1)
    far = apart > 0.04
    power = 4 * math.pi * radius / (2e6 * math.pi / NM * apart) ** 3
    expected = sun_cosine * cosine**4 / f**2 * power / (NM * 1e-6) ** 2
    assert 0.9 < far.mean() <= 1
    # (σ / Δu)² and the table's interpolation
    np.testing.assert_allclose(frame[far], expected[far], rtol=0.01)


def test_a_pattern_scales_with_the_wavelength_when_the_disc_does() -> None:
    """|A|² depends on r / λ alone: with σ and the pixels in proportion to λ the frame falls by λ²."""
    frames = []
    for nm in (450.0, 675.0):
        burst = starburst(lens_with(7, 0.2, 5.0), sun_radius_rad=1e-3 * nm / 450)
        pitch = 0.02 * nm / 450
        frames.append(
            burst.image(frame_at((15 * pitch, 10 * pitch), np.array([nm]), (201, 201), pitch, half_width_nm=0))[0]
            * nm**2
        )
    # rows of the two tables lie elsewhere, 3 % apart
    lit = frames[0] > 0
    assert np.quantile(np.abs(frames[1][lit] / frames[0][lit] - 1), 0.99) < 0.03
    assert frames[1].sum() == pytest.approx(frames[0].sum(), rel=2e-3)


def test_a_spike_is_as_wide_as_the_sun_at_every_wavelength() -> None:
    """Half of √(1 - t² / σ²) is reached at t = σ √3 / 2."""
    sun, pitch = 2e-3, 0.01
    burst = starburst(lens_with(6, rotation_deg=30.0), sun_radius_rad=sun, table=(224, 2048))
    frames = burst.image(frame_at((-3.0, 0.0), np.array([450.0, 675.0]), (121, 201), pitch, half_width_nm=0))
    for frame in frames:
        profile = frame[:, 150]
        # linear between pixels
        edge = np.flatnonzero(profile > profile.max() / 2)
        below, above = profile[edge[-1] + 1], profile[edge[-1]]
        reach = edge[-1] + (above - profile.max() / 2) / (above - below) - 60
        assert reach * pitch == pytest.approx(100 * sun * math.sqrt(3) / 2, rel=0.02)
    # its height goes with λ
    assert frames[1, 60, 150] / frames[0, 60, 150] == pytest.approx(1.5, rel=0.01)


# --- the frame --------------------------------------------------------------------------------------------------


def test_the_pattern_stands_where_the_sun_does_and_has_no_hole() -> None:
    burst = starburst(lens_with(7), sun_radius_rad=4.65e-3, table=(224, 1024))
    frame = burst.image(frame_at((1.0, 0.5), np.array([500.0, 600.0]), (201, 301), 0.02))
    assert frame.shape == (2, 201, 301)
    assert frame.dtype == np.float32
    # the brightest pixels are those in and next to the Sun's image: none darker than a disc twice as wide
    r = np.hypot(*(np.mgrid[:201, :301] - np.array([125, 200])[:, None, None]))
    radius_px = 0.465 / 0.02
    assert frame[0][r < radius_px + 1].min() > np.median(frame[0][(r > 2 * radius_px) & (r < 2.2 * radius_px)])
    y, x = np.nonzero(frame[0] > 0.5 * frame[0].max())
    assert (x.mean() - 150, y.mean() - 100) == pytest.approx((50, 25), abs=0.5)
    outside = burst.image(frame_at((4.0, 0.0), np.array([500.0, 600.0]), (201, 301), 0.02))
    assert outside.min() > 0
    assert np.isfinite(outside).all()
    # towards the Sun it gets brighter
    assert (np.diff(outside[0].mean(axis=0)) > 0).all()


def test_a_lone_band_is_wide_and_a_hat_is_a_mean() -> None:
    burst = starburst(lens_with(6, 0.1), sun_radius_rad=2e-3, table=(128, 512))
    shape, pitch = (101, 101), 0.05
    wide = burst.image(frame_at((0, 0), np.array([550.0]), shape, pitch))[0]
    narrow = burst.image(frame_at((0, 0), np.linspace(415, 685, 10), shape, pitch, half_width_nm=0)).mean(axis=0)
    np.testing.assert_allclose(wide, narrow, rtol=0.01)
    hats = burst.image(frame_at((0, 0), np.array([450.0, 550.0, 650.0]), shape, pitch))
    # the first band is half a hat, its mean a third of the way to the next node; rims go with λ
    pure = burst.image(frame_at((0, 0), np.array([450.0 + 100 / 3]), shape, pitch, half_width_nm=0))[0]
    r, _ = distance_and_angle(shape)
    bright = (pure > np.median(pure)) & (r > 10)
    np.testing.assert_allclose(hats[0][bright], pure[bright], rtol=0.01)


@pytest.mark.parametrize(("blades", "rounding"), [(6, 0.0), (7, 0.4)])
def test_eight_bands_are_what_each_is_alone(blades: int, rounding: float) -> None:
    """Together they share tables, and bent edges' corners are a parabola in λ: 3 and 15 thousandths."""
    burst = starburst(lens_with(blades, rounding), sun_radius_rad=1.3e-3, table=(64, 1024))
    nodes = np.linspace(420.0, 680.0, 8)
    together = burst.image(frame_at((0.1, 0), nodes, (101, 101), 0.08, half_width_nm=0))
    for k in (0, 2, 5):
        alone = burst.image(frame_at((0.1, 0), nodes[k : k + 1], (101, 101), 0.08, half_width_nm=0))[0]
        lit = alone > 0
        np.testing.assert_allclose(together[k][lit], alone[lit], rtol=0.02)


def airy(v: F64) -> F64:
    return (2 * j1(v) / np.where(v == 0, 1, v)) ** 2 + (v == 0)


def test_a_round_stop_gives_the_airy_pattern_to_the_third_ring() -> None:
    stop = lens_with().surfaces[0]
    psf, pitch = fraunhofer_psf(stop, NM, samples=1024, across=128)
    assert psf.sum() == pytest.approx(1, abs=1e-12)
    # area of the pupil / (λ f)² is the peak per area; of the flux 2 / πv lies beyond the frame's v = 64 π
    peak = math.pi / 4 * DIAMETER_MM**2 / (NM * 1e-6 * 100.0) ** 2 * pitch**2
    assert psf[512, 512] == pytest.approx(peak, rel=4e-3)
    y, x = np.mgrid[:1024, :1024] - 512.0
    v = math.pi * DIAMETER_MM * np.hypot(x, y) * pitch / (NM * 1e-6 * 100.0)
    near = v < 13.3  # the fourth dark ring
    crest = np.minimum(1, 8 / (math.pi * np.maximum(v, 1) ** 3))  # the rings' heights, cos² = 1 of J₁
    wrong = np.abs(psf / psf[512, 512] - airy(v)) / crest
    assert wrong[near].max() < 0.01
    # and each ring where it belongs: J₂'s zeros
    row = psf[512, 512:] / psf[512, 512]
    place = v[512, 512:]
    for zero in (5.1356, 8.4172, 11.6198):
        around = np.flatnonzero(np.abs(place - zero) < 0.8)
        a, b, _ = np.polyfit(place[around], row[around], 2)
        top = around[np.argmax(row[around])]
        assert -b / (2 * a) == pytest.approx(zero, rel=0.01)
        assert row[top] == pytest.approx(float(airy(place[top])), rel=0.01)
