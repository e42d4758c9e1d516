"""Companding and compression of raw numbers, against closed forms and other readers of their formats."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_file import completed

from vbnfault.core.errors import InputError
from vbnfault.detector.chain import Device
from vbnfault.detector.effects import Effect, Exposure
from vbnfault.detector.effects.downlink import Companding, Compression, RawStep
from vbnfault.detector.sensor import load_sensor, parse_sensor

SHAPE = (96, 96)


def sent(raw: NDArray[Any], *effects: Effect, name: str = "generic_cmos", bits: int = 12) -> NDArray[Any]:
    """What arrives of raw numbers through a sensor with effects of its own."""
    sensor = load_sensor(name)
    sensor = replace(sensor, readout=replace(sensor.readout, bits=bits, dnl_lsb_rms=0.0), effects=effects)
    exposure = Exposure(device=Device(sensor, 1, shape=raw.shape), exposure_s=0.01, noise=None, acts={})
    out: Any = raw
    for effect in effects:
        out = effect.apply(out.copy(), exposure)
    assert out.dtype == np.uint16
    return np.asarray(out).astype(int)


def ground(seed: int = 0, top: int = 4095) -> NDArray[np.uint16]:
    """Smooth ground with noise, of a whole range of numbers."""
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.standard_normal(SHAPE), (0, 0), 6)
    level = (smooth - smooth.min()) / np.ptp(smooth) * 0.9 + 0.05
    return np.asarray(np.clip(level * top + rng.normal(0, 8, SHAPE), 0, top), dtype=np.uint16)


def test_the_error_of_square_root_companding_is_even_in_the_square_root() -> None:
    """Steps are 1/255 of the root of the range, and each holds errors from -1/2 to 1/2 of it."""
    every = np.arange(4096, dtype=np.uint16).reshape(64, 64)
    restored = sent(every, Companding(law="square_root", bits=8))
    step = (np.sqrt(restored / 4095) - np.sqrt(every / 4095)) * 255
    bright = every > 400  # where a step is 6 DN or more; below, rounding to whole DN shows
    assert np.abs(step[bright]).max() <= 0.5 + 0.5 / 6
    # the mean over DN of a uniform error; each of 175 steps is sampled by 6 to 32 DN
    assert step[bright].std() == pytest.approx(1 / np.sqrt(12), rel=0.03)
    assert abs(step[bright].mean()) < 0.02
    assert len(np.unique(restored)) <= 256
    # steps in DN: 2 √(DN · 4095) / 255, at most that of white
    assert np.abs(restored - every.astype(int)).max() <= np.ceil(4095 / 255)


def test_companding_twice_changes_nothing_more() -> None:
    every = np.arange(4096, dtype=np.uint16).reshape(64, 64)
    for law in (Companding(), Companding(law="linear", bits=6), Companding(levels_dn=(0, 5, 100, 4000))):
        once = sent(every, law)
        np.testing.assert_array_equal(sent(once.astype(np.uint16), law), once)
        assert (np.diff(once.ravel()) >= 0).all()
    np.testing.assert_array_equal(sent(every, Companding(law="linear", bits=12)), every)
    np.testing.assert_array_equal(sent(every, Companding(law="linear", bits=16)), every)


def test_a_table_of_levels_restores_the_nearest() -> None:
    raw = np.array([[0, 2, 3, 52, 53, 2050, 2051, 4095]], np.uint16)
    restored = sent(raw, Companding(levels_dn=(0, 5, 100, 4000)))
    np.testing.assert_array_equal(restored, [[0, 0, 5, 5, 100, 4000, 4000, 4000]])


def test_jpeg_of_full_quality_keeps_its_eight_bits_within_one() -> None:
    """With steps of 1 the cosine transform rounds by up to 1/2 in each of 64 coefficients: 1/12 of variance."""
    raw = (ground(top=255)).astype(np.uint16)
    error = sent(raw, Compression(codec="jpeg", quality=100), bits=8) - raw
    assert np.abs(error).max() <= 2
    assert (np.abs(error) <= 1).mean() > 0.99
    # variances of the coefficients' rounding and of the pixels' add: 2/12
    assert error.std() < np.sqrt(2 / 12)


def test_jpeg_takes_eight_bits_of_twelve_and_more_quality_keeps_more() -> None:
    raw = ground()
    errors = [(sent(raw, Compression(codec="jpeg", quality=q)) - raw).std() for q in (100, 90, 50, 10)]
    assert errors == sorted(errors)
    # 16 DN to a code: 16/√12 of rounding, and a little of the transform
    assert 16 / np.sqrt(12) <= errors[0] < 1.5 * 16 / np.sqrt(12)


def test_jpeg_shows_blocks_of_eight_pixels_and_wavelets_none() -> None:
    raw = ground(3)
    steps = {}
    for name, effect in (
        ("jpeg", Compression(codec="jpeg", quality=5)),
        ("jpeg2000", Compression(codec="jpeg2000", bits_per_px=0.3)),
    ):
        # a monochrome sensor is compressed as one image
        image = sent(raw, effect, name="rosetta_navcam", bits=12)
        across = np.abs(np.diff(image, axis=1)).mean(axis=0)
        edges = np.arange(len(across)) % 8 == 7
        steps[name] = across[edges].mean() / across[~edges].mean()
    assert steps["jpeg"] > 1.5
    assert steps["jpeg2000"] < 1.25


def test_wavelets_without_a_limit_lose_nothing_and_keep_to_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = ground(1)
    np.testing.assert_array_equal(sent(raw, Compression(codec="jpeg2000", bits_per_px=16.0)), raw)
    sizes, encode = [], cv2.imencode

    def counted(*given: Any) -> Any:
        done, data = encode(*given)
        sizes.append(8 * len(data) / given[1].size)
        return done, data

    monkeypatch.setattr(cv2, "imencode", counted)
    errors = [(sent(raw, Compression(codec="jpeg2000", bits_per_px=b)) - raw).std() for b in (8.0, 4.0, 2.0)]
    assert errors == sorted(errors)
    # four planes of 48 x 48 px each; heads of the files take some 110 bytes, 0.4 bits per px
    assert np.max(np.reshape(sizes, (3, 4)), axis=1) == pytest.approx([8, 4, 2], abs=0.5)


def test_files_are_those_of_their_formats(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow reads the same numbers as OpenCV."""
    image = pytest.importorskip("PIL.Image")
    raw, seen = ground(2, top=255), []
    decode = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda data, how: seen.append(bytes(data)) or decode(data, how))
    for effect in (Compression(codec="jpeg", quality=80), Compression(codec="jpeg2000", bits_per_px=3.0)):
        seen.clear()
        arrived = sent(raw, effect, bits=8)
        for k, data in enumerate(seen):
            # codes above the highest count as that one; two inverse cosine transforms of libjpeg may round apart
            other = np.minimum(np.asarray(image.open(io.BytesIO(data))).astype(int), 255)
            assert np.abs(other - arrived[k // 2 :: 2, k % 2 :: 2]).max() <= 1


def test_what_faults_make_of_raw_numbers_has_the_codes_of_companding() -> None:
    """A fault that leaves a pixel alone changes nothing there; without faults or companding all stays as it is."""
    law, every = Companding(levels_dn=(10, 20, 100, 3800)), np.arange(4096, dtype=np.uint16).reshape(64, 64)
    sensor = load_sensor("generic_cmos")
    sensor = replace(sensor, readout=replace(sensor.readout, bits=12, dnl_lsb_rms=0.0), effects=(law,))

    def dark(raw: NDArray[Any]) -> NDArray[Any]:
        return np.where(np.arange(64)[:, None] < 32, raw, raw - 7)  # fewer than the least code holds

    exposure = Exposure(device=Device(sensor, 1, shape=every.shape), exposure_s=0.01, noise=None, acts={})
    restored = law.apply(every, exposure)
    np.testing.assert_array_equal(RawStep().apply(restored.copy(), exposure), restored)
    faulty = RawStep().apply(restored.copy(), replace(exposure, acts={"raw": (dark,)}))
    np.testing.assert_array_equal(faulty[:32], restored[:32])
    assert set(np.unique(faulty)) <= {10, 20, 100, 3800}


def test_codes_of_companding_are_what_is_compressed() -> None:
    """Square roots spare dark ground what eight linear bits of twelve take from it."""
    raw = (ground(4).astype(float) * 0.03).astype(np.uint16)  # up to 123 DN: 8 linear codes, 44 of square roots
    jpeg = Compression(codec="jpeg", quality=95)
    plain, rooted = (sent(raw, *effects) - raw for effects in ((jpeg,), (Companding(), jpeg)))
    assert rooted.std() < 0.5 * plain.std()


def test_a_mosaic_is_compressed_by_colours() -> None:
    """Colours that differ by far stay apart: a checkerboard of even planes arrives as it was."""
    raw = np.tile(np.array([[100, 3000], [2000, 400]], np.uint16), (24, 24))
    arrived = sent(raw, Compression(codec="jpeg", quality=50))
    # even planes are one coefficient a block: half a step of quantisation, 8 codes at quality 50
    assert np.abs(arrived - raw).max() <= 16 * 2


@pytest.mark.parametrize("shape", [(16, 16), (17, 40), (33, 31)])
@pytest.mark.parametrize("codec", ["jpeg", "jpeg2000"])
def test_frames_of_any_size_pass(shape: tuple[int, int], codec: Any) -> None:
    raw = np.random.default_rng(0).integers(0, 4096, shape, dtype=np.uint16)
    assert sent(raw, Compression(codec=codec, bits_per_px=8)).shape == shape


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        ({"companding": {"levels_dn": [0, 5, 5]}}, r"effects.companding.levels_dn = .*each above the one before"),
        ({"companding": {"levels_dn": [7]}}, r"effects.companding.levels_dn = .*two DN or more"),
        ({"companding": {"levels_dn": [0, 70000]}}, r"effects.companding.levels_dn.* = 70000: must be .*65535"),
        (
            {"compression": {"codec": "jpeg"}, "companding": {"bits": 10}},
            r"effects.companding gives 1024 codes; must be at most 256",
        ),
    ],
)
def test_wrong_tables_are_refused_in_a_sentence(effects: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        parse_sensor(completed({"effects": effects}), source="mine.toml")
    assert str(caught.value).startswith("mine.toml: ")
