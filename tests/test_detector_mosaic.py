"""Mosaics and their reconstruction: published kernels, an independent package, exact cases, footprints."""

from __future__ import annotations

import warnings
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from vbnfault.core.errors import InputError
from vbnfault.detector import demosaic as module
from vbnfault.detector.demosaic import (
    bounded_at_edges,
    correct_defects,
    demosaic,
    footprint,
    interpolate,
    mended_from,
)
from vbnfault.detector.mosaic import BAYER, PATTERNS, Pattern, channel_of, pattern, plane_of, sample

METHODS = ("bilinear", "malvar", "menon")
FITTING = [(f, m) for f in map(str.lower, BAYER) for m in METHODS]
FITTING += [(f, "bilinear") for f in ("rgbw", "rgb_nir", "mono")]


def channel_mask(pattern: Pattern, shape: tuple[int, int], channel: str) -> np.ndarray:
    """The pixels of one channel."""
    return channel_of(pattern, shape) == pattern.index(channel)


def random_raw(shape: tuple[int, int] = (42, 50), seed: int = 1) -> np.ndarray:
    """Random 16 bit numbers: quarters and eighths of their sums are exact in float32."""
    return np.random.default_rng(seed).integers(0, 65536, shape).astype(np.uint16)


# --------------------------------------------------------------------------------------------------- patterns


@pytest.mark.parametrize("name", BAYER)
def test_bayer_patterns_are_read_row_by_row_from_the_top_left(name: str) -> None:
    letters = np.array(["R", "G", "B"])[channel_of(pattern(name), (4, 6))]
    for y in range(4):
        for x in range(6):
            assert letters[y, x] == name[2 * (y % 2) + x % 2]
    assert pattern(name).is_bayer


def test_rgbw_is_half_white_in_a_chequerboard_a_quarter_green() -> None:
    rgbw = pattern("RGBW")
    letters = np.array(rgbw.channels)[channel_of(rgbw, (4, 4))]
    assert ["".join(row) for row in letters] == ["WBWG", "BWGW", "WGWR", "GWRW"]
    # panchromatic pixels touch each other at their corners only
    white = channel_mask(rgbw, (8, 8), "W")
    np.testing.assert_array_equal(white, np.indices((8, 8)).sum(axis=0) % 2 == 0)
    assert [channel_mask(rgbw, (8, 8), c).mean() for c in "RGB"] == [1 / 8, 1 / 4, 1 / 8]
    # and so do the coloured ones
    for name in "RGB":
        colour = channel_mask(rgbw, (8, 8), name)
        assert not (colour[:, 1:] & colour[:, :-1]).any()
        assert not (colour[1:] & colour[:-1]).any()


def test_near_infrared_replaces_the_second_green() -> None:
    nir = pattern("rgb_nir")
    np.testing.assert_array_equal(channel_of(nir, (2, 2)), [[0, 1], [3, 2]])
    assert nir.channels == ("R", "G", "B", "NIR")


# tiles of a user: their heights divide no power of two, or are larger than the blocks that are copied at a time
SIX = Pattern(name="six", channels=("R", "W"), tile=((0, 1, 1, 1, 1, 1), *(((1,) * 6,) * 5)))
TALL = Pattern(name="tall", channels=("R", "W"), tile=((0,),) * 3 + ((1,),) * 67)


@pytest.mark.parametrize("p", [*PATTERNS.values(), SIX, TALL], ids=lambda p: p.name)
@pytest.mark.parametrize("shape", [(6, 8), (67, 131), (64, 64), (200, 9)])
def test_sample_takes_each_pixels_own_filter(p: Pattern, shape: tuple[int, int]) -> None:
    planes = np.random.default_rng(3).random((*shape, len(p.channels)), dtype=np.float32)
    before = planes.copy()
    raw = sample(planes, p)
    own = channel_of(p, shape)
    np.testing.assert_array_equal(raw, np.take_along_axis(planes, own[..., None].astype(int), 2)[..., 0])
    assert raw.dtype == np.float32
    np.testing.assert_array_equal(planes, before)
    sparse = np.stack([plane_of(raw, p, channel) for channel in p.channels], axis=-1)
    np.testing.assert_array_equal(sample(sparse, p), raw)
    np.testing.assert_array_equal(np.count_nonzero(sparse, axis=2), 1)
    masks = [channel_mask(p, shape, c) for c in p.channels]
    np.testing.assert_array_equal(np.sum(masks, axis=0), 1)


LONG = Pattern(name="long", channels=("R", "W"), tile=((0,),) * 8 + ((1,),))


def test_bad_patterns_are_told_in_a_sentence() -> None:
    for bad, sentence in (
        (lambda: pattern("RGBG"), "pattern = 'RGBG': must be one of rggb"),
        (
            lambda: Pattern(name="a", channels=("R",), tile=((0, 0), (0,))),
            r"tile = \[\[0, 0\], \[0\]\]: must have rows of one length",
        ),
        (lambda: Pattern(name="a", channels=("R", "G"), tile=((0, 0),)), "every index 0 to 1"),
        (lambda: interpolate(np.zeros((8, 8)), LONG, "W"), r"must hold the \(9, 1\) tile"),
    ):
        with pytest.raises(InputError, match=sentence):
            bad()


# ---------------------------------------------------------------------------------------------------- kernels

RED_BLUE = [[1 / 4, 1 / 2, 1 / 4], [1 / 2, 1, 1 / 2], [1 / 4, 1 / 2, 1 / 4]]
GREEN = [[0, 1 / 4, 0], [1 / 4, 1, 1 / 4], [0, 1 / 4, 0]]


@pytest.mark.parametrize("name", BAYER)
@pytest.mark.parametrize("at", [(6, 6), (6, 7), (7, 6), (7, 7)])
def test_one_defect_spreads_by_the_published_bilinear_kernel_in_its_own_plane(
    name: str, at: tuple[int, int]
) -> None:
    # Chapman et al.'s spread of a hot pixel: exact, quarters being exact in float32
    p = pattern(name)
    raw = np.zeros((14, 14), np.float32)
    raw[at] = 1
    rgb = demosaic(raw, p)
    own = int(channel_of(p, raw.shape)[at])
    expected = np.zeros((14, 14, 3))
    expected[at[0] - 1 : at[0] + 2, at[1] - 1 : at[1] + 2, own] = GREEN if own == 1 else RED_BLUE
    np.testing.assert_array_equal(rgb, expected)
    assert rgb.dtype == np.float32


def test_malvar_kernels_keep_flat_fields_and_their_symmetry() -> None:
    for kernel in (module.MALVAR_GREEN, module.MALVAR_ALONG_ROW, module.MALVAR_ACROSS):
        assert kernel.sum() == 1
        np.testing.assert_array_equal(kernel, kernel[::-1])
        np.testing.assert_array_equal(kernel, kernel[:, ::-1])


@pytest.fixture(scope="module")
def oracle() -> ModuleType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it imports from a deprecated scipy namespace
        return pytest.importorskip(
            "colour_demosaicing", reason="colour-demosaicing (extra 'test') is not installed"
        )


@pytest.mark.parametrize("name", BAYER)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("levels", [65536, 3])  # with three levels, directions are often equally rough
def test_bayer_methods_agree_with_colour_demosaicing(
    oracle: ModuleType, name: str, method: str, levels: int
) -> None:
    # the package mirrors with the outermost pixel repeated, which swaps the filters at the border: it gets
    # the mosaic already mirrored as is done here. A height of 131 is two blocks of rows and 3 rows more
    raw = np.random.default_rng(1).integers(0, levels, (131, 75)).astype(np.uint16)
    padded = np.pad(raw.astype(np.float64), 16, mode="reflect")
    theirs = {
        "bilinear": oracle.demosaicing_CFA_Bayer_bilinear,
        "malvar": oracle.demosaicing_CFA_Bayer_Malvar2004,
        "menon": oracle.demosaicing_CFA_Bayer_Menon2007,
    }[method](padded, name)[16:-16, 16:-16]
    ours = demosaic(raw, pattern(name), method)
    # halves, quarters and sixteenths of 16 bit integers are exact in float32; Menon's thirds are not: its three
    # steps in thirds of numbers below 2^18 err by 2^-24 of them each, some 0.05 in all
    assert np.abs(ours - theirs).max() <= (0.05 if method == "menon" else 0)


@pytest.mark.parametrize(("name", "method"), FITTING)
def test_a_flat_colour_stays_flat_up_to_the_borders(name: str, method: str) -> None:
    p = pattern(name)
    colour = np.array([100, 200, 48, 350][: len(p.channels)], np.float32)
    for shape in ((20, 22), (21, 23), (70, 6)):
        raw = sample(np.broadcast_to(colour, (*shape, len(colour))).copy(), p)
        rgb = demosaic(raw, p, method)
        expected = np.full(3, 100) if name == "mono" else colour[:3]
        # a mean of n float32 numbers by way of weights and their reciprocal: some 1e-6
        np.testing.assert_allclose(rgb, np.broadcast_to(expected, rgb.shape), rtol=2e-6)


@pytest.mark.parametrize("name", ["rggb", "gbrg", "rgb_nir"])
def test_bilinear_reproduces_planes_that_rise_linearly(name: str) -> None:
    p = pattern(name)
    y, x = np.indices((24, 30), dtype=np.float32)
    planes = np.stack([3 * x + 5 * y + 7, 11 * x - 2 * y + 90, 4 * y - x + 60, 6 * x + 8], axis=-1)
    raw = sample(planes[..., : len(p.channels)], p)
    rgb = demosaic(raw, p)
    # single-filter planes interpolate between pixels two apart; the borders extrapolate and do not
    np.testing.assert_allclose(rgb[2:-2, 2:-2], planes[2:-2, 2:-2, :3], rtol=2e-6)


@pytest.mark.parametrize("name", BAYER)
@pytest.mark.parametrize("axis", [0, 1])
def test_menon_interpolates_along_edges(name: str, axis: int) -> None:
    # a grey scene that varies along one axis only, without any smoothness, is measured whole along the other:
    # the right direction gives it back, to rounding of the thirds. Rounding alone would leave 0.01 of 1000
    profile = np.random.default_rng(5).integers(0, 1000, 40).astype(np.float32)
    grey = np.broadcast_to(profile[:, None] if axis == 0 else profile, (40, 40))
    raw = sample(np.repeat(grey[..., None], 3, axis=2), pattern(name))
    error = {m: np.abs(demosaic(raw, pattern(name), m) - grey[..., None]).max() for m in METHODS}
    assert error["menon"] < 1e-3
    assert error["bilinear"] > 100
    assert error["malvar"] > 100


@pytest.mark.parametrize(("name", "method"), FITTING)
def test_measured_values_stay_and_the_mosaic_is_not_edited(name: str, method: str) -> None:
    p = pattern(name)
    raw = random_raw()
    before = raw.copy()
    rgb = demosaic(raw, p, method)
    np.testing.assert_array_equal(raw, before)
    own = channel_of(p, raw.shape)
    for index, channel in enumerate(p.channels):
        if channel in "RGB":
            plane = rgb[..., "RGB".index(channel)]
            np.testing.assert_array_equal(plane[own == index], raw[own == index])
        np.testing.assert_array_equal(interpolate(raw, p, channel)[own == index], raw[own == index])


def test_intensity_of_rgbw_is_white_or_the_mean_of_its_four_white_neighbours() -> None:
    raw = random_raw().astype(np.float64)
    intensity = interpolate(raw, pattern("rgbw"), "W")
    mean = (raw[:-2, 1:-1] + raw[2:, 1:-1] + raw[1:-1, :-2] + raw[1:-1, 2:]) / 4
    white = channel_mask(pattern("rgbw"), raw.shape, "W")[1:-1, 1:-1]
    np.testing.assert_allclose(intensity[1:-1, 1:-1], np.where(white, raw[1:-1, 1:-1], mean), rtol=2e-6)
    # in the corner without white only its two neighbours are there
    raw = np.roll(raw, 1, axis=1)
    shifted = Pattern(name="w", channels=("A", "W"), tile=((0, 1), (1, 0)))
    assert interpolate(raw, shifted, "W")[0, 0] == pytest.approx((raw[0, 1] + raw[1, 0]) / 2, rel=2e-6)


def test_monochrome_is_the_plane_itself() -> None:
    raw = random_raw()
    np.testing.assert_array_equal(demosaic(raw, pattern("mono")), np.repeat(raw[..., None], 3, axis=2))
    np.testing.assert_array_equal(interpolate(raw, pattern("mono"), "W"), raw)


@pytest.mark.parametrize("name", ["rggb", "GBRG"])
def test_interpolated_bayer_channels_are_the_bilinear_ones_inside(name: str) -> None:
    # normalised convolution by the narrowest tent is bilinear interpolation: only the borders differ
    raw = random_raw()
    rgb = demosaic(raw, pattern(name))
    for index, channel in enumerate("RGB"):
        plane = interpolate(raw, pattern(name), channel)
        np.testing.assert_allclose(plane[2:-2, 2:-2], rgb[2:-2, 2:-2, index], rtol=2e-6)


def edges(shape: tuple[int, int] = (40, 44)) -> list[np.ndarray]:
    """Bright sides, bool[y, x]: straight, diagonal and slanted edges, corners, a strut of 3 px, a line, a point, a
    hole; the straight ones at both phases of a tile."""
    y, x = np.indices(shape)
    straight = [x > 20, x > 21, y > 17, y > 18, x < 21, y < 17]
    slanted = [x + y > 40, x + y > 41, x > y + 2, x < y + 2, y + 2 * x > 60]
    thin = [np.abs(x - 20) <= 1, np.abs(y - 21) <= 1, np.abs(x - y) <= 1, x == 20, (x == 20) & (y == 20)]
    return [*straight, *slanted, *thin, (x > 15) & (y > 17), (x > 15) | (y > 17), (x - 20) ** 2 + (y - 20) ** 2 > 2]


def bounded(raw: np.ndarray, p: Pattern, method: str, **known: Any) -> np.ndarray:
    return bounded_at_edges(demosaic(raw, p, method), raw, p, method, **known)  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "method"), FITTING)
def test_the_dark_side_of_a_hard_edge_stays_as_dark_as_it_is(name: str, method: str) -> None:
    # 10,000:1, as a sunlit foot before shaded ground
    p, black, dark, lowest = pattern(name), 64.0, 1.0, np.inf
    for bright in edges():
        raw = (black + np.where(bright, 1e4 * dark, dark)).astype(np.float32)
        published = demosaic(raw, p, method)
        kept = bounded(raw, p, method, black=black, noise=0.5)
        assert kept.min() >= black + dark * (1 - 1e-3)
        # what is bright keeps its interpolated values, but for those below all of their own colour
        high = bright[..., None] & (published >= black + dark)
        assert np.array_equal(kept[high], published[high])
        if p.is_bayer:  # no colour is measured farther than one pixel away: a false bright rim is none either
            away = ~cv2.dilate(bright.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
            assert kept[away].max(initial=0) <= black + dark * (1 + 1e-3)
        lowest = min(lowest, float(published.min()))
    assert (lowest < black - 100 * dark) == (method != "bilinear")  # so there is something to mend


@pytest.mark.parametrize("ratio", [3.0, 6.0, 7.9])
@pytest.mark.parametrize("method", METHODS)
def test_edges_below_the_hard_ratio_give_no_negative_light(method: str, ratio: float) -> None:
    for name in BAYER:
        for bright in edges():
            raw = np.where(bright, ratio * 1000, 1000).astype(np.float32)
            assert bounded(raw, pattern(name), method, black=0.0, noise=4.0).min() >= 0


# Bright colours that reach full scale. The white balance of the class makes green the first.
CLIPPED = ("G", "RG", "GB", "RB", "RGB")


@pytest.mark.parametrize("clipped", CLIPPED)
@pytest.mark.parametrize("method", METHODS)
def test_the_dark_side_of_a_clipped_edge_has_no_rim(method: str, clipped: str) -> None:
    # colours that end at the same full scale do not rise by the same amount, as the kernels assume
    black, top, balance = 70.0, 4095.0, np.array([1.43, 1.0, 1.35])
    shown = 255 / (top - black) * balance
    bright_dn = np.where([c in clipped for c in "RGB"], 2 * top, 0.98 * (top - black) / balance)
    inside, lowest = np.s_[3:-3, 3:-3], 0.0  # beyond its borders the mirrored mosaic has other edges
    for name in BAYER:
        p = pattern(name)
        for bright in edges():
            for dark in (0.0, 1.0, 30.0, 100.0, 155.0, 225.0, 245.0):  # of 255; the brighter side is above
                planes = black + np.where(bright[..., None], bright_dn, dark / shown)
                raw = np.minimum(sample(planes.astype(np.float32), p), np.float32(top))
                if bright.sum() == 1 and raw.max() < top:
                    continue  # the point is a pixel of a colour that is not clipped
                published, kept = (
                    (((rgb - black) * shown - dark)[inside])[~bright[inside]]
                    for rgb in (
                        demosaic(raw, p, method),  # type: ignore[arg-type]
                        bounded(raw, p, method, black=black, noise=3.9, clipped=raw >= top),
                    )
                )
                assert kept.min(initial=0) > -1e-2  # rounding of float32 at 4095, not the 1 DN that is asked for
                lowest = min(lowest, float(published.min(initial=0)))
    assert (lowest < -20) == (method != "bilinear")  # so there is something to mend


@pytest.mark.parametrize("method", ["malvar", "menon"])
def test_bounds_beside_clipped_pixels_bring_noise_nearer_to_its_mean(method: str) -> None:
    # one saturated pixel in 24 rows and columns: its surroundings are bounded from both sides
    p, rng = pattern("rggb"), np.random.default_rng(8)
    raw = rng.normal(1000, 30, (480, 480)).astype(np.float32)
    clipped = np.zeros(raw.shape, bool)
    clipped[12::24, 12::24] = True
    raw[clipped] = 4095
    near = cv2.dilate(clipped.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
    beside = footprint(clipped, p, method) & ~near  # type: ignore[arg-type]  # no colour is clipped within one pixel
    published = demosaic(raw, p, method)[beside]  # type: ignore[arg-type]
    kept = bounded(raw, p, method, black=0.0, noise=30.0, clipped=clipped)[beside]
    shift, before = abs(kept.mean() - 1000), abs(published.mean() - 1000)
    # the least of two to four measured values lies 0.56 to 1.03 standard deviations below their mean
    assert shift < 0.56 * 30
    # 4 standard errors; values share measured neighbours, at most 25 each
    assert shift < max(before, 4 * 30 / np.sqrt(kept.size / 25))
    assert np.abs(kept - 1000).max() <= np.abs(raw[~clipped] - 1000).max()


@pytest.mark.parametrize(("name", "method"), FITTING)
def test_noise_without_edges_is_demosaiced_as_published(name: str, method: str) -> None:
    # darkness and light of a flat field: a bound from below alone would brighten them
    p, rng = pattern(name), np.random.default_rng(5)
    for level in (0.0, 30.0, 3000.0):
        raw = (64 + level + rng.normal(0, np.hypot(3.0, np.sqrt(level)), (120, 120))).astype(np.float32)
        published = demosaic(raw, p, method)  # type: ignore[arg-type]
        for clipped in (None, np.zeros(raw.shape, bool)):
            kept = bounded_at_edges(published.copy(), raw, p, method, black=64.0, noise=3.0, clipped=clipped)  # type: ignore[arg-type]
            assert np.array_equal(kept, published)


# ------------------------------------------------------------------------------------------------- footprints


def changed(raw: np.ndarray, mask: np.ndarray, p: Pattern, method: str, value: float) -> np.ndarray:
    other = np.where(mask, value, raw)
    # as a detector shows them, bounded at hard edges
    one, two = (bounded(a, p, method, black=0.0, noise=1.0, clipped=a >= 65_000) for a in (raw, other))
    out = (one != two).any(axis=2)
    for channel in set(p.channels) - set("RGB"):
        out |= interpolate(raw, p, channel) != interpolate(other, p, channel)
    return out


def defects_apart(shape: tuple[int, int]) -> np.ndarray:
    """Corners and borders; every filter; far apart, so that no two changes cancel."""
    mask = np.zeros(shape, bool)
    mask[::12, ::11] = mask[-1, -1] = mask[31, 30] = True
    return mask


@pytest.mark.parametrize(("name", "method"), [f for f in FITTING if f[1] == "bilinear"])
def test_footprint_of_the_linear_method_is_what_changes(name: str, method: str) -> None:
    p = pattern(name)
    raw = random_raw((70, 60)).astype(np.float32)
    mask = defects_apart(raw.shape)
    np.testing.assert_array_equal(footprint(mask, p, method), changed(raw, mask, p, method, 3e5))
    assert not footprint(np.zeros_like(mask), p, method).any()


@pytest.mark.parametrize("name", BAYER)
def test_footprint_of_malvar_is_its_kernels_and_what_shows_a_clipped_edge(name: str) -> None:
    p = pattern(name)
    raw = random_raw((70, 60)).astype(np.float32)
    mask = defects_apart(raw.shape)
    where = footprint(mask, p, "malvar")
    seen = np.zeros_like(mask)
    for scene in (raw, raw / 1000, cv2.GaussianBlur(raw, (5, 5), 0)):
        for value in (0.0, 300.0, 3e5):
            seen |= changed(scene, mask, p, "malvar", value)
            seen |= (demosaic(scene, p, "malvar") != demosaic(np.where(mask, value, scene), p, "malvar")).any(
                axis=2
            )
    assert not (seen & ~where).any()
    # 21 pixels inside, of which the kernels weight at least 9
    assert where[29:34, 28:33].sum() == 21
    assert seen.sum() > 0.5 * where.sum()
    assert not footprint(np.zeros_like(mask), p, "malvar").any()


@pytest.mark.parametrize("name", BAYER)
def test_footprint_of_menon_holds_whatever_changes(name: str) -> None:
    p = pattern(name)
    mask = np.zeros((80, 70), bool)
    mask[8::21, 9::20] = True  # all four filters, 20 px apart: one footprint does not hide in another's
    mask[0, 0] = mask[-1, -1] = mask[0, 33] = mask[44, 0] = True
    where = footprint(mask, p, "menon")
    seen = np.zeros_like(mask)
    # weak and strong defects, on flat, noisy and smooth pictures, so that decisions flip
    scenes = [
        random_raw(mask.shape, seed).astype(np.float32) / s for seed, s in ((1, 1), (2, 1000), (3, 1), (4, 50))
    ]
    scenes += [cv2.GaussianBlur(s, (5, 5), 0) for s in scenes]
    for scene in scenes:
        for value in (0.0, 300.0, 70_000.0, 1e6):
            now = changed(scene, mask, p, "menon", value)
            assert not (now & ~where).any()
            seen |= now
    # a superset, not the whole picture: a fair part is seen to change
    assert seen.sum() > 0.3 * where.sum()
    assert where[8 + 8, 9]
    assert not where[8 + 9, 9]


# --------------------------------------------------------------------------------------------- defect mending


def test_a_defect_takes_its_same_coloured_neighbours_value() -> None:
    raw = random_raw((12, 12))
    bad = np.zeros(raw.shape, bool)
    bad[4, 4] = bad[4, 5] = bad[4, 6] = True
    got = correct_defects(raw, bad, pattern("rggb"))
    red = [raw[y, x] for y in (2, 4, 6) for x in (2, 4, 6) if (y, x) not in ((4, 4), (4, 6))]
    green = [raw[y, x] for y in range(2, 7) for x in range(3, 8) if (y + x) % 2 == 1 and (y, x) != (4, 5)]
    assert len(red) == 7
    assert len(green) == 12
    assert got[4, 4] == np.rint(np.median(red))
    assert got[4, 5] == np.rint(np.median(green))
    assert got.dtype == raw.dtype
    np.testing.assert_array_equal(got[~bad], raw[~bad])


@pytest.mark.parametrize("name", PATTERNS)
def test_mending_gives_a_flat_colour_back(name: str) -> None:
    p = pattern(name)
    colour = np.array([100, 200, 48, 350][: len(p.channels)], np.float32)
    raw = sample(np.broadcast_to(colour, (96, 96, len(colour))).copy(), p)
    bad = np.random.default_rng(2).random(raw.shape) < 0.05
    bad[:, 20] = bad[33] = bad[0, 0] = True
    mended = correct_defects(np.where(bad, 4095, raw), bad, p)
    np.testing.assert_array_equal(mended, raw)
    spread = demosaic(np.where(bad, 4095, raw), p)
    assert np.abs(spread - demosaic(mended, p)).max() > 1000  # what mending is for


def test_what_lies_too_far_from_any_good_pixel_is_left() -> None:
    p = pattern("rggb")
    raw = np.full((128, 128), 7, np.uint16)
    bad = np.zeros(raw.shape, bool)
    bad[:, :100] = True
    raw[bad] = 0
    mended = correct_defects(raw, bad, p)
    np.testing.assert_array_equal(mended[:, 92:], 7)  # four tiles of two pixels
    np.testing.assert_array_equal(mended[:, :92], 0)
    everything = np.ones_like(bad)
    np.testing.assert_array_equal(correct_defects(raw, everything, p), raw)
    np.testing.assert_array_equal(correct_defects(raw, ~everything, p), raw)


@pytest.mark.parametrize("name", PATTERNS)
def test_mended_pixels_know_what_they_are_made_of(name: str) -> None:
    p = pattern(name)
    rng = np.random.default_rng(3)
    raw = rng.integers(0, 4096, (64, 64)).astype(np.uint16)
    bad = rng.random(raw.shape) < 0.1
    bad[20:50, 30:52] = True  # those inside look four times as far
    changed = rng.random(raw.shape) < 0.01
    other = np.where(changed, raw ^ 2048, raw).astype(np.uint16)
    differs = correct_defects(raw, bad, p) != correct_defects(other, bad, p)
    told = mended_from(changed, bad, p)
    assert not (differs & bad & ~told & ~changed).any()
    # one changed neighbour of several may leave the median as it is
    assert (differs & told).sum() > 0.2 * told.sum()
    assert not mended_from(np.zeros_like(bad), bad, p).any()
