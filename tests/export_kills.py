"""Kill exports at random file operations, resume them, and compare the files with an undisturbed export.

    python tests/export_kills.py --count 200

Each export runs in a process forked from this one, which opens no store. The exit code is 1 if a round failed.
"""

from __future__ import annotations

import argparse
import hashlib
import signal
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import synthetic
import victim
from kills import forked

from vbnfault.output.export import export_store, formats


def tree(folder: Path) -> dict[str, str]:
    """Return the digest of each file below a folder by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def export(store: Path, out: Path, name: str, workers: int = 1) -> int:
    """Export a store, and return how many samples were written."""
    return export_store(store, out, name, workers=workers, progress=False).written


def main() -> int:
    """Run the rounds."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=200, help="kills in all")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--formats", nargs="+", default=[*formats()])
    given = options.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="export-kills-"))
    store = folder / "s.zarr"
    names = given.formats
    code, problem = forked(lambda: synthetic.filled(store, 6).samples)
    assert code == 0, problem
    operations: dict[str, int] = {}
    failures = kills = 0
    for k in range(100 * given.count):
        if kills == given.count:
            break
        name = names[k % len(names)]
        if name not in operations:

            def count(name: str = name) -> int:
                events = [0]

                def counted(kind: str, _text: str) -> None:
                    events[0] += kind == "write"

                victim.follow([], counted)
                export(store, folder / f"whole_{name}", name)
                return events[0]

            code, operations[name] = forked(count)
            assert code == 0, operations[name]
        dice = np.random.default_rng([given.seed, k])
        step = victim.step("write", count=int(dice.integers(1, operations[name])), torn=bool(dice.random() < 0.5))
        out, workers = folder / f"{k}_{name}", int(dice.integers(1, 4))

        def disturbed(step: dict = step, out: Path = out, name: str = name, workers: int = workers) -> int:
            victim.follow([step])
            return export(store, out, name, workers)

        ended, _ = forked(disturbed)
        kills += ended == -signal.SIGKILL
        code, written = forked(lambda out=out, name=name: export(store, out, name))
        if code != 0 or tree(out) != tree(folder / f"whole_{name}"):
            failures += 1
            print(f"FAILED {name}, {step}, {workers} workers: {code}, {written}, files in {out}")
    print(f"{kills} kills, {failures} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
