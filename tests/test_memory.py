"""Memory of a sample: the arrays that its stages keep, and what is left of it afterwards."""

from __future__ import annotations

import gc
import os
import platform
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from conftest import small_scene

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.pipeline import Session
from vbnfault.pipeline import session as pipeline_session
from vbnfault.pipeline.development import acting_at, without
from vbnfault.pipeline.injection import inject_faults
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.stages import simulate_frame
from vbnfault.scene import config

SIZE = 64


@pytest.fixture(scope="module")
def session() -> Session:
    """A camera with a real lens and a mosaic, and a sample with one model of every optical class."""
    scene = small_scene(
        dataset={"layers": ["clean", "without_straylight", "mask_effect", "raw"]},
        camera={
            "width_px": SIZE,
            "height_px": SIZE,
            "lens": "nikkor_28_f2p8_camera",
            "detector": "cmv4000",
            "exposure_max_s": 0.015,
        },
        geometry={"sun_visibility": "required"},
    )
    scene["faults"] = {
        "straylight": {"model": "paraxial"},
        "dust_on_optics": {"model": "defocused"},
        "optics_degradation": {"model": "contamination"},
        "vignetting": {"model": "lens"},
    }
    return Session(config.parse_scene(scene, source="test"))


def test_twins_leave_no_light_behind(session: Session) -> None:
    """Kept is the light of the clean image, of the image with all faults and of the stored twin, and no other."""
    index = next(i for i in range(len(session.plan)) if len(session.plan.commanded(i)) == 4)
    frame = session.frame(index)
    injection = inject_faults(frame.spec, frame.pose, frame.rendering, frame.exposure)
    draws, development = injection.draws, injection.development
    optical = acting_at(draws, "electrons")
    assert len(optical) == 4
    kept = development._signals
    assert len(kept) == 3
    # planes of the scene's light and of the light past the rims, in three colours
    planes = [p for q in kept.values() for p in (q.array, q.past_rims) if p is not None]
    assert sum(p.nbytes for p in planes) <= len(kept) * 2 * 3 * 4 * SIZE**2
    # what was not kept is computed again, with the same bits
    for name in optical:
        again = development.signal(without(draws, name), [n for n in optical if n != name])
        once_more = development.signal(without(draws, name), [n for n in optical if n != name], keep=False)
        np.testing.assert_array_equal(again.merged.array, once_more.merged.array)
    # all light in one array is added when it is needed
    assert all("merged" not in vars(q) for q in kept.values())


def test_samples_leave_nothing_behind(session: Session) -> None:
    """Once caches are full, rounds of three samples add less than a plane to what the program and numpy hold.

    What threads of other tests and libraries hold for a time is left out: a leak adds in every round, they in one.
    """
    held = []
    own = [tracemalloc.Filter(True, str(Path(module.__file__).parent / "*")) for module in (vbnfault, np)]
    tracemalloc.start()
    try:
        for _ in range(4):
            for index in range(3):
                to_sample(simulate_frame(session.spec(index)))
            gc.collect()
            taken = tracemalloc.take_snapshot().filter_traces(own)
            held.append(sum(trace.size for trace in taken.traces))
    finally:
        tracemalloc.stop()
    assert min(held) > 0
    assert min(np.diff(held[1:])) < 4 * SIZE**2


ARENAS = """
import ctypes, sys, threading
from vbnfault.core.process import environment
if sys.argv[1] == "shared":
    environment.share_arenas()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
all_run = threading.Barrier(8)

def allocate():
    libc.malloc(1000)
    all_run.wait()

threads = [threading.Thread(target=allocate) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the GNU C library")
def test_threads_share_two_arenas() -> None:
    """Eight threads at once would otherwise have one each; a number that the user sets is kept."""

    def arenas(how: str, **variables: str) -> int:
        environment = {k: v for k, v in os.environ.items() if k != "MALLOC_ARENA_MAX"} | variables
        command = [sys.executable, "-c", ARENAS, how]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.count("<heap nr=")

    assert arenas("shared") == 2
    assert arenas("not shared") > 2
    assert arenas("shared", MALLOC_ARENA_MAX="3") == 3


def test_a_session_shares_arenas_before_anything_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """Later, the threads of its terrain would each have one."""
    done: list[str] = []
    monkeypatch.setattr(pipeline_session, "share_arenas", lambda: done.append("arenas"))

    def as_trajectory(_: object) -> None:
        done.append("trajectory")
        raise InputError("no poses")

    monkeypatch.setattr(pipeline_session, "as_trajectory", as_trajectory)
    with pytest.raises(InputError, match="no poses"):
        Session(config.parse_scene(small_scene(), source="test"), poses=())
    assert done == ["arenas", "trajectory"]
