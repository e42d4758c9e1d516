"""Views that keep what was drawn: uniform variables, an exact fault matrix, the paper's order, sites for Suns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, verified_store
from scipy import stats

from vbnfault.body import choose_sites
from vbnfault.core import frames
from vbnfault.core.errors import InputError
from vbnfault.pipeline import Session, resolve
from vbnfault.pipeline.spec import Pose
from vbnfault.scene import config, exchange, plan, redraw
from vbnfault.world import ground

# Every test is of a fixed seed; 1e-3 over about 16 comparisons.
LEVEL = 1e-3 / 16


def paper(samples: int = 5000, **settings: Any) -> tuple[config.Scene, plan.Plan]:
    """The packaged scene and its plan."""
    scene = config.load_scene("paper67p", {"dataset.samples": samples, **settings})
    return scene, plan.make_plan(scene, list(scene.faults), need_sun=["straylight"])


def test_straylight_comes_first_as_in_the_papers_equation() -> None:
    _, table = paper()
    straylight = table.injects("straylight")
    np.testing.assert_array_equal(straylight, np.arange(5000) < straylight.sum())
    np.testing.assert_array_equal(table.stratum == plan.SUN_FACING, straylight)
    for code in range(len(plan.SPLITS)):  # each split has all classes, and samples without any
        assert table.injected[table.split == code].any(axis=0).all()
        assert not table.injected[table.split == code].any(axis=1).all()
    for k, name in enumerate(table.faults):  # the others are randomly distributed: rank correlations of spread 1/√n
        here = table.injected[straylight, k]
        if name != "straylight":
            assert abs(stats.spearmanr(np.arange(len(here)), here).statistic) < 4.5 / np.sqrt(len(here))


@pytest.mark.parametrize("stratum", [plan.SUN_FACING, plan.SUN_AVERTED])
def test_every_variable_is_uniform_and_the_sun_out_of_averted_frames(stratum: int) -> None:
    scene, table = paper()
    here = table.stratum == stratum
    for name in redraw.VARIABLES:
        low, high = (bound[stratum] for bound in redraw.bounds(scene, name))
        assert stats.kstest((table.variables[name][here] - low) / (high - low), "uniform").pvalue > LEVEL
    if stratum == plan.SUN_AVERTED:
        angle = frames.boresight_angle_deg(*(table.variables[name][here] for name in ("roll_deg", "pitch_deg")))
        assert angle.min() >= redraw.least_sun_angle_deg(scene)


def test_suns_of_a_site_come_from_one_sector_and_views_move_within_a_shard() -> None:
    scene, table = paper()
    facing = table.stratum == plan.SUN_FACING
    azimuth = table.variables["sun_azimuth_deg"]
    widths = [np.ptp(azimuth[facing & (table.site == site)]) for site in range(scene.dataset.sites)]
    # 64 sectors of 5.6 degrees; sites with one shard more than others have wider ones
    assert max(widths) < 15
    for index in (0, 1481 + 5, 4999):
        members = table.members(index)
        assert index in members
        assert {k // 8 for k in members} == {index // 8}
        assert {table.stratum[k] for k in members} == {table.stratum[index]}
        seen = [table.view(scene, index, attempt) for attempt in range(len(members))]
        moved = redraw.VARIABLES if not facing[index] else ("x_m", "y_m", "height_m")
        for name in redraw.VARIABLES:
            of_members = table.variables[name][members].tolist()
            kept = [table.variables[name][index]] * len(members)
            assert sorted(view[name] for view in seen) == sorted(of_members if name in moved else kept)
    # behind the members: another position under the same Sun, at last another Sun
    first, later, last = (table.view(scene, 0, k) for k in (0, 8, 8 + exchange.KEPT_TRIES))
    assert {name for name in first if first[name] != later[name]} == {"x_m", "y_m", "height_m"}
    assert all(first[name] != last[name] for name in first)


def test_an_appended_block_leaves_views_and_sites_of_the_first_alone() -> None:
    scene, _ = paper(samples=100)
    short, long = (
        plan.make_plan(scene, list(scene.faults), b, need_sun=["straylight"]) for b in ([100], [100, 60])
    )
    for name in redraw.VARIABLES:
        np.testing.assert_array_equal(short.variables[name], long.variables[name][:100])
    for index in range(100):
        assert short.members(index) == long.members(index)
    for site in np.unique(short.site[short.stratum == plan.SUN_FACING]).tolist():
        np.testing.assert_array_equal(short.suns_of_site(site), long.suns_of_site(site))


def test_pairs_of_the_papers_order_share_site_and_sun() -> None:
    _, table = paper(**{"plan.pair_strata": True})
    follows = np.flatnonzero(table.paired & (table.stratum == plan.SUN_AVERTED))
    assert len(follows) > 1400  # nearly all of the 1481 Sun-facing samples
    for index in follows[::100]:
        (lead,) = np.flatnonzero((table.draw == table.light[index]) & (table.stratum == plan.SUN_FACING))
        assert table.site[lead] == table.site[index]
        for name in ("sun_azimuth_deg", "sun_elevation_deg"):
            assert table.variables[name][lead] == table.variables[name][index]
    with pytest.raises(InputError, match=r"plan\.pair_strata = true: needs .*'exchange'"):
        config.load_scene("paper67p", {"plan.pair_strata": True, "plan.unusable_views": "redraw"})


def test_more_suns_are_seen_from_the_sites_that_are_chosen_for_them() -> None:
    scene, table = paper()
    session = Session(scene)
    site = int(table.site[0])
    suns = table.suns_of_site(site)
    drawn = {name: values[suns] for name, values in table.variables.items()}
    model = ground.shape_model(session.body)
    random = choose_sites(session.body, 8, scene.dataset.seed)
    seen = [ground.suns_seen(scene, model, random[k], drawn).mean() for k in range(8)]
    chosen = ground.suns_seen(scene, model, session.sites[site], drawn)
    assert chosen.mean() > max(0.9, np.mean(seen))
    assert ground.suns_seen(scene, model, random[0], {**drawn, "sun_elevation_deg": np.full(len(suns), 89.0)}).all()


# The paper's geometry over a small body with coarse ground. Half of the Suns are below the horizon.
EXCHANGE = {"unusable_views": "exchange", "order": "sun_first", "mode": "per_sample", "faulty_fraction": 0.8}


def small(**tables: dict[str, Any]) -> config.Scene:
    given = small_scene(
        **{
            **tables,
            "dataset": {"samples": 48, "sites": 4, "shard_samples": 16, "layers": ["clean"]}
            | tables.get("dataset", {}),
            "camera": {"width_px": 48, "height_px": 48},
            "plan": {**EXCHANGE, **tables.get("plan", {})},
        }
    )
    return config.parse_scene(given, source="test")


def test_the_samples_of_a_shard_exchange_positions_and_views_so_that_all_can_be_used() -> None:
    session = Session(small())
    table = session.plan
    poses: list[Pose] = [resolve.resolve(session.spec(index)) for index in range(len(table))]
    exchanged = again = 0
    for index, pose in enumerate(poses):
        members, first = table.members(index), table.view(session.scene, index, 0)
        exchanged += 1 < pose.tries <= len(members)
        again += pose.tries > len(members)
        if table.stratum[index] == plan.SUN_FACING:
            assert pose.sun_visible_fraction == 1
            if pose.tries <= len(members) + exchange.KEPT_TRIES:  # the Sun and the attitude are those drawn
                kept = {k: v for k, v in first.items() if k not in ("x_m", "y_m", "height_m")}
                assert kept.items() <= dict(pose.variables).items()
        # what a sample takes, no other one of its shard keeps
        others = [poses[k] for k in members if k != index and poses[k].tries <= len(members)]
        assert all(other.variables["x_m"] != pose.variables["x_m"] for other in others)
    assert exchanged >= 4
    assert again <= 1
    # a single sample is that of the whole shard
    alone = Session(small())
    index = next(k for k, pose in enumerate(poses) if pose.tries > 1)
    assert resolve.resolve(alone.spec(index)).variables == poses[index].variables


@pytest.mark.parametrize(
    "literal",
    [{}, {"plan": {"pair_strata": True}, "geometry": {"sun_visibility": "as_drawn", "height_reference": "site"}}],
)
def test_the_fault_matrix_is_exact_also_where_the_paper_is_taken_literally(
    literal: dict[str, Any], tmp_path: Path
) -> None:
    opened = verified_store(small(**literal, dataset={"samples": 24}), tmp_path / "s.zarr")
    commanded = [json.loads(str(text))["injected"] for text in np.asarray(opened.read("proposal"))]
    injected = np.asarray(opened.read("injected"))
    names = np.array(opened.spec.faults)
    assert [set(names[row]) for row in injected] == [set(row) for row in commanded]
    assert injected.any(axis=1).sum() == round(0.8 * 24)
