"""Parts of a retake: which stored truth and radiance are used, which views count as resolved, which lenses fit."""

from __future__ import annotations

import dataclasses
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

    view = SimpleNamespace(height_px=ROWS, width_px=COLUMNS, pixel_map=None)
    scene = SimpleNamespace(view=view, sun=None, wavelength_nm=(450.0, 550.0))
    monkeypatch.setattr(retaken, "may_see_sun", lambda *_: sees_sun)
    monkeypatch.setattr(render, "sun_in_view", lambda *_: "disc")
    monkeypatch.setattr(retaken, "add_mean", add)
    return retaken._radiance(spec_of(), scene, stored)  # type: ignore[arg-type]


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
