"""What `import vbnfault` offers to Python."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.scene import config


def small(scene: str = "quickstart") -> vbnfault.Scene:
    """Return a packaged scene with few pixels and samples over coarse terrain."""
    values: dict[str, Any] = {
        "camera.width_px": 48,
        "camera.height_px": 40,
        "dataset.samples": 3,
        "dataset.sites": 1,
        "patch.facet_m": 12.0,
        "patch.radius_m": 60.0,
        "patch.min_boulder_m": 6.0,
        "plan.on_invisible": "drop",
    }
    return vbnfault.load_scene(scene, values)


def test_every_public_name_resolves_and_is_listed() -> None:
    homes: dict[str, str] = {}
    for block in ast.parse(Path(vbnfault.__file__).read_text()).body:
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            for line in block.body:
                assert isinstance(line, ast.ImportFrom)
                for name in line.names:
                    public = name.asname or name.name
                    module = line.module or f"{name.name}:"
                    homes[public] = module if public == name.name else f"{module}:{name.name}"
    assert homes == vbnfault._HOMES | {"study": "study.run", "inject": "inject"}
    for public in vbnfault.__all__:
        assert getattr(vbnfault, public) is vars(vbnfault)[public] is not None
    with pytest.raises(AttributeError, match="module 'vbnfault' has no attribute 'nothing'"):
        vbnfault.nothing  # noqa: B018


def test_the_package_lists_its_public_names() -> None:
    assert dir(vbnfault) == vbnfault.__all__
    assert vbnfault.build is vbnfault.dataset.build_scene  # a name of its own
    assert vbnfault.navigation is sys.modules["vbnfault.navigation"]  # a module
    assert callable(vbnfault.study)


def test_the_import_loads_nothing_but_itself() -> None:
    script = (
        "import sys; before = set(sys.modules); import vbnfault; "
        "print(sorted(m for m in set(sys.modules) - before if m.split('.')[0] not in sys.stdlib_module_names))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['vbnfault']"


def test_the_package_says_that_it_is_typed_and_which_version_it_is() -> None:
    assert (Path(vbnfault.__file__).parent / "py.typed").is_file()
    assert vbnfault.__version__.count(".") == 2
    done = subprocess.run(
        [sys.executable, "-m", "vbnfault", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["vbnfault", vbnfault.__version__]
    assert importlib.metadata.requires("vbnfault") is not None


def test_a_dataset_is_built_checked_and_opened(tmp_path: Path) -> None:
    scene = small()
    summary = vbnfault.build(scene, str(tmp_path / "s.zarr"))
    assert summary.built == 3
    report = vbnfault.verify(tmp_path / "s.zarr")
    assert report.problems == []
    assert report.digest == summary.digest
    with vbnfault.open_dataset(tmp_path / "s.zarr") as data:
        assert data["image"].dims == ("sample", "y", "x", "channel")
        assert data["image"].shape == (3, 40, 48, 4)
        alone = vbnfault.simulate(scene, 1)
        assert np.array_equal(alone.layers["image"], data["image"][1])
        assert np.array_equal(alone.layers["mask"], data["mask"][1])


def test_a_session_keeps_what_is_costly_and_gives_any_sample() -> None:
    session = vbnfault.Session(small())
    last, first = session.simulate(2), session.simulate(0)
    assert (last.index, first.index) == (2, 0)
    assert session.terrain(int(session.plan.site[0])) is session.terrain(int(session.plan.site[2]))


@pytest.mark.parametrize("index", [-1, 3, 1.0, np.float64(1), True, None, "1", [1], np.array([1])])
def test_a_session_refuses_what_is_no_sample_of_it(index: Any) -> None:
    with pytest.raises(InputError, match=r"scene: sample .*: must be a whole number from 0 to 2$"):
        vbnfault.Session(small()).simulate(index)


@pytest.mark.parametrize("threads", [0, -1, 1.5, "2", 10**6, True])
def test_a_session_refuses_a_number_of_threads_that_is_none(threads: Any) -> None:
    with pytest.raises(InputError, match=r"threads = .*: must be a whole number from 1 to 1024$"):
        vbnfault.Session(small(), threads=threads)


def test_numbers_of_numpy_and_paths_are_settings_as_those_of_python(tmp_path: Path) -> None:
    """A loop over numpy's arrays gives them; their type does not change the scene."""
    shape = tmp_path / "ball.obj"
    plain = {"dataset.samples": 3, "camera.fov_deg": 40.5, "patch.boulders": False, "body.shape": str(shape)}
    numpy = {
        "dataset.samples": np.int64(3),
        "camera.fov_deg": np.float32(40.5),
        "patch.boulders": np.bool_(False),
        "body.shape": shape,
        "geometry": {"height_m": np.array([5.0, 7.0]), "x_m": (np.float32(-1), np.int8(1))},
    }
    shape.write_text("v 0 0 0\n")
    want = vbnfault.load_scene("quickstart", {**plain, "geometry": {"height_m": [5.0, 7.0], "x_m": [-1.0, 1.0]}})
    assert vbnfault.load_scene("quickstart", numpy) == want
    with pytest.raises(InputError, match=r"camera\.fov_deg = 200\.0: must be a number from 0\.01 to 140"):
        vbnfault.load_scene("quickstart", {"camera.fov_deg": np.float32(200)})
    options = vbnfault.BuildOptions(workers=np.int32(2), threads=np.int64(1))
    assert (type(options.workers), options.workers, options.threads) == (int, 2, 1)
    with pytest.raises(InputError, match=r"--samples 2\.0: must be a whole number from 1"):
        vbnfault.build(small(), tmp_path / "s.zarr", samples=2.0)  # type: ignore[arg-type]
    summary = vbnfault.build(small(), tmp_path / "s.zarr", samples=np.int64(2), dry_run=True, progress=False)
    assert summary.samples == 2


def test_a_misspelt_name_and_one_without_its_ending_get_a_suggestion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^quickstrt: neither .* name \(did you mean quickstart\?\); scenes: "):
        vbnfault.load_scene("quickstrt")
    Path("a.toml").write_text('title = "mine"\n')
    with pytest.raises(InputError, match=r"^a: neither .* name \(did you mean a\.toml\?\); scenes: "):
        vbnfault.load_scene("a")
    with pytest.raises(InputError, match=r"^zzz: neither a file nor a packaged name; lenses: "):
        vbnfault.load_lens("zzz")


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda out: vbnfault.simulate(small(), 3), "sample 3: must be a whole number from 0 to 2"),
        (lambda out: vbnfault.load_scene("nowhere"), "nowhere"),
        (lambda out: vbnfault.open_dataset(out), r"s\.zarr: no such store"),
        # a text is a sequence, too: its letters would be taken for stores
        (lambda out: vbnfault.merge("a.zarr", out), r"stores = 'a\.zarr': must be a list of stores"),
        (
            lambda out: vbnfault.load_scene("quickstart", ["camera.fov_deg=3"]),
            r"overrides = \['camera.fov_deg=3'\]: must be a table of dotted keys",
        ),
        (lambda out: vbnfault.load_scene("quickstart", {5: 3}), "5 = 3: the key must be a text"),
        (lambda out: vbnfault.build(small(), out, {"workers": 2}), r"options = \{'workers': 2\}: must be BuildO"),
        (lambda out: vbnfault.retake("a.zarr", small(), out, 2), "options = 2: must be BuildOptions$"),
        (
            lambda out: vbnfault.Session("quickstart"),
            r"scene = 'quickstart': must be a Scene, as vbnfault\.load_sc",
        ),
    ],
)
def test_what_is_wrong_is_named(wrong: Callable[[Path], object], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=sentence):
        wrong(tmp_path / "s.zarr")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", [None, 3, b"x", []])
def test_what_is_no_path_is_refused_in_a_sentence(tmp_path: Path, path: Any) -> None:
    calls: list[Callable[[], object]] = [
        lambda: vbnfault.build(small(), path, dry_run=True, progress=False),
        lambda: vbnfault.build(path, tmp_path / "s.zarr", dry_run=True, progress=False),
        lambda: vbnfault.retake(tmp_path / "s.zarr", small(), path),
        lambda: vbnfault.verify(path),
        lambda: vbnfault.load_lens(path),
        lambda: vbnfault.merge([path], tmp_path / "s.zarr"),
        lambda: vbnfault.merge(["s.zarr"], path),
    ]
    if path is not None:  # which keeps nothing of a study
        calls.append(lambda: vbnfault.study("flare_models", path))
    for call in calls:
        with pytest.raises(InputError, match=f"= {re.escape(repr(path))}: must be a path$"):
            call()
    if path is None:
        with pytest.raises(InputError, match="stores = None: must be a list of stores"):
            vbnfault.merge(path, tmp_path / "s.zarr")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"shard_range": (0, 1)}, r"shard_range = \(0, 1\): must be an instance of range"),
        ({"shard_range": range(0, 4, 2)}, r"shard_range = range\(0, 4, 2\): must be a range of steps of 1"),
        ({"overwrite": "never"}, "overwrite = 'never': must be true or false"),  # a text that is not empty is true
        ({"overwrite": "yes"}, "overwrite = 'yes': must be true or false"),
        ({"workers": True}, "workers = True: must be a whole number"),
        ({"workers": "2"}, "workers = '2': must be a whole number"),
        ({"dry_run": 2}, "dry_run = 2: must be true or false"),
        ({"recycle_shards": None}, "recycle_shards = None: must be a whole number of at least 1"),
        ({"scheduler": 8786}, "scheduler = 8786: must be a string"),
        ({"append": 1.5}, r"--append 1\.5: must be at least 1, and a whole number"),
        ({"workers": 5000}, "workers = 5000: must be a whole number from 1 to 1024"),
        ({"threads": 0}, "threads = 0: must be a whole number from 1 to 1024"),
        ({"workers": 2, "scheduler": "tcp://a:1"}, "--workers 2 and --scheduler tcp://a:1 exclude each other"),
        ({"shard_range": range(2, 2)}, "--shard-range 2:2: must be A:B, whole numbers with 0 <= A < B"),
        ({"shard_range": range(-1, 2)}, "--shard-range -1:2: must be A:B"),
        ({"shard_range": range(1), "overwrite": True}, "--shard-range and --overwrite exclude each other"),
    ],
)
def test_options_of_a_build_are_checked(tmp_path: Path, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        vbnfault.build(small(), tmp_path / "s.zarr", **{"dry_run": True, "progress": False, **options})


def test_lens_sensor_and_flare_are_at_hand() -> None:
    lens = vbnfault.load_lens("tessar_50_f2p8")
    flare = vbnfault.trace_flare(lens, 20.0, wavelength_nm=550.0, pixels=32, fov_deg=40.0)
    assert set(flare.layers) == {"sun", "ghosts", "starburst", "glare", "veil"}
    assert flare.layers["ghosts"].shape == (1, 32, 32)
    n = len(lens.surfaces)
    assert len(flare.ghosts) <= n * (n - 1) // 2
    assert all(ghost.flux_fraction >= 0 for ghost in flare.ghosts)
    texture = vbnfault.trace_flare(lens, 20.0, model="texture", pixels=32)
    assert texture.ghosts == ()
    sensor = vbnfault.load_sensor("rosetta_navcam")
    assert sensor.height_px > 0


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ({"sun_deg": 90.0}, "sun_deg = 90"),
        ({"sun_deg": float("nan")}, "sun_deg = nan: must be from 0 to 90"),
        ({"sun_deg": "16"}, "sun_deg = '16': must be from 0 to 90, and a number"),
        ({"sun_deg": 16, "pixels": 128.5}, "pixels = 128.5: must be a whole number"),
        (
            {"sun_deg": 16, "wavelength_nm": [550, 600]},
            r"wavelength_nm = \[550, 600\]: must be from 250 to 2500, a",
        ),
        ({"sun_deg": 10.0, "pixels": 5}, "pixels = 5: must be from 16 to 4096"),
        ({"sun_deg": 10.0, "model": "painted"}, "model = 'painted': must be one of"),
        ({"sun_deg": 10.0, "reflections": 3}, "reflections = 3: must be 2 or 4"),
        ({"sun_deg": 10.0, "wavelength_nm": 20.0}, "20: must be from 250 to 2500"),
        ({"sun_deg": -1.0}, "sun_deg = -1: must be from 0 to 90"),
        ({"sun_deg": 10.0, "roughness_nm": -1.0}, "roughness_nm = -1: must be from 0 to 50"),
        ({"sun_deg": 10.0, "cleanliness_level": -3.0}, "cleanliness_level = -3: must be from 0 to 1000"),
    ],
)
def test_a_flare_refuses_what_the_physics_does_not_take(setting: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        vbnfault.trace_flare("tessar_50_f2p8", **setting)


def test_the_field_helpers_make_a_fault() -> None:
    import dataclasses

    from vbnfault.core.registry import undoing_registrations
    from vbnfault.faults import from_dict

    with undoing_registrations(always=True):

        @dataclasses.dataclass(frozen=True, kw_only=True)
        class Tint(vbnfault.Fault):
            """A fault of a user."""

            fault = "tint"
            model = "plain"
            default = True
            after = "dust_on_optics"
            step = "electrons"
            strength: vbnfault.Interval = vbnfault.bounds(0.1, 0.9, limits=(0, 1), doc="fraction of light lost")  # noqa: RUF009

        assert Tint().strength == (0.1, 0.9)
        assert from_dict("tint", {"strength": 0.5}, source="a scene").strength == (0.5, 0.5)  # type: ignore[attr-defined]
        with pytest.raises(InputError, match=r"a scene: faults.tint.strength = 2"):
            from_dict("tint", {"strength": 2.0}, source="a scene")
    assert config.Scene is vbnfault.Scene
