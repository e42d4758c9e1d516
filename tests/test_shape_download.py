"""Downloads of shape models from a server on this machine: checksums, the lock file, and what is refused."""

from __future__ import annotations

import hashlib
import http.server
import itertools
import json
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from vbnfault import cli
from vbnfault.body.download import LOCK, Fetched, fetch_shape
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.files import user_files
from vbnfault.scene import bodies

TETRAHEDRON = b"v 1 1 1\nv 1 -1 -1\nv -1 1 -1\nv -1 -1 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SHA256 = hashlib.sha256(TETRAHEDRON).hexdigest()


class Server:
    """Serve bytes by path and count the requests."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {"/a/mine.obj": TETRAHEDRON}
        self.requests: list[str] = []
        self.short = False  # announce one byte more than is sent
        server = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                server.requests.append(self.path)
                data = server.files.get(self.path)
                self.send_response(200 if data is not None else 404)
                self.send_header("Content-Length", str(len(data or b"") + server.short))
                self.end_headers()
                self.wfile.write(data or b"")

            def log_message(self, *_: object) -> None:
                pass

        self._http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._http.server_port}"
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.01})
        self._thread.start()

    def close(self) -> None:
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    one = Server()
    yield one
    one.close()


def fetched(server: Server, folder: Path, sha256: str = "") -> Fetched:
    return fetch_shape(f"{server.url}/a/mine.obj", folder, sha256=sha256)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def test_a_file_is_downloaded_once_and_pinned(server: Server, tmp_path: Path) -> None:
    folder = tmp_path / "shapes"
    first = fetched(server, folder)
    assert (first.is_new, first.was_known) == (True, False)
    assert first.path.read_bytes() == TETRAHEDRON
    lock = json.loads((folder / LOCK).read_text())
    assert lock == {
        "mine.obj": {"sha256": SHA256, "size_bytes": len(TETRAHEDRON), "url": f"{server.url}/a/mine.obj"}
    }
    second = fetched(server, folder)
    assert (second.is_new, second.was_known, second.pin) == (False, True, first.pin)
    assert len(server.requests) == 1
    assert names(folder) == {"mine.obj", LOCK}
    # the pin holds for the next download too, here and in a folder that has only the lock file
    server.files["/a/mine.obj"] = TETRAHEDRON + b"\n"
    first.path.unlink()
    with pytest.raises(
        VbnfaultError, match=rf"mine\.obj: has SHA-256 [0-9a-f]{{64}} .*: must be {SHA256}; the file"
    ):
        fetched(server, folder)
    assert names(folder) == {LOCK}


def test_a_published_checksum_holds(server: Server, tmp_path: Path) -> None:
    assert fetched(server, tmp_path, SHA256).was_known
    (tmp_path / "mine.obj").write_bytes(b"v 0 0 0\n")
    with pytest.raises(
        InputError, match=rf"mine\.obj: SHA-256 [0-9a-f]{{64}}: must be {SHA256}; move the file away"
    ):
        fetched(server, tmp_path, SHA256)
    other = "0" * 64
    with pytest.raises(InputError, match=rf"{LOCK}: mine\.obj: sha256 = '{SHA256}': the published one is {other}"):
        fetched(server, tmp_path, other)
    with pytest.raises(VbnfaultError, match=f"must be {other}") as caught:
        fetched(server, tmp_path / "empty", other)
    assert caught.value.exit_code == 1
    assert names(tmp_path / "empty") == set()


def test_what_is_no_shape_is_not_kept(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = b"<html><body>Please sign in</body></html>"
    server.files |= {"/page.obj": page, "/page.bds": page, "/b.bds": b"DAS/DSK \0\0"}
    for name, sentence in (
        ("page.obj", r"page\.obj: is not a shape: .*; the file was not kept"),
        ("page.bds", r"page\.bds: is not a shape: it begins with b'<html><b', a DSK with b'DAS/DSK '"),
        ("gone.obj", r"gone\.obj: the server answers 404 Not Found"),
    ):
        with pytest.raises(VbnfaultError, match=sentence):
            fetch_shape(f"{server.url}/{name}", tmp_path)
    assert names(tmp_path) == set()
    assert fetch_shape(f"{server.url}/b.bds", tmp_path).is_new
    (tmp_path / "b.bds").unlink()
    (tmp_path / LOCK).unlink()
    monkeypatch.setitem(user_files.LIMIT_BYTES, "shape", 20)
    with pytest.raises(VbnfaultError, match=r"mine\.obj: has more than 1\.90735e-05 MiB, the most of a shape file"):
        fetched(server, tmp_path)
    monkeypatch.undo()
    server.short = True
    with pytest.raises(VbnfaultError, match=r"mine\.obj: (cannot be downloaded|\d+ of \d+ bytes arrived)"):
        fetched(server, tmp_path)
    assert names(tmp_path) == set()


def test_a_file_that_lies_there_must_be_a_shape(server: Server, tmp_path: Path) -> None:
    for name, data, reason in (
        ("mine.obj", b"x\n", "mesh has 0 faces"),
        ("mine.bds", b"x\n", r"it begins with b'x\\n', a DSK with b'DAS/DSK '"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(
            InputError, match=rf"{name}: is not a shape: {reason}; move the file away to download it"
        ):
            fetch_shape(f"{server.url}/a/{name}", tmp_path)
    assert not server.requests
    assert names(tmp_path) == {"mine.obj", "mine.bds"}
    (tmp_path / "mine.obj").write_bytes(TETRAHEDRON)
    assert not fetched(server, tmp_path).is_new


@pytest.mark.parametrize("address", ["/komet_é.obj", "/komet_%C3%A9.obj", "/a b/komet_é.obj?x=ü"])
def test_addresses_beyond_ascii_are_encoded(server: Server, tmp_path: Path, address: str) -> None:
    sent = {"/a": "/a%20b/komet_%C3%A9.obj?x=%C3%BC"}.get(address[:2], "/komet_%C3%A9.obj")
    server.files[sent] = TETRAHEDRON
    assert fetch_shape(server.url + address, tmp_path).path == tmp_path / "komet_é.obj"
    assert server.requests == [sent]


@pytest.mark.parametrize("is_slow", [True, False])
def test_a_download_that_would_never_end_is_given_up(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_slow: bool
) -> None:
    """The clock goes 61 s or 1 s a look, with no wait: 5000 bytes a second are asked for after a minute."""
    clock = itertools.count(0, 61 if is_slow else 1)
    monkeypatch.setattr("vbnfault.body.download.time.monotonic", lambda: float(next(clock)))
    if not is_slow:
        assert fetched(server, tmp_path).is_new
        return
    with pytest.raises(
        VbnfaultError, match=r"mine\.obj: sent 70 bytes in 61 s, fewer than 5000 a second; try again"
    ):
        fetched(server, tmp_path)
    assert names(tmp_path) == set()


def test_without_a_network_a_sentence_says_so(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]  # bound but not listening: connections are refused
        with pytest.raises(VbnfaultError, match=r"/x\.obj: cannot be downloaded: .*; check the network, or"):
            fetch_shape(f"http://127.0.0.1:{port}/x.obj", tmp_path)
    assert names(tmp_path) == set()


@pytest.mark.parametrize(
    ("url", "sentence"),
    [
        ("ftp://example.org/a.obj", "must begin with http:// or https:// and a host"),
        ("file:///etc/a.obj", "must begin with http:// or https:// and a host"),
        ("https://example.org/a.zip", r"must end with the name of a shape file: \.obj, \.ply"),
        ("https://example.org/", "must end with the name of a shape file"),
        ("https://[a/b.obj", "Invalid IPv6 URL"),
        ("https://example.org:99999/a.obj", "Port out of range 0-65535"),
        ("https://example.org:x/a.obj", "Port could not be cast"),
        ("https://:80/a.obj", "must begin with http:// or https:// and a host"),
        ("https://a..é/a.obj", "label empty or too long"),
        (f"https://{'a' * 64}.org/a.obj", "label .*too long"),
        ("https://example.org/a%0ab.obj", "must end with the name of a shape file"),
    ],
)
def test_a_wrong_address_is_refused(tmp_path: Path, url: str, sentence: str) -> None:
    with pytest.raises(InputError, match=rf"url = '.*': .*{sentence}"):
        fetch_shape(url, tmp_path)
    with pytest.raises(InputError, match=r"file to download = .*: must be a path of at most"):
        fetch_shape(f"https://example.org/{'a' * 300}.obj", tmp_path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[]", "is not a lock file of shapes"),
        ("{", "is not a lock file of shapes"),
        ('{"a": {"sha256": "0"}}', "is not a lock file of shapes"),
        ('{"a": {"sha256": "0", "size_bytes": 1, "url": ""}}', "a: sha256 = '0': must be 64 hexadecimal digits"),
    ],
)
def test_a_damaged_lock_file_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / LOCK).write_text(text)
    with pytest.raises(InputError, match=rf"{LOCK}: {sentence}"):
        fetch_shape("https://example.org/a.obj", tmp_path)


def test_the_command(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: object) -> int:
        monkeypatch.setattr(sys, "argv", ["vbnfault", "shape", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        return int(stop.value.code or 0)

    assert run("Bennu", "--out", tmp_path, "--url", f"{server.url}/a/mine.obj") == 0
    text = capsys.readouterr().out
    assert f"{tmp_path / 'mine.obj'}: downloaded, Daly et al. 2020" in text
    assert f"SHA-256 {SHA256}\nnobody published a checksum; {tmp_path / LOCK} keeps this one" in text
    assert f'in the scene: [body] name = "Bennu", shape = "{tmp_path / "mine.obj"}"' in text
    assert run("bennu", "--out", tmp_path, "--url", f"{server.url}/a/mine.obj") == 0
    assert "lies there already" in capsys.readouterr().out
    assert run("Eros", "--out", tmp_path / "b", "--url", f"{server.url}/a/mine.obj") == 1
    assert "must be 43aea1117e115ff2" in capsys.readouterr().err
    assert run("Moon", "--out", tmp_path) == 2
    assert "no body with a known address of a shape model; known: 67p, bennu, ceres" in capsys.readouterr().err
    assert run("nothing", "--out", tmp_path) == 2


def test_the_addresses_of_the_packaged_bodies_name_shape_files() -> None:
    files = {name: body.shape_file for name, body in bodies.packaged_bodies().items() if body.shape_file}
    assert set(files) == {"67p", "bennu", "ceres", "eros", "itokawa", "phobos", "ryugu"}
    for file in files.values():
        assert file.url.startswith("https://")
        assert Path(file.url).suffix.lower() == ".bds"
        assert bool(file.sha256) == bool(file.size_bytes)
        assert file.size_bytes < user_files.LIMIT_BYTES["shape"]
