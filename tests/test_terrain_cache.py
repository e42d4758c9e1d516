"""Patches on disk: the same bits, whole files only, bounded, and never in the way."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import numpy as np
import pytest
import trimesh

from vbnfault.body import Body, Patch, Site, cache, choose_sites
from vbnfault.body.cache import cache_folder, cached_patch, patch_key
from vbnfault.body.patch import build_patch
from vbnfault.errors import InputError

COARSE = {"seed": 3, "facet_m": 20.0, "radius_m": 60.0, "min_boulder_m": 8.0, "max_triangles": 60_000}


@pytest.fixture(scope="module")
def body() -> Body:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=900.0)
    return Body(name="ball", vertices_m=np.array(ball.vertices), faces=np.array(ball.faces))


@pytest.fixture(scope="module")
def site(body: Body) -> Site:
    return choose_sites(body, 1, seed=0)[0]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(cache.FOLDER_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.delenv(cache.SIZE_VARIABLE, raising=False)
    return tmp_path / "cache"


def same(a: Patch, b: Patch) -> bool:
    return all(
        np.asarray(x).dtype == np.asarray(y).dtype and np.array_equal(x, y)
        for x, y in ((getattr(a, name), getattr(b, name)) for name in cache._ARRAYS)
    )


def refuse(*args: object, **kwargs: object) -> Patch:
    raise AssertionError("built again")


def test_read_is_what_was_built(body: Body, site: Site, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built = cached_patch(body, site, **COARSE)
    assert same(built, build_patch(body, site, **COARSE))
    assert [path.suffix for path in folder.iterdir()] == [".npz"]
    monkeypatch.setattr(cache, "build_patch", _same_signature(refuse))
    read = cached_patch(body, site, **COARSE)
    assert same(read, built)
    assert read.site is site


def _same_signature(function: object) -> object:
    function.__wrapped__ = build_patch  # type: ignore[attr-defined]  # what inspect.signature looks at
    return function


def test_key_tells_apart_what_builds_differently(body: Body, site: Site) -> None:
    other_site = choose_sites(body, 2, seed=0)[1]
    other_body = Body(name="ball", vertices_m=body.vertices_m * 1.01, faces=body.faces)
    heavier = Body(name="ball", vertices_m=body.vertices_m, faces=body.faces, density_kg_m3=900.0)
    keys = [
        patch_key(body, site, **COARSE),
        patch_key(body, site, **{**COARSE, "seed": 4}),
        patch_key(body, site, **{**COARSE, "facet_m": 21.0}),
        patch_key(body, site, **COARSE, relief=0.9),
        patch_key(body, site, **COARSE, boulder_index=3.0),
        patch_key(body, other_site, **COARSE),
        patch_key(other_body, site, **COARSE),
        patch_key(heavier, site, **COARSE),
    ]
    assert len(set(keys)) == len(keys)
    # the name is not content, and a default is what is meant by leaving it out
    assert patch_key(Body(name="b", vertices_m=body.vertices_m, faces=body.faces), site, **COARSE) == keys[0]
    assert patch_key(body, site, **COARSE, relief=1) == keys[0]


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text"])
def test_damaged_file_is_built_again(body: Body, site: Site, folder: Path, damage: str) -> None:
    built = cached_patch(body, site, **COARSE)
    (path,) = folder.iterdir()
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[len(data) // 2] ^= 1
    path.write_bytes({"cut": data[: len(data) // 2], "flip": data, "empty": b"", "text": b"no zip"}[damage])
    assert same(cached_patch(body, site, **COARSE), built)
    assert path.stat().st_size == len(data)  # and written again
    assert cache._read(path, site) is not None


def test_unwritable_folder_costs_nothing_but_time(
    body: Body, site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv(cache.FOLDER_VARIABLE, str(blocked / "below"))
    patch = cached_patch(body, site, **COARSE)  # -W error: no warning either

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setenv(cache.FOLDER_VARIABLE, str(tmp_path / "full"))
    monkeypatch.setattr(np, "savez", full)
    assert same(cached_patch(body, site, **COARSE), patch)
    assert list((tmp_path / "full").iterdir()) == []


def test_used_longest_ago_goes_first(body: Body, site: Site, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = cached_patch(body, site, **COARSE)
    (path,) = folder.iterdir()
    size = path.stat().st_size
    monkeypatch.setenv(cache.SIZE_VARIABLE, str(2.5 * size / 2**30))
    os.utime(path, (1000, 1000))
    cached_patch(body, site, **{**COARSE, "seed": 4})
    os.utime(next(p for p in folder.iterdir() if p != path), (2000, 2000))
    cached_patch(body, site, **COARSE)  # read: now used last
    cached_patch(body, site, **{**COARSE, "seed": 5})
    left = {p.name for p in folder.iterdir()}
    assert left == {f"patch-{patch_key(body, site, **{**COARSE, 'seed': k})}.npz" for k in (3, 5)}
    assert same(cached_patch(body, site, **COARSE), first)


def test_unfinished_files_of_the_dead_are_removed(body: Body, site: Site, folder: Path) -> None:
    folder.mkdir()
    old, young = folder / "patch-a.part", folder / "patch-b.part"
    for path in (old, young):
        path.write_bytes(b"x")
    os.utime(old, (1000, 1000))
    cached_patch(body, site, **COARSE)
    assert not old.exists()
    assert young.exists()


def test_size_of_zero_keeps_nothing_and_nonsense_is_refused(
    body: Body, site: Site, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(cache.SIZE_VARIABLE, "0")
    cached_patch(body, site, **COARSE)
    assert not folder.exists()
    for text in ("-1", "many", "nan"):
        monkeypatch.setenv(cache.SIZE_VARIABLE, text)
        with pytest.raises(InputError, match=cache.SIZE_VARIABLE):
            cached_patch(body, site, **COARSE)


def test_two_at_once_write_one_whole_file(body: Body, site: Site, folder: Path) -> None:
    patch = build_patch(body, site, **COARSE)
    path = folder / "patch-race.npz"
    writers = [threading.Thread(target=cache._write, args=(path, patch, 2**30)) for _ in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    read = cache._read(path, site)
    assert read is not None
    assert same(read, patch)
    assert [p.name for p in folder.iterdir()] == [path.name]


def test_folder_follows_the_platform(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(cache.FOLDER_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache.sys, "platform", "linux")
    assert cache_folder() == tmp_path / "vbnfault"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "vbnfault"
    monkeypatch.setattr(cache.sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    assert cache_folder() == tmp_path / "vbnfault" / "cache"
