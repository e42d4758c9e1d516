"""The command `vbnfault study`: dry runs, values set in place of the file, and bad input in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Called


def test_a_dry_run_says_how_much_a_study_evaluates_and_writes_nothing(
    tmp_path: Path, call: Callable[..., Called]
) -> None:
    out = tmp_path / "out"
    code, said, errors = call("study", "flare_textures", "--out", out, "--dry-run", "--set", "design.n=8")
    assert (code, errors, out.exists()) == (0, "", False)
    lines = said.splitlines()
    assert lines[1] == ("latin_hypercube, n = 8: 8 points × 20 views × 1 seed × 3 models = 480 evaluations")
    assert lines[2].startswith("factors: sun.distance_au (au), ")
    assert "straylight_total_e (electrons), " in lines[3]
    assert lines[4].startswith("warning: design.n = 8: below n = 16 ")


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("design.n=9", "design.n = 9: must be a power of two with method = 'sobol', such as 8 or"),
        ("desing.n=8", "desing: unknown key (did you mean design?)"),
        ("factor[4].high=-0.5", "factor[4].low = -0.03, high = -0.5: bounds reversed or equal"),
        ("factor.4.key=lens.coating.thicknes", "did you mean lens.coating.thickness?"),
        ("factor[15].low=1", "factor[15].low = 1: factor is a list; its entries are 0 to 14"),
        ("metrics.names[0]=straylight_total", "did you mean straylight_total_e?"),
        ("scene.samples=[999]", "scene.samples: sample 999: must be below dataset.samples = "),
        ("scene.plan.sun_facing_nominal_fraction=1.0", "plan.sun_facing_nominal_fraction"),
    ],
)
def test_what_is_wrong_is_one_sentence(
    setting: str, sentence: str, tmp_path: Path, call: Callable[..., Called]
) -> None:
    words = ("study", "flare_lens", "--out", tmp_path / "out", "--dry-run", "--set", setting)
    code, said, errors = call(*words)
    assert (code, said) == (2, "")
    (line,) = errors.splitlines()
    assert sentence in line
