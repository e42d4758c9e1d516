"""Draw the five levels of severity of each fault class on one view; classes that need the Sun on another.

python benchmarks/severity_figure.py --out docs/figures/severity.png
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vbnfault.faults import LEVELS, read_table, registry
from vbnfault.study.severity import ModelUnderTest
from vbnfault.study.severity_views import ViewGroup, faulted, sequences, session_of
from vbnfault.study.views import CleanView

_TILE_PX, _GAP_PX, _LABEL_PX, _HEAD_PX = 112, 4, 126, 20
_GREYS = 40  # of the file: fewer greys make it smaller
_INK, _PAPER = 20, 255


def _view(scene: str, seed: int, tries: int, detector: str, facing_sun: bool) -> CleanView:
    """Return the first of some views whose ground is brightest."""
    overrides = {
        "camera.width_px": 256,
        "camera.height_px": 256,
        "dataset.seed": seed,
        "dataset.samples": 64,
        "dataset.sites": 1,
        "patch.max_triangles": 200_000,
    } | ({"camera.detector": detector} if detector else {})
    group = ViewGroup(
        scene=scene, overrides=overrides, lens=0, facing_sun=facing_sun, site=0, first=0, count=tries, models=()
    )
    views = [first for first, _ in sequences(group, "matches_lost", session_of(group))]
    return max(views, key=lambda view: float(np.median(_tile(view.frame.clean))))


def _tile(image: np.ndarray) -> Image.Image:
    """Return the middle of an image at its own pixels, from its intensity."""
    top, left = ((size - _TILE_PX) // 2 for size in image.shape[:2])
    part = image[top : top + _TILE_PX, left : left + _TILE_PX, 3].astype(float)
    return Image.fromarray(np.round(np.round(part / 255 * (_GREYS - 1)) * 255 / (_GREYS - 1)).astype(np.uint8))


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    parser.add_argument("--table", type=Path, default=Path("scenes/severity/levels.toml"), help="table of levels")
    parser.add_argument("--seed", type=int, default=21, help="seed of the view")
    parser.add_argument("--tries", type=int, default=6, help="number of views to choose from")
    parser.add_argument("--blocks", type=int, default=1, help="number of blocks side by side")
    given = parser.parse_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    table = read_table(given.table)
    views: dict[tuple[str, bool], CleanView] = {}
    rows = []
    for fault, models in table.levels.items():
        name = next((name for name in registry()[fault] if name in models), "")
        levels = models[name]
        if all(math.isnan(value) for value in levels.values):
            continue
        kind = levels.detector, registry()[fault][name].needs_sun
        if kind not in views:
            views[kind] = _view(table.scene, given.seed, given.tries, *kind)
        view = views[kind]
        model = ModelUnderTest(fault=fault, model=name, keys={})
        width_px = view.spec.camera.width_px
        images: list[tuple[str, np.ndarray | None]] = []
        for value in levels.values:
            if math.isnan(value):
                images.append(("no such level", None))
                continue
            value = model.severity.at_width(value, width_px, given_for_px=table.width_px)
            images.append((f"{value:.3g}", faulted(view, model.at(value)[0]).image))
        rows.append((fault, levels.key, images))
    per_block = -(-len(rows) // given.blocks)
    block_px = _LABEL_PX + LEVELS * (_TILE_PX + _GAP_PX) + 4 * _GAP_PX
    size = given.blocks * block_px, _HEAD_PX + per_block * (_TILE_PX + _GAP_PX)
    sheet = Image.new("L", size, _PAPER)
    draw = ImageDraw.Draw(sheet)
    font, small = ImageFont.load_default(13), ImageFont.load_default(11)
    for k, (fault, key, images) in enumerate(rows):
        block, row = divmod(k, per_block)
        x0, y = block * block_px, _HEAD_PX + row * (_TILE_PX + _GAP_PX)
        draw.text((x0 + 4, y + 38), fault.replace("_", " "), fill=_INK, font=font)
        draw.text((x0 + 4, y + 56), key, fill=_INK, font=small)
        for level, (label, image) in enumerate(images):
            x = x0 + _LABEL_PX + level * (_TILE_PX + _GAP_PX)
            if row == 0:
                draw.text((x + 36, 3), f"level {level + 1}", fill=_INK, font=font)
            if image is None:
                draw.text((x + 18, y + 48), label, fill=_INK, font=small)
                continue
            sheet.paste(_tile(image), (x, y))
            right = draw.textlength(label, font=small)
            draw.rectangle((x, y + _TILE_PX - 15, x + right + 5, y + _TILE_PX - 1), fill=_PAPER)
            draw.text((x + 3, y + _TILE_PX - 14), label, fill=_INK, font=small)
    sheet.quantize(_GREYS + 8, dither=Image.Dither.NONE).save(given.out, optimize=True)


if __name__ == "__main__":
    main()
