"""Every declared key of every fault model acts, and a file that cannot be used is named with its key."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from test_faults_kit import make_context, noisy, with_mosaic
from typer.testing import CliRunner

from vbnfault import cli
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Electrons, Radiance
from vbnfault.detector import MosaicDetector
from vbnfault.faults import Fault, FaultContext, from_dict, path_fields, registry
from vbnfault.pipeline import masks

SIZE = 64
KEYS = [
    (fault, model, f.name)
    for fault, models in registry().items()
    for model, cls in models.items()
    for f in dataclasses.fields(cls)
]
# What keys need beside them to be seen: other keys of the class, or of one key, that give it something to do.
COMPANIONS: dict[tuple[str, str], dict[str, Any]] = {
    ("straylight", "baffle_length_mm"): {"baffle_radius_mm": 1.0},
    ("straylight", "baffle_radius_mm"): {"baffle_length_mm": 30.0},
    ("straylight", "scene_diffraction"): {"sources": "scene"},
    ("dust_on_optics", "window_height_mm"): {"surface": -2},
    ("dust_on_optics", "mask_loss"): {"diameter_um": 20.0},
    ("dust_on_optics", "cover"): {"diameter_um": 20.0},
    ("dust_on_optics", "cover_um"): {"cover": 0.3, "diameter_um": 20.0},
    ("straylight", "shadow_depth"): {"shadow_chance": 1.0},
    ("straylight", "shadow_softness"): {"shadow_chance": 1.0},
    ("transmission", "sync_rows"): {"fill": "shifted"},
    ("transmission", "cut_every"): {"cut_rows": 8},
    ("broken_pixels", "clustered_fraction"): {"years": 20.0},
    ("optics_degradation", "filter_size_px"): {"scale_with_resolution": False},
    ("broken_lines", "saturated_weight"): {"count": 20},
    ("broken_lines", "duplicated_weight"): {"count": 20},
    ("pixel_overwriting", "strength"): {"blend": "mixture"},
    ("particles", "farthest_m"): {"nearest_m": 0.05},
    ("persistence", "shift_px"): {"source": "frame"},
    ("persistence", "exposure_factor"): {"source": "frame"},
}
# A packet is by default half of the small picture; a small picture shows few grains, and before the Sun only their
# night sides.
CLASS_KEYS: dict[str, dict[str, Any]] = {
    "transmission": {"packet_px": 64},
    "particles": {"density_per_m3": 100.0, "phase_slope_mag_deg": 0.0},
}
ARCHITECTURES = {
    "leak": "interline_ccd",
    "shutter_fraction": "full_frame_ccd",
    "lines_at_once": "cmos",
    "saturated_weight": "cmos",
    "duplicated_weight": "cmos",
}
# Of few surfaces, so that all paths are soon traced.
SINGLET = """
surface = [
  { radius_mm = 60.0, thickness_mm = 4.0, nd = 1.6, vd = 45.0, diameter_mm = 16.0 },
  { radius_mm = -60.0, thickness_mm = 2.0, diameter_mm = 16.0 },
  { stop = true, thickness_mm = 0.0, diameter_mm = 10.0 },
]
"""


def values(f: dataclasses.Field[Any], files: list[str]) -> list[Any]:
    """Values of a key to compare, the most usual first, from its declaration alone."""
    meta = f.metadata
    kind = meta["kind"]
    if kind == "flag":
        return [True, False]
    if kind == "choice":
        return list(meta["options"])
    if kind in ("text", "path"):
        return {"channels": ["RGBI", "R"], "lens": [files[2], "tessar_50_f2p8"]}.get(f.name, files[:2])
    if kind == "paths":
        return [[], files[:1], files[:2]]
    if kind == "rows":
        return [[], [{k: float(np.ceil(lo + 0.05 * (hi - lo))) for k, (lo, hi) in meta["columns"].items()}]]
    lo, hi = meta["limits"]
    if kind == "bounds":
        a, b = f.default  # type: ignore[misc]
        found = [a, b, a + 1e-4 * (hi - a), hi]
    else:
        first = lo if f.default is None else f.default
        found = [first, 0.5 * first, first + 1, first + 2, lo, 30 * first, hi]
    found = [v for v in found if lo <= v <= hi]
    return list(dict.fromkeys(int(v) for v in found)) if meta["integer"] else list(dict.fromkeys(found))


def context(fault: Fault, key: str) -> FaultContext:
    architecture = ARCHITECTURES.get(key, "frame_transfer_ccd")
    made = make_context(SIZE, sun_xy_px=(40.0, 24.0), exposure_s=1e-3, architecture=architecture)
    nodes = spectra.band_nodes_nm(400.0, 700.0, 3)
    made = replace(
        made,
        sun_direction_C=np.array([0.091, -0.091, 0.9917]),
        wavelength_nm=nodes,
        sun_irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0),
        sun_angular_radius_rad=spectra.sun_angular_radius_rad(1.0),
        radiance=Radiance(array=np.full((3, SIZE, SIZE), 10.0, np.float32), wavelength_nm=nodes),
    )
    # long enough for dark current
    if not fault.needs_mosaic:
        return made
    made = with_mosaic(replace(made, camera=replace(made.camera, exposure_s=20.0)))
    assert isinstance(made.camera.detector, MosaicDetector)
    sensor = made.camera.detector.sensor
    # a key may need several nodes, or a drain that can fail
    readout = replace(sensor.readout, nodes=2 if key == "node_chance" else sensor.readout.nodes)
    transfer = replace(sensor.transfer, antiblooming=0.5 if made.camera.is_ccd else 0.0)
    detector = replace(made.camera.detector, sensor=replace(sensor, readout=readout, transfer=transfer))
    return replace(made, camera=replace(made.camera, detector=detector))


def outcome(table: dict[str, Any], name: str, key: str) -> list[NDArray[Any]]:
    """What a key may act on: the quantity, the altered camera's device, masks and defects."""
    fault = from_dict(name, table, source="test.toml")
    where = context(fault, key)
    params = fault.draw(where, np.random.default_rng(5))
    camera = fault.alter(where.camera, params)
    where = fault.inform(where, params)
    before: Any = noisy(fault.step, where)
    after: Any
    if isinstance(before, Electrons):
        after = fault.on_light(before, params, where).merged
        found = [after.array]
    else:
        found = [fault.apply_at(step, noisy(step, where), params, where).array for step in fault.steps]  # type: ignore[type-var]
    if camera != where.camera and isinstance(camera.detector, MosaicDetector):
        found.append(np.frombuffer(repr(camera.detector).encode(), dtype=np.uint8))
    if fault.effect_mask and isinstance(before, Electrons):
        one, other = (where.camera.detector.develop(q, 1e-3, None).array for q in (after, before))
        found.append(masks.effect(one, other, fault.effect_level_dn))
    else:
        mask = fault.footprint(params, where)
        found.append(np.zeros(0) if mask is None else mask)
    defects = fault.defects(params, where)
    return [*found, np.zeros(0) if defects is None else defects]


def same(one: list[NDArray[Any]], other: list[NDArray[Any]]) -> bool:
    return len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two different textures, and a lens."""
    folder = tmp_path_factory.mktemp("files")
    lens = folder / "singlet.toml"
    lens.write_text(SINGLET, encoding="utf-8")
    paths: list[Path] = [folder / f"{k}.png" for k in range(2)]
    for k, path in enumerate(paths):
        picture = np.random.default_rng(k).integers(0, 256, (40, 50, 4), dtype=np.uint8)
        picture[:20, :, 3] = 0
        assert cv2.imwrite(str(path), picture)
    return [str(path) for path in (*paths, lens)]


@pytest.mark.parametrize(("name", "model", "key"), KEYS)
def test_every_key_acts_on_pixels_or_masks(name: str, model: str, key: str, files: list[str]) -> None:
    fields = {f.name: f for f in dataclasses.fields(registry()[name][model])}
    base = {"model": model, "texture_file": files[0], "lens": files[2]}
    base |= CLASS_KEYS.get(name, {}) | COMPANIONS.get((name, key), {})
    base = {k: v for k, v in base.items() if k in fields or k == "model"}
    first: list[NDArray[Any]] | None = None
    tried = values(fields[key], files)
    for value in tried:
        try:
            found = outcome(base | {key: value}, name, key)
        except InputError:  # it contradicts another key
            continue
        if first is not None and not same(first, found):
            return
        first = found if first is None else first
    pytest.fail(f"{name}.{key}: all of {tried!r} give the same pixels and masks")


@pytest.mark.parametrize("model", ["traced", "paraxial"])
def test_keys_of_straylight_work_together(model: str, files: list[str], tmp_path: Path) -> None:
    """Reflections, coatings, a baffle and a sensor that reflects: no failure, and light as physics orders it."""
    mirror = tmp_path / "mirror.toml"
    mirror.write_text(SINGLET.replace("\n]", "\n  { sensor = true, reflectance = 0.1 },\n]"), encoding="utf-8")

    def ghosts(**keys: Any) -> float:
        fault = from_dict(
            "straylight",
            {"model": model, "veil_fraction": 0.0, "roughness_nm": 0.0, "cleanliness_level": 0.0} | keys,
            source="test.toml",
        )
        where = context(fault, "")
        params = fault.draw(where, np.random.default_rng(0))
        black = Electrons(array=np.zeros((SIZE, SIZE, 3), np.float32), white_e=where.camera.detector.white_e)
        light = fault.on_light(black, params, where)
        assert np.isfinite(light.merged.array).all()
        assert (light.merged.array >= 0).all()
        return float(light.merged.array.sum(dtype=np.float64))

    two = {c: ghosts(lens=files[2], coating=c) for c in ("as_prescribed", "none", "mgf2", "v", "bbar")}
    assert two["as_prescribed"] == two["none"]  # the file names no coating
    assert max(two["mgf2"], two["v"], two["bbar"]) < two["none"]
    four = {c: ghosts(lens=files[2], coating=c, reflections=4) for c in ("none", "mgf2")}
    assert all(four[c] >= two[c] for c in four)
    # the singlet sends the sensor's ghosts of this Sun past the frame: no light is lost
    assert ghosts(lens=str(mirror), coating="none") >= two["none"]
    assert ghosts(lens=str(mirror), coating="mgf2", reflections=4) >= two["mgf2"]
    # of a tube as wide as the lens, and of one that is narrower
    assert ghosts(lens=files[2], baffle_length_mm=1e4, baffle_radius_mm=1.0) < 1e-3 * two["none"]
    assert ghosts(lens=files[2], baffle_length_mm=1e4, baffle_radius_mm=1e-3) < 1e-3 * two["none"]


# --- files that a scene names -------------------------------------------------------------------------------------


# Key → suffix of the file, and the lines of a scene that name it.
FILES = {
    "body.shape": ("obj", '[body]\nshape = "{}"'),
    "body.albedo_map.file": ("png", '[body.albedo_map]\nfile = "{}"'),
    "spacecraft.model": ("glb", '[spacecraft]\nmodel = "{}"'),
    "severity.file": ("toml", '[severity]\nfile = "{}"'),
    "camera.lens": ("toml", '[camera]\nlens = "{}"'),
    "camera.detector": ("toml", '[camera]\ndetector = "{}"'),
    "trajectory.file": ("csv", '[trajectory]\nfile = "{}"'),
    "spice.kernels": ("tls", '[spice]\nkernels = ["{}"]\ntarget = "X"'),
    "plugins": ("py", 'plugins = ["{}"]'),
    "faults.pixel_overwriting: texture_file": ("png", '[faults.pixel_overwriting]\ntexture_file = "{}"'),
    **{
        f"faults.straylight: {key}": ("png", f'[faults.straylight]\n{key} = ["{{}}"]')
        for key in ("close_textures", "far_textures", "glare_textures")
    },
    **{
        f"faults.{name}: lens": ("toml", f'[faults.{name}]\nmodel = "{model}"\nlens = "{{}}"')
        for name, model in (
            ("dust_on_optics", "defocused"),
            ("straylight", "traced"),
            ("straylight", "paraxial"),
            ("vignetting", "lens"),
            ("optics_degradation", "contamination"),
        )
    },
}


def describe(folder: Path, lines: str) -> str:
    """Return what `describe` says of a scene with these lines, which must be one sentence."""
    (folder / "my.toml").write_text(f'title = "t"\n{lines}\n')
    result = CliRunner().invoke(cli.app, ["describe", str(folder / "my.toml")])
    assert result.exit_code == 1, result.output
    error = result.exception
    assert type(error).__name__ == "InputError", error
    assert "\n" not in str(error)
    return str(error)


@pytest.mark.parametrize("key", FILES)
def test_a_file_that_cannot_be_used_is_reported_with_scene_key_and_value(
    tmp_path: Path, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    suffix, lines = FILES[key]
    for name, content in (("absent", None), ("folder", ""), ("empty", b""), ("garbage", b"\0\1garbage\xff" * 10)):
        path = tmp_path / f"{name}.{suffix}"
        if content == "":
            path.mkdir()
        elif content is not None:
            path.write_bytes(content)
        sentence = describe(tmp_path, lines.format(path.name))
        assert sentence.startswith(f"{tmp_path / 'my.toml'}: {key}"), sentence
        # SPICE takes any file; it is then without the data, and which of several files lacks them is unknown
        assert str(path) in sentence or (key, name) == ("spice.kernels", "garbage")


def test_no_key_of_a_fault_that_names_a_file_is_left_out() -> None:
    for name in registry():
        for key in path_fields(name):
            assert f"faults.{name}: {key}" in FILES
