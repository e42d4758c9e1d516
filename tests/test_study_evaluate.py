"""Evaluations of a study: what factors move, what is computed again, and the metrics of straylight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from conftest import recorded_calls, small_scene
from PIL import Image

from vbnfault.camera import Camera
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.files import resources
from vbnfault.core.process import llvm
from vbnfault.core.process.llvm import backend
from vbnfault.core.spectra import solar_irradiance_W_m2_nm
from vbnfault.lens import load_lens
from vbnfault.lens.adapt import Change, changed
from vbnfault.lens.coating import mean_reflectance
from vbnfault.study import evaluate as evaluate_module
from vbnfault.study import image_metrics, results, run
from vbnfault.study.evaluate import SceneEvaluator
from vbnfault.study.image_metrics import LitImage
from vbnfault.study.spec import Evaluation, StudySpec, load_study, parse_study

try:
    llvm.find()
except VbnfaultError as error:
    pytest.skip(f"no usable LLVM: {error}", allow_module_level=True)

SIZE = 48
TOTALS = ("straylight_total_e", "ghost_total_e", "starburst_total_e", "glare_total_e", "veil_median_e")
LENS = {"model": "traced", "lens": "nikkor_35_f2p8_camera", "coating": "bbar"}


def factor(key: str, low: float = 0.0, high: float = 1.0, unit: str = "") -> dict[str, Any]:
    return {"key": key, "distribution": "uniform", "low": low, "high": high, "unit": unit}


def study(tmp_path_factory: Any, *factors: dict[str, Any], **tables: Any) -> StudySpec:
    """A study of a small scene with the Sun in view."""
    scene = small_scene(
        dataset={"samples": 2, "sites": 1, "layers": ["clean"]},
        camera={"width_px": SIZE, "height_px": SIZE, "exposure_s": 0.01, **tables.pop("camera", {})},
        geometry={"sun_facing": {"sun_elevation_deg": [10, 20], "roll_deg": [-9, 9], "pitch_deg": [-9, 9]}},
        plan={"mode": "per_class", "faulty_fraction": 1.0},
    )
    scene["faults"] = {"straylight": tables.pop("straylight", LENS)}
    scene["render"] |= {"bands": 2, **tables.pop("render", {})}
    path = tmp_path_factory.mktemp("study") / "scene.toml"
    path.write_text(tomli_w.dumps(scene), encoding="utf-8")
    plain = {
        "title": "test",
        "design": {"method": "sobol", "n": 2},
        "scene": {"base": str(path), "samples": [0], "seeds": [5]},
        "factor": list(factors),
        "metrics": {"names": tables.pop("names", list(TOTALS))},
        **tables,
    }
    return parse_study(plain, source="study")


def point(values: Mapping[str, float | str], role: str = "point", model: str = "", view: int = 0) -> Evaluation:
    return Evaluation(index=0, seed=5, view=view, model=model, role=role, values=values)


ALL = (
    factor("lens.surface.2.radius", -1e-3, 1e-3, "fraction"),
    factor("lens.coating.thickness", -0.3, 0.3, "fraction"),
    factor("lens.stop.blades", 0, 9),
    factor("lens.stop.blade_rounding", 0, 1),
    factor("scene.faults.straylight.roughness_nm", 0.2, 1.0, "nm"),
    factor("sun.angle_deg", 2, 20, "deg"),
    factor("sun.distance_au", 1, 2, "au"),
    factor("detector.full_well_e", 1e4, 2e4, "e"),
    factor("detector.read_noise_e_rms", 1, 20, "e"),
)
NOMINAL: dict[str, float] = {
    "lens.surface.2.radius": 0.0,
    "lens.coating.thickness": 0.0,
    "lens.stop.blades": 0.0,
    "lens.stop.blade_rounding": 0.0,
    "scene.faults.straylight.roughness_nm": 0.5,
    "sun.angle_deg": 12.0,
    "sun.distance_au": 1.5,
    "detector.full_well_e": 13500.0,
    "detector.read_noise_e_rms": 13.0,
}


# What no factor of a kind makes the study compute again.
STAYS = {
    "lens": {"render"},
    "scene": {"render", "ghosts", "starburst"},
    "sun": {"render"},
    "detector": {"render", "ghosts", "starburst", "glare"},
}


@pytest.fixture(scope="module")
def evaluator(tmp_path_factory: pytest.TempPathFactory) -> SceneEvaluator:
    """One evaluator for the tests of this module: the render and the kernels are made once."""
    names = [*TOTALS, "straylight_peak_e", "pixels_saturated", "snr", "mask_area", "ghost_1_flux_e"]
    return SceneEvaluator(study(tmp_path_factory, *ALL, names=names))


# --- what is computed again --------------------------------------------------------------------------------------


def test_the_view_is_rendered_once_and_each_factor_moves_only_its_own_stages(
    evaluator: SceneEvaluator, monkeypatch: pytest.MonkeyPatch
) -> None:
    renders = recorded_calls(monkeypatch, evaluate_module, "render_view")
    exposures = recorded_calls(monkeypatch, Camera, "expose")
    base = evaluator.evaluate(point(NOMINAL, role="A"))
    events = evaluator.kept.events
    for key in NOMINAL:
        before, exposed = dict(events), len(exposures)
        evaluator.evaluate(
            point(NOMINAL | {key: NOMINAL[key] * 1.01 + 1e-4 + (5 if key.endswith("blades") else 0)})
        )
        moved = {stage for stage in events if events[stage] != before.get(stage, 0)}
        assert not moved & STAYS[key.partition(".")[0]], key
        if not key.startswith("sun.") and key != "detector.full_well_e":  # the direct image is found
            assert len(exposures) == exposed, key
    assert events["render"] <= 1
    assert len(renders) <= 1
    # the results of the base row are held, however many rows came in between
    before = dict(events)
    assert evaluator.evaluate(point(NOMINAL, role="AB:x")) == base
    assert events == before


def test_new_values_of_a_lens_compile_no_kernel(evaluator: SceneEvaluator) -> None:
    dr = backend().dr
    bladed = NOMINAL | {"lens.stop.blades": 7.0}
    evaluator.evaluate(point(bladed | {"lens.stop.blade_rounding": 0.3}))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        evaluator.evaluate(point(bladed | {"lens.stop.blade_rounding": 0.35, "lens.surface.2.radius": 5e-4}))
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(entry["cache_hit"] for entry in kernels)


@pytest.mark.parametrize("keys", [{}, {"sources": "scene", "lens": "tessar_50_f2p8"}])
def test_an_evaluation_equals_the_pipelines_own_light(
    tmp_path_factory: pytest.TempPathFactory, keys: dict[str, str]
) -> None:
    made = SceneEvaluator(study(tmp_path_factory, factor("lens.sensor_reflectance"), straylight=LENS | keys))
    image = made._lit_image(point({}), made.factors.setting({}))
    exposed = made._exposed(point({}), made.factors.setting({}))
    fault = exposed.spec.faults["straylight"]
    params = fault.draw(exposed.context, exposed.spec.rng("fault", "straylight/0"))
    whole = fault.on_light(exposed.exposure.rate.scaled(exposed.camera.exposure_s), params, exposed.context).merged
    own = np.moveaxis(image.kept + image.added, 0, -1)
    # both are sums of four parts in single precision, added in another order
    np.testing.assert_allclose(own, whole.array, rtol=2e-4, atol=1e-3)


# --- physics -----------------------------------------------------------------------------------------------------


def test_flux_falls_with_the_square_of_the_suns_distance(evaluator: SceneEvaluator) -> None:
    near, far = (evaluator.evaluate(point(NOMINAL | {"sun.distance_au": au})) for au in (1.0, 2.0))
    # the disc shrinks, too: the edges of ghosts change, and the starburst begins nearer to the Sun
    for name, within in (("glare_total_e", 1e-5), ("ghost_1_flux_e", 1e-5), ("ghost_total_e", 0.02)):
        assert near[name] / far[name] == pytest.approx(4, rel=within), name


# Two elements of one glass without dispersion, on which a quarter wave of MgF₂ leaves hardly any reflection.
OF_ONE_GLASS: dict[str, Any] = {
    "name": "of one glass",
    "source": "made up",
    "surface": [
        {"radius_mm": 60.0, "thickness_mm": 4.0, "nd": 1.9, "diameter_mm": 20.0, "coating": "mgf2"},
        {"radius_mm": -90.0, "thickness_mm": 3.0, "diameter_mm": 20.0, "coating": "mgf2"},
        {"stop": True, "thickness_mm": 3.0, "diameter_mm": 8.0},
        {"radius_mm": 70.0, "thickness_mm": 3.0, "nd": 1.9, "diameter_mm": 20.0, "coating": "mgf2"},
        {"radius_mm": -100.0, "diameter_mm": 20.0, "coating": "mgf2"},
    ],
}


def test_ghost_flux_follows_the_square_of_the_mean_reflectance(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("lens") / "lens.toml"
    path.write_text(tomli_w.dumps(OF_ONE_GLASS), encoding="utf-8")
    spec = study(
        tmp_path_factory,
        factor("lens.coating.thickness", 0, 1, "fraction"),
        factor("sun.angle_deg", 0, 10, "deg"),
        names=["ghost_total_e"],
        straylight={"model": "traced", "lens": str(path)},
        render={"bands": 1},
    )
    made = SceneEvaluator(spec)
    (layer,) = load_lens(path).surfaces[0].coating
    errors = (0.2, 0.4, 0.6)
    flux = [
        made.evaluate(point({"lens.coating.thickness": e, "sun.angle_deg": 3.0}))["ghost_total_e"] for e in errors
    ]
    # all surfaces are alike, and most angles so small that reflection is that at normal incidence
    films = [replace(layer, thickness_nm=layer.thickness_nm * (1 + error)) for error in errors]
    # the mean over the band of R², weighted by sunlight and the sensor; glass and film have one index
    nm = np.arange(400.0, 701.0, 2.0)
    light = made._nominal_camera.detector.efficiency.electron_weights(nm).sum(axis=0) * solar_irradiance_W_m2_nm(nm)
    squares = [np.average(mean_reflectance([film], 1.0, 1.9, 1.0, nm) ** 2, weights=light) for film in films]
    assert squares[-1] > 2.5 * squares[0]
    slope = np.polyfit(np.log(squares), np.log(flux), 1)[0]
    # rays at the rims are oblique: over the whole plane, 300² exact rays a ghost give 2.113 / 2 in a line of light
    assert slope == pytest.approx(1, rel=0.07)


def test_blades_move_the_starburst_alone(evaluator: SceneEvaluator) -> None:
    round_, bladed = (evaluator.evaluate(point(NOMINAL | {"lens.stop.blades": n})) for n in (0.0, 6.0))
    assert bladed["starburst_total_e"] != round_["starburst_total_e"]
    assert bladed["straylight_peak_e"] != round_["straylight_peak_e"]
    assert bladed["glare_total_e"] == pytest.approx(round_["glare_total_e"], rel=0.05)


def test_metrics_are_those_of_their_equations() -> None:
    clean = np.full((2, 4, 4), 100.0, dtype=np.float32)
    added = np.zeros_like(clean)
    added[:, 0, 0], added[0, 1, 1] = 300.0, 0.5
    image = LitImage(
        clean=clean,
        kept=clean * np.float32(0.5),
        added=added,
        parts_e={"ghosts": 7.0},
        ghosts_e=(3.0,),
        lit=np.arange(1, 16),
        dark_e=4.0,
        read_noise_e=3.0,
        full_well_e=354.0,
        white_e=np.array([255.0, 127.5], dtype=np.float32),
        mask_level_dn=30.0,
    )
    expected = {
        "straylight_total_e": 300.25,
        "straylight_peak_e": 300.0,
        "ghost_total_e": 7.0,
        "starburst_total_e": np.nan,
        "veil_median_e": 0.0,
        "contrast_loss": 0.0,
        "pixels_above_1dn": 1 / 16,  # 0.5 e are half a DN of the first channel
        "pixels_above_noise": 1 / 16,
        "pixels_saturated": 1 / 16,  # 50 + 300 + 4
        "snr": 50 / np.sqrt(50 + 4 + 9),
        "mask_area": 1.0,  # half of 100 e are more than 30 DN everywhere
        "ghost_1_flux_e": 3.0,
        "ghost_2_flux_e": np.nan,
        "veiling_glare_index": 0.25 / 750.25,
        "straylight_over_signal": 300.25 / 800,
        "sun_direct_e": 0.0,
        "ghost_peak_e": np.nan,  # of a model without ghosts of its own
        "ghost_difference": np.nan,
    }
    assert {name: image_metrics.value(name, image) for name in expected} == pytest.approx(
        expected, rel=1e-6, nan_ok=True
    )


def test_spatial_metrics_of_ghosts_are_those_of_their_equations() -> None:
    ghosts, traced = np.zeros((2, 5, 9), np.float32)
    ghosts[2, 7], ghosts[2, 5] = 30.0, 10.0  # 3 and 1 px right of the middle
    traced[2, 7], traced[0, 0] = 30.0, 20.0
    clean = np.full((3, 5, 9), 100.0, np.float32)
    image = LitImage(
        clean=clean,
        kept=clean + 50,
        direct=np.full_like(clean, 60.0),
        ghosts=ghosts,
        traced_ghosts=traced,
        added=np.full_like(clean, 12.0),
        parts_e={},
        ghosts_e=(),
        lit=np.arange(9),
        dark_e=4.0,
        read_noise_e=3.0,
        full_well_e=1e4,
        white_e=np.full(3, 1e4, np.float32),
        mask_level_dn=1.0,
    )
    expected = {
        "ghost_peak_e": 30.0,
        "ghost_area": 1 / 45,  # the noise is √113 = 10.6 e
        "ghost_offset_px": 2.5,
        "ghost_spread_px": 0.75**0.5,
        "ghost_difference": 30 / 50,
        "veiling_glare_index": 12 / 162,
        "sun_direct_e": 60.0 * 45,
        "straylight_over_signal": 12 / 90,  # without the Sun's direct image
    }
    assert {name: image_metrics.value(name, image) for name in expected} == pytest.approx(expected, rel=1e-6)


def test_ghosts_of_two_models_are_compared_pixel_by_pixel(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Veil and starburst, which both models share, hide the difference in all light that straylight adds."""
    names = ["ghost_difference", "ghost_total_e", "ghost_offset_px", "straylight_total_e", "sun_direct_e"]
    models = {"fault": "straylight", "compare": ["paraxial", "traced"]}
    spec = study(tmp_path_factory, factor("sun.angle_deg", 0, 30, "deg"), names=names, models=models)
    made = SceneEvaluator(spec)
    near, far = (
        {m: made.evaluate(point({"sun.angle_deg": angle}, model=m)) for m in ("paraxial", "traced")}
        for angle in (5.0, 30.0)
    )
    for values in (near, far):
        assert values["traced"]["ghost_difference"] == 0
        assert values["paraxial"]["straylight_total_e"] == pytest.approx(
            values["traced"]["straylight_total_e"], rel=0.1
        )
    # paraxial rays leave the rims and the aberrations of oblique light out
    assert far["paraxial"]["ghost_difference"] > near["paraxial"]["ghost_difference"] > 0.1
    assert near["traced"]["sun_direct_e"] > near["traced"]["straylight_total_e"]


# --- errors ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed_factor", "message"),
    [
        (factor("lens.surface.2.radios", unit="fraction"), "did you mean lens.surface.2.radius?"),
        (factor("scene.faults.straylight.roughness"), "did you mean scene.faults.straylight.roughness_nm?"),
        (factor("optics.f_number"), "keys begin with scene., lens., detector. or sun."),
        (factor("lens.surface.2.radius", unit="K"), "unit = 'K': must be fraction or mm"),
        (factor("sun.distance_au", 1, 2, "m"), "unit = 'm': must be au"),
    ],
)
def test_a_wrong_factor_is_named(
    tmp_path_factory: pytest.TempPathFactory, changed_factor: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=r"factor\[0\].key") as error:
        SceneEvaluator(study(tmp_path_factory, changed_factor))
    assert message in str(error.value)


def test_a_factor_that_nothing_reads_is_refused_and_one_of_some_models_is_told(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    spec = study(tmp_path_factory, factor("detector.bias_dn", 32, 96, "DN"), names=["veil_median_e"])
    with pytest.raises(InputError, match=r"factor\[0\].key = 'detector.bias_dn': nothing in the images"):
        SceneEvaluator(spec).check()
    spec = study(
        tmp_path_factory,
        factor("scene.faults.straylight.roughness_nm", 0.2, 1.0, "nm"),
        names=["veil_median_e"],
        models={"fault": "straylight", "compare": ["texture", "paraxial"]},
    )
    assert SceneEvaluator(spec).check() == [
        "factor 'scene.faults.straylight.roughness_nm' is inactive where the others are large with the model "
        "texture and where the others are nominal with the model texture"
    ]


def test_a_factor_that_needs_another_one_is_told(tmp_path_factory: pytest.TempPathFactory) -> None:
    blades = {"key": "lens.stop.blades", "distribution": "categorical", "values": [0, 6]}
    rounding = factor("lens.stop.blade_rounding", 0, 0.5)
    spec = study(tmp_path_factory, blades, rounding, names=["starburst_total_e"])
    assert SceneEvaluator(spec).check() == [
        "factor 'lens.stop.blade_rounding' is inactive where the others are nominal"
    ]


def test_an_unknown_metric_or_model_is_named(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(InputError, match=r"'veil_medium_e' is unknown \(did you mean veil_median_e\?\)"):
        SceneEvaluator(study(tmp_path_factory, ALL[0], names=["veil_medium_e"]))
    models = {"fault": "straylight", "compare": ["traced", "trased"]}
    with pytest.raises(InputError, match=r"models.compare: 'trased' is unknown \(did you mean traced\?\)"):
        SceneEvaluator(study(tmp_path_factory, ALL[0], models=models))


# --- changes of a lens -------------------------------------------------------------------------------------------


def test_changes_of_a_lens_are_errors_of_its_rows() -> None:
    lens = load_lens("nikkor_35_f2p8").coated("bbar")
    before = lens.surfaces
    made = changed(
        lens,
        [
            Change(quantity="radius", row=0, value=0.01, relative=True),
            Change(quantity="thickness", row=1, value=0.5),
            Change(quantity="index", row=2, value=1e-3),
            Change(quantity="coating_thickness", row=3, layer=0, value=2.0),
            Change(quantity="sensor_reflectance", value=0.2),
        ],
    ).surfaces
    assert made[0].radius_mm == pytest.approx(58.0 * 1.01)
    assert made[1].thickness_mm == pytest.approx(10.51)
    assert made[2].medium.nd == pytest.approx(1.714)
    assert made[3].coating[0].thickness_nm == pytest.approx(before[3].coating[0].thickness_nm + 2)
    assert made[3].coating[1:] == before[3].coating[1:]
    assert replace(made[4]) == before[4]
    with pytest.raises(InputError, match=r"surface 1: thickness_mm = 10.01 with an error of -11: must not"):
        changed(lens, [Change(quantity="thickness", row=1, value=-11.0)])


# --- packaged studies --------------------------------------------------------------------------------------------


SMALL = {
    "scene.camera.width_px": 32,
    "scene.camera.height_px": 32,
    "scene.patch.facet_m": 12.0,
    "scene.patch.radius_m": 60.0,
    "scene.patch.max_triangles": 60_000,
    "scene.render.bands": 1,
    "scene.samples": [0],
    "design.n": 1,
    "design.resamples": 100,
}


@pytest.mark.parametrize("name", list(resources.packaged("scenes/studies")))
def test_packaged_studies_run(name: str, tmp_path: Path) -> None:
    # navigation finds features in no smaller image
    size = {"scene.camera.width_px": 64, "scene.camera.height_px": 64} if name == "fault_ranking" else {}
    spec = load_study(name, SMALL | size)
    found = run.study(spec, tmp_path if name == "fault_ranking" else None, progress=False)
    assert list(found["metric"].values) == list(spec.metrics.names)
    assert list(found["model"].values) == list(spec.model_names)
    valued = np.isfinite(found["mean"].values).all(axis=1)
    if name != "fault_ranking":
        assert valued.all()
        return
    assert valued.sum() >= 6  # frames of this size have too few matches for a pose, and perhaps no limb
    assert (found["fault_acts"] > 0).sum() >= 7
    assert results.read_table(tmp_path).num_rows == len(found["fault"])
    assert results.open_indices(tmp_path).equals(found)
    assert "probability that the next is worse" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_study_of_navigation_alone_is_evaluated_and_reported(tmp_path: Path) -> None:
    """No fault of the scene adds light, so the images of the report are those that the metrics judge."""
    scene = small_scene(
        dataset={"samples": 2, "sites": 1, "layers": ["clean"]},
        camera={"width_px": 64, "height_px": 64},
        plan={"mode": "per_class", "faulty_fraction": 1.0},
    )
    scene["faults"] = {"broken_lines": {}}
    (tmp_path / "scene.toml").write_text(tomli_w.dumps(scene), encoding="utf-8")
    lines = {"key": "scene.faults.broken_lines.count", "distribution": "categorical", "values": [1, 12]}
    spec = parse_study(
        {
            "title": "lines",
            "design": {"method": "one_at_a_time", "n": 2},
            "scene": {"base": str(tmp_path / "scene.toml"), "samples": [0]},
            "factor": [lines],
            "metrics": {"names": ["centroid_shift_px"]},
        },
        source="study",
    )
    indices = run.study(spec, tmp_path / "out", progress=False)
    assert indices["range"].sel(factor=lines["key"]).item() > 0
    images = [np.asarray(Image.open(tmp_path / f"out/images/centroid_shift_px_{k}.png")) for k in ("best", "worst")]
    assert images[0].shape[:2] == images[1].shape[:2]
    assert (images[0] != images[1]).any()  # one line against twelve
