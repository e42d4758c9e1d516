"""Straylight from a prescription: the light of a frame, its truth, and what its keys do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import needs_llvm, recorded_calls
from lens_kit import sunlit
from test_faults_kit import flat_electrons, make_context

from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.shared_results import SharedResults
from vbnfault.faults import FaultContext, from_dict, registry
from vbnfault.lens import load_lens, paraxial_properties, scaled_to_focal_length
from vbnfault.lens.coating import mean_reflectance
from vbnfault.lens.rays import ghost, transmittance
from vbnfault.lens.straylight.irradiance import FlareModel
from vbnfault.lens.straylight.starburst import Starburst
from vbnfault.lens.straylight.total import anew

needs_llvm()

MODELS = ("traced", "paraxial")
SIZE = 256
SUN = (0.8 * SIZE, 0.35 * SIZE)


def context(sun: tuple[float, float] | None = SUN, **more: Any) -> FaultContext:
    made = make_context(SIZE, sun_xy_px=sun, exposure_s=1e-3)
    return sunlit(made, spectra.band_nodes_nm(400.0, 700.0, 4), 3.0, **more)


def light(model: str, where: FaultContext, **keys: Any) -> tuple[Any, dict[str, Any]]:
    """What a fault adds, electrons float64[y, x, 3], and its parameters."""
    fault = registry()["straylight"][model](**({"cleanliness_level": 0, "roughness_nm": 1.0} | keys))
    params = fault.draw(where, np.random.default_rng(3))
    black = flat_electrons(where, 0.0)
    return fault.apply(black, params, where).array.astype(np.float64), params


def test_what_is_left_of_the_direct_light_is_a_mean_over_each_channels_bands() -> None:
    """Each channel's weights add up to 1, so nearly all is left where the surfaces are smooth and nothing veils."""
    where = context()
    fault = registry()["straylight"]["paraxial"](cleanliness_level=0, roughness_nm=0, veil_fraction=0)
    found = fault.added_light(fault.draw(where, np.random.default_rng(3)), where, anew)
    assert found is not None
    assert found.direct_left.shape == (3,)
    # starburst takes 11 to 13 % here; weights of four bands in three channels that did not add up to 1 in each
    # channel would give a third more
    assert (found.direct_left > 0.8).all()
    assert (found.direct_left <= 1).all()


@pytest.mark.parametrize("model", MODELS)
def test_ghosts_lie_on_the_line_from_the_sun_through_the_centre(model: str) -> None:
    where = context()
    added, params = light(model, where, coating="none", roughness_nm=0)
    assert (added >= 0).all()
    assert len(params["ghosts"]) >= 10
    middle = np.array([SIZE / 2, SIZE / 2])
    along = (np.array(SUN) - middle) / np.hypot(*(np.array(SUN) - middle))
    across = np.array([-along[1], along[0]])
    for g in params["ghosts"]:
        place = np.array([g["x_px"], g["y_px"]]) - middle
        # a ghost's rays are symmetrical about the line; of wide ones, to some parts in a thousand
        assert abs(place @ across) < 0.05 + 0.004 * g["rms_radius_px"]
    # so is the whole picture: mirrored about that line it is itself, but for resampling
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    side = np.stack([x - middle[0], y - middle[1]], axis=-1)
    mirrored = side - 2 * (side @ across)[..., None] * across
    mx, my = (np.floor(mirrored[..., k] + middle[k]).astype(int) for k in (0, 1))
    inside = (mx >= 0) & (mx < SIZE) & (my >= 0) & (my < SIZE)
    green = added[..., 1]
    other = green[my[inside], mx[inside]]
    assert np.corrcoef(np.log(green[inside] + 1), np.log(other + 1))[0, 1] > 0.98


def test_models_agree_on_the_pairs_and_differ_in_the_light() -> None:
    (a, p), (b, q) = (light(model, context(), coating="none") for model in MODELS)
    assert {tuple(g["pair"]) for g in p["ghosts"]} & {tuple(g["pair"]) for g in q["ghosts"]}
    assert 0.3 < a.sum() / b.sum() < 3
    assert np.abs(a - b).max() > 0.1 * a.mean()


def test_light_follows_sun_exposure_and_coating() -> None:
    where = context()
    base, _ = light("traced", where)
    assert where.sun_irradiance_W_m2_nm is not None
    twice, _ = light("traced", replace(where, sun_irradiance_W_m2_nm=2 * where.sun_irradiance_W_m2_nm))
    np.testing.assert_allclose(twice, 2 * base, rtol=1e-4, atol=1e-3)
    half, _ = light("traced", replace(where, sun_visible_fraction=0.5))
    np.testing.assert_allclose(half, base / 2, rtol=1e-4, atol=1e-3)
    longer = replace(where, camera=replace(where.camera, exposure_s=4e-3))
    np.testing.assert_allclose(light("traced", longer)[0], 4 * base, rtol=1e-4, atol=1e-3)
    truths = [light("traced", where, coating=c) for c in ("bbar", "mgf2", "none")]
    flux = [sum(ghost["flux_fraction"] for ghost in params["ghosts"]) for _, params in truths]
    assert 5 * max(flux[:2]) < flux[2]
    far = np.hypot(*(np.mgrid[:SIZE, :SIZE] - np.array(SUN[::-1])[:, None, None])) > 40
    assert np.median(truths[1][0][far]) < np.median(truths[2][0][far])
    dirty, _ = light("traced", where, cleanliness_level=500)
    assert np.median(dirty[far]) > np.median(base[far])


@pytest.mark.parametrize("model", ["paraxial", "traced"])
def test_a_filter_before_the_lens_dims_all_straylight(model: str) -> None:
    """A filter of 1/20 leaves 1/20 of ghosts, starburst, glare and veil; both lose more than the traced lens."""
    where = context()
    lens = where.camera.lens
    added = [
        light(model, replace(where, camera=replace(where.camera, lens=replace(lens, transmission=t))))[0]
        for t in (0.2, 0.01)
    ]
    assert added[0].max() > 0
    np.testing.assert_allclose(added[1], added[0] / 20, rtol=1e-4, atol=1e-6 * added[0].max())


def test_no_sun_no_light() -> None:
    for where in (context(None), context(sun_visible_fraction=0.0)):
        added, params = light("traced", where)
        assert not added.any()
        assert params["ghosts"] == []


def test_a_sun_outside_the_field_still_gives_ghosts() -> None:
    added, _ = light("traced", context((1.25 * SIZE, 0.5 * SIZE)), coating="none")
    assert added.max() > 0


def test_a_slow_camera_closes_the_stop() -> None:
    where = context((SIZE / 2, SIZE / 2))

    def at(f_number: float) -> tuple[Any, dict[tuple[int, ...], float]]:
        camera = replace(where.camera, lens=replace(where.camera.lens, f_number=f_number))
        added, params = light("traced", replace(where, camera=camera), coating="none")
        return added, {tuple(g["pair"]): g["rms_radius_px"] for g in params["ghosts"]}

    (added, wide), (again, _), (_, narrow) = (at(n) for n in (2.0, 1.4, 8.0))
    np.testing.assert_array_equal(added, again)  # the stop opens no farther than the f/2.8 of the prescription
    shared = wide.keys() & narrow.keys()
    assert len(shared) >= 10
    # a paraxial ghost is the stop's image; some are bound by other rims, or all but in focus
    assert np.median([narrow[pair] / wide[pair] for pair in shared]) == pytest.approx(2.8 / 8, rel=0.1)


def test_the_lens_is_the_cameras_own_or_the_one_named() -> None:
    where = context()
    default, _ = light("traced", where, coating="as_prescribed")
    named, params = light("traced", where, lens="nikkor_35_f2p8", coating="as_prescribed")
    np.testing.assert_array_equal(default, named)
    other, _ = light("traced", where, lens="tessar_50_f2p8", coating="as_prescribed")
    assert np.abs(other - named).max() > 0
    scaled = scaled_to_focal_length(load_lens("tessar_50_f2p8"), where.camera.lens.focal_length_mm)
    assert paraxial_properties(scaled).efl_mm == pytest.approx(where.camera.lens.focal_length_mm)
    assert params["lens"] == "nikkor_35_f2p8"
    with pytest.raises(InputError, match=r"scene\.toml: faults\.straylight|no_such_lens"):
        from_dict("straylight", {"model": "traced", "lens": "no_such_lens"}, source="scene.toml")
    with pytest.raises(InputError, match="baffle_length_mm"):
        from_dict("straylight", {"model": "traced", "baffle_length_mm": 5.0}, source="scene.toml")
    with pytest.raises(InputError, match="reflections = 3"):
        from_dict("straylight", {"model": "traced", "reflections": 3}, source="scene.toml")


@pytest.mark.parametrize("model", MODELS)
def test_worn_coatings_raise_ghosts(model: str) -> None:
    """Mirrors reflect the mean of coated and bare; what passes stays as it was."""
    where = context((0.52 * SIZE, 0.5 * SIZE))
    worn = from_dict("optics_degradation", {"model": "contamination"}, source="test").inform(
        where, {"coating_loss": 0.5}
    )
    fluxes = []
    for there, coating in ((where, "mgf2"), (worn, "mgf2"), (where, "none"), (worn, "none")):
        added, params = light(model, there, coating=coating, roughness_nm=0)
        ghosts = {tuple(g["pair"]): g["flux_fraction"] for g in params["ghosts"]}
        fluxes.append((added, ghosts))
    (coated, a), (half, b), (bare, c), (again, d) = fluxes
    np.testing.assert_array_equal(bare, again)
    assert c == d
    shared = set(a) & set(b) & set(c)
    assert len(shared) >= 8
    lens = where.frame.prescription("", "mgf2")
    nm = np.linspace(400.0, 700.0, 301)
    sensed = where.camera.detector.electron_rates(nm) * spectra.solar_irradiance_W_m2_nm(nm)
    weight = (sensed / sensed.sum(axis=1, keepdims=True)).mean(axis=0)
    index = [np.ones(len(nm)), *(surface.medium.index(nm) for surface in lens.surfaces)]
    gains = []
    for pair in shared:
        assert a[pair] < b[pair] < 1.02 * c[pair] / 0.7**2
        coated_, bare_ = (
            np.array([mean_reflectance(f, *index[k : k + 2], 1.0, nm) for k, f in zip(pair, films, strict=True)])
            for films in ([lens.surfaces[k].coating for k in pair], [(), ()])
        )
        share = weight * transmittance(lens, ghost(lens, *pair), nm)
        gain = (share * np.prod(0.5 * (1 + bare_ / coated_), axis=0)).sum() / share.sum()
        gains.append(b[pair] / a[pair] / gain)
    # of the Sun's light near the axis, told at normal incidence
    assert np.median(gains) == pytest.approx(1, abs=0.02)
    assert coated.sum() < half.sum()


def test_samples_of_a_view_share_whole_ghosts_and_the_starburst(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each sample has its own roughness, dust, veil and worn coatings, and the same bits as alone."""
    ghosts, starbursts = (recorded_calls(monkeypatch, kind, "image") for kind in (FlareModel, Starburst))
    keys = [{"roughness_nm": 0.5, "veil_fraction": 0.01}, {}, {"cleanliness_level": 90}, {"coating": "none"}, {}]
    samples = [({"coating": "bbar"} | own, loss) for own, loss in zip(keys, (0.0, 0.4, 0.0, 0.0, 0.1), strict=True)]
    of_view = SharedResults(kept=True)
    together = [light("paraxial", context(coating_loss=loss, of_view=of_view), **own) for own, loss in samples]
    # whole coatings, worn coatings twice, other coatings; the camera's own lens has one starburst
    assert (len(ghosts), len(starbursts)) == (4, 1)
    alone = [light("paraxial", context(coating_loss=loss), **own) for own, loss in samples]
    assert (len(ghosts), len(starbursts)) == (4 + 5, 1 + 5)
    for (added, params), (added_alone, params_alone) in zip(together, alone, strict=True):
        np.testing.assert_array_equal(added, added_alone)
        assert params == params_alone
    light("paraxial", context(of_view=of_view), lens="tessar_50_f2p8")
    assert (len(ghosts), len(starbursts)) == (9 + 1, 6 + 1)
