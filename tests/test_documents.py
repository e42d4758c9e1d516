"""CONTRIBUTING.md with its recipes, CHANGELOG.md and CITATION.cff say what the project holds."""

from __future__ import annotations

import re
from datetime import date
from pathlib import Path

import pytest

import vbnfault

ROOT = Path(__file__).parents[1]
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
RECIPES = sorted((ROOT / "docs" / "contribute").glob("*.md"))
DOCUMENTS = [ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *RECIPES]

# Files that the commands in the text write or that a reader of it adds.
_WRITTEN = {"after.json", "digests.json", "docs/_build", "survivors.json"}


def code_spans(text: str) -> list[str]:
    """Return the code of a Markdown text: what stands between backticks, and the lines of fenced blocks."""
    fenced = re.findall(r"^```.*?\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    rest = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return [*re.findall(r"`([^`]+)`", rest), *"".join(fenced).splitlines()]


def paths(document: Path) -> set[str]:
    """Return every path from the root that a Markdown page names in code, or from its folder as a link's target."""
    text = document.read_text(encoding="utf-8")
    words = {word for span in code_spans(text) for word in span.split()}
    found = {w for w in words if re.fullmatch(r"[\w.-]+(/[\w.-]*)+|[\w-]+\.(py|md|toml|cff|json|png)", w)}
    modules = {m.replace(".", "/") + ".py" for m in re.findall(r"python -m (tests(?:\.\w+)+)", text)}
    links = [link for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]
    linked = {str((document.parent / link.partition("#")[0]).resolve().relative_to(ROOT)) for link in links}
    return {path for path in found | modules | linked if "NAME" not in path} - _WRITTEN


def test_every_path_that_is_named_exists() -> None:
    named = set().union(*(paths(document) for document in DOCUMENTS))
    assert len(named) > 100
    assert not sorted(path for path in named if not (ROOT / path).exists())


def test_contributing_is_short_and_names_every_recipe() -> None:
    assert len(CONTRIBUTING.encode()) <= 8192
    assert {str(recipe.relative_to(ROOT)) for recipe in RECIPES} <= paths(ROOT / "CONTRIBUTING.md")


def test_every_name_beside_a_file_is_in_that_file() -> None:
    text = "\n".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
    beside = re.findall(r"`([\w./]+\.py)`\s+\((`\w+`(?:[,;\s]+`\w+`)*)", text)
    assert len(beside) > 20
    missing = [
        f"{path}: {name}"
        for path, names in beside
        for name in re.findall(r"\w+", names)
        if not re.search(rf"\b{name}\b", (ROOT / path).read_text(encoding="utf-8"))
    ]
    assert not missing


def test_the_changelog_begins_with_this_version() -> None:
    releases = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d{2}-\d{2})$", CHANGELOG, flags=re.MULTILINE)
    assert releases[0][0] == vbnfault.__version__
    days = [date.fromisoformat(day) for _, day in releases]
    assert days == sorted(days, reverse=True)


def test_the_citation_is_of_this_version() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with dask, of the extra 'test'")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    # the keys that the schema of CFF 1.2.0 requires, of the file and of a reference
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["cff-version"] == "1.2.0"
    assert str(citation["version"]) == vbnfault.__version__
    assert f"[{vbnfault.__version__}] - {citation['date-released']}" in CHANGELOG
    assert citation["license"] == "BSD-3-Clause"
    assert citation["authors"] == [{"name": "The vbnfault developers"}]
    for reference in citation["references"]:
        assert {"type", "title", "authors"} <= set(reference)
        assert all(set(author) == {"family-names", "given-names"} for author in reference["authors"])
    assert "doi" not in citation
