"""What a trainer reads without any framework: which samples, in which order, as which arrays."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import recorded_calls
from hypothesis import given
from hypothesis import strategies as strategy
from synthetic import FAULTS, fake_sample, filled, make_spec

from vbnfault import store as st
from vbnfault.core.errors import InputError
from vbnfault.train import TARGETS, Columns, Order, SampleReader, Targets, reader, select
from vbnfault.train.targets import regions


def order(count: int = 50, **changes: object) -> Order:
    values: dict = {"samples": np.arange(count), "shard_samples": 4, "batch_size": 3, "buffer": 8, "seed": 5}
    return Order(**{**values, **changes})


# --- order ------------------------------------------------------------------------------------------------


@given(
    count=strategy.integers(1, 60),
    size=strategy.integers(1, 9),
    buffer=strategy.integers(1, 80),
    workers=strategy.integers(1, 7),
    start=strategy.integers(0, 5),
    epoch=strategy.integers(0, 3),
)
def test_workers_in_turn_give_one_sequence(
    count: int, size: int, buffer: int, workers: int, start: int, epoch: int
) -> None:
    """As a DataLoader does: batch k comes from worker k modulo n; a worker that has no more is left out."""
    plan = order(count, batch_size=size, buffer=buffer)
    alone = plan.batches(epoch, start)
    each = [plan.batches(epoch, start, w, workers) for w in range(workers)]
    in_turn = [each[k % workers][k // workers] for k in range(len(alone))]
    assert [b.tolist() for b in in_turn] == [b.tolist() for b in alone]
    assert sum(map(len, each)) == len(alone) == max(0, len(plan) - start)
    if not start:
        assert sorted(np.concatenate(alone).tolist()) == list(range(count))


@given(ranks=strategy.integers(2, 5), count=strategy.integers(20, 60))
def test_ranks_share_the_batches_of_one_rank(ranks: int, count: int) -> None:
    whole = order(count, drop_last=True).batches(1)
    parts = [order(count, rank=r, ranks=ranks) for r in range(ranks)]
    assert len({len(part) for part in parts}) == 1  # or ranks would wait for one another for ever
    together = [batch.tolist() for step in zip(*(p.batches(1) for p in parts), strict=True) for batch in step]
    assert together == [b.tolist() for b in whole[: len(together)]]
    assert len(whole) - len(together) < ranks


def test_an_epoch_is_another_order_and_a_seed_another_sequence() -> None:
    orders = [order(seed=s).of_epoch(e).tolist() for s, e in itertools.product((0, 5), (0, 1))]
    assert len({tuple(o) for o in orders}) == 4
    assert all(sorted(o) == list(range(50)) for o in orders)
    assert order(shuffle=False).of_epoch(3).tolist() == list(range(50))


def test_the_order_is_the_same_in_every_version() -> None:
    """It is made of hashes; a change would make saved states continue with other samples."""
    assert order(12).of_epoch(2).tolist() == [8, 5, 9, 7, 11, 10, 6, 4, 0, 2, 3, 1]


def test_samples_of_a_shard_are_read_close_together() -> None:
    """A sample moves by less than the buffer from its place in the sequence of shards."""
    plan = order(4000, buffer=40)
    of_shard: dict[int, list[int]] = {}
    for place, sample in enumerate(plan.of_epoch(0).tolist()):
        of_shard.setdefault(sample // 4, []).append(place)
    assert max(max(places) - min(places) for places in of_shard.values()) < 2 * 40 + 4
    first = [places[0] for _, places in sorted(of_shard.items())]
    assert abs(np.corrcoef(first, np.arange(len(first)))[0, 1]) < 0.1  # the shards are shuffled


def test_a_large_buffer_makes_every_order_equally_likely() -> None:
    plan = order(6, buffer=6, batch_size=6)
    first = np.bincount([plan.of_epoch(e)[0] for e in range(3000)], minlength=6)
    # 5 degrees of freedom: above 20.5 with a probability of 0.001
    assert ((first - 500) ** 2 / 500).sum() < 20.5


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"batch_size": 0}, "batch_size = 0: must be a whole number of at least 1"),
        ({"seed": -1}, "seed = -1: must be a whole number of at least 0"),
        ({"buffer": 2.5}, r"buffer = 2\.5: must be a whole number of at least 1"),
        ({"rank": 2, "ranks": 2}, "rank = 2: must be below ranks = 2"),
        ({"batch_size": 30, "ranks": 2}, "50 samples make no whole batch for each of 2 ranks; must be at most 25"),
    ],
)
def test_a_wrong_order_is_refused_in_one_sentence(changes: dict, says: str) -> None:
    with pytest.raises(InputError, match=says):
        order(**changes)


def test_a_state_continues_its_own_order_only() -> None:
    state = json.loads(json.dumps(order().state(3, 7)))
    assert order().position(state) == (3, 7)
    for changes, says in (
        ({"batch_size": 4}, "state: its batch_size = 3, but here batch_size = 4"),
        ({"seed": 6}, "state: its seed = 5, but here seed = 6"),
        ({"samples": np.arange(49)}, "state: it belongs to other samples"),
        ({"shard_samples": 5}, "state: it belongs to other samples"),
    ):
        with pytest.raises(InputError, match=says):
            order(**changes).position(state)
    for wrong in ({"epoch": -1, "batch": 0}, {"epoch": 10**30, "batch": 0}, {"epoch": 0, "batch": True}, {}):
        with pytest.raises(InputError, match="must hold epoch and batch"):
            order().position(state | {"epoch": None} | wrong)


# --- selection ----------------------------------------------------------------------------------------------


def test_samples_are_chosen_by_split_fault_and_value(finished_store: Path) -> None:
    store = st.open_store(finished_store)
    split, injected = store.read("split"), store.read("injected")
    elevation = store.read("sun_elevation_deg")
    everything = np.arange(store.samples)
    assert select(store).tolist() == everything.tolist()
    assert select(store, "val").tolist() == everything[split == "val"].tolist()
    dusty = injected[:, FAULTS.index("dust_on_optics")]
    assert select(store, containing=["dust_on_optics"]).tolist() == everything[dusty].tolist()
    assert 0 < dusty.sum() < store.samples
    either = dusty | injected[:, FAULTS.index("straylight")]
    assert select(store, containing=["dust_on_optics", "straylight"]).tolist() == everything[either].tolist()
    assert dusty.sum() < either.sum()
    high = select(store, "train", where=lambda c: (c["sun_elevation_deg"] > 0) & (c["split"] != "val"))
    assert high.tolist() == everything[(split == "train") & (elevation > 0)].tolist()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"split": "tests"}, "split = 'tests': must be one of train, val, test, or None"),
        ({"containing": ["rain"]}, "containing: 'rain' is no fault class of .*; known: dust_on_optics"),
        ({"containing": []}, "no finished sample fits containing = \\[\\]"),
        ({"where": lambda c: c["site"]}, r"where: it returned int32\[10\]; must be bool\[10\]"),
        ({"where": lambda c: c["site"] > 9, "split": "val"}, "no finished sample fits split = val, where = …"),
    ],
)
def test_a_wrong_choice_is_refused_in_one_sentence(finished_store: Path, given: dict, says: str) -> None:
    with pytest.raises(InputError, match=says):
        select(st.open_store(finished_store), **given)


def test_unfinished_samples_are_left_out_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(), 10)
    st.write_samples(store, [fake_sample(store.spec, i) for i in (1, 8)])
    assert select(store).tolist() == [1, 8]
    assert "2 of 10 samples are finished; the others are left out" in caplog.text
    columns = Columns(store)
    assert columns["tries"].tolist() == [1, 1]
    with pytest.raises(KeyError, match="no such value of a sample"):
        columns["image"]


# --- targets ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(finished_store: Path) -> st.Store:
    return st.open_store(finished_store)


def read(store: st.Store, samples: list[int], names: list[str], threads: int = 1, **options: object) -> dict:
    targets = Targets(store, names, **options)  # type: ignore[arg-type]
    source = SampleReader(store, targets, threads)
    layers = source.buffers(len(samples))
    scalars = source.fill(samples, layers)
    source.close()
    return targets.make(layers, scalars)


@pytest.mark.parametrize("threads", [1, 3])
def test_targets_are_what_was_written(store: st.Store, threads: int) -> None:
    chosen = [9, 2, 2, 5]
    batch = read(store, chosen, [*TARGETS, "raw", "radiance", "sun_xy_px"], threads)
    written = [fake_sample(store.spec, i) for i in chosen]
    assert next(iter(batch)) == "image"
    for name, layer in {"image": "image", "clean": "clean", "normal": "normal"}.items():
        assert np.array_equal(batch[name], [w.layers[layer].transpose(2, 0, 1) for w in written])
    for name, layer in {"masks": "mask", "depth": "depth_m", "semantic": "semantic", "raw": "raw"}.items():
        assert np.array_equal(batch[name], [w.layers[layer] for w in written])
    assert batch["classes"].dtype == np.float32
    assert np.array_equal(batch["classes"], [w.scalars["injected"] for w in written])
    pose = [[*w.scalars["camera_position_T_m"], *w.scalars["camera_from_T"]] for w in written]
    assert np.array_equal(batch["pose"], pose)
    assert batch["radiance"].shape == (4, 3, 24, 32)
    assert batch["sun_xy_px"].shape == (4, 2)


def test_classes_are_a_subset_in_the_order_asked_for(store: st.Store) -> None:
    batch = read(
        store, [0, 1, 2, 3], ["masks", "classes"], classes=["straylight", "dust_on_optics"], masks="effect"
    )
    written = [fake_sample(store.spec, i) for i in range(4)]
    assert np.array_equal(batch["masks"], [w.layers["mask_effect"][[2, 0]] for w in written])
    assert np.array_equal(batch["classes"], [w.scalars["injected"][[2, 0]] for w in written])


def test_instances_are_the_connected_regions_of_localised_classes(store: st.Store) -> None:
    for i in range(6):
        mask = fake_sample(store.spec, i).layers["mask"]
        instances = read(store, [i], ["instances"])["instances"][0]
        assert np.array_equal(instances > 0, mask)
        whole = FAULTS.index("vignetting")
        assert set(np.unique(instances[whole])) <= {0, 1}
    apart = np.zeros((1, len(FAULTS), 4, 7), bool)
    apart[..., 1, [1, 5]] = True
    most = Targets(store, ["instances"])._instances(apart)[0].max(axis=(1, 2))
    assert most.tolist() == [2 if name in (store.spec.localised_faults or ()) else 1 for name in FAULTS]
    assert set(most.tolist()) == {1, 2}


def test_regions_are_numbered_by_their_first_pixel() -> None:
    mask = np.zeros((5, 7), dtype=bool)
    mask[0, 6] = mask[1, 1] = mask[2, 2] = mask[2, 0] = mask[4, 4] = True
    numbers = regions(mask)
    assert [int(numbers[y, x]) for y, x in ((0, 6), (1, 1), (2, 2), (2, 0), (4, 4))] == [1, 2, 2, 2, 3]
    assert np.array_equal(numbers > 0, mask)


@pytest.mark.parametrize(
    ("names", "options", "says"),
    [
        (["mask_any", "depht"], {}, r"targets: 'depht' is no target.* \(did you mean depth\?\)"),
        (["parameters"], {}, "targets: 'parameters' is no target"),
        (3, {}, "targets = 3: must be a list of names"),
        (["masks"], {"masks": "both"}, "masks = 'both': must be one of footprint, effect"),
        (["masks"], {"classes": ["fog"]}, "classes: 'fog' is no fault class"),
        (["masks"], {"classes": ["straylight", "straylight"]}, "a class is named twice"),
    ],
)
def test_a_wrong_target_is_refused_in_one_sentence(store: st.Store, names: Any, options: dict, says: str) -> None:
    with pytest.raises(InputError, match=says):
        Targets(store, names, **options)


def test_a_layer_that_the_store_lacks_is_named(tmp_path: Path) -> None:
    small = filled(tmp_path / "s.zarr", 1, layers=())
    with pytest.raises(InputError, match=r"it has no layer depth_m, which depth needs; add it to dataset\.layers"):
        Targets(small, ["depth"])


# --- reading ahead --------------------------------------------------------------------------------------------


def test_each_chunk_is_read_once_and_each_file_opened_once(
    store: st.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched = recorded_calls(monkeypatch, st.ShardReader, "fetch")
    source = SampleReader(store, Targets(store, ["masks"]))
    sequence = [5, 0, 6, 9, 1, 4, 2, 8]
    for k in range(0, 8, 2):
        source.fill(sequence[k : k + 2], source.buffers(2), sequence[k + 2 :])
    source.close()
    assert sorted((number, samples) for _, number, samples in fetched) == [
        (0, [0, 1, 2]),
        (1, [4, 5, 6]),
        (2, [8, 9]),
    ]


def test_what_is_held_ahead_is_limited(store: st.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "READ_AHEAD_BYTES", 0)
    source = SampleReader(store, Targets(store, ["masks"]))
    sequence = [0, 1, 2, 3]
    for k in range(4):
        source.fill(sequence[k : k + 1], source.buffers(1), sequence[k + 1 :])
        source._wait()
        assert len(source._held) <= 1
    source.close()


def test_scalars_of_the_latest_shards_are_kept(store: st.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "SHARDS_OF_SCALARS", 2)
    source = SampleReader(store, Targets(store, ["classes"]))
    for i in (0, 4, 8, 5):
        source.fill([i], source.buffers(1))
    assert list(source._scalars) == [1, 2]
    source.close()


def test_reading_loads_neither_renderer_nor_zarr(finished_store: Path) -> None:
    code = f"""
import sys
from vbnfault import store
from vbnfault.train import SampleReader, Targets, select
opened = store.open_store({str(finished_store)!r})
source = SampleReader(opened, Targets(opened, ["masks", "classes", "pose"]))
source.fill(select(opened, "train")[:2], source.buffers(2))
source.close()
print(sorted({{"zarr", "xarray", "pydantic", "scipy", "cv2", "mitsuba", "drjit", "torch"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_store_is_read_where_the_renderer_is_not_installed(finished_store: Path) -> None:
    code = f"""
import sys

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("mitsuba", "drjit"):
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, NotInstalled())
import vbnfault
print(vbnfault.open_dataset({str(finished_store)!r}).sizes["sample"])
try:
    import torch
except ModuleNotFoundError:
    print(10)
else:
    from vbnfault.torch import BatchDataset, Loader, SampleDataset
    data = SampleDataset({str(finished_store)!r}, None, ["masks", "instances", "pose"])
    print(sum(len(batch["image"]) for batch in Loader(BatchDataset(data, batch_size=4), num_workers=1)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["10", "10"]


def test_without_pytorch_its_layer_says_what_to_install() -> None:
    code = """
import sys
sys.modules["torch"] = None
import vbnfault
print(vbnfault.torch.__all__)
try:
    from vbnfault.torch import Loader
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names, sentence = done.stdout.splitlines()
    assert "SampleDataset" in names
    assert sentence == (
        "vbnfault.torch.Loader needs PyTorch, which is not installed: pip install 'vbnfault[torch]'"
    )
