"""The compiled kernels of mosaics have the bits of the single steps, for any mosaic, sensor and noise."""

from __future__ import annotations

import numpy as np
import pytest

from vbnfault.detector import compiled, compiled_bayer
from vbnfault.detector.demosaic import demosaic
from vbnfault.detector.display import Display, levels, luminance
from vbnfault.detector.mosaic import BAYER, PATTERNS
from vbnfault.detector.noise import NormalField, draw_normals, poisson_quantile

SHAPES = [(6, 6), (7, 6), (6, 7), (9, 13), (64, 40), (131, 70)]


def stepwise(mosaic: np.ndarray, name: str, saturated: np.ndarray, display: Display) -> np.ndarray:
    """Return the image uint8[y, x, 4] by the functions of the single steps."""
    rgb = levels(mosaic, PATTERNS[name], "malvar", mosaic >= saturated, display)
    return np.dstack([rgb, luminance(rgb)])


def scenes(shape: tuple[int, int], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return mosaics with noise, single bright pixels, hard edges of blocks, and any numbers."""
    dark = rng.integers(60, 80, shape).astype(np.uint16)
    stars = np.where(rng.random(shape) < 0.05, rng.integers(0, 32768, shape), dark).astype(np.uint16)
    blocks = rng.integers(0, 4096, (shape[0] // 5 + 1, shape[1] // 5 + 1)).repeat(5, 0).repeat(5, 1)
    return {
        "dark": dark,
        "stars": stars,
        "blocks": blocks[: shape[0], : shape[1]].astype(np.uint16),
        "any": rng.integers(0, 32768, shape).astype(np.uint16),
    }


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", [name.lower() for name in BAYER])
def test_an_image_has_the_bits_of_its_steps(name: str, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng([len(shape), *shape, *name.encode()])
    hard = 0
    for limit in (32767, 2500):
        saturated = (limit - rng.integers(0, 400, shape)).astype(np.uint16)
        for mosaic in scenes(shape, rng).values():
            display = Display(
                black_dn=rng.uniform(0, 90), noise_dn=rng.uniform(0, 5), scale=tuple(rng.uniform(0.01, 1, 3))
            )
            assert compiled_bayer.serves(mosaic, PATTERNS[name], "malvar")
            wanted = stepwise(mosaic, name, saturated, display)
            np.testing.assert_array_equal(compiled_bayer.image(mosaic, PATTERNS[name], saturated, display), wanted)
            plain = demosaic(mosaic, PATTERNS[name], "malvar") - np.float32(display.black_dn)
            hard += np.count_nonzero(np.clip(np.rint(plain * display.scale), 0, 255) != wanted[..., :3])
    assert hard > 0  # edges of which values beside them are bounded are among these mosaics


@pytest.mark.parametrize(
    ("name", "method", "dtype", "shape", "greatest"),
    [
        ("rgbw", "malvar", np.uint16, (40, 40), 100),
        ("rggb", "menon", np.uint16, (40, 40), 100),
        ("rggb", "malvar", np.float32, (40, 40), 100),
        ("rggb", "malvar", np.uint16, (5, 40), 100),
        ("rggb", "malvar", np.uint16, (0, 0), 0),
        ("rggb", "malvar", np.uint16, (40, 40), 32768),
    ],
)
def test_other_mosaics_are_left_to_the_steps(
    name: str, method: str, dtype: type, shape: tuple[int, int], greatest: int
) -> None:
    assert not compiled_bayer.serves(np.full(shape, greatest, dtype), PATTERNS[name], method)


def with_tails(shape: tuple[int, ...]) -> NormalField:
    """Return variates whose first pixels have the outermost codes, with values that no table holds."""
    codes = draw_normals(shape, np.random.default_rng(5)).codes.copy()
    codes.reshape(-1)[:8] = ([0, 65535] * 4)[: codes.size]
    tail = np.flatnonzero((codes == 0) | (codes == 65535))
    return NormalField(codes=codes, tail=tail, tail_values=np.where(codes.flat[tail] == 0, -5, 5).astype("f4"))


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (3, 3), (200, 301)])
@pytest.mark.parametrize("greatest_e", [0.0, 0.5, 4.0, 30.0, 1500.0, 1e5])
def test_shot_noise_has_the_bits_of_the_quantile(greatest_e: float, shape: tuple[int, int]) -> None:
    mean = np.random.default_rng(3).random(shape).astype(np.float32) ** 2 * np.float32(greatest_e)
    for normal in (draw_normals(shape, np.random.default_rng(4)), with_tails(shape)):
        for given in (mean, mean[::-1, ::-1]):  # the second is not contiguous
            wanted = poisson_quantile(given, normal.values())
            np.testing.assert_array_equal(compiled.poisson(given, normal), wanted)
