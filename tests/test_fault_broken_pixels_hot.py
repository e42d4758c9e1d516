"""Hot and dead pixels of the camera's own device: age, dose, exposure, and how far the mosaic spreads them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from test_faults_kit import flat_electrons, make, make_context, rng, with_mosaic

from vbnfault import config
from vbnfault.errors import InputError
from vbnfault.faults import FaultContext
from vbnfault.pipeline import Session
from vbnfault.quantities import Charge

SIZE = 128
KEYS: dict[str, Any] = {"years": 5.0, "growth_factor": 2e4, "dose_TeV_g": 0.0, "clustered_share": 0.0}


def context(exposure_s: float = 0.02, **sensor: Any) -> FaultContext:
    made = with_mosaic(make_context(SIZE, architecture="cmos"), **sensor)
    return replace(made, camera=replace(made.camera, exposure_s=exposure_s))


def added(where: FaultContext, params: dict[str, Any]) -> Any:
    """Electrons that the defects add to a dark mosaic, float64[y, x]."""
    dark = Charge(array=np.zeros(where.shape, dtype=np.float32))
    return make("broken_pixels", model="hot_pixels").apply(dark, params, where).array.astype(np.float64)


def drawn(where: FaultContext, **keys: Any) -> dict[str, Any]:
    return make("broken_pixels", model="hot_pixels", **(KEYS | keys)).draw(where, rng(1))


def test_defects_grow_with_exposure_from_their_offset() -> None:
    """I = R T + b: from three exposures the same line."""
    params = drawn(context(), least_dn=0.001)
    shots = {t: added(context(t), params) for t in (0.01, 0.05, 0.25)}
    hot = np.logical_and.reduce([shot > 0 for shot in shots.values()])
    assert hot.sum() > 30
    rate = (shots[0.25] - shots[0.05])[hot] / 0.2
    np.testing.assert_allclose((shots[0.05] - shots[0.01])[hot], 0.04 * rate, rtol=1e-3, atol=0.02)
    offset = shots[0.01][hot] - 0.01 * rate
    # Chapman et al.: over 40 % of defects have one; 45 % here, of some 50
    assert 0.2 < (offset > 1).mean() < 0.7
    assert (rate > 0).all()


def test_age_and_dose_keep_what_is_there() -> None:
    where = context(0.1)
    young, old = (added(where, drawn(where, years=y, least_dn=0.01)) for y in (2.0, 8.0))
    assert (young > 0).sum() < (old > 0).sum()
    # a later defect may fall on an earlier one
    assert (old[young > 0] > 0.99999 * young[young > 0]).all()
    assert np.mean(old[young > 0] < 1.00001 * young[young > 0]) > 0.9
    hit, unhurt = (added(where, drawn(where, growth_factor=1.0, dose_TeV_g=d, least_dn=0.01)) for d in (20.0, 0.0))
    assert (hit > 0).sum() > (unhurt > 0).sum() + 100
    cold = replace(where.camera.detector, sensor=replace(where.camera.detector.sensor, temperature_K=253.0))  # type: ignore[union-attr, type-var]
    frozen = replace(where, camera=replace(where.camera, detector=cold))
    params = drawn(where, dose_TeV_g=20.0, growth_factor=1.0, least_dn=0.001)
    # 0.63 eV from 293 to 253 K, in all pixels whose damage shows in both: a factor of 51.6
    warm, less = added(where, params), added(frozen, params)
    both = (warm > 0) & (less > 0)
    assert np.median(warm[both] / less[both]) == pytest.approx(51.6, rel=0.02)


def test_defects_stay_in_their_mask_when_the_mosaic_spreads_them() -> None:
    where = context(0.1)
    keys = KEYS | {"growth_factor": 2e3, "dead_per_year": 1e-6, "least_dn": 2.0}
    fault = make("broken_pixels", model="hot_pixels", **keys)
    params = fault.draw(where, rng(2))
    assert 0 < params["count"] < 400
    detector: Any = where.camera.detector
    signal = flat_electrons(where, 0.4)

    def act(array: Any) -> Any:
        return fault.apply(Charge(array=array), params, where).array

    before, after = (detector.develop(signal, 0.1, None, acts).array for acts in ({}, {"pixels": [act]}))
    changed = (before != after).any(axis=2)
    mask = fault.footprint(params, where)
    assert mask is not None
    assert changed.any()
    assert not (changed & ~mask).any()
    # and every pixel named by the parameters is in it
    assert mask[params["y"], params["x"]].all()
    assert mask.mean() < 0.6


def test_a_scene_without_a_mosaic_refuses_it() -> None:
    scene = {**small_scene(), "faults": {"broken_pixels": {"model": "hot_pixels"}}}
    with pytest.raises(
        InputError, match=r"faults\.broken_pixels\.model = 'hot_pixels': .* name a camera\.detector"
    ):
        Session(config.parse_scene(scene, source="test"), source="test")
