"""The chain of a detector: its order, effects from outside the package, shared signal, a response by a table."""

from __future__ import annotations

import dataclasses
import json
import pickle
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import Field

from vbnfault.core import tables
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.quantities import Electrons
from vbnfault.core.registry import chained, forget
from vbnfault.detector import MosaicDetector, Sensor
from vbnfault.detector.chain import Device, MosaicNoise
from vbnfault.detector.effects import STEPS, Effect, Exposure, contract, order, registry
from vbnfault.detector.effects.electrons import DarkCurrent
from vbnfault.detector.effects.neighbours import Crosstalk, InterpixelCapacitance
from vbnfault.detector.effects.output import Nonlinearity
from vbnfault.detector.sensor import load_sensor, parse_sensor

SHAPE = (48, 40)
RNG = np.random.default_rng(5)
LIGHT = RNG.uniform(0, 20_000, SHAPE).astype(np.float32)


class Persistence(Effect):
    """Add what is left of the exposure before, with noise of its own."""

    name = "afterimage"
    after = "dark_current"

    before_e: float = Field(ge=0, le=1e6, description="electrons per pixel of the exposure before")
    fraction: float = Field(0.001, ge=0, le=0.1, description="part of them that is left")
    spread: float = Field(0.0, ge=0, le=1, description="spread of that part from exposure to exposure")

    def apply(self, signal: Any, exposure: Exposure) -> Any:
        rng = exposure.rng(self.name)
        factor = 1.0 if rng is None else 1 + self.spread * rng.standard_normal()
        return signal + np.float32(self.before_e * self.fraction * factor)


class Nothing(Effect):
    """Change nothing between the analogue chain and the converter."""

    name = "nothing"
    after = "analogue"

    def apply(self, signal: Any, exposure: Exposure) -> Any:
        assert signal.dtype == np.float32
        return signal


class SenseNode(Effect):
    """Add charge at the sense node, behind the full well."""

    name = "sense_node"
    after = "full_well"

    added_e: float = Field(500.0, ge=0, le=1e4, description="charge that is added")

    def apply(self, signal: Any, exposure: Exposure) -> Any:
        assert signal.max() <= exposure.sensor.readout.full_well_e
        return signal + np.float32(self.added_e)


class LostBit(Effect):
    """Clear the least significant bit of the raw numbers."""

    name = "lost_bit"
    after = "stuck_pixels"

    def apply(self, signal: Any, exposure: Exposure) -> Any:
        return signal & np.uint16(0xFFFE)


@pytest.fixture(autouse=True, scope="module")
def only_here() -> Iterator[None]:
    """Forget the effects of this file, so that other tests see those of the package."""
    yield
    forget(__name__)


def noise(seed: int, shape: tuple[int, int] = SHAPE) -> MosaicNoise:
    return MosaicNoise.draw(shape, *(np.random.default_rng([seed, k]) for k in range(3)))


def sensor_with(*effects: Effect, name: str = "generic_ccd") -> Sensor:
    return dataclasses.replace(load_sensor(name), effects=effects)


def test_the_order_is_the_documented_one() -> None:
    listed = re.search(r"    (response, .*?raw)\n", contract.__doc__ or "", flags=re.DOTALL)
    assert listed is not None
    packaged = [name for name in order() if contract.is_packaged(registry()[name])]
    assert packaged == re.findall(r"\w+", listed.group(1))
    assert [name for name in packaged if name in STEPS] == [step for step in STEPS if step != "offsets"]


def test_an_effect_from_outside_acts_behind_the_one_that_it_names() -> None:
    names = list(order())
    assert names.index("afterimage") == names.index("dark_current") + 1
    chain = [effect.name for effect in Device(sensor_with(Persistence(before_e=1.0)), 1, shape=SHAPE).chain]
    always = {name for name, cls in registry().items() if contract.acts_always(cls)}
    assert chain == [name for name in names if name in always | {"afterimage"}]
    with pytest.raises(TypeError, match=r"detector effect b: after = 'c': there is none of this name"):
        chained({"a": "", "b": "c"}, ["a"], "detector effect")
    with pytest.raises(TypeError, match=r"what b, c state by `after` runs in a circle"):
        chained({"a": "", "b": "c", "c": "b"}, ["a"], "detector effect")


@pytest.mark.parametrize(
    ("result", "got"),
    [(LIGHT[1:], r"float32\[47, 40\]"), (LIGHT.astype(np.float64), r"float64\[48, 40\]"), (None, "NoneType")],
)
def test_an_effect_that_changes_shape_or_dtype_is_named(
    monkeypatch: pytest.MonkeyPatch, result: Any, got: str
) -> None:
    monkeypatch.setattr(Persistence, "apply", lambda *_: result)
    device = Device(sensor_with(Persistence(before_e=1.0)), 1, shape=SHAPE)
    with pytest.raises(
        VbnfaultError, match=rf"effect afterimage: apply returned {got}, but must .* float32\[48, 40\]"
    ):
        device.expected_e(LIGHT, 0.1)


@pytest.mark.parametrize("name", ["generic_ccd", "generic_cmos"])
def test_effects_without_strength_change_no_bit(name: str) -> None:
    """The first also has noise of its own, which must not move that of the others."""
    plain = Device(sensor_with(name=name), 3, shape=SHAPE).raw(LIGHT, 0.1, noise(1))
    off = sensor_with(Persistence(before_e=0.0, spread=0.5), SenseNode(added_e=0.0), Nothing(), name=name)
    np.testing.assert_array_equal(Device(off, 3, shape=SHAPE).raw(LIGHT, 0.1, noise(1)), plain)


def test_an_effect_from_outside_adds_its_electrons() -> None:
    acting = Device(sensor_with(Persistence(before_e=1e5, fraction=0.01)), 3, shape=SHAPE)
    plain = Device(sensor_with(), 3, shape=SHAPE)
    gained = acting.expected_e(LIGHT, 0.1) - plain.expected_e(LIGHT, 0.1)
    np.testing.assert_allclose(gained, 1000.0, rtol=1e-5)  # float32 of up to 2e4 electrons
    raw = Device(sensor_with(LostBit()), 3, shape=SHAPE).raw(LIGHT, 0.1, noise(1))
    np.testing.assert_array_equal(raw, plain.raw(LIGHT, 0.1, noise(1)) & 0xFFFE)


@pytest.mark.parametrize("name", ["generic_ccd", "generic_cmos"])
def test_an_effect_behind_the_full_well_gets_what_the_wells_hold_and_is_not_clipped(name: str) -> None:
    sensor = sensor_with(name=name)
    readout = dataclasses.replace(sensor.readout, full_well_e=5000.0, gain_dn_per_e=0.1)
    full = np.full(SHAPE, 5e5, np.float32)
    plain, acting = (
        Device(dataclasses.replace(sensor, readout=readout, effects=effects), 3, shape=SHAPE).raw(full, 0.1)
        for effects in ((), (SenseNode(added_e=500.0),))
    )
    working = plain < 0.9 * readout.top_dn  # neither stuck nor at the top code
    gained_dn = acting[working].astype(float) - plain[working]
    assert working.mean() > 0.9
    assert gained_dn.mean() == pytest.approx(50, abs=0.5)  # rounding to whole DN


def test_the_noise_of_an_effect_is_keyed_by_its_exposure() -> None:
    device = Device(sensor_with(Persistence(before_e=1e5, fraction=0.01, spread=0.3)), 3, shape=SHAPE)
    dark = np.zeros(SHAPE, np.float32)
    first, again, other = (float(device.collected_e(dark, 0.1, noise(k)).mean()) for k in (1, 1, 2))
    assert first == again
    assert first != pytest.approx(
        other, rel=0.01
    )  # 30 % of 1000 e apart, of which shot noise moves the mean by 1 e


def sensor_file(folder: Path, **table: Any) -> Path:
    path = folder / "mine.toml"
    numbers = "".join(f"{key} = {value}\n" for key, value in table.items())
    sources = "".join(f'"effects.afterimage.{key}" = "assumed"\n' for key in table)
    path.write_text(
        'architecture = "cmos"\npixel_pitch_um = 5.5\n[readout]\nbits = 12\nfull_well_e = 13500.0\n'
        f"[effects.afterimage]\n{numbers}[sources]\npixel_pitch_um = 'a'\n'readout.bits' = 'a'\n"
        f"'readout.full_well_e' = 'a'\n{sources}"
    )
    return path


def test_a_sensor_file_sets_an_effect_from_outside(tmp_path: Path) -> None:
    sensor = load_sensor(sensor_file(tmp_path, before_e=1e5))
    assert sensor.effects == (Persistence(before_e=1e5),)
    assert "afterimage" in json.dumps(tables.json_schema(Sensor))
    detector = MosaicDetector(sensor=sensor, width_px=SHAPE[1], height_px=SHAPE[0])
    assert detector.description["sensor"]["effects"] == [
        {"name": "afterimage", "before_e": 1e5, "fraction": 0.001, "spread": 0.0}
    ]
    planes = np.zeros((*SHAPE, 3), np.float32)
    light = Electrons(array=planes, white_e=detector.white_e)
    plain = dataclasses.replace(detector, sensor=dataclasses.replace(sensor, effects=()))
    assert detector != plain  # caches of devices tell them apart
    gained = detector.raw(light, 0.0, None).mean() - plain.raw(light, 0.0, None).mean()
    assert gained == pytest.approx(100 * sensor.readout.system_gain_dn_per_e, abs=0.5)  # rounding to whole DN
    assert pickle.loads(pickle.dumps(detector)) == detector


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"before_e": -3.0}, r"effects.afterimage.before_e = -3.0: must be a number from 0 to 1000000"),
        ({}, r"effects.afterimage.before_e: is missing"),
        (
            {"before_e": 1.0, "fractoin": 0.1},
            r"effects.afterimage.fractoin: unknown key \(did you mean fraction\?",
        ),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, table: dict[str, float], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        load_sensor(sensor_file(tmp_path, **table))


def test_an_unknown_effect_is_named() -> None:
    table = {"architecture": "cmos", "pixel_pitch_um": 5.5, "readout": {"bits": 12, "full_well_e": 1e4}}
    with pytest.raises(InputError, match=r"t.toml: effects.afterimege: no such effect \(did you mean afterimage"):
        parse_sensor({**table, "effects": {"afterimege": {}}}, source="t.toml")


def test_bias_and_temperature_drift_from_exposure_to_exposure() -> None:
    """The bias moves every pixel alike, the temperature the dark current; without noise and with 0 neither acts."""
    calm = load_sensor("rosetta_navcam")
    calm = dataclasses.replace(
        calm,
        temperature_drift_K=0.0,
        readout=dataclasses.replace(calm.readout, bias_drift_dn_rms=0.0, read_noise_e_rms=0.0, bits=16),
    )
    drifting = dataclasses.replace(calm, readout=dataclasses.replace(calm.readout, bias_drift_dn_rms=40.0))
    plain, moved = (Device(sensor, 3, shape=SHAPE) for sensor in (calm, drifting))
    np.testing.assert_array_equal(moved.raw(LIGHT, 0.1), plain.raw(LIGHT, 0.1))
    shifts = []
    for seed in range(150):
        apart = moved.raw(LIGHT / 4, 0.1, noise(seed)).astype(int) - plain.raw(LIGHT / 4, 0.1, noise(seed))
        assert np.ptp(apart) <= 2  # rounding of either
        shifts.append(apart.mean())
    # of 150 values, the standard error of the mean is 40 / 12 and that of the deviation 40 / 17
    assert abs(np.mean(shifts)) < 4 * 40 / 12
    assert np.std(shifts) == pytest.approx(40, abs=4 * 40 / 17)
    warm = Device(dataclasses.replace(calm, temperature_drift_K=3.0), 3, shape=SHAPE)
    np.testing.assert_array_equal(warm.expected_e(LIGHT, 0.1), plain.expected_e(LIGHT, 0.1))
    dark = plain.expected_e(np.zeros_like(LIGHT), 5.0, {})
    ratios = []
    for seed in range(60):
        acting = Exposure(device=warm, exposure_s=5.0, noise=noise(seed), acts={})
        added = DarkCurrent().apply(np.zeros_like(LIGHT), acting)
        ratios.append(float(np.median(added / dark)))
        np.testing.assert_allclose(added, dark * ratios[-1], rtol=1e-4)
    # Eg / 2kT² is 0.113 per K at 240 K, so 3 K are a factor of e^0.34
    assert np.std(np.log(ratios)) == pytest.approx(0.34, rel=0.4)


def test_the_dark_current_drifts_by_the_activation_energy_of_the_file() -> None:
    """The logarithm of a ratio of exp(-Ea/kT) is proportional to Ea, whatever the two temperatures are."""
    plain = load_sensor("cmv4000")
    logs = []
    for energy_eV in (0.5, 1.0):
        changed = dataclasses.replace(plain.individual, dark_activation_eV=energy_eV, dark_nonuniformity=0.0)
        warm = dataclasses.replace(plain, individual=changed, temperature_drift_K=3.0)
        device = Device(warm, 3, shape=SHAPE)
        acting = Exposure(device=device, exposure_s=5.0, noise=noise(1), acts={})
        added = DarkCurrent().apply(np.zeros_like(LIGHT), acting)
        logs.append(np.log(np.median(added / device.expected_e(np.zeros_like(LIGHT), 5.0))))
    assert abs(logs[0]) > 0.01
    assert logs[1] == pytest.approx(2 * logs[0], rel=1e-3)


# --- pixels that share their signal, and a response by a table, against closed forms ------------------------------


WIDE = (256, 256)
MEAN_E = 4000.0


def quiet(*effects: Effect) -> Sensor:
    """A sensor of ideal pixels, whose only noise is that of the light."""
    sensor = load_sensor("generic_cmos")
    same = replace(sensor.individual, prnu=0.0, dsnu_e=0.0, dark_current_e_s=0.0, years=0.0, rts_fraction=0.0)
    same = replace(same, dead_fraction=0.0)
    return replace(sensor, individual=same, transfer=replace(sensor.transfer, leak=0.0), effects=effects)


def collected(*effects: Effect, noise: bool = True) -> NDArray[Any]:
    """What reaches the analogue chain under even light."""
    device = Device(quiet(*effects), 1, shape=WIDE)
    exposure = Exposure(
        device=device,
        exposure_s=0.01,
        noise=MosaicNoise.draw(WIDE, *np.random.default_rng(2).spawn(3)) if noise else None,
        acts={},
    )
    signal: Any = np.full(WIDE, MEAN_E, np.float32)
    for effect in device.chain:
        if effect.name == "analogue":
            break
        signal = effect.apply(signal, exposure)
    return np.asarray(signal, dtype=np.float64)


def covariance(image: NDArray[Any], dy: int, dx: int) -> float:
    rest = image - image.mean()
    return float((rest[: WIDE[0] - dy, : WIDE[1] - dx] * rest[dy:, dx:]).mean())


@pytest.mark.parametrize("effect", [Crosstalk, InterpixelCapacitance])
def test_neighbours_get_their_fractions_and_the_sum_stays(effect: Any) -> None:
    device = Device(quiet(), 1, shape=(16, 20))
    exposure = Exposure(device=device, exposure_s=0.1, noise=None, acts={})
    shared = effect(beside_fraction=0.02, corner_fraction=0.003)
    point = np.zeros((16, 20), np.float32)
    point[7, 9] = 1000
    expected = [[3, 20, 3], [20, 908, 20], [3, 20, 3]]
    np.testing.assert_allclose(shared.apply(point, exposure)[6:9, 8:11], expected, rtol=1e-6)
    edges = np.random.default_rng(0).uniform(0, 1e4, (16, 20)).astype(np.float32)
    # 320 sums of nine products of float32
    assert shared.apply(edges, exposure).sum(dtype=np.float64) == pytest.approx(
        edges.sum(dtype=np.float64), rel=1e-6
    )


def test_capacitance_correlates_shot_noise_and_crosstalk_does_not() -> None:
    """Moore et al. 2006: the autocovariance of a flat is the mean times the autocorrelation of the kernel."""
    beside, corner = 0.02, 0.004
    centre = 1 - 4 * (beside + corner)
    kernel = np.full((3, 3), corner)
    kernel[1], kernel[:, 1] = beside, beside
    kernel[1, 1] = centre
    wide = np.pad(kernel, 2)
    coupled = collected(InterpixelCapacitance(beside_fraction=beside, corner_fraction=corner))
    diffused = collected(Crosstalk(beside_fraction=beside, corner_fraction=corner))
    assert coupled.mean() == pytest.approx(MEAN_E, rel=2e-3)
    # a covariance of 65 536 pixels has a standard error of about variance / 256, here five of them
    error = 5 * MEAN_E / 256
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 2)):
        expected = MEAN_E * float((wide * np.roll(wide, (-dy, -dx), (0, 1))).sum())
        assert covariance(coupled, dy, dx) == pytest.approx(expected, abs=error)
        assert covariance(diffused, dy, dx) == pytest.approx(MEAN_E if dy == dx == 0 else 0, abs=error)
    # the two are told apart: the variance falls by a fifth, which is eleven of these errors
    assert covariance(coupled, 0, 0) < 0.85 * covariance(diffused, 0, 0)


def test_a_table_bends_the_response() -> None:
    table = ((2000.0, 1900.0), (6000.0, 5500.0), (10_000.0, 8500.0))
    signal = np.array([[0, 1000, 2000, 5000, 10_000, 12_000]], np.float32)
    device = Device(quiet(), 1, shape=(16, 20))
    bent = Nonlinearity(table=table).apply(signal, Exposure(device=device, exposure_s=0.1, noise=None, acts={}))
    # beyond the table its last slope, 3000 e over 4000 e, goes on
    np.testing.assert_allclose(bent, [[0, 950, 1900, 4600, 8500, 10_000]], rtol=1e-6)
    # a full well of 13 500 e reads as 11 125 e, and is white in every colour
    whole = Device(quiet(Nonlinearity(table=table)), 1, shape=(16, 20))
    raw = whole.raw(np.full((16, 20), 1e6, np.float32), 0.01)
    assert (whole.rgbi(raw, 0.01).array == 255).all()
    assert raw.max() < 0.9 * 4095
    straight = Nonlinearity(table=((1.0, 1.0), (2.0, 2.0)))
    np.testing.assert_array_equal(collected(straight), collected())


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        (
            {"nonlinearity": {"table": [[10.0, 9.0], [20.0, 8.0]]}},
            r"effects.nonlinearity.table.* pair 1, \[20.0, 8.0\], must be above",
        ),
        ({"nonlinearity": {"table": []}}, r"effects.nonlinearity.table = \[\]: must be .*2"),
        ({"nonlinearity": {"table": [[-1.0, 2.0], [3.0, 4.0]]}}, r"effects.nonlinearity.table.*-1"),
        ({"crosstalks": {}}, r"no such effect \(did you mean crosstalk\?\)"),
        ({"smear": {}}, r"effects.smear: no such effect"),
    ],
)
def test_wrong_tables_are_refused_in_a_sentence(effects: dict[str, Any], sentence: str) -> None:
    from sensor_file import completed

    from vbnfault.detector.sensor import parse_sensor

    with pytest.raises(InputError, match=sentence) as caught:
        parse_sensor(completed({"effects": effects}), source="mine.toml")
    assert str(caught.value).startswith("mine.toml: ")
