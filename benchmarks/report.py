"""Print the table of median durations, and compare ratios of them with the project's targets."""

from __future__ import annotations

from collections.abc import Mapping

AFTER = ("meter", "inject_faults", "take_images", "label", "to_sample", "store")
SAMPLE = ("resolve", "render", "truth", *AFTER)


def sample_seconds(seconds: Mapping[str, float]) -> float:
    """Return the duration of a whole labelled sample, in s."""
    return sum(seconds[name] for name in SAMPLE)


def targets(seconds: Mapping[str, float]) -> list[tuple[str, float, str, float]]:
    """Return the name, ratio, bound ("at least" or "at most") and limit of each target.

    The ratios to Cycles are there only if it was measured.
    """
    after, chain = sum(seconds[name] for name in AFTER), max(seconds["chain_ccd"], seconds["chain_cmos"])
    render, hapke, bounce = seconds["render"], seconds["hapke"], seconds["bounce"]
    listed = [
        ("speed of the render over the bound's", seconds["bound"] / render, "at least", 0.7),
        ("all that follows, over the render", after / render, "at most", 0.2),
        ("the same with Hapke's photometry", seconds["bound"] / hapke, "at least", 0.8),
        ("light between surfaces, over Hapke's render", bounce / hapke - 1, "at most", 0.4),
        ("a full flare frame, over the render", seconds["flare"] / render, "at most", 0.25),
        ("the slower detector chain, over the render", chain / render, "at most", 0.25),
    ]
    if "cycles" in seconds:
        ratio = seconds["cycles"] / sample_seconds(seconds)
        listed.append(("Cycles' render over our labelled sample", ratio, "at least", 4))
    if "cycles_bounce" in seconds:
        listed.append(("Cycles' one bounce over ours", seconds["cycles_bounce"] / bounce, "at least", 4))
    return listed


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
    for name, ratio, bound, limit in targets(seconds):
        met = ratio >= limit if bound == "at least" else ratio <= limit
        lines.append(f"{name:<52}{ratio:9.2f}      {bound} {limit:g}: {'met' if met else 'MISSED'}")
    return "\n".join(lines)
