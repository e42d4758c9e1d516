"""Every key of an effect that a sensor file switches on, through a scene, its store and back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from conftest import small_scene, verified_store
from numpy.typing import NDArray

from vbnfault.core.files import resources, toml_files
from vbnfault.detector import load_sensor
from vbnfault.detector.chain import Device
from vbnfault.detector.effects import Exposure, acts_always, is_packaged, registry

OWN = {name: cls for name, cls in registry().items() if is_packaged(cls) and not acts_always(cls)}
# Values of each key that differ from those of the first table of its effect.
TABLES: dict[str, list[dict[str, Any]]] = {
    "crosstalk": [{"beside_fraction": 0.02}, {"beside_fraction": 0.02, "corner_fraction": 0.01}],
    "interpixel_capacitance": [{"beside_fraction": 0.015}, {"beside_fraction": 0.015, "corner_fraction": 0.01}],
    "nonlinearity": [{"table": [[5e3, 4.5e3], [2e4, 1.5e4]]}],
    "companding": [{}, {"bits": 6}, {"law": "linear"}, {"levels_dn": [64, 100, 400, 1000, 4000]}],
    "compression": [
        {"codec": "jpeg"},
        {"codec": "jpeg", "quality": 20},
        {"codec": "jpeg2000"},
        {"codec": "jpeg2000", "bits_per_px": 4.0},
    ],
}


def sensor_file(folder: Path, name: str, effects: dict[str, Any]) -> str:
    """The path of a packaged sensor's file with effects."""
    table = toml_files.read_toml(resources.find("scenes/detectors", "generic_cmos"), "detector")
    table["effects"] = effects
    numbers = [
        f"effects.{effect}.{key}"
        for effect, keys in effects.items()
        for key, value in keys.items()
        if not isinstance(value, str)
    ]
    table["sources"] |= dict.fromkeys(numbers, "assumed")
    (folder / f"{name}.toml").write_text(toml_files.toml_text(table))
    return str(folder / f"{name}.toml")


def raw_of(folder: Path, name: str, effects: dict[str, Any]) -> NDArray[Any]:
    """The raw mosaic that a store holds of a scene whose sensor has effects."""
    scene = small_scene(
        dataset={"samples": 1, "sites": 1, "layers": ["raw"], "shard_samples": 1},
        camera={"width_px": 48, "height_px": 40, "detector": sensor_file(folder, name, effects)},
    )
    opened = verified_store({**scene, "faults": {}}, folder / f"{name}.zarr")
    stored = opened.attributes["detector"]["sensor"]["effects"]
    assert [effect["name"] for effect in stored] == list(effects)
    return opened.read_sample(0).layers["raw"]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> NDArray[Any]:
    return raw_of(tmp_path_factory.mktemp("plain"), "plain", {})


@pytest.mark.parametrize("name", OWN)
def test_every_key_reaches_the_store(name: str, plain: NDArray[Any], tmp_path: Path) -> None:
    tables, fields = TABLES[name], OWN[name].model_fields
    assert set(fields) == {key for table in tables for key in table}
    for key, field in fields.items():  # each word of a choice, the default among them
        words = {word for word in get_args(field.annotation) if isinstance(word, str)}
        given = [table.get(key, field.default) for table in tables]
        assert all(word in given for word in words)
    seen = [plain]
    for k, table in enumerate(tables):
        raw = raw_of(tmp_path, str(k), {name: table})
        assert all((raw != one).any() for one in seen)
        seen.append(raw)
        if name in ("companding", "compression"):  # no noise comes behind them: the numbers are those of one call
            sensor = replace(load_sensor("generic_cmos"), effects=load_sensor(tmp_path / f"{k}.toml").effects)
            exposure = Exposure(device=Device(sensor, 1, shape=raw.shape), exposure_s=1.0, noise=None, acts={})
            np.testing.assert_array_equal(sensor.effects[0].apply(plain.copy(), exposure), raw)


def test_all_at_once_act_in_the_order_of_the_chain(tmp_path: Path, plain: NDArray[Any]) -> None:
    raw = raw_of(tmp_path, "all", {name: TABLES[name][0] for name in TABLES})
    assert raw.shape == plain.shape
    assert np.corrcoef(raw.ravel(), plain.ravel())[0, 1] > 0.9


def test_masks_hold_what_compression_spreads(tmp_path: Path) -> None:
    """Without noise, nothing differs from the clean twin beyond the mask of broken pixels."""
    coarse = {"compression": TABLES["compression"][1]}
    scene = small_scene(
        dataset={"samples": 2, "sites": 1, "layers": ["clean", "mask_effect"], "shard_samples": 2},
        camera={"width_px": 48, "height_px": 40, "detector": sensor_file(tmp_path, "a", coarse)},
        plan={"faulty_fraction": 1.0},
    )
    faults = {"broken_pixels": {"model": "hot_pixels", "growth_factor": 1e5, "least_dn": 20.0}}
    layers = verified_store({**scene, "faults": faults}, tmp_path / "a.zarr").read_sample(0).layers
    assert layers["mask_effect"][0].sum() > 64  # blocks of 8 x 8 pixels of each colour
    assert not (layers["mask_effect"] & ~layers["mask"]).any()
