"""Draw the figures that accompany the scene files.

    python benchmarks/scene_pictures.py --out scenes
    python benchmarks/scene_pictures.py --out scenes landing flares
    python benchmarks/scene_pictures.py --out docs/figures flown_faults flown_readout

Contact sheets show samples of a dataset with their masks. Their samples are 512 pixels wide, over terrain as coarse
as quickstart's; the sheets are then shrunk. The figures of `flares`, `navcam67p`, `paper_example`, `physical67p`
and `rosetta67p` show single samples, rendered at the scene's own size and then shrunk. Those of flights are film
strips, of samples like those of contact sheets. `flown_faults` and `flown_readout` show each fault on one frame,
for the page `flown_faults`; they get a palette. A figure without colour is written as a grey PNG, with a smaller
file.
"""

from __future__ import annotations

import argparse
import tempfile
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image  # comes with matplotlib

from vbnfault import dataset
from vbnfault.core.files.images import decoded_image, write_png
from vbnfault.faults import from_dict
from vbnfault.output import contact_sheet
from vbnfault.output.sample_files import annotated
from vbnfault.pipeline import Session
from vbnfault.pipeline.spec import Draw, Frame
from vbnfault.scene import config

U8 = NDArray[np.uint8]

# Samples of each contact sheet.
SHEETS = {
    "approach": 16,
    "earth_observation": 12,
    "interplanetary": 12,
    "landing": 12,
    "quickstart": 16,
    "sssb_exploration": 12,
}
SHEET_PX = 512
SHEET_TRIANGLES = 800_000
SHEET_WIDTH_PX = 1080
NARROW_PX = {"approach": 700, "earth_observation": 700}  # sheets that pages of the documentation show
# Sequences of which film strips are shown, and frames of each.
STRIPS = {"descent67p": (0, 5), "flyby_bennu": (3, 6), "hover_ceres": (4, 19), "relocation67p": (6, 9)}
STRIP_FRAMES, STRIP_PX = 6, 144
# Samples with many fault classes; several share a site, whose terrain is then built once.
# Those of NAVCAM have all nine classes of the scene between them, most of them visible in a small figure.
FLARES, NAVCAM, PHYSICAL = (1, 2, 3), (2, 7, 13, 15), (7, 4)
NAVCAM_TILE_PX = 304  # keeps the file below 250 kB
GAP_PX = 4  # white, between images whose own edges may be black
# Of the paper's classes: keys of its model and of the physical one, sample of physical67p, and the part that is
# shown (left, top, side).
WHOLE = (0, 0, 1024)
FLOWN: tuple[tuple[str, dict[str, Any], dict[str, Any], int, tuple[int, int, int]], ...] = (
    ("dust_on_optics", {"model": "gaussian"}, {"model": "defocused"}, 10, WHOLE),
    ("broken_pixels", {"model": "texture"}, {"model": "hot_pixels", "growth_factor": 200.0}, 10, (300, 200, 256)),
    ("broken_lines", {"model": "texture"}, {"model": "readout"}, 10, (768, 256, 256)),
    ("straylight", {"model": "texture"}, {"model": "traced"}, 7, WHOLE),
    ("vignetting", {"model": "cos4"}, {"model": "lens", "decentre": 0.3, "hood_offset": 0.4}, 10, WHOLE),
    ("optics_degradation", {"model": "gaussian"}, {"model": "contamination", "haze": 0.1}, 7, WHOLE),
)
# Faults of the readout and from beside the field: faults with their keys, scene, sample, part.
READOUT: tuple[tuple[dict[str, dict[str, Any]], str, int, tuple[int, int, int]], ...] = (
    ({"cosmic_rays": {"flux_per_cm2_s": 200.0}, "cti": {"parallel_per_px": 8.0}}, "navcam67p", 24, (480, 0, 256)),
    ({"banding": {"model": "columns", "period_px": 4}}, "navcam67p", 24, (480, 600, 256)),
    ({"transmission": {"cut_rows": 150, "lost_count": 0, "lost_lines": 0}}, "physical67p", 10, WHOLE),
    ({"transmission": {"fill": "shifted", "lost_lines": 0}}, "navcam67p", 24, WHOLE),
    ({"straylight": {"model": "surroundings", "reflectance": 0.01}}, "physical67p", 10, WHOLE),
    ({"dust_on_optics": {"model": "defocused", "count": 0, "cover": 0.4}}, "physical67p", 10, WHOLE),
    ({"optics_degradation": {"filter_size_px": 17}}, "physical67p", 7, (768, 0, 256)),
    ({"optics_degradation": {"filter_size_px": 17, "unclipped": True}}, "physical67p", 7, (768, 0, 256)),
    ({"register_upset": {"bit": 5}}, "navcam67p", 24, WHOLE),
    ({"register_upset": {"bit": 4}}, "navcam67p", 24, WHOLE),
    ({"register_upset": {"model": "window", "lines": "columns", "bit": 8}}, "navcam67p", 24, WHOLE),
    ({"register_upset": {"model": "flip", "lines": "both"}}, "physical67p", 10, WHOLE),
)
FLOWN_TILE_PX, READOUT_TILE_PX = 256, 232  # the latter keeps the file below 250 kB


def frames(scene: str, samples: tuple[int, ...], overrides: dict[str, Any] | None = None) -> list[Frame]:
    """Return finished samples of a packaged scene."""
    session = Session(config.load_scene(scene, overrides or {}))
    return [session.frame(index) for index in samples]


def rgb(frame: Frame, name: str) -> U8:
    """Return one of a sample's images as uint8[y, x, 3] R, G, B."""
    images = frame.images
    twins = {f"without_{fault}": twin for fault, twin in images.without.items()}
    return np.asarray({"image": images.image, "clean": images.clean, **twins}[name].array[..., :3])


def mask(frame: Frame, *classes: str) -> U8:
    """Return the union of the masks of some classes in white, uint8[y, x, 3]."""
    chosen = [name in classes for name in frame.spec.faults]
    return np.repeat(frame.labels.masks[chosen].any(axis=0)[..., None].astype(np.uint8) * 255, 3, axis=2)


def grid(rows: list[list[U8]], tile_px: int) -> U8:
    """Return images in rows, each shrunk to a square tile, uint8[y, x, 3]."""
    size = (tile_px, tile_px)
    shrunk = [[cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in row] for row in rows]
    return np.vstack([np.hstack(row) for row in shrunk])


def spaced(rows: list[list[U8]], tile_px: int) -> U8:
    """Return images in rows as `grid` does, with white gaps between them, uint8[y, x, 3]."""
    tiles = grid(rows, tile_px)
    for axis in (0, 1):
        cuts = range(tile_px, tiles.shape[axis], tile_px)
        tiles = np.insert(tiles, np.repeat(list(cuts), GAP_PX), 255, axis=axis)
    return tiles


def without_colour(figure: U8) -> U8:
    """Return one channel of a figure whose channels are equal, uint8[y, x]; other figures as they are."""
    grey = figure[..., :1]
    return grey[..., 0] if (figure == grey).all() else figure


def flares() -> U8:
    """Draw three samples with each of the three models of straylight, one row a model."""
    models: list[dict[str, Any]] = [
        {},  # traced
        {"faults.straylight.model": "paraxial"},
        {"faults.straylight": {"model": "texture"}},  # replaces the table: this model has no key `coating`
    ]
    rows = [frames("flares", FLARES, model) for model in models]
    return grid([[rgb(frame, "image") for frame in row] for row in rows], 360)


def navcam67p() -> U8:
    """Draw four samples of a dataset of 16."""
    images = [rgb(frame, "image") for frame in frames("navcam67p", NAVCAM, {"dataset.samples": 16})]
    return spaced([images[:2], images[2:]], NAVCAM_TILE_PX)


def paper_example() -> U8:
    """Draw the image, its twin without straylight, the image with its flares marked, four masks and their union."""
    (frame,) = frames("paper_example", (0,))
    local = ("straylight", "dust_on_optics", "broken_pixels", "broken_lines")
    masks = [mask(frame, name) for name in local]
    pictures = [rgb(frame, "image"), rgb(frame, "without_straylight"), annotated(frame, "straylight")]
    return spaced([[*pictures, masks[0]], [*masks[1:], mask(frame, *local)]], 400)


def rosetta67p() -> U8:
    """Draw four frames."""
    images = [rgb(frame, "image") for frame in frames("rosetta67p", (0, 1, 2, 3))]
    return spaced([images[:2], images[2:]], NAVCAM_TILE_PX)


def physical67p() -> U8:
    """Draw two samples, each with and without its faults."""
    taken = frames("physical67p", PHYSICAL)
    return spaced([[rgb(frame, "image"), rgb(frame, "clean")] for frame in taken], 540)


def unharmed(scene: str, sample: int) -> Frame:
    """Return a finished sample of a packaged scene without faults, with the light of its surroundings."""
    return frames(scene, (sample,), {"plan.faulty_fraction": 0.0})[0]


def harmed(frame: Frame, faults: dict[str, dict[str, Any]], part: tuple[int, int, int], attempt: int) -> U8:
    """Return a part of a sample's image with the given faults alone, uint8[y, x, 3], stretched by a square root.

    `attempt` tells the draws of one frame apart.
    """
    development, draws = frame.injection.development, {}
    for name, table in faults.items():
        fault = from_dict(name, table, source="figure")
        params = fault.draw(development.context, np.random.default_rng(0))
        draws[name] = Draw(fault=fault, attempt=attempt, params=params)
    left, top, side = part
    image = development.image(draws).array[top : top + side, left : left + side, :3]
    return np.rint(np.sqrt(image * 255.0)).astype(np.uint8)


def flown_faults() -> U8:
    """Draw the six classes of the paper, two rows each of three: the paper's model left, the physical one right."""
    of, attempt = {sample: unharmed("physical67p", sample) for *_, sample, _ in FLOWN}, count(1)
    tiles = [
        harmed(of[sample], {name: keys}, part, next(attempt))
        for name, *models, sample, part in FLOWN
        for keys in models
    ]
    return spaced([tiles[k : k + 4] for k in range(0, len(tiles), 4)], FLOWN_TILE_PX)


def flown_readout() -> U8:
    """Draw faults of the readout and light from beside the field, each alone."""
    of, attempt = {key: unharmed(*key) for key in {(scene, sample) for _, scene, sample, _ in READOUT}}, count(1)
    tiles = [harmed(of[scene, sample], faults, part, next(attempt)) for faults, scene, sample, part in READOUT]
    return spaced([tiles[k : k + 4] for k in range(0, len(tiles), 4)], READOUT_TILE_PX)


def strips(scene: str) -> U8:
    """Return film strips of two sequences of a scene with other faults, a row each."""
    changes = {"camera.width_px": SHEET_PX, "camera.height_px": SHEET_PX, "patch.max_triangles": SHEET_TRIANGLES}
    session = Session(config.load_scene(scene, changes))
    rows = []
    for sequence in STRIPS[scene]:
        count = session.scene.frames[sequence]
        first = sum(session.scene.frames[:sequence])
        chosen = np.linspace(0, count - 1, STRIP_FRAMES).round().astype(int)
        rows.append([rgb(session.frame(first + k), "image") for k in chosen.tolist()])
    return spaced(rows, STRIP_PX)


SINGLE = {
    "flares": flares,
    "flown_faults": flown_faults,
    "flown_readout": flown_readout,
    "navcam67p": navcam67p,
    "paper_example": paper_example,
    "physical67p": physical67p,
    "rosetta67p": rosetta67p,
    **{scene: partial(strips, scene) for scene in STRIPS},
}


def sheet(scene: str) -> U8:
    """Return the contact sheet of a scene, shrunk to SHEET_WIDTH_PX or to its own width."""
    own = config.load_scene(scene)
    small = {
        "dataset.samples": SHEETS[scene],
        "camera.width_px": SHEET_PX,
        "camera.height_px": SHEET_PX,
        "patch.max_triangles": min(SHEET_TRIANGLES, own.patch.max_triangles),
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{scene}.zarr"
        dataset.build_scene(config.load_scene(scene, small), path, source=scene)
        contact_sheet.preview(path, path.with_suffix(".png"))
        whole, _ = decoded_image(path.with_suffix(".png").read_bytes(), 2**28)
    width_px = NARROW_PX.get(scene, SHEET_WIDTH_PX)
    size = (width_px, round(width_px * whole.shape[0] / whole.shape[1]))
    return np.rint(255 * cv2.resize(whole, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)


def main() -> None:
    """Write the requested figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for SCENE.png")
    known = sorted([*SHEETS, *SINGLE])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(known)} [default: all]")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for scene in given.scenes or known:
        path = given.out / f"{scene}.png"
        figure = sheet(scene) if scene in SHEETS else SINGLE[scene]()
        if scene.startswith("flown") or scene in STRIPS:
            # smooth veils would show steps of a palette without dither
            image = Image.fromarray(figure)
            palette = image.quantize(256, Image.Quantize.MAXCOVERAGE, 2)
            image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(path, optimize=True)
        else:
            write_png(path, without_colour(figure), smallest=True)
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
