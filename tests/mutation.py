"""Measure how many mutations of the code the tests notice. A tool for people, not a part of the test suite.

    pip install 'cosmic-ray>=8.7'
    python tests/mutation.py --count 40 --seed 1 --out survivors.json plan labels
    python tests/mutation.py --only survivors.json --out still.json

For each group of modules below, `count` mutations are drawn at random, one at a time is applied to a copy of the
project, and the group's tests run until the first failure. A mutation is *killed* if a test fails or if the tests
take ten times as long as without it, and *survives* otherwise. The score is the fraction killed.

Mutations that cannot change what the program does are left out where that can be told from their position alone:
type annotations, decorators of dataclasses, conditions on `TYPE_CHECKING`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

# group → (modules, tests that are meant to notice their mutations)
GROUPS: dict[str, tuple[list[str], list[str]]] = {
    "plan": (["vbnfault/plan.py"], ["tests/test_plan.py"]),
    "pose": (["vbnfault/pose.py"], ["tests/test_resolve.py", "tests/test_pipeline.py"]),
    "labels": (["vbnfault/labels.py", "vbnfault/record.py"], ["tests/test_labels.py", "tests/test_pipeline.py"]),
    "pictures": (["vbnfault/pictures.py"], ["tests/test_pipeline.py", "tests/test_labels.py"]),
    "exposure": (["vbnfault/exposure.py"], ["tests/test_pipeline.py", "tests/test_physical.py"]),
    "store": (["vbnfault/store/*.py"], ["tests/test_store*.py"]),
    "faults": (["vbnfault/faults/*.py"], ["tests/test_fault_{stem}*.py", "tests/test_faults_*.py"]),
}
_ALWAYS = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
# of mutations that would rarely tell anything: annotations hold `|`, and decorators make dataclasses
_LEFT_OUT = ("BitOr", "RemoveDecorator", "VariableInserter", "VariableReplacer")


def positions(path: Path) -> list[dict[str, Any]]:
    """List every mutation of a module: operator, occurrence and position in the text."""
    import cosmic_ray.plugins
    from cosmic_ray.ast import ast_nodes, get_ast_from_path

    tree, out = get_ast_from_path(path), []
    for name in cosmic_ray.plugins.operator_names():
        kind = cosmic_ray.plugins.get_operator(name)
        if kind.arguments() or any(word in name for word in _LEFT_OUT):
            continue
        operator = kind()
        places = [p for node in ast_nodes(tree) for p in operator.mutation_positions(node)]
        out += [
            {"path": str(path.relative_to(ROOT)), "operator": name, "occurrence": k, "line": start[0], "at": start}
            for k, (start, _) in enumerate(places)
        ]
    return out


def drawn(group: str, count: int, seed: int) -> list[dict[str, Any]]:
    """Draw mutations of a group: one at each of `count` random positions."""
    files = sorted(p for pattern in GROUPS[group][0] for p in ROOT.glob(pattern))
    by_place: dict[Any, list[dict[str, Any]]] = {}
    for path in files:
        for mutation in positions(path):
            by_place.setdefault((mutation["path"], *mutation["at"]), []).append(mutation)
    chance = random.Random(f"{group} {seed}")
    places = chance.sample(sorted(by_place), min(count, len(by_place)))
    return [chance.choice(by_place[place]) | {"group": group} for place in places]


def tests_of(mutation: dict[str, Any], root: Path) -> list[str]:
    """Return the test files that are meant to notice a mutation."""
    stem = Path(mutation["path"]).stem
    patterns = [p.format(stem=stem) for p in GROUPS[mutation["group"]][1]]
    return [str(p.relative_to(root)) for pattern in patterns for p in sorted(root.glob(pattern))]


def run_tests(root: Path, tests: list[str], python: str, limit_s: float | None) -> tuple[bool, str]:
    """Run tests in a copy of the project; return whether they failed, and the first failing test."""
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [python, "-m", "pytest", *_ALWAYS, *tests]
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return True, "no end"
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode != 0, failed[0][:160] if failed else done.stdout[-160:]


def judge(mutation: dict[str, Any], root: Path, python: str, usual_s: dict[str, float]) -> dict[str, Any]:
    """Apply a mutation to the copy at `root`, run its tests, take it back."""
    import cosmic_ray.plugins
    from cosmic_ray.mutating import use_mutation

    operator = cosmic_ray.plugins.get_operator(mutation["operator"])()
    path, tests = root / mutation["path"], tests_of(mutation, root)
    before = path.read_text(encoding="utf-8").splitlines()
    with use_mutation(path, operator, mutation["occurrence"]):
        after = path.read_text(encoding="utf-8").splitlines()
        limit = 10 * usual_s[" ".join(tests)] + 60
        killed, by = run_tests(root, tests, python, limit)
    changed = [(a, b) for a, b in zip(before, after, strict=False) if a != b]
    return mutation | {"killed": killed, "by": by, "change": [x.strip() for x in changed[0]] if changed else []}


def main() -> None:
    """Run the tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="*", help=f"of {', '.join(GROUPS)} [default: all]")
    parser.add_argument("--count", type=int, default=40, help="mutations of each group")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=Path, help="judge the survivors of an earlier run again")
    parser.add_argument("--out", type=Path, required=True, help="JSON of all mutations and what became of them")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--python", default=sys.executable, help="interpreter that runs the tests")
    given = parser.parse_args()
    if given.only:
        chosen = [m for m in json.loads(given.only.read_text(encoding="utf-8")) if not m["killed"]]
    else:
        chosen = [m for group in given.groups or GROUPS for m in drawn(group, given.count, given.seed)]
    done: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.workers) as pool:
        copies = []
        for k in range(given.workers):
            copies.append(Path(folder) / f"copy{k}")
            shutil.copytree(ROOT, copies[-1], ignore=shutil.ignore_patterns(".git", "*.zarr", ".*_cache"))
        usual: dict[str, float] = {}
        for tests in {" ".join(tests_of(m, copies[0])): None for m in chosen}:
            began = time.monotonic()
            failed, by = run_tests(copies[0], tests.split(), given.python, None)
            usual[tests] = time.monotonic() - began
            if failed:
                raise SystemExit(f"tests fail without any mutation: {by}")

        def work(k: int) -> None:
            while True:
                try:
                    mutation = queue.pop()
                except IndexError:
                    return
                result = judge(mutation, copies[k], given.python, usual)
                done.append(result)
                verdict = "killed" if result["killed"] else "SURVIVES"
                print(f"{verdict:<9}{result['path']}:{result['line']} {result['change']}", flush=True)
                given.out.write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")

        queue = list(reversed(chosen))
        list(pool.map(work, range(given.workers)))
    for group in GROUPS:
        mine = [m["killed"] for m in done if m["group"] == group]
        if mine:
            print(f"{group:<10}{sum(mine):4d} of {len(mine):4d} killed: {sum(mine) / len(mine):.2f}")


if __name__ == "__main__":
    main()
