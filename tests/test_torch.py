"""`vbnfault.torch`: one sequence of batches for any workers, states, transforms, lost workers, damaged samples."""

from __future__ import annotations

import gc
import json
import os
import re
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from s3_server import BUCKET, S3Server, in_environment
from synthetic import FAULTS, fake_sample, flip

import vbnfault
from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.dataset.merge import join_stores

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from torch.utils.data import DataLoader  # noqa: E402

from vbnfault.torch import BatchDataset, Loader, SampleDataset, ShardSampler  # noqa: E402

TARGETS = ("masks", "classes", "pose", "depth")
Rows = list[tuple[list[int], int, int]]


@pytest.fixture(autouse=True)
def _few_cores() -> Iterator[None]:
    """PyTorch warns of more workers than cores."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="This DataLoader will create")
        yield


def data(path: Path | str, **changes: Any) -> SampleDataset:
    return SampleDataset(path, targets=TARGETS, **changes)


def batches(path: Path | str, **changes: Any) -> BatchDataset:
    return BatchDataset(data(path), **{"batch_size": 2, "seed": 3, "buffer": 4, **changes})


def rows(loader: Any) -> Rows:
    """Return samples and contents of each batch as plain data."""
    return [row(batch) for batch in loader]


def row(batch: dict[str, Any]) -> tuple[list[int], int, int]:
    contents = sum(int(np.frombuffer(v.numpy().tobytes(), np.uint8).sum()) for k, v in batch.items())
    return batch["sample"].tolist(), contents, int(batch["masks"].sum())


def expected(path: Path, epoch: int = 0) -> list[list[int]]:
    return [batch.tolist() for batch in batches(path).order.batches(epoch)]


# --- samples --------------------------------------------------------------------------------------------


def test_a_sample_is_what_was_written(finished_store: Path) -> None:
    dataset = data(finished_store, split="val")
    assert vbnfault.torch.SampleDataset is SampleDataset
    assert dataset.classes == FAULTS
    for k, index in enumerate(dataset.samples.tolist()):
        sample, written = dataset[k], fake_sample(st.open_store(finished_store).spec, index)
        assert int(sample["sample"]) == index
        assert sample["image"].dtype == torch.uint8
        assert np.array_equal(sample["image"].permute(1, 2, 0).numpy(), written.layers["image"])
        assert np.array_equal(sample["masks"].numpy(), written.layers["mask"])
        assert np.array_equal(sample["depth"].numpy(), written.layers["depth_m"])
    with pytest.raises(IndexError):
        dataset[len(dataset)]


def test_weights_balance_classes_and_pixels(finished_store: Path) -> None:
    dataset, store = data(finished_store), st.open_store(finished_store)
    injected, mask = store.read("injected"), store.read("mask")
    positive = injected.sum(axis=0)
    assert np.allclose(dataset.class_weights().numpy(), (len(injected) - positive) / positive)
    inside = mask.mean(axis=(0, 2, 3))
    assert np.allclose(dataset.pixel_weights().numpy(), (1 - inside) / inside)
    two = SampleDataset(finished_store, targets=["masks"], classes=["vignetting", "straylight"])
    assert np.allclose(two.pixel_weights().numpy(), ((1 - inside) / inside)[[3, 2]])
    clear = ~injected[:, 0].astype(bool)
    without = data(finished_store, where=lambda scalars: ~scalars["injected"][:, 0].astype(bool))
    positive = injected[clear].sum(axis=0)
    wanted = np.where(positive > 0, (clear.sum() - positive) / np.maximum(positive, 1), 1)
    assert 0 < clear.sum() < len(injected)
    assert np.allclose(without.class_weights().numpy(), wanted)
    assert without.class_weights()[0] == without.pixel_weights()[0] == 1  # of a class that never occurs
    with pytest.raises(InputError, match="most = 0: must be a whole number of at least 1"):
        dataset.pixel_weights(most=0)
    with pytest.raises(InputError, match="the dataset reads no masks; add masks to targets"):
        SampleDataset(finished_store).pixel_weights()


# --- one sequence for any number of workers -------------------------------------------------------------


@pytest.mark.parametrize(("workers", "start"), [(1, "fork"), (2, "fork"), (4, "fork"), (2, "spawn")])
def test_every_number_of_workers_gives_the_same_batches(finished_store: Path, workers: int, start: str) -> None:
    alone, loader = (
        Loader(batches(finished_store)),
        Loader(batches(finished_store), num_workers=workers, multiprocessing_context=start),
    )
    for epoch in range(2):  # the workers of the first epoch live on
        given = rows(alone)
        assert rows(loader) == given
        assert [samples for samples, _, _ in given] == expected(finished_store, epoch)
        assert loader.epoch == alone.epoch == epoch + 1


def test_stores_in_a_bucket_give_the_same_batches(finished_store: Path, s3_server: S3Server) -> None:
    """With threads and with spawned workers; forked ones, which would wait for ever, are refused in a sentence."""
    with in_environment(s3_server):
        url = f"s3://{BUCKET}/trained.zarr"
        join_stores([finished_store], url, progress=False)
        for workers in (0, 1):
            loader = Loader(batches(url), num_workers=workers)
            assert rows(loader) == rows(Loader(batches(finished_store)))
        with pytest.raises(InputError, match="'fork': forked workers cannot read an object store"):
            Loader(batches(url), num_workers=1, multiprocessing_context="fork")
        plain = DataLoader(batches(url), batch_size=None, num_workers=1, multiprocessing_context="fork")
        with pytest.raises(InputError, match="a forked process cannot read an object store"):
            next(iter(plain))


def test_plain_loaders_give_the_same_batches(finished_store: Path) -> None:
    alone = rows(Loader(batches(finished_store)))
    assert rows(DataLoader(batches(finished_store), batch_size=None, num_workers=2)) == alone
    dataset = data(finished_store)
    sampler = ShardSampler(dataset, batch_size=2, seed=3, buffer=4)
    loader: Any = DataLoader(dataset, batch_sampler=sampler, num_workers=2)
    assert rows(loader) == alone
    assert len(loader) == len(alone) == 5
    sampler.load_state_dict(json.loads(json.dumps(sampler.state_dict(3))))
    assert rows(DataLoader(dataset, batch_sampler=sampler)) == alone[3:]
    sampler.set_epoch(1)
    assert [b.tolist() for b in map(dataset.samples.__getitem__, sampler)] == expected(finished_store, 1)


def test_ranks_share_an_epoch(finished_store: Path) -> None:
    parts = [rows(Loader(batches(finished_store, ranks=(r, 2), seed=1), num_workers=2)) for r in range(2)]
    whole = rows(Loader(batches(finished_store, drop_last=True, seed=1)))
    assert [one for step in zip(*parts, strict=True) for one in step] == whole[:4]


# --- states ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("before", "after"), [(0, 2), (2, 0), (2, 1)])
def test_a_run_continues_in_mid_epoch(finished_store: Path, before: int, after: int) -> None:
    whole = Loader(batches(finished_store))
    wanted = rows(whole) + rows(whole)
    first, got = Loader(batches(finished_store), num_workers=before), []
    for k, batch in enumerate(first):
        got.append(row(batch))
        if k == 2:
            break
    state = json.loads(json.dumps(first.state_dict()))
    second = Loader(batches(finished_store), num_workers=after)
    second.load_state_dict(state)
    assert got + rows(second) + rows(second) == wanted
    assert rows(first) == wanted[:5]  # left early and without a state, an epoch begins again


@pytest.mark.parametrize("state", [None, [], 5, "x"])
def test_what_is_no_state_is_refused(finished_store: Path, state: Any) -> None:
    for of in (batches(finished_store), ShardSampler(data(finished_store)), Loader(batches(finished_store))):
        with pytest.raises(InputError, match=r"^state = .*: must be what state_dict\(\) returned, a mapping$"):
            of.load_state_dict(state)


@pytest.mark.parametrize("batch", [10**6, 6, -1, "x", None])
def test_a_batch_beyond_the_epoch_is_refused(finished_store: Path, batch: Any) -> None:
    of, loader = batches(finished_store), Loader(batches(finished_store))
    assert len(of) == 5
    for use in (of.state_dict, lambda batch: of.set_epoch(0, batch)):
        with pytest.raises(InputError, match=r"^batch = .*: must be a whole number from 0 to 5, the batches of an"):
            use(batch)
    with pytest.raises(InputError, match="whole number"):
        loader.load_state_dict({**loader.state_dict(), "batch": batch})
    of.set_epoch(0, np.int64(5))


def test_arguments_of_another_kind_are_refused(finished_store: Path) -> None:
    wrong: Any
    for wrong in (5, "ab", (1,), (0, 1, 2)):
        with pytest.raises(InputError, match=r"^ranks = .*: must be two whole numbers"):
            batches(finished_store, ranks=wrong)
    for key in ("containing", "classes", "where", "transform", "masks"):
        wrong = [5] if key == "masks" else 5
        with pytest.raises(InputError, match=f"^{key} = .*: must be "):
            SampleDataset(finished_store, **{key: wrong})


@pytest.mark.parametrize("epoch", [-1, 10**30, 1.0, "x", None, True])
def test_an_epoch_that_is_none_is_refused_at_once(finished_store: Path, epoch: Any) -> None:
    made = data(finished_store)
    for of in (made, ShardSampler(made), batches(finished_store), Loader(batches(finished_store))):
        with pytest.raises(InputError, match=r"^epoch = .*: must be a whole number from 0 to 2⁶³ - 1$"):
            of.set_epoch(epoch)
        of.set_epoch(np.int64(3))


def test_options_that_belong_elsewhere_are_refused(finished_store: Path) -> None:
    with pytest.raises(InputError, match="shuffle: a Loader takes it from its BatchDataset; give it there"):
        Loader(batches(finished_store), shuffle=True)
    with pytest.raises(InputError, match="num_workers = -1: must be a whole number of at least 0"):
        Loader(batches(finished_store), num_workers=-1)


def test_what_is_no_dataset_is_refused(finished_store: Path) -> None:
    wrong: Any = 3
    for of in (BatchDataset, ShardSampler):
        with pytest.raises(InputError, match="data = 3: must be a SampleDataset"):
            of(wrong, batch_size=2)
    with pytest.raises(InputError, match=r"batches = .*: must be a BatchDataset"):
        Loader(data(finished_store))


# --- transforms -----------------------------------------------------------------------------------------


def flipped_at_random(sample: dict[str, Any]) -> dict[str, Any]:
    """Flip a sample as an augmentation does, with the random numbers of PyTorch."""
    turned = bool(torch.rand(()) < 0.5)
    image = sample["image"].flip(-1) if turned else sample["image"]
    return {**sample, "image": image, "draw": torch.rand(2)}


def test_random_numbers_of_a_transform_depend_on_the_sample_alone(finished_store: Path) -> None:
    def run(workers: int, **options: Any) -> list[dict[int, list[float]]]:
        dataset = data(finished_store, transform=flipped_at_random)
        loader = Loader(BatchDataset(dataset, **{"batch_size": 2, **options}), num_workers=workers)
        drawn: list[dict[int, list[float]]] = [{}, {}]
        for of_epoch in drawn:
            for batch in loader:
                of_epoch |= dict(zip(batch["sample"].tolist(), batch["draw"].tolist(), strict=True))
        return drawn

    before = torch.get_rng_state()
    alone = run(0)
    assert torch.equal(torch.get_rng_state(), before)  # the program's own random numbers go on
    assert run(2) == run(0, batch_size=3, buffer=9) == alone
    assert alone[0] != alone[1]  # another epoch, another augmentation
    assert len({tuple(draw) for draw in alone[0].values()}) == 10
    assert run(0, seed=8) != alone


# --- memory that is used again --------------------------------------------------------------------------


def test_a_batch_that_is_kept_is_not_written_over(finished_store: Path) -> None:
    loader = Loader(batches(finished_store), num_workers=1, prefetch_factor=1)
    kept = [batch for _ in range(3) for batch in loader]  # more than there are slots
    wanted: Rows = []
    alone = Loader(batches(finished_store))
    for _ in range(3):
        wanted += rows(alone)
    assert rows(kept) == wanted


def test_a_slot_is_free_when_its_last_tensor_is_gone(finished_store: Path) -> None:
    loader = Loader(batches(finished_store), num_workers=1, prefetch_factor=1)
    first = next(iter(loader))
    slots = loader._slots
    assert slots is not None
    part, used = first["image"][:, :1], set(slots._used)
    assert len(used) == 1
    del first
    gc.collect()
    assert slots._used == used
    del part
    gc.collect()
    assert not slots._used & used
    for _ in range(3):
        for batch in loader:
            del batch
    assert not slots._used


def test_a_loader_without_workers_uses_its_memory_again(
    finished_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vbnfault.train.datasets.new_tensors", pytest.fail)
    loader = Loader(batches(finished_store))
    places = {batch["image"].untyped_storage().data_ptr() for _ in range(3) for batch in loader}
    assert len(places) <= 2


def test_batches_are_read_as_usual_after_a_loader(finished_store: Path) -> None:
    source = batches(finished_store)
    wanted = rows(Loader(source, num_workers=1))
    source.set_epoch(0)
    assert rows(source) == wanted
    assert rows(DataLoader(source, batch_size=None, num_workers=1)) == wanted


def test_an_iteration_that_is_left_drops_what_was_read_ahead_and_keeps_the_reader(finished_store: Path) -> None:
    source = batches(finished_store, buffer=8)
    left: Any = iter(source)
    next(left)
    opened = source.data._reader
    assert opened is not None
    assert opened[1]._held
    left.close()
    assert not opened[1]._held
    assert len(rows(source)) == len(source)
    assert source.data._reader is opened  # it knows which layers it has compared with their checksums


# --- what goes wrong ------------------------------------------------------------------------------------


class DiesOnce:
    """Kill the worker at one sample, the first time only; or each time."""

    def __init__(self, flag: Path, sample: int, again: bool = False) -> None:
        self.flag, self.sample, self.again = flag, sample, again

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        if int(sample["sample"]) == self.sample and (self.again or not self.flag.exists()):
            self.flag.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return sample


def test_a_worker_that_dies_loses_nothing(
    finished_store: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fourth = expected(finished_store)[3][0]
    dataset = data(finished_store, transform=DiesOnce(tmp_path / "died", fourth))
    loader = Loader(BatchDataset(dataset, batch_size=2, seed=3, buffer=4), num_workers=2)
    handler = signal.getsignal(signal.SIGCHLD)
    got = rows(loader)
    (said,) = (record.getMessage() for record in caplog.records)
    assert re.search(r"a loader worker died \(.*; new workers go on from there$", said)
    assert got == rows(Loader(batches(finished_store)))
    assert signal.getsignal(signal.SIGCHLD) is handler


@pytest.mark.expects_warnings  # of the workers that die
def test_workers_that_keep_dying_end_in_one_sentence(finished_store: Path, tmp_path: Path) -> None:
    third = expected(finished_store)[2][0]
    dataset = data(finished_store, transform=DiesOnce(tmp_path / "died", third, again=True))
    loader = Loader(BatchDataset(dataset, batch_size=2, seed=3, buffer=4), num_workers=1)
    got: Rows = []
    with pytest.raises(VbnfaultError) as caught:
        got.extend(map(row, loader))
    message = str(caught.value)
    # what the worker had finished may die with it, so this is batch 2 or the one before
    assert re.search(r"before batch [12] of epoch 0, twice; nothing is lost: state_dict\(\) continues", message)
    assert "\n" not in message
    well = Loader(batches(finished_store))
    well.load_state_dict(loader.state_dict())
    assert got + rows(well) == rows(Loader(batches(finished_store)))


@pytest.mark.parametrize("workers", [0, 2])
def test_a_damaged_sample_is_named_in_one_sentence(whole: st.Store, workers: int) -> None:
    flip(whole.file("mask", 1), 40)
    loader = Loader(batches(whole.path), num_workers=workers)
    with pytest.raises(VbnfaultError) as caught:
        rows(loader)
    message = str(caught.value)
    assert message.startswith(f"{whole.path}: mask of sample 4 ")
    assert message.endswith("; the build command repairs it")
    assert "\n" not in message
    st.write_samples(whole, [fake_sample(whole.spec, 4)])
    loader.load_state_dict(loader.state_dict())
    rest = rows(loader)
    assert rest == rows(Loader(batches(whole.path)))[-len(rest) :]


def test_an_error_of_a_transform_keeps_its_traceback(finished_store: Path) -> None:
    dataset = data(finished_store, transform=lambda sample: sample["nothing"])
    with pytest.raises(KeyError, match="nothing"):
        rows(Loader(BatchDataset(dataset), num_workers=1))


# --- starting a worker ----------------------------------------------------------------------------------
