"""Draw what trained detectors call straylight: beside the Sun without a fault, and in flares that they do not know.

    python benchmarks/straylight_or_sun.py bench trained/paint_0 trained/physics_0 trained/both_0 --out sun.png

The rows are frames of the tests of a benchmark: nominal ones with the Sun in view, flares of other textures, and
flares of another lens whose Sun is in the frame, and beyond it. The columns are the true mask and that of each
model. A border stands for a mask of nearly the whole frame. It prints, for each model, the fraction of nominal
Sun-facing frames in which a pixel is called straylight, and the fraction of their pixels.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image  # comes with matplotlib

from vbnfault.detect.benchmark import read_manifest
from vbnfault.detect.networks import TrainedDetector, load_detector
from vbnfault.output.contact_sheet import overlay
from vbnfault.store import Store, open_store

CLASS = "straylight"
EACH = 2  # frames of a kind


def kinds(stores: dict[str, Store]) -> dict[str, tuple[Store, NDArray[np.int64]]]:
    """Return the frames of each kind: the store and the samples."""
    found = {}
    for title, test, faulty, inside in (
        ("Sun, no fault", "sun", False, True),
        ("other textures", "textures", True, True),
        ("other lens", "lens", True, True),
        ("Sun outside", "lens", True, False),
    ):
        store = stores[test]
        xy, size = store.read("sun_xy_px"), (store.spec.width, store.spec.height)
        with np.errstate(invalid="ignore"):
            in_frame = ((xy >= 0) & (xy < size)).all(axis=1) & (store.read("sun_visible_fraction") > 0)
        has = store.read("injected")[:, store.spec.faults.index(CLASS)].astype(bool)
        found[title] = store, np.flatnonzero((has == faulty) & (in_frame == inside))
    return found


def straylight(model: TrainedDetector, images: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the masks of a model, bool[sample, y, x]."""
    c = model.classes.index(CLASS)
    return np.array([prediction.masks[c] >= 0.5 for prediction in model.predict(images)])


def main() -> None:
    """Print the fractions and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bench", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    parts = read_manifest(given.bench)["parts"]
    stores = {name: open_store(given.bench / parts[name]["store"]) for name in ("sun", "textures", "lens")}
    models = {path.name.rpartition("_")[0] or path.name: load_detector(path) for path in given.models}
    frames = kinds(stores)
    store, nominal = frames["Sun, no fault"]
    images = store.read("image")[nominal]
    for name, model in models.items():
        masks = straylight(model, images)
        alarms = masks.any(axis=(1, 2)).mean()
        print(f"{name}: straylight in {alarms:.1%} of {len(nominal)} nominal frames, {masks.mean():.2%} of pixels")
    rows: list[tuple[str, list[Any]]] = []
    for title, (store, samples) in frames.items():
        chosen = samples[np.linspace(0, len(samples) - 1, EACH + 2).round().astype(int)[1:-1]]
        images, truth = store.read("image")[chosen], store.read("mask_effect")[chosen]
        truth = truth[:, store.spec.faults.index(CLASS)].astype(bool)
        columns = [truth, *(straylight(model, images) for model in models.values())]
        for k, image in enumerate(images[..., :3]):
            shown = [overlay(image, masks[k][None], [bool(masks[k].any())]) for masks in columns]
            rows.append((title, [image, *shown]))
    heads = ["frame", "truth", *models]
    figure, axes = plt.subplots(len(rows), len(heads), figsize=(1.6 * len(heads), 1.6 * len(rows)), squeeze=False)
    for r, (title, shown) in enumerate(rows):
        for axis, head, image in zip(axes[r], heads, shown, strict=True):
            axis.imshow(image)
            axis.set(xticks=[], yticks=[], title=head if r == 0 else "")
        axes[r, 0].set_ylabel(title)
    figure.tight_layout(pad=0.3)
    figure.savefig(given.out, dpi=90)
    picture = Image.open(given.out).convert("RGB")
    palette = picture.quantize(256)  # a third of the bytes
    picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(given.out, optimize=True)


if __name__ == "__main__":
    main()
