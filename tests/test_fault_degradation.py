"""Gaussian blur against a direct sum."""

from __future__ import annotations

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, make_context, noisy_electrons, rng

from vbnfault.core.errors import InputError
from vbnfault.faults.degradation import sigma_px


def gaussian(size: int) -> np.ndarray:
    d = np.arange(size) - size // 2
    weights = np.exp(-0.5 * (d / sigma_px(size)) ** 2)
    return weights / weights.sum()


@pytest.mark.parametrize("size", [3, 9, 17])
def test_against_a_direct_sum(size: int) -> None:
    context = make_context(1024, 96)
    fault = make("optics_degradation", filter_size_px=size)
    params = fault.draw(context, rng())
    assert params == {"filter_size_px": size, "kernel_px": size, "sigma_px": sigma_px(size)}
    sharp = noisy_electrons(context)
    blurred = fault.apply(sharp, params, context).array
    clipped = np.minimum(sharp.array, sharp.white_e).astype(float)
    r = size // 2
    padded = np.pad(clipped, ((r, r), (r, r), (0, 0)), mode="reflect")
    g = gaussian(size)
    rows = sum(w * padded[k : k + 96] for k, w in enumerate(g))
    expected = sum(w * rows[:, k : k + 1024] for k, w in enumerate(g))
    # 2 × 17 float32 products of up to white: 34 · 2⁻²⁴ of white
    assert np.abs(blurred - expected).max() < 34 * 2**-24 * sharp.white_e.max()


def test_the_sun_is_clipped_to_white_first() -> None:
    context = make_context(1024, 64)
    fault = make("optics_degradation", filter_size_px=17)
    params = fault.draw(context, rng())
    dim = flat_electrons(context, 0.0)
    bright = dim.array.copy()
    bright[32, 512] = 1e5 * dim.white_e
    blurred = fault.apply(dim.with_array(bright), params, context).array
    assert blurred[32, 512] == pytest.approx(dim.white_e * gaussian(17)[8] ** 2, rel=1e-5)
    assert blurred.sum(axis=(0, 1)) == pytest.approx(dim.white_e, rel=1e-5)
    assert np.count_nonzero(blurred[..., 0]) == 17**2


def test_the_sun_stays_white_where_light_is_not_clipped() -> None:
    context = make_context(1024, 128)
    fault = make("optics_degradation", filter_size_px=17, unclipped=True)
    params = fault.draw(context, rng())
    dark = flat_electrons(context, 0.0)
    bright = dark.array.copy()
    bright[64, 512] = 1e5 * dark.white_e
    blurred = fault.apply(dark.with_array(bright), params, context).array / dark.white_e
    assert blurred[64, 512, 1] == pytest.approx(1e5 / (2 * np.pi * sigma_px(17) ** 2), rel=1e-3)
    assert blurred[..., 1].sum() == pytest.approx(1e5, rel=1e-5)
    # a Gaussian falls to white at σ √(2 ln(1e5 / 2πσ²)): a round disc of that radius is white
    radius = sigma_px(17) * np.sqrt(2 * np.log(1e5 / (2 * np.pi * sigma_px(17) ** 2)))
    y, x = np.mgrid[-64:64, -512:512]
    white = blurred[..., 1] >= 1
    assert white[np.hypot(x, y) < radius - 0.01].all()
    assert not white[np.hypot(x, y) > radius + 0.01].any()


def test_flat_stays_flat() -> None:
    context = make_context(256)
    fault = make("optics_degradation")
    params = fault.draw(context, rng())
    flat = flat_electrons(context, 0.5)
    assert np.allclose(fault.apply(flat, params, context).array, flat.array, rtol=1e-6, atol=0)
    assert fault.footprint(params, context).all()  # type: ignore[union-attr]


def test_sizes_are_odd_and_fill_the_table() -> None:
    context = make_context(1024, 8)
    sizes = {make("optics_degradation").draw(context, rng(s))["filter_size_px"] for s in range(200)}
    assert sizes == {3, 5, 7, 9, 11, 13, 15, 17}
    assert make("optics_degradation", filter_size_px=[4, 6]).draw(context, rng())["filter_size_px"] == 5
    with pytest.raises(InputError, match="no odd size within"):
        make("optics_degradation", filter_size_px=4)


def test_blur_scales_with_the_resolution() -> None:
    fault = make("optics_degradation", filter_size_px=17)
    at_2048 = fault.draw(make_context(2048, 8), rng())
    assert at_2048["sigma_px"] == pytest.approx(2 * sigma_px(17))
    assert at_2048["kernel_px"] in (33, 35)
    small = make("optics_degradation", filter_size_px=17, scale_with_resolution=False)
    assert small.draw(make_context(128), rng())["kernel_px"] == 17
    assert fault.draw(make_context(128), rng())["kernel_px"] == 3


def test_a_small_image_is_still_blurred() -> None:
    context = make_context(64)
    fault = make("optics_degradation", filter_size_px=3)
    params = fault.draw(context, rng())
    assert params == {"filter_size_px": 3, "kernel_px": 3, "sigma_px": 0.4}
    flat = flat_electrons(context, 0.5)
    edge = flat.with_array(flat.array * (np.arange(64) < 32).reshape(1, -1, 1))
    blurred = fault.apply(edge, params, context).array
    # e^(-1/(2·0.16)) / (1 + 2 e^(-1/(2·0.16))) of the lit side arrives behind the edge: 4 %, 5 DN at half white
    assert blurred[20, 32] == pytest.approx(0.0404 * edge.array[20, 31], rel=0.01)
