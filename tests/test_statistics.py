"""Statistics and card of a store: counts as brute force has them, a card that changes no digest."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Called, small_scene

from vbnfault import dataset, pipeline
from vbnfault import store as st
from vbnfault.dataset import card, from_scene
from vbnfault.dataset.build import BuildOptions
from vbnfault.dataset.identity import stored_plan
from vbnfault.dataset.statistics import key_of, statistics
from vbnfault.scene import config


@pytest.fixture(scope="module")
def data(described_store: Path) -> Any:
    """Return the store, which no test changes."""
    return st.open_store(described_store)


def test_statistics_are_those_of_the_arrays(data: st.Store) -> None:
    numbers = statistics(data).plain()
    injected, split = data.read("injected").astype(int), np.array([str(s) for s in data.read("split")])
    planned = stored_plan(data.attributes, data.spec.faults)[1].injected
    assert numbers["samples"] == numbers["finished"] == len(injected) == sum(numbers["splits"].values())
    for k, fault in enumerate(data.spec.faults):
        counts = numbers["faults"][fault]
        assert (counts["planned"], counts["realised"]) == (planned[:, k].sum(), injected[:, k].sum())
        for name in ("train", "val", "test"):
            assert counts["by_split"][name]["realised"] == injected[split == name, k].sum()
        for j, other in enumerate(data.spec.faults):
            assert numbers["co_occurrence"][fault][other] == (injected[:, k] & injected[:, j]).sum()
    per_sample = np.bincount(injected.sum(axis=1))
    assert numbers["faults_per_sample"] == {str(n): int(c) for n, c in enumerate(per_sample) if c}
    assert numbers["ranges"]["exposure_s"]["all"] == {
        "count": 6,
        "min": 0.01,
        "mean": pytest.approx(0.035, rel=1e-12),
        "max": 0.06,
    }
    for name, has_mean in (("roll_deg", False), ("sun_azimuth_deg", False), ("sun_elevation_deg", True)):
        of_angle = numbers["ranges"][name]["all"]  # 359° and 1° have no mean of 180°
        assert (of_angle["min"] is not None, of_angle["mean"] is not None) == (True, has_mean)
    val = np.flatnonzero(split == "val")
    assert numbers["ranges"]["exposure_s"]["val"]["min"] == 0.01 * (val[0] + 1)
    fault = data.spec.faults[0]
    with_fault = np.flatnonzero(injected[:, 0])
    assert set(numbers["parameters"][fault]) == {"model", "x"}  # no seeds
    assert numbers["parameters"][fault]["x"]["max"] == with_fault[-1] + 0.5
    assert numbers["parameters"][fault]["x"]["count"] == 2 * len(with_fault)
    assert numbers["parameters"][fault]["model"] == {"values": {"made_up": len(with_fault)}}
    assert numbers["bounds"]["dust_on_optics"]["count"] == [30, 100]


def test_a_parameter_of_a_glare_has_not_the_bounds_of_the_flares() -> None:
    keys = {"radius", "brightness", "index", "glare_radius"}
    assert [key_of(name, keys) for name in ("flares.radius", "glare.radius", "glare.index", "index", "x")] == [
        *("radius", "glare_radius", "", "index", "")
    ]


def test_statistics_of_a_store_whose_plan_is_unknown(finished_store: Path) -> None:
    numbers = statistics(finished_store)
    assert not numbers.has_plan
    assert numbers.plain()["faults"]["straylight"]["planned"] is None
    assert any("plan is not known" in line for line in numbers.lines())


def test_a_card_changes_neither_digest_nor_check_and_xarray_reads_as_before(copied: Path) -> None:
    before, found = st.digest(copied), st.examine(copied).problems
    with st.open_dataset(copied) as dataset_before:
        arrays = {name: dataset_before[name].values for name in ("image", "mask", "parameters")}
    first = [path.read_bytes() for path in card.write_card(copied)]
    assert [path.read_bytes() for path in card.write_card(copied)] == first  # no date, no order
    assert st.digest(copied) == before
    assert st.examine(copied).problems == found
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with st.open_dataset(copied) as after:
            for name, values in arrays.items():
                assert np.array_equal(after[name].values, values)
    store = st.recover(copied)
    assert card.has_card(store)
    text = (copied / "README.md").read_text()
    for part in ("CC0-1.0", "A test", "| `mask` | sample, fault, y, x | bool |", "| camera.width_px | 40 | set |"):
        assert part in text


def test_the_card_names_the_origin_of_every_value(tmp_path: Path) -> None:
    scene = config.parse_scene(small_scene(body={"name": "Bennu", "density_kg_m3": 1200.0}), source="bennu")
    store = st.create(tmp_path / "s.zarr", dataset.store_spec(pipeline.Session(scene), (16,)), 16)
    readme = card.write_card(store)[0].read_text()  # no sample is made yet
    rows = [line.strip("| ").split(" | ") for line in readme.splitlines() if line.startswith("| ")]
    origins = {row[0]: row[-1] for row in rows}
    wanted = {
        "body.rotation_period_h": "packaged table of 101955 Bennu",
        "orbit.eccentricity": "packaged table of 101955 Bennu",
        "body.density_kg_m3": "set",
        "dataset.seed": "set",
        "render.bounces": "default",
        "faults.vignetting.mask_loss": "default",
        "body.shape_sha256": "contents of the files",
    }
    assert {key: origins[key] for key in wanted} == wanted


def test_mlcroissant_accepts_the_description_of_a_store(copied: Path, data: st.Store) -> None:
    croissant = pytest.importorskip("mlcroissant", reason="mlcroissant is in the extra `readers`")
    card.write_card(copied)
    described = croissant.Dataset(str(copied / "croissant.json"))
    assert described.metadata.issues.errors == set()
    assert {row["arrays/name"] for row in described.records("arrays")} == set(data.spec.arrays)
    assert [row["fault_classes/name"] for row in described.records("fault_classes")] == list(data.spec.faults)


def test_a_build_writes_the_card_once(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A build that makes nothing leaves a card alone; one that makes samples, or finds none, writes it."""
    made, written = [0], []

    class Summary:
        counts, shard_range = (), None

        @property
        def built(self) -> int:
            return made[0]

    monkeypatch.setattr(from_scene.build, "build", lambda *_: Summary())
    monkeypatch.setattr(from_scene, "planned_blocks", lambda *_, **__: (6,))
    monkeypatch.setattr(from_scene, "_prepared", lambda *_: (None, None, []))
    monkeypatch.setattr(from_scene.dataclasses, "replace", lambda thing, **_: thing)
    monkeypatch.setattr(from_scene.llvm, "find", lambda: None)
    write = card.write_card
    monkeypatch.setattr(card, "write_card", lambda path: written.append(write(path)))
    for built, cards in ((0, 1), (0, 1), (3, 2)):
        made[0] = built
        dataset.build_scene("quickstart", copied, BuildOptions())
        assert len(written) == cards


def test_the_commands(copied: Path, call: Callable[..., Called]) -> None:
    text = call("stats", copied).out
    for title in ("planned", "two classes occur together", "exposure_s", "drawn parameters", "samples by stratum"):
        assert title in text
    assert json.loads(call("stats", copied, "--json").out)["samples"] == 6
    assert call("card", copied).out.split() == [
        str(copied / "README.md"),
        str(copied / "croissant.json"),
    ]
    out = copied.with_name("out")
    assert (
        call("export", copied, "--format", "yolo", "--out", out, "--workers", 1).out
        == f"{out}: 6 samples as yolo\n"
    )
    refused = call("export", copied, "--format", "voc", "--out", out)
    assert (refused.code, "format 'voc': there is no such format" in refused.said) == (2, True)
