"""Straylight textures: where they land, in which order, how bright."""

from __future__ import annotations

import hashlib
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import tifffile
from test_faults_kit import flat_electrons, make, make_context, rng

from vbnfault.core.errors import InputError
from vbnfault.core.files.images import write_png
from vbnfault.core.files.resources import data_dir
from vbnfault.core.files.user_files import sha256
from vbnfault.dataset.identity import _contents_of_fault
from vbnfault.faults import from_dict
from vbnfault.faults.straylight import CLOSE, FAR, flare_centres_px, texture
from vbnfault.scene import config

# The script that draws the packaged textures; it is no part of the package.
SCRIPT = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "flare_textures.py"))
STEP, TEXTURES, make_texture = SCRIPT["STEP"], SCRIPT["TEXTURES"], SCRIPT["make"]

# The paper's table of the parameters of its full example.
PAPER_EXAMPLE = [
    {"index": 3, "position": 0.83, "radius": 0.11, "brightness": 1.5},
    {"index": 4, "position": 1.00, "radius": 0.13, "brightness": 1.5},
    {"index": 5, "position": 1.17, "radius": 0.16, "brightness": 1.5},
]


def added(context, params, fault) -> np.ndarray:  # type: ignore[no-untyped-def]
    """What a black image gains, in units of white, float32[y, x, 3]."""
    black = flat_electrons(context, 0.0)
    return fault.apply(black, params, context).array / black.white_e


def one(index: int, position: float = 1.0, radius: float = 0.1, brightness: float = 1.5, **table: object):  # type: ignore[no-untyped-def]
    row = {"index": index, "position": position, "radius": radius, "brightness": brightness}
    return make("straylight", flares=[row], glare=0, **table)


@pytest.mark.parametrize("index", [1, 3, 5, 6, 9])  # flares symmetric about their centre
@pytest.mark.parametrize(
    ("width", "height", "sun", "position", "radius"),
    [
        (1024, 1024, (200.3, 300.7), 0.83, 0.11),
        (1024, 768, (700.0, -50.25), 1.2, 0.3),
        (400, 300, (33.4, 201.9), 1.37, 0.05),
        (200, 200, (20.123, 20.456), 0.71, 0.16),
    ],
)
def test_centroid(
    index: int, width: int, height: int, sun: tuple[float, float], position: float, radius: float
) -> None:
    context = make_context(width, height, sun_xy_px=sun)
    fault = one(index, position, radius)
    params = fault.draw(context, rng())
    expected = np.array(sun) + position * (np.array([width / 2, height / 2]) - sun)
    assert flare_centres_px(params, np.array(sun))[0] == pytest.approx(expected)
    plane = added(context, params, fault)[..., 1].astype(float)
    y, x = np.mgrid[:height, :width] + 0.5
    centroid = np.array([(plane * x).sum(), (plane * y).sum()]) / plane.sum()
    # bilinear sampling keeps the centroid of a smooth texture, but for OpenCV's steps of 1/32 texel: at most
    # half a step, at most 1.8 px a texel here, so 0.03 px
    assert np.abs(centroid - expected).max() < 0.05


def test_radius_is_that_of_the_outline() -> None:
    context = make_context(1024, sun_xy_px=(200.0, 512.0))
    fault = one(2, radius=0.2)
    plane = added(context, fault.draw(context, rng()), fault)[512, :, 1]
    lit = np.flatnonzero(plane > plane.max() / 2)
    # green is 2 % smaller than red, which reaches radius 1, and fades over the last 12 %
    assert (lit[-1] - lit[0]) / 2 == pytest.approx(0.2 * 1024 * 0.93, rel=0.03)


def test_texture_axis_follows_the_line() -> None:
    # flare 10, a pupil clipped on the Sun's side: its light lies beyond its centre, seen from the Sun
    for sun in ((100.0, 512.0), (512.0, 100.0), (900.0, 900.0)):
        context = make_context(1024, sun_xy_px=sun)
        fault = one(10, radius=0.15)
        plane = added(context, fault.draw(context, rng()), fault)[..., 1].astype(float)
        y, x = np.mgrid[:1024, :1024] + 0.5
        centroid = np.array([(plane * x).sum(), (plane * y).sum()]) / plane.sum()
        outward = (np.array([512.0, 512.0]) - sun) / np.hypot(*(np.array([512.0, 512.0]) - sun))
        offset = centroid - 512
        assert offset @ outward > 30
        assert abs(offset @ [-outward[1], outward[0]]) < 0.1


def test_brightness_and_visible_fraction_scale_the_light() -> None:
    context = make_context(256, sun_xy_px=(60.0, 60.0))
    base = added(context, one(4).draw(context, rng()), one(4))
    assert base.max() == pytest.approx(1.5 * texture("flare_04").levels[0].max(), rel=0.05)
    bright = one(4, brightness=3.0)
    assert np.allclose(added(context, bright.draw(context, rng()), bright), 2 * base, rtol=1e-5, atol=1e-8)
    half = make_context(256, sun_xy_px=(60.0, 60.0), sun_visible_fraction=0.5)
    dim = added(half, one(4).draw(half, rng()), one(4))
    assert np.allclose(dim, 0.5 * base, rtol=1e-5, atol=1e-8)
    for context in (make_context(256, sun_xy_px=(60.0, 60.0), sun_visible_fraction=0.0), make_context(256)):
        fault = one(4)
        params = fault.draw(context, rng())
        assert not added(context, params, fault).any()
        assert not fault.footprint(params, context).any()


def own(folder: Path, name: str, colour: tuple[float, float, float], shape: tuple[int, int] = (60, 60)) -> str:
    """A rectangle of one colour, as a user's own texture."""
    image = np.broadcast_to(np.rint(np.array(colour) * 65535).astype(np.uint16), (*shape, 3))
    return str(write_png(folder / f"{name}.png", image))


def test_own_textures_lie_on_the_line_of_the_sun(tmp_path: Path) -> None:
    """Their own size, side and colours; the light is brightness · texture, with the Sun's line to the right."""
    context = make_context(512, sun_xy_px=(56.0, 256.0))
    wide = own(tmp_path, "wide", (0.5, 0.25, 0.125), shape=(40, 100))
    glare = own(tmp_path, "glare", (0.0, 0.0, 0.2))
    row = {"index": 1, "position": 1.0, "radius": 0.1, "brightness": 1.2}
    fault = make("straylight", flares=[row], glare=0, far_textures=wide)
    light = added(context, fault.draw(context, rng()), fault)
    # from 0.1 · 512 px on either side of the centre of the frame, and 0.4 of this above and below
    lit = light[..., 0] > 0.3
    assert np.flatnonzero(lit.any(axis=0))[[0, -1]] == pytest.approx([256 - 51, 256 + 50], abs=1)
    assert np.flatnonzero(lit.any(axis=1))[[0, -1]] == pytest.approx([256 - 20, 256 + 19], abs=1)
    np.testing.assert_allclose(light[256, 256], 1.2 * np.array([0.5, 0.25, 0.125]), rtol=1e-4)
    upright = make_context(512, sun_xy_px=(256.0, 56.0))  # turned with the line
    turned = added(upright, fault.draw(upright, rng()), fault)
    np.testing.assert_allclose(turned, light.swapaxes(0, 1), atol=2e-3)

    fault = make("straylight", count=0, glare=[1, 2], glare_textures=[glare], glare_brightness=1.0)
    for seed in range(4):  # glare 2 does not exist, so the first stands for it
        params = fault.draw(context, np.random.default_rng(seed))
        assert params["glare"]["index"] == 1
        np.testing.assert_allclose(added(context, params, fault)[256, 56], [0, 0, 0.2], atol=1e-4)


def test_own_textures_close_to_the_sun_stay_closer_than_far_ones(tmp_path: Path) -> None:
    close = [own(tmp_path, f"close_{k}", (0.1 * k, 0, 0)) for k in (1, 2, 3)]
    far = [own(tmp_path, f"far_{k}", (0, 0.1 * k, 0)) for k in (1, 2)]
    fault = make("straylight", count=[1, 10], close_textures=close, far_textures=far, glare=0)
    context, seen = make_context(256, sun_xy_px=(30.0, 128.0)), set()
    for seed in range(40):
        flares = fault.draw(context, np.random.default_rng(seed))["flares"]
        groups = [f["index"] > 3 for f in flares]
        assert groups == sorted(groups)
        assert [f["position"] for f in flares] == sorted(f["position"] for f in flares)
        assert len({f["index"] for f in flares}) == len(flares)
        seen |= {f["index"] for f in flares}
    assert seen == {1, 2, 3, 4, 5}
    assert from_dict("straylight", fault.to_dict(), source="t") == fault
    assert not {"close_textures", "glare_textures"} & make("straylight").to_dict().keys()


def test_own_textures_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    good, bright = own(tmp_path, "good", (0.5, 0.5, 0.5)), tmp_path / "bright.tif"
    tifffile.imwrite(bright, np.full((8, 8), 1.5, np.float32))
    for keys, said in (
        ({"close_textures": [good] * 6, "far_textures": [good] * 5}, "there are 11 textures; must be at most 10"),
        ({"glare_textures": [good] * 3}, "glare_textures: there are 3 textures; must be at most 2"),
        ({"close_textures": [good], "index": [2, 5]}, "index leaves 0 textures"),
        ({"far_textures": [str(tmp_path / "none.png")]}, r"far_textures: .*none\.png: texture file not found"),
        ({"far_textures": [str(bright)]}, r"far_textures: .*bright\.tif: has values that are .* above white"),
        (
            {"far_textures": [good], "flares": [PAPER_EXAMPLE[0]]},
            r"flares\[0\]\.index = 3: must be a whole number from 1 to 1",
        ),
    ):
        with pytest.raises(InputError, match=said):
            make("straylight", **keys)


def test_a_scene_takes_own_textures_from_its_folder_and_knows_their_contents(tmp_path: Path) -> None:
    own(tmp_path, "mine", (0.5, 0.5, 0.5))
    path = tmp_path / "scene.toml"
    path.write_text('title = "t"\n[faults.straylight]\nclose_textures = ["mine.png"]\n')
    scene = config.load_scene(path)
    assert scene.faults["straylight"]["close_textures"] == [str(tmp_path / "mine.png")]
    table = (fault := from_dict("straylight", scene.faults["straylight"], source="t")).to_dict()
    _contents_of_fault(table, fault, scene)
    first = table["close_textures"]
    own(tmp_path, "mine", (0.5, 0.5, 0.4))
    table = fault.to_dict()
    _contents_of_fault(table, fault, scene)
    assert first != table["close_textures"] == [f"sha256:{sha256((tmp_path / 'mine.png').read_bytes())}"]


def test_the_papers_example() -> None:
    context = make_context(1024, sun_xy_px=(250.0, 180.0))
    fault = make("straylight", flares=PAPER_EXAMPLE, glare=0)
    params = fault.draw(context, rng())
    assert params["flares"] == PAPER_EXAMPLE
    total = added(context, params, fault)
    parts = [make("straylight", flares=[row], glare=0) for row in PAPER_EXAMPLE]
    alone = sum(added(context, f.draw(context, rng()), f) for f in parts)
    assert np.abs(total - alone).max() < 1e-6
    mask = fault.footprint(params, context)
    gain_dn = total.max(axis=2) * 255
    clear = np.abs(gain_dn - 1) > 1e-4  # at the level itself, rounding decides
    assert np.array_equal(mask[clear], (gain_dn >= 1)[clear])  # type: ignore[index]


def test_draws_follow_the_table_and_keep_the_groups_apart() -> None:
    context = make_context(512, sun_xy_px=(100.0, 150.0))
    counts, glares = set(), set()
    for seed in range(300):
        params = make("straylight").draw(context, rng(seed))
        flares = params["flares"]
        counts.add(len(flares))
        glares.add(params["glare"]["index"] if params["glare"] else 0)
        index = [f["index"] for f in flares]
        assert len(set(index)) == len(index)
        assert set(index) <= set(CLOSE + FAR)
        for name, lo, hi in (("position", 0.5, 2), ("radius", 0.05, 0.3), ("brightness", 1.5, 2.5)):
            assert all(lo <= f[name] <= hi for f in flares)
        position = np.array([f["position"] for f in flares])
        radius = np.array([f["radius"] for f in flares])
        assert (np.diff(position) >= 0).all()
        assert (np.diff(radius) >= 0).all()
        far = np.isin(index, FAR)
        assert not far.any() or far.all() or position[~far].max() <= position[far].min()
    assert counts == set(range(1, 11))
    assert glares == {0, 1, 2}


@pytest.mark.parametrize("sun", [(20.0, 20.0), (-300.0, 900.0), (3000.0, 2000.0), (128.0, 128.0)])
def test_something_shows_whenever_it_can(sun: tuple[float, float]) -> None:
    context = make_context(256, sun_xy_px=sun)
    for seed in range(25):
        fault = make("straylight", count=1, glare=0)
        assert fault.footprint(fault.draw(context, rng(seed)), context).any()  # type: ignore[union-attr]


def test_glare_sits_at_the_sun_and_only_near_the_frame() -> None:
    context = make_context(512, sun_xy_px=(200.3, 150.8))
    fault = make("straylight", count=0, glare=1)
    params = fault.draw(context, rng())
    plane = added(context, params, fault)[..., 1].astype(float)
    y, x = np.mgrid[:512, :512] + 0.5
    core = plane > 0.5 * plane.max()
    weight = plane * core
    assert (weight * x).sum() / weight.sum() == pytest.approx(200.3, abs=0.3)  # the cut core is 20 px wide
    assert (weight * y).sum() / weight.sum() == pytest.approx(150.8, abs=0.3)
    far = make_context(512, sun_xy_px=(900.0, 150.0))
    assert make("straylight", glare=1, glare_radius=0.4).draw(far, rng())["glare"] is None
    near = make_context(512, sun_xy_px=(600.0, 150.0))
    assert make("straylight", glare=1, glare_radius=0.4).draw(near, rng())["glare"]


def test_bad_tables_are_refused() -> None:
    row = PAPER_EXAMPLE[0]
    with pytest.raises(InputError, match=r"flares\[0\]\.index = 3\.5: must be a whole number"):
        make("straylight", flares=[row | {"index": 3.5}])
    with pytest.raises(InputError, match=r"flares\[1\]\.index = 11"):
        make("straylight", flares=[row, row | {"index": 11}])
    with pytest.raises(InputError, match="index leaves 2 textures"):
        make("straylight", count=3, index=[4, 5])


# ---- the texture files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(TEXTURES))
def test_texture_can_be_made_again(name: str) -> None:
    made = make_texture(name).astype(np.int64)
    stored = np.rint(texture(name).levels[0].astype(np.float64) * 65535).astype(np.int64)
    # another machine's exp and cos may round a value over a step's edge
    assert np.abs(made - stored).max() <= STEP
    assert (made != stored).mean() < 1e-3
    rim = np.concatenate([stored[0], stored[-1], stored[:, 0], stored[:, -1]])
    assert not rim.any()


def test_sources_name_every_texture_with_its_hash() -> None:
    folder = data_dir("textures")
    listed = dict(re.findall(r"`(\w+\.png)` .*`([0-9a-f]{64})`", (folder / "SOURCES.md").read_text()))
    assert set(listed) >= {f"{name}.png" for name in TEXTURES}
    for name, digest in listed.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert sum(p.stat().st_size for p in folder.glob("*.png")) < 1.5e6


@pytest.mark.parametrize("name", list(TEXTURES))
def test_flares_are_translucent_and_halvings_keep_the_light(name: str) -> None:
    levels = texture(name).levels
    if name.startswith("flare"):
        assert 0.05 < levels[0].max() < 0.35
    means = [level.mean(axis=(0, 1), dtype=np.float64) for level in levels]
    for mean in means[1:]:
        assert mean == pytest.approx(means[0], rel=1e-6)
