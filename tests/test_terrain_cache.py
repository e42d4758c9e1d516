"""Arrays and patches on disk: the same bits, whole files only, bounded, and never in the way."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import platformdirs
import pytest
import trimesh

from vbnfault.body import Body, PatchSpec, Site, choose_sites
from vbnfault.body import patch as patch_module
from vbnfault.body.patch import arrays_of, build_patch, cached_patch, patch_key
from vbnfault.core.errors import InputError
from vbnfault.core.files import array_files
from vbnfault.core.files.array_files import ArrayFiles, Arrays, cache_folder
from vbnfault.core.process import activity

COARSE = {"seed": 3, "facet_m": 20.0, "radius_m": 60.0, "min_boulder_m": 8.0, "max_triangles": 60_000}
FILES = ArrayFiles(kind="patch", content="terrain")


@pytest.fixture(scope="module")
def body() -> Body:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=900.0)
    return Body(name="ball", vertices_m=np.array(ball.vertices), faces=np.array(ball.faces))


@pytest.fixture(scope="module")
def site(body: Body) -> Site:
    return choose_sites(body, 1, seed=0)[0]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(array_files.FOLDER_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.delenv(array_files.SIZE_VARIABLE, raising=False)
    return tmp_path / "cache"


def made(number: int = 0) -> Arrays:
    """Return arrays of several types, and a number."""
    return {"x": np.arange(500.0) + number, "faces": np.arange(60, dtype=np.int32).reshape(-1, 3), "facet_m": 0.5}


def kept(number: int = 0, compute: Callable[[], Arrays] | None = None) -> Arrays:
    """Return the arrays of a number from disk, or computed."""
    return FILES.kept(f"key{number}", compute or (lambda: made(number)))


def same(a: Arrays, b: Arrays) -> bool:
    return a.keys() == b.keys() and all(
        np.asarray(a[name]).dtype == np.asarray(b[name]).dtype and np.array_equal(a[name], b[name]) for name in a
    )


class Built(Exception):
    """Raised in place of computing arrays."""


def instead(*_: object) -> Arrays:
    raise Built


def test_a_patch_is_read_as_it_was_built(
    body: Body, site: Site, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    with activity.reported_to(told.append):
        built = cached_patch(body, site, PatchSpec(**COARSE))
    assert told == ["terrain of site 0 (new patch)"]
    assert same(arrays_of(built), arrays_of(build_patch(body, site, PatchSpec(**COARSE))))
    assert [path.suffix for path in folder.iterdir()] == [".patch"]
    monkeypatch.setattr(patch_module, "build_patch", instead)
    with activity.reported_to(told.append):
        read = cached_patch(body, site, PatchSpec(**COARSE))
    assert len(told) == 1
    assert same(arrays_of(read), arrays_of(built))
    assert read.site is site


def test_key_tells_apart_what_builds_differently(body: Body, site: Site) -> None:
    other_site = choose_sites(body, 2, seed=0)[1]
    other_body = Body(name="ball", vertices_m=body.vertices_m * 1.01, faces=body.faces)
    heavier = Body(name="ball", vertices_m=body.vertices_m, faces=body.faces, density_kg_m3=900.0)
    keys = [
        patch_key(body, site, PatchSpec(**COARSE)),
        patch_key(body, site, PatchSpec(**{**COARSE, "seed": 4})),
        patch_key(body, site, PatchSpec(**{**COARSE, "facet_m": 21.0})),
        patch_key(body, site, PatchSpec(**COARSE, relief=0.9)),
        patch_key(body, site, PatchSpec(**COARSE, boulder_index=3.0)),
        patch_key(body, other_site, PatchSpec(**COARSE)),
        patch_key(other_body, site, PatchSpec(**COARSE)),
        patch_key(heavier, site, PatchSpec(**COARSE)),
    ]
    assert len(set(keys)) == len(keys)
    # the name is not content
    assert (
        patch_key(Body(name="b", vertices_m=body.vertices_m, faces=body.faces), site, PatchSpec(**COARSE))
        == keys[0]
    )


def test_any_damage_means_that_arrays_are_computed_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept()
    (path,) = folder.iterdir()
    good = path.read_bytes()
    kept(1)
    other_file = next(p for p in folder.iterdir() if p != path)
    assert same(kept(0, instead), made())

    def is_damaged() -> bool:
        """Whether the arrays would be computed again; then the user has been told."""
        try:
            kept(0, instead)
        except Built:
            told = capsys.readouterr().err
            return told.startswith(f"note: {path}: the terrain kept there is damaged (") and told.count("\n") == 1
        return False

    # every bit of the header and of the checksum, and some of each array
    rng = np.random.default_rng(1)
    for place in (*range(0, 900, 3), *rng.integers(0, len(good), 300), *range(len(good) - 40, len(good))):
        data = bytearray(good)
        data[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        assert is_damaged(), place
    of_another_key = other_file.read_bytes()
    for data in (b"", good[:-1], good[: len(good) // 2], good + b"x", b"no", bytes(len(good)), of_another_key):
        path.write_bytes(data)
        assert is_damaged()
    for make in (path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to(folder)):
        path.unlink() if path.is_file() else None
        make()
        assert same(kept(), made())
        assert "is damaged" in capsys.readouterr().err
        assert path.read_bytes() == good  # and written again
        assert not path.is_symlink()


def test_a_file_that_cannot_be_read_is_computed_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept()

    def refuse_to_read(*_: object) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse_to_read)
    assert same(kept(), made())
    assert "is damaged (Permission denied)" in capsys.readouterr().err


def test_unwritable_folder_costs_nothing_but_time_and_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv(array_files.FOLDER_VARIABLE, str(blocked / "below"))
    told = f"warning: {blocked / 'below'}: terrain cannot be kept there (Not a directory), so every run builds it"
    for said in (told, ""):
        assert same(kept(), made())
        assert capsys.readouterr().err.startswith(said) if said else not capsys.readouterr().err

    def full(*_: object, **__: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setenv(array_files.FOLDER_VARIABLE, str(tmp_path / "full"))
    monkeypatch.setattr(np, "savez", full)
    assert same(kept(), made())
    assert list((tmp_path / "full").iterdir()) == []
    assert "full: terrain cannot be kept there (No space left on device)" in capsys.readouterr().err


def test_used_longest_ago_goes_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept()
    (path,) = folder.iterdir()
    monkeypatch.setenv(array_files.SIZE_VARIABLE, str(2.5 * path.stat().st_size / 2**30))
    os.utime(path, (1000, 1000))
    kept(1)
    os.utime(next(p for p in folder.iterdir() if p != path), (2000, 2000))
    kept()  # read: now used last
    kept(2)
    assert {p.name for p in folder.iterdir()} == {"patch-key0.patch", "patch-key2.patch"}


def test_unfinished_files_of_the_dead_are_removed(folder: Path) -> None:
    folder.mkdir()
    old, young = folder / "patch-a.part", folder / "patch-b.part"
    for path in (old, young):
        path.write_bytes(b"x")
    os.utime(old, (1000, 1000))
    kept()
    assert not old.exists()
    assert young.exists()


def test_size_of_zero_keeps_nothing_and_nonsense_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(array_files.SIZE_VARIABLE, "0")
    kept()
    assert not folder.exists()
    for text in ("-1", "many", "nan"):
        monkeypatch.setenv(array_files.SIZE_VARIABLE, text)
        with pytest.raises(InputError, match=array_files.SIZE_VARIABLE):
            kept()


def test_two_at_once_write_one_whole_file(folder: Path) -> None:
    path = folder / "patch-race.patch"
    content = path, "race", made(), 2**30
    writers = [threading.Thread(target=FILES.write, args=content) for _ in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert same(FILES.read(path, "race"), made())
    assert [p.name for p in folder.iterdir()] == [path.name]


def test_the_folder_is_in_the_users_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(array_files.FOLDER_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() in (tmp_path / "vbnfault", platformdirs.user_cache_path("vbnfault", appauthor=False))
