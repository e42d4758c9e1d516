"""Some rounds of `kills`: builds, merges and exports that are killed and resumed have one digest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent


def test_killed_commands_resume_to_one_digest() -> None:
    """Other ways take longer; test_build_dask, test_object_store, test_retake, test_shard_range have them."""
    ways = ["process", "merge", "bucket", "export"]
    options = ["--each", "1", "--steps", "1", "--samples", "8", "--ways", *ways]
    command = [sys.executable, "-m", "tests.tools.kills", *options]
    done = subprocess.run(command, cwd=HERE.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "one digest" in done.stdout
    table = done.stdout.split("digests\n")[1].splitlines()[: len(ways)]
    assert [int(line[34:40]) for line in table] == [1] * len(ways), done.stdout
