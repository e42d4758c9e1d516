"""Generated flights: motion against closed forms and conserved quantities, attitude, Sun, stores, and mistakes."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Called, recorded_calls
from scipy.integrate import quad
from scipy.optimize import brentq

import vbnfault
from vbnfault.body import Body, site_at
from vbnfault.core import frames
from vbnfault.core.errors import InputError
from vbnfault.dataset import describe_scene
from vbnfault.scene import config
from vbnfault.scene.config import Scene
from vbnfault.scene.trajectory import Trajectory
from vbnfault.world import flights, ground
from vbnfault.world.flights import fly

G = 6.67430e-11  # m³ kg⁻¹ s⁻², CODATA 2018
PERIOD_S = 20_000.0
SIX: dict[str, dict[str, Any]] = {
    "descent": {"period_s": 240.0, "height_m": [150, 200], "end_height_m": 20, "aside_m": [0, 40]},
    "orbit": {"period_s": 900.0, "radius_m": [1.5e3, 2e3]},
    "flyby": {"period_s": 200.0, "closest_m": 2e3, "speed_m_s": 0.8},
    "approach": {"period_s": 500.0, "range_m": [9e3, 3e3], "offset_deg": [1, 2]},
    "hover": {"period_s": 60.0, "height_m": 60, "dead_band_m": 1.0},
    "relocation": {"period_s": 300.0, "distance_m": [50, 60]},
}


@functools.cache
def rock() -> Body:
    """Return an ellipsoid of 1280 facets, whose centre of mass is 40 m from T's origin."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.asarray(sphere.vertices) * [900, 700, 600] + [40, 0, 0]
    return Body(
        name="rock", vertices_m=vertices, faces=sphere.faces, density_kg_m3=2000.0, rotation_period_s=PERIOD_S
    )


def ball(radius_m: float, period_s: float = 1e7) -> Body:
    """Return a sphere of 1280 facets, which is symmetric so that its field has no harmonics of degrees 1 to 5."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=3, radius=radius_m)
    return Body(
        name="ball",
        vertices_m=sphere.vertices,
        faces=sphere.faces,
        density_kg_m3=2000.0,
        rotation_period_s=period_s,
    )


def scene_of(*tables: dict[str, Any], period_s: float = PERIOD_S, **dataset: Any) -> Scene:
    """Return a scene of flights about a body that turns in `period_s`."""
    return config.parse_scene(
        {
            "title": "flights",
            "body": {"rotation_period_h": period_s / 3600},
            "trajectory": {"flight": list(tables)},
            "dataset": dataset,
        },
        source="test",
    )


def flight(kind: str, **values: Any) -> dict[str, Any]:
    """Return the table of a flight of five frames."""
    return {"kind": kind, "frames": 5, **SIX[kind], **values}


def inertial(body: Body, table: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities relative to the centre of mass, in axes that lie along T's at time 0."""
    spin = np.array([0, 0, body.omega_rad_s])
    offset = table.camera_position_T_m - body.centre_of_mass_T_m
    velocity = table.velocity_T_m_s + np.cross(spin, offset)
    turns = [frames.rz(body.omega_rad_s * t) for t in table.time_s]
    return tuple(np.array([m @ v for m, v in zip(turns, x, strict=True)]) for x in (offset, velocity))


# --- motion ---------------------------------------------------------------------------------------------------


def test_a_far_orbit_is_keplers() -> None:
    """A circle at 20 radii: the ball's first harmonic, of degree 6, is below (1/20)^6 = 2e-8 of gravity there.

    It is below 1 % of that, as the facets leave the sphere by 1 %. Over one period this moves the camera by about
    (2 π)² · 2e-10 radii of the orbit; the integrator adds some 100 steps of 1e-10.
    """
    body, radius_m = ball(500.0, 3e4), 10e3
    period_s = 2 * np.pi * np.sqrt(radius_m**3 / (G * body.density_kg_m3 * body.volume_m3))
    table = flight("orbit", radius_m=radius_m, period_s=period_s / 50, frames=51, inclination_deg=30, node_deg=50)
    flown = fly(scene_of(table, period_s=3e4), body)
    position, velocity = inertial(body, flown)
    x, y = position[0] / radius_m, velocity[0] / np.linalg.norm(velocity[0])
    angle = 2 * np.pi * flown.time_s[:, None] / period_s
    np.testing.assert_allclose(position, radius_m * (np.cos(angle) * x + np.sin(angle) * y), atol=2e-8 * radius_m)
    momentum = np.cross(position, velocity)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (51, 1)), atol=2e-8 * np.linalg.norm(momentum[0]))
    assert np.degrees(np.arccos(frames.unit(momentum[0])[2])) == pytest.approx(30, abs=1e-9)
    ascending = np.cross([0, 0, 1], momentum[0])
    assert np.degrees(np.arctan2(ascending[1], ascending[0])) == pytest.approx(50, abs=1e-9)


def test_a_flyby_is_a_hyperbola() -> None:
    """Distances from Kepler's hyperbolic equation, e sinh H - H = n t, counted from the middle frame."""
    body, closest_m, far_m_s = ball(500.0), 5e3, 0.1
    table = flight("flyby", closest_m=closest_m, speed_m_s=far_m_s, period_s=6000.0, frames=21, phase_deg=70)
    flown = fly(scene_of(table, period_s=1e7), body)
    gm = G * body.density_kg_m3 * body.volume_m3
    a, e = gm / far_m_s**2, 1 + closest_m * far_m_s**2 / gm
    mean = np.sqrt(gm / a**3) * (flown.time_s - 60_000)
    kepler = [brentq(lambda h, m=m: e * np.sinh(h) - h - m, -10, 10, xtol=1e-13) for m in mean]
    position, velocity = inertial(body, flown)
    distance = np.linalg.norm(position, axis=1)
    np.testing.assert_allclose(distance, a * (e * np.cosh(kepler) - 1), rtol=1e-7)  # degree 6 at 10 radii: 1e-8
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=1) ** 2, far_m_s**2 + 2 * gm / distance, rtol=1e-7)
    assert distance.argmin() == 10
    assert distance[10] == pytest.approx(closest_m, abs=1e-6)
    cosine = flown.sun_direction_T[10] @ frames.unit(flown.camera_position_T_m[10])
    assert np.degrees(np.arccos(cosine)) == pytest.approx(70, abs=1e-6)


@pytest.mark.parametrize("kind", ["descent", "orbit", "flyby", "relocation"])
def test_the_jacobi_constant_is_kept(kind: str) -> None:
    """In T, ½ v² - U - ½ ω² (x² + y²) stays, with U of the polyhedron, whatever the shape is.

    The integrator keeps positions to 1e-10 of some km and velocities to 1e-10 of 1 m/s, so the constant, of some
    0.1 m²/s², to about 1e-9.
    """
    body = rock()
    flown = fly(scene_of(flight(kind, sequences=2)), body)
    offset = flown.camera_position_T_m - body.centre_of_mass_T_m
    potential = body.gravity.evaluate(flown.camera_position_T_m).potential_m2_s2
    kinetic = 0.5 * (flown.velocity_T_m_s**2).sum(axis=1)
    jacobi = kinetic - potential - 0.5 * body.omega_rad_s**2 * (offset[:, :2] ** 2).sum(axis=1)
    for first in (0, 5):
        assert np.ptp(jacobi[first : first + 5]) < 2e-9
        assert np.ptp(kinetic[first : first + 5]) > 1e-4  # there is something to keep


def test_a_hop_on_flat_ground_is_a_parabola() -> None:
    """On a large facet of a sphere of 50 km, a hop of 40 m leaves with D/T level and g T/2 upward.

    Over 40 m gravity turns by up to D/R = 8e-4 and changes by 2 h/R, and the spin of 100 days adds 2 ω T = 4e-5.
    The ends lie on the verticals of their sites, 10 m up, which spread by D/R. All stay below 4 D/R.
    """
    body, time_s = ball(50e3, 8.64e6), 40.0
    hop = flight("relocation", distance_m=40.0, period_s=time_s / 10, frames=11)
    flown = fly(scene_of(hop, period_s=8.64e6), body)
    start, end = flown.camera_position_T_m[[0, -1]]
    _, facet = ground.nearest_ground(body, start)
    corners = body.vertices_m[body.faces[facet]]
    site = site_at(body, 0, start - 10 * frames.unit(np.cross(corners[1] - corners[0], corners[2] - corners[0])))
    down = site.T_from_L[:, 2]
    gravity = float(np.linalg.norm(body.effective_gravity(start)))
    level = (end - start) - (end - start) @ down * down
    t = flown.time_s[:, None]
    fallen = 0.5 * gravity * t * (t - time_s)
    parabola = start + (end - start) * t / time_s + fallen * down
    tolerance = 4 * 40 / 50e3
    height_m = 0.125 * gravity * time_s**2
    assert np.linalg.norm(end - start) == pytest.approx(40, rel=0.012)  # the sites are 40 m apart to 1 %
    np.testing.assert_allclose(flown.camera_position_T_m, parabola, atol=tolerance * height_m)
    launch = flown.velocity_T_m_s[0]
    rise = (end - start) @ -down / time_s + 0.5 * gravity * time_s
    assert launch @ -down == pytest.approx(rise, rel=tolerance)
    np.testing.assert_allclose(launch + rise * down, level / time_s, atol=tolerance * rise)


def test_a_fall_to_a_place_is_found_by_few_trial_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    """The even gravity of the middle is right to a tenth here, so each trial leaves a tenth of the miss or less.

    From some metres to a millimetre that takes five trials, and the fall itself is one more.
    """
    falls = recorded_calls(monkeypatch, flights, "_fall")
    monkeypatch.setattr(flights, "_flown", {})  # flights of other tests are not known
    fly(scene_of(flight("relocation", sequences=2)), rock())
    assert 2 * 3 <= len(falls) <= 2 * 6


def test_a_descent_has_its_heights_and_its_site() -> None:
    flown = fly(scene_of(flight("descent", height_m=180, aside_m=30, latitude_deg=[-40, 40], sequences=3)), rock())
    for first in (0, 5, 10):
        start, end = flown.camera_position_T_m[[first, first + 4]]
        hit = ground.first_hit(rock(), end, frames.unit(-end))
        assert hit is not None
        # the site lies 20 m below the last position along gravity, and gravity is 35 deg from the facet at most
        near_m, _ = ground.nearest_ground(rock(), end)
        assert 20 * np.cos(np.radians(35)) - 0.1 < near_m < 20.01
        assert np.linalg.norm(start - end) == pytest.approx(np.hypot(160, 30), abs=0.02)
        falling = (flown.velocity_T_m_s[first : first + 5] * frames.unit(end - start)).sum(axis=1)
        assert (np.diff(falling) > 0).all()


def test_a_hover_stays_in_its_band_and_falls_between_thrusts() -> None:
    """Between thrusts the second difference of positions is the effective gravity of the station."""
    body = rock()
    flown = fly(scene_of(flight("hover", frames=2001, period_s=2.0)), body)
    middle = flown.camera_position_T_m.mean(axis=0)
    down = frames.unit(body.effective_gravity(middle)[0])
    offset = flown.camera_position_T_m - middle
    up = offset @ -down
    assert np.ptp(up) == pytest.approx(1, abs=0.005)  # 1 s beside the top of an arc, it is g/2 = 2e-4 m lower
    assert np.linalg.norm(offset + up[:, None] * down, axis=1).max() < 1  # the band is 0.5 m to each side
    change = np.diff(flown.velocity_T_m_s, axis=0)
    # a thrust changes the velocity by twice the speed √(2 g 1 m) = 0.03 m/s of the fall, and gravity by 7e-4 in 2 s
    thrusts = np.linalg.norm(change, axis=1) > 0.01
    arc_s = 2 * np.sqrt(2 / np.linalg.norm(body.effective_gravity(middle)))
    assert thrusts.sum() == pytest.approx(4000 / arc_s, abs=1)
    # the mean position is up to 0.5 m from the station, 650 m from the centre: 0.15 % of gravity
    gravity = np.tile(body.effective_gravity(middle), ((~thrusts).sum(), 1))
    np.testing.assert_allclose(change[~thrusts] / 2, gravity, atol=0.002 * np.linalg.norm(gravity[0]))


def test_an_approach_is_straight_and_even() -> None:
    body = rock()
    flown = fly(scene_of(flight("approach", frames=9)), body)
    position, velocity = inertial(body, flown)
    np.testing.assert_allclose(np.linalg.norm(position, axis=1), np.linspace(9e3, 3e3, 9), rtol=1e-12)
    np.testing.assert_allclose(velocity, np.tile(velocity[0], (9, 1)), atol=1e-12)
    assert np.linalg.norm(np.cross(frames.unit(position[0]), frames.unit(velocity[0]))) < 1e-12
    slow = fly(scene_of(flight("approach", speed_m_s=1.25)), body)
    assert np.linalg.norm(inertial(body, slow)[1], axis=1) == pytest.approx(1.25)


# --- attitude, Sun and rates --------------------------------------------------------------------------------------


@pytest.mark.parametrize("roll", ["pole", "sun"])
@pytest.mark.parametrize("kind", list(SIX))
def test_velocities_and_rates_are_derivatives(kind: str, roll: str) -> None:
    """Against central differences of fourth order of 1201 frames, h apart.

    The fastest harmonic of the noise, 10 / attitude_time_s, has an error of (10 h / τ)^4 / 30 of the noise's rate.
    With τ = 100 h this is 3e-6 of some 3e-4 rad / τ. Thrusts of a hover are left out.
    """
    whole_s = 4 * SIX[kind]["period_s"]
    values = {"frames": 1201, "period_s": whole_s / 1200, "attitude_time_s": whole_s / 12, "roll": roll}
    flown = fly(scene_of(flight(kind, **values)), rock())

    def derivative(of: np.ndarray) -> np.ndarray:
        return (of[:-4] - 8 * of[1:-3] + 8 * of[3:-1] - of[4:]) / (12 * values["period_s"])

    velocity = derivative(flown.camera_position_T_m)
    axes = np.stack([flown.pose(k).T_from_C for k in range(1201)])
    skew = np.einsum("nji,njk->nik", axes[2:-2], derivative(axes))
    rate = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    known, turning = flown.velocity_T_m_s[2:-2], flown.rate_C_rad_s[2:-2]
    smooth = np.ones(1197, bool)
    if kind == "hover":
        jumps = np.linalg.norm(np.diff(flown.velocity_T_m_s, axis=0), axis=1)
        thrusts = np.flatnonzero(jumps > 0.01)  # m/s; gravity adds 1e-4 from row to row
        assert len(thrusts)
        smooth = np.abs(np.arange(2, 1199)[:, None] - thrusts).min(axis=1) > 3
    np.testing.assert_allclose(velocity[smooth], known[smooth], atol=1e-6 * np.linalg.norm(known, axis=1).max())
    np.testing.assert_allclose(rate[smooth], turning[smooth], atol=1e-5 * np.linalg.norm(turning, axis=1).max())


@pytest.mark.parametrize("kind", list(SIX))
def test_the_camera_looks_where_its_kind_says(kind: str) -> None:
    """Without noise the boresight passes through the centre, or the site; up is the pole or the Sun."""
    body = rock()
    still = {"attitude_noise_deg": 0.0, "offset_deg": 0.0, "latitude_deg": [-60, 60]}
    table = flight(
        kind,
        **{
            key: v
            for key, v in still.items()
            if kind in ("descent", "hover", "relocation") or key != "latitude_deg"
        },
    )
    for roll in ("pole", "sun"):
        flown = fly(scene_of({**table, "roll": roll}), body)
        for k in range(4):
            pose = flown.pose(k)
            x, y, z = pose.T_from_C.T
            up = frames.rz(-body.omega_rad_s * pose.time_s) @ flown.sun_direction_T[0]
            up = np.array([0, 0, 1.0]) if roll == "pole" else up
            assert x @ up == pytest.approx(0, abs=1e-9)
            assert y @ up < 0
            if kind in ("orbit", "flyby", "approach"):
                towards = frames.unit(body.centre_of_mass_T_m - pose.camera_position_T_m)
                assert np.linalg.norm(np.cross(z, towards)) < 1e-9
                continue
            hits = [ground.first_hit(body, p.camera_position_T_m, p.T_from_C[:, 2]) for p in (pose, flown.pose(4))]
            assert hits[0] is not None
            assert hits[1] is not None
            assert kind == "relocation" or np.linalg.norm(hits[0] - hits[1]) < 1e-4
    if kind == "approach":
        tilted = fly(scene_of({**table, "offset_deg": [3, 4]}), body)
        towards = body.centre_of_mass_T_m - tilted.camera_position_T_m
        cosine = (tilted.boresight_T * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
        assert (np.abs(np.degrees(np.arccos(cosine)) - 3.5) <= 0.5).all()
        assert np.ptp(np.arccos(cosine)) < 1e-9


def test_the_noise_of_the_attitude_is_a_gauss_markov_process_with_a_band() -> None:
    """Over 300 sequences and three axes: deviation, correlation after τ, and the deviation of the rate.

    900 samples know a deviation to 1/√1800 = 2.4 % and a correlation to 0.03. The limited spectrum has
    correlation ∫ cos(x) / (1 + x²) dx / arctan(10) and the rate σ/τ · √(10 / arctan(10) - 1).
    """
    table = flight("approach", sequences=300, frames=2, period_s=50.0, attitude_time_s=50.0, offset_deg=0.0)
    scene = scene_of({**table, "attitude_noise_deg": 0.5})
    assert scene.trajectory is not None
    cases = [
        flights._Case(scene=scene, body=rock(), flight=scene.trajectory.flight[0], number=k, time_s=np.zeros(1))
        for k in range(300)
    ]
    noise, rate = (
        np.array(part) for part in zip(*(flights._noise(c, np.array([7.0, 57.0])) for c in cases), strict=True)
    )
    sigma = np.radians(0.5)
    assert noise.std() == pytest.approx(sigma, rel=0.1)
    assert rate.std() == pytest.approx(sigma / 50 * np.sqrt(10 / np.arctan(10) - 1), rel=0.1)
    expected = quad(lambda x: np.cos(x) / (1 + x * x), 0, 10)[0] / np.arctan(10)
    assert np.corrcoef(noise[:, 0].ravel(), noise[:, 1].ravel())[0, 1] == pytest.approx(expected, abs=0.12)
    assert expected == pytest.approx(np.exp(-1), abs=0.05)
    assert np.abs(np.corrcoef(noise[:, 0].T) - np.eye(3)).max() < 0.25  # the axes are independent: 4 / √300


def test_sun_and_dates_go_on_while_the_body_turns() -> None:
    """The Sun's direction is that of orbit and pole at the frame's date, and goes round a hovering camera."""
    start_s, body = 5000.0, rock()
    table = flight("hover", frames=11, period_s=PERIOD_S / 10, start_s=start_s, sun_elevation_deg=[-90, 90])
    scene = scene_of(table)
    flown = fly(scene, body)
    dates = scene.sun.julian_date + (start_s + flown.time_s) / 86400
    np.testing.assert_allclose(flown.julian_date, dates, atol=1e-9)
    pole = frames.Rotation(
        pole_ra_deg=scene.body.pole_ra_deg,
        pole_dec_deg=scene.body.pole_dec_deg,
        prime_meridian_deg=scene.body.prime_meridian_deg,
        period_h=PERIOD_S / 3600,
    )
    for k, date in enumerate(flown.julian_date):
        sun_J_au = -frames.ORBIT_67P.position_J_au(float(date))
        np.testing.assert_allclose(
            flown.sun_direction_T[k], pole.J_from_T(date).T @ frames.unit(sun_J_au), atol=1e-12
        )
        assert flown.sun_distance_au[k] == pytest.approx(np.linalg.norm(sun_J_au), abs=1e-12)
    longitude = np.unwrap(np.arctan2(flown.sun_direction_T[:, 1], flown.sun_direction_T[:, 0]))
    # westward by a turn, to what the body's own motion about the Sun adds in 6 h, below 0.3 deg
    np.testing.assert_allclose(np.diff(longitude), -2 * np.pi / 10, atol=np.radians(0.03))
    assert np.ptp(flown.camera_position_T_m, axis=0).max() < 1.5
    given = scene.model_copy(update={"sun": scene.sun.model_copy(update={"distance_au": 2.0})})
    assert set(fly(given, body).sun_distance_au) == {2.0}


# --- sequences --------------------------------------------------------------------------------------------------


def digest(flown: Trajectory) -> str:
    """Return a digest of everything that a trajectory holds."""
    parts = [
        np.ascontiguousarray(v).tobytes() if isinstance(v, np.ndarray) else repr(v).encode()
        for v in vars(flown).values()
    ]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def test_the_same_scene_flies_the_same_and_flights_do_not_depend_on_others() -> None:
    tables = [flight(kind, sequences=2) for kind in ("hover", "descent", "approach")]
    flown = fly(scene_of(*tables), rock())
    flights._flown.clear()
    assert digest(fly(scene_of(*tables), rock())) == digest(flown)
    assert digest(fly(scene_of(tables[0], seed=2), rock())) != digest(fly(scene_of(tables[0]), rock()))
    alone = fly(scene_of(flight("approach"), flight("hover", sequences=2)), rock())
    assert alone.sequence_names == ("approach/0", "hover/0", "hover/1")
    np.testing.assert_array_equal(alone.camera_from_T[5:15], flown.camera_from_T[:10])
    np.testing.assert_array_equal(alone.camera_position_T_m[:5], flown.camera_position_T_m[20:25])
    assert flown.name[:6] == (*(f"hover/0/{k:04d}" for k in range(5)), "hover/1/0000")
    assert flown.frames == (5,) * 6
    assert flown.time_s[:6].tolist() == [0, 60, 120, 180, 240, 0]


def test_two_flights_of_a_kind_are_numbered_on() -> None:
    flown = fly(scene_of(flight("approach", frames=1), flight("approach", frames=2, sequences=2)), rock())
    assert flown.sequence_names == ("approach/0", "approach/1", "approach/2")
    assert flown.frames == (1, 2, 2)
    assert len(set(flown.name)) == 5


def test_bounds_are_kept() -> None:
    table = flight("approach", frames=1, sequences=40, phase_deg=[20, 30], start_s=[100, 200], offset_deg=0)
    flown = fly(scene_of(table), rock())
    towards = flown.camera_position_T_m - rock().centre_of_mass_T_m
    cosine = (towards * flown.sun_direction_T).sum(axis=1) / np.linalg.norm(towards, axis=1)
    phase = np.degrees(np.arccos(cosine))
    since = (flown.julian_date - scene_of(table).sun.julian_date) * 86400
    for values, low, high in ((phase, 20, 30), (since, 100, 200)):
        assert (values >= low - 1e-4).all()
        assert (values <= high + 1e-4).all()
        assert np.ptp(values) > 0.5 * (high - low)


def test_sites_keep_the_bounds_of_their_keys() -> None:
    keys = {"latitude_deg": [10, 30], "longitude_deg": [40, 80], "max_slope_deg": 20, "look": "down"}
    flown = fly(scene_of(flight("hover", frames=1, sequences=15, sun_elevation_deg=[20, 70], **keys)), rock())
    for k in range(15):
        pose = flown.pose(k)
        site = ground.first_hit(rock(), pose.camera_position_T_m, pose.T_from_C[:, 2])
        assert site is not None
        x, y, z = site
        # the camera's noise of 0.01 deg and the band of 1 m shift the hit by up to 1 m, of 600 m
        assert 9.5 < np.degrees(np.arctan2(z, np.hypot(x, y))) < 30.5
        assert 39.5 < np.degrees(np.arctan2(y, x)) < 80.5
        up = -site_at(rock(), 0, site).T_from_L[:, 2]
        assert 19.5 < np.degrees(np.arcsin(up @ pose.sun_direction_T)) < 70.5
        assert pose.T_from_C[:, 2] @ up < -0.999


# --- scenes, stores and mistakes ----------------------------------------------------------------------------------

SPICE = {"kernels": ["k"], "spacecraft": "X", "frame": "F", "camera_frame": "C"}
SCENE = """
title = "flown"
faults.dust_on_optics.model = "defocused"
camera = {detector = "generic_ccd", width_px = 48, height_px = 40, fov_deg = 40.0, exposure_s = 0.02}
plan.faulty_fraction = 1.0
render = {bands = 2, samples_per_pixel = 1}
patch = {facet_m = 10.0, radius_m = 40.0, boulders = false, max_triangles = 60_000}
dataset = {shard_samples = 2, seed = 3}
body.shape = "rock.obj"
body.unit = "m"
body.name = "rock"
body.density_kg_m3 = 2000.0
body.rotation_period_h = 5.0
body.pole_ra_deg = 10.0
body.pole_dec_deg = 70.0
body.prime_meridian_deg = 0.0
body.reflectance = 0.1
body.photometry = {model = "lambert"}
sun = {distance_au = 2.0}
trajectory.flight = [
    {kind = "hover", frames = 3, period_s = 20, height_m = 60, sequences = 2},
    {kind = "approach", frames = 2, period_s = 100, range_m = [9e3, 8e3]},
]
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    import trimesh

    trimesh.Trimesh(rock().vertices_m, rock().faces).export(tmp_path / "rock.obj")
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def test_flights_are_built_appended_described_and_taken_again(
    scene: Path, tmp_path: Path, call: Callable[..., Called]
) -> None:
    out, layers = tmp_path / "s.zarr", {"dataset.layers": ["clean", "radiance"]}
    loaded = config.load_scene(scene, layers)
    assert (loaded.dataset.samples, loaded.dataset.sites, loaded.frames) == (8, 3, (3, 3, 2))
    assert vbnfault.build(loaded, out, samples=4, progress=False).built == 4
    assert vbnfault.build(loaded, out, samples=4, append=4, progress=False, workers=2).built == 4
    assert vbnfault.verify(out).problems == []
    flown = vbnfault.Session(loaded).trajectory
    assert flown is not None
    with vbnfault.open_dataset(out) as data:
        assert data["name"].values.tolist() == list(flown.name)
        assert data["sequence"].attrs["names"] == ["hover/0", "hover/1", "approach/0"]
        assert data["frame"].values.tolist() == [0, 1, 2, 0, 1, 2, 0, 1]
        assert data["time_s"].values.tolist() == flown.time_s.tolist()
        # positions and directions have been through L
        np.testing.assert_allclose(data["camera_position_T_m"], flown.camera_position_T_m, atol=1e-9)
        np.testing.assert_allclose(data["sun_direction_T"], flown.sun_direction_T, atol=1e-14)
        drawn = [json.loads(text)["dust_on_optics"] for text in data["parameters"].values]
        image = data["image"].values
    assert drawn[0] == drawn[1] == drawn[2] != drawn[3]
    np.testing.assert_array_equal(vbnfault.simulate(loaded, 7).layers["image"], image[7])
    with pytest.raises(InputError, match=r"9 samples are planned, but trajectory\.flight has 8 rows"):
        vbnfault.build(loaded, out, append=1, progress=False)
    other = config.load_scene(scene, layers | {"trajectory.flight[0].height_m": 61})
    with pytest.raises(InputError, match=r"trajectory\.flight"):
        vbnfault.build(other, out, samples=4, append=4, progress=False)
    again = config.load_scene(scene, {"faults": {"broken_lines": {}}})
    assert vbnfault.retake(out, again, tmp_path / "again.zarr", progress=False).built == 8
    assert vbnfault.verify(tmp_path / "again.zarr").problems == []
    assert call("preview", out, "--out", tmp_path / "s.png").code == 0
    text = call("describe", scene).out
    assert "8 of 8 rows of trajectory.flight, from hover/0/0000 to approach/0/0001" in text
    assert "  hover: 2 sequences of 3 frames, 40 s; " in text
    assert "  approach: 1 sequence of 2 frames, 100 s; 8000 to 9000 m from the centre of mass, " in text
    pixel = 2 * np.tan(np.radians(20)) / 48
    first_m, last_m = (ground.nearest_ground(rock(), flown.camera_position_T_m[k])[0] for k in (6, 7))
    assert f"{pixel * first_m:.3g} m a pixel first, {pixel * last_m:.3g} last" in text


def test_poses_in_python_replace_flights(scene: Path) -> None:
    flown = vbnfault.Session(config.load_scene(scene)).trajectory
    assert flown is not None
    shown = vbnfault.Session(config.load_scene(scene), poses=replace(flown, source="mine"))
    np.testing.assert_array_equal(shown.trajectory.camera_from_T, flown.camera_from_T)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"trajectory.file": "poses.csv"},
            r"trajectory\.file = .*poses\.csv': flight makes poses, too; leave one out",
        ),
        ({"trajectory.flight": []}, r"trajectory\.file: is missing; a trajectory needs a file, or flights"),
        (
            {"trajectory.flight[0].kind": "dive"},
            r"flight\[0\]\.kind = 'dive': must be .*'approach', .*'relocation'",
        ),
        ({"trajectory.flight[0].period_s": 0}, r"flight\[0\]\.period_s = 0: must be a number from 1e-06 to 1e\+09"),
        ({"trajectory.flight[0].frames": 0}, r"flight\[0\]\.frames = 0: must be a whole number from 1 to 1000000"),
        ({"trajectory.flight[0].height_m": [60, 50]}, r"flight\[0\]\.height_m = \[60, 50\]: bounds reversed"),
        ({"trajectory.flight[0].radius_m": 60}, r"flight\[0\]\.radius_m: unknown key"),
        ({"trajectory.flight[0].dead_band_m": 120}, r"dead_band_m = 120: must be below 120, twice height_m"),
        ({"trajectory.flight[0].frames": 600_000}, r"flight: has 1200002 frames; must have at most 1000000"),
        ({"trajectory.flight[1].range_m": [8e3, 9e3]}, r"range_m = \[8000\.0, 9000\.0\]: bounds reversed"),
        ({"trajectory.flight[1].speed_m_s": [1, 11]}, r"speed_m_s = 11: 100 s of flight .*; must be at most 10"),
        ({"dataset.samples": 9}, r"dataset\.samples = 9: trajectory\.flight has 8 rows, and each is a sample"),
        ({"dataset.variants_per_view": 2}, r"dataset\.variants_per_view = 2: the samples are frames of sequences"),
        ({"spice": SPICE}, r"trajectory\.flight: spice\.spacecraft = 'X'"),
        (
            {"trajectory.flight": [{**flight("descent"), "end_height_m": [20, 150]}]},
            r"flight\[0\]\.end_height_m = 150: must be below height_m, 150",
        ),
        (
            {"trajectory.flight": [flight("descent", frames=1)]},
            r"flight\[0\]\.frames = 1: must be at least 2, the first and the last",
        ),
    ],
)
def test_wrong_keys_are_named(scene: Path, change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        vbnfault.Session(config.load_scene(scene, change))


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (flight("flyby", closest_m=300.0), r"row 'flyby/0/000\d', at \S+ s, is \S+ m below the ground"),
        (flight("orbit", radius_m=800.0), r"row 'orbit/0/000\d', at \S+ s, is \S+ m below the ground"),
        (
            flight("descent", period_s=3e3),
            r"descent/0 would have to rise first, as it lasts 12000 s; .* about \d+ s",
        ),
        (
            flight("relocation", period_s=5.0),
            r"relocation/0: a hop of \S+ m lasts 20 s; must last from \S+ to \S+ s",
        ),
        (flight("orbit", period_s=3e6), r"lasts 1.2e\+07 s; must last at most \S+ s in this gravity, 200 orbits"),
        (
            flight("approach", frames=400, period_s=1e9),
            r"approach/0 ends at Julian date \S+; must be from 1000000 to 5000000",
        ),
        (flight("hover", max_slope_deg=0), r"hover/0 finds no site in 300 draws; widen latitude_deg"),
    ],
)
def test_flights_that_cannot_be_flown_say_so(table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=rf"^trajectory\.flight: {sentence}"):
        fly(scene_of(table), rock())


def test_ground_between_frames_is_met(scene: Path) -> None:
    """A flyby of two frames, before and behind the body, passes through it half-way, 300 m from its middle."""
    table = flight("flyby", closest_m=300.0, frames=2, period_s=8000.0)
    with pytest.raises(InputError, match=r"row 'flyby/0/0001', at (\S+) s, is \S+ m below"):
        describe_scene(config.load_scene(scene, {"trajectory.flight": [table]}), source="s")


def test_the_first_position_inside_is_that_of_testing_all() -> None:
    """Against a test of every position, on paths that are smooth, jump about, and stay near the ground."""
    rng = np.random.default_rng(5)
    starts = rng.normal(0, 1, (12, 1, 3))
    starts = starts / np.linalg.norm(starts, axis=2, keepdims=True) * [930, 730, 630] + [40, 0, 0]
    paths = [
        *(starts + np.cumsum(rng.normal(0, 6, (12, 400, 3)), axis=1)),
        *rng.uniform(-3e3, 3e3, (3, 200, 3)),
        np.full((3, 3), 1e5),
    ]
    found = [ground.first_inside(rock(), path) for path in paths]
    for path, first in zip(paths, found, strict=True):
        inside = np.flatnonzero([ground.encloses(rock(), place) for place in path])
        assert (None if first is None else first[0]) == (inside[0] if len(inside) else None)
    assert found[-1] is None
    assert sum(first is not None and first[0] > 0 for first in found) > 2
    assert ground.first_inside(rock(), np.array([[1e4, 0, 0], [40.0, 0, 550.0]])) == (1, pytest.approx(49, abs=3))
