"""Training of detectors: the same weights again, after a kill, too; labels, losses, files, and every mistake."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Called
from synthetic import FAULTS, fake_sample, make_spec

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.process.interrupts import Interrupted
from vbnfault.faults import Levels

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from vbnfault.detect import training  # noqa: E402
from vbnfault.detect.losses import loss_of  # noqa: E402
from vbnfault.detect.model_files import CARD, FIGURE, ONNX, ONNX_WITHIN  # noqa: E402
from vbnfault.detect.networks import (  # noqa: E402
    ARCHITECTURES,
    CHECKPOINT,
    MODEL,
    WEIGHTS,
    Outputs,
    load_detector,
    new_network,
    start_from,
)
from vbnfault.detect.training import TrainOptions, rate_at, train  # noqa: E402
from vbnfault.detect.training_data import Labelled, TrainingData, may_be_mirrored  # noqa: E402

SIZE = 64
SMALL: dict[str, Any] = {"epochs": 2, "batch_size": 2, "crop_px": 32}
GRAINS = 64  # of dust: level 2 of the packaged table in frames of 256 px


def made(path: Path, samples: int = 10, **changes: Any) -> str:
    """Write a store of made-up samples of 64 x 72 px, whose faults show; return its path."""
    models = dict.fromkeys(FAULTS, "texture") | {"dust_on_optics": "gaussian", "vignetting": "cos4"}
    attributes = {"scene": {"body": {"name": "67P"}, "samples": samples}, "scene_hash": "abc", "seed": 7}
    spec = make_spec(**{"size": SIZE, "attributes": attributes | {"fault_models": models}, **changes})
    store = st.create(path, spec, samples)
    drawn = {"dust_on_optics": {"model": "gaussian", "x_px": [0.5] * GRAINS}}
    st.write_samples(store, [with_parameters(fake_sample(spec, i), drawn) for i in range(samples)])
    return str(path)


def with_parameters(sample: Any, drawn: dict[str, Any]) -> Any:
    """Return a sample whose present faults have these parameters, and others none that say a level."""
    names = sample.scalars["parameters"]
    parameters = {name: drawn.get(name, {"model": "texture"}) for name in names}
    return dataclasses.replace(sample, scalars={**sample.scalars, "parameters": parameters})


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> str:
    return made(tmp_path_factory.mktemp("data") / "a.zarr")


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A dataset of other size, with the classes in another order and one more."""
    return made(tmp_path_factory.mktemp("data") / "b.zarr", samples=4, size=40)


@pytest.fixture(scope="module")
def trained(path: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    train([path], out, TrainOptions(**SMALL))
    return out


def weights(out: Path) -> bytes:
    return (out / WEIGHTS).read_bytes()


# --- the same weights ---------------------------------------------------------------------------------------------


def test_a_seed_gives_its_weights_again_and_another_seed_others(path: str, trained: Path, tmp_path: Path) -> None:
    state = torch.get_rng_state()
    train([path], tmp_path / "again", TrainOptions(**SMALL), workers=1)
    assert weights(tmp_path / "again") == weights(trained)
    assert torch.equal(torch.get_rng_state(), state)  # the program's own random numbers go on
    train([path], tmp_path / "other", TrainOptions(**SMALL, seed=1))
    assert weights(tmp_path / "other") != weights(trained)


def losses(out: Path) -> list[tuple[float, float]]:
    """The losses by epoch: those of the validation depend on every weight, also where an earlier epoch was kept."""
    return [(one["train_loss"], one["val_loss"]) for one in json.loads((out / MODEL).read_text())["epochs"]]


@pytest.mark.parametrize("how", ["killed", "interrupted", "killed in the validation", "killed, with dropout"])
def test_a_training_that_was_stopped_goes_on_to_the_same_weights(
    path: str, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Killed in a step, as by a loss of power, or interrupted; in the second epoch of two, of two steps each."""
    update, steps, options = training._Run._update, [], TrainOptions(**SMALL)
    if how == "killed, with dropout":
        if not has_torchvision():
            pytest.skip("torchvision is not installed: pip install '.[torch]'")
        options = TrainOptions(**SMALL, architecture="deeplabv3_mobilenet_v3_large")
        trained = tmp_path / "whole"
        train([path], trained, options)

    now, sent = threading.Event(), threading.Event()

    def send() -> None:
        if now.wait(60):
            signal.raise_signal(signal.SIGINT)
        sent.set()

    def judged(run: Any, batch: Any) -> Any:
        """Interrupt a step between its halves; the signal reaches another thread, as it may with many threads."""
        said = type(run)._judged(run, batch)
        now.set()
        assert sent.wait(60)
        return said

    if how == "interrupted":
        threading.Thread(target=send).start()

    def stop(run: Any, batch: Any) -> None:
        steps.append(run.step)
        if len(steps) == 3 and how == "interrupted":
            run._judged = partial(judged, run)
        update(run, batch)
        if len(steps) == 4 and how.startswith("killed"):
            raise RuntimeError("killed")

    def unable(run: Any) -> None:
        raise RuntimeError("killed")

    monkeypatch.setattr(training._Run, "_update", stop)
    # of the killed one, only what was written before the step is left
    monkeypatch.setattr(training, "_CHECKPOINT_EVERY_S", 60.0 if how == "interrupted" else 0.0)
    if how == "killed in the validation":
        monkeypatch.setattr(training._Run, "_validated", unable)
    out = tmp_path / "model"
    with pytest.raises((RuntimeError, Interrupted)):
        train([path], out, options)
    assert (out / CHECKPOINT).is_file()
    assert not (out / MODEL).exists()
    with pytest.raises(InputError, match="its training is not finished; the command that began it continues it"):
        load_detector(out)
    monkeypatch.undo()
    before = len(steps)
    monkeypatch.setattr(training._Run, "_update", lambda run, batch: (steps.append(run.step), update(run, batch)))
    train([path], out, options)
    assert losses(out) == losses(trained)
    assert weights(out) == weights(trained)
    assert not (out / CHECKPOINT).exists()
    assert len(steps) < before + 4  # it went on, and did not begin again


def test_a_finished_training_returns_at_once_and_another_one_is_refused(
    path: str, other: str, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "_Run", pytest.fail)
    record = train([path], trained, TrainOptions(**SMALL))
    assert record == json.loads((trained / MODEL).read_text())
    for stores, changes, says in (
        ([path], {"batch_size": 3}, "holds a training with batch_size = 2, not 3; choose another --out"),
        ([path], {"classes": FAULTS[:2]}, "holds a training with classes = .*, not "),
        ([path], {"architecture": ARCHITECTURES[1]}, "holds a training with architecture = 'unet', not 'lraspp"),
        ([other], {}, r"holds a training on a.zarr \(.*\), not on b.zarr \("),
        ([path, other], {}, "holds a training on a.zarr"),
    ):
        with pytest.raises(InputError, match=says):
            train(stores, trained, TrainOptions(**{**SMALL, **changes}))


# --- what is learned ----------------------------------------------------------------------------------------------


@pytest.mark.expects_warnings
def test_a_network_learns_three_images_by_heart(tmp_path: Path) -> None:
    """One of them has a disc of 12 px in radius: whoever marks the whole of all has an IoU of 0.03.

    Who is off by 2 px everywhere at the rim has (10 / 12)² = 0.69; nothing makes 60 steps exact to a pixel.
    """
    store = st.open_store(made(tmp_path / "few.zarr", samples=3))  # all of the training split
    options = TrainOptions(classes=("straylight",), epochs=60, batch_size=3, learning_rate=1e-2)
    train([str(store.path)], tmp_path / "model", options)
    said = load_detector(tmp_path / "model").predict(store.read("image"))
    truth = store.read("mask_effect")[:, FAULTS.index("straylight")]
    assert 0.01 < truth.mean() < 0.04
    marked = np.stack([one.masks[0] > 0.5 for one in said])
    assert (marked & truth).sum() / (marked | truth).sum() > 0.6
    assert [one.present[0] > 0.5 for one in said] == truth.any(axis=(1, 2)).tolist()
    usable = 1 - store.read("mask_any").mean(axis=(1, 2))  # from 0.83 to 0.96
    assert np.abs([one.usable_fraction for one in said] - usable).max() < 0.06


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_architecture_trains_and_predicts_images_of_any_size(
    path: str, tmp_path: Path, architecture: str
) -> None:
    if architecture != ARCHITECTURES[0] and not has_torchvision():
        pytest.skip("torchvision is not installed: pip install '.[torch]'")
    out = tmp_path / "model"
    record = train([path], out, TrainOptions(architecture=architecture, epochs=1, batch_size=3, crop_px=32))
    assert record["parameters"] == sum(p.numel() for p in new_network(architecture, len(FAULTS)).parameters())
    assert math.isfinite(record["epochs"][0]["train_loss"])
    detector = load_detector(out, "cpu")
    assert detector.classes == FAULTS
    images = np.random.default_rng(0).integers(0, 256, (2, 45, 70, 4), dtype=np.uint8)
    one, two = detector.predict(images)
    assert one.masks.shape == (len(FAULTS), 45, 70)
    assert one.present.shape == one.severity.shape == (len(FAULTS),)
    assert 0 <= one.masks.min() <= one.masks.max() <= 1
    assert 0 <= one.severity.min() <= one.severity.max() <= 5
    assert 0 <= one.usable_fraction <= 1
    alone = detector.predict(images[1:])[0]
    assert np.allclose(alone.masks, two.masks, atol=1e-5)  # float32 sums in another order
    assert detector.predict(images[:0]) == []
    with pytest.raises(InputError, match=r"images: float64\[2, 45, 70, 4\]: must be uint8\[sample, y, x, 4\]"):
        detector.predict(images / 255)  # type: ignore[arg-type]


def has_torchvision() -> bool:
    try:
        new_network(ARCHITECTURES[1], 1)
    except InputError:
        return False
    return True


def test_crops_of_any_size_train(tmp_path: Path) -> None:
    store = made(tmp_path / "odd.zarr", size=50)
    train([store], tmp_path / "model", TrainOptions(epochs=1, batch_size=2, crop_px=37))
    (said,) = load_detector(tmp_path / "model").predict(np.zeros((1, 50, 58, 4), np.uint8))
    assert said.masks.shape[1:] == (50, 58)
    small = made(tmp_path / "small.zarr", size=24)
    with pytest.raises(InputError, match="images of 24 px: the shortest side must be at least 32 px"):
        train([small], tmp_path / "none", TrainOptions(epochs=1))


def test_onnx_gives_what_torch_gives(path: str, trained: Path, tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="ONNX is not installed: pip install '.[onnx]'")
    pytest.importorskip("onnxscript", reason="ONNX is not installed: pip install '.[onnx]'")
    out = tmp_path / "model"
    shutil.copytree(trained, out)
    # two epochs leave a network that says much the same of all images; this one does not
    steep = torch.load(out / WEIGHTS)
    steep["masks.weight"] *= 100
    torch.save(steep, out / WEIGHTS)
    changed = json.loads((out / MODEL).read_text()) | {"weights_sha256": sha256(weights(out)).hexdigest()}
    (out / MODEL).write_text(json.dumps(changed))
    record = train([path], out, TrainOptions(**SMALL), onnx=True)  # of a finished training
    assert record["onnx"]["largest_difference"] <= ONNX_WITHIN
    assert torch.equal(torch.load(out / WEIGHTS)["masks.weight"], steep["masks.weight"])
    image = st.open_store(path).read("image", 0, 1)[:, :32, :64]
    session = onnxruntime.InferenceSession(out / ONNX, providers=["CPUExecutionProvider"])
    given = np.ascontiguousarray(image.transpose(0, 3, 1, 2)).astype(np.float32)
    masks, present, severity, usable = session.run(None, {"image": given})
    (said,) = load_detector(out, "cpu").predict(image)
    assert np.ptp(said.masks) > 0.3
    for ours, theirs in ((said.masks, masks[0]), (said.present, present[0]), (said.severity, severity[0])):
        assert np.abs(ours - theirs).max() <= ONNX_WITHIN
    assert abs(said.usable_fraction - usable[0]) <= ONNX_WITHIN


# --- labels and losses --------------------------------------------------------------------------------------------


def labelled_sample(width: int = 72) -> dict[str, Any]:
    """Return a sample whose image says what its masks are: R is 200 in the first, B is the number of the column."""
    masks = torch.zeros(2, 40, width, dtype=torch.bool)
    masks[0, 3:9, 34:44] = True
    image = torch.zeros(4, 40, width, dtype=torch.uint8)
    image[0][masks[0]] = 200
    image[2] = torch.arange(width, dtype=torch.uint8)
    return {
        "image": image,
        "masks": masks,
        "mask_any": masks.any(0),
        "classes": torch.tensor([1.0, 0.0]),
        "sample": torch.tensor(5),
    }


LEVEL = {5: np.array([2.5, 1.0], np.float32)}


@pytest.mark.parametrize("mirrored", [False, True])
def test_crops_and_mirror_images_keep_image_and_labels_together(mirrored: bool) -> None:
    turned, empty = set(), set()
    for seed in range(40):
        torch.manual_seed(seed)
        label = Labelled(LEVEL, 32, mirrored=mirrored)(labelled_sample())
        image, masks = label["image"], label["masks"]
        assert image.shape == (4, 32, 32)
        assert torch.equal(image[0] == 200, masks[0])
        turned.add(int(image[2, 0, 1]) - int(image[2, 0, 0]))
        there = bool(masks[0].any())
        empty.add(not there)
        assert label["present"].tolist() == [float(there), 0.0]
        assert label["severity"].tolist() == [2.5 * there, 0.0]
        assert float(label["usable"]) == pytest.approx(1 - float(masks[0].float().mean()))
    assert turned == ({1, -1} if mirrored else {1})
    assert empty == {False, True}


def test_half_of_the_images_get_a_black_level_and_noise() -> None:
    """On a black image, the median of 4 × 32² rounded values is the level within a DN, their spread the noise.

    A uniform level of up to 12 DN has a mean of 6; a mean of about 100 such has an error of 0.35.
    """
    sample = labelled_sample()
    sample["image"] = torch.full_like(sample["image"], 100)
    levels, spreads = [], []
    for seed in range(200):
        torch.manual_seed(seed)
        image = Labelled(LEVEL, 32, raised=True)(sample)["image"]
        assert image.dtype == torch.uint8
        levels.append(float(image.double().median()) - 100)
        spreads.append(float(image.double().std()))
    raised = np.array(levels) > 0.5
    assert 0.4 < raised.mean() < 0.6
    assert np.array(levels).max() <= 12
    assert abs(np.array(levels)[raised].mean() - 6.25) < 1.1  # from 0.5 on; three errors
    assert 1.2 < max(spreads) < 1.6
    white = sample | {"image": torch.full_like(sample["image"], 255)}
    assert min(int(Labelled(LEVEL, 32, raised=True)(white)["image"].min()) for _ in range(20)) > 245


def test_masks_of_a_class_that_the_image_has_not_are_lowered() -> None:
    """A network that says of an image that it has no fault marks no pixel, whatever each pixel looks like."""
    torch.manual_seed(1)
    network, image = new_network("unet", 2).eval(), torch.rand(1, 4, 32, 32)
    with torch.inference_mode():
        network.heads.said.bias[:2] += 100
        there = network(image)
        network.heads.said.bias[0] -= 200
        gone = network(image)
    assert gone.present[0, 0] < -50
    assert torch.allclose(gone.masks[0, 0], there.masks[0, 0] + gone.present[0, 0])
    assert torch.equal(gone.masks[0, 1], there.masks[0, 1])


def test_whole_images_are_labelled_by_what_is_injected() -> None:
    """A fault may change pixels although its mask, a footprint above a threshold, is empty."""
    sample = labelled_sample() | {"masks": torch.zeros(2, 40, 72, dtype=torch.bool)}
    assert Labelled(LEVEL)(sample)["present"].tolist() == [1.0, 0.0]
    assert Labelled(LEVEL)(sample)["image"].shape == (4, 40, 72)


def test_only_faults_of_the_light_may_be_mirrored(path: str) -> None:
    assert not may_be_mirrored(st.open_store(path))  # defects have lines in the direction of the readout
    models = {"dust_on_optics": "gaussian", "straylight": "texture", "vignetting": "cos4"}
    faults = ("dust_on_optics", "straylight", "vignetting")
    spec = make_spec(faults=faults, mask_any_faults=())
    for changes, allowed in (({}, True), ({"dust_on_optics": "of_a_plug_in"}, False)):
        stand_in: Any = SimpleNamespace(spec=spec, attributes={"fault_models": models | changes})
        assert may_be_mirrored(stand_in) is allowed


def test_severity_is_that_of_the_table(path: str) -> None:
    """As many grains as at level 2 of the table, for frames of 256 px, are more severe in frames of 72 px."""
    data = TrainingData([path], None, "footprint", None, 2, 0)
    levels = Levels().table.levels["dust_on_optics"]["gaussian"]
    assert levels.values[1] == GRAINS
    dust, injected = FAULTS.index("dust_on_optics"), st.open_store(path).read("injected")
    dusty = [i for i in range(10) if injected[i, dust]]
    level = {data._levels[0][i][dust] for i in dusty}
    assert len(level) == 1
    # costs as much as (256 / 72)^0.5 times as many at 256 px, where 120.5 is level 4 and 217 level 5
    in_table = GRAINS * (256 / (SIZE + 8)) ** 0.5
    wanted = 4 + math.log(in_table / 120.5) / math.log(217 / 120.5)
    assert level.pop() == pytest.approx(wanted, abs=1e-5)
    batch = next(data.batches(0))
    assert torch.isnan(batch["severity"][:, 1:][batch["present"][:, 1:] > 0]).all()  # parameters that say nothing
    assert (batch["severity"][batch["present"] == 0] == 0).all()


def test_stores_are_mixed_evenly_and_resumed_anywhere(path: str, other: str) -> None:
    data = TrainingData([path, other], None, "footprint", None, 2, 0)
    assert data.classes == FAULTS
    assert data.crop_px == 40
    sequence = data.sequence(1)
    assert np.bincount(sequence).tolist() == [len(one) for one in data.train]
    assert sequence.tolist() != data.sequence(2).tolist()
    whole = list(data.batches(1))
    assert len(whole) == data.steps == data.images // 2
    for first in range(data.steps + 1):
        rest = list(data.batches(1, first))
        assert len(rest) == data.steps - first
        for ours, theirs in zip(rest, whole[first:], strict=True):
            assert all(torch.equal(ours[name].nan_to_num(), theirs[name].nan_to_num()) for name in theirs)


def test_pixels_weigh_by_their_mean_fraction_also_of_full_masks_and_of_stores_without_any(tmp_path: Path) -> None:
    """One store marks all pixels with the first class and a quarter with the second, one neither in any pixel."""
    stores = []
    for name, first, second in (("full", True, np.arange(SIZE + 8) < (SIZE + 8) // 4), ("none", False, False)):
        stores.append(made(tmp_path / name, samples=6))
        spec = st.open_store(stores[-1]).spec
        samples = [fake_sample(spec, i) for i in range(6)]
        for sample in samples:
            sample.layers["mask"][:] = 0
            sample.layers["mask"][0], sample.layers["mask"][1] = first, second
        shutil.rmtree(stores[-1])
        st.write_samples(st.create(stores[-1], spec, 6), samples)
    classes = FAULTS[:2]
    alone, both = (
        TrainingData(of, classes, "footprint", None, 2, 0).pixel_weights() for of in (stores[:1], stores)
    )
    assert alone.tolist() == pytest.approx([1, math.sqrt(3)])
    assert both.tolist() == pytest.approx([1, math.sqrt(7)])


def test_the_loss_is_its_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two classes in one image of four pixels, by hand; the second class is absent, so it has no Dice term."""
    p = np.array([[0.8, 0.6, 0.3, 0.1], [0.2, 0.2, 0.2, 0.2]])
    y = np.array([[1, 1, 0, 0], [0, 0, 0, 0]])
    w = np.array([3.0, 1.0])
    entropy = -(w[:, None] * y * np.log(p) + (1 - y) * np.log(1 - p)).mean(1)
    dice = 1 - 2 * (0.8 + 0.6) / (2 + 1.8)
    wanted = entropy.mean() + dice / 2
    presence = -(math.log(0.9) + math.log(1 - 0.4)) / 2  # the first is said to be there at 0.9, the second at 0.4
    severity = -(0.5 * math.log(0.4) + 0.5 * math.log(0.6))  # level 2 of 5 is said, and 2.5 is true
    usable = -(0.5 * math.log(0.25) + 0.5 * math.log(0.75))
    wanted += 0.5 * (presence + severity + usable)

    def logit(value: Any) -> Any:
        return torch.logit(torch.as_tensor(value, dtype=torch.float64))

    said = Outputs(logit(p).reshape(1, 2, 2, 2), logit([[0.9, 0.4]]), logit([[2.0 / 5, 0.5]]), logit([0.25]))
    batch = {
        "masks": torch.tensor(y, dtype=torch.bool).reshape(1, 2, 2, 2),
        "present": torch.tensor([[1.0, 0.0]], dtype=torch.float64),
        "severity": torch.tensor([[2.5, 0.0]], dtype=torch.float64),
        "usable": torch.tensor([0.5], dtype=torch.float64),
    }
    assert float(loss_of(said, batch, torch.tensor(w))) == pytest.approx(wanted, rel=1e-9)
    unknown = batch | {"severity": torch.tensor([[math.nan, 0.0]], dtype=torch.float64)}
    assert float(loss_of(said, unknown, torch.tensor(w))) == pytest.approx(wanted - 0.5 * severity, rel=1e-9)


def test_the_rate_rises_and_falls_to_nothing() -> None:
    rates = [rate_at(step, 100) for step in range(100)]
    assert rates[:5] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert all(before >= after for before, after in itertools.pairwise(rates[4:]))
    assert rates[-1] < 0.001


# --- files --------------------------------------------------------------------------------------------------------


def test_a_model_says_what_it_was_trained_on(path: str, trained: Path) -> None:
    record = json.loads((trained / MODEL).read_text())
    assert record["datasets"][0]["digest"] == st.digest(path)
    assert record["classes"] == list(FAULTS)
    assert [one["epoch"] for one in record["epochs"]] == [1, 2]
    assert 0 <= record["epochs"][0]["val_mean_iou"] <= 1
    text = (trained / CARD).read_text()
    for part in (record["datasets"][0]["digest"], "dust_on_optics", "unet", "mean IoU", "a.zarr"):
        assert part in text
    assert (trained / FIGURE).read_bytes().startswith(b"\x89PNG")


def test_the_training_ends_where_nothing_gets_better(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = iter([0.1, 0.4, 0.3, 0.2, 0.9])
    monkeypatch.setattr(training.Figures, "values", lambda self: FIGURES | {"val_mean_iou": next(figures)})
    record = train([path], tmp_path / "model", TrainOptions(**{**SMALL, "epochs": 9, "patience": 2}))
    assert (len(record["epochs"]), record["best_epoch"]) == (4, 2)


FIGURES = {
    "val_loss": 1.0,
    "val_iou": dict.fromkeys(FAULTS, 0.5),
    "val_presence_accuracy": 0.5,
    "val_severity_within_one_level": 0.5,
    "val_usable_error": 0.5,
}


def test_weights_of_a_file_are_used_where_they_fit(trained: Path, tmp_path: Path) -> None:
    network = torch.nn.Sequential(torch.nn.Conv2d(4, 16, 3), torch.nn.BatchNorm2d(16))
    file = tmp_path / "w.pt"
    own = {name: torch.full_like(value, 2) for name, value in network.state_dict().items()}
    torch.save({**own, "0.weight": torch.ones(16, 3, 3, 3), "else": torch.zeros(3)}, file)
    assert start_from(network, file) == len(own)
    # an image whose four channels are equal gives what three gave
    assert torch.allclose(network.state_dict()["0.weight"], torch.tensor(0.75))
    torch.save({"else": torch.zeros(3)}, file)
    with pytest.raises(InputError, match="none of its 1 weights has name and shape of one of this network's"):
        start_from(network, file)
    torch.save([1, 2], file)
    with pytest.raises(InputError, match="must hold a state dict"):
        start_from(network, file)
    for content, says in (
        (b"no weights", "is no file of weights that PyTorch reads safely"),
        (None, "No such file"),
    ):
        file.unlink()
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(InputError, match=says):
            start_from(network, file)


# --- mistakes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"architecture": "resnet"}, "architecture = 'resnet': must be one of unet, lraspp"),
        ({"epochs": 0}, "epochs = 0: must be a whole number of at least 1"),
        ({"learning_rate": 0.0}, "learning_rate = 0: must be above 0 and at most 1"),
        ({"architecture": ARCHITECTURES[1], "batch_size": 1}, "batch_size = 1: .* must be at least 2"),
        ({"classes": ("rain",)}, "classes: 'rain' is no fault class of .*; known: dust_on_optics"),
        ({"classes": ()}, "must name at least one class, and none twice"),
        ({"masks": "both"}, "masks = 'both': must be one of footprint, effect"),
        ({"crop_px": 65}, "crop_px = 65: must be from 32 to 64, the shortest side of the images"),
        ({"weights": Path("/dev/zero")}, "/dev/zero: weights is not a file but a device"),
        ({"weights": Path("none.pt")}, r"none\.pt: weights file not found"),
    ],
)
def test_wrong_options_are_refused_in_one_sentence(
    path: str, tmp_path: Path, changes: dict[str, Any], says: str
) -> None:
    with pytest.raises(InputError, match=says):
        train([path], tmp_path / "model", TrainOptions(**{**SMALL, **changes}))
    assert not (tmp_path / "model").exists()


def test_wrong_places_are_refused_in_one_sentence(path: str, trained: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.zarr"):
        train([str(tmp_path / "nothing.zarr")], tmp_path / "model", TrainOptions(**SMALL))
    (tmp_path / "full").mkdir()
    (tmp_path / "full/notes.txt").touch()
    with pytest.raises(InputError, match="full: exists and holds no training; choose another --out"):
        train([path], tmp_path / "full", TrainOptions(**SMALL))
    for device in ("abacus", "meta", "mps:9"):
        with pytest.raises(InputError, match=f"^device = '{device}': PyTorch has no such device: .{{1,240}}$"):
            train([path], tmp_path / "model", TrainOptions(**SMALL), device=device)
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / CHECKPOINT).write_bytes(b"torn")
    with pytest.raises(InputError, match="is no file of a checkpoint that PyTorch reads safely"):
        train([path], tmp_path / "model", TrainOptions(**SMALL))
    (tmp_path / "model" / CHECKPOINT).write_bytes(b"")
    with pytest.raises(InputError, match=r"that PyTorch reads safely: it ends too early$"):
        train([path], tmp_path / "model", TrainOptions(**SMALL))


def test_fields_of_other_types_are_refused_in_one_sentence(
    path: str, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a checkpoint, and of `model.json`, which its owner may have edited."""
    out, options = tmp_path / "model", TrainOptions(**SMALL)
    monkeypatch.setattr(training._Run, "_train_epoch", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(Interrupted):
        train([path], out, options)
    state = torch.load(out / CHECKPOINT)
    what = state["what"]
    for key, value in [
        *((key, [1]) for key in state),
        *(("what", {**what, **changed}) for changed in ({"options": None}, {"datasets": None}, {"datasets": [{}]})),
        *(("epoch", 1), ("step", 99)),
    ]:
        torch.save({**state, key: value}, out / CHECKPOINT)
        with pytest.raises(InputError, match=r"is a checkpoint of another version: .+|holds (no|a) training "):
            train([path], out, options)
    record = json.loads((trained / MODEL).read_text())
    for changed in ({"datasets": None}, {"datasets": [1]}, {"epochs": None}):
        (out / MODEL).write_text(json.dumps({**record, **changed}))
        with pytest.raises(InputError, match=r"is no model\.json of this vbnfault|holds (no|a) training "):
            train([path], out, options)


def test_what_is_no_model_is_refused_in_one_sentence(trained: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing: no such model"):
        load_detector(tmp_path / "nothing")
    with pytest.raises(
        InputError, match=r"is no trained model: it has no model\.json, which vbnfault train writes"
    ):
        load_detector(tmp_path)
    out = tmp_path / "model"
    shutil.copytree(trained, out)
    (out / WEIGHTS).write_bytes(weights(trained)[:100])
    with pytest.raises(InputError, match=r"weights\.pt: is no file of weights that PyTorch reads safely"):
        load_detector(out)
    torch.save({"a": torch.zeros(1)}, out / WEIGHTS)
    with pytest.raises(InputError, match="its weights are not those of unet"):
        load_detector(out)
    damaged = bytearray(weights(trained))
    damaged[len(damaged) // 2] ^= 0x40  # of a number, which PyTorch reads as it is
    (out / WEIGHTS).write_bytes(damaged)
    with pytest.raises(InputError, match=r"weights\.pt: is no file of weights .* the check sum of its numbers"):
        load_detector(out)
    state = torch.load(trained / WEIGHTS)
    torch.save({name: value + 1 for name, value in state.items()}, out / WEIGHTS)
    with pytest.raises(InputError, match=r"weights\.pt: was exchanged: its SHA-256 is not the weights_sha256"):
        load_detector(out)
    without = {key: value for key, value in json.loads((out / MODEL).read_text()).items() if key != "options"}
    for text in ("{", "[]", json.dumps({"format": 99, "classes": ["a"]}), json.dumps(without)):
        (out / MODEL).write_text(text)
        with pytest.raises(InputError, match=r"is no model\.json of this vbnfault; its format must be 1"):
            load_detector(out)


def test_a_loss_that_is_no_number_ends_the_training(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "loss_of", lambda said, batch, weights: said.masks.sum() * math.nan)
    with pytest.raises(VbnfaultError, match="the loss of step 0 of epoch 1 is no number; begin again in another"):
        train([path], tmp_path / "model", TrainOptions(**SMALL))


def test_short_memory_is_said_in_a_sentence(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def short(*_: object) -> None:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes.\nMore")

    monkeypatch.setattr(training, "as_input", short)
    with pytest.raises(VbnfaultError, match="batch_size = 2: memory is short for crops of 32 px; choose less"):
        train([path], tmp_path / "model", TrainOptions(**SMALL))


def test_a_dataset_without_validation_trains_to_the_end(
    path: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    few = made(tmp_path / "few.zarr", samples=3)  # all at the first site, which is of the training split
    record = train([few], tmp_path / "model", TrainOptions(**SMALL))
    assert "no dataset has a validation split" in caplog.text
    assert record["best_epoch"] == 2
    assert "there was no validation split" in (tmp_path / "model" / CARD).read_text()


def test_the_command_trains_and_continues(path: str, tmp_path: Path, call: Callable[..., Called]) -> None:
    """With every option; then again, then with another one, then with what does not exist."""
    file, out = tmp_path / "w.pt", tmp_path / "model"
    torch.save(new_network("unet", 2).state_dict(), file)
    words = ["train", path, "--out", out, "--epochs", "1", "--batch-size", "3", "--crop-px", "32", "--seed", "4"]
    words += ["--architecture", "unet", "--masks", "footprint", "--learning-rate", "0.001", "--patience", "3"]
    words += ["--weights", file, "--workers", "1", "--device", "cpu", "--classes", "straylight", "--classes"]
    for _ in range(2):
        done = call(*words, "dust_on_optics", "--no-onnx")
        assert done.code == 0, done.err
        assert "straylight" in done.out
        assert f"model of epoch 1 of 1: {out / WEIGHTS}" in done.out
    detector = load_detector(out)
    assert (detector.classes, detector.masks) == (("straylight", "dust_on_optics"), "footprint")
    assert "holds a training with classes = " in call(*words, "vignetting").said
    assert "classes: 'rain' is no fault class" in call(*words, "rain", "--onnx").said


def test_without_torch_a_sentence_says_what_to_install(
    path: str, tmp_path: Path, call: Callable[..., Called], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("vbnfault.detect.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert call("train", path, "--out", tmp_path / "m").said == (
        "detectors need PyTorch, which is not installed: pip install 'vbnfault[torch]'"
    )
