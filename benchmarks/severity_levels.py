"""Compute the levels of severity of fault models and write the table that scenes read.

    python benchmarks/severity_levels.py --out scenes/severity/levels.toml
    python benchmarks/severity_levels.py --out some.toml --models dust_on_optics/gaussian vignetting/cos4

Models that need the Sun are evaluated on views that face it, models of a mosaic with the sensor `generic_ccd`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from vbnfault.study import severity


def main() -> None:
    """Compute the levels of the models given, and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="TOML file to write")
    parser.add_argument("--scene", default="quickstart", help="scene whose views are used")
    parser.add_argument("--views", type=int, default=12, help="number of views")
    parser.add_argument("--pixels", type=int, default=512, help="width and height of the images")
    parser.add_argument("--lens", default="", help="packaged lens of the camera; default: the scene's")
    parser.add_argument("--models", nargs="*", default=(), help="models as class/model; default: all")
    given = parser.parse_args()
    criterion = severity.Criterion()
    overrides = {"camera.width_px": given.pixels, "camera.height_px": given.pixels}
    if given.lens:
        overrides["camera.lens"] = given.lens
    sets: dict[tuple[bool, bool], severity.ViewSet] = {}
    levels = []
    for model in severity.models_with_severity():
        if given.models and f"{model.fault}/{model.model}" not in given.models:
            continue
        kind = model.needs_sun, model.needs_mosaic
        if kind not in sets:
            sensor = {"camera.detector": "generic_ccd"} if model.needs_mosaic else {}
            sets[kind] = severity.view_set(
                given.scene,
                given.views,
                criterion=criterion,
                facing_sun=model.needs_sun,
                overrides={**overrides, **sensor},
            )
        levels.append(severity.levels_of(model, sets[kind], said=lambda text: print(text, flush=True)))
        print(levels[-1], flush=True)
        severity.write_levels(given.out, levels, criterion, given.scene, given.views)


if __name__ == "__main__":
    main()
