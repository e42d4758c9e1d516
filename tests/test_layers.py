"""Every optional layer a scene may ask for: built, verified, and read back by xarray, in both worlds."""

from __future__ import annotations

import re
import typing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, verified_store
from test_faults_contract import MODELS
from test_faults_kit import flat_electrons, make_context, with_mosaic

from vbnfault import dataset
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import SOFT_KINDS, soft_kind
from vbnfault.faults import Fault, from_dict, registry
from vbnfault.pipeline import Session
from vbnfault.pipeline.record import to_sample
from vbnfault.scene import config, sampling

# The names of layers that the scene file takes; the patterns of names are filled in below.
PATTERN = next(m.pattern for m in typing.get_args(sampling.Layer)[1].metadata if hasattr(m, "pattern"))
NAMED = [name for name in re.sub(r"^\^\(|\)\$$", "", PATTERN).split("|") if re.fullmatch(r"[A-Za-z_]+", name)]
PAPER = {name: {} for name in ("dust_on_optics", "broken_pixels", "broken_lines", "straylight", "vignetting")}
# grains small enough to leave light in a frame of 0.5 mm: else no other fault shows, and views are drawn in vain
PHYSICAL = {
    "dust_on_optics": {"model": "defocused", "surface": -2, "transmission": 0.0, "diameter_um": [20, 60]},
    "broken_pixels": {"model": "hot_pixels"},
    "straylight": {"model": "paraxial"},
    "vignetting": {"model": "lens", "decentre": [0.4, 0.5]},
}
SOFT = ["dust_opacity", "vignetting_factor", "straylight_added"]


def layers_of(faults: dict[str, Any], mosaic: bool) -> list[str]:
    left_out = {"flow"} if mosaic else {"flow", "raw", "defects"}  # flow is that of sequences
    named = [name for name in NAMED if name not in left_out]
    return [*named, *(f"without_{name}" for name in faults), *SOFT]


@pytest.mark.parametrize("world", ["paper", "physical"])
def test_every_optional_layer_is_built_verified_and_read_back(world: str, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    faults = PAPER if world == "paper" else PHYSICAL
    detector = {} if world == "paper" else {"detector": "generic_ccd"}
    layers = layers_of(faults, bool(detector))
    table = small_scene(
        dataset={"samples": 4, "sites": 1, "layers": layers, "shard_samples": 2, "mask_any": ["straylight"]},
        camera={"width_px": 64, "height_px": 48, **detector},
        plan={"faulty_fraction": 0.5, "classes_per_sample": [len(faults), len(faults)]},
    )
    out = tmp_path / "s.zarr"
    opened = verified_store({**table, "faults": faults}, out)
    assert set(layers) - {"clean"} <= set(opened.spec.layers)
    with xarray.open_zarr(out) as data:
        injected = data["injected"].to_pandas()
        assert 0 < injected.to_numpy().sum() < injected.size
        for name in layers:
            array = data[name]
            assert array.dims[0] == "sample"
            grid = {"y_rendered": 48, "x_rendered": 64} if name == "scene_radiance" else {"y": 48, "x": 64}
            assert dict(array.sizes).items() >= {"sample": 4, **grid}.items()
            assert array.attrs["units"]
            assert array.attrs["long_name"]
            assert np.array_equal(
                array[3].values, opened.read_sample(3).layers[name], equal_nan=array.dtype != bool
            )
        assert list(data["mask_any"].attrs["faults"]) == ["straylight"]
        for k, name in enumerate(data["fault"].values):
            fault = registry()[name][faults[name].get("model", next(iter(registry()[name])))]
            kind = data["mask"].attrs["kinds"][k]
            moves = bool({"light", "pixels", "charge"} & set(fault.steps)) and bool(detector)
            assert kind == ("effect" if fault.effect_mask else "footprint and effect" if moves else "footprint")
            rule = data["mask"].attrs["rules"][k]
            assert ("1 DN" in rule) == ("effect" in kind)
            assert data["mask_effect"].attrs["threshold_dn"] == 1
            if not fault.soft_layer:
                continue
            soft, neutral = data[fault.soft_layer].load(), soft_kind(fault.soft_layer).neutral
            acts = (soft != neutral).any(("y", "x")).values
            # a fault acts where it is injected and nowhere else
            np.testing.assert_array_equal(acts, injected[name])


@pytest.mark.parametrize(
    ("name", "model"), [m for m in MODELS if registry()[m[0]][m[1]].soft_layer and m != ("straylight", "traced")]
)
def test_a_soft_layer_is_what_the_fault_does_to_light(name: str, model: str) -> None:
    """The oracle is `apply`: to even light it shows the factor, to darkness what it adds."""
    context = make_context(96, 72, sun_xy_px=(20.0, 30.0))
    if model != "gaussian":
        context = with_mosaic(context)
    fault = from_dict(name, {"model": model}, source="test")
    if name == "straylight" and model == "paraxial":
        context = lit(context)
    if name == "dust_on_optics" and model == "defocused":  # the glow of grains is no part of their opacity
        context = make_context(96, 72)
    params = fault.draw(context, np.random.default_rng(4))
    soft = fault.soft(params, context)
    assert soft.shape == context.shape
    assert soft.dtype == np.float32
    even = flat_electrons(context)
    kind = fault.soft_layer.rpartition("_")[2]
    if kind == "added":
        dark = even.with_array(np.zeros_like(even.array))
        added = fault.apply(dark, params, context).array
        assert added.max() > 0
        shown = dict(zip(context.camera.detector.channels, np.moveaxis(added / even.white_e, 2, 0), strict=True))
        luminance = 0.2126 * shown["R"] + 0.7152 * shown["G"] + 0.0722 * shown["B"]
        # float32 sums of a few terms
        np.testing.assert_allclose(soft, 255 * luminance, rtol=1e-5, atol=1e-4)
        return
    left = fault.apply(even, params, context).array[..., 1] / even.array[..., 1]
    assert left.min() < 0.999
    # a product in float32, and its quotient
    np.testing.assert_allclose(1 - soft if kind == "opacity" else soft, left, atol=1e-6)


def lit(context: Any) -> Any:
    """The context with what models that trace the Sun's light need to know."""
    import dataclasses

    camera = context.camera
    x, y = np.asarray(context.sun_xy_px) - np.array([camera.width_px, camera.height_px]) / 2
    direction = np.array([x / camera.focal_length_px, y / camera.focal_length_px, 1.0])
    nodes = np.linspace(420.0, 680.0, 4)
    return dataclasses.replace(
        context,
        sun_direction_C=direction / np.linalg.norm(direction),
        sun_irradiance_W_m2_nm=np.full(4, 1.5),
        wavelength_nm=nodes,
        sun_angular_radius_rad=0.0047,
    )


def test_all_models_of_a_class_name_one_soft_layer_of_a_known_kind() -> None:
    names = {}
    for fault, models in registry().items():
        of_class = {kind.soft_layer for kind in models.values()}
        assert len(of_class) == 1, fault
        names[fault] = of_class.pop()
    used = [name for name in names.values() if name]
    assert len(used) == len(set(used))
    assert {name.rpartition("_")[2] for name in used} == set(SOFT_KINDS)
    assert sorted(used) == sorted(SOFT)

    with pytest.raises(KeyError, match="haze"):

        class Unknown(Fault):
            fault, model, step = "unknown_class", "unknown", "electrons"
            soft_layer = "unknown_haze"


def of_scene(**tables: Any) -> Session:
    return Session(config.parse_scene(small_scene(**tables), source="test"))


def test_mask_any_unites_the_classes_that_a_scene_chooses() -> None:
    def members(**chosen: Any) -> tuple[str, ...]:
        s = of_scene(dataset=chosen, camera={"width_px": 32, "height_px": 32})
        return dataset.store_spec(s, [16]).mask_any_faults

    localised = ("dust_on_optics", "broken_pixels", "broken_lines", "straylight")
    assert members() == localised
    assert members(mask_any=[]) == ()
    # in dataset order, each once
    assert members(mask_any=["vignetting", "dust_on_optics", "vignetting"]) == ("dust_on_optics", "vignetting")
    for unknown in ("dust", "smear"):  # no class, and a class that the scene has not
        with pytest.raises(InputError, match=rf"dataset.mask_any: '{unknown}': .* it has: dust_on_optics, "):
            members(mask_any=[unknown])


def test_a_faulty_sample_cannot_have_more_classes_than_the_scene() -> None:
    with pytest.raises(InputError, match=r"plan.classes_per_sample = \[7, 9\]: the scene has only 6 fault classes"):
        of_scene(plan={"classes_per_sample": [7, 9]})
    of_scene(plan={"classes_per_sample": [2, 9]})  # at most as many as there are


def test_mask_effect_is_stored_by_default_and_soft_layers_need_their_fault() -> None:
    assert "mask_effect" in sampling.DatasetTable().layers
    with pytest.raises(InputError, match="'dust_opacity': no fault of the scene has it; the faults have: none"):
        Session(config.parse_scene({"title": "t", "dataset": {"layers": ["dust_opacity"]}}, source="test"))


def test_mask_any_holds_the_pixels_that_several_faults_turn_white() -> None:
    """Bright grains and flares saturate the same pixels: none of the two changes anything there alone."""
    grains = {"density_per_m3": [1e5, 1e5], "albedo": [0.6, 0.6], "radius_mm": [5, 100], "size_exponent": 1}
    table = small_scene(
        dataset={"samples": 3, "sites": 1, "layers": ["clean", "mask_effect"]},
        plan={"faulty_fraction": 1.0, "mode": "per_class", "on_invisible": "drop"},
        camera={"width_px": 64, "height_px": 64, "exposure_s": 5.0},
    )
    table["faults"] = {
        "straylight": {"count": [10, 10], "radius": [0.3, 0.3], "brightness": [2.5, 2.5]},
        "particles": {**grains, "nearest_m": 2.0, "farthest_m": 30.0, "most_grains": 5000},
    }
    frame = Session(config.parse_scene(table, source="test")).frame(1)
    development, draws = frame.injection.development, frame.injection.draws
    image, clean = (development.image(d, noisy=False).array for d in (draws, {}))
    changed = (image != clean).any(axis=2)
    of_none = changed & ~frame.labels.effects["straylight"] & ~frame.labels.effects["particles"]
    assert of_none.sum() > 20
    assert (image[of_none] == 255).all()
    assert not (changed & ~frame.labels.mask_any).any()
    sample = to_sample(frame)
    np.testing.assert_array_equal(sample.layers["mask_any"], frame.labels.mask_any)
    assert (sample.layers["mask_any"] & ~sample.layers["mask"].any(axis=0))[of_none].all()
