"""The command line: real scenes are built, resumed, verified and rendered; mistakes, help and options."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import typer.main
from conftest import Called, small_scene
from tools import victim
from typer.testing import CliRunner

from vbnfault import cli, pipeline, store
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Sample
from vbnfault.output import sample_files
from vbnfault.output.flare_images import RANGES
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.spec import Frame

Call = Callable[..., Called]
ENVIRONMENT = {**os.environ, "PYTHONWARNINGS": "error::UserWarning"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    path.write_text(tomli_w.dumps(small_scene(dataset={"samples": 8, "shard_samples": 2, "sites": 4})))
    return path


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The command in this process; its exit code."""
    monkeypatch.setattr(sys, "argv", ["vbnfault", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "vbnfault", *map(str, arguments)]


@pytest.fixture(scope="module")
def built(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference store: one process, two threads, nothing interrupted."""
    out = tmp_path_factory.mktemp("built") / "reference.zarr"
    told, summary = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stderr(told),
        contextlib.redirect_stdout(summary),
    ):
        code = run(patch, "build", scene, "--out", out, "--threads", 2)
    assert code == 0, told.getvalue()
    said = told.getvalue().splitlines()
    assert said[0].startswith(f"{out}: 8 samples at 4 sites in 4 shards, about ")
    assert any(line.startswith("estimated time: ") for line in said)
    for stage in ("shape of the body", "compiling of kernels, with the first sample"):
        assert said.count(stage) == 1
    assert {f"terrain of site {k}" for k in range(4)} <= set(said)
    assert summary.getvalue().splitlines()[-1] == f"digest {store.digest(out)}"
    return out


def test_a_build_is_whole_and_labelled(built: Path, call: Call) -> None:
    said = call("verify", built)
    assert (said.code, said.err) == (0, "")  # without a terminal no bar
    assert "8 samples, whole, labelled and as planned" in said.out
    # the counts are those of the arrays, not those of the plan
    opened = store.open_store(built)
    injected = opened.read("injected")
    rows = {line.split()[0]: line.split() for line in said.out.splitlines() if line}
    proposals = [json.loads(str(text))["injected"] for text in opened.read("proposal")]
    for k, fault in enumerate(opened.spec.faults):
        assert int(rows[fault][1]) == sum(fault in names for names in proposals)
        assert int(rows[fault][2]) == injected[:, k].sum()
    digest = store.digest(built)
    assert call("digest", built).out.strip() == digest
    assert f"digest {digest}" in said.out


def test_products_of_matrices_use_one_thread_unless_the_user_says_otherwise() -> None:
    """The variable is set before numpy is imported, or OpenBLAS would not read it."""
    code = (
        "import os, sys, vbnfault.cli; app = sys.modules['vbnfault.cli.app']\n"
        "app._exit_code = lambda: print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS']) or 0\n"
        "app.main()"
    )
    others = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    for given, used in (({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")):
        done = subprocess.run([sys.executable, "-c", code], env=others | given, capture_output=True, text=True)
        assert done.stdout.split() == ["False", used], done.stderr


def test_the_digest_depends_on_no_workers_or_threads(
    built: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone, shared = tmp_path / "alone.zarr", tmp_path / "shared.zarr"
    assert run(monkeypatch, "build", scene, "--out", alone, "--workers", 1, "--threads", 1) == 0
    assert store.digest(alone) == store.digest(built)
    monkeypatch.setenv("PYTHONWARNINGS", ENVIRONMENT["PYTHONWARNINGS"])  # of the workers
    assert run(monkeypatch, "build", scene, "--out", shared, "--workers", 2, "--threads", 1) == 0
    assert store.digest(shared) == store.digest(built)


def test_a_rendered_sample_equals_the_stored_one(
    built: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2
    import OpenEXR

    def without_a_number(frame: Frame) -> Sample:
        sample = to_sample(frame)
        return replace(sample, scalars={**sample.scalars, "noise_fraction_p99": float("nan")})

    monkeypatch.setattr(sample_files, "to_sample", without_a_number)
    layers = 'dataset.layers=["clean", "dust_opacity"]'
    assert run(monkeypatch, "render", scene, "--sample", 5, "--out", tmp_path, "--set", layers) == 0
    stored = store.open_store(built).read_sample(5)
    image = cv2.imread(str(tmp_path / "image.png"))[..., ::-1]
    assert np.array_equal(image, stored.layers["image"][..., :3])
    assert np.array_equal(
        cv2.imread(str(tmp_path / "image_intensity.png"), cv2.IMREAD_UNCHANGED),
        stored.layers["image"][..., 3],
    )
    names = store.open_store(built).spec.faults
    for k, name in enumerate(names):
        mask = cv2.imread(str(tmp_path / f"mask_{name}.png"), cv2.IMREAD_UNCHANGED) > 0
        assert np.array_equal(mask, stored.layers["mask"][k])
    soft = {"dust_on_optics": "dust_opacity", "straylight": "straylight_added", "vignetting": "vignetting_factor"}
    drawn = {name for name, on in zip(names, stored.scalars["injected"], strict=True) if on}
    for name, layer in soft.items():
        assert (tmp_path / f"{layer}.png").exists() == (name in drawn or layer == "dust_opacity")
    # NaN and Infinity, which Python also reads, are not JSON
    scalars = json.loads((tmp_path / "parameters.json").read_text(), parse_constant=pytest.fail)
    assert scalars["noise_fraction_p99"] is None
    assert scalars["exposure_s"] == stored.scalars["exposure_s"]
    with OpenEXR.File(str(tmp_path / "sample.exr"), separate_channels=True) as exr:
        channels = exr.channels()
        assert np.array_equal(channels["depth.Z"].pixels, stored.layers["depth_m"])
        assert sum(name.startswith("radiance.") for name in channels) == 8
        assert channels["dust_opacity"].pixels.dtype == np.float16
        dusty = dict(zip(names, stored.scalars["injected"], strict=True))["dust_on_optics"]
        assert channels["dust_opacity"].pixels.any() == dusty


def test_the_digest_survives_an_interrupt_and_a_kill(
    scene: Path, built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C after the first shard, kill -9 at a file operation while terrain is kept, rendered or written."""
    out = tmp_path / "stopped.zarr"
    landed = victim.step("write", text="done/c/", number="SIGINT")
    stopped = victim.run(["cli", "build", scene, "--out", out], main=[landed])
    assert stopped.returncode == 130, stopped.stderr
    last = stopped.stderr.splitlines()[-1]
    assert last.endswith("interrupted; 2 of 8 samples are finished, and the same command resumes")
    assert "Traceback" not in stopped.stderr
    # after a shard that is new: so that the kill finds the store further on
    steps = [victim.step("write", text="done/c/", number="SIGCONT")]
    steps.append(victim.step("write", count=int(np.random.default_rng(5).integers(1, 120))))
    killed = victim.run(["cli", "build", scene, "--out", out], main=steps)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert 2 <= store.open_store(out).finished() < 8
    assert run(monkeypatch, "build", scene, "--out", out) == 0
    assert store.digest(out) == store.digest(built)
    assert store.examine(out).problems == []
    assert not list(out.rglob("*.partial"))


def test_the_real_shape_is_67ps(real_shape: Path) -> None:
    from vbnfault.scene import config
    from vbnfault.world import assemble

    for settings in ({}, {"body.shape": str(real_shape)}):
        scene = config.load_scene("quickstart", settings)
        assert assemble.values_of_another_body(scene, assemble.make_body(scene)) == ""


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("build quickstart --out x.zarr --set camera.fov_deg=0", "camera.fov_deg = 0"),
        ("build quickstart --out x.zarr --set faults.dust.count=3", "faults.dust"),
        ("build quickstart --out x.zarr --set faults.straylight.model=nope", "faults.straylight.model"),
        ("build quickstart --out x.zarr --set body.shape=absent.obj", "absent.obj"),
        ("build quickstart --out file/x.zarr", "file is a file, not a folder"),
        ("render quickstart --out file/x", "file/x: cannot be written: Not a directory"),
        (
            "flare tessar_50_f2p8 --sun-deg 12 --model texture --pixels 16 --out folder.exr",
            "folder.exr: cannot be written: Is a directory",
        ),
        (
            "flare nikkor_35_f2p8 --sun-deg 10 --out f.png --json no/f.json",
            "--json no/f.json: must be in a folder that exists",
        ),
        ("lens nikkor_35_f2p8 --toml no/l.toml", "--toml no/l.toml: must be in a folder that exists"),
        ("detector generic_cmos --out file", "file: cannot be written: it is a file, not a folder"),
        ("lens scene.toml", ": unknown keys; known: name"),
        # its cos⁴ vignetting would be refused with any lens
        (
            "describe paper67p --set camera.lens=nikor_35_f2p8",
            "camera.lens: nikor_35_f2p8: neither a file nor a packaged name (did you mean nikkor_35_f2p8?)",
        ),
        ("list", "must be one of scenes, bodies, lenses, detectors, studies, benchmarks, faults, effects, reflect"),
        ("list cameras", "must be one of scenes, bodies, lenses"),
        ("schema body", "must be one of scene, lens, sensor, study"),
    ],
)
def test_a_mistake_is_one_sentence_before_the_work(
    arguments: str, sentence: str, scene: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pipeline.Session, "frame", lambda *_: pytest.fail("rendered"))
    Path("file").touch()
    Path("folder.exr").mkdir()
    shutil.copy(scene, "scene.toml")
    refused = call(*arguments.split())
    assert (refused.code, refused.out) == (2, "")
    assert sentence in refused.said
    assert all(line.startswith(("vbnfault:", "warning:")) for line in refused.err.splitlines())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.exr", "scene.toml"]


def test_another_scene_is_refused_and_named(built: Path, scene: Path, call: Call) -> None:
    before = store.digest(built)
    refused = call("build", scene, "--out", built, "--set", "camera.fov_deg=40")
    assert refused.code == 2
    assert re.search(r"fov_deg.*65.* store and 40", refused.said)
    assert store.digest(built) == before


def test_no_usable_llvm_is_one_sentence_and_no_abort(scene: Path, tmp_path: Path) -> None:
    """Only LLVM 14 in sight: a sentence, whatever the machine has."""
    program = (
        "import sys; from pathlib import Path; from vbnfault import cli; from vbnfault.core.process import llvm\n"
        f"old = Path({str(tmp_path / 'libLLVM-14.so.1')!r}); old.write_bytes(b'')\n"
        "llvm._paths = lambda: iter([('system', old)])\n"
        f"sys.argv = ['vbnfault', 'build', {str(scene)!r}, '--out', {str(tmp_path / 'x.zarr')!r}]\n"
        "cli.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1
    assert "no usable LLVM" in done.stderr
    assert "version 14" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_commands_print_what_is_there(scene: Path, tmp_path: Path, call: Call) -> None:
    for arguments, text in (
        ("list scenes", "quickstart"),
        ("list lenses", "tessar_50_f2p8"),
        ("list studies", "flare_models"),
        ("list faults", "straylight / texture (default model)\n"),
        ("list bodies", "bennu    asteroid Bennu, the target of OSIRIS-REx"),
        ("list detectors", "rosetta_navcam   Rosetta NAVCAM: 1024 x 1024 px, monochrome\n"),
        ("list effects", "\nfull_well               Limit the charge of each pixel to the full well.\n"),
        ("list reflectances", "\n    phase_slope_mag_deg = 0.0    fading with phase angle"),
        ("list glasses", "N-BK7   nd 1.51680  Abbe number 64.17  formula sellmeier\n"),
        ("doctor", "as it should be"),
        (f"build {scene} --out {tmp_path / 'x.zarr'} --dry-run", "8 samples"),
    ):
        done = call(*arguments.split())
        assert (done.code, text in done.out) == (0, True), arguments
    for kind, key in (("scene", "faults"), ("lens", "surface"), ("sensor", "readout")):
        assert key in json.loads(call("schema", kind).out)["properties"]
    assert not (tmp_path / "x.zarr").exists()


def test_a_flare_is_a_table_and_a_picture(tmp_path: Path, call: Call) -> None:
    picture, ghosts = tmp_path / "flare.png", tmp_path / "ghosts.json"
    options = ("--sun-deg", 12, "--model", "paraxial", "--pixels", 64, "--out", picture, "--json", ghosts)
    done = call("flare", "tessar_50_f2p8", *options)
    assert (done.code, done.err) == (0, "")  # without a terminal no bar
    table = json.loads(ghosts.read_text())
    assert f"{len(table['ghosts'])} ghosts hold" in done.out
    assert len(table["wavelength_nm"]) == 8
    assert picture.stat().st_size > 1000
    level = re.search(r"white level (\S+); --white \1 gives", done.out)
    assert level
    bright = picture.read_bytes()
    dimmed = call("flare", "tessar_50_f2p8", *options, "--white", 10 * float(level[1]), "--veil-fraction", 0)
    assert (dimmed.code, "white level" in dimmed.out) == (0, False)
    assert picture.read_bytes() != bright


def test_help_imports_little() -> None:
    """0.3 s of computing where others are not at work; imports are counted, since a clock also counts them."""
    program = (
        "import atexit, json, sys; from vbnfault import cli; sys.argv = ['vbnfault', '--help']\n"
        "atexit.register(lambda: print(json.dumps(sorted(sys.modules)), file=sys.stderr)); cli.main()\n"
    )
    started = [sys.executable, "-c", program]
    done = subprocess.run(started, env=ENVIRONMENT, check=True, capture_output=True, text=True)
    assert "render" in done.stdout
    modules = json.loads(done.stderr)
    packages = {module.partition(".")[0] for module in modules}
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    declared = {re.split(r"[\[>=<;]", line)[0].lower() for line in project["dependencies"]}
    imported = {"opencv-python-headless": "cv2", "colour-science": "colour", "scikit-image": "skimage"}
    heavy = {imported.get(name, name) for name in declared} - {"typer", "rich"}
    assert {"numpy", "mitsuba", "zarr", "cv2", "matplotlib", "pydantic"} <= heavy
    assert not heavy & {package.lower() for package in packages}
    assert "vbnfault.scene.config" not in modules
    assert len(modules) < 700  # 420 today


def test_the_real_shape_builds(
    real_shape: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "real.zarr"
    options = ("--set", f"body.shape={real_shape}", "--samples", 2)
    assert run(monkeypatch, "build", scene, "--out", out, *options) == 0
    assert store.examine(out).problems == []


# --- options: their help is complete, and each is tried by some test ----------------------------------------------


COMMANDS: dict[str, Any] = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]


def options() -> Iterator[tuple[str, Any]]:
    """Yield (command, option) of every option but `--help`."""
    for name, command in COMMANDS.items():
        for option in command.params:
            if option.param_type_name == "option" and "--help" not in option.opts:
                yield name, option


def limits(option: Any) -> tuple[float, float] | None:
    """The least and the largest number that an option takes, as its help says them; None if it takes no number."""
    found = re.fullmatch(r"(?:INTEGER|NUMBER) \((\S+) to (\S+)\)", option.metavar or "")
    return (float(found[1]), float(found[2])) if found else None


@cache
def help_of(command: str) -> str:
    """The help of a command as one line of words, without the frame around its tables."""
    shown = CliRunner().invoke(cli.app, [command, "--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"})
    assert shown.exit_code == 0
    return re.sub(r"[│\s]+", " ", shown.output)


def test_help_shows_the_text_and_the_default_of_every_option() -> None:
    seen = 0
    for command, option in options():
        text = help_of(command)
        assert option.help, (command, option.name)
        assert option.help[-1] == ".", (command, option.name)
        assert option.help in text, (command, option.name)  # a [word] would be taken for markup
        if isinstance(option.show_default, str):
            seen += 1
            assert f"{option.help} [default: ({option.show_default})]" in text, (command, option.name)
        elif option.default is not None and option.default is not False and not option.required:
            seen += 1
            word = option.name if option.default is True else option.default
            assert f"{option.help} [default: {word}]" in text, (command, option.name)
    assert seen > 30


def test_help_shows_every_word_of_a_commands_text() -> None:
    for name, command in COMMANDS.items():
        assert " ".join(command.help.split()) in help_of(name), name  # a [word] would be taken for markup


def test_a_number_without_a_default_says_what_holds_instead() -> None:
    counts = {"append"}  # nothing is appended without it
    for command, option in options():
        if option.default is None and not option.required and limits(option):
            assert isinstance(option.show_default, str) or option.name in counts, (command, option.name)


def test_the_flares_options_have_the_limits_of_the_library() -> None:
    flare = [option for name, option in options() if name == "flare"]
    found = {option.name: limits(option) for option in flare if limits(option)}
    for name, low, high in RANGES:
        assert found.pop(name) == (low, high), name
    assert set(found) == {"wavelength_nm", "focal_length_mm", "sensor_width_mm", "reflections"}


def test_a_number_that_is_none_is_refused_in_a_sentence_with_the_limits() -> None:
    result = CliRunner().invoke(cli.app, ["describe", "quickstart", "--samples", "1e3"], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert "Invalid value for '--samples': '1e3' must be a whole number from 1 to 10000000" in result.output


def test_a_path_to_write_is_no_url() -> None:
    """A path `s3://bucket/x` would make a folder `s3:` here."""
    stores = ("build", "merge", "retake", "migrate")  # their --out may be a URL, or is checked with the store
    seen = 0
    for command, option in options():
        if option.name in ("out", "json_", "toml") and command not in stores and not option.is_flag:
            for url in ("s3://bucket/x.png", "file:///data/x"):
                shown = CliRunner().invoke(cli.app, [command, option.opts[0], url])
                assert isinstance(shown.exception, InputError), (command, option.name)
                start = f"{option.opts[0]} {url.split(':')[0]}://"
                assert re.fullmatch(rf"{start}.*: is a URL; must be a path on this machine", str(shown.exception))
            for path, sentence in (
                (" ", "must be a path, and not empty"),
                ("/", "is the root folder; choose a folder"),
            ):
                refused = CliRunner().invoke(cli.app, [command, option.opts[0], path], env={"COLUMNS": "200"})
                assert (refused.exit_code, sentence in refused.output) == (2, True), (command, option.name)
            seen += 1
    assert seen == 22
    assert not Path("s3:").exists()


def test_every_option_is_named_in_a_test() -> None:
    texts = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.rglob("*.py"))
    missing = []
    for command, option in options():
        for name in option.opts:
            if not re.search(rf"{re.escape(name)}(?![\w-])", texts):
                missing.append(f"{command} {name}")
    assert not missing
