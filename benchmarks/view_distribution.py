"""Compare a store with the tables of its scene: the counts of its faults, and the distribution of every variable.

    vbnfault build paper67p --out paper.zarr --samples 2000 --set camera.width_px=128 --set camera.height_px=128 \
        --set patch.max_triangles=200000
    python benchmarks/view_distribution.py paper.zarr
    python benchmarks/view_distribution.py paper.zarr --out views.png

The first lines say how often each class is planned and realised. A table has the Kolmogorov-Smirnov test of every
variable of the views, by stratum, and of every parameter of the paper's fault models, as stored, with the uniform
distribution within the bounds of the scene. Whole numbers get a uniform fraction, so that the test is exact; the
offset of a line is uniform up to the smaller of its two bounds. With m variables, some p is below 0.01 / m once in
a hundred datasets; the exit status is 1 if one is, or if a count differs from the plan.

With `--out`, the first and the kept views are plotted and compared.

A view is drawn again if the geometry of the scene excludes it (the camera is below the ground, or the Sun is hidden
in a sample with straylight), or if a commanded fault cannot show in it. The reference distribution is that of the
first views of a plan with 200,000 samples and another seed: uniform within the bounds, without the attitudes of
Sun-averted samples that look at the Sun. The kept views should follow it, on the condition that they can be used.

Three comparisons with the Kolmogorov-Smirnov test show this, for each stratum and each variable:

- `first`: the first views of all samples with the reference. They must agree.
- `kept`: the views of the store with the reference. They differ because the conditions exclude some views; `shift`
  is the difference of the means divided by the width of the bounds.
- `again`: the views kept at a later try with those kept at the first try, for samples with a fault. They must
  agree; otherwise drawing again prefers some of the usable views.
"""

from __future__ import annotations

import argparse
import json
import operator
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vbnfault import store
from vbnfault.dataset.identity import classes_that_need_sun, stored_plan, stored_scene
from vbnfault.scene import exchange, names, plan, redraw

VARIABLES = ("x_m", "y_m", "height_m", "roll_deg", "pitch_deg", "yaw_deg", "sun_elevation_deg", "sun_azimuth_deg")
LEVEL = 0.01
TABLE_SAMPLES = 200_000
BINS = 20

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """The views of one stratum: values of each variable, float64[sample], and its bounds.

    Attributes
    ----------
    table
        Values of the reference plan.
    first, kept
        First and kept views of the samples.
    again
        Samples that kept a later view, bool[sample].
    faulty
        Samples for which a fault is commanded, bool[sample].
    """

    stratum: str
    bounds: dict[str, tuple[float, float]]
    table: dict[str, F64]
    first: dict[str, F64]
    kept: dict[str, F64]
    again: NDArray[np.bool_]
    faulty: NDArray[np.bool_]

    def tests(self, variable: str) -> dict[str, Any]:
        """Return the results of the three tests for a variable, and `shift`."""
        table, first, kept = (of[variable] for of in (self.table, self.first, self.kept))
        low, high = self.bounds[variable]
        early, late = kept[~self.again & self.faulty], kept[self.again & self.faulty]
        return {
            "first": stats.ks_2samp(first, table),
            "kept": stats.ks_2samp(kept, table),
            "again": stats.ks_2samp(late, early) if len(late) and len(early) else None,
            "shift": float(kept.mean() - table.mean()) / ((high - low) or 1.0),
        }


# Drawn parameters of the paper's fault models: the key of the scene that bounds them, and the values as stored.
PARAMETERS: dict[str, dict[str, Callable[[dict[str, Any]], Any]]] = {
    "dust_on_optics": {
        "count": lambda p: len(p["peak_dn"]),
        **{key: operator.itemgetter(key) for key in ("peak_dn", "sigma_xx", "sigma_yy")},
    },
    "broken_pixels": {"count": lambda p: len(p["x"]), "brightness_dn": operator.itemgetter("brightness_dn")},
    "broken_lines": {"count": lambda p: len(p["row_values"]) + len(p["column_values"])},
    "straylight": {
        "count": lambda p: len(p["flares"]),
        **{
            key: lambda p, key=key: [flare[key] for flare in p["flares"]]
            for key in ("index", "position", "radius", "brightness")
        },
    },
    "vignetting": {"on_axis_illuminance_dn": operator.itemgetter("on_axis_illuminance_dn")},
    "optics_degradation": {"filter_size_px": operator.itemgetter("filter_size_px")},
}
WHOLE = ("count", "brightness_dn", "index", "filter_size_px")


def variables_of(opened: store.Store) -> Iterator[tuple[str, tuple[float, float], F64]]:
    """Yield name, bounds and values of each variable of a store's tables; the values are uniform in [0, 1]."""
    scene, need = stored_scene(opened.attributes), ("stratum", "parameters", "proposal")
    done = np.flatnonzero(np.asarray(opened.read("done")))
    stratum, parameters, proposal = (np.asarray(opened.read(name))[done] for name in need)
    proposals = [json.loads(str(text)) for text in proposal]
    for code, name in enumerate(names.STRATA):
        for variable in VARIABLES:
            low, high = (float(bound[code]) for bound in redraw.bounds(scene, variable))
            values = np.array([p[variable] for p, s in zip(proposals, stratum, strict=True) if s == code])
            if len(values) and high > low:
                yield f"{name} {variable}", (low, high), (values - low) / (high - low)
    drawn = [json.loads(str(text)) for text in parameters]
    rng = np.random.default_rng(1)
    for fault, keys in PARAMETERS.items():
        mine = [p[fault] for p in drawn if p.get(fault, {}).get("model") in ("gaussian", "texture", "cos4")]
        if not mine:
            continue
        table = scene.faults[fault]
        for key, values_of in keys.items():
            values = np.concatenate([np.ravel(values_of(p)) for p in mine]).astype(float)
            low, high = (float(bound) for bound in table[key])
            step = (1 if key in WHOLE else 0) + (key == "filter_size_px")  # sizes are odd
            values += step * rng.random(len(values))
            yield f"{fault} {key}", (low, high), (values - low) / (high - low + step)
        lines = [p for p in mine if "line_offset_dn" in p]
        if lines:
            offset, bright = (np.concatenate([p[k] for p in lines]) for k in ("line_offset_dn", "brightness_dn"))
            low, high = table["line_offset_dn"]
            most = np.minimum(high, np.floor(table["line_offset_fraction"] * bright + 1e-9))
            yield f"{fault} line_offset_dn", (low, high), (offset + rng.random(len(offset))) / (most + 1)


def print_table(path: Path) -> bool:
    """Print counts and tests of a store, and return whether all agree with the plan and with the bounds."""
    opened = store.open_store(path)
    _, made = stored_plan(opened.attributes, opened.spec.faults)
    counts = store.count_faults(opened, made.injected)
    print("\n".join(counts.lines()))
    print(f"\n{'variable':<36}{'bounds':>16}{'values':>9}{'mean':>8}{'D':>8}{'p':>9}")
    chances = []
    for name, (low, high), values in variables_of(opened):
        test = stats.kstest(values, "uniform")
        chances.append(test.pvalue)
        tail = f"{values.mean():>8.3f}{test.statistic:>8.4f}{test.pvalue:>9.2g}"
        print(f"{name:<36}{f'{low:g} to {high:g}':>16}{len(values):>9}{tail}")
    least = LEVEL / len(chances)
    print(f"\n{len(chances)} variables, smallest p = {min(chances):.2g}, which must be above {least:.2g}")
    if made.group is not None:
        tries, stratum = (np.asarray(opened.read(name)) for name in ("tries", "stratum"))
        members = np.array([len(made.members(i)) for i in range(len(made))])
        for code, name in enumerate(names.STRATA):
            here = (stratum == code) & (tries > 0)
            t, m = tries[here], members[here]
            again = t > m if code == plan.SUN_AVERTED else t > m + exchange.KEPT_TRIES
            print(
                f"{name}: {int((t == 1).sum())} views as drawn, {int(((t > 1) & (t <= m)).sum())} exchanged, "
                f"{int((t > m).sum())} drawn again, {int(again.sum())} of them with another Sun"
            )
    return not counts.missing and min(chances) > least


def views_of(path: Path) -> list[Views]:
    """Return the views of a store's finished samples by stratum; strata without samples are left out."""
    opened = store.open_store(path)
    scene = stored_scene(opened.attributes)
    need_sun = classes_that_need_sun(opened.attributes)
    made = plan.make_plan(scene, opened.spec.faults, opened.attributes["blocks"], need_sun=need_sun)
    large = {"samples": TABLE_SAMPLES, "seed": scene.dataset.seed + 1}
    many = scene.model_copy(update={"dataset": scene.dataset.model_copy(update=large)})
    table = plan.make_plan(many, opened.spec.faults, need_sun=need_sun)
    whole = np.flatnonzero(np.asarray(opened.read("done")))
    tries = np.asarray(opened.read("tries"))[whole]
    kept = [made.view(scene, int(i), int(k) - 1) for i, k in zip(whole, tries, strict=True)]
    out = []
    for code, name in enumerate(names.STRATA):
        here = made.stratum[whole] == code
        if not here.any():
            continue
        out.append(
            Views(
                stratum=name,
                bounds={v: tuple(float(b[code]) for b in redraw.bounds(scene, v)) for v in VARIABLES},
                table={v: table.variables[v][table.stratum == code] for v in VARIABLES},
                first={v: made.variables[v][whole][here] for v in VARIABLES},
                kept={v: np.array([view[v] for view in kept])[here] for v in VARIABLES},
                again=tries[here] > 1,
                faulty=made.injected[whole][here].any(axis=1),
            )
        )
    return out


def lines(views: Views) -> list[str]:
    """Return the test results of a stratum as lines of text."""
    out = [
        f"{views.stratum}: {len(views.again)} samples, {int(views.again.sum())} kept a later view",
        f"  {'':<18}{'bounds':>18}  {'first: D':>9}{'p':>8}  {'kept: D':>9}{'p':>9}{'shift':>8}  "
        f"{'again: D':>9}{'p':>8}",
    ]
    for variable in VARIABLES:
        found = views.tests(variable)
        low, high = views.bounds[variable]
        first, kept, again = found["first"], found["kept"], found["again"]
        tail = f"{again.statistic:9.3f}{again.pvalue:8.3f}" if again else f"{'-':>9}{'-':>8}"
        out.append(
            f"  {variable:<18}{f'{low:g} to {high:g}':>18}  {first.statistic:9.3f}{first.pvalue:8.3f}  "
            f"{kept.statistic:9.3f}{kept.pvalue:9.1e}{found['shift']:+8.3f}  {tail}"
        )
    return out


def plot(strata: list[Views], title: str, path: Path) -> None:
    """Write histograms of every variable as a PNG, one row a stratum."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(
        len(strata), len(VARIABLES), figsize=(3 * len(VARIABLES), 3 * len(strata)), squeeze=False
    )
    for row, views in zip(grid, strata, strict=True):
        for axes, variable in zip(row, VARIABLES, strict=True):
            low, high = views.bounds[variable]
            edges = np.linspace(low, high if high > low else low + 1, BINS + 1)
            kept = views.kept[variable]
            axes.hist(views.table[variable], edges, density=True, color="0.85", label="table")
            for values, label in (
                (views.first[variable], f"first views, {len(kept)}"),
                (kept, f"kept views, {len(kept)}"),
                (kept[views.again], f"drawn again, {int(views.again.sum())}"),
            ):
                axes.hist(values, edges, density=True, histtype="step", lw=1.4, label=label)
            for bound in (low, high):
                axes.axvline(bound, color="k", ls=":", lw=1)
            found = views.tests(variable)
            again = "" if found["again"] is None else f", again p = {found['again'].pvalue:.2g}"
            axes.set_title(f"kept D = {found['kept'].statistic:.3f}{again}", fontsize=8)
            axes.set_xlabel(variable)
            axes.set_yticks([])
        row[0].set_ylabel(views.stratum)
        row[0].legend(fontsize=7)
    figure.suptitle(title)
    figure.tight_layout()
    figure.savefig(path, dpi=70)


def main() -> int:
    """Print the test results, write the plot and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path, help="store whose views are looked at")
    parser.add_argument("--out", type=Path, help="PNG to write [none]")
    given = parser.parse_args()
    good = print_table(given.store)
    if given.out is None:
        return 0 if good else 1
    given.out.parent.mkdir(parents=True, exist_ok=True)
    strata = views_of(given.store)
    for views in strata:
        print("\n".join(lines(views)))
    total = sum(len(views.again) for views in strata)
    plot(strata, f"{given.store.name}: views of {total} samples", given.out)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
