"""Builds, kills, damage, appending, replacing and verifying, in any order: what must hold after each of them.

A state machine (Hypothesis) drives one store of made-up samples. More steps, with their rate, are asked for by

    VBNFAULT_STATE_STEPS=2000 python -m pytest -n 0 -s tests/test_build_states.py
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from synthetic import Session, flip, make_spec, site_of

from vbnfault import store
from vbnfault.dataset import build
from vbnfault.store import disk

STEPS = int(os.environ.get("VBNFAULT_STATE_STEPS", "40"))
STEPS_A_RUN = 20
FIRST, BLOCK, SCENES = 10, 3, 2
_references: dict[tuple[int, int], str] = {}


class Killed(BaseException):
    """Stands for the end of the process; what cleans up behind it still runs. `tools.kills` kills in earnest."""


def spec_of(scene: int) -> store.StoreSpec:
    return make_spec(attributes={**make_spec().attributes, "seed": scene})


def make(out: Path, scene: int, samples: int, *, overwrite: bool = False) -> build.Summary:
    blocks = (FIRST, *([BLOCK] * ((samples - FIRST) // BLOCK)))
    plan = build.BuildPlan(spec=spec_of(scene), site=site_of(samples), blocks=blocks)
    return build.build(Session(), plan, out, build.BuildOptions(progress=False, overwrite=overwrite))


def reference(scene: int, samples: int) -> str:
    """The digest of a store that nothing ever disturbed."""
    if (scene, samples) not in _references:
        with tempfile.TemporaryDirectory() as folder:
            for grown in range(FIRST, samples + 1, BLOCK):
                make(Path(folder) / "s.zarr", scene, grown)
            _references[scene, samples] = store.digest(Path(folder) / "s.zarr")
    return _references[scene, samples]


class Builds(RuleBasedStateMachine):
    """`scene`, `samples`: of the store on disk; `sound`: samples finished and undamaged since."""

    began = time.monotonic()
    runs = steps = 0

    @initialize()
    def begin(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="vbnfault-states-"))
        self.out = self.folder / "s.zarr"
        self.scene, self.samples = 0, FIRST
        self.sound: set[int] = set()
        make(self.out, self.scene, self.samples)
        self.whole()

    def teardown(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        Builds.runs += 1
        if STEPS > 40 and Builds.runs % 5 == 0:
            rate = Builds.steps / (time.monotonic() - Builds.began) * 60
            print(f"{Builds.steps} steps in {Builds.runs} runs, {rate:.0f} a minute", flush=True)

    @invariant()
    def counted(self) -> None:
        Builds.steps += 1

    def whole(self) -> None:
        assert store.digest(self.out) == reference(self.scene, self.samples)
        assert store.examine(self.out).problems == []
        assert [p.name for p in self.folder.iterdir()] == ["s.zarr"]
        assert not list(self.out.rglob(f"*{disk.PARTIAL}"))
        self.sound = set(range(self.samples))

    @rule()
    def resume(self) -> None:
        summary = make(self.out, self.scene, self.samples)
        assert summary.built <= self.samples - len(self.sound)  # nothing that is sound is made again
        self.whole()

    @precondition(lambda self: self.samples < FIRST + 3 * BLOCK)
    @rule(writes=st.none() | st.integers(1, 40))
    def append(self, writes: int | None) -> None:
        self.samples += BLOCK
        self.disturbed(writes, overwrite=False)

    @rule(scene=st.integers(0, SCENES - 1), writes=st.none() | st.integers(1, 40))
    def overwrite(self, scene: int, writes: int | None) -> None:
        before = self.scene, self.samples, self.sound
        there = self.stored()  # an append that was killed early left fewer samples than were asked for
        self.scene, self.samples, self.sound = scene, FIRST, set()
        if self.disturbed(writes, overwrite=True):
            return
        # the store is the old one, untouched, or the new one; never a mixture
        if self.stored() == there != (scene, FIRST):
            self.scene, self.samples, self.sound = before
        else:
            assert self.stored() == (scene, FIRST)

    def stored(self) -> tuple[int, int]:
        """Return scene and number of samples of the store on disk."""
        opened = store.open_store(self.out)
        return opened.attributes["seed"], opened.samples

    @rule(writes=st.integers(1, 60))
    def kill(self, writes: int) -> None:
        self.disturbed(writes, overwrite=False)

    def disturbed(self, writes: int | None, *, overwrite: bool) -> bool:
        """Build, and end at the n-th rename where that comes first; whether it came to its end."""
        left, rename = [writes], os.replace

        def counted(*args: object, **kwargs: object) -> None:
            if left[0] is not None:
                left[0] -= 1
                if left[0] <= 0:
                    raise Killed
            rename(*args, **kwargs)  # type: ignore[arg-type]

        with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Killed):
            patch.setattr(os, "replace", counted)
            make(self.out, self.scene, self.samples, overwrite=overwrite)
            self.whole()
            return True
        return False

    @rule(data=st.data())
    def damage(self, data: st.DataObject) -> None:
        opened = store.open_store(self.out)
        files = sorted(p for p in self.out.rglob("c/**/*") if p.is_file() and p.stat().st_size)
        if not files:
            return
        file = files[data.draw(st.integers(0, len(files) - 1))]
        how = data.draw(st.sampled_from(["flip", "remove", "truncate"]))
        if how == "flip":
            flip(file, data.draw(st.integers(0, file.stat().st_size - 1)))
        elif how == "remove":
            file.unlink()
        else:
            os.truncate(file, file.stat().st_size // 2)
        array, _, number, *_ = file.relative_to(self.out).parts
        if array in opened.spec.pixel_layers or array in store.SCALARS or array in ("done", "crc32c"):
            self.sound -= set(opened.shard(int(number)))


def test_builds_keep_their_promises_in_any_order() -> None:
    """By default the same few runs; where more steps are asked for, other runs until there are that many."""
    few = STEPS <= 40
    how = settings(
        max_examples=max(1, STEPS // STEPS_A_RUN),
        stateful_step_count=STEPS_A_RUN,
        derandomize=few,
        suppress_health_check=list(HealthCheck),
    )
    while Builds.steps == 0 or (Builds.steps < STEPS and not few):
        run_state_machine_as_test(Builds, settings=how)
    print(f"{Builds.steps} steps in {Builds.runs} runs: 0 failures")
