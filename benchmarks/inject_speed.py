"""Time faults in images of 1024×1024 pixels, and compare them with imagecorruptions and Albumentations.

    python benchmarks/inject_speed.py --size 1024 --rounds 9
    python benchmarks/inject_speed.py --only "detector: all"

The first table has the time of one image after set-up: the six faults of the paper, the faults of the sensor
together and each alone, traced straylight with a new Sun, with the same one, and also with the lens in the same
state, as in a sequence, and `vbnfault.torch.Inject` on batches of 256×256 pixels. The arms take turns, round by
round; the table gives medians. A line says how much of the machine's processor time other programs took meanwhile:
wall times count only where that is little.

The second table (`benchmarks/inject_beside.py`) needs `pip install imagecorruptions 'albumentations<2.1'` and is
left out without them. `--only beside` measures it alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import inject_beside
from inject_beside import PAPER, Arm, injector, textured
from turns import Turns, in_turns

from vbnfault.core.errors import VbnfaultError

SENSOR: dict[str, dict[str, Any]] = {
    "smear": {},
    "blooming": {},
    "cti": {},
    "cosmic_rays": {},
    "banding": {},
    "adc": {},
    "broken_pixels": {"model": "hot_pixels"},
    "broken_lines": {"model": "readout"},
    "transmission": {},
}
SMALL_PX, BATCH = 256, 8
# milliseconds of one image at 1024×1024 pixels on two cores, beyond which the program is too slow
TARGETS_MS = {
    "paper, grey": 60,
    "paper, RGB": 60,
    "detector: all": 120,
    "traced, a new Sun": 400,
    "traced, the same Sun": 60,
    "traced, the same Sun and lens": 60,
}


def arms(size_px: int) -> Iterator[tuple[str, Callable[[], Arm]]]:
    """Yield names, and what sets up a function that takes one image with its number."""
    sun = (0.68 * size_px, 0.3 * size_px)

    def of(
        faults: Mapping[str, Any],
        channels: int = 1,
        *,
        moves: bool = False,
        state: int | None = None,
        **camera: Any,
    ) -> Callable[[], Arm]:
        def set_up() -> Arm:
            run, image = injector(faults, **camera), textured(size_px, channels)
            shift = 0.11 * float(moves)
            return lambda k: run(image, k, state=state, sun=(sun[0] + shift * k, sun[1] - shift * k))

        return set_up

    sensor = {"detector": "rosetta_navcam", "fov_deg": 5.0}
    yield "paper, grey", of(PAPER, fov_deg=65.0)
    yield "paper, RGB", of(PAPER, 3, fov_deg=65.0)
    yield "detector: all", of(SENSOR, **sensor)
    for name, table in SENSOR.items():
        yield f"detector: {name}", of({name: table}, **sensor)
    traced = {"straylight": {"model": "traced"}}
    yield "traced, a new Sun", of(traced, 3, moves=True, fov_deg=20.0)
    yield "traced, the same Sun", of(traced, 3, fov_deg=20.0)
    yield "traced, the same Sun and lens", of(traced, 3, state=0, fov_deg=20.0)
    yield f"torch.Inject, {SMALL_PX} px", batches


def batches() -> Arm:
    """Return a function that injects into a batch of RGB images; the time of one image is that over `BATCH`."""
    import torch

    from vbnfault.torch import Inject

    sun = (0.68 * SMALL_PX, 0.3 * SMALL_PX)
    transform = Inject(PAPER, camera={"fov_deg": 65.0, "exposure_s": 0.01}, seed=1, sun=sun)
    batch = torch.from_numpy(textured(SMALL_PX, 3)).permute(2, 0, 1).repeat(BATCH, 1, 1, 1)
    return lambda k: transform(batch, range(k * BATCH, (k + 1) * BATCH))


def table(turns: Turns, targets_ms: Mapping[str, float]) -> str:
    """Return the table of the times."""
    lines = [f"{'ms an image':<30}{'wall':>8}{'CPU':>8}{'target':>8}{'ratio':>8}"]
    for name, wall in turns.wall_ms.items():
        count = BATCH if name.startswith("torch") else 1
        line = f"{name:<30}{wall / count:8.1f}{turns.processor_ms[name] / count:8.1f}"
        if name in targets_ms:
            line += f"{targets_ms[name]:8.0f}{wall / targets_ms[name]:8.2f}"
        lines.append(line)
    return "\n".join(lines)


def main() -> None:
    """Measure the arms in turns and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024, help="pixels along either side of the image")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--only", help="measure only the arms whose name begins so")
    options = parser.parse_args()
    ready: dict[str, Arm] = {}
    for name, set_up in arms(options.size):
        if options.only and not name.startswith(options.only):
            continue
        try:
            ready[name] = set_up()
        except (ImportError, VbnfaultError) as error:
            print(f"{name}: left out: {error}")
    if ready:
        turns = in_turns(ready, options.rounds, warm_up=2)
        print(table(turns, TARGETS_MS if options.size == 1024 else {}))
        print(turns)
    if options.only in (None, "beside"):
        print(inject_beside.table(options.size, options.rounds))


if __name__ == "__main__":
    main()
