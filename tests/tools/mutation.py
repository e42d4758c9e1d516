"""Measure which fraction of mutations of the code the tests detect. This tool is not part of the test suite.

    pip install 'cosmic-ray>=8.7'
    python -m tests.tools.mutation --count 40 --seed 1 --out survivors.json plan labels
    python -m tests.tools.mutation --only survivors.json --out still.json

For each group of modules, `--count` mutations are drawn at random. Each one is applied alone to a copy of the
project, and the group's tests run until the first failure. A mutation is *killed* if a test fails or if the tests
take more than 60 s plus ten times their normal duration; otherwise it *survives*. The score is the fraction killed,
printed with its 95 % interval (Wilson).

Before the first mutation the tests run once with a tracer, which records each test's duration and the lines that it
executes (`--traces` keeps both in a file for the next run). For a mutation, only the tests that execute its
statement run, the shortest first. Lines that run in the set-up of a test count for all tests of its file. Lines
that run while modules are imported count for all tests. Tests marked `slow` are left out.

Mutations whose position shows that they cannot change what the program computes are left out: those of type
annotations, decorators and the text of errors, and those that are not valid Python.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

# group → (modules, tests that should detect their mutations)
GROUPS: dict[str, tuple[list[str], list[str]]] = {
    "plan": (["vbnfault/scene/plan.py"], ["tests/test_plan.py", "tests/test_views.py"]),
    "splits": (["vbnfault/scene/plan.py"], ["tests/test_plan.py", "tests/test_views.py"]),
    "pose": (
        ["vbnfault/pipeline/resolve.py"],
        ["tests/test_resolve.py", "tests/test_views.py", "tests/test_pipeline.py", "tests/test_spice.py"],
    ),
    "labels": (
        ["vbnfault/pipeline/masks.py", "vbnfault/pipeline/labels.py", "vbnfault/pipeline/record.py"],
        ["tests/test_labels.py", "tests/test_pipeline.py", "tests/test_truth.py"],
    ),
    "images": (
        ["vbnfault/pipeline/injection.py", "vbnfault/pipeline/development.py"],
        ["tests/test_pipeline.py", "tests/test_labels.py"],
    ),
    "exposure": (
        ["vbnfault/pipeline/rendering.py", "vbnfault/pipeline/exposure.py"],
        ["tests/test_exposure.py", "tests/test_pipeline.py", "tests/test_physical.py"],
    ),
    "store": (["vbnfault/store/*.py"], ["tests/test_store*.py"]),
    "faults": (["vbnfault/faults/*.py"], ["tests/test_fault_{stem}*.py", "tests/test_faults_contract.py"]),
}
# functions of a module that form their own group
PARTS: dict[str, set[str]] = {
    "splits": {"shortcomings", "site_split", "individual_split", "_in_turn", "individuals", "_dealt", "_exchange"}
    | {"_shard_sites", "_site_order"},
}
_ALWAYS = ["-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not slow"]
# operators whose mutations rarely show anything: most `|` are in annotations, most decorators make dataclasses
_LEFT_OUT = ("BitOr", "RemoveDecorator", "VariableInserter", "VariableReplacer")
_IMPORT = "import"  # name in tests/tools/lines_by_test.py for lines that run outside of tests


# ------------------------------------------------------------------------------------ which test executes a line


def traced(root: Path, file: str, python: str, kept: Path | None) -> dict[str, Any]:
    """Return the lines and the duration of each test of a file.

    They come from the file `kept` if the sources, `conftest.py` and the test file are unchanged since.
    """
    sources = [*sorted(root.glob("vbnfault/**/*.py")), root / "tests/conftest.py", root / file]
    digest = hashlib.sha256(b"".join(p.read_bytes() for p in sources) + file.encode()).hexdigest()
    known = json.loads(kept.read_text(encoding="utf-8")) if kept and kept.is_file() else {}
    if digest not in known:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "trace.json"
            failed, by = run_tests(
                root, ["-p", "tools.lines_by_test", file], python, None, {"LINES_BY_TEST": str(out)}
            )
            if failed:
                raise SystemExit(f"tests fail without any mutation: {by}")
            known[digest] = json.loads(out.read_text(encoding="utf-8"))
        if kept:
            kept.write_text(json.dumps(known), encoding="utf-8")
    result: dict[str, Any] = known[digest]
    return result


def executing(mutation: dict[str, Any], traces: list[dict[str, Any]]) -> dict[str, float]:
    """Return the tests that execute a mutation's statement with their durations in s, the shortest first."""
    first, last = mutation["statement"]
    keys = [f"{mutation['path']}:{k}" for k in range(first, last + 1)]
    runs: dict[str, float] = {}
    for trace in traces:
        by = {t for key in keys for t in trace["lines"].get(key, ())}
        runs |= {t: s for t, s in trace["seconds"].items() if by & {_IMPORT, t, t.split("::")[0]}}
    return dict(sorted(runs.items(), key=lambda run: run[1]))


# ------------------------------------------------------------------------------------ mutations


def _decorated(node: ast.AST) -> Iterator[int]:
    """Yield the lines of a definition's decorators."""
    for decorator in getattr(node, "decorator_list", ()):
        yield from range(decorator.lineno, decorator.end_lineno + 1)


def statements(path: Path) -> dict[int, tuple[int, int, str, bool]]:
    """Return for each line of a module: first and last line of its statement, its function, whether it is left out.

    Decorators and `raise` statements are left out.
    """
    found: dict[int, tuple[int, int, str, bool]] = {}

    def visit(node: ast.AST, function: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner = function
            if isinstance(child, ast.stmt):
                body = getattr(child, "body", None)
                last = body[0].lineno - 1 if body and isinstance(body[0], ast.stmt) else child.end_lineno
                last = max(child.lineno, last or child.lineno)
                for line in range(child.lineno, last + 1):
                    found[line] = (child.lineno, last, function, isinstance(child, ast.Raise))
                for line in _decorated(child):
                    found[line] = (line, line, function, True)
                if isinstance(child, ast.FunctionDef | ast.ClassDef):
                    inner = f"{function}.{child.name}".lstrip(".")
            visit(child, inner)

    visit(ast.parse(path.read_text(encoding="utf-8")), "")
    return found


def positions(path: Path) -> list[dict[str, Any]]:
    """Return every mutation of a module: operator, occurrence, position, statement and function."""
    import cosmic_ray.plugins
    from cosmic_ray.ast import ast_nodes, get_ast_from_path

    tree, out, by_line = get_ast_from_path(path), [], statements(path)
    for name in cosmic_ray.plugins.operator_names():
        kind = cosmic_ray.plugins.get_operator(name)
        if kind.arguments() or any(word in name for word in _LEFT_OUT):
            continue
        operator = kind()
        places = [p for node in ast_nodes(tree) for p in operator.mutation_positions(node)]
        for k, (start, _) in enumerate(places):
            first, last, function, left_out = by_line.get(start[0], (start[0], start[0], "", False))
            if not left_out:
                where = {"path": str(path.relative_to(ROOT)), "line": start[0], "at": start, "function": function}
                out.append({**where, "operator": name, "occurrence": k, "statement": (first, last)})
    return out


def drawn(group: str, count: int, seed: int) -> list[dict[str, Any]]:
    """Draw mutations of a group: one at each of up to `count` random positions."""
    files = sorted(p for pattern in GROUPS[group][0] for p in ROOT.glob(pattern))
    apart = set().union(*(PARTS[g] for g in PARTS if g != group and GROUPS[g][0] == GROUPS[group][0]))
    by_place: dict[Any, list[dict[str, Any]]] = {}
    for path in files:
        for mutation in positions(path):
            function = mutation["function"].split(".")[0]
            if function in PARTS[group] if group in PARTS else function not in apart:
                by_place.setdefault((mutation["path"], *mutation["at"]), []).append(mutation)
    chance = random.Random(f"{group} {seed}")
    out: list[dict[str, Any]] = []
    for place in chance.sample(sorted(by_place), len(by_place)):
        mutation = chance.choice(by_place[place])
        if _compiles(mutation):
            out.append(mutation | {"group": group})
        if len(out) >= count:
            break
    return out


def _compiles(mutation: dict[str, Any]) -> bool:
    """Return whether the mutated module is valid Python."""
    import cosmic_ray.plugins
    from cosmic_ray.mutating import mutate_code

    text = (ROOT / mutation["path"]).read_text(encoding="utf-8")
    changed = mutate_code(text, cosmic_ray.plugins.get_operator(mutation["operator"])(), mutation["occurrence"])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # compile warns about `is` with a number
            compile(changed or "", mutation["path"], "exec")
    except SyntaxError:
        return False
    return changed is not None


def tests_of(mutation: dict[str, Any], root: Path) -> list[str]:
    """Return the test files that should detect a mutation."""
    stem = Path(mutation["path"]).stem
    patterns = [p.format(stem=stem) for p in GROUPS[mutation["group"]][1]]
    return [str(p.relative_to(root)) for pattern in patterns for p in sorted(root.glob(pattern))]


# ------------------------------------------------------------------------------------ verdicts


def run_tests(
    root: Path, tests: list[str], python: str, limit_s: float | None, more: dict[str, str] | None = None
) -> tuple[bool, str]:
    """Run tests in a copy of the project; return whether they failed, and the first failing test.

    `limit_s`: duration after which the tests count as failed. `more`: further environment variables.
    """
    paths = os.pathsep.join((str(root), str(root / "tests")))
    # tests that are killed leave their files: on the disk, not in memory
    own = {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1", "TMPDIR": tempfile.gettempdir()}
    environment = {**os.environ, **own, **(more or {})}
    command = [python, "-m", "pytest", *_ALWAYS, "-x", *tests]
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return True, "no end"
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode != 0, failed[0][:160] if failed else (done.stdout + done.stderr)[-400:]


def judge(mutation: dict[str, Any], root: Path, python: str, traces: list[dict[str, Any]]) -> dict[str, Any]:
    """Apply a mutation to the copy at `root`, run its tests, undo the mutation; return the verdict."""
    import cosmic_ray.plugins
    from cosmic_ray.mutating import use_mutation

    operator = cosmic_ray.plugins.get_operator(mutation["operator"])()
    path, tests = root / mutation["path"], executing(mutation, traces)
    before = path.read_text(encoding="utf-8").splitlines()
    with use_mutation(path, operator, mutation["occurrence"]):
        after = path.read_text(encoding="utf-8").splitlines()
        limit = 10 * sum(tests.values()) + 60
        killed, by = run_tests(root, list(tests), python, limit) if tests else (False, "no test executes it")
    changed = [(a, b) for a, b in zip(before, after, strict=False) if a != b]
    change = [x.strip() for x in changed[0]] if changed else []
    return mutation | {"killed": killed, "by": by, "change": change, "tests": len(tests)}


def interval(killed: int, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a fraction."""
    z = 1.96
    middle = (killed + z**2 / 2) / (count + z**2)
    half = z / (count + z**2) * (killed * (count - killed) / count + z**2 / 4) ** 0.5
    return middle - half, middle + half


def main() -> None:
    """Draw the mutations, judge them, and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="*", help=f"of {', '.join(GROUPS)} [default: all]")
    parser.add_argument("--count", type=int, default=40, help="mutations of each group")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=Path, help="judge the survivors of an earlier run again")
    parser.add_argument("--out", type=Path, required=True, help="JSON of all mutations and what became of them")
    parser.add_argument("--traces", type=Path, help="JSON in which the lines and durations of tests are kept")
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
        if (ROOT.parent / "shared").is_dir():  # some tests read the real shape of the comet there
            (Path(folder) / "shared").symlink_to(ROOT.parent / "shared")
        traces: dict[str, dict[str, Any]] = {}
        for file in sorted({file for m in chosen for file in tests_of(m, copies[0])}):
            traces[file] = traced(copies[0], file, given.python, given.traces)
            print(f"{file}: {len(traces[file]['seconds'])} tests", flush=True)

        def work(k: int) -> None:
            while True:
                try:
                    mutation = queue.pop()
                except IndexError:
                    return
                mine = [traces[file] for file in tests_of(mutation, copies[k])]
                result = judge(mutation, copies[k], given.python, mine)
                done.append(result)
                verdict = "killed" if result["killed"] else "SURVIVES"
                print(f"{verdict:<9}{result['path']}:{result['line']} {result['change']}", flush=True)
                given.out.write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")

        queue = list(reversed(chosen))
        list(pool.map(work, range(given.workers)))
    for group in GROUPS:
        mine = [m["killed"] for m in done if m["group"] == group]
        if mine:
            low, high = interval(sum(mine), len(mine))
            score = f"{sum(mine) / len(mine):.2f} ({low:.2f} to {high:.2f})"
            print(f"{group:<10}{sum(mine):4d} of {len(mine):4d} killed: {score}")


if __name__ == "__main__":
    main()
