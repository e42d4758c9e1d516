"""What several test files share: small scenes, and the real shape where it is at hand."""

from __future__ import annotations

import builtins
import contextlib
import errno
import functools
import gc
import io
import logging
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, settings

# A shell that starts the tests in the background makes them, and every process they start, deaf to Ctrl-C;
# with a handler here, processes that are started begin with the default again.
# A worker of a Dask cluster imports this file in a thread that sets no handlers.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # So does `nohup` for the hang-up of a terminal: handled here, it is ignored by the tests alone.
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)

# A loaded machine is slow at everything: no example fails for the seconds that it or its drawing took. What cannot
# be drawn for other reasons (too much is filtered out) still fails, and a failure prints what repeats it.
settings.register_profile(
    "vbnfault",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    print_blob=True,
)
settings.load_profile("vbnfault")
# Hypothesis would parse all modules for constants, in every process, which costs more than most test files do. It
# has no setting for that; where a version lacks these names, the lines do nothing.
if "hypothesis.internal.conjecture.providers" in sys.modules:
    vars(sys.modules["hypothesis.internal.conjecture.providers"])["is_local_module_file"] = lambda _: False

pytest.register_assert_rewrite("synthetic")

REAL_SHAPE = Path(__file__).resolve().parents[2] / "shared/data/shapes/67p_18k.obj"

# The six classes of Gallon et al., in the order of the dataset's `fault` axis.
ALL_FAULTS = (
    "dust_on_optics",
    "broken_pixels",
    "broken_lines",
    "straylight",
    "vignetting",
    "optics_degradation",
)

# Stores flush every file, and a disk is slow at that and at removing files. Temporary files of pytest are in memory
# instead, where there is eight times the room that all tests were seen to use, 0.5 GB. No test is of the disk
# itself; what is flushed, and in which order, is counted.
_MEMORY, _ROOM = Path("/dev/shm"), 4 << 30


def _has_room() -> bool:
    if not os.access(_MEMORY, os.W_OK) or shutil.disk_usage(_MEMORY).free < _ROOM:
        return False
    lines = Path("/proc/meminfo").read_text().splitlines()
    return any(line.startswith("MemAvailable") and int(line.split()[1]) << 10 > _ROOM for line in lines)


def _is_alive(process: str) -> bool:
    return not process.isdigit() or Path("/proc", process).exists()


if "PYTEST_VERSION" in os.environ and "TMPDIR" not in os.environ and _has_room():
    for left in _MEMORY.glob("vbnfault-tests-*-*"):  # by runs that were killed
        if not _is_alive(left.name.split("-")[2]):
            shutil.rmtree(left, ignore_errors=True)
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))  # the folders of tests that fail stay there
    _TEMPORARY = tempfile.TemporaryDirectory(prefix=f"vbnfault-tests-{os.getpid()}-", dir=_MEMORY)
    os.environ["TMPDIR"] = tempfile.tempdir = _TEMPORARY.name

# The processes of xdist, and those that tests start, would compile the package again and again.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    sys.dont_write_bytecode = False

# A thread of OpenMP or OpenBLAS that waits for another keeps a core busy. Where three processes share two cores, a
# training takes eight times the processor time with two threads. The libraries read this when they are loaded.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# Patches are cached for this run alone: the tests neither read nor fill the cache of the user. The processes of
# xdist, and those that tests start, share the folder of the first process.
if "VBNFAULT_TESTS_CACHE" not in os.environ:
    _CACHE = tempfile.TemporaryDirectory(prefix="vbnfault-tests-")
    os.environ["VBNFAULT_TESTS_CACHE"] = _CACHE.name
os.environ["VBNFAULT_CACHE_DIR"] = os.environ["VBNFAULT_TESTS_CACHE"]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Spare the garbage collector what is imported and collected: 700,000 objects, which live to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def spared_what_lives_on() -> None:
    """Spare the garbage collector what earlier test files left in caches."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def one_render_thread() -> None:
    """The processes of xdist share the cores: each renders with one thread, where a test asks for no more."""
    if "PYTEST_XDIST_WORKER" in os.environ and "drjit" in sys.modules:
        sys.modules["drjit"].set_thread_count(1)


@pytest.fixture(scope="session", autouse=True)
def one_command_line() -> None:
    """Make the commands of Typer once a process, not at each of some thousand calls: that takes 20 ms."""
    import typer.testing

    cached = functools.cache(typer.main.get_command)
    typer.main.get_command = typer.testing._get_command = cached


@pytest.fixture(autouse=True)
def no_unexpected_warning(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test during which the library logs a warning, but for `caplog` and the mark `expects_warnings`."""
    heard: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: heard.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("vbnfault")
    logger.addHandler(handler)
    yield
    logger.removeHandler(handler)
    if "caplog" not in request.fixturenames and not request.node.get_closest_marker("expects_warnings"):
        # a dataset of few samples lacks a class or a split
        assert not [text for text in heard if not re.match(r"split \w+ has no sample", text)]


@contextlib.contextmanager
def render_threads(count: int) -> Iterator[None]:
    """Render with as many threads in a `with` block."""
    from vbnfault import render
    from vbnfault.core.process.llvm import backend

    before = backend().dr.thread_count()
    render.set_threads(count)
    try:
        yield
    finally:
        render.set_threads(before)


@contextlib.contextmanager
def ellipsoids_of(subdivisions: int) -> Iterator[None]:
    """In a `with` block, ellipsoids of scenes have 20 * 4^subdivisions facets; 82,000 take most of a test."""
    import trimesh

    from vbnfault.world import assemble

    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assemble, "ellipsoid", lambda axes, _: (ball.vertices * axes, ball.faces.astype("int32")))
        yield


@pytest.fixture(scope="session")
def real_shape() -> Path:
    """The 67P shape model; skips where it is not at hand, since it is not part of the project."""
    if not REAL_SHAPE.is_file():
        pytest.skip(f"the real shape model is not part of the project: no file {REAL_SHAPE}")
    return REAL_SHAPE


@pytest.fixture(scope="session")
def finished_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of a finished store of 10 synthetic samples in 3 shards, which no test changes."""
    from synthetic import filled

    return filled(tmp_path_factory.mktemp("store") / "finished.zarr").path


@pytest.fixture(scope="session")
def described_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of a finished store of a real scene, with made-up pixels, which no test changes."""
    from synthetic import of_a_scene

    return of_a_scene(tmp_path_factory.mktemp("described") / "described.zarr").path


@pytest.fixture
def copied(described_store: Path, tmp_path: Path) -> Path:
    """Return a copy of the described store, to be changed."""
    return Path(shutil.copytree(described_store, tmp_path / "s.zarr"))


@pytest.fixture
def whole(finished_store: Path, tmp_path: Path) -> Any:
    """Return a copy of the finished store, to be damaged."""
    from vbnfault import store

    return store.open_store(shutil.copytree(finished_store, tmp_path / "s.zarr"), "r+")


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return the path and the digest of an undisturbed build of 18 synthetic samples in one process."""
    from synthetic import run

    out = tmp_path_factory.mktemp("build") / "undisturbed.zarr"
    digest = run(out).digest
    assert digest is not None
    return out, digest


class Called(NamedTuple):
    """What a command did: its exit code, and what it printed."""

    code: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """The one line on standard error besides warnings, notes and progress."""
        (line,) = [line for line in self.err.splitlines() if line.startswith("vbnfault: ")]
        assert "Traceback" not in self.err
        return line.removeprefix("vbnfault: ")


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Called]:
    """What runs the command line in this process."""
    from vbnfault import cli

    def run(*arguments: object) -> Called:
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", ["vbnfault", *map(str, arguments)])
        code: Any = None
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code
        return Called(int(code or 0), *capsys.readouterr())

    return run


def calls_of(action: Callable[[], Any]) -> int:
    """Return how many functions, Python's and built-in ones, an action calls: loops, without a clock."""
    calls, before = 0, sys.getprofile()

    def count(_frame: Any, event: str, _argument: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    gc.collect()
    gc.disable()  # its callbacks would count
    sys.setprofile(count)
    try:
        action()
    finally:
        sys.setprofile(before)
        gc.enable()
    return calls


def recorded_calls(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> list[tuple[Any, ...]]:
    """Record the positional arguments of each call of a function, or of a class's method, which acts as before."""
    calls: list[tuple[Any, ...]] = []
    original = getattr(owner, name)

    def recorded(*given: Any, **more: Any) -> Any:
        calls.append(given)
        return original(*given, **more)

    monkeypatch.setattr(owner, name, recorded)
    return calls


def deny(monkeypatch: pytest.MonkeyPatch, *paths: Path) -> None:
    """Have the system refuse to open, list or look below `paths`; for a user other than root, `chmod` would do."""

    def refusing(real: Callable[..., Any], *, below: bool = False) -> Callable[..., Any]:
        def call(path: Any = ".", *args: Any, **kwargs: Any) -> Any:
            if isinstance(path, str | bytes | os.PathLike):
                absolute = Path(os.path.abspath(os.fsdecode(path)))
                if any(p in absolute.parents or (p == absolute and not below) for p in paths):
                    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return real(path, *args, **kwargs)

        return call

    for module, name in ((os, "open"), (os, "listdir"), (os, "scandir"), (io, "open"), (builtins, "open")):
        monkeypatch.setattr(module, name, refusing(getattr(module, name)))
    for name in ("stat", "lstat"):  # what lies in a folder cannot be looked at, the folder itself can
        monkeypatch.setattr(os, name, refusing(getattr(os, name), below=True))


def needs_llvm() -> None:
    """Skip a test, or a file whose first lines call this, where no LLVM can be used."""
    from vbnfault.core.errors import VbnfaultError
    from vbnfault.core.process import llvm

    try:
        llvm.find()
    except VbnfaultError as error:
        pytest.skip(f"no usable LLVM: {error}", allow_module_level=True)


def small_scene(**tables: dict[str, Any]) -> dict[str, Any]:
    """A scene of small images over coarse terrain, as plain data; `tables` are merged into it."""
    scene: dict[str, Any] = {
        "title": "small",
        "dataset": {"samples": 16, "seed": 11, "sites": 4, "shard_samples": 4},
        "patch": {"facet_m": 12.0, "radius_m": 60.0, "min_boulder_m": 6.0},
        "camera": {"width_px": 96, "height_px": 80, "fov_deg": 65.0},
        "render": {"samples_per_pixel": 4},
        "plan": {"faulty_fraction": 0.75},
        "faults": {name: {} for name in ALL_FAULTS},
    }
    for name, table in tables.items():
        scene[name] = {**scene.get(name, {}), **table}
    return scene


def verified_store(scene: Any, out: Path, **options: Any) -> Any:
    """Build the store of a scene, which may be plain data, verify it, and return it open."""
    from vbnfault import dataset, store
    from vbnfault.scene.config import parse_scene

    parsed = parse_scene(scene, source="test") if isinstance(scene, dict) else scene
    dataset.build_scene(parsed, out, source="test", progress=False, **options)
    assert dataset.verify(out).problems == []
    return store.open_store(out)


@pytest.fixture(scope="session")
def s3_server() -> Iterator[Any]:
    """A server of S3 on this machine, started once."""
    pytest.importorskip("obstore")
    from s3_server import S3Server

    server = S3Server()
    yield server
    server.close()
