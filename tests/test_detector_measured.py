"""A device as it was measured: what its frames show, what its lists say, and where it may not be."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import small_scene, verified_store
from numpy.typing import NDArray

from vbnfault import store
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources, toml_files
from vbnfault.core.quantities import DEAD, HOT, RTS, STUCK
from vbnfault.detector import MosaicDetector, Sensor
from vbnfault.detector.chain import Device
from vbnfault.detector.dark import arrhenius_factor
from vbnfault.detector.measured import as_measured
from vbnfault.detector.operation import amplified, binned
from vbnfault.detector.sensor import parse_sensor

SHAPE = (48, 64)
ZERO = np.zeros(SHAPE, np.float32)
LIGHT = np.full(SHAPE, 6000.0, np.float32)
DARK_S, FLAT_S = 20.0, 0.01
BAD = {"dead": (3, 4), "hot": (10, 20), "stuck": (11, 21), "rts": (30, 5)}  # x, y


def sensor(folder: Path, name: str = "generic_cmos", *, defects: Any = None, **tables: Any) -> Sensor:
    """A small sensor, whose file lies in a folder; `tables` are merged into its own."""
    table = toml_files.read_toml(resources.find("scenes/detectors", name), "detector")
    table |= {"width_px": SHAPE[1], "height_px": SHAPE[0]}
    # a converter of even codes, so that numbers say electrons; no telegraph signals, which frames cannot hold
    changes: dict[str, Any] = {
        "readout": {"dnl_lsb_rms": 0.0, "inl_quadratic_dn": 0.0},
        "individual": {"rts_fraction": 0.0, "rts_per_interaction": 0.0},
    }
    for key in {*changes, *tables}:
        new = changes.get(key, {}) | tables.get(key, {})
        table[key] |= new
        table["sources"] |= {f"{key}.{name}": "assumed" for name in new}
    if not table["transfer"].get("parallel_traps"):
        table["sources"].pop("transfer.parallel_traps", None)
    if defects is not None:
        table["defects"] = defects
        numbers = [key for key, value in defects.items() if not isinstance(value, str)]
        table["sources"] |= {f"defects.{key}": "measured" for key in numbers}
    return parse_sensor(table, source=str(folder / "mine.toml"))


def write(path: Path, image: NDArray[Any], **header: float) -> str:
    if path.suffix == ".fits":
        fits = pytest.importorskip("astropy.io.fits")
        fits.writeto(path, image, header=fits.Header(header.items()), overwrite=True)
    else:
        assert cv2.imwrite(str(path), image)
    return path.name


@pytest.fixture
def frames(tmp_path: Path) -> dict[str, Any]:
    """Frames without noise of the device with the seed 5, and the table that names them."""
    device = Device(sensor(tmp_path), 5)
    raw = {
        "dark": device.raw(ZERO, DARK_S),
        "bias": device.raw(ZERO, 0.0),
        "flat": device.raw(LIGHT, FLAT_S),
    }
    table: dict[str, Any] = {key: write(tmp_path / f"{key}.png", image) for key, image in raw.items()}
    return table | {"dark_exposure_s": DARK_S, "flat_exposure_s": FLAT_S, "flat_surface": "kept"}


def listed(folder: Path, rows: str | None = None) -> str:
    text = "x,y,kind\n" + "".join(f"{x},{y},{kind}\n" for kind, (x, y) in BAD.items()) if rows is None else rows
    (folder / "bad.csv").write_text(text)
    return "bad.csv"


def but_bad(image: NDArray[Any]) -> NDArray[Any]:
    """An image without the listed pixels."""
    keep = np.ones(SHAPE, bool)
    for x, y in BAD.values():
        keep[y, x] = False
    return image[keep].astype(int)


@pytest.mark.parametrize("name", ["generic_cmos", "generic_ccd"])
@pytest.mark.parametrize("nodes", [1, 4])
def test_a_measured_device_takes_the_frames_again(tmp_path: Path, name: str, nodes: int) -> None:
    """Offsets of nodes, columns and charge transfer, dark current in the flat and hot pixels are in them once."""
    more: dict[str, Any] = {
        "individual": {"dose_TeV_g": 3.0},  # a dozen hot pixels of some 1000 e/s
        "readout": {
            "nodes": nodes,
            "node_gains": [1.0, 0.9, 0.95, 0.85][:nodes],
            "node_offsets_dn": [0.0, 3.0, -5.0, 8.0][:nodes],
            "column_pattern_e_rms": 30.0,
        },
        # a row waits for up to 4.8 s; no traps, whose trails would be in the frames and then be made again
        "transfer": {"row_readout_s": 0.1, "leak": 0.0, "parallel_traps": []},
    }
    dark_s, flat_s = 1.0, 0.25
    first = Device(sensor(tmp_path, name, **more), 5)
    taken = {"dark": first.raw(ZERO, dark_s), "bias": first.raw(ZERO, 0.0), "flat": first.raw(LIGHT, flat_s)}
    table: dict[str, Any] = {key: write(tmp_path / f"{key}.png", image) for key, image in taken.items()}
    table |= {"dark_exposure_s": dark_s, "flat_exposure_s": flat_s, "flat_surface": "kept"}
    other = Device(sensor(tmp_path, name, defects=table, **more), 9)
    plain = Device(sensor(tmp_path, name, **more), 9)
    assert len(other.individual.hot) > 5
    # of a pixel that saturates in the dark, the rate is that of saturation
    known = taken["dark"] < 3000
    assert known.mean() > 0.995
    np.testing.assert_allclose(other.response[known], first.response[known], atol=0.003)
    for key, light, exposure_s in (("dark", ZERO, dark_s), ("bias", ZERO, 0.0), ("flat", LIGHT, flat_s)):
        again = other.raw(light, exposure_s).astype(int)
        # two roundings, and in the flat four times the error of 768 pixels' mean: 4e-4 of 1800 DN
        limit = 3 if key == "flat" else 1
        assert np.abs(again - taken[key])[known].max() <= limit, key
        # the drawn device of this seed is another one
        assert np.abs(plain.raw(light, exposure_s).astype(int) - taken[key])[known].max() > limit


def test_a_dark_frame_alone_is_taken_again_at_its_exposure(tmp_path: Path) -> None:
    """Below black a pixel has an offset, above it dark current; a stuck pixel shows what the frame shows."""
    dark = np.random.default_rng(1).integers(55, 110, SHAPE).astype(np.uint16)
    table = {"dark": write(tmp_path / "dark.png", dark), "dark_exposure_s": DARK_S}
    device = Device(sensor(tmp_path, defects=table), 1)
    np.testing.assert_array_equal(device.raw(ZERO, DARK_S), dark)
    np.testing.assert_array_equal(device.raw(ZERO, 0.0), np.minimum(dark, 64))
    table |= {"bad_pixels": listed(tmp_path, "x,y\n5,6\n"), "bad_kind": "stuck"}
    assert Device(sensor(tmp_path, defects=table), 1).raw(LIGHT, 0.1)[6, 5] == dark[6, 5]


def test_noise_of_a_cool_sensor_makes_no_dark_current(tmp_path: Path) -> None:
    """A mean dark signal far below the noise stays, and noise makes no hot pixel.

    The mean of 3072 differences of two frames has a standard error of 0.1 DN, of which four are the tolerance.
    """
    rng = np.random.default_rng(4)
    bias, dark = (rng.normal(mean, 4.0, SHAPE).astype(np.float32) for mean in (100.0, 100.5))
    table = {"dark": write(tmp_path / "dark.tif", dark), "bias": write(tmp_path / "bias.tif", bias)}
    made = sensor(tmp_path, defects=table | {"dark_exposure_s": DARK_S})
    device = Device(made, 1)
    mean_dn = device.dark_rate_e_s.mean() * DARK_S * made.readout.system_gain_dn_per_e
    assert mean_dn == pytest.approx(0.5, abs=0.4)
    assert device.dark_rate_e_s.min() >= 0
    assert len(device.individual.hot) == 0


def test_frames_may_be_of_another_gain(tmp_path: Path, frames: dict[str, Any]) -> None:
    """Twice the DN per electron: half of the electrons, half of the offsets and currents, the same responses."""
    own, other = (
        sensor(tmp_path, defects=frames | more).measured
        for more in ({}, {"gain_dn_per_e": 2 * sensor(tmp_path).readout.system_gain_dn_per_e})
    )
    assert own is not None
    assert other is not None
    for name in ("offset_e", "dark_e_s"):
        np.testing.assert_allclose(getattr(other, name), getattr(own, name) / 2, rtol=1e-5)
    np.testing.assert_allclose(other.gain, own.gain, rtol=1e-5)


def test_the_shade_of_lamp_and_lens_is_no_response(tmp_path: Path, frames: dict[str, Any]) -> None:
    y, x = (np.linspace(-1, 1, size) for size in SHAPE)
    shade = 1 - 0.2 * (x**2 + y[:, None] ** 2) + 0.05 * x
    flat = cv2.imread(str(tmp_path / frames["flat"]), cv2.IMREAD_UNCHANGED)
    write(tmp_path / "shaded.png", np.rint(64 + (flat - 64.0) * shade).astype(np.uint16))
    table = frames | {"flat": "shaded.png"}
    true = Device(sensor(tmp_path), 5).response
    kept, removed = (
        Device(sensor(tmp_path, defects=table | {"flat_surface": how}), 5).response for how in ("kept", "removed")
    )
    # 15 terms of 768 pixels of each colour take 1 % of the responses' spread of 0.01 along, 14 % of it in amplitude
    assert (removed - true).std() < 0.2 * 0.01
    assert (kept / true).std() == pytest.approx((shade / shade.mean()).std(), rel=0.05)


def test_currents_follow_the_temperature_by_their_own_laws(tmp_path: Path) -> None:
    """An ordinary pixel as silicon, a hot one beyond the median as displaced atoms (0.63 eV)."""
    made = sensor(tmp_path)
    gain = made.readout.system_gain_dn_per_e
    rng = np.random.default_rng(3)
    dark = np.rint(64 + gain * DARK_S * rng.uniform(13, 17, SHAPE)).astype(np.uint16)
    dark[7, 9] = 64 + round(gain * DARK_S * 400)
    table = {"dark": write(tmp_path / "dark.png", dark), "dark_exposure_s": DARK_S, "dark_temperature_K": 303.0}
    measured = sensor(tmp_path, defects=table)
    cool = Device(measured, 1, temperature_K=273.0)
    assert (cool.individual.hot.row.tolist(), cool.individual.hot.column.tolist()) == ([7], [9])
    warm = Device(measured, 1, temperature_K=303.0)
    usual = np.median(warm.dark_rate_e_s[5:10, 7:12])
    spec = measured.individual
    silicon = spec.dark_factor(273.0) / spec.dark_factor(303.0)
    # half a DN of rounding is 0.08 e/s, of 13 e/s or more
    np.testing.assert_allclose(warm.dark_rate_e_s, (dark - 64.0) / gain / DARK_S, atol=0.01)
    rest = np.delete(cool.dark_rate_e_s.ravel(), 7 * SHAPE[1] + 9)
    np.testing.assert_allclose(rest, np.delete(warm.dark_rate_e_s.ravel(), 7 * SHAPE[1] + 9) * silicon, rtol=1e-5)
    above = warm.dark_rate_e_s[7, 9] - usual
    assert cool.dark_rate_e_s[7, 9] == pytest.approx(
        usual * silicon + above * arrhenius_factor(273.0, 303.0, 0.63), rel=1e-5
    )


@pytest.mark.parametrize("kind", [np.int16, np.int64])
def test_a_fits_file_says_exposure_and_temperature(kind: type, tmp_path: Path) -> None:
    dark = np.full(SHAPE, 100, kind)
    name = write(tmp_path / "dark.fits", dark, EXPTIME=DARK_S, **{"CCD-TEMP": 0.0})
    table = {"dark": name, "dark_exposure_s": DARK_S, "dark_temperature_K": 273.15}
    by_header, by_keys = (sensor(tmp_path, defects=some).measured for some in ({"dark": name}, table))
    assert by_header is not None
    assert by_header == by_keys
    assert by_header.description["dark_temperature_K"] == 273.15


@pytest.mark.parametrize("ending", [".fits", ".tif"])
@pytest.mark.parametrize("dn", [100.25, 2000.0625])
def test_a_mean_of_frames_need_not_be_whole(tmp_path: Path, ending: str, dn: float) -> None:
    mean = write(tmp_path / f"mean{ending}", np.full(SHAPE, dn, np.float32))
    gain = sensor(tmp_path).readout.system_gain_dn_per_e
    device = Device(sensor(tmp_path, defects={"dark": mean, "dark_exposure_s": DARK_S}), 1)
    np.testing.assert_allclose(device.dark_rate_e_s * DARK_S * gain, dn - 64, rtol=1e-5)


def test_a_list_adds_its_pixels_to_those_that_are_drawn(tmp_path: Path) -> None:
    aged = sensor(tmp_path)
    device = Device(sensor(tmp_path, defects={"bad_pixels": listed(tmp_path)}), 5)
    drawn, found = device.drawn, device.individual
    np.testing.assert_array_equal(found.gain, drawn.gain)
    np.testing.assert_array_equal(found.dsnu_e, drawn.dsnu_e)
    for kind, (x, y) in BAD.items():
        before, after = getattr(drawn, kind), getattr(found, kind)
        assert len(after) == len(before) + 1
        assert (after.column[-1], after.row[-1]) == (x, y)
        assert (
            device.defects(1.0, noise_of(device))[y, x]
            & {"dead": DEAD, "hot": HOT, "stuck": STUCK, "rts": RTS}[kind]
        )
    assert device.response[BAD["dead"][1], BAD["dead"][0]] == 0
    x, y = BAD["hot"]
    least, most = aged.individual.hot_rate_e_s
    assert least <= found.damage_e_s[y, x] - drawn.damage_e_s[y, x] <= most
    np.testing.assert_array_equal(but_bad(device.raw(LIGHT, FLAT_S)), but_bad(Device(aged, 5).raw(LIGHT, FLAT_S)))


def noise_of(device: Device) -> Any:
    detector = MosaicDetector(sensor=device.sensor, seed=device.seed, width_px=SHAPE[1], height_px=SHAPE[0])
    return detector.draw_noise(SHAPE, lambda name: np.random.default_rng([1, *name.encode()]))


def test_masks_and_tables_list_the_same_pixels(tmp_path: Path) -> None:
    mask = np.zeros(SHAPE, np.uint8)
    for x, y in BAD.values():
        mask[y, x] = 255
    rows = "x,y\n" + "".join(f"{x},{y}\n" for x, y in BAD.values())
    files = {
        "png": write(tmp_path / "mask.png", mask),
        "fits": write(tmp_path / "mask.fits", mask.astype(np.int16)),
        "csv": listed(tmp_path, rows),
    }
    kinds = {}
    for ending, name in files.items():
        found = sensor(tmp_path, defects={"bad_pixels": name, "bad_kind": "hot"}).measured
        assert found is not None
        kinds[ending] = found.kinds
    np.testing.assert_array_equal(kinds["png"], np.where(mask > 0, HOT, 0))
    np.testing.assert_array_equal(kinds["fits"], kinds["png"])
    np.testing.assert_array_equal(kinds["csv"], kinds["png"])


def test_listed_pixels_behave_as_the_frames_show(tmp_path: Path, frames: dict[str, Any]) -> None:
    images = {key: cv2.imread(str(tmp_path / frames[key]), cv2.IMREAD_UNCHANGED) for key in ("dark", "flat")}
    for kind, dn in (("stuck", 3000), ("hot", 2000)):
        x, y = BAD[kind]
        images["dark"][y, x] = dn
    x, y = BAD["dead"]
    images["flat"][y, x] = round(64 + 0.3 * (images["flat"].mean() - 64))
    for key, image in images.items():
        write(tmp_path / frames[key], image)
    found = Device(sensor(tmp_path, defects=frames | {"bad_pixels": listed(tmp_path)}), 9)
    assert found.response[BAD["dead"][::-1]] == pytest.approx(0.3, abs=0.05)  # of its colour, not of all
    assert found.raw(ZERO, DARK_S)[BAD["hot"][::-1]] == pytest.approx(2000, abs=1)
    for light, exposure_s in ((ZERO, 0.0), (LIGHT, FLAT_S)):
        assert found.raw(light, exposure_s)[BAD["stuck"][::-1]] == 3000
    assert len(found.individual.dead) == 1


def test_binned_and_windowed_pixels_are_those_of_the_sensor(tmp_path: Path, frames: dict[str, Any]) -> None:
    """Offsets and currents of four pixels of one colour add, responses average; a window begins where it says."""
    table = frames | {"bad_pixels": listed(tmp_path), "origin_px": [8, 4]}
    made = sensor(tmp_path, defects=table)
    whole = made.measured
    assert whole is not None
    both = binned(made, 2)
    assert both.measured is not None
    # columns 8, 10 and rows 4, 6 make the red pixel at column 4 and row 2
    part = np.ix_([4, 6], [8, 10])
    for name, how in (("gain", np.mean), ("offset_e", np.sum), ("dark_e_s", np.sum), ("damage_e_s", np.sum)):
        assert getattr(both.measured, name)[2, 4] == pytest.approx(how(getattr(whole, name)[part]), rel=1e-5)
    for kind, bit in (("dead", DEAD), ("hot", HOT), ("stuck", STUCK), ("rts", RTS)):
        x, y = BAD[kind]
        assert both.measured.kinds[y // 4 * 2 + y % 2, x // 4 * 2 + x % 2] & bit
    assert both.measured.origin_px == (4, 2)
    device = Device(both, 9, shape=(16, 20))
    np.testing.assert_array_equal(device.individual.dsnu_e, both.measured.offset_e[2:18, 4:24])
    middle = Device(sensor(tmp_path, defects=frames), 9, shape=(20, 30))
    np.testing.assert_array_equal(middle.individual.dsnu_e, whole.offset_e[14:34, 16:46])
    again = pickle.loads(pickle.dumps(both))
    assert (again, hash(again)) == (both, hash(both))
    assert both.measured != whole
    # a higher gain shows the same electrons
    assert amplified(made, 4.0).measured is whole


def test_later_damage_comes_on_top_of_what_was_measured(tmp_path: Path, frames: dict[str, Any]) -> None:
    from test_faults_kit import make, make_context, rng

    plain, measured = (
        MosaicDetector(sensor=one, seed=3, width_px=SHAPE[1], height_px=SHAPE[0])
        for one in (sensor(tmp_path), sensor(tmp_path, defects=frames | {"bad_pixels": listed(tmp_path)}))
    )
    where = make_context(SHAPE[1], SHAPE[0], architecture="cmos", exposure_s=10.0)
    fault: Any = make("broken_pixels", model="hot_pixels", years=10.0, growth_factor=1e4)
    drawn = [
        fault.draw(replace(where, camera=replace(where.camera, detector=one)), rng(1)) for one in (plain, measured)
    ]
    assert drawn[0]["count"] > 10
    assert drawn[0] == drawn[1]


def test_a_device_without_files_is_the_drawn_one(tmp_path: Path) -> None:
    made = sensor(tmp_path)
    device = Device(made, 4)
    assert as_measured(device.drawn, made) is device.drawn
    assert "defects" not in MosaicDetector(sensor=made, width_px=64, height_px=48).description["sensor"]


def test_tables_and_frames_that_do_not_fit_are_refused_in_a_sentence(
    tmp_path: Path, frames: dict[str, Any]
) -> None:
    tall = write(tmp_path / "tall.png", np.zeros((64, 48), np.uint16))
    nan = np.zeros(SHAPE, np.float32)
    nan[3, 5] = np.nan
    holed = write(tmp_path / "holed.fits", nan)
    bright = write(tmp_path / "bright.png", np.full(SHAPE, 4097, np.uint16) + np.arange(64, dtype=np.uint16))
    full = write(tmp_path / "full.png", np.full(SHAPE, 4090, np.uint16))
    coloured = write(tmp_path / "coloured.png", np.random.default_rng(0).integers(0, 255, (*SHAPE, 3), np.uint8))
    (tmp_path / "torn.png").write_bytes((tmp_path / frames["dark"]).read_bytes()[:200])
    (tmp_path / "empty.csv").write_bytes(b"")

    def table(**keys: Any) -> dict[str, Any]:
        return frames | keys

    def lists(rows: str, name: str) -> dict[str, Any]:
        (tmp_path / name).write_text(rows)
        return {"bad_pixels": name}

    cases: list[tuple[dict[str, Any], str]] = [
        ({}, "defects: names no file; must name one of dark, bias, flat, bad_pixels"),
        ({"dark": "no.png", "dark_exposure_s": 1.0}, "defects.dark = '.*no.png': data file not found"),
        ({"dark": frames["dark"]}, "defects.dark_exposure_s: is missing, .* must be above 0 s"),
        (table(dark_exposure_s=0.0), "defects.dark_exposure_s = 0.0: must be .*above 0"),
        (table(dark_temperature_K=20.0), "defects.dark_temperature_K = 20.0: must be .*100 to 400"),
        ({"flat": frames["flat"], "dark_exposure_s": 1.0}, "dark_exposure_s = 1: needs dark"),
        (table(dark=tall), "defects.dark = .*: is 48x64 px; must be 64x48, the sensor's width_px and height_px"),
        (table(bias=holed), "defects.bias = .*: holds nan at x = 5, y = 3; must hold finite numbers"),
        (table(bias=bright), "defects.bias = .*: holds numbers from 4097 to 4160; must be from 0 to 4095"),
        (table(flat=full), "defects.flat = .*: has a median of .* e above black; must be from .* below saturation"),
        (table(flat=frames["bias"]), "defects.flat = .*: has a median of .* e above black; must be from 33"),
        (table(flat=coloured), "defects.flat = .*: has colours"),
        (table(dark="torn.png"), "defects.dark = .*: is a damaged PNG file"),
        (table(dark="bad.jpg"), "defects.dark = .*bad.jpg"),
        (table(dar="dark.png"), r"defects.dar: unknown key \(did you mean dark\?\)"),
        (table(flat_surface="none"), "defects.flat_surface = 'none': must be .*removed"),
        (table(origin_px=[3, 4]), r"defects.origin_px = \[3, 4\]: must be multiples of 2 and 2"),
        (table(gain_dn_per_e=0.0), "defects.gain_dn_per_e = 0.0: must be .*above 0"),
        ({"bad_pixels": "empty.csv"}, "defects.bad_pixels = .*: data file is empty"),
        (lists("x,y\n", "a.csv"), "defects.bad_pixels = .*: lists no pixel; must list one or more"),
        (lists("3,4\n5,6\n", "b.csv"), r"defects.bad_pixels = .*: has the columns \['3', '4'\]; must be x, y"),
        (lists("x,y\n64,0\n", "c.csv"), "row 1: x = '64': must be a whole number from 0 to 63"),
        (lists("x,y\n1,2\n0,-1\n", "d.csv"), "row 2: y = '-1': must be a whole number from 0 to 47"),
        (lists("x,y\n1.5,2\n", "e.csv"), "row 1: x = '1.5': must be a whole number"),
        (lists("x,y\nnan,2\n", "f.csv"), "row 1: x = 'nan': must be a whole number"),
        (lists("x,y\n3\n", "g.csv"), "row 1: y = '': must be a whole number"),
        (lists("x,y,kind\n1,2,ded\n", "h.csv"), r"row 1: kind = 'ded': must be one of dead, hot, stuck, rts \(did"),
        (lists("x,y\n1,2,hot\n", "j.csv"), "row 1: has more values than the columns x, y"),
        ({"bad_pixels": tall}, "defects.bad_pixels = .*: is 48x64 px; must be 64x48"),
        (lists("x,y\n1,2\n", "i.csv") | {"bad_kind": "warm"}, "defects.bad_kind = 'warm': must be .*dead"),
    ]
    for defects, sentence in cases:
        with pytest.raises(InputError, match=sentence) as caught:
            sensor(tmp_path, defects=defects)
        assert str(caught.value).startswith(f"{tmp_path / 'mine.toml'}: "), caught.value
    with pytest.raises(InputError, match=r"mine.toml: sources: defects.dark_exposure_s has none"):
        parse_sensor({**minimal(), "defects": frames}, source=str(tmp_path / "mine.toml"))
    with pytest.raises(
        InputError, match=r"defects.origin_px = \[60, 4\]: a window of 20x16 px .* beyond the 64x48 px"
    ):
        Device(sensor(tmp_path, defects=table(origin_px=[60, 4])), 1, shape=(16, 20))


@pytest.mark.parametrize(("nodes", "origin_px"), [(2, [8, 4]), (4, [22, 4])])
def test_other_nodes_than_those_of_the_frames_read_no_window(
    tmp_path: Path, frames: dict[str, Any], nodes: int, origin_px: list[int]
) -> None:
    """Two nodes halve columns alone."""
    made = sensor(tmp_path, defects=frames | {"origin_px": origin_px}, readout={"nodes": nodes})
    with pytest.raises(InputError, match=r"defects.origin_px = .*: readout.nodes = . halve a window of 20x16 px"):
        MosaicDetector(sensor=made, width_px=20, height_px=16)
    table = frames | {"origin_px": [22, 4 if nodes == 2 else 16]}
    middle = sensor(tmp_path, defects=table, readout={"nodes": nodes})
    MosaicDetector(sensor=middle, width_px=20, height_px=16)


@pytest.mark.parametrize(("factor", "dn"), [(16, 500), (16, 484), (4, 2001)])
def test_numbers_at_the_top_of_sixteen_bits_lose_powers_of_two_alone(tmp_path: Path, factor: int, dn: int) -> None:
    """A frame of one number keeps it: 8000 of 16 bits are 500 of 12 bits, and not 1."""
    frame = write(tmp_path / "bias.png", np.full(SHAPE, factor * dn, np.uint16))
    made = sensor(tmp_path, defects={"bias": frame})
    assert made.measured is not None
    np.testing.assert_array_equal(made.measured.level, np.float32(dn) / np.float32(4095))


def minimal() -> dict[str, Any]:
    from sensor_file import completed

    size = {"width_px": SHAPE[1], "height_px": SHAPE[0]}
    sources = dict.fromkeys((*size, "defects.flat_exposure_s"), "assumed")
    return completed(size | {"sources": sources})


# --- through a scene and its store ------------------------------------------------------------------------------


def built(folder: Path, **camera: Any) -> store.Store:
    """The store of a scene of one sample with the sensor file `mine.toml`."""
    table = small_scene(
        dataset={"samples": 1, "sites": 1, "layers": ["raw", "defects"], "shard_samples": 1},
        camera={
            "width_px": 40,
            "height_px": 32,
            "detector": str(folder / "mine.toml"),
            "exposure_s": 0.02,
            **camera,
        },
    )
    return verified_store({**table, "faults": {}}, folder / f"{len(list(folder.iterdir()))}.zarr")


def test_a_scene_takes_the_device_and_its_identity_the_files(tmp_path: Path, frames: dict[str, Any]) -> None:
    def file(**defects: Any) -> None:
        table = toml_files.read_toml(resources.find("scenes/detectors", "generic_cmos"), "detector")
        table |= {"width_px": SHAPE[1], "height_px": SHAPE[0], "defects": defects}
        numbers = {f"defects.{key}": "measured" for key, value in defects.items() if not isinstance(value, str)}
        table["sources"] |= numbers
        (tmp_path / "mine.toml").write_text(toml_files.toml_text(table))

    defects = frames | {"bad_pixels": listed(tmp_path), "origin_px": [0, 0]}
    file(**defects)
    first = built(tmp_path)
    layer, raw = first.read_sample(0).layers["defects"], first.read_sample(0).layers["raw"]
    for kind, bit in (("dead", DEAD), ("hot", HOT), ("stuck", STUCK), ("rts", RTS)):
        x, y = BAD[kind]
        assert layer[y, x] & bit
    described = json.dumps(first.attributes["detector"])
    assert str(tmp_path) not in described
    assert first.attributes["detector"]["sensor"]["defects"]["dark"]["file"] == "dark.png"
    assert first.attributes["scene"]["camera"]["detector"].count("+") == 4
    again = built(tmp_path)
    assert again.attributes["scene_hash"] == first.attributes["scene_hash"]
    # one number of one frame makes another scene, and another image
    dark = cv2.imread(str(tmp_path / "dark.png"), cv2.IMREAD_UNCHANGED)
    dark[6, 8] = 4000
    write(tmp_path / "dark.png", dark)
    other = built(tmp_path)
    assert other.attributes["scene_hash"] != first.attributes["scene_hash"]
    changed = np.argwhere(other.read_sample(0).layers["raw"] != raw)
    assert (changed == [6, 8]).all()
    assert other.read_sample(0).layers["defects"][6, 8] & HOT
    with pytest.raises(InputError, match=r"camera.individuals = 2: must be 1, since the sensor file's defects"):
        built(tmp_path, individuals=2)
    file(**defects | {"origin_px": [40, 0]})
    with pytest.raises(InputError, match=r"camera.detector: .*defects.origin_px = \[40, 0\]: a window of 40x32 px"):
        built(tmp_path)
