"""Samples by the sensor's noise: cells of pixels, their numbers of samples, the exposure foreseen for them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import recorded_calls, small_scene
from test_light import limb
from test_render import NODES, UP, box, join, plane, scene, view

from vbnfault import render
from vbnfault.camera import Camera
from vbnfault.core import frames
from vbnfault.pipeline import Session, noise_budget
from vbnfault.pipeline.exposure import exposure_s, foreseen_exposure_s, meter
from vbnfault.pipeline.rendering import describe, render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.reflectance.hapke import hapke_at
from vbnfault.render import light as cell_module
from vbnfault.render.description import RenderInput
from vbnfault.render.sampling import Pixels, Strata, limb_sets
from vbnfault.scene import config

WEIGHTS = np.ones(len(NODES))


def boxed(width: int = 16, **more: object) -> tuple[render.TerrainMesh, RenderInput]:
    """A box on a plane with its shadow, under a limb-darkened Sun."""
    light = dataclasses.replace(limb(2.99), direction_L=frames.direction_L(30, 35))
    a_view = view(12 * UP + np.array([3.0, 0, 0]), -UP, width=width, fov_deg=30.0)
    return join(plane(), box(np.array([0, 0, -1.0]), 1.0)), scene(a_view, light, hapke_at(NODES), **more)


def all_cells(pixels: int, side: int = 4) -> render.Cells:
    count = side * side
    return render.Cells(
        pixel=np.repeat(np.arange(pixels, dtype=np.uint32), count),
        cell=np.tile(np.arange(count, dtype=np.uint32), pixels),
        side=side,
    )


@pytest.mark.parametrize("samples", [1, 2, 16])
def test_cells_have_the_light_of_their_pixel(samples: int) -> None:
    """The mean over cells and random keys is that of 4096 samples, in every band; the error is as estimated."""
    surface, a_scene = boxed()
    pixels, keys = 16 * 16, 16
    truth = render.direct(surface, dataclasses.replace(a_scene, samples_per_pixel=4096)).array.reshape(8, -1)
    means, estimates = [], []
    for key in range(keys):
        keyed = dataclasses.replace(a_scene, key=0x51ED270B * (key + 1) & 0xFFFFFFFF)
        light, signal, error = render.direct_in_cells(surface, keyed, WEIGHTS, all_cells(pixels), samples)
        np.testing.assert_allclose(signal, light.sum(axis=0), rtol=1e-5, atol=1e-9)
        means.append(light.reshape(8, pixels, 16).mean(axis=2))
        estimates.append((error.reshape(pixels, 16) ** 2).sum(axis=1) / 256)
    found = np.mean(means, axis=0)
    square = np.mean([(m.sum(axis=0) - truth.sum(axis=0)) ** 2 for m in means], axis=0)
    # per band, the mean over all pixels: four standard errors, and a sixteenth of that again for the reference;
    # chosen by the mean limb darkening, a sample of the outermost bands has 6 % of noise of colour
    spread = np.sqrt(square.sum() / keys) / pixels / 8 * 4 * (17 / 16)
    colour = 4 * 0.06 * truth.mean(axis=1) / np.sqrt(16 * pixels * keys * samples)
    assert (np.abs(found.mean(axis=1) - truth.mean(axis=1)) < 2 * spread + colour).all()
    if samples > 1:
        # halves of cells tell the error to a factor of 1.5: two side by side also see how light changes across
        ratio = np.sqrt(np.mean(estimates) / square.mean())
        assert 0.7 < ratio < (1.6 if samples == 2 else 1.3)


def test_cells_do_not_depend_on_other_cells() -> None:
    surface, a_scene = boxed()
    chosen = all_cells(16 * 16)
    whole = render.direct_in_cells(surface, a_scene, WEIGHTS, chosen, 4)
    some = np.arange(5, len(chosen.pixel), 37)
    part = render.Cells(pixel=chosen.pixel[some], cell=chosen.cell[some], side=4)
    for got, of_all in zip(render.direct_in_cells(surface, a_scene, WEIGHTS, part, 4), whole, strict=True):
        np.testing.assert_array_equal(got, of_all[..., some])


@pytest.mark.parametrize(("samples", "columns", "rows"), [(1, 1, 1), (2, 2, 1), (8, 2, 2), (64, 2, 2)])
def test_quarters_of_cells_are_cells_of_half_the_size(samples: int, columns: int, rows: int) -> None:
    """Their mean is the signal, and where samples tell them apart, each is the light of a smaller cell."""
    surface, a_scene = boxed()
    pixels, keys, total = 16 * 16, 24, np.zeros((2, 16, 256, 4))
    for key in range(keys):
        keyed = dataclasses.replace(a_scene, key=0x51ED270B * (key + 1) & 0xFFFFFFFF)
        _, whole, _ = render.direct_in_cells(surface, keyed, WEIGHTS, all_cells(pixels), samples)
        _, quarters, _ = render.direct_in_cells(surface, keyed, WEIGHTS, all_cells(pixels), samples, quarters=True)
        np.testing.assert_allclose(quarters.mean(axis=1), whole, rtol=1e-5, atol=1e-6)
        _, small, _ = render.direct_in_cells(surface, keyed, WEIGHTS, all_cells(pixels, 8), 16)
        quarters = quarters.reshape(pixels, 4, 4, 2, 2).transpose(0, 1, 3, 2, 4)  # pixel, row, half, column, half
        small = small.reshape(pixels, 4, 2, 4, 2)
        if rows == 1:
            small = np.broadcast_to(small.mean(axis=2, keepdims=True), small.shape)
        if columns == 1:
            small = np.broadcast_to(small.mean(axis=4, keepdims=True), small.shape)
        for k, of in enumerate((quarters, small)):
            total[k] += of.reshape(pixels, 16, 4).transpose(1, 0, 2) / keys
    # A sample of a cell that a shadow's edge crosses is off by half the light (1 σ), so the mean of all keys and of
    # the samples in a quarter by this over √(24 · samples / 4). A hundred cells of 4,096 have edges: at most 3 σ.
    light = total[1].max()
    assert np.abs(total[0] - total[1]).max() < 3 * 0.5 * light / np.sqrt(keys * max(samples / 4, 1))
    if rows > 1:
        apart = total[1][..., 0] - total[1][..., 3]
        assert np.corrcoef(apart.ravel(), (total[0][..., 0] - total[0][..., 3]).ravel())[0, 1] > 0.95


def test_points_of_the_sun_are_as_dense_as_it_is_bright() -> None:
    """Radii against the closed form ∫ Σ A_k μ^k d(μ²), and one point in each ring of equal light."""
    coefficients = tuple(limb(2.99).limb_darkening[4].tolist())  # type: ignore[index]
    for samples in (1, 4, 64):
        points = limb_sets(samples, 0, coefficients)
        mu = np.sqrt(1 - (points**2).sum(axis=2))
        within = sum(a * 2 / (k + 2) * (1 - mu ** (k + 2)) for k, a in enumerate(coefficients))
        within = within / sum(a * 2 / (k + 2) for k, a in enumerate(coefficients))
        np.testing.assert_array_equal(np.sort((within * samples).astype(int), axis=1)[0], np.arange(samples))
        # all sets together are even to half a step
        assert (
            np.abs(np.sort(within.ravel()) - (np.arange(within.size) + 0.5) / within.size).max() < 1 / within.size
        )


@pytest.mark.parametrize("first", [5, (1 << 20) + 7, (1 << 24) - 3])
def test_many_samples_stay_in_their_pixel(first: int) -> None:
    """A frame of 1024 pixels and its guard band has more than 2²⁰ pixels; times 4096 this exceeds 2³²."""
    strata = Strata(Pixels(2, first), 4096, 1)
    np.testing.assert_array_equal(np.array(strata.pixel).reshape(2, -1)[:, ::1000], [[first] * 5, [first + 1] * 5])


def test_samples_go_where_light_varies() -> None:
    """The goal is reached with fewer samples than with one number for all cells."""
    rng = np.random.default_rng(3)
    squares = (rng.random((200, 16)) ** 6).astype(np.float32)
    goal = rng.uniform(0.001, 0.3, 200).astype(np.float32)
    numbers = noise_budget._allocated(squares, goal, 1 << 20)
    assert (numbers & (numbers - 1) == 0).all()
    assert (np.diff(np.take_along_axis(numbers, squares.argsort(axis=1), axis=1), axis=1) >= 0).all()
    left = (squares * numbers**-1.5).sum(axis=1) / squares.sum(axis=1)
    # rounding down by a quarter of an octave at most leaves 2^(3/8) of the variance
    assert (left < 2**0.375 * goal).all()
    even = 2 ** np.ceil(np.log2(goal ** (-2 / 3)))
    assert (numbers.sum(axis=1) <= 16 * even).all()
    assert numbers.sum() < 0.6 * 16 * even.sum()
    # at the limit of a pixel, cells keep their order and their sum stays within it
    limited = noise_budget._allocated(squares, goal, 256)
    assert (limited.sum(axis=1) <= 256).all()
    assert limited.max() > 256 / 16
    assert (limited <= numbers).all()


def physical(**tables: dict[str, object]) -> config.Scene:
    base = {
        "body": {"photometry": {"model": "hapke"}},
        "camera": {
            "width_px": 64,
            "height_px": 64,
            "lens": "nikkor_28_f2p8_camera",
            "detector": "cmv4000",
            "exposure_max_s": 0.015,
        },
        "render": {"samples_per_pixel": 16, "noise_fraction": 0.3, "max_samples_per_pixel": 4096},
    }
    merged = {name: {**base.get(name, {}), **tables.get(name, {})} for name in {*base, *tables}}
    return config.parse_scene({**small_scene(**merged), "faults": {}}, source="test")


def test_a_view_takes_fewer_samples_than_by_whole_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count samples: those of all pixels once, and in cells far fewer than as many in every cell of the pixel."""
    taken, whole = [], []
    count = cell_module.CellStrata.__init__

    def counted(self: cell_module.CellStrata, cells: render.Cells, samples: int, *more: object) -> None:
        taken.append(len(cells.pixel) * samples)
        count(self, cells, samples, *more)

    allocated = noise_budget._allocated

    def noted(*inputs: object) -> np.ndarray:
        numbers = allocated(*inputs)
        whole.append(int(16 * numbers.max(axis=1).sum()) if len(numbers) else 0)
        return numbers

    monkeypatch.setattr(cell_module.CellStrata, "__init__", counted)
    monkeypatch.setattr(noise_budget, "_allocated", noted)
    session = Session(physical())
    for index in range(2):
        spec = session.spec(index)
        rendering = render_view(spec, resolve(spec))
        view_ = rendering.scene.view
        pixels = view_.width_px * view_.height_px
        assert rendering.samples_per_pixel * pixels <= 16 * pixels + sum(taken)
    assert sum(taken) > 0
    assert sum(taken) < 0.75 * sum(whole)


def test_bits_do_not_depend_on_how_many_cells_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light of cells is summed in parts, to bound memory; a part never divides a pixel."""
    chosen = np.random.default_rng(5).random((40, 16)) < 0.6
    chosen[7:20] = False
    monkeypatch.setattr(noise_budget, "_CELLS_AT_ONCE", 21)
    spans = list(noise_budget._spans(chosen))
    assert [span.start for span in spans] == [0, *(span.stop for span in spans[:-1])]
    assert spans[-1].stop == len(chosen)
    assert max(chosen[span].sum() for span in spans) <= 21
    session = Session(physical())
    spec = session.spec(0)
    pose = resolve(spec)
    divided = render_view(spec, pose).light.rendered.array
    monkeypatch.undo()
    np.testing.assert_array_equal(divided, render_view(spec, pose).light.rendered.array)


def test_only_the_last_round_exceeds_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three rounds of a view that stays too noisy: the limit twice, then twice the limit."""
    allocated = recorded_calls(monkeypatch, noise_budget, "_allocated")
    session = Session(physical(render={"noise_fraction": 0.02, "max_samples_per_pixel": 64}))
    spec = session.spec(0)
    render_view(spec, resolve(spec))
    assert [most for *_, most in allocated] == [64, 64, 128]


def test_the_exposure_is_foreseen_without_imaging(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exposure within 3 %, though the lens images the render once a sample, for the metering."""
    imaged = recorded_calls(monkeypatch, Camera, "expose")
    session = Session(physical(camera={"exposure_max_s": 10.0}))
    for index in range(3):
        spec = session.spec(index)
        pose = resolve(spec)
        imaged.clear()
        rendering = render_view(spec, pose)
        assert not imaged
        exposure = meter(spec, rendering)
        assert len(imaged) == 1
        radiance = rendering.light.rendered
        foreseen = foreseen_exposure_s(
            spec.scene, spec.camera, rendering.truth, describe(spec, pose).view, radiance
        )
        metered = exposure_s(spec.scene, spec.camera, rendering.truth, exposure.rate.merged)
        # the point spread mixes edges of shadows, which moves a percentile of 64 × 64 pixels by a few percent
        assert foreseen == pytest.approx(metered, rel=0.03)
