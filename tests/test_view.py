"""The viewer: what its server gives and refuses, and its page in a real browser, clicks included."""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import WHY_NOT, Page, found, opened
from conftest import Called
from sequences_kit import FRAMES, sequences
from sequences_kit import NAMES as SEQUENCES
from synthetic import FAULTS, fake_sample, filled, flip, make_spec

from vbnfault import store as st
from vbnfault.core.errors import InputError
from vbnfault.core.files import images
from vbnfault.output.contact_sheet import overlay
from vbnfault.output.report import write_report
from vbnfault.output.viewer import Viewer, server
from vbnfault.output.viewer.server import NOT_KNOWN, Listing
from vbnfault.scene.names import STRATA


class Served:
    """A viewer that serves in a thread."""

    def __init__(self, store: st.Store) -> None:
        self.store, self.viewer = store, Viewer(store)
        self.thread = threading.Thread(target=self.viewer.serve)
        self.thread.start()

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, dict[str, str]]:
        """Return status, body and headers of a request."""
        connection = http.client.HTTPConnection("127.0.0.1", self.viewer.port, timeout=60)
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        try:
            return answer.status, answer.read(), dict(answer.getheaders())
        finally:
            connection.close()

    def json(self, path: str) -> dict:
        """Return a JSON object."""
        return dict(json.loads(self.ask(path)[1]))

    def close(self) -> None:
        """End the server."""
        self.viewer.stop()
        self.thread.join()


@pytest.fixture(scope="module")
def served(described_store: Path) -> Iterator[Served]:
    """A viewer of a finished store of a real scene."""
    with contextlib.closing(Served(st.open_store(described_store))) as one:
        yield one


# --- the server ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "//etc/passwd",
        "/server.py",
        "/nothing",
        "/api/nothing",
        "/api/sample/6",
        "/api/sample/-1",
        "/api/layer/split/0",
        "/api/small/0?side=100000",
        "/api/small/0?side=" + "9" * 5000,
    ],
)
def test_nothing_else_is_served(path: str, served: Served) -> None:
    assert served.ask(path)[0] == 404


def test_requests_for_another_host_are_refused(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    for host in ("evil.example", f"evil.example:{served.viewer.port}", "127.0.0.1", "127.0.0.1:1", ""):
        assert served.ask("/", Host=host)[0] == 403
        assert served.ask("/api/store", Host=host)[0] == 403
    assert served.ask("/", Host=f"localhost:{served.viewer.port}")[0] == 200
    assert served.ask("/", "POST")[0] == 501
    assert served.viewer.server.server_address[0] == "127.0.0.1"
    monkeypatch.setattr(server, "_PORT_OF_HTTP", served.viewer.port)  # a browser leaves this port out
    assert served.ask("/", Host="127.0.0.1")[0] == served.ask("/", Host="localhost")[0] == 200
    assert served.ask("/", Host="evil.example")[0] == 403


def test_the_page_takes_nothing_from_elsewhere(served: Served) -> None:
    _, body, headers = served.ask("/")
    assert headers["Content-Security-Policy"].startswith("default-src 'self'")
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert b"http" not in body
    for name in ("view.js", "elements.js", "film.js", "layers.js", "view.css"):
        assert served.ask(f"/{name}")[0] == 200


def test_a_taken_port_is_refused_with_a_sentence(served: Served) -> None:
    with pytest.raises(InputError, match=f"--port {served.viewer.port}: .*0 takes a free port"):
        Viewer(served.store, served.viewer.port)


def test_layers_and_scalars_are_those_of_the_store(served: Served) -> None:
    data = served.store
    for name, row in data.spec.pixel_layers.items():
        status, body, _ = served.ask(f"/api/layer/{name}/4")
        assert status == 200
        np.testing.assert_array_equal(
            np.frombuffer(body, row.dtype).reshape(data.spec.shape(row)), data.read(name, 4, 5)[0]
        )
    sample = served.json("/api/sample/4")["values"]
    assert sample["exposure_s"] == {"value": data.read("exposure_s", 4, 5)[0], "units": "s"}
    assert sample["parameters"] == json.loads(data.read("parameters", 4, 5)[0])
    assert sample["split"] == data.read("split", 4, 5)[0]


def test_small_images_show_the_masks_where_asked(served: Served) -> None:
    plain, masked = (served.ask(f"/api/small/3?side=160&masks={k}")[1] for k in (0, 1))
    decoded = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (32, 40, 3)  # not enlarged
    assert plain != masked


def test_where_no_class_is_localised_none_is_shown_as_if_it_were(tmp_path: Path) -> None:
    """A viewer tints masks of such classes less, and a report does not tick them."""
    store = filled(tmp_path / "s.zarr", 4, faults=("vignetting",), mask_any_faults=(), layers=("clean",))
    with contextlib.closing(Served(store)) as served:
        assert [fault["localised"] for fault in served.json("/api/store")["faults"]] == [False]
    write_report(store, tmp_path / "r.html")
    assert 'id="show-m0">' in (tmp_path / "r.html").read_text()


def test_brighter_images_are_the_square_root_and_their_masks_keep_their_colours(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def image(query: str) -> np.ndarray:
        data = np.frombuffer(served.ask(f"/api/small/3?side=320&{query}")[1], np.uint8)  # asked by no other test
        return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]

    # JPEG halves the resolution of colours, so that nothing could be compared exactly
    encoded = images.encoded
    monkeypatch.setattr(images, "encoded", lambda rgb, *_: encoded(rgb, ".png"))
    stored = served.store.read("image", 3, 4)[0][..., :3]
    root = np.round(np.sqrt(255.0 * stored)).astype(np.uint8)
    masks = served.store.read("mask", 3, 4)[0].astype(bool)
    localised = [fault in (served.store.spec.localised_faults or FAULTS) for fault in FAULTS]
    for masked in (False, True):
        for brighter, rgb in ((False, stored), (True, root)):
            flags = [bool(mask.any()) for mask in masks]
            expected = overlay(rgb, masks, flags, localised) if masked else rgb
            found = image(f"masks={int(masked)}&brighter={int(brighter)}")
            np.testing.assert_array_equal(found, expected)


# --- the listing --------------------------------------------------------------------------------------------


def columns(store: st.Store) -> tuple[np.ndarray, np.ndarray]:
    """Return the injected faults [word, sample] and split, stratum, finished [3, sample]."""
    data, words = Listing(store).columns, -(-len(store.spec.faults) // 32)
    bits = np.frombuffer(data, "<u4", words * store.samples).reshape(words, -1)
    return bits, np.frombuffer(data, np.uint8, offset=bits.nbytes).reshape(3, -1)


def test_the_listing_holds_every_sample(tmp_path: Path) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(layers=()), 23)
    st.write_samples(store, [fake_sample(store.spec, i) for i in (*range(6), 21, 22)])
    bits, (split, stratum, finished) = columns(store)
    injected = store.read("injected").astype(bool)
    np.testing.assert_array_equal((bits[0][:, None] >> np.arange(len(FAULTS))) & 1, injected)
    assert np.flatnonzero(finished).tolist() == [0, 1, 2, 3, 4, 5, 21, 22]
    names = store.read("split")
    assert [st.SPLITS[k] if k != NOT_KNOWN else "" for k in split] == names.tolist()
    np.testing.assert_array_equal(stratum, store.read("stratum"))


def test_more_classes_than_a_word_has_bits(tmp_path: Path) -> None:
    faults = tuple(f"fault_{k}" for k in range(35))
    store = st.create(tmp_path / "s.zarr", make_spec(faults=faults, mask_any_faults=(), layers=()), 1)
    sample = fake_sample(make_spec(layers=()), 0)
    injected = np.arange(35) % 3 == 1
    sample.scalars.update(injected=injected, parameters={})
    sample.layers.update(mask=np.zeros((35, 24, 32), bool), mask_any=np.zeros((24, 32), bool))
    st.write_samples(store, [sample])
    bits, _ = columns(store)
    assert [(int(bits[k >> 5, 0]) >> (k & 31)) & 1 for k in range(35)] == injected.astype(int).tolist()


def test_severity_is_the_rank_of_what_was_drawn(tmp_path: Path) -> None:
    models = {
        "dust_on_optics": "gaussian",
        "broken_pixels": "texture",
        "straylight": "traced",
        "vignetting": "cos4",
    }
    attributes = {"scene": {}, "fault_models": models}
    store = st.create(tmp_path / "s.zarr", make_spec(layers=(), attributes=attributes), 4)
    made = []
    for i, grains in enumerate((30, 10, 20, 20)):
        sample = fake_sample(store.spec, i)
        # the longest list counts, not what else was drawn
        grain = {"x_px": [1] * grains, "size": [2], "kind": "grain"}
        drawn = {"dust_on_optics": grain, "straylight": {"veil_fraction": 0.1 * i, "flares": []}}
        sample.scalars["parameters"] = drawn | ({"vignetting": {"mask_loss": 0.1}} if i else {})
        made.append(sample)
    st.write_samples(store, made)
    ranks = np.frombuffer(Listing(store).severities, np.uint8).reshape(4, 4)
    assert ranks[0].tolist() == [254, 0, 127, 127]
    assert ranks[2].tolist() == [0, 85, 169, 254]
    assert (ranks[[1, 3]] == NOT_KNOWN).all()


def test_numbers_without_end_and_a_stratum_without_a_name_are_shown(tmp_path: Path) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(layers=()), 2)
    for i in range(2):
        sample = fake_sample(store.spec, i)
        sample.scalars["stratum"] = len(STRATA) - 1 + i
        sample.scalars["parameters"] = '{"vignetting": {"a": NaN, "b": [1e999, -Infinity], "c": 0.5}}'
        st.write_samples(store, [sample])
    viewer = Viewer(store)
    viewer.server.server_close()
    values = [json.loads(viewer.answer(f"api/sample/{i}", {})[0])["values"] for i in range(2)]
    assert values[0]["parameters"] == {"vignetting": {"a": "NaN", "b": ["1e999", "-Infinity"], "c": 0.5}}
    assert [one["stratum"] for one in values] == [STRATA[-1], "?"]


def test_damage_is_said_in_a_sentence(whole: st.Store) -> None:
    flip(whole.file("image", 0), 200)
    shutil.rmtree(whole.path / "exposure_s" / "c")
    flip(whole.file("tries", 1), 12)
    with contextlib.closing(Served(whole)) as one:
        status, body, _ = one.ask("/api/layer/image/0")
        assert (status, b"the build command repairs it" in body) == (422, True)
        assert one.ask("/api/small/0")[0] == 422
        assert one.json("/api/sample/0") == {"index": 0, "finished": False}


@pytest.mark.slow
def test_the_command_prints_its_address_and_ends_with_ctrl_c(finished_store: Path) -> None:
    command = [sys.executable, "-m", "vbnfault", "view", str(finished_store), "--no-browser", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[0]
        port = int(address.rstrip("/").rpartition(":")[2])
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request("GET", "/api/store")
        assert json.loads(connection.getresponse().read())["samples"] == 10
        connection.close()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")


def test_a_view_that_is_ended_by_a_signal_says_nothing_of_files(
    finished_store: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[..., Called]
) -> None:
    def ended(viewer: Viewer) -> None:
        viewer.server.server_close()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)

    monkeypatch.setattr(Viewer, "serve", ended)
    ended_view = call("view", finished_store, "--no-browser")
    assert (ended_view.code, ended_view.said) == (143, f"the view of {finished_store} was ended")


def test_the_command_opens_a_browser_unless_told_not_to(
    finished_store: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[..., Called]
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("webbrowser.open", asked.append)
    monkeypatch.setattr(Viewer, "serve", lambda viewer: viewer.server.server_close())
    assert call("view", finished_store, "--browser").code == 0
    assert [url[:17] for url in asked] == ["http://127.0.0.1:"]
    assert call("view", finished_store, "--no-browser").code == 0
    assert len(asked) == 1


# --- the page in a browser ----------------------------------------------------------------------------------

needs_browser = pytest.mark.skipif(found() is None, reason=WHY_NOT)
_SUM = """document.getElementById('canvas').getContext('2d').getImageData(0, 0, 1200, 700).data
  .reduce((a, b) => a + b, 0)"""


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """A browser."""
    with opened() as one:
        one.look(1366, 768)
        yield one


def ready(page: Page, served: Served, first: str = "performance.getEntriesByName('first-image').length") -> None:
    """Open the page and wait for its listing and its first image, or what stands in its place."""
    page.goto("about:blank")
    page.errors.clear()  # what an earlier page logs, such as refused requests, may come late
    page.goto(served.viewer.url)
    page.wait(f"window.vbnfault?.listing && {first}")


@needs_browser
def test_filters_fold_and_leave_a_phone_to_the_images(page: Page, served: Served) -> None:
    page.look(390, 800)
    ready(page, served)
    height = "document.getElementById('scroller').clientHeight"
    assert page.evaluate("document.getElementById('fold').open") is False
    folded = page.evaluate(height)
    assert folded > 560
    page.press("f")
    page.wait("document.getElementById('fold').open")
    assert page.evaluate(height) < folded
    page.look(1366, 768)


@needs_browser
def test_a_tile_that_waits_differs_from_a_black_image(page: Page, served: Served) -> None:
    ready(page, served)
    waiting = "getComputedStyle(document.querySelector('.tile .image')).backgroundImage"
    assert page.evaluate(waiting).startswith("repeating-linear-gradient")
    page.evaluate("document.querySelector('.tile img').classList.add('waiting')")
    page.wait("getComputedStyle(document.querySelector('.tile img')).opacity === '0'")


@needs_browser
def test_the_grid_shows_filters_and_goes(page: Page, served: Served) -> None:
    ready(page, served)
    injected = served.store.read("injected").astype(bool)
    assert page.evaluate("document.querySelectorAll('.tile').length") == 6
    page.wait("[...document.querySelectorAll('.tile img')].every((i) => i.complete && i.naturalWidth === 40)")

    page.click('[data-filter="classes:0"]')
    assert page.evaluate("window.vbnfault.count") == injected[:, 0].sum()
    page.click('[data-filter="classes:1"]')
    assert page.evaluate("window.vbnfault.count") == injected[:, :2].any(axis=1).sum()
    page.click("#mode")  # all of the chosen classes
    assert page.evaluate("window.vbnfault.count") == injected[:, :2].all(axis=1).sum()
    page.click("#clear")
    assert page.evaluate("window.vbnfault.count") == 6
    page.click('[data-filter="classes:none"]')
    assert page.evaluate("window.vbnfault.count") == (~injected.any(axis=1)).sum()
    page.click("#clear")
    split = served.store.read("split").tolist()
    k = st.SPLITS.index(split[0])
    page.click(f'[data-filter="splits:{k}"]')
    assert page.evaluate("window.vbnfault.count") == split.count(split[0])
    page.click("#clear")

    page.click("#number")
    page.type("4")
    page.press("Enter")
    assert page.evaluate("document.activeElement.dataset.index") == "4"
    page.press("ArrowLeft")
    assert page.evaluate("document.activeElement.dataset.index") == "3"
    page.press("m")
    page.wait("[...document.querySelectorAll('.tile img')].every((i) => i.src.endsWith('masks=1&brighter=0'))")
    page.press("b")
    page.wait("[...document.querySelectorAll('.tile img')].every((i) => i.src.endsWith('masks=1&brighter=1'))")
    assert page.evaluate("document.querySelector('header .brighter').getAttribute('aria-pressed')") == "true"
    page.click("header .brighter")
    page.wait("[...document.querySelectorAll('.tile img')].every((i) => i.src.endsWith('masks=1&brighter=0'))")
    page.press("?")
    assert page.evaluate("document.getElementById('help').open")
    page.press("Escape")
    page.wait("!document.getElementById('help').open")
    assert page.errors == []


@needs_browser
@pytest.mark.parametrize("width_px", [1440, 1024, 700])
def test_the_key_g_reaches_the_field_of_the_number_in_windows_of_any_width(
    page: Page, served: Served, width_px: int
) -> None:
    try:
        page.look(width_px, 768)
        ready(page, served)
        page.press("g")
        assert page.evaluate("document.activeElement.id") == "number"
        page.type("5")
        page.press("Enter")
        assert page.evaluate("document.activeElement.dataset.index") == "5"
        field, key = (
            page.evaluate(f"document.querySelector('{element}').getBoundingClientRect().top")
            for element in ("#number", "#go kbd")
        )
        assert abs(field - key) < 20  # px: both are in one line
    finally:
        page.look(1366, 768)


@needs_browser
def test_one_sample_by_mouse_and_by_keys(page: Page, served: Served) -> None:
    ready(page, served)
    data = served.store
    index = int(np.flatnonzero(data.read("injected").astype(bool)[:, 0])[0])
    page.click(f'.tile[data-index="{index}"]')
    page.wait("performance.getEntriesByName('sample').length")
    page.wait(f"document.querySelector('#parameters').textContent.includes('{FAULTS[0].replace('_', ' ')}')")
    image = data.read("image", index, index + 1)[0]
    assert page.evaluate("[...window.vbnfault.view.pixels.data]") == image.ravel().tolist()
    masks = data.read("mask", index, index + 1)[0]
    areas = page.evaluate("window.vbnfault.view.masks.map((m) => (m ? m.area : 0))")
    np.testing.assert_allclose(areas, masks.reshape(len(FAULTS), -1).mean(axis=1))

    before = page.evaluate(_SUM)
    page.click('#masks [data-fault="0"]')
    without = page.evaluate(_SUM)
    assert without != before
    page.press("1")
    assert page.evaluate(_SUM) == before

    page.press("b")
    root = page.evaluate(
        "(() => { const c = window.vbnfault.view.root; "
        "return [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]; })()"
    )
    rgb = image[..., :3].reshape(-1, 3).astype(float)
    np.testing.assert_array_equal(np.reshape(root, (-1, 4))[:, :3], np.round(np.sqrt(255 * rgb)))
    assert page.evaluate(_SUM) != before
    assert page.evaluate("[...window.vbnfault.view.pixels.data]") == image.ravel().tolist()
    page.press("d")  # a depth is no image of the camera
    page.wait("window.vbnfault.view.layer === 'depth_m' && window.vbnfault.view.root === null")
    page.press("i")
    page.wait("window.vbnfault.view.layer === 'image' && window.vbnfault.view.root !== null")
    page.click("#panel .brighter")
    assert page.evaluate(_SUM) == before

    for key, name in (("c", "clean"), ("d", "depth_m"), ("n", "normal"), ("s", "semantic"), ("x", "difference")):
        page.press(key)
        page.wait(f"window.vbnfault.view.layer === '{name}' && document.getElementById('message').hidden")
        page.wait(f"document.querySelector('[data-layer={name}]').getAttribute('aria-checked') === 'true'")
    for name in ("depth_m", "normal"):  # of 32 and of 16 bits
        page.click(f"[data-layer={name}]")
        page.wait(f"window.vbnfault.view.pixels?.layer.name === '{name}'")
        stored = data.read(name, index, index + 1)[0].astype(float).ravel()
        shown = page.evaluate("[...window.vbnfault.view.pixels.data].map((v) => (Number.isFinite(v) ? v : -1))")
        np.testing.assert_array_equal(shown, np.where(np.isfinite(stored), stored, -1))
    page.press("e")
    page.wait("document.getElementById('kind').textContent.startsWith('effects')")

    page.press("i")
    page.press("ArrowRight" if index < 5 else "ArrowLeft")
    other = index + 1 if index < 5 else index - 1
    page.wait(f"document.getElementById('name').textContent === 'Sample {other}'")
    page.press("+")
    assert page.evaluate("window.vbnfault.view.zoom") > 1
    page.press("Escape")
    assert page.evaluate("document.getElementById('viewer').hidden")
    assert page.evaluate("document.activeElement.dataset.index") == str(other)
    assert page.errors == []
    assert all(
        u.startswith((served.viewer.url, "blob:", "data:", "about:")) for u in page.requests if "file:" not in u
    )


@needs_browser
def test_the_pointer_names_defects_and_reads_a_render_with_a_guard_band(page: Page, tmp_path: Path) -> None:
    """A render of 12 rows and 10 columns more than the frame begins 6 rows and 5 columns outside of it."""
    spec = make_spec(layers=("defects", "scene_radiance", "flow"), rendered_shape=(36, 42))
    sample = fake_sample(spec, 0)
    defects = np.zeros((spec.height, spec.width), np.uint8)
    defects[7, 9], defects[8, 9] = 1, 8 | 16
    scene = np.arange(3 * 36 * 42, dtype=np.float16).reshape(3, 36, 42) % 2048
    store = st.create(tmp_path / "s.zarr", spec, 1)
    flow = np.stack([np.full(defects.shape, 1.5), np.full(defects.shape, -2.5)], axis=-1).astype(np.float32)
    layers = {**sample.layers, "defects": defects, "scene_radiance": scene, "flow": flow}
    st.write_samples(store, [dataclasses.replace(sample, layers=layers)])
    with contextlib.closing(Served(store)) as served:
        ready(page, served)
        page.evaluate("location.hash = '#0'")
        page.wait("performance.getEntriesByName('sample').length")
        page.wait("document.getElementById('scalars').children.length")  # whose coming moves what is to be clicked

        def pointed(layer: str, x: int, y: int) -> str:
            page.click(f"[data-layer={layer}]")
            page.wait(f"window.vbnfault.view.pixels?.layer.name === '{layer}'")
            return str(
                page.evaluate(f"""(() => {{
              const canvas = document.getElementById("canvas"), box = canvas.getBoundingClientRect();
              const zoom = 0.97 * Math.min(box.width / {spec.width}, box.height / {spec.height});
              const clientX = box.x + box.width / 2 + ({x} + 0.5 - {spec.width / 2}) * zoom;
              const clientY = box.y + box.height / 2 + ({y} + 0.5 - {spec.height / 2}) * zoom;
              canvas.dispatchEvent(new PointerEvent("pointermove", {{ clientX, clientY }}));
              return document.getElementById("probe").textContent;
            }})()""")
            )

        assert pointed("defects", 9, 7).split(":")[1].split() == ["hot"]
        assert pointed("defects", 9, 8).split(":")[1].split() == ["rts", "rts_high"]
        assert pointed("defects", 9, 9).split(":")[1].split() == ["none"]
        shown = pointed("scene_radiance", 4, 3).replace("\u202f", "").split(":")[1].split()[:3]
        assert [float(value) for value in shown] == scene[:, 9, 9].tolist()
        assert pointed("flow", 4, 3).split(":")[1].split() == ["1.5", "−2.5"]
        page.wait("document.getElementById('scale').textContent.includes('component x')")  # the one that is painted
        assert page.errors == []


@needs_browser
def test_unfinished_and_damaged_samples_are_named(page: Page, tmp_path: Path) -> None:
    store = filled(tmp_path / "s.zarr", 6)
    shutil.rmtree(store.path / "done" / "c")
    st.write_samples(store, [fake_sample(store.spec, i) for i in (0, 1, 2)])
    shutil.rmtree(store.path / "image")
    store = st.open_store(store.path)
    with contextlib.closing(Served(store)) as one:
        ready(page, one, "document.querySelector('.tile[data-index=\"5\"]').textContent.includes('not finished')")
        page.wait("document.querySelector('.tile[data-index=\"0\"]').textContent.includes('cannot be read')")
        page.click('.tile[data-index="0"]')
        page.wait("document.getElementById('message').textContent.includes('the build command repairs it')")
    page.errors.clear()  # the browser logs each refused request


@needs_browser
def test_more_samples_than_a_browser_can_scroll_px(page: Page, tmp_path: Path) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(layers=(), shard_samples=16), 600_000)
    st.write_samples(store, [fake_sample(store.spec, i) for i in (0, 599_999)])
    with contextlib.closing(Served(store)) as one:
        ready(page, one, "true")
        page.press("End")
        page.wait("document.activeElement.dataset.index === '599999'")
        page.wait("document.activeElement.querySelector('img')?.naturalWidth > 0")
        box = page.evaluate(
            "(() => { const b = document.activeElement.getBoundingClientRect(); return [b.top, b.bottom]; })()"
        )
        assert box[0] >= 40
        assert box[1] <= 768
        assert page.evaluate("document.querySelectorAll('.tile').length") < 100


# --- sequences ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A viewer of a store with sequences."""
    with contextlib.closing(Served(sequences(tmp_path_factory.mktemp("view") / "s.zarr", step_s=600))) as one:
        yield one


def test_times_of_sequences_are_those_of_the_store(filmed: Served, served: Served) -> None:
    status, body, _ = filmed.ask("/api/times")
    samples = sum(FRAMES)
    assert (status, len(body)) == (200, 12 * samples)
    np.testing.assert_array_equal(np.frombuffer(body, "<f8", samples), filmed.store.read("time_s"))
    np.testing.assert_array_equal(np.frombuffer(body, "<i4", offset=8 * samples), filmed.store.read("sequence"))
    assert filmed.json("/api/store")["sequences"] == list(SEQUENCES)
    assert served.ask("/api/times")[0] == 404


SPEED = """(() => {{
  const speed = document.getElementById("speed");
  speed.value = "{}";
  speed.dispatchEvent(new Event("change"));
}})()"""


def open_sample(page: Page, one: Served, index: int) -> None:
    """Open a sample of a store with sequences, and note what its label of time will say."""
    ready(page, one)
    page.click(f'.tile[data-index="{index}"]')
    page.wait("performance.getEntriesByName('sample').length && !document.getElementById('film').hidden")
    page.evaluate("""(() => {
      const time = document.getElementById("time");
      window.noted = [];
      new MutationObserver(() => window.noted.push(time.textContent)).observe(time, { childList: true });
    })()""")


@needs_browser
def test_a_sequence_plays_frame_by_frame_and_keeps_its_buttons(page: Page, filmed: Served) -> None:
    open_sample(page, filmed, 2)
    assert page.evaluate("document.getElementById('sequence').textContent") == "approach, frame 3 of 9"
    page.evaluate("window.button = document.querySelector('#masks [data-fault=\"0\"]')")
    assert page.evaluate("document.getElementById('speed').value") == "1000"  # the least with a frame in a second
    asked = len(page.requests)
    page.press(" ")
    page.wait("window.noted.length")
    page.evaluate(SPEED.format(0.1))  # the next frame comes in 6000 s
    page.wait("performance.getEntriesByName('sample').length === window.noted.length + 1")  # all frames are drawn
    before = page.evaluate(_SUM)
    page.click('#masks [data-fault="0"]')
    assert page.evaluate(_SUM) != before
    page.press("1")
    assert page.evaluate(_SUM) == before
    page.press("1")
    assert page.evaluate("window.vbnfault.film.playing")
    page.evaluate(SPEED.format(10000))
    page.wait("!window.vbnfault.film.playing")
    assert page.evaluate("window.noted") == [f"{5 + 600 * k} s" for k in range(3, 9)]
    assert page.evaluate("window.vbnfault.view.hidden.has(0)")
    assert page.evaluate("window.button.isConnected && window.button.getAttribute('aria-pressed')") == "false"
    page.wait("document.querySelector('#parameters').textContent.length && location.hash === '#8'")
    details = [url.rpartition("/")[2] for url in page.requests[asked:] if "/api/sample/" in url]
    assert details == ["8"]  # of the frame where it stopped
    stored = filmed.store.read("image", 8, 9)[0]
    assert page.evaluate("[...window.vbnfault.view.pixels.data]") == stored.ravel().tolist()
    assert page.errors == []


@needs_browser
def test_arrows_the_slider_and_the_end_of_a_sequence(page: Page, filmed: Served) -> None:
    open_sample(page, filmed, 8)
    title = "document.getElementById('sequence').textContent"
    page.click("#play")  # from the last frame, it begins again
    page.wait("window.vbnfault.film.playing && window.vbnfault.view.index < 8")
    page.press("ArrowRight")
    page.wait("!window.vbnfault.film.playing")
    frame = page.evaluate("window.vbnfault.film.at")
    page.press("ArrowLeft")
    page.evaluate("new Promise((done) => setTimeout(done, 700))")  # the next frame would have come after 600 ms
    page.wait(f"{title} === 'approach, frame {frame} of 9'")
    page.evaluate("""(() => {
      const frame = document.getElementById("frame");
      frame.value = 6;
      frame.dispatchEvent(new Event("input"));
    })()""")
    page.wait("window.vbnfault.view.index === 6 && document.getElementById('time').textContent === '3605 s'")
    for _ in range(3):
        page.press("ArrowRight")
    page.wait(f"{title} === 'still, frame 1 of 1'")
    page.press(" ")  # nothing follows
    page.wait("!window.vbnfault.film.playing")
    page.press(" ")
    page.press("Escape")
    assert page.evaluate("!window.vbnfault.film.playing && document.getElementById('viewer').hidden")
    assert page.errors == []


@needs_browser
def test_a_store_without_sequences_has_no_player(page: Page, served: Served) -> None:
    ready(page, served)
    page.click('.tile[data-index="0"]')
    page.wait("performance.getEntriesByName('sample').length")
    page.press(" ")
    assert page.evaluate("document.getElementById('film').hidden && !window.vbnfault.film.playing")


@needs_browser
def test_filters_leave_the_frames_of_a_film_that_pass(page: Page, filmed: Served) -> None:
    ready(page, filmed)
    page.click('[data-filter="classes:0"]')  # dust, from the fourth frame on
    page.click('.tile[data-index="3"]')
    page.wait("document.getElementById('sequence').textContent === 'approach, frame 1 of 6'")
    assert page.evaluate("window.vbnfault.film.frames") == [3, 4, 5, 6, 7, 8]
