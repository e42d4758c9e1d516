"""Parts of a retake: which stored truth and radiance are used, which views count as resolved, which lenses fit."""

from __future__ import annotations

import dataclasses
import hashlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vbnfault import render, store
from vbnfault.core.errors import InputError
from vbnfault.dataset import retake
from vbnfault.pipeline import retaken
from vbnfault.pipeline.retaken import RetakeSession, StoredView
from vbnfault.pipeline.spec import Pose

ROWS, COLUMNS = 4, 6


def stored_view(*, same_optics: bool = True, dtype: Any = np.float32, **scalars: Any) -> StoredView:
    """Return a view whose render is 2 px wider and 1 px higher on each side than its image."""
    rng = np.random.default_rng(4)
    truth = {
        "depth_m": np.ones((ROWS, COLUMNS), np.float32),
        "normal": np.zeros((ROWS, COLUMNS, 3), np.float16),
        "semantic": np.ones((ROWS, COLUMNS), np.uint8),
        "albedo": np.ones((ROWS, COLUMNS), np.float32),
        "emission_deg": np.full((ROWS, COLUMNS), 7, np.float32),
    }
    known = {"intrinsics": np.array([9.0, 9, 3, 2]), "distortion": np.zeros(8)}
    radiance = rng.random((2, ROWS + 2, COLUMNS + 4)).astype(dtype)
    return StoredView(scalars=known | scalars, radiance=radiance, truth=truth, same_optics=same_optics)


def spec_of(**changes: Any) -> Any:
    """Return what the functions read of a specification."""
    lens = SimpleNamespace(distortion=np.zeros(8))
    camera = SimpleNamespace(intrinsics=np.array([9.0, 9, 3, 2]), lens=lens)
    layers = changes.pop("layers", ("depth_m",))
    own = {"camera": camera, "scene": SimpleNamespace(dataset=SimpleNamespace(layers=layers))}
    return SimpleNamespace(**own, terrain=SimpleNamespace(surface=None), **changes)


# --- truth ------------------------------------------------------------------------------------------------


def test_stored_truth_is_that_of_a_camera_with_the_same_pixels() -> None:
    truth = retaken._stored_truth(spec_of(), stored_view())
    assert truth is not None
    assert (truth.depth_m == 1).all()
    assert truth.emission_deg is None
    with_angles = retaken._stored_truth(spec_of(layers=("emission_deg",)), stored_view())
    assert with_angles is not None
    assert with_angles.emission_deg is not None
    assert (with_angles.emission_deg == 7).all()


@pytest.mark.parametrize(
    ("layers", "scalars"),
    [
        (("depth_m",), {"intrinsics": np.array([9.0, 9, 3, 2.5])}),
        (("depth_m",), {"distortion": np.full(8, 1e-6)}),
        (("albedo",), {}),  # stored, but it needs the dust and the materials that pixels show
        (("incidence_deg",), {}),
    ],
)
def test_other_pixels_and_other_layers_need_new_truth(layers: tuple[str, ...], scalars: dict[str, Any]) -> None:
    assert retaken._stored_truth(spec_of(layers=layers), stored_view(**scalars)) is None


# --- radiance ---------------------------------------------------------------------------------------------


def _radiance(monkeypatch: pytest.MonkeyPatch, stored: StoredView, *, sees_sun: bool) -> Any:
    """Return the radiance of a view; the Sun, if seen, gives 5 in the pixel (1, 2)."""

    def add(out: Any, *_: Any) -> str:
        out[:, 1, 2] += 5
        return "the disc is seen"

    view = SimpleNamespace(height_px=ROWS, width_px=COLUMNS, intrinsics=np.array([9.0, 9, 3, 2]))
    scene = SimpleNamespace(view=view, sun=None, wavelength_nm=(450.0, 550.0))
    monkeypatch.setattr(retaken, "may_see_sun", lambda *_: sees_sun)
    monkeypatch.setattr(render, "sun_in_view", lambda *_: "disc")
    monkeypatch.setattr(retaken, "add_mean", add)
    monkeypatch.setattr(retaken, "Pinhole", lambda *_: None)
    return retaken._radiance(spec_of(), scene, stored)  # type: ignore[arg-type]


def test_the_middle_of_a_wider_render_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    stored = stored_view()
    made = _radiance(monkeypatch, stored, sees_sun=False)
    assert np.array_equal(made.array, stored.radiance[:, 1:-1, 2:-2])
    assert made.sun is None


@pytest.mark.parametrize(
    ("same_optics", "dtype", "exact"),
    [(True, np.float32, True), (False, np.float32, False), (True, np.float16, False)],
)
def test_pixels_of_the_sun_are_exact_or_as_if_the_scene_were_dark(
    monkeypatch: pytest.MonkeyPatch, same_optics: bool, dtype: Any, exact: bool
) -> None:
    """The stored sum is kept if the same aperture saw the Sun; otherwise the Sun stands alone there."""
    stored = stored_view(same_optics=same_optics, dtype=dtype)
    middle = stored.radiance[:, 1:-1, 2:-2].astype(np.float32)
    made = _radiance(monkeypatch, stored, sees_sun=True)
    assert (made.sun[:, 1, 2] == 5).all()
    assert (made.sun.sum(axis=(1, 2)) == 5).all()
    if not exact:
        middle[:, 1, 2] = 5
    assert np.array_equal(made.array, middle)


# --- which views are resolved -----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Spec:
    """A specification of a sample whose faults are given."""

    commanded: tuple[str, ...]
    index: int = 0
    scene: Any = None
    plan: Any = None


@pytest.mark.parametrize("required", [True, False])
@pytest.mark.parametrize("commanded", [("straylight",), ("vignetting",)])
@pytest.mark.parametrize(("visible", "towards"), [(1.0, 1.0), (0.9, 1.0), (1.0, -1.0)])
def test_a_fault_that_needs_the_sun_is_resolved_only_where_it_is_seen(
    monkeypatch: pytest.MonkeyPatch, required: bool, commanded: tuple[str, ...], visible: float, towards: float
) -> None:
    pose = Pose(
        position_L_m=np.zeros(3),
        L_from_C=np.eye(3),
        sun_L=np.array([0.0, 0.0, towards]),
        sun_azimuth_deg=0.0,
        sun_elevation_deg=90.0,
        sun_visible_fraction=visible,
        tries=1,
        variables={},
        resolved=True,
    )
    session = object.__new__(RetakeSession)
    scene = SimpleNamespace(
        geometry=SimpleNamespace(sun_visibility="required" if required else "any"),
        is_flown=False,
        model_copy=lambda update: None,
    )
    faults = {"straylight": SimpleNamespace(needs_sun=True), "vignetting": SimpleNamespace(needs_sun=False)}
    session._scene, session._plan = scene, None  # type: ignore[assignment]
    session._views = SimpleNamespace(repeats=1)  # type: ignore[assignment]
    session._world = SimpleNamespace(faults=faults)  # type: ignore[assignment]
    spec = _Spec(commanded, scene=SimpleNamespace(sun=None))
    monkeypatch.setattr(session, "_view", lambda _: (spec, pose, None, 1))
    monkeypatch.setattr(retaken, "simulate_stored_view", lambda spec, pose, *_: pose)
    seen = visible == 1.0 and towards > 0
    expected = seen or not required or commanded == ("vignetting",)
    assert session.frame(0).resolved == expected  # type: ignore[attr-defined]


# --- which lenses fit -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("focal_length_px", "guard_px", "says"),
    [
        (100.0, (2, 1), ""),
        (100.0 * (1 + 2e-6), (0, 0), "its focal length is 100 px, but the radiance of .* has 100 px"),
        (100.1, (0, 0), "its focal length is 100.1 px"),
        (100.0, (3, 0), "needs light from 3 px around the frame, and .* has 1 px"),
        (100.0, (0, 2), "needs light from 2 px around the frame, and .* has 1 px"),
    ],
)
def test_a_lens_must_have_the_scale_and_the_guard_band_of_the_store(
    focal_length_px: float, guard_px: tuple[int, int], says: str
) -> None:
    shape = SimpleNamespace(rendered_shape=(ROWS + 2, COLUMNS + 4), height=ROWS, width=COLUMNS)
    opened: Any = SimpleNamespace(
        begun=lambda: [0], column=lambda *_: np.array([[100.0, 100, 3, 2]]), spec=shape, path="s.zarr"
    )
    session: Any = SimpleNamespace(
        base_camera=SimpleNamespace(focal_length_px=focal_length_px, lens=SimpleNamespace(guard_px=guard_px)),
        scene=SimpleNamespace(camera=SimpleNamespace(lens="a", focus="infinity")),
    )
    if not says:
        retake._check_grid(opened, session, "scene")
        return
    with pytest.raises(InputError, match=says):
        retake._check_grid(opened, session, "scene")


@pytest.mark.parametrize("key", retake._OPTICS)
def test_any_other_optics_make_another_aperture(finished_store: Any, key: str) -> None:

    opened = store.open_store(finished_store)
    attributes = {**opened.attributes, "scene": {"camera": {"lens": "a", "f_number": 4.0}}}
    stub: Any = SimpleNamespace(spec=opened.spec, attributes={**attributes, "blocks": [opened.samples]})
    before = stub.attributes["scene"]["camera"]
    assert retake._StoredViews(stub, before)._same_optics
    assert not retake._StoredViews(stub, {**before, key: "other"})._same_optics


# --- what may differ, and what is taken -------------------------------------------------------------------


def differing(changed: dict[str, Any]) -> list[str]:
    """Return the keys in which a scene may not differ from a stored one, but does."""
    camera = {"fov_deg": 60.0, "width_px": 8, "height_px": 8, "focus_distance_m": 100.0, "lens": "a"}
    stored: dict[str, Any] = {
        "camera": camera,
        "dataset": {"sites": 2, "seed": 1},
        "plan": {"mode": "per_class", "pair_strata": False},
        "faults": {"vignetting": {}},
        "shape_sha256": "a",
        "lens_sha256": "a",
    }
    wanted = {**stored, **{table: values for table, values in changed.items() if not isinstance(values, dict)}}
    for table, values in changed.items():
        if isinstance(values, dict):
            wanted[table] = {**stored.get(table, {}), **values}
    return [difference.text("before", "now").split(" ")[0] for difference in retake._differing(stored, wanted)]


@pytest.mark.parametrize(
    ("changed", "keys"),
    [
        ({}, []),
        ({"camera": {"lens": "b", "exposure_s": 1.0}, "lens_sha256": "b"}, []),
        *[({"camera": {key: 7}}, [f"camera.{key}"]) for key in sorted(retake._FIXED_OF_CAMERA)],
        ({"shape_sha256": "b"}, ["shape_sha256"]),
        ({"dataset": {"seed": 2, "samples": 9, "licence": "x"}, "title": "other"}, []),
        ({"dataset": {"sites": 3}, "plan": {"mode": "independent"}}, ["dataset.sites"]),
        ({"plan": {"pair_strata": True}}, ["plan.pair_strata"]),
        ({"faults": {"smear": {}}, "coma": {"afrho_cm": 100.0}}, ["coma.afrho_cm"]),
    ],
)
def test_only_what_the_radiance_does_not_depend_on_may_differ(changed: dict[str, Any], keys: list[str]) -> None:
    assert differing(changed) == keys
    assert sorted(retake._FIXED_OF_CAMERA) == ["focus_distance_m", "fov_deg", "height_px", "width_px"]


@pytest.mark.parametrize(
    ("stored", "wanted", "repeats"),
    [(None, 1, 1), (None, 3, 3), (2, 2, 1), (2, 4, 2), (3, 6, 2), (2, 3, 0), (4, 2, 0)],
)
def test_each_stored_sample_is_taken_as_often_as_the_variants_say(
    stored: int | None, wanted: int, repeats: int
) -> None:
    table = {} if stored is None else {"variants_per_view": stored}
    opened: Any = SimpleNamespace(attributes={"scene": {"dataset": table}}, path="s.zarr")
    scene: Any = SimpleNamespace(dataset=SimpleNamespace(variants_per_view=wanted))
    if repeats:
        assert retake._repeats(opened, scene, "scene") == repeats
        return
    with pytest.raises(InputError, match=f"{wanted}: s.zarr has {stored} samples .* a multiple of {stored}"):
        retake._repeats(opened, scene, "scene")


def test_the_checksum_of_the_old_store_is_that_of_the_samples_taken(finished_store: Any) -> None:

    opened = store.open_store(finished_store)  # shards of 4 samples
    chosen = ([0, 1, 5], [0, 1, 6], [0, 5], [0, 1, 5, 9])
    digests = [retake._checksums(opened, np.array(samples)) for samples in chosen]
    assert len(set(digests)) == len(chosen)
    rows = np.concatenate([opened.column("crc32c", number) for number in range(opened.shards)])
    assert digests[3] == hashlib.sha256(rows[[0, 1, 5, 9]].tobytes()).hexdigest()


@pytest.mark.parametrize(
    ("layers", "scene", "layer"),
    [
        (("radiance", "scene_radiance"), {"camera": {"lens": "a"}, "sky": {"stars": "on"}}, "scene_radiance"),
        (("radiance",), {"camera": {}}, "radiance"),
        (("radiance",), {"camera": {}, "sky": {"stars": "off"}}, "radiance"),
        (("radiance",), {"camera": {}, "sky": {"stars": "auto"}}, ""),
        (("radiance",), {"camera": {"lens": "a"}}, ""),
        (("depth_m",), {"camera": {}}, ""),
    ],
)
def test_the_radiance_before_the_lens_and_without_stars_is_used(
    layers: tuple[str, ...], scene: dict[str, Any], layer: str
) -> None:
    spec: Any = SimpleNamespace(layers=layers)
    assert retake._radiance_layer(spec, {"scene": scene}) == layer
