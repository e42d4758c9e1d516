"""The report of a dataset: what it says of a store, which stores it takes, and its page in a real browser."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import WHY_NOT, found, opened
from sequences_kit import NAMES, sequences
from synthetic import FAULTS, fake_sample, filled, flip, make_spec
from typer.testing import CliRunner

import vbnfault
from vbnfault import cli
from vbnfault import store as st
from vbnfault.core.errors import InputError
from vbnfault.core.html_page import number_text
from vbnfault.output.contact_sheet import film_strips
from vbnfault.output.report import MOST_READ, MOST_SHOWN, write_report
from vbnfault.output.report.charts import _limits, bin_edges, histogram
from vbnfault.output.report.measure import Drawn, key_bounds, key_unit, read_drawn, read_pixels, read_scalars
from vbnfault.output.report.page import pick
from vbnfault.store import codec


@pytest.fixture(scope="module")
def page(described_store: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The report of a store of a real scene."""
    out = tmp_path_factory.mktemp("report") / "r.html"
    assert write_report(described_store, out) == out
    return out.read_text(encoding="utf-8")


def test_the_page_needs_no_other_file_and_holds_every_section(page: str) -> None:
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert not re.search(r"url\((?!data:|#)|@import|https?://|<script", page)
    identifiers = re.findall(r'\bid="([^"]*)"', page)
    assert len(identifiers) == len(set(identifiers))
    names = re.findall(r'<section id="(\w+)">', page)
    assert names == ["gallery", "balance", "together", "sun", "view", "parameters", "exposure", "areas", "about"]
    assert page.count('class="card"') == 6
    assert page.count("<svg") == page.count("</svg>") > 15
    text = re.sub(r"data:[^\"]*", "", page)
    assert "NaN" not in text
    assert ">nan" not in text


def test_planned_and_realised_numbers_are_those_of_the_store(page: str, described_store: Path) -> None:
    data = st.open_store(described_store)
    injected, split = data.read("injected").astype(bool), data.read("split")
    for k, fault in enumerate(FAULTS):
        for name in sorted(set(split)):
            count, of = int(injected[split == name, k].sum()), int((split == name).sum())
            cells = re.escape(fault.replace("_", " ")), re.escape(name), *(f"{n}" for n in (count, count, of))
            assert re.search(r"\s*".join(f"<td[^>]*>{cell}</td>" for cell in cells), page)


def test_what_is_measured_is_what_the_layers_hold(described_store: Path) -> None:
    data = st.open_store(described_store)
    scalars = read_scalars(data)
    pixels = read_pixels(data, scalars, 4, {})
    assert pixels.positions.tolist() == [0, 2, 3, 5]
    for k, i in enumerate(pixels.positions):
        image, mask = data.read("image", i, i + 1)[0], data.read("mask", i, i + 1)[0]
        assert pixels.saturated["image"][k] == np.mean((image[..., :3] == 255).any(axis=2))
        assert pixels.mean_dn["image"][k] == pytest.approx(image[..., 3].mean())
        np.testing.assert_allclose(pixels.areas["mask"][k], mask.reshape(len(FAULTS), -1).mean(axis=1))
    drawn, read = read_drawn(data, scalars)
    assert read == 6
    counts = data.read("injected").astype(bool).sum(axis=0)
    assert {d.name for d in drawn} == {"x"}  # no histogram of seeds
    assert {d.fault: len(d.values) for d in drawn} == {f: 2 * n for f, n in zip(FAULTS, counts, strict=True) if n}


def test_directions_of_the_sun_follow_from_azimuth_elevation_and_attitude(tmp_path: Path) -> None:
    # a level frame that is T, a camera that is T turned by 90 degrees about z: the Sun in T is (0.6, 0, -0.8)
    spec = make_spec()
    store = st.create(tmp_path / "s.zarr", spec, 1)
    sample = fake_sample(spec, 0)
    half = np.sqrt(0.5)
    turned = {"sun_direction_T": (0.6, 0, -0.8), "T_from_L": np.eye(3), "camera_from_T": (half, 0, 0, half)}
    sample.scalars.update(turned)
    st.write_samples(store, [sample])
    scalars = read_scalars(store)
    np.testing.assert_allclose(scalars.sun_L[0], (0.6, 0, -0.8), atol=1e-12)
    np.testing.assert_allclose(scalars.sun_C[0], (0, 0.6, -0.8), atol=1e-12)


# --- stores of every kind -----------------------------------------------------------------------------------


def test_an_unfinished_store_is_reported_as_far_as_it_is(tmp_path: Path) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(), 40)
    with pytest.raises(InputError, match="no sample is finished yet"):
        write_report(store, tmp_path / "r.html")
    st.write_samples(store, [fake_sample(store.spec, i) for i in (3, 9)])
    text = write_report(store, tmp_path / "r.html").read_text()
    assert "2 of 40 finished" in text
    assert text.count('class="card"') == 2


@pytest.mark.parametrize(
    "changes",
    [
        {"layers": ()},  # no effects, no depth
        {"faults": (), "mask_any_faults": (), "layers": ()},
        {"faults": (*FAULTS, "of_a_plug_in"), "layers": ()},
        {"size": 300, "layers": ()},  # not small enough for PNG
    ],
)
def test_stores_of_every_kind_have_a_report(changes: dict[str, Any], tmp_path: Path) -> None:
    if "of_a_plug_in" in changes.get("faults", ()):
        store = st.create(tmp_path / "s.zarr", make_spec(**changes), 1)
        sample = fake_sample(make_spec(layers=()), 0)
        mask = np.concatenate([sample.layers["mask"], sample.layers["mask"][:1]])
        sample.layers["mask"] = mask
        sample.scalars["injected"] = np.array([True] * 5)
        sample.scalars["parameters"] = {"of_a_plug_in": {"depth": [{"x": 1.5}, {"x": 2}], "on": True, "who": "<b>"}}
        st.write_samples(store, [sample])
    elif changes.get("faults") == ():
        store = st.create(tmp_path / "s.zarr", make_spec(**changes), 1)
        sample = fake_sample(make_spec(layers=()), 0)
        sample.layers.update(mask=np.zeros((0, 24, 32), bool), mask_any=np.zeros((24, 32), bool))
        sample.scalars.update(injected=np.zeros(0, bool), parameters={})
        st.write_samples(store, [sample])
    else:
        store = filled(tmp_path / "s.zarr", 1, **changes)
    text = write_report(store, tmp_path / "r.html").read_text()
    assert text.count('class="card"') == 1
    assert "Effects" not in text
    assert ("image/png" in text) == ("size" not in changes)


def test_damaged_samples_are_counted_and_left_out(whole: st.Store, tmp_path: Path) -> None:
    flip(whole.file("stratum", 0), 12)
    shutil.rmtree(whole.path / "image" / "c" / "1")
    chunks = whole.chunk("image", 2)
    whole.file("image", 2).write_bytes(codec.join_shard({0: chunks[9], 1: chunks[9]}, 4))
    sentence = r"sample 8 does not match the stored crc32c of image; .* of 4 samples more; the report leaves"
    with pytest.warns(UserWarning, match=sentence):
        text = write_report(whole, tmp_path / "r.html").read_text()
    assert "4 finished samples whose scalars cannot be read and 5 whose pixels cannot be read" in text
    assert text.count('class="card"') == 1


def test_a_large_store_is_sampled_and_the_page_says_so(described_store: Path, tmp_path: Path) -> None:
    text = write_report(described_store, tmp_path / "r.html", samples=3, pixels=2).read_text()
    assert "3 of 6 finished samples" in text
    assert "of 2 samples, evenly spaced" in text


def test_numbers_of_samples_have_the_limits_of_the_command_and_are_refused_beyond_them(
    described_store: Path, tmp_path: Path
) -> None:
    text = CliRunner().invoke(cli.app, ["report", "--help"], env={"COLUMNS": "300"}).output
    for name, most in (("samples", MOST_SHOWN), ("pixels", MOST_READ)):
        assert re.search(rf"--{name} +INTEGER \(1 to {most}\)", text)
        for wrong in (0, most + 1, 2.5, "3", True, None):
            with pytest.raises(InputError, match=rf"^{name} = {wrong!r}: must be a whole number from 1 to {most}$"):
                vbnfault.report(described_store, tmp_path / "r.html", **{name: wrong})
    assert not list(tmp_path.iterdir())
    vbnfault.report(described_store, tmp_path / "r.html", samples=np.int64(1))
    assert (tmp_path / "r.html").read_text(encoding="utf-8").count('class="card"') == 1


def test_the_gallery_has_every_class_of_every_split_where_there_is_room(tmp_path: Path) -> None:
    scalars = read_scalars(filled(tmp_path / "s.zarr", 30, layers=()))
    for most in (1, 5, 24, 30, 99):
        chosen = pick(scalars, most)
        assert chosen == sorted(set(chosen))
        assert len(chosen) == min(most, 30)
    chosen = np.array(pick(scalars, 18))
    for k in range(len(FAULTS)):
        for split in range(3):
            inside = scalars.split == split
            assert (
                scalars.injected[chosen][scalars.split[chosen] == split, k].any()
                == scalars.injected[inside, k].any()
            )


def test_files_that_are_no_page_are_refused(finished_store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.html"):
        write_report(finished_store, tmp_path / "r.pdf")
    with pytest.raises(InputError, match="cannot be written"):
        write_report(finished_store, tmp_path / "no" / "r.html")
    assert list(tmp_path.iterdir()) == []


# --- parts --------------------------------------------------------------------------------------------------


def test_bounds_belong_to_the_key_of_the_parameter() -> None:
    bounds = {"straylight": {"radius": (0.05, 0.3), "glare_radius": (0.2, 0.45), "index": (1.0, 10.0)}}

    def of(name: str) -> tuple[float, float] | None:
        return key_bounds(bounds, Drawn(fault="straylight", name=name, values=np.zeros(0), split=np.zeros(0, int)))

    assert of("flares.radius") == (0.05, 0.3)
    assert of("glare.radius") == (0.2, 0.45)
    assert of("glare.index") is None
    assert of("index") == (1.0, 10.0)
    assert of("nothing") is None


@pytest.mark.parametrize(
    ("fault", "model", "name", "unit"),
    [
        ("dust_on_optics", "gaussian", "sigma_xx", "grid units²"),
        ("dust_on_optics", "gaussian", "x_px", ""),  # drawn, no key
        ("straylight", "texture", "flares.radius", "image widths"),
        ("straylight", "texture", "glare.radius", "image widths"),
        ("dust_on_optics", "not_loaded", "sigma_xx", ""),
        ("not_loaded", "gaussian", "sigma_xx", ""),
    ],
)
def test_a_drawn_parameter_has_the_unit_of_its_key(fault: str, model: str, name: str, unit: str) -> None:
    drawn = Drawn(fault=fault, name=name, values=np.zeros(0), split=np.zeros(0, int))
    assert key_unit({fault: model}, drawn) == unit


def test_a_histogram_has_few_bins_for_few_values_and_one_for_each_of_few_whole_numbers() -> None:
    np.testing.assert_array_equal(bin_edges(np.array([0, 1, 1, 2, 10.0]), 0, 10, False), np.arange(11))
    assert len(bin_edges(np.linspace(0, 1, 9), 0, 1, False)) == 7
    edges = bin_edges(np.geomspace(1, 100, 500), 1, 100, True)
    assert len(edges) == 25
    np.testing.assert_allclose(np.diff(np.log10(edges)), 2 / 24)


@pytest.mark.parametrize(("most", "in_a_bin"), [(1, 1), (4, 1), (23, 1), (30, 3), (255, 11)])
def test_bins_hold_equally_many_whole_numbers(most: int, in_a_bin: int) -> None:
    values = np.arange(most + 1.0)
    low, high = _limits(values, [(0.0, float(most))], False)
    counts = np.histogram(values, bin_edges(values, low, high, False))[0].tolist()
    assert counts[:-1] == [in_a_bin] * (len(counts) - 1)
    assert sum(counts) == most + 1


def test_a_histogram_says_how_many_values_it_has_and_where_all_are_equal() -> None:
    text = histogram("x", "s", [("all", np.array([0, 0, 0, 0.1]))], logarithmic=True)
    assert "all: 4 values" in text
    assert "75 %" in text  # the bar of the zeros is the highest
    assert ">bright</" in histogram("x", "", [("a", np.ones(2))], labels=("dark", "bright"))
    assert "1.5 au in all samples" in histogram("x", "au", [("a", np.full(3, 1.5))])
    assert "no values" in histogram("x", "au", [])


def test_numbers_are_short() -> None:
    assert [number_text(v) for v in (0, -1.5, 1e-6, 2.5e8)] == ["0", "−1.5", "10⁻⁶", "2.5·10⁸"]
    assert [number_text(v) for v in (999.6, 1000, -1024, 99_990, 1e5)] == ["1000", "1000", "−1020", "10⁵", "10⁵"]


def test_names_cannot_end_an_element(tmp_path: Path) -> None:
    name = "</style><script>alert(1)</script>"
    attributes = make_spec().attributes | {"title": name, "description": name, "licence": name, "citation": name}
    store = filled(tmp_path / "s.zarr", 1, attributes=attributes, layers=())
    text = write_report(store, tmp_path / "r.html").read_text()
    assert "<script" not in text
    assert text.count("&lt;/style&gt;&lt;script&gt;") >= 4


# --- in a browser -------------------------------------------------------------------------------------------


def first_image(page: Any) -> np.ndarray:
    """Return the first image of the gallery as the browser shows it, float64[y, x, 3]."""
    place = (
        "(() => { const { x, y, width, height } = document.querySelector('.card .image').getBoundingClientRect(); "
    )
    x, y, width, height = (round(v) for v in page.evaluate(place + "return [x, y, width, height]; })()"))
    shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return shown[y + 2 : y + height - 2, x + 2 : x + width - 2].astype(float)


@pytest.mark.skipif(found() is None, reason=WHY_NOT)
def test_the_page_in_a_browser(described_store: Path, tmp_path: Path) -> None:
    url = write_report(described_store, tmp_path / "r.html").as_uri()
    with opened() as page:
        page.look(1366, 768)
        page.goto(url)
        shown = "[...document.querySelectorAll('.mask')].filter((m) => m.checkVisibility()).length"
        before, own = page.evaluate(shown), page.evaluate("document.querySelectorAll('.m0').length")
        assert own > 0
        page.click("#show-m0")
        assert page.evaluate(shown) == before - own
        page.press(" ")  # the same by a key
        assert page.evaluate(shown) == before

        clean = "document.querySelector('.clean').checkVisibility()"
        assert not page.evaluate(clean)
        page.click("#show-clean")
        assert page.evaluate(clean)
        page.click("#show-clean")

        for k in range(len(FAULTS)):
            if page.evaluate(f"document.querySelector('#show-m{k}').checked"):
                page.click(f"#show-m{k}")
        plain = first_image(page)
        page.click("#show-brighter")
        brighter = first_image(page)
        assert plain.mean() < 200
        assert (np.abs(brighter - np.sqrt(255 * plain)) <= 1).mean() > 0.99  # of two roundings

        page.evaluate("document.documentElement.style.scrollBehavior = 'auto'")  # else a click meets a moving page
        wide = "document.querySelector('#sample-2').clientWidth"
        small = page.evaluate(wide)
        page.click("#sample-2 .frame")
        page.wait(f"{wide} > {2 * small}")
        page.click("#sample-2 .close")
        page.wait(f"{wide} === {small}")

        fits = "document.documentElement.scrollWidth <= innerWidth"
        for width in (1920, 1366, 390):
            page.look(width, 768)
            assert page.evaluate(fits), width
        # at 390 px: the letters of every chart are as large as those of small print
        heights = (
            "[...document.querySelectorAll('svg[role=img] text')].map((t) => t.getBoundingClientRect().height)"
        )
        assert min(h for h in page.evaluate(heights) if h) > 8
        assert page.errors == []
        assert {request.partition(":")[0] for request in page.requests} <= {"file", "data"}


# --- sequences ----------------------------------------------------------------------------------------------------


def test_film_strips_are_evenly_spaced_frames_of_some_sequences() -> None:
    """Of 3 sequences of 9, 1 and 12 frames, counted by hand; of 6 sequences, the first, third, fourth and last."""
    sequence = np.repeat([0, 1, 2], [9, 1, 12])
    strips = [strip.tolist() for strip in film_strips(sequence, 4, 32, 8)]
    assert strips == [[0, 1, 2, 3, 5, 6, 7, 8], [9], [10, 12, 13, 15, 16, 18, 19, 21]]
    assert [strip.tolist() for strip in film_strips(sequence, 2, 6)] == [[0, 4, 8], [10, 16, 21]]
    assert [sequence[0] for sequence in film_strips(np.arange(6), 4, 32, 8)] == [0, 2, 3, 5]
    mixed = np.array([1, 0, 1, 0])
    assert [strip.tolist() for strip in film_strips(mixed, 4, 8)] == [[1, 3], [0, 2]]


def test_a_report_begins_with_film_strips(tmp_path: Path) -> None:
    store = sequences(tmp_path / "s.zarr")
    text = write_report(store, tmp_path / "r.html", samples=3).read_text(encoding="utf-8")
    strips = re.findall(r'<h3 class="name">(.*?)</h3>\s*<div class="strip">(.*?)</div>', text, re.DOTALL)
    assert [name for name, _ in strips] == list(NAMES)
    shown = [[int(k) for k in re.findall(r'id="frame-(\d+)"', strip)] for _, strip in strips]
    assert shown == [strip.tolist() for strip in film_strips(store.read("sequence"), 4, 32, 8)]
    assert re.findall(r"</b> (\S+)\N{NO-BREAK SPACE}s ", strips[0][1])[:3] == ["5", "5.2", "5.4"]
    assert strips[0][1].count('class="mask m0"') == sum(3 <= k <= 8 for k in shown[0])
    assert "film strips of 3 of 3 sequences" in text
    assert text.count('id="sample-') == 3
    identifiers = re.findall(r'\bid="([^"]*)"', text)
    assert len(identifiers) == len(set(identifiers))


def test_frames_that_cannot_be_read_leave_their_strips(tmp_path: Path) -> None:
    store = sequences(tmp_path / "s.zarr")
    shutil.rmtree(store.path / "image" / "c" / "2")  # samples 8 to 11, among them all of the second sequence
    with pytest.warns(UserWarning, match="the report leaves out what it cannot read"):
        text = write_report(store, tmp_path / "r.html").read_text(encoding="utf-8")
    frames = [int(k) for k in re.findall(r'id="frame-(\d+)"', text)]
    assert frames == [0, 1, 2, 3, 5, 6, 7, 12, 13, 15, 16, 18, 19, 21]
    assert "film strips of 2 of 3 sequences" in text
