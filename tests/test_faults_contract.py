"""One contract for every fault model in the registry."""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import ALL_FAULTS
from test_faults_kit import make, make_context, noisy, noisy_electrons, with_mosaic

from vbnfault.core.errors import InputError
from vbnfault.core.quantities import LUMINANCE, RGBI
from vbnfault.core.registry import undoing_registrations
from vbnfault.detector.interface import with_luminance
from vbnfault.detector.mosaic import pattern
from vbnfault.faults import (
    Fault,
    dataset_order,
    from_dict,
    json_schema,
    physical_order,
    registry,
)
from vbnfault.faults.planes import scale_by_intensity
from vbnfault.testing import check_fault

MODELS = [(fault, model) for fault, models in registry().items() for model in models]
WITH_BOUNDS = [
    (fault, model, f.name)
    for fault, model in MODELS
    for f in dataclasses.fields(registry()[fault][model])
    if f.metadata["kind"] == "bounds"
]


@pytest.fixture(scope="module")
def required(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Keys without which a fault class is refused."""
    path = tmp_path_factory.mktemp("texture") / "texture.png"
    texture = np.random.default_rng(0).integers(0, 256, (40, 50, 4), dtype=np.uint8)
    texture[:20, :, 3] = 0
    assert cv2.imwrite(str(path), texture)
    return {"pixel_overwriting": {"texture_file": str(path)}}


SLOW = [("straylight", "traced"), ("straylight", "paraxial")]  # a lens is made ready for every camera


@pytest.mark.parametrize(("name", "model"), MODELS)
def test_contract(name: str, model: str, required: dict[str, dict[str, Any]]) -> None:
    examples = 4 if (name, model) in SLOW else 12
    check_fault(registry()[name][model], required=required.get(name), examples=examples)


@pytest.mark.parametrize(("name", "model", "key"), WITH_BOUNDS)
def test_bad_bounds_are_refused(name: str, model: str, key: str, required: dict[str, dict[str, Any]]) -> None:
    f = registry()[name][model].__dataclass_fields__[key]
    lo, hi = f.metadata["limits"]
    bad: list[Any] = [hi + 1, lo - 1, [lo, hi + 1], "wide", True, None, [lo], [lo, hi, hi], float("nan")]
    bad += [10**400, -(10**400), 10**5000, [lo, 10**400]]  # beyond floats
    if hi > lo:
        bad.append([hi, lo])
    if f.metadata["integer"]:
        bad.append(lo + 0.5)
    for value in bad:
        with pytest.raises(InputError, match=rf"^test.toml: faults\.{name}\.{key} = ") as caught:
            from_dict(name, required.get(name, {}) | {"model": model, key: value}, source="test.toml")
        assert "\n" not in str(caught.value)
        pickle.loads(pickle.dumps(caught.value))


@pytest.mark.parametrize(("name", "model"), MODELS)
def test_wrong_types_and_unknown_keys_are_refused(
    name: str, model: str, required: dict[str, dict[str, Any]]
) -> None:
    base = required.get(name, {}) | {"model": model}
    with pytest.raises(InputError, match=rf"faults\.{name}\.colour_of_the_moon: unknown key"):
        from_dict(name, base | {"colour_of_the_moon": 1}, source="test.toml")
    wrong = {"number": "a lot", "flag": 1, "choice": "sideways", "text": 3, "path": 3, "rows": [{"nothing": 1}]}
    wrong |= {"paths": [3]}
    for f in dataclasses.fields(registry()[name][model]):
        if f.metadata["kind"] in wrong:
            with pytest.raises(InputError, match=rf"faults\.{name}\.{f.name}"):
                from_dict(name, base | {f.name: wrong[f.metadata["kind"]]}, source="test.toml")


def test_unknown_class_and_model_are_refused() -> None:
    with pytest.raises(InputError, match="did you mean vignetting"):
        from_dict("vigneting", {}, source="test.toml")
    with pytest.raises(InputError, match=r"faults\.vignetting\.model = 'cos5': must be one of"):
        from_dict("vignetting", {"model": "cos5"}, source="test.toml")


@pytest.mark.parametrize(
    ("first", "later"),
    [("pixels", ("light",)), ("pixels", ("pixels",)), ("electrons", ("pixels",)), ("raw", ("rgbi",)), ("dark", ())],
)
def test_several_steps_come_in_order_and_inside_the_mosaic(first: str, later: tuple[str, ...]) -> None:
    with pytest.raises(TypeError, match="fault model steps_of_a_test/one"):
        type("Wrong", (Fault,), {"fault": "steps_of_a_test", "model": "one", "step": first, "later_steps": later})
    assert "steps_of_a_test" not in registry()


def test_orders() -> None:
    names = list(registry())
    assert tuple(names[: len(ALL_FAULTS)]) == ALL_FAULTS
    assert names.index("pixel_overwriting") >= len(ALL_FAULTS)
    assert dataset_order(reversed(names)) == names
    order = physical_order(names)
    # light first meets the optics, then the pixels, then the readout (design document, "Order"); within the
    # detector: charge collected, moved, read, converted, assembled and sent
    assert order == [
        "frozen_frame",
        "particles",
        "straylight",
        "dust_on_optics",
        "optics_degradation",
        "vignetting",
        "broken_pixels",
        "persistence",
        "smear",
        "cosmic_rays",
        "blooming",
        "cti",
        "banding",
        "adc",
        "broken_lines",
        "register_upset",
        "transmission",
        "pixel_overwriting",
    ]
    # optical effects come before those of detector and readout, whatever the models
    # but a frame that is sent again is a finished image
    optical = [{m.step for m in registry()[n].values() if m.model != "repeated"} for n in order]
    assert all(len(s) == 1 for s in optical if "electrons" in s)
    flat = ["electrons" in s for s in optical]
    assert flat == sorted(flat, reverse=True)


def declare(name: str, **attributes: Any) -> type[Fault]:
    """Define a model of a test's own class."""
    declared = {"fault": name, "model": "one", "step": "rgbi", "default": True, "__module__": f"of_a_test.{name}"}
    return dataclasses.dataclass(frozen=True, kw_only=True)(
        type(f"Of{name.title()}", (Fault,), declared | {"after": "vignetting"} | attributes)
    )


def test_a_class_acts_directly_behind_the_class_that_it_names() -> None:
    before = physical_order(registry())
    with undoing_registrations(always=True):
        declare("b_of_a_test", after="straylight")
        declare("a_of_a_test", after="straylight")
        declare("on_a_of_a_test", after="a_of_a_test")
        declare("first_of_all", after="")
        order = physical_order(registry())
        first = ["first_of_all", *before[:3], "a_of_a_test", "on_a_of_a_test", "b_of_a_test"]
        assert order[:7] == first
        assert order[7:] == before[3:]
        assert list(registry())[: len(ALL_FAULTS)] == list(ALL_FAULTS)
    assert physical_order(registry()) == before


@pytest.mark.parametrize(
    ("classes", "sentence"),
    [
        ({"x": {"after": "vigneting"}}, r"fault class x: after = 'vigneting': .* \(did you mean vignetting\?\)"),
        ({"x": {"after": "y"}, "y": {"after": "x"}}, r"fault class: what x, y state by `after` runs in a circle"),
        ({"x": {"after": "x"}}, r"fault class: what x state by `after` runs in a circle"),
        ({"x": {"default": False}}, r"fault class x: none of its models \(one\) states default = True"),
        ({"x": {"after": None}}, r"fault model x/one: the default model must state the class after"),
        ({"vignetting": {}}, r"fault model vignetting/one: default = True, but vignetting/cos4 is the default"),
        ({"dust_on_optics": {"model": "gaussian", "default": False}}, r"gaussian is defined twice: .* of_a_test"),
        ({"x": {"axis": 0}}, r"fault model x/one: axis = 0: only the six classes"),
        ({"X": {}}, r"fault model X/one: its names must consist of lower-case"),
        ({"x": {"wide": dataclasses.field(default=3), "__annotations__": {"wide": int}}}, r"x/one: wide must be"),
    ],
)
def test_contradictory_declarations_are_refused(classes: dict[str, dict[str, Any]], sentence: str) -> None:
    known = registry()

    @undoing_registrations()
    def declare_all() -> None:
        for name, attributes in classes.items():
            declare(name, **attributes)
        registry()

    with pytest.raises(TypeError, match=sentence):
        declare_all()
    assert registry() == known


def test_a_model_has_to_be_a_frozen_dataclass() -> None:
    @undoing_registrations()
    def declare_it() -> None:
        type("Bare", (Fault,), {"fault": "x", "model": "one", "step": "rgbi", "default": True, "after": "adc"})
        registry()

    with pytest.raises(TypeError, match=r"x/one: .* @dataclass\(frozen=True, kw_only=True\)"):
        declare_it()


def test_json_schema_names_every_key() -> None:
    schema = json.loads(json.dumps(json_schema()))
    for name, model in MODELS:
        entry = schema["properties"][name]
        options = entry.get("anyOf", [entry])
        (match,) = [o for o in options if o["properties"]["model"]["const"] == model]
        cls = registry()[name][model]
        keys = {"model"} | {f.name for f in dataclasses.fields(cls)}
        assert set(match["properties"]) == keys | ({"severity"} if cls.severity is not None else set())


def test_plain_numbers_make_bounds_in_python_too() -> None:
    cls = registry()["dust_on_optics"]["gaussian"]
    assert cls(count=50) == from_dict("dust_on_optics", {"count": 50}, source="test.toml")
    with pytest.raises(InputError, match=r"dust_on_optics\.count = -1"):
        cls(count=-1)


def test_replace_forgets_what_was_made_once() -> None:
    context = make_context(96)
    params: dict[str, Any] = {}
    made: list[Any] = []

    def number(params: dict[str, Any], where: Any, more: int) -> int:
        made.append(where)
        return len(made) + more

    assert [context.once(number, params, 1), context.once(number, params, 1)] == [2, 2]
    assert context.once(number, params, 7) == 9
    assert dataclasses.replace(context).once(number, params, 1) == 4


def test_scale_by_intensity() -> None:
    pixels = np.array([[100, 50, 20, 60], [0, 0, 0, 0], [9, 7, 5, 0], [200, 100, 0, 100]], np.uint8)
    wanted = np.array([30, 77, 10, 200], np.float32)
    # ratio ½; I = 0 gives RGB = I; I = 0 below coloured RGB likewise; overflow clips in its channel only
    expected = [[50, 25, 10, 30], [77, 77, 77, 77], [10, 10, 10, 10], [255, 200, 0, 200]]
    assert scale_by_intensity(pixels, wanted).tolist() == expected
    unchanged = scale_by_intensity(pixels[[0, 3]], np.array([60, 100], np.float32))
    assert np.array_equal(unchanged, pixels[[0, 3]])


def test_dark_pixels_scaled_by_intensity_keep_i_as_their_luminance() -> None:
    """A level of 1 stands for 0.5 to 1.5. By the ratio of the rounded ones, luminance was up to half too bright."""
    rgb = np.stack(np.meshgrid(*[np.arange(8, dtype=np.uint8)] * 3), axis=-1).reshape(1, -1, 3)
    pixels = with_luminance(rgb)[0]
    for wanted in (0.0, 5.0, 42.0):
        out = scale_by_intensity(pixels, np.full(len(pixels), wanted, np.float32))
        whole = (out[:, :3] < 255).all(axis=1)
        assert whole.mean() > 0.9
        # half a level of rounding in each channel, and half in I
        off = out[whole, :3] @ LUMINANCE.astype(np.float64) - out[whole, 3]
        assert np.abs(off).max() <= 1.0
    lit = pixels[pixels[:, 3] > 0]
    assert np.array_equal(scale_by_intensity(lit, lit[:, 3].astype(np.float32)), lit)


@pytest.mark.parametrize(
    ("fault", "table"),
    [
        ("broken_pixels", {"model": "texture", "count": 400}),
        ("pixel_overwriting", {"channels": "I", "blend": "mixture", "strength": 0.5}),
    ],
)
def test_an_image_without_colours_stays_without_colours(fault: str, table: dict[str, Any], tmp_path: Path) -> None:
    """All channels of a camera without colour filters are the same, also where an intensity is half a DN."""
    if fault == "pixel_overwriting":
        table = table | {"texture_file": str(tmp_path / "half.png")}
        cv2.imwrite(table["texture_file"], np.tile(np.arange(256, dtype=np.uint8), (8, 1)))
    context = with_mosaic(make_context(256, architecture="cmos"), pattern=pattern("mono"))
    made = make(fault, **table)
    image = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 256, axis=1).repeat(4, axis=2)
    params = made.draw(context, np.random.default_rng(2))
    given = RGBI(array=image)
    changed = made.apply(given, params, context).array
    assert (changed != image).any()
    assert (changed == changed[..., 3:]).all()
    coloured = made.apply(given, params, make_context(256, architecture="cmos")).array
    np.testing.assert_array_equal(changed[..., 3], coloured[..., 3])  # I itself is as for any camera


LIMITS = [
    (fault, model, f.name, limit)
    for fault, model in MODELS
    if (fault, model) not in SLOW
    for f in dataclasses.fields(registry()[fault][model])
    if f.metadata["kind"] in ("bounds", "number")
    for limit in f.metadata["limits"]
]


@pytest.mark.parametrize(("name", "model"), sorted({(name, model) for name, model, *_ in LIMITS}))
def test_every_number_serves_at_both_ends_of_its_limits(
    name: str, model: str, required: dict[str, dict[str, Any]]
) -> None:
    """What is read is never refused sample by sample: ranges of keys are what the physics takes."""
    small = make_context(32, sun_xy_px=(10.0, 12.0), architecture="frame_transfer_ccd")
    beam = np.array([-0.1, -0.05, 1.0])
    context = dataclasses.replace(
        with_mosaic(small) if registry()[name][model].needs_mosaic else small,
        sun_direction_C=beam / np.linalg.norm(beam),
        sun_irradiance_W_m2_nm=np.ones(4),
        wavelength_nm=np.linspace(420.0, 680.0, 4),
        sun_angular_radius_rad=0.0046,
    )
    served = 0
    for _, _, key, limit in (row for row in LIMITS if row[:2] == (name, model)):
        table = required.get(name, {}) | {"model": model, key: limit}
        refusal, fault = "", None
        try:
            fault = from_dict(name, table, source="test.toml")
        except InputError as error:  # two keys that contradict each other, told when the file is read
            refusal = str(error)
        assert not refusal.startswith(f"test.toml: faults.{name}.{key} = ")
        if fault is None:
            continue
        params = fault.draw(context, np.random.default_rng(1))
        met = dataclasses.replace(context, camera=fault.alter(context.camera, params))
        with np.errstate(invalid="raise", divide="raise", over="raise"):
            results = [fault.apply_at(step, noisy(step, met), params, met) for step in fault.steps]  # type: ignore[type-var]
            fault.footprint(params, met)
        assert all(np.isfinite(result.array).all() for result in results), (key, limit)
        served += 1
    assert served


@pytest.mark.parametrize("model", ["traced", "paraxial"])
def test_limits_of_straylight_are_those_of_scatter(model: str) -> None:
    """Scattering serves at both ends of the declared limits; the reader refuses what lies beyond."""
    from vbnfault.lens.straylight import particles, scatter

    fields = registry()["straylight"][model].__dataclass_fields__
    for key, physics in (
        ("roughness_nm", lambda value: scatter.Harvey.of_roughness(roughness_nm=value, index_step=0.5).b0),
        ("cleanliness_level", lambda value: particles.particle_scatter_fraction(value, 550.0)),
    ):
        low, high = fields[key].metadata["limits"]
        assert np.isfinite([physics(low), physics(high)]).all()
        for beyond in (low - 1e-6, high * (1 + 1e-6)):
            with pytest.raises(InputError, match=rf"faults\.straylight\.{key} = "):
                from_dict("straylight", {"model": model, key: beyond}, source="test.toml")


OPTICAL_TEXTURES = ["straylight", "dust_on_optics", "optics_degradation", "vignetting"]


@pytest.mark.parametrize("name", OPTICAL_TEXTURES)
def test_a_plane_of_no_light_past_the_rims_is_no_light(name: str) -> None:
    context = make_context(64, sun_xy_px=(50.0, 40.0))
    fault: Fault = make(name)
    params, light = fault.draw(context, np.random.default_rng(1)), noisy_electrons(context)
    none = dataclasses.replace(light, past_rims=np.zeros_like(light.array)).scaled(1.0)
    assert none.past_rims is None
    np.testing.assert_array_equal(
        fault.on_light(none, params, context).array, fault.on_light(light, params, context).array
    )


def test_light_past_the_rims_is_scaled_again() -> None:
    light = noisy_electrons(make_context(64))
    past = np.zeros_like(light.array)
    past[30:32] = 8.0
    both = dataclasses.replace(light, past_rims=past)
    np.testing.assert_array_equal(both.scaled(2.0).scaled(4.0).merged.array, both.scaled(8.0).merged.array)
