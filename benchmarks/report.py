"""Print the table of median durations, and compare ratios of them with the project's targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

AFTER = ("meter", "inject_faults", "take_images", "label", "to_sample", "store")
SAMPLE = ("resolve", "render", "truth", *AFTER)


@dataclass(frozen=True, kw_only=True)
class Target:
    """A ratio and its limit: a minimum if `least`, otherwise a maximum."""

    what: str
    ratio: float
    limit: float
    least: bool

    @property
    def met(self) -> bool:
        """Whether the ratio keeps its limit."""
        return self.ratio >= self.limit if self.least else self.ratio <= self.limit


def sample_seconds(seconds: Mapping[str, float]) -> float:
    """Return the duration of a whole labelled sample, in s."""
    return sum(seconds[name] for name in SAMPLE)


def targets(seconds: Mapping[str, float]) -> list[Target]:
    """Return the ratios of one run with their limits; those to Cycles only if it was measured."""
    after = sum(seconds[name] for name in AFTER)
    found = [
        Target(
            what="speed of the render over the bound's",
            ratio=seconds["bound"] / seconds["render"],
            limit=0.7,
            least=True,
        ),
        Target(what="all that follows, over the render", ratio=after / seconds["render"], limit=0.2, least=False),
    ]
    found += [
        Target(
            what="the same with Hapke's photometry",
            ratio=seconds["bound"] / seconds["hapke"],
            limit=0.8,
            least=True,
        ),
        Target(
            what="light between surfaces, over Hapke's render",
            ratio=seconds["bounce"] / seconds["hapke"] - 1,
            limit=0.4,
            least=False,
        ),
    ]
    found.append(
        Target(
            what="a full flare frame, over the render",
            ratio=seconds["flare"] / seconds["render"],
            limit=0.25,
            least=False,
        )
    )
    found.append(
        Target(
            what="the slower detector chain, over the render",
            ratio=max(seconds["chain_ccd"], seconds["chain_cmos"]) / seconds["render"],
            limit=0.25,
            least=False,
        )
    )
    if "cycles" in seconds:
        ratio = seconds["cycles"] / sample_seconds(seconds)
        found.append(Target(what="Cycles' render over our labelled sample", ratio=ratio, limit=4, least=True))
    if "cycles_bounce" in seconds:
        ratio = seconds["cycles_bounce"] / seconds["bounce"]
        found.append(Target(what="Cycles' one bounce over ours", ratio=ratio, limit=4, least=True))
    return found


def table(seconds: Mapping[str, float]) -> str:
    """Return the medians in ms and the ratios, as a text table."""
    names = {
        "bound": "bound: closest hit + shadow ray, one kernel",
        "resolve": "resolve",
        "render": "render: eight bands",
        "truth": "truth: depth, normals, classes",
        "meter": "meter",
        "inject_faults": "inject_faults: draws of six faults, clean twin",
        "take_images": "take_images: image with six faults",
        "label": "label: masks",
        "to_sample": "to_sample",
        "store": "store: encode and write, per sample of a shard",
    }
    others = {
        "hapke": "render with Hapke's photometry",
        "bounce": "render with Hapke's photometry and one bounce",
        "flare": "flare: all ghosts of 11 surfaces, eight wavelengths",
        "chain_ccd": "detector: a CCD's chain, every effect on",
        "chain_cmos": "detector: a CMOS sensor's chain, every effect on",
        "cycles": "Blender Cycles, render call alone",
        "cycles_bounce": "Blender Cycles with one bounce",
    }

    def lines_of(of: Mapping[str, str]) -> list[str]:
        return [f"{text:<52}{seconds[n] * 1e3:9.1f} ms" for n, text in of.items() if n in seconds]

    lines = [
        *lines_of(names),
        f"{'= labelled sample':<52}{sample_seconds(seconds) * 1e3:9.1f} ms",
        *lines_of(others),
    ]
    lines.append("")
    for t in targets(seconds):
        wanted = f"{'at least' if t.least else 'at most'} {t.limit:g}"
        lines.append(f"{t.what:<52}{t.ratio:9.2f}      {wanted}: {'met' if t.met else 'MISSED'}")
    return "\n".join(lines)
