"""The figures and the page of a study, from made-up results."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
import pyarrow as pa
import pytest
import study_kit
from study_results import IMAGE_METRICS, LENS_FACTORS, Plan, ishigami, made_up

import vbnfault
from vbnfault.core.figures import inline_svg
from vbnfault.study import indices, plots, report
from vbnfault.study.report import write_images, write_report
from vbnfault.study.summaries import StudyResults

FEW = (LENS_FACTORS[0], LENS_FACTORS[9], LENS_FACTORS[7])  # normal, categorical, log-uniform
TWO = (IMAGE_METRICS[0], IMAGE_METRICS[10])  # lower is better, higher is better
SMALL = Plan(factors=FEW, metrics=TWO, n=32)


@pytest.fixture(autouse=True)
def _fast_delta(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out most resamples of delta, whose estimates cost much and which no test looks at."""
    monkeypatch.setattr(indices, "_MOST_RESAMPLES_OF_DELTA", 2)


def with_column(results: StudyResults, name: str, values: Any) -> StudyResults:
    """Return results with other values in a column of the table."""
    where = results.table.schema.get_field_index(name)
    table = results.table.set_column(where, results.table.schema.field(where), pa.array(values))
    return StudyResults(dataset=results.dataset, table=table, spec=results.spec)


def written(results: StudyResults, folder: Path) -> str:
    path = write_report(folder, results)
    assert path == folder / "report.html"
    return path.read_text(encoding="utf-8")


class Page(HTMLParser):
    """Collect the tags of a page, its identifiers and its text, and check that elements close in order."""

    VOID = frozenset({"meta", "img", "br", "link", "input", "hr"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text, self._open = "", []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


# ------------------------------------------------------------------------------------ the page


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[StudyResults, Path, str]:
    """A study that compares models, with failures, a metric without values, and images."""
    plan = replace(SMALL, models=("texture", "traced"), seeds=(1,), failed=7, empty=("snr",))
    results = made_up(plan)
    folder = tmp_path_factory.mktemp("study")
    write_images(folder, results, Painter())
    return results, folder, written(results, folder)


class Painter:
    """Give images whose brightness is the number of the evaluation, and remember what was asked."""

    def __init__(self) -> None:
        self.asked: list[Any] = []

    def picture(self, evaluation: Any) -> Any:
        self.asked.append(evaluation)
        return np.full((8, 10), 1.0 + evaluation.index, dtype=np.float32)


def test_the_page_is_whole_and_needs_no_other_file(compared: tuple[StudyResults, Path, str]) -> None:
    results, _, text = compared
    page = Page(text)
    assert "http:" not in text
    assert "https:" not in text
    assert "url(" not in text.replace("url(#", "")
    sources = [attrs["src"] for tag, attrs in page.tags if tag == "img"]
    sources += [attrs["href"] for tag, attrs in page.tags if tag == "image"]  # within a drawing
    assert len(sources) > 2
    assert all(re.match(r"data:image/(png|webp);base64,[A-Za-z0-9+/=]+$", str(source)) for source in sources)
    links = [str(attrs["href"]) for tag, attrs in page.tags if "href" in attrs and tag != "image"]
    identifiers = Counter(str(attrs["id"]) for _, attrs in page.tags if "id" in attrs)
    assert set(identifiers.values()) == {1}
    assert all(link.startswith("#") and link[1:] in identifiers for link in links)
    assert not {"script", "link", "iframe"} & {tag for tag, _ in page.tags}
    for name in (*results.metrics, *results.factors, *results.models, "dummy"):
        assert name in page.text
    assert len(text.encode()) < 20e6


def test_the_page_says_what_was_asked_and_what_went_wrong(compared: tuple[StudyResults, Path, str]) -> None:
    results, _, text = compared
    words = " ".join(Page(text).text.split())
    assert "Twelve factors of <one> lens & its sensor." in words  # escaped
    assert "log-uniform, 0.3 to 30" in words
    assert "normal, mean 1, deviation 0.005, cut at 0.99 and 1.01" in words
    assert "one of 5, 7, 9, round, equally likely" in words
    assert f"7 of {results.table.num_rows} evaluations failed" in words
    assert "the rays <miss> surface 4" in words
    assert "half-width above 0.05" in words  # n = 32 is too few
    assert "vbnfault 0.2.0" in words
    assert "812.4" in words  # the time of a stage
    for kind in ("overview", "indices", "models", "tornado", "responses", "interactions", "images"):
        assert f'<section id="{kind}">' in text
    # first order, total, pairs, control variates, model form
    assert text.count('class="formula"><svg') == 5


def test_the_summary_names_factors_above_the_noise_floor_only() -> None:
    results = ishigami()
    assert re.findall("x.", report._leading(results, "ishigami", "")) == ["x1", "x2", "x3"]  # by the total index
    results.dataset["ST_interval"].loc[{"factor": ["x3", "dummy"]}] = [[0.04, 0.3], [-0.05, 0.05]]
    assert re.findall("x.", report._leading(results, "ishigami", "")) == ["x1", "x2"]


def test_two_reports_of_one_study_are_equal_and_nothing_global_changes(tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    plan = replace(SMALL, method="grid", factors=FEW[:1], metrics=TWO[:1], n=4)
    pages = [written(made_up(plan), tmp_path / name) for name in ("a", "b")]
    assert pages[0] == pages[1]
    assert dict(matplotlib.rcParams) == before
    assert not list(tmp_path.rglob("*.partial"))


def test_an_inline_drawing_has_themed_colours_and_identifiers_of_its_own() -> None:
    svg = (
        '<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg" version="1.1"><metadata>http://a.b</metadata>'
        '<style>*{}</style><g id="figure_1"><path id="m1" style="fill: #1b1f24"/><use xlink:href="#m1"/>'
        '<path clip-path="url(#p2)" style="stroke: #123456"/><clipPath id="p2"/></g></svg>'
    )
    text = inline_svg(svg, "tornado a", "a & b")
    assert text == (
        '<svg role="img" aria-label="a &amp; b"><g><path id="tornado-a-m1" style="fill: var(--ink)"/>'
        '<use href="#tornado-a-m1"/><path clip-path="url(#tornado-a-p2)" style="stroke: #123456"/>'
        '<clipPath id="tornado-a-p2"/></g></svg>'
    )


def test_a_study_writes_its_report(tmp_path: Path) -> None:
    spec = study_kit.spec(design={"n": 128, "resamples": 100, "half_width": 0.4}, metrics={"names": ["y"]})
    vbnfault.study(spec, tmp_path, evaluator=study_kit.Function, progress=False)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    words = " ".join(Page(text).text.split())
    assert "x0 0.56, x1 0.44" in words.replace("\N{NO-BREAK SPACE}", " ")  # as in theory
    assert "uniform, −3.14159 to 3.14159" in words
    assert "function" in words  # the stage of the evaluator
    assert "scikit-image" in words  # the versions
    assert {path.suffix for path in (tmp_path / "plots").iterdir()} == {".png", ".svg"}
    for name in ("indices_y", "tornado_y", "responses_y", "interactions_y"):
        assert (tmp_path / "plots" / f"{name}.png").is_file()
    assert not (tmp_path / "images").exists()  # this evaluator has none


# ------------------------------------------------------------------------------------ figures

METHODS = {
    "sobol": {"indices", "seeds", "tornado", "responses", "interactions"},
    "morris": {"indices", "morris", "seeds", "tornado", "responses"},
    "latin_hypercube": {"indices", "seeds", "tornado", "responses"},
    "grid": {"indices", "tornado", "responses", "interactions"},
    "one_at_a_time": {"tornado", "responses"},
}


@pytest.mark.parametrize("method", METHODS)
def test_every_design_gives_its_figures(method: str, tmp_path: Path) -> None:
    n = 3 if method in ("grid", "one_at_a_time") else 16
    results = made_up(replace(SMALL, method=method, factors=FEW[1:], metrics=TWO[:1], n=n))
    text = written(results, tmp_path)
    stems = {path.stem for path in (tmp_path / "plots").glob("*.svg")}
    assert {stem.removesuffix("_straylight_total_e") for stem in stems} == METHODS[method]
    assert stems == {path.stem for path in (tmp_path / "plots").glob("*.png")}
    assert all(cv2.imread(str(path)).std() > 0 for path in (tmp_path / "plots").glob("*.png"))
    Page(text)


def texts(figure: Any) -> list[tuple[str, Any]]:
    """Return every visible text of a figure, with its box in pixels."""
    renderer = figure.canvas.get_renderer()
    figure.draw(renderer)
    found = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    for axes in figure.axes:
        found += [axes.title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
        for axis in (axes.xaxis, axes.yaxis) if axes.axison else ():
            low, high = sorted(axis.get_view_interval())  # ticks beyond are not drawn
            found += [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in found if text.get_text().strip()]


HARD = {
    "forty factors of long keys": Plan(
        factors=[(f"scene.faults.straylight.a_long_table.a_long_key_{i}", "uniform", "µm/K") for i in range(40)],
        metrics=TWO[:1],
        n=4,
        views=(0,),
        seeds=(1,),
    ),
    "one factor": replace(SMALL, factors=FEW[:1], metrics=TWO[:1]),
    "no values": replace(SMALL, metrics=TWO[:1], empty=("straylight_total_e",), models=("texture", "traced")),
    "three models": replace(SMALL, metrics=TWO[:1], models=("texture", "paraxial", "traced"), seeds=(1,)),
    "grid": replace(SMALL, method="grid", n=3),
    "morris": replace(SMALL, factors=LENS_FACTORS, metrics=TWO[:1], method="morris", n=8),
}


@pytest.mark.parametrize("case", HARD)
def test_no_label_is_cut_or_covers_another(case: str) -> None:
    kinds = set()
    for drawing in plots.drawings(made_up(HARD[case])):
        kinds.add(drawing.kind)
        labels = texts(drawing.figure)
        width, height = drawing.figure.canvas.get_width_height()
        for text, box in labels:
            assert box.x0 > -1, (drawing.stem, text)
            assert box.y0 > -1, (drawing.stem, text)
            assert box.x1 < width + 1, (drawing.stem, text)
            assert box.y1 < height + 1, (drawing.stem, text)
        if drawing.kind in ("overview", "interactions"):
            continue  # the boxes of slanted labels overlap, the labels do not
        for i, (text, box) in enumerate(labels):
            for other, around in labels[:i]:
                across = min(box.x1, around.x1) - max(box.x0, around.x0)
                down = min(box.y1, around.y1) - max(box.y0, around.y0)
                # a box is a little larger than its text
                assert min(across, down) < 2.5, (drawing.stem, text, other)
    assert {"tornado", "responses"} <= kinds


def test_a_constant_metric_has_figures_but_no_images() -> None:
    results = made_up(replace(SMALL, factors=FEW[:2]))
    results = with_column(results, "snr", np.full(results.table.num_rows, 5.0))
    results.dataset["variance"].loc[{"metric": "snr"}] = 0
    results.dataset["ST"].loc[{"metric": "snr"}] = results.dataset["S1"].loc[{"metric": "snr"}] = np.nan
    assert results.extremes("snr") is None
    drawn = plots.indices(results, "snr")
    assert drawn is not None
    assert "no variance" in [text for text, _ in texts(drawn[0])]
    for draw in (plots.tornado, plots.responses):
        figure, _ = draw(results, "snr")
        assert "no values" not in [text for text, _ in texts(figure)]


def test_units_stand_at_the_axes() -> None:
    figure, _ = plots.responses(made_up(SMALL), "straylight_total_e")
    labels = {text.replace("\n", " ") for text, _ in texts(figure)}
    assert "straylight_total_e / 10⁶ e" in labels
    assert "scene.faults.straylight. roughness_nm / nm" in labels


# ------------------------------------------------------------------------------------ what the figures show


def test_a_curve_is_the_conditional_median() -> None:
    results = made_up(replace(SMALL, metrics=TWO[1:], method="latin_hypercube", n=400, views=(0,), seeds=(1,)))
    x = np.asarray(results.column(FEW[2][0]), dtype=float)
    noise = np.random.default_rng(3).normal(0, 0.1, len(x))
    curve = with_column(results, "snr", np.log(x) + noise).points("snr", "").curve(FEW[2][0], 0.95)
    # the standard error of the median of some 36 normal values of deviation 0.1 is 0.021; within a bin of 1/11 of
    # the range ln 100 the values are spread by a further 0.12
    assert np.abs(curve.median - np.log(curve.x)).max() < 4 * np.hypot(0.021, 1.25 * 0.12 / 6)
    assert ((curve.low <= curve.median) & (curve.median <= curve.high)).all()
    assert 0.05 < (curve.high - curve.low).mean() < 0.25  # about 4 standard errors


def test_views_that_differ_do_not_widen_the_bands() -> None:
    plan = replace(SMALL, metrics=TWO[:1], method="latin_hypercube", n=200, seeds=(1,), views=(0,))
    one = made_up(plan).points("straylight_total_e", "")
    two = made_up(replace(plan, views=(0, 1)))  # the second view is brighter by a constant
    values = two.points("straylight_total_e", "").values
    assert np.allclose(values - values.mean(), one.values - one.values.mean())
    failed = np.asarray(two.column("status"))
    failed[5] = "failed"
    lame = with_column(two, "status", failed).points("straylight_total_e", "").values
    # the point that failed in one view has the other one; its shift is exact but for one value of 200 in the means
    assert np.allclose(lame, values, atol=np.ptp(values) / 200)


def test_a_swing_of_one_factor_at_a_time_is_read_from_its_rows() -> None:
    results = made_up(replace(SMALL, method="one_at_a_time", n=5))
    x = np.asarray(results.column(FEW[2][0]), dtype=float)
    points = with_column(results, "snr", (np.log(x) - np.log(3.0)) ** 2).points("snr", "")
    swing = points.swing(FEW[2][0])
    assert swing.least == pytest.approx(0, abs=1e-9)  # at the base, in the middle
    assert swing.most == swing.at_low_end == pytest.approx(swing.at_high_end)
    assert swing.most == pytest.approx((0.5 * np.log(100)) ** 2)
    assert points.swing(FEW[0][0]).size == 0
    assert points.chance_swing() == 0


def test_a_factor_without_effect_swings_as_chance_does() -> None:
    results = made_up(replace(SMALL, metrics=TWO[1:], method="latin_hypercube", n=300, views=(0,), seeds=(1,)))
    sizes, of_all = [], []
    for seed in range(30):
        values = np.random.default_rng(seed).normal(size=300)
        points = with_column(results, "snr", values).points("snr", "")
        sizes.append(points.swing(FEW[0][0]).size)
        of_all += [points.swing(key).size for key, *_ in FEW]
    # the range of five means of 60 values: 2.33 standard errors on average, with a deviation of 0.86
    assert np.mean(sizes) == pytest.approx(2.33 / np.sqrt(60), abs=4 * 0.86 / np.sqrt(60 * 30))
    # of these factors, one has four values in place of fifths: four means of 75 values, whose range is 0.24
    assert points.chance_swing() == pytest.approx(2.33 / np.sqrt(60), rel=0.2)
    # the median of 90 sizes has a standard error of 1.25 × 0.11 / √90, 5 %
    assert points.chance_swing() == pytest.approx(np.median(of_all), rel=0.2)


def test_trajectories_are_resampled_whole() -> None:
    results = made_up(replace(SMALL, method="morris", n=12, seeds=(1,), views=(0,)))
    trajectory = [int(role.split(":")[1]) for role in results.column("role")]
    points = with_column(results, "snr", np.asarray(trajectory, dtype=float)).points("snr", "")
    assert (np.diff(points.cluster) >= 0).all()
    # twelve different values, each repeated along its trajectory: the median is as uncertain as that of twelve
    curve = points.curve(FEW[0][0], 0.95)
    assert (curve.high - curve.low).min() >= 3


def test_images_are_those_of_the_extremes_with_one_exposure(tmp_path: Path) -> None:
    results, painter = made_up(replace(SMALL, models=("texture", "traced"), failed=5)), Painter()
    paths = write_images(tmp_path, results, painter)
    assert [path.name for path in paths] == [
        f"{metric}_{end}.png" for metric, *_ in TWO for end in ("best", "worst")
    ]
    for metric, better in (("straylight_total_e", min), ("snr", max)):
        values = np.asarray(results.column(metric), dtype=float)
        extremes = results.extremes(metric)
        assert extremes is not None
        assert extremes.best == values[extremes.best_row] == better(values[results.succeeded])
        pair = [cv2.imread(str(tmp_path / "images" / f"{metric}_{end}.png")).max() for end in ("best", "worst")]
        assert max(pair) == 255
        brighter = int(extremes.best_row < extremes.worst_row)  # an image is as bright as its evaluation's number
        assert pair[brighter] == 255
        assert pair[1 - brighter] < 255
    asked = {evaluation.index: evaluation for evaluation in painter.asked}
    assert len(asked) == len(painter.asked)  # none twice
    row = results.table.slice(extremes.best_row, 1).to_pylist()[0]
    evaluation = asked[row["evaluation"]]
    assert {key: getattr(evaluation, key) for key in ("seed", "view", "model", "role")}.items() <= row.items()
    assert evaluation.values == {key: row[key] for key, *_ in FEW}
    assert write_images(tmp_path, results, object()) == []


def test_images_of_8_bits_stay_as_they_are_and_others_have_a_middle_that_is_seen() -> None:
    stored = [np.full((4, 4, 3), level, dtype=np.uint8) for level in (7, 255)]
    assert all((shown == image).all() for shown, image in zip(report._shown(stored), stored, strict=True))
    # ground a thousand times fainter than the Sun, and a veil that is nearly as bright as everything else
    for faint in (1e-3, 0.6):
        pair = [np.full((20, 20), faint * 1e6, dtype=np.float32) for _ in range(2)]
        pair[0][0, :5], pair[1][0, :5] = 1e6, 0.5e6
        best, worst = report._shown(pair)
        assert best.max() == 255
        assert worst[0, 0] < 255
        assert 0.25 * 255 < np.median(best) == np.median(worst) < 0.65 * 255
