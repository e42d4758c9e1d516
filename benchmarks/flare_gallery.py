"""Draw the flares of every packaged lens at several Sun angles, one sheet a lens.

    python benchmarks/flare_gallery.py OUT_FOLDER [--lens NAME ...] [--coating mgf2] [--model traced|paraxial|both]

A sheet has one row for each model and one column for each angle. With both models, a third row shows the ratio of
traced to paraxial irradiance: red if it is above 1, blue if it is below 1, with full colour at a factor of ten. The
tool also writes `energy.csv`: the flux of all ghosts divided by the flux through the entrance pupil, by lens,
coating, model and angle.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from vbnfault.core.files import resources
from vbnfault.core.files.images import write_png
from vbnfault.lens import load_lens
from vbnfault.output import flare_images

ANGLES_DEG = (0.0, 8.0, 16.0, 24.0, 34.0)
AZIMUTH_DEG = 30.0
FOV_DEG = 60.0


def part(traced: np.ndarray, paraxial: np.ndarray) -> np.ndarray:
    """Return the ratio of two irradiance images as colours, uint8[y, x, 3] R, G, B."""
    floor = 1e-3 * np.percentile(traced, 90)
    ratio = np.clip(np.log10((traced + floor) / (paraxial + floor)), -1, 1)
    out = np.full((*ratio.shape, 3), 255.0)
    out[..., 1:] -= 255 * np.maximum(ratio, 0)[..., None]
    out[..., :2] -= 255 * np.maximum(-ratio, 0)[..., None]
    return np.clip(out, 0, 255).astype(np.uint8)


def sheet(name: str, coating: str, models: tuple[str, ...], pixels: int) -> tuple[np.ndarray, list[list[object]]]:
    """Return the sheet of one lens, uint8[y, x, 3] R, G, B, and its rows of `energy.csv`."""
    lens = load_lens(name).coated(coating)
    columns, energy = [], []
    white = None
    for angle in ANGLES_DEG:
        cells, light = [], []
        for model in models:
            request = flare_images.FlareRequest(
                lens=lens,
                sun_deg=angle,
                azimuth_deg=AZIMUTH_DEG,
                fov_deg=FOV_DEG,
                pixels=pixels,
                wavelength_nm=flare_images.wavelengths_nm(),
                sun_distance_au=3.0,
                model=model,
            )
            layers = flare_images.layers(request)
            if white is None:  # the whole sheet has one exposure
                ghosts = flare_images.colours(request, layers["ghosts"] + layers["veil"]).max(axis=2)
                white = float(np.percentile(ghosts, 99)) * 2
            exposed = replace(request, white=white)
            cells.append(flare_images.picture(flare_images.Flare(request=exposed, layers=layers)))
            light.append(flare_images.colours(request, layers["ghosts"])[..., 1])
            at_550_nm = replace(request, wavelength_nm=flare_images.wavelengths_nm(550.0))
            all_ghosts = flare_images.ghosts(at_550_nm)
            energy.append([name, coating, model, angle, len(all_ghosts), sum(g.flux_fraction for g in all_ghosts)])
        if len(models) == 2:
            cells.append(part(light[0], light[1]))
        columns.append(np.concatenate(cells))
    return np.concatenate(columns, axis=1), energy


def main() -> None:
    """Write the sheets and `energy.csv`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--lens", nargs="*")
    parser.add_argument("--coating", default="mgf2")
    parser.add_argument("--model", choices=["traced", "paraxial", "both"], default="both")
    parser.add_argument("--pixels", type=int, default=384)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    models = ("traced", "paraxial") if args.model == "both" else (args.model,)
    rows: list[list[object]] = []
    for name in args.lens or resources.packaged("scenes/lenses"):
        picture, energy = sheet(name, args.coating, models, args.pixels)
        path = args.out / f"{name}_{args.coating}.png"
        write_png(path, picture)
        print(path)
        rows += energy
        for row in energy:
            print("  {:<18}{:<6}{:<10}{:5.0f} deg {:4d} ghosts {:10.3e}".format(*row))
    with (args.out / "energy.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["lens", "coating", "model", "sun_deg", "ghosts", "flux_fraction"])
        writer.writerows(rows)


if __name__ == "__main__":
    main()
