"""Print how far the ghosts of a lens move on the sensor where one of its elements is decentred or tilted.

    python benchmarks/ghost_decentre.py nikkor_35_f2p8_camera --decentre-mm 0.02 --tilt-arcmin 3

The computation is of first order, with the matrices of paraxial ghosts: a surface of the power φ (of a mirror: 2
c) that is decentred by δ acts as one on the axis and a kick of the slope, -φ δ. An element that tilts about its
first vertex decentres each of its surfaces by the angle times the distance of its centre of curvature from this
vertex. The kicks at all surfaces of the element that a path meets add up on the sensor, for the ray that still
passes the middle of the stop. The stop and the other rims do not move, and the flux of a ghost stays as it is:
where rims cut a ghost, only rays through the decentred lens would give its flux.
"""

from __future__ import annotations

import argparse

import numpy as np

from vbnfault.lens import Prescription, load_lens
from vbnfault.lens.paraxial import along
from vbnfault.lens.rays import ghost, transmittance
from vbnfault.lens.straylight.bundles import name_of, routes

_MOST = 8  # ghosts, those with most light


def elements(lens: Prescription) -> list[list[int]]:
    """Return the rows of each element: its surfaces from air through glass to air."""
    found: list[list[int]] = []
    before = False
    for row, surface in enumerate(lens.surfaces):
        if before:
            found[-1].append(row)
        elif surface.medium.nd > 1.0001:
            found.append([row])
        before = surface.medium.nd > 1.0001
    return found


def shift_mm(lens: Prescription, pair: tuple[int, int], decentre_mm: dict[int, float]) -> float:
    """Return how far a ghost moves on the sensor where rows are decentred."""
    path, index = ghost(lens, *pair), lens.indices()
    whole, met = along(lens, path)
    at_stop = next(j for j, (row, _) in enumerate(path) if row == lens.stop)
    moved, moved_at_stop, onward = 0.0, 0.0, True
    for j, (row, mirror) in enumerate(path):
        if row in decentre_mm:
            curvature = lens.surfaces[row].curvature_per_mm * (1 if onward else -1)
            into, out = (index[row], index[row + 1]) if onward else (index[row + 1], index[row])
            # the slope before the surface that has the same effect behind it
            kick = -decentre_mm[row] * curvature * (2 if mirror else (into - out) / into)
            before = np.linalg.inv(met[j]) @ [0.0, kick]
            moved += float((whole @ before)[0])
            if j < at_stop:
                moved_at_stop += float((met[at_stop] @ before)[0])
        onward ^= mirror
    return moved - float(whole[0, 0] / met[at_stop][0, 0]) * moved_at_stop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lens")
    parser.add_argument("--decentre-mm", type=float, default=0.02)
    parser.add_argument("--tilt-arcmin", type=float, default=3.0)
    parser.add_argument("--pitch-um", type=float, default=5.5)
    arguments = parser.parse_args()
    lens = load_lens(arguments.lens)
    tilt, vertex = np.radians(arguments.tilt_arcmin / 60), lens.vertices_mm
    brightest = sorted(
        [name_of(r) for r in routes(lens)], key=lambda pair: -transmittance(lens, ghost(lens, *pair))
    )[:_MOST]
    print("shift / px of the ghosts of", ", ".join(f"{a}-{b}" for a, b in brightest))
    for rows in elements(lens):
        centres = {row: vertex[row] - vertex[rows[0]] for row in rows}
        centres = {row: z + 1 / c for row, z in centres.items() if (c := lens.surfaces[row].curvature_per_mm)}
        for name, decentre in (
            (f"decentre {arguments.decentre_mm:g} mm", dict.fromkeys(rows, arguments.decentre_mm)),
            (f"tilt {arguments.tilt_arcmin:g} arcmin", {row: tilt * z for row, z in centres.items()}),
        ):
            moved = [1e3 * shift_mm(lens, pair, decentre) / arguments.pitch_um for pair in brightest]
            print(f"rows {rows[0]}-{rows[-1]}, {name:>18}:", *(f"{value:7.2f}" for value in moved))


if __name__ == "__main__":
    main()
