"""Images of the compiled kernel have the bits of the single steps, for any sensor, signal and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_detector import draw

from vbnfault.core.process.llvm import backend
from vbnfault.core.quantities import Electrons
from vbnfault.detector import GreyDetector, Noise, ThreeColourDetector
from vbnfault.detector.noise import NormalField, draw_normals, variates_by_code

EXPOSURE_S = 0.02


def with_outermost(noise: Noise) -> Noise:
    """Return noise in whose first pixels both outermost codes occur, with variates that no table holds."""
    codes = noise.codes.copy()
    codes.reshape(-1)[:24] = [0, 65535] * 6 + [65535, 0] * 6

    def field(of: np.ndarray) -> NormalField:
        flat = of.reshape(-1)
        tail = np.flatnonzero((flat == 0) | (flat == 65535))
        return NormalField(codes=of, tail=tail, tail_values=np.where(flat[tail] == 0, -5, 5).astype(np.float32))

    return Noise(codes=codes, shot=field(codes[..., 0]), read=field(codes[..., 1]))


def stepwise(detector: ThreeColourDetector, expected: Electrons, noise: Noise | None) -> np.ndarray:
    """Return the image uint8[y, x, 4] by the methods of the single steps, which leave out nothing."""
    shot, read = (None, None) if noise is None else (noise.shot.values(), noise.read.values())
    electrons = detector.collected_e(expected.array, EXPOSURE_S, shot)
    return detector.shown(detector.converted_dn(electrons, read), EXPOSURE_S)


def sky(shape: tuple[int, int], lit: float, level_e: float = 900.0) -> np.ndarray:
    """Return signals of which the lower fraction `lit` is light, with single lit values above it."""
    rng = np.random.default_rng(7)
    out = (rng.random((*shape, 3)) * level_e).astype(np.float32)
    out[: round(shape[0] * (1 - lit))] = 0
    out[3, 5, 1] = 2000
    out[4, 6] = 20
    return out


def differing(detector: ThreeColourDetector, signal: np.ndarray, noise: Noise | None) -> int:
    """Return the number of values of the image that differ from those of the single steps."""
    expected = Electrons(array=signal, white_e=detector.white_e)
    image = detector.develop(expected, EXPOSURE_S, noise).array
    return int(np.count_nonzero(image != stepwise(detector, expected, noise)))


def test_variates_are_those_of_the_whole_field() -> None:
    for field in (draw_normals((40, 30, 3), np.random.default_rng(1)), with_outermost(draw(1, (40, 30))).read):
        values = field.values()
        assert values.std() == pytest.approx(1, abs=0.05)  # 3600 variates: 0.012 in one standard deviation
        pixels = np.concatenate([[2, 0, 1], np.random.default_rng(2).permutation(1200)[:300]])[None]
        np.testing.assert_array_equal(field.of_pixels(pixels).values(), values.reshape(-1, 3)[pixels])
        again = np.array([[1, 0]])
        np.testing.assert_array_equal(field.of_pixels(pixels).of_pixels(again).values()[0, 0], values[0, 0])
    assert (values == 5).sum() == np.count_nonzero(field.codes == 65535) >= 6
    assert (values == -5).sum() == np.count_nonzero(field.codes == 0) >= 6


def test_both_fields_are_the_halves_of_one_field() -> None:
    noise = draw(4, (33, 17))
    both = draw_normals((33, 17, 3, 2), np.random.default_rng(4))
    for k, field in enumerate((noise.shot, noise.read)):
        np.testing.assert_array_equal(field.values(), both.values()[..., k])
        inner = (field.codes > 0) & (field.codes < 65535)
        assert len(field.tail) == np.count_nonzero(~inner)
        np.testing.assert_array_equal(field.values()[inner], variates_by_code()[field.codes[inner]])


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
    noise = with_outermost(draw(6, shape)) if noisy else None
    assert differing(detector, sky(shape, lit), noise) == 0


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("greatest_e", [0.5, 4.0, 30.0, 1000.0, 1e5, 1e20])
def test_signals_of_any_size_have_the_bits_of_their_steps(greatest_e: float, noisy: bool) -> None:
    shape = (120, 110)  # 39,600 values, each with another variate
    signal = np.random.default_rng(3).random((*shape, 3)).astype(np.float32) ** 2 * np.float32(greatest_e)
    noise = draw(8, shape) if noisy else None
    for detector in (
        ThreeColourDetector(),
        ThreeColourDetector(dark_current_e_s=0.0, adc_bits=16, bias_dn=0, full_well_e=9e4),
        ThreeColourDetector(adc_bits=8, bias_dn=3, response="nikon_5100", read_noise_e_rms=0.7),
    ):
        assert differing(detector, signal, noise) == 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (3, 1), (5, 7), (64, 3)])
@pytest.mark.parametrize("noisy", [True, False])
def test_images_of_few_pixels_have_the_bits_of_their_steps(shape: tuple[int, int], noisy: bool) -> None:
    noise = draw(9, shape) if noisy else None
    for signal in (np.zeros((*shape, 3), np.float32), np.full((*shape, 3), 700, np.float32)):
        assert differing(ThreeColourDetector(), signal, noise) == 0


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_an_image_may_have_no_pixels(shape: tuple[int, int]) -> None:
    detector, signal = ThreeColourDetector(), np.zeros((*shape, 3), np.float32)
    for noise in (draw(1, shape), None):
        image = detector.develop(Electrons(array=signal, white_e=detector.white_e), EXPOSURE_S, noise)
        assert image.array.shape == (*shape, 4)


def test_arrays_in_any_order_and_place_in_memory_give_the_same_image() -> None:
    detector, shape = ThreeColourDetector(), (40, 36)
    noise, signal = draw(2, shape), sky(shape, 0.6)
    image = detector.develop(Electrons(array=signal, white_e=detector.white_e), EXPOSURE_S, noise).array
    memory = np.zeros(signal.size + 1, np.float32)
    memory[1:] = signal.reshape(-1)
    for same in (np.asfortranarray(signal), np.repeat(signal, 2, axis=1)[:, ::2], memory[1:].reshape(signal.shape)):
        again = detector.develop(Electrons(array=same, white_e=detector.white_e), EXPOSURE_S, noise)
        np.testing.assert_array_equal(again.array, image)


def test_shapes_that_differ_are_refused() -> None:
    detector = ThreeColourDetector()
    light = Electrons(array=np.ones((4, 6, 3), np.float32), white_e=detector.white_e)
    with pytest.raises(ValueError, match="noise has the shape"):
        detector.develop(light, EXPOSURE_S, draw(1, (6, 4)))


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_signal_that_is_no_number_does_not_end_the_process(noisy: bool) -> None:
    detector, shape = ThreeColourDetector(), (4, 6)
    signal = np.full((*shape, 3), np.nan, np.float32)
    signal[0] = np.inf
    signal[1] = 500
    noise = draw(3, shape) if noisy else None
    image = detector.develop(Electrons(array=signal, white_e=detector.white_e), EXPOSURE_S, noise).array
    np.testing.assert_array_equal(
        image[:2], stepwise(detector, Electrons(array=signal, white_e=detector.white_e), noise)[:2]
    )
    if noisy:
        return
    assert (image[0, :, :3] == 255).all()
    assert ((image[1, :, :3] > 0) & (image[1, :, :3] < 255)).all()


def test_exposures_and_variates_share_kernels() -> None:
    """A kernel takes a hundred times as long to compile as to run. There are three: variates, levels, luminance."""
    dr = backend().dr
    shape, signal = (64, 64), sky((64, 64), 0.5)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        hashes: list[set[str]] = []
        for k in range(6):
            detector = ThreeColourDetector(read_noise_e_rms=5.0 + k, bias_dn=10 * k, dark_current_e_s=float(k))
            light = Electrons(array=signal * np.float32(k + 1), white_e=detector.white_e)
            memory = np.zeros(signal.size + k, np.float32)[k:].reshape(signal.shape)  # anywhere in memory
            memory[...] = light.array
            detector.develop(light.with_array(memory), 0.01 * (k + 1), draw(k, shape))
            hashes.append({kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel})
    assert len(hashes[0]) == 3
    assert all(of_exposure == hashes[0] for of_exposure in hashes)


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("width", [64, 33])
def test_a_grey_detector_has_the_bits_of_its_steps(width: int, noisy: bool) -> None:
    detector = GreyDetector(width_px=width, height_px=40)
    assert detector.white_e.tolist() == [detector.full_well_e]  # white reaches the full well
    signal = sky((40, width), 0.6)[..., :1].copy()
    noise = Noise.draw((40, width), np.random.default_rng(3), 1) if noisy else None
    assert differing(detector, signal, noise) == 0
    expected = Electrons(array=signal, white_e=detector.white_e)
    image = detector.develop(expected, EXPOSURE_S, noise)
    assert (image.array == image.array[..., :1]).all()
