"""Plot the deviograms of the shape model and of the synthetic terrain, to see whether one continues the other.

python benchmarks/terrain_spectrum.py --out FILE.png [--shape FILE] [--sites N]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vbnfault.body import EMBEDDED, Patch, PatchSpec, build_patch, choose_sites, load_body
from vbnfault.body.geometry import mean_edge_m, vertex_normals
from vbnfault.body.roughness import deviogram, model_roughness

TERRAIN_M = np.geomspace(0.4, 40.0, 11)


def terrain_deviogram(patch: Patch, baselines_m: NDArray) -> NDArray:
    """Return the RMS deviation ν in m at each baseline.

    Only ground near the site is used, where facets are at most a third of the baseline.
    """
    faces = patch.faces[~patch.face_is_boulder]
    points = patch.vertices_L_m[: faces.max() + 1].astype(np.float64)
    normals = vertex_normals(points, faces)
    distance = np.linalg.norm(points, axis=1)
    out = []
    for baseline in baselines_m:
        near = np.flatnonzero(distance < 20.0 + 7.0 * baseline)
        near = near[:: max(1, len(near) // 60_000)] if baseline > 3 else near
        out.append(deviogram(points[near], normals[near], np.array([baseline]), windows=60)[0])
    return np.array(out)


def main() -> None:
    """Print the values and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--shape", default=EMBEDDED)
    parser.add_argument("--sites", type=int, default=6)
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    body = load_body(arguments.shape)
    edge, law = mean_edge_m(body.vertices_m, body.faces), model_roughness(body.vertices_m, body.faces)
    coarse = edge * np.geomspace(1.0, 5.0, 7)
    model = deviogram(body.vertices_m, vertex_normals(body.vertices_m, body.faces), coarse)
    fine = np.array(
        [
            terrain_deviogram(build_patch(body, site, PatchSpec(seed=arguments.seed)), TERRAIN_M)
            for site in choose_sites(body, arguments.sites, arguments.seed)
        ]
    )
    middle = np.sqrt(np.nanmean(fine**2, axis=0))
    formula = f"ν(L) = {law.deviation_m:.2f} m (L / {law.baseline_m:.1f} m)^{law.hurst:.2f}"
    print(f"{body.name}: mean edge {edge:.1f} m; {formula}")
    for length, value in zip([*TERRAIN_M, *coarse], [*middle, *model], strict=True):
        print(f"{length:8.2f} m  ν {value:8.4f} m  law {float(law.deviation_at(length)):8.4f} m")

    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 5))
    axes.loglog(TERRAIN_M, fine.T, color="0.8", lw=1)
    axes.loglog(TERRAIN_M, middle, "o-", label=f"terrain, {len(fine)} sites")
    axes.loglog(coarse, model, "s-", label="shape model")
    both = np.array([TERRAIN_M[0], coarse[-1]])
    axes.loglog(both, law.deviation_at(both), "k--", label=f"law fitted to the model, H = {law.hurst:.2f}")
    axes.axvline(edge, color="0.5", ls=":", label="mean edge of the model")
    axes.set(xlabel="baseline L / m", ylabel="RMS deviation ν / m", title=body.name)
    axes.legend()
    figure.tight_layout()
    figure.savefig(arguments.out, dpi=120)


if __name__ == "__main__":
    main()
