"""The documentation is complete, and every code block of it and of the README runs, on small images.

The blocks of a page run in order, in one folder, in this process. What is added to a command makes it smaller,
never different: image size, terrain and number of samples.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import vbnfault
from vbnfault.body import body as body_module
from vbnfault.body import load_body
from vbnfault.core.tables import json_schema
from vbnfault.detector import Sensor
from vbnfault.faults import registry
from vbnfault.lens.prescription_file import PrescriptionFile
from vbnfault.lens.straylight import irradiance
from vbnfault.reflectance import registry as reflectances

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS / "_ext"))

import blocks  # noqa: E402
import notebooks  # noqa: E402
import reference  # noqa: E402

NOTEBOOK = DOCS / "quickstart.ipynb"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md")), NOTEBOOK]
TERRAIN = {
    "patch.facet_m": 12.0,
    "patch.radius_m": 60.0,
    "patch.min_boulder_m": 6.0,
    "patch.max_triangles": 15_000,
}
LONGEST_PX = 64
SAMPLES_OF_PAGES = {
    "README.md": 4,
    "docs/tutorial.md": 4,
    "docs/quickstart.ipynb": 4,
}  # they show the fourth sample
SMALLER = {
    "detector": ["--pixels", "64", "--points", "12", "--stack", "4"],
    "flare": ["--pixels", "64", "--wavelength-nm", "550"],
    "train": ["--epochs", "1", "--batch-size", "2"],
}
BASE_SAMPLES = 8  # of a study
RAYS_ACROSS = 96  # of a ghost
OUTPUTS = ("--out", "--json", "--toml")
# a documented count → one with which the command takes seconds
FEWER = {"--samples": 2, "--append": 2, "--sample": 1}

load_scene, run_study = vbnfault.load_scene, vbnfault.study.study


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def page_text(page: Path) -> str:
    text = page.read_text(encoding="utf-8")
    return notebooks.markdown(text, outputs=False) if page.suffix == ".ipynb" else text


def page_blocks(page: Path) -> list[blocks.Block]:
    return blocks.blocks(page_text(page), page_name(page))


def small_values(scene: vbnfault.Scene) -> dict[str, Any]:
    """Return overrides that make a scene small: its image keeps its aspect, its ground is coarse."""
    width, height = scene.camera.width_px, scene.camera.height_px
    scale = min(1.0, LONGEST_PX / max(width, height))
    size = {"camera.width_px": max(16, round(width * scale)), "camera.height_px": max(16, round(height * scale))}
    return {**TERRAIN, **size, "dataset.samples": min(FEWER["--samples"], scene.dataset.samples)}


def smaller(words: list[str]) -> list[str]:
    """Return a command on small images, with few samples."""
    out = list(words)
    for k, (option, value) in enumerate(itertools.pairwise(words)):
        if option in FEWER:
            out[k + 1] = str(min(FEWER[option], int(value)))
    if words[1] in ("build", "render", "describe", "retake", "event-camera"):
        scene = words[words.index("--scene") + 1] if words[1] == "retake" else words[2]
        small = small_values(load_scene(scene))
        if "--samples" in words or words[1] in ("describe", "event-camera"):
            del small["dataset.samples"]
        out += [word for key, value in small.items() for word in ("--set", f"{key}={value}")]
    return out + SMALLER.get(words[1], [])


def small_scene(name: str | Path, overrides: dict[str, Any] | None = None) -> vbnfault.Scene:
    """Load a scene as the page says, and then on small images."""
    given = dict(overrides or {})
    return load_scene(name, given | small_values(load_scene(name, given)))


def small_study(*arguments: Any, **keywords: Any) -> Any:
    """Run a study that renders with few base samples."""
    fewer = {} if "evaluator" in keywords else {"overrides": {"design.n": BASE_SAMPLES}}
    return run_study(*arguments, **fewer, **keywords)


@pytest.fixture(scope="module", autouse=True)
def few_facets() -> Iterator[None]:
    """Give the embedded body its form in 5120 facets, not 36,000: most of the time of a page is its terrain."""
    vertices_m = load_body("embedded").vertices_m
    ball = trimesh.creation.icosphere(subdivisions=4)
    radius_m = np.linalg.norm(vertices_m, axis=1, keepdims=True)
    nearest = cKDTree(vertices_m / radius_m).query(ball.vertices)[1]
    coarse = np.asarray(ball.vertices) * radius_m[nearest], np.asarray(ball.faces, np.int32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(body_module, "embedded_nucleus", lambda: coarse)
        yield


@pytest.fixture(scope="module")
def made() -> dict[tuple[str, ...], Path]:
    """Return an empty memory of what commands have made: command without its path → copy of the store or file."""
    return {}


@pytest.fixture
def command(
    made: dict[tuple[str, ...], Path], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[list[str]], int]:
    """Return what runs a command small; it copies what an earlier page made by the same command."""

    def run(words: list[str]) -> int:
        arguments = smaller(words)
        given = {option: Path(value) for option, value in itertools.pairwise(words) if option in OUTPUTS}
        out = given.get("--out")
        if out is None or out.exists() or not depends_on_nothing(words):
            return checked(arguments, given)
        key = tuple(word for word in arguments if word != str(out))
        if key in made:
            copy(made[key], out)
            return 0
        code = checked(arguments, given)
        if not code and list(given) == ["--out"]:
            made[key] = copy(out, tmp_path_factory.mktemp("made") / out.name)
        return code

    def checked(arguments: list[str], outputs: dict[str, Path]) -> int:
        code = blocks.run_command(arguments)
        missing = [str(path) for path in outputs.values() if not path.exists()]
        assert code or not missing or "--dry-run" in arguments, f"{' '.join(arguments)} wrote no {missing}"
        return code

    return run


def copy(made: Path, to: Path) -> Path:
    """Copy a store, folder or file."""
    return Path((shutil.copytree if made.is_dir() else shutil.copy)(made, to))


def depends_on_nothing(words: list[str]) -> bool:
    """Return whether a command makes something from packaged files alone."""
    makes = words[1] in ("build", "render", "flare") and "--dry-run" not in words and "--append" not in words
    return makes and not Path(words[2]).suffix and not any(word.startswith("body.shape=") for word in words)


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_every_block_runs_in_order(
    page: Path,
    command: Callable[[list[str]], int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = page_blocks(page)
    if not found:
        return
    monkeypatch.setenv("MPLBACKEND", "Agg")
    most = SAMPLES_OF_PAGES.get(page_name(page), FEWER["--samples"])
    monkeypatch.setitem(FEWER, "--samples", most)
    monkeypatch.setitem(FEWER, "--sample", most - 1)
    monkeypatch.setattr(vbnfault, "load_scene", small_scene)
    monkeypatch.setattr(vbnfault.study, "study", small_study)
    monkeypatch.setattr(irradiance, "FINE", RAYS_ACROSS)
    if "67p.obj" in page_text(page):
        # a user's own shape: the real comet's name, the embedded body's form
        body = load_body("embedded")
        rows = [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in body.vertices_m]
        rows += [f"f {a} {b} {c}" for a, b, c in body.faces + 1]
        (tmp_path / "67p.obj").write_text("\n".join(rows) + "\n", encoding="utf-8")
    blocks.run_page(found, tmp_path, command=command, said=lambda: capsys.readouterr().err)


def test_every_fence_is_a_block_that_is_known() -> None:
    for page in PAGES:
        text = page_text(page)
        fences = re.findall(r"^```(\w*)", text, flags=re.MULTILINE)
        opened = [language for language in fences if language]
        assert set(opened) <= set(blocks.LANGUAGES), page_name(page)
        assert len(opened) == len(page_blocks(page)), page_name(page)


def test_a_block_that_does_not_run_says_why() -> None:
    idle = [block for page in PAGES for block in page_blocks(page) if block.not_run]
    assert all(len(block.not_run.split()) >= 3 for block in idle)
    # most blocks run: the marks are for downloads and clusters
    assert len(idle) < 0.2 * sum(len(page_blocks(page)) for page in PAGES)


def test_a_block_with_a_wrong_option_is_refused(tmp_path: Path) -> None:
    page = "<!-- not run: a test of the check -->\n```sh\nvbnfault build quickstart --oout x.zarr\n```\n"
    (block,) = blocks.blocks(page, "page.md")
    with pytest.raises(Exception, match=r"oout"):
        blocks.check(block)
    with pytest.raises(ValueError, match="no command bulid"):
        blocks.parse(["bulid", "quickstart"])


def test_inline_commands_name_real_commands() -> None:
    known = {words[0] for words, _ in reference.walk_commands()}
    texts = [page_text(page) for page in PAGES]
    named = {word for text in texts for word in re.findall(r"`vbnfault ([a-z-]+)", text)}
    assert len(named) > 5
    assert named <= known


def generated(page: str) -> str:
    """Return a reference page as Sphinx reads it."""
    text = reference.fill((DOCS / "reference" / f"{page}.md").read_text(encoding="utf-8"))
    assert "<!-- generated" not in text
    return text


def test_the_reference_has_every_command_and_option(capsys: pytest.CaptureFixture[str]) -> None:
    text = generated("commands")
    walked = list(reference.walk_commands())
    assert len(walked) > 10
    assert blocks.run_command(["vbnfault", "--help"]) == 0
    helped = capsys.readouterr().out
    for words, shown in walked:
        assert words[0] in helped
        section = text.partition(f"## vbnfault {' '.join(words)}\n")[2].partition("\n## ")[0]
        for parameter in shown.params:
            if parameter.param_type_name == "option" and parameter.name != "help":
                assert f"`{parameter.opts[0]}`" in section, f"{words}: {parameter.opts}"


def test_the_reference_has_every_key_of_a_scene() -> None:
    text = generated("scene")
    scene = load_scene("quickstart").resolved()
    tables = {name: table for name, table in scene.items() if isinstance(table, dict) and name != "faults"}
    keys = [(name, key) for name, table in tables.items() for key in table]
    assert len(keys) > 80
    for name, key in keys:
        section = text.partition(f"## `[{name}]`\n")[2].partition("\n## ")[0]
        own_table = re.search(rf"^## `\[+{name}\.{key}[].]", text, flags=re.MULTILINE)
        assert f"| `{key}` |" in section or own_table, f"{name}.{key}"


def test_the_notebook_holds_the_outputs_of_one_run_in_order() -> None:
    text = NOTEBOOK.read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    kinds = {output["output_type"] for cell in cells for output in cell["outputs"]}
    assert kinds == {"stream", "display_data"}  # no errors
    shown = notebooks.markdown(text)
    assert shown.count("](data:image/png;base64,") == 1
    assert "0 problems, digest" in shown
    assert len(text) < 300_000


def test_the_gallery_shows_every_figure() -> None:
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+\.png)\)", (DOCS / "gallery.md").read_text(encoding="utf-8"))
    figures = [
        *(ROOT / "scenes").glob("*.png"),
        *(ROOT / "scenes/studies").glob("*.png"),
        *DOCS.glob("figures/*.png"),
    ]
    assert sorted((DOCS / path).resolve() for path in shown) == sorted(figure.resolve() for figure in figures)


def test_figures_are_small() -> None:
    figures = {figure.name: figure.stat().st_size for figure in (DOCS / "figures").glob("*.png")}
    assert len(figures) >= 8
    assert not {name: size for name, size in figures.items() if size > blocks.MOST_BYTES}


# Numbers without a unit: counts, fractions, ratios, exponents, and coefficients of formulas.
_DIMENSIONLESS = """
    adc_bits airfall albedo_contrast angularity antiblooming apron asymmetry axis bands binning bits blade_rounding
    blades boulder_index bounces
    camera_axes classes_per_sample coefficients coherent_amplitude coherent_width column_pattern_freedom conic
    contour_scarps
    crater_depth crater_index dark_nonuniformity
    dead_fraction default_material distance_exponent dsnu_freedom dust_contrast eccentricity
    duty equilibrium exposure_stops f_number frames
    faulty_fraction fill_power gain gamma grain_albedo halo_index hot_clustered_fraction hot_offset_fraction
    hot_pixel_fraction hurst
    individuals
    intermittency internal_transmittance_10mm iso iso_power joints k leak limb log10_scale max_samples_per_pixel
    max_triangles max_tries max_views metering_delay_frames metering_level min_lit_fraction missing_codes n nadir
    nd neutral
    node_gains noise_fraction of_sunlight optical_depth ponds porosity_factor prnu prnu_column prnu_low prnu_row
    quantum_efficiency_peak random random_jet_strength random_jets reflectance relief roughness rts_per_interaction
    rts_fraction rubble samples samples_per_pixel scarps seed sequences shadow_hiding_amplitude shadow_hiding_width
    shard_samples sharpen shutter_transmission single_scattering_albedo site sites size_power slope_parameter smooth
    strata strength stretch stuck_bits stuck_fraction
    sun sun_facing_nominal_fraction sunlit_fraction test threshold_off threshold_on threshold_sigma tile train
    transmission
    trap_fraction val value variants_per_view vd wing_index
"""
# Names that OpenCV gives; the text behind them says which are in pixels and in radians.
_OF_OPENCV = "cx cy fx fy k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4 skew tau_x tau_y"


def test_every_number_of_the_reference_has_its_meaning_and_its_unit() -> None:
    described = [
        *reference.scene_tables(),
        *reference.tables(json_schema(PrescriptionFile)),
        *reference.tables(json_schema(Sensor)),
    ]
    # without the effects and ground reflectances of plug-ins, which other tests may have defined
    keys = {key.name: key for table in described if "[effects." not in table.header for key in table.keys}
    for cls in reflectances().values():
        if not cls.__module__.startswith("vbnfault."):
            keys = {name: key for name, key in keys.items() if name not in cls.__annotations__}
    assert len(keys) > 150
    assert not sorted(name for name, key in keys.items() if not key.meaning and name != "model")
    numbers = {name for name, key in keys.items() if re.search(r"number| to \d|above|at least", key.allowed)}
    assert len(numbers) > 100
    without = {name for name in numbers if not reference.unit_of(name)}
    assert without == {
        *_DIMENSIONLESS.split(),
        *_OF_OPENCV.split(),
    }  # a new one needs a unit at the end of its name, or a line here


def test_the_reference_has_every_fault_and_key() -> None:
    text = generated("faults")
    for fault_class, models in registry().items():
        for model, cls in models.items():
            section = text.partition(f"### {fault_class} / {model}")[2].partition("\n##")[0]
            assert section, (fault_class, model)
            for field in dataclasses.fields(cls):
                assert f"| `{field.name}` |" in section, (fault_class, model, field.name)


def test_the_reference_has_every_array_of_a_store(
    command: Callable[[list[str]], int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = generated("store")
    monkeypatch.chdir(tmp_path)
    assert command(["vbnfault", "build", "quickstart", "--out", "quickstart.zarr"]) == 0
    with vbnfault.open_dataset("quickstart.zarr") as data:
        arrays = [re.sub(r"^without_.*", "without_<fault>", str(name)) for name in data.data_vars]
    assert len(arrays) > 40
    assert not [name for name in arrays if f"| `{name}` |" not in text]


def test_the_reference_has_every_public_name() -> None:
    text = generated("api")
    assert not [n for n in vbnfault.__all__ if not n.startswith("__") and f":: vbnfault.{n}\n" not in text]
