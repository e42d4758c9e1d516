"""Where the sky sends no light, only values that are not black are developed, and the image keeps its bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vbnfault.core.quantities import Electrons
from vbnfault.detector import Noise, ThreeColourDetector
from vbnfault.detector.noise import NormalField, draw_normals, variates_of
from vbnfault.detector.three_colour import noise_limits_of

EXPOSURE_S = 0.02
LAST_CODE = 65471  # that is tried as a limit


def draw(seed: int, shape: tuple[int, int]) -> Noise:
    return Noise.draw(shape, np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2]))


def with_outermost(field: NormalField) -> NormalField:
    """Return a field in whose first pixels both outermost codes occur, with variates that no table holds."""
    codes = field.codes.copy()
    codes.reshape(-1)[:12] = [0, 65535] * 6
    tail = np.flatnonzero((codes == 0) | (codes == 65535))
    values = np.where(codes.reshape(-1)[tail] == 0, -5.0, 5.0).astype(np.float32)
    return NormalField(codes=codes, tail=tail, tail_values=values)


def stepwise(detector: ThreeColourDetector, expected: Electrons, noise: Noise | None) -> np.ndarray:
    """Return the image uint8[y, x, 4] by the methods of the single steps, which leave out nothing."""
    raw = detector.raw_dn(detector.electrons(expected, EXPOSURE_S, noise), noise)
    return detector.rgbi(raw, EXPOSURE_S).array


def sky(shape: tuple[int, int], lit: float, level_e: float = 900.0) -> np.ndarray:
    """Return signals of which the lower fraction `lit` is light, with single lit values above it."""
    rng = np.random.default_rng(7)
    out = (rng.random((*shape, 3)) * level_e).astype(np.float32)
    out[: round(shape[0] * (1 - lit))] = 0
    out[3, 5, 1] = 2000
    out[4, 6] = 20
    return out


def test_variates_are_those_of_the_whole_field() -> None:
    field = with_outermost(draw_normals((40, 30, 3), np.random.default_rng(1)))
    values = field.values()
    assert (values == 5).sum() == 6
    np.testing.assert_array_equal(field[7:19].values(), values[7:19])
    np.testing.assert_array_equal(field[0:1][0:1].values(), values[:1])
    for step in (2, -1):
        with pytest.raises(ValueError, match=f"step = {step}: must be 1"):
            field[0:9:step]
    rng = np.random.default_rng(2)
    for places in (np.arange(values.size), np.sort(rng.permutation(values.size)[:700]), np.zeros(0, dtype=np.intp)):
        np.testing.assert_array_equal(field.at(places), values.ravel()[places])
    pixels = np.concatenate([[2, 0, 1], rng.permutation(1200)[:300]])[None]
    np.testing.assert_array_equal(field.of_pixels(pixels).values(), values.reshape(-1, 3)[pixels])
    again = np.array([[1, 0]])
    np.testing.assert_array_equal(field.of_pixels(pixels).of_pixels(again).values()[0, 0], values[0, 0])


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("lit", [0.0, 0.15, 0.5, 1.0])
@pytest.mark.parametrize("dark_e_s", [0.0, 15.0, 300.0, 5000.0, 1e6])
@pytest.mark.parametrize(
    "changes", [{}, {"bias_dn": 0}, {"adc_bits": 8, "read_noise_e_rms": 60.0}, {"read_noise_e_rms": 0.0}]
)
def test_an_image_with_sky_has_the_bits_of_its_steps(
    noisy: bool, lit: float, dark_e_s: float, changes: dict[str, float]
) -> None:
    detector = replace(ThreeColourDetector(dark_current_e_s=dark_e_s), **changes)
    shape = (70, 50)
    noise = None
    if noisy:
        noise = draw(6, shape)
        noise = Noise(shot=with_outermost(noise.shot), read=with_outermost(noise.read))
    expected = Electrons(array=sky(shape, lit), white_e=detector.white_e)
    np.testing.assert_array_equal(
        detector.develop(expected, EXPOSURE_S, noise).array, stepwise(detector, expected, noise)
    )


@pytest.mark.parametrize("dark_e_s", [0.0, 15.0, 40.0, 150.0])
@pytest.mark.parametrize("read_noise_e_rms", [0.0, 13.0, 25.0])
def test_values_are_black_up_to_the_limits_and_no_further(dark_e_s: float, read_noise_e_rms: float) -> None:
    detector = ThreeColourDetector(dark_current_e_s=dark_e_s, read_noise_e_rms=read_noise_e_rms)
    limits = noise_limits_of(detector, EXPOSURE_S)
    assert limits is not None
    dark = Electrons(array=np.zeros((4, 5, 3), np.float32), white_e=detector.white_e)

    def field(code: int | np.ndarray) -> NormalField:
        codes = np.broadcast_to(code, (4, 5, 3)).astype(np.uint16)
        return NormalField(codes=codes, tail=np.zeros(0, np.intp), tail_values=np.zeros(0, np.float32))

    def image(shot: int, read: np.ndarray) -> np.ndarray:
        """Return the image of variates that have the same codes in every pixel."""
        return stepwise(detector, dark, Noise(shot=field(shot), read=field(read)))[..., :3]

    shot, read = int(limits.shot), limits.read.astype(int)
    assert not image(shot, read).any()
    # every limit is the last of the codes tried with which values have this count, or are black
    if dark_e_s > 0 and read_noise_e_rms > 0:
        assert shot < LAST_CODE
    if shot < LAST_CODE:
        collect = detector._collector(EXPOSURE_S)
        of_limit, of_next = collect(np.zeros(2, np.float32), variates_of(np.array([shot, shot + 64], np.uint16)))
        assert of_next > of_limit
    assert (read < LAST_CODE).all() == (read_noise_e_rms > 0)
    for k in np.flatnonzero(read < LAST_CODE):
        beyond = read.copy()
        beyond[k] += 64
        assert image(shot, beyond)[..., k].all()


@pytest.mark.parametrize("noisy", [True, False])
def test_most_of_the_sky_is_not_developed(noisy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []
    convert = ThreeColourDetector._convert

    def counted(self: ThreeColourDetector, electrons: np.ndarray, read: np.ndarray | None) -> np.ndarray:
        sizes.append(electrons.size)
        return convert(self, electrons, read)

    detector, shape = ThreeColourDetector(), (256, 256)
    noise = draw(3, shape) if noisy else None
    expected = Electrons(array=np.zeros((*shape, 3), np.float32), white_e=detector.white_e)
    noise_limits_of(detector, EXPOSURE_S)  # kept for all images of an exposure
    monkeypatch.setattr(ThreeColourDetector, "_convert", counted)
    image = detector.develop(expected, EXPOSURE_S, noise).array
    # red, with the greatest white balance, is not black beyond 1.4 σ of the read noise, which is 8 % of the values
    assert sum(sizes) < (0.2 if noisy else 1e-4) * 3 * 256 * 256
    assert image.any() == noisy


def test_a_long_exposure_develops_all_of_the_sky() -> None:
    # the mean of the dark current is subtracted, so its noise is seen in half of the values
    detector = ThreeColourDetector(dark_current_e_s=1e6)
    assert noise_limits_of(detector, EXPOSURE_S) is None
    # nor are there limits where counts no longer are steps, unless the full well holds fewer electrons
    for mean_e in (31.0, 100.0, 1000.0):
        long = ThreeColourDetector(dark_current_e_s=mean_e / EXPOSURE_S)
        assert noise_limits_of(long, EXPOSURE_S) is None
    assert noise_limits_of(ThreeColourDetector(), EXPOSURE_S) is not None
