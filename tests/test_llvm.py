"""Finding libLLVM: order, refusals by name and by symbol, a sentence and never an abort."""

from __future__ import annotations

import ast
import ctypes
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy._core._multiarray_umath as some_library
import pytest

from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.process import llvm

NOT_LLVM = Path(some_library.__file__)  # a shared library of every system these tests run on


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(llvm.VARIABLE, "")  # so that it is put back, or taken away, afterwards
    monkeypatch.delenv(llvm.VARIABLE)
    llvm.prepare.cache_clear()
    yield
    llvm.prepare.cache_clear()


class FakeLibrary:
    """Stands for a loaded libLLVM that reports a version."""

    def __init__(self, *version: int) -> None:
        self.version = version

    def LLVMGetVersion(self, *parts: object) -> None:
        for part, value in zip(parts, self.version, strict=True):
            part._obj.value = value  # type: ignore[attr-defined]


Looked = Callable[..., list[tuple[str, Path]]]


@pytest.fixture
def fake_libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Looked:
    """Make files `name=version` the only libraries there are, without loading anything."""

    def install(**versions: tuple[int, int, int]) -> list[tuple[str, Path]]:
        found = []
        for name, version in versions.items():
            path = tmp_path / f"{name}.so"
            path.write_bytes(repr(version).encode())
            found.append((name, path))
        monkeypatch.setattr(llvm, "_paths", lambda: iter(found))
        return found

    def load(path: Path, origin: str) -> FakeLibrary:
        return FakeLibrary(*ast.literal_eval(path.read_text()))

    monkeypatch.setattr(llvm, "_load", load)
    return install


def forbid_loading(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(path: Path, origin: str) -> None:
        raise AssertionError(f"{path} was loaded")

    monkeypatch.setattr(llvm, "_load", load)


# -------------------------------------------------------------------------------------------- order of search


def test_the_variable_comes_first_then_the_wheel_then_the_system_newest_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = tmp_path / "system"
    for version in ("16", "9", "18", "17.0.6"):
        folder = system / f"llvm-{version}" / "lib"
        folder.mkdir(parents=True)
        (folder / f"libLLVM-{version}.so").write_bytes(b"")
    wheel = tmp_path / "libLLVM.so.23.1"
    wheel.write_bytes(b"")
    monkeypatch.setenv(llvm.VARIABLE, str(tmp_path / "own.so"))
    monkeypatch.setattr(llvm, "_wheel_files", lambda stem: [wheel] if stem == "libLLVM.so" else [])
    monkeypatch.setattr(
        llvm,
        "_SYSTEM_PATTERNS",
        {sys.platform: ((str(system), "llvm-*/lib/libLLVM*.so*"), (str(system), "absent*"))},
    )
    found = list(llvm._paths())
    assert found[0] == (llvm.VARIABLE, tmp_path / "own.so")
    assert found[1] == ("karellen-llvm-core", wheel)
    assert [path.name for _, path in found[2:]] == [f"libLLVM-{v}.so" for v in ("18", "17.0.6", "16", "9")]
    assert {origin for origin, _ in found[2:]} == {"system"}


def test_candidates_keep_the_order_and_name_each_library_once(fake_libraries: Looked, tmp_path: Path) -> None:
    found = fake_libraries(a=(18, 1, 0), b=(17, 0, 6), c=(15, 0, 7))
    link = tmp_path / "link.so"
    link.symlink_to(found[0][1])
    found.append(("again", link))
    found.append(("gone", tmp_path / "gone.so"))
    got = list(llvm.candidates())
    assert [(c.origin, c.version, c.usable) for c in got] == [
        ("a", (18, 1, 0), True),
        ("b", (17, 0, 6), True),
        ("c", (15, 0, 7), False),
        ("gone", None, False),
    ]
    assert llvm.find() == got[0]


@pytest.mark.parametrize(("version", "usable"), [((14, 0, 6), False), ((15, 0, 7), False), ((16, 0, 0), True)])
def test_the_oldest_usable_version_is_16(
    version: tuple[int, int, int], usable: bool, fake_libraries: Looked
) -> None:
    fake_libraries(some=version)
    (candidate,) = llvm.candidates()
    assert candidate.version == version
    assert candidate.usable is usable
    assert usable or str(version[0]) in candidate.problem


def test_the_first_usable_one_is_taken_whatever_comes_before(fake_libraries: Looked) -> None:
    fake_libraries(a=(14, 0, 0), b=(19, 1, 7), c=(23, 1, 0))
    assert llvm.find().origin == "b"


def test_prepare_points_drjit_to_it(fake_libraries: Looked) -> None:
    found = fake_libraries(a=(15, 0, 0), b=(19, 1, 7))
    assert llvm.prepare().path == found[1][1]
    assert os.environ[llvm.VARIABLE] == str(found[1][1])


# ------------------------------------------------------------------------------------------ the real variable


def real_candidate() -> llvm.Candidate:
    try:
        return llvm.find()
    except VbnfaultError as error:
        pytest.skip(f"this machine has no usable LLVM: {error}")


def test_the_installed_library_is_usable_and_says_its_version() -> None:
    candidate = real_candidate()
    assert candidate.path.is_file()
    assert candidate.version is not None
    assert candidate.version[0] >= 16


def test_the_variable_wins_if_usable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = real_candidate()
    own = tmp_path / "mine.so"
    own.symlink_to(real.path.resolve())
    monkeypatch.setenv(llvm.VARIABLE, str(own))
    chosen = llvm.find()
    assert (chosen.path, chosen.origin, chosen.version) == (own, llvm.VARIABLE, real.version)
    # and the wheel's or the system's name of the same file is not looked at again
    assert [c.path.resolve() for c in llvm.candidates()].count(real.path.resolve()) == 1


@pytest.mark.parametrize("kind", ["text", "empty", "missing", "folder", "no_llvm", "version_14"])
def test_an_unusable_variable_is_passed_over_with_a_reason(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, reason = {
        "text": (tmp_path / "libLLVM.so.18.1", "does not load"),
        "empty": (tmp_path / "libLLVM.so", "does not load"),
        "missing": (tmp_path / "absent.so", "no such file"),
        "folder": (tmp_path, "no such file"),
        "no_llvm": (NOT_LLVM, "LLVMGetVersion"),
        "version_14": (tmp_path / "libLLVM-14.so.1", "14"),
    }[kind]
    if not path.exists() and kind != "missing":
        path.write_bytes(b"" if kind == "empty" else b"no library at all")
    monkeypatch.setenv(llvm.VARIABLE, str(path))
    first = next(iter(llvm.candidates()))
    assert (first.path, first.origin, first.usable) == (path, llvm.VARIABLE, False)
    assert reason in first.problem
    assert "\n" not in first.problem
    assert real_candidate().origin != llvm.VARIABLE


def test_a_library_without_the_symbol_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not hasattr(ctypes.CDLL(str(NOT_LLVM)), "LLVMGetVersion")
    monkeypatch.setenv(llvm.VARIABLE, str(NOT_LLVM))
    candidate = next(iter(llvm.candidates()))
    assert candidate.version is None
    assert "16" in candidate.problem


@pytest.mark.parametrize(
    ("name", "major"),
    [
        ("libLLVM-14.so.1", 14),
        ("libLLVM-14.so", 14),
        ("libLLVM-15.so.1", 15),
        ("libLLVM-15.0.7.so", 15),
        ("libLLVM.so.15.0", 15),
        ("libLLVM-9.so", 9),
    ],
)
def test_old_versions_are_refused_by_name_without_loading(
    name: str, major: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forbid_loading(monkeypatch)
    (tmp_path / name).write_bytes(b"")
    plain = tmp_path / "libLLVM.so"  # as Debian links it: the name of what it leads to counts
    plain.symlink_to(name)
    for path in (tmp_path / name, plain):
        monkeypatch.setattr(llvm, "_paths", lambda path=path: iter([("system", path)]))
        (candidate,) = llvm.candidates()
        assert candidate.version == (major, 0, 0)
        assert not candidate.usable
        assert f"version {major}" in candidate.problem


@pytest.mark.parametrize("name", ["libLLVM-16.so", "libLLVM.so.18.1", "libLLVM-19.so.1", "libLLVM.so", "other.so"])
def test_newer_and_unversioned_names_are_loaded_to_ask(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forbid_loading(monkeypatch)
    (tmp_path / name).write_bytes(b"")
    monkeypatch.setattr(llvm, "_paths", lambda: iter([("system", tmp_path / name)]))
    with pytest.raises(AssertionError, match="was loaded"):
        list(llvm.candidates())


# --------------------------------------------------------------------------------------------- nothing usable


def test_nothing_found_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "_paths", lambda: iter(()))
    for ask in (llvm.find, llvm.prepare):
        with pytest.raises(VbnfaultError) as caught:
            ask()
        assert not isinstance(caught.value, InputError)  # a failed run, exit code 1
        assert caught.value.exit_code == 1
        sentence = str(caught.value)
        assert "\n" not in sentence
        for part in ("libLLVM 16", "none found", "pip install karellen-llvm-core", llvm.VARIABLE):
            assert part in sentence
        assert str(pickle.loads(pickle.dumps(caught.value))) == sentence
    assert llvm.VARIABLE not in os.environ


def test_nothing_usable_says_what_was_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old, text = tmp_path / "libLLVM-15.so.1", tmp_path / "libLLVM.so"
    old.write_bytes(b"")
    text.write_text("no library")
    looked = [("system", old), ("system", text), (llvm.VARIABLE, tmp_path / "absent.so")]
    monkeypatch.setattr(llvm, "_paths", lambda: iter(looked))
    with pytest.raises(VbnfaultError) as caught:
        llvm.find()
    sentence = str(caught.value)
    assert "\n" not in sentence
    for _, path in looked:
        assert str(path) in sentence
    for reason in ("version 15", "does not load", "no such file"):
        assert reason in sentence


# ------------------------------------------------------------------------------------------------ never abort


@pytest.mark.parametrize("kind", ["garbage", "elf_header"])
def test_a_damaged_library_never_ends_the_process(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "libLLVM.so.99"
    data = {
        "garbage": lambda: bytes(range(256)) * 64,
        "elf_header": lambda: b"\x7fELF\x02\x01\x01" + bytes(4096),
    }[kind]()
    path.write_bytes(data)
    script = (
        "from vbnfault.core.process import llvm; c = next(llvm.candidates()); assert not c.usable; print(c.problem)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        env={**os.environ, llvm.VARIABLE: str(path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "does not load" in done.stdout


def test_looking_does_not_load_mitsuba() -> None:
    script = (
        "import sys; from vbnfault.core.process import llvm; list(llvm.candidates());"
        "assert not {'mitsuba', 'drjit'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)


AT_THE_END_OF_MEMORY = """
import ctypes, mmap, sys
import numpy as np
from vbnfault.core.process.llvm import backend, flat
from vbnfault.body.fields import Points

def at_the_end(values):
    # the last byte is the last before a page that may not be read
    size, pages = values.nbytes, -(-values.nbytes // mmap.PAGESIZE)
    block = mmap.mmap(-1, (pages + 1) * mmap.PAGESIZE)
    base = ctypes.addressof(ctypes.c_char.from_buffer(block))
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(base + pages * mmap.PAGESIZE), mmap.PAGESIZE, 0) == 0
    placed = np.frombuffer(block, np.uint8)[pages * mmap.PAGESIZE - size : pages * mmap.PAGESIZE].view(values.dtype)
    placed[:] = values
    return placed

be = backend()
for kind, dtype in (("Float", np.float32), ("Float64", np.float64), ("UInt32", np.uint32), ("UInt8", np.uint8)):
    for size in (4001, 4008, 4016, 4088):
        values = np.arange(size).astype(dtype)
        doubled = getattr(be, kind)(flat(at_the_end(values))) * 2
        be.dr.eval(doubled)
        be.dr.sync_thread()
        assert np.array_equal(doubled.numpy(), values * 2), (kind, size)
places = at_the_end(np.arange(3.0 * 4008)).reshape(-1, 3)
assert len(Points(places).gradient(7.0, 1, 4008)) == 4008
"""


def test_kernels_read_nothing_past_the_memory_of_an_array() -> None:
    """They read whole vectors of 16 numbers, and an unreadable page behind an array would end the process."""
    done = subprocess.run([sys.executable, "-c", AT_THE_END_OF_MEMORY], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
