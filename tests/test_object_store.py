"""Stores in an object store: built, resumed, locked, read by ranges and described, against a server of S3."""

from __future__ import annotations

import itertools
import json
import platform
import sys
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from s3_server import BUCKET, S3Server, in_environment
from synthetic import fake_sample, make_spec, run
from test_shard_range import Guest
from typer.testing import CliRunner

from vbnfault import cli
from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.dataset import claims
from vbnfault.dataset.merge import join_stores
from vbnfault.store import bucket

SAMPLES = 8
_numbers = itertools.count()


@pytest.fixture(autouse=True)
def server(s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """The server, which this process finds; requests are repeated twice, at once."""
    backoff = {"init_backoff": timedelta(milliseconds=1), "max_backoff": timedelta(milliseconds=9), "base": 2.0}
    retries = {"max_retries": 2, "retry_timeout": timedelta(seconds=60), "backoff": backoff}
    monkeypatch.setattr(bucket, "RETRIES", retries)
    with in_environment(s3_server):
        yield s3_server


@pytest.fixture
def url() -> str:
    """The URL of a new store."""
    return f"s3://{BUCKET}/folder/{next(_numbers)}.zarr"


@pytest.fixture(scope="module")
def digest(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The digest of the store on disk."""
    return str(run(tmp_path_factory.mktemp("disk") / "s.zarr", samples=SAMPLES).digest)


@pytest.fixture(scope="module")
def built(s3_server: S3Server) -> str:
    """A finished store that no test changes."""
    with in_environment(s3_server):
        run(f"s3://{BUCKET}/built.zarr", samples=SAMPLES)
    return f"s3://{BUCKET}/built.zarr"


def left_behind(url: str) -> list[str]:
    return [n for n in st.files_of(st.located(url))._all_names() if n.startswith(".vbnfault")]  # type: ignore[attr-defined]


def puts(url: str, what: str) -> Callable[[str, str], bool]:
    """Chooses the writes of objects whose name contains `what`."""
    folder = url.removeprefix("s3:/")
    return lambda method, path: method == "PUT" and path.startswith(folder) and what in path


# --- build, resume, verify --------------------------------------------------------------------------------


def test_a_build_in_a_bucket_has_the_digest_of_one_on_disk(built: str, digest: str) -> None:
    assert st.digest(built) == digest
    assert st.examine(built).problems == []
    again = run(built, samples=SAMPLES)
    assert (again.built, again.finished, again.digest) == (0, SAMPLES, digest)
    assert " free" not in again.outlook()[0]
    assert left_behind(built) == []
    assert st.open_store(built).path.name == "built.zarr"
    with pytest.raises(InputError, match="exists already"):
        st.create(built, make_spec(), SAMPLES)


def test_ranges_are_written_at_once_and_damage_is_repaired(url: str, digest: str) -> None:
    def others() -> None:
        with pytest.raises(VbnfaultError, match=r"another command is writing shards 0:1 of it \(process .*claims/"):
            run(url, samples=SAMPLES)
        run(url, samples=SAMPLES, shard_range=range(1, 2))

    run(url, Guest(others), samples=SAMPLES, shard_range=range(1))
    assert left_behind(url) == []
    store = st.open_store(url)
    name = store.file_name("image", 1)
    data = bytearray(store.files.read(name, 1 << 30))
    data[50] ^= 1
    store.files.write([(name, bytes(data))])
    store.files.remove([store.file_name("mask", 0)])
    assert [p.samples for p in st.examine_shard(store, 1).problems] == [(4,)]
    assert "the shard file mask/c/0/0/0/0 is missing" in st.examine_shard(store, 0).problems[0].sentence
    again = run(url, samples=SAMPLES)
    assert (again.built, again.digest) == (5, digest)


def test_claims_of_killed_commands_are_removed(url: str, server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    files = st.files_of(st.located(url))

    def write(kind: str, **owner: Any) -> str:
        name = f".vbnfault/claims/{kind}.{'0' * 32}.json"
        files.write([(name, json.dumps(owner).encode())])
        return name

    write("whole", host=platform.node(), pid=1, started=1.0)
    with claims.claimed(st.Url(url), None):
        pass
    held = write("shards-0-2", host="elsewhere", pid=1, started=1.0)
    with (
        pytest.raises(VbnfaultError, match=r"writing shards 0:2 of it \(process 1 on elsewhere\)"),
        claims.claimed(st.Url(url), range(1, 4)),
    ):
        pass
    with claims.claimed(st.Url(url), range(2, 4)):
        assert files.exists(held)
    monkeypatch.setattr(claims, "_SECONDS_OF_A_CLAIM", -1.0)
    with claims.claimed(st.Url(url), range(1, 4)):
        assert not files.exists(held)
    waits = write("prepare", host="elsewhere", pid=1, started=1.0)
    monkeypatch.setattr(claims, "_SECONDS_OF_A_CLAIM", 100.0)
    with pytest.raises(VbnfaultError, match="process 1 on elsewhere"), claims.prepared(st.Url(url), 0):
        pass
    files.remove([waits])
    with claims.prepared(st.Url(url), 0):
        pass
    assert left_behind(url) == []


@pytest.mark.parametrize("name", ["depth_m/zarr.json", "image/c/1"])
def test_a_bucket_that_fails_in_the_middle_ends_a_build_that_resumes(
    url: str, server: S3Server, digest: str, name: str
) -> None:
    with server.failing(503, puts(url, name)) as refused, pytest.raises(VbnfaultError) as raised:
        run(url, samples=SAMPLES)
    assert len(refused) == 3  # repeated twice
    assert "503 Service Unavailable" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert raised.value.exit_code == 1
    if "zarr.json" not in name:
        assert "finished samples stay, and the same command resumes" in str(raised.value)
        assert st.open_store(url).finished() == 4
    else:
        assert not st.is_store(url)
    assert run(url, samples=SAMPLES).digest == digest
    assert left_behind(url) == []


def test_requests_that_fail_are_repeated(url: str, server: S3Server, digest: str) -> None:
    seen: set[str] = set()

    def first(method: str, path: str) -> bool:
        return not (path in seen or seen.add(path))  # type: ignore[func-returns-value]

    with server.failing(503, first) as refused:
        assert run(url, samples=SAMPLES).digest == digest
    assert len(refused) > 100


@pytest.mark.parametrize(("status", "reason"), [(403, "403 Forbidden"), (401, "401 Unauthorized")])
def test_a_bucket_without_rights(url: str, server: S3Server, built: str, status: int, reason: str) -> None:
    with server.failing(status, lambda method, path: method == "PUT"), pytest.raises(VbnfaultError) as raised:
        run(url, samples=SAMPLES)
    assert f"access is refused ({reason})" in str(raised.value)
    with server.failing(status, lambda method, path: "/c/" in path), pytest.raises(InputError) as raised:
        st.digest(built)
    assert f"access is refused ({reason}): give this user the right to read it" in str(raised.value)
    with server.failing(status, lambda method, path: "/image/c/" in path):
        for read in (lambda: st.open_store(built).read("image", 0, 1), lambda: st.open_store(built).read_sample(0)):
            with pytest.raises(InputError, match="access is refused"):
                read()


def test_a_bucket_that_cannot_be_read_is_not_taken_for_an_empty_one(
    built: str, server: S3Server, digest: str
) -> None:
    with server.failing(500, lambda method, path: method == "GET"):
        for action in (lambda: st.is_store(built), lambda: run(built, samples=SAMPLES), lambda: st.examine(built)):
            with pytest.raises(VbnfaultError, match="cannot be read: 500 Internal Server Error; nothing is lost"):
                action()
    assert st.digest(built) == digest


def test_no_such_bucket_store_or_server(built: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=f"s3://{BUCKET}/none.zarr: no such store"):
        st.open_store(f"s3://{BUCKET}/none.zarr")
    with pytest.raises(InputError, match="is no vbnfault store"):
        st.open_store(f"{built}/image")
    with pytest.raises(VbnfaultError, match=r"s3://none/s\.zarr: there is no such bucket; create it"):
        run("s3://none/s.zarr", samples=SAMPLES)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(VbnfaultError, match=r"zarr.json: cannot be read: HTTP error: error sending request"):
        st.open_store(built)
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(InputError, match=r"obstore is not installed; pip install 'vbnfault\[cloud\]'"):
        st.open_store(built)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("s3://bucket", "is no URL of a store, such as s3://BUCKET/NAME.zarr"),
        ("s3:///a.zarr", "is no URL of a store"),
        ("s3://bucket/a.zarr?x=1", "is no URL of a store"),
        ("ftp://host/a.zarr", r"ftp:// is unknown; known: file://, s3://, s3a://, gs://, az://"),
        ("file://host/a.zarr", "must be file:// and an absolute path"),
    ],
)
def test_urls_are_checked(text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        st.located(text)


def test_a_file_url_is_a_path(tmp_path: Path) -> None:
    assert st.located(f"file://{tmp_path}/a%20b.zarr") == tmp_path / "a b.zarr"
    assert st.located("S3://bucket/a/b.zarr/") == st.Url("s3://bucket/a/b.zarr")
    assert st.located("C:/a") == Path("C:/a")
    run(f"file://{tmp_path}/s.zarr", samples=4)
    assert st.open_store(tmp_path / "s.zarr").finished() == 4


# --- create and replace -----------------------------------------------------------------------------------


def test_other_objects_are_left_alone(url: str) -> None:
    files = st.files_of(st.located(url))
    files.write([("notes/a.txt", b"mine")])
    with pytest.raises(InputError, match=r"holds notes/a\.txt and is no vbnfault store, so it is left alone"):
        run(url, samples=SAMPLES, overwrite=True)
    assert files.read("notes/a.txt", 9) == b"mine"


def test_a_store_is_replaced_also_after_interruptions(url: str, server: S3Server) -> None:
    st.write_samples(st.create(url, make_spec(), 4), [fake_sample(make_spec(), 0)])
    for chosen in (
        puts(url, "replaced"),
        lambda method, path: method == "POST",  # of what is deleted
        puts(url, "mask/zarr.json"),
    ):
        with server.failing(403, chosen), pytest.raises(VbnfaultError):
            st.create(url, make_spec(), SAMPLES, overwrite=True)
    store = st.create(url, make_spec(), SAMPLES)  # that it is to be replaced is known
    assert (store.samples, store.finished()) == (SAMPLES, 0)
    assert left_behind(url) == []
    assert st.append_samples(store, 2).samples == SAMPLES + 2


def test_the_root_is_written_last_and_removed_first(url: str, server: S3Server) -> None:
    """So a killed creation, or replacement, leaves no store rather than half of one."""
    root = f"{url.removeprefix('s3:/')}/zarr.json"

    def exists() -> bool:
        return st.files_of(st.located(url)).exists("zarr.json")

    with server.counted() as requests:
        st.create(url, make_spec(), SAMPLES)
    puts = [r.path for r in requests if r.method == "PUT"]
    assert puts[-1] == root
    assert puts.count(root) == 1
    # deleting the first object of another array fails: the root is gone by then
    seen: list[str] = []

    def refuse(method: str, path: str) -> bool:
        if method in ("POST", "DELETE"):
            seen.append(path)
        return len(seen) > 2

    with server.failing(403, refuse), pytest.raises(VbnfaultError):
        st.create(url, make_spec(), SAMPLES, overwrite=True)
    assert not exists()
    st.create(url, make_spec(), SAMPLES)
    assert exists()


def test_an_object_that_is_replaced_while_it_is_read_is_not_mixed(url: str, server: S3Server) -> None:
    """The index and the chunks are two requests; the second is refused if the object is another one by then."""
    files = st.files_of(st.located(url))
    files.write([("a", b"0" * 60)])

    def choose(tail: bytes) -> list[tuple[int, int]]:
        assert tail == b"0" * 10
        files.write([("a", b"1" * 60)])
        return [(5, 10)]

    with pytest.raises(VbnfaultError, match=r"cannot be read: .*; nothing is lost, repeat the command later"):
        files.read_parts("a", 10, choose)


def test_a_write_that_fails_is_not_passed_over(url: str, server: S3Server) -> None:
    """One of many objects is refused, the first ones of which are finished before it is sent."""
    files = st.files_of(st.located(url))
    with server.failing(403, puts(url, "/object2")), pytest.raises(PermissionError):
        files.write([(f"object{k}", b"x") for k in range(20)])
    assert "object0" in files.names("")


# --- reading ----------------------------------------------------------------------------------------------


def test_a_sample_is_read_by_ranges_of_its_shard(built: str, server: S3Server) -> None:
    store = st.open_store(built)
    shard = len(store.files.read(store.file_name("image", 0), 1 << 30))
    reader = st.ShardReader(store, ["image"])
    data = st.open_dataset(built)
    for read in (
        lambda: store.read("image", 2, 3),
        lambda: data.image[2].values,
        lambda: reader.fetch(0, [2])[2].chunks["image"],
    ):
        read()
        with server.counted() as requests:
            read()
        of_image = [r for r in requests if "/image/c/" in r.path]
        assert len(of_image) == 2  # the index, and the chunk
        assert all(r.range for r in of_image)
        assert sum(r.answered for r in of_image) < shard / 3
    with server.counted() as requests:
        sample = store.read_sample(5, ["image"])
    assert (sample.layers["image"] == fake_sample(store.spec, 5).layers["image"]).all()
    assert sum(r.answered for r in requests) < shard
    assert len(requests) < 60


def test_stores_in_buckets_and_on_disks_are_merged(tmp_path: Path, built: str, url: str, digest: str) -> None:
    assert join_stores([built], tmp_path / "a.zarr", progress=False).digest == digest
    summary = join_stores([tmp_path / "a.zarr"], url, move=True, progress=False)
    assert summary.digest == digest
    assert st.open_store(tmp_path / "a.zarr").finished() == 0


def test_commands_take_urls(tmp_path: Path, built: str, digest: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vbnfault.dataset.identity.planned", lambda *_: None)
    monkeypatch.setattr("vbnfault.dataset.identity.check_described", lambda _: None)
    monkeypatch.setattr("vbnfault.dataset.identity.is_exact", lambda *_: False)
    monkeypatch.setattr("vbnfault.dataset.missing_plugins", lambda _: [])

    def call(*words: str) -> str:
        shown = CliRunner().invoke(cli.app, list(words))
        assert shown.exit_code == 0, (shown.output, shown.exception)
        return shown.output

    assert "8 samples, whole, labelled" in call("verify", built)
    assert digest in call("digest", built)
    call("preview", built, "--out", str(tmp_path / "p.png"))
    assert (tmp_path / "p.png").stat().st_size > 1000
    assert "samples" in call("stats", built)
    assert call("card", built).split() == [f"{built}/README.md", f"{built}/croissant.json"]
    assert call("report", built, "--out", str(tmp_path / "r.html")).strip() == str(tmp_path / "r.html")
    assert "8 samples as png" in call("export", built, "--format", "png", "--out", str(tmp_path / "e"))
    shown = CliRunner().invoke(cli.app, ["verify", "ftp://a/b"])
    assert "ftp:// is unknown" in str(shown.exception)
