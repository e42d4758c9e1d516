"""One more frame, now: a pose that was not known before, with faults and exposure of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from poses_kit import columns_of, row

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.world.ephemeris import sun_distance_au

CHANGES = {
    "camera.width_px": 48,
    "camera.height_px": 40,
    "camera.fov_deg": 30.0,
    "patch.max_triangles": 30_000,
    "patch.boulders": False,
    "render.samples_per_pixel": 4,
    "dataset.samples": 6,
    "dataset.sites": 2,
    "dataset.shard_samples": 3,
}
POSE = row("a", (2500.0, 9000.0, 4000.0), (0.6, 0.8, 0.0))


def scene(**values: Any) -> vbnfault.Scene:
    return vbnfault.load_scene("quickstart", CHANGES | values)


@pytest.fixture(scope="module")
def session() -> vbnfault.Session:
    return vbnfault.Session(scene())


def assert_same(one: Any, other: Any) -> None:
    """Compare two samples bit for bit."""
    assert vars(one).keys() == vars(other).keys()
    for name, value in vars(one).items():
        expected = vars(other)[name]
        if isinstance(value, dict):
            assert value.keys() == expected.keys(), name
            for key, inner in value.items():
                np.testing.assert_equal(inner, expected[key], err_msg=f"{name}.{key}")
        else:
            np.testing.assert_equal(value, expected, err_msg=name)


@pytest.mark.parametrize("sample", [0, 4])
def test_a_frame_is_that_of_a_table_with_its_row(session: vbnfault.Session, sample: int) -> None:
    table = columns_of([{**POSE, "name": str(k)} for k in range(6)])
    expected = vbnfault.Session(scene(), poses=table).simulate(sample)
    session.take(row("b", (100.0, 8000.0, 0.0)), sample=sample)  # another one before does not matter
    assert_same(session.take(POSE, sample=sample), expected)
    apart = [POSE[f"camera_{axis}_T_m"] for axis in "xyz"], [POSE[f"camera_from_T_{axis}"] for axis in "wxyz"]
    far_au = sun_distance_au(scene(**{"sun.julian_date": POSE["julian_date"]}))
    table = columns_of([{**POSE, "name": str(k), "sun_distance_au": far_au} for k in range(6)])
    expected = vbnfault.Session(scene(), poses=table).simulate(sample)
    assert_same(session.take(apart, sun=(6.0, 8.0, 0.0), time=POSE["julian_date"], sample=sample), expected)


def test_faults_and_exposure_are_those_of_the_call(session: vbnfault.Session) -> None:
    names = list(session.faults)
    chosen = {"dust_on_optics": {"count": 7}, "vignetting": True, "broken_lines": False}
    one = session.take(POSE, faults=chosen)
    on = [name for name, has in zip(names, one.scalars["injected"], strict=True) if has]
    assert sorted(on) == ["dust_on_optics", "vignetting"]
    changed = scene(**{"faults.dust_on_optics.count": 7, "plan.mode": "per_class", "plan.faulty_fraction": 1.0})
    table = columns_of([{**POSE, "name": str(k)} for k in range(6)])
    whole = vbnfault.Session(changed, poses=table).simulate(0)
    k = names.index("dust_on_optics")
    masks = one.layers["mask"][k], whole.layers["mask"][k]
    np.testing.assert_array_equal(*masks)  # a fault's draw does not know the others
    none = session.take(POSE, faults={}, exposure=0.002)
    assert not none.scalars["injected"].any()
    assert none.scalars["exposure_s"] == 0.002
    assert not np.array_equal(none.layers["image"], session.take(POSE, faults={}).layers["image"])


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"pose": 3}, r"pose = 3: must be a position in m and a quaternion"),
        ({"pose": ([0, 0], [1, 0, 0, 0])}, "pose = .*: must be a position"),
        ({"pose": ([0, 0, 9e3], [1, 0, 0, 0])}, r"pose: sun_x_T, sun_y_T, sun_z_T is missing; sun gives"),
        ({"pose": ([0, 0, 9e3], [1, 0.1, 0, 0]), "sun": (1, 0, 0)}, r"pose: row 1: .*their norm is 1.00499"),
        ({"sun": (0, 0, 0)}, r"sun = .*: must be three numbers"),
        ({"sun": "up"}, r"sun = .*: must be three numbers"),
        ({"time": "noon"}, r"julian_date = 'noon': must be a number"),
        ({"faults": ["dust_on_optics"]}, r"faults = .*: must map names of classes"),
        ({"time": 5}, r"julian_date = 5.*must be a number from 1000000"),
        ({"faults": {"dust": True}}, r"faults: 'dust' is no fault of scene; it has dust_on_optics"),
        ({"faults": {"dust_on_optics": {"cuont": 3}}}, r"cuont"),
        ({"exposure": -1.0}, r"camera.exposure_s = -1"),
        ({"sample": 6}, r"sample = 6: must be a whole number from 0 to 5"),
    ],
)
def test_a_mistake_is_one_sentence(session: vbnfault.Session, values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        session.take(**{"pose": POSE, **values})
