"""SPICE kernels against the built-in ephemeris, rotation and frames; every kernel is written here."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from conftest import small_scene, verified_store
from test_cli import run

import vbnfault
from vbnfault.core import frames
from vbnfault.core.errors import InputError
from vbnfault.core.files import spice
from vbnfault.pipeline import Session
from vbnfault.scene import config
from vbnfault.world import ephemeris

spiceypy: Any = pytest.importorskip("spiceypy", reason="spiceypy (the extra 'spice') is not installed")

COMET, SPACECRAFT, CAMERA = 1000012, -999, -999100
ET_S = 300_000_000.0  # 2009-07-04, within every kernel below
JD = spice.julian_date_from_et_s(ET_S)

# Scholten, Cheops frame document: the constants of the built-in 67P. SPICE knows the body's name by itself.
PCK = r"""KPL/PCK
\begindata
BODY1000012_POLE_RA = ( 69.54 0. 0. )
BODY1000012_POLE_DEC = ( 64.11 0. 0. )
BODY1000012_PM = ( 114.69 696.543884683 0. )
\begintext
"""
LSK = r"""KPL/LSK
\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT = ( 32, @1999-JAN-1, 33, @2006-JAN-1, 34, @2009-JAN-1, 35, @2012-JUL-1 )
\begintext
"""
FK = rf"""KPL/FK
\begindata
NAIF_BODY_NAME += ( 'TESTCRAFT' )
NAIF_BODY_CODE += ( {SPACECRAFT} )
FRAME_COMET_FIXED = 1400012
FRAME_1400012_NAME = 'COMET_FIXED'
FRAME_1400012_CLASS = 2
FRAME_1400012_CLASS_ID = {COMET}
FRAME_1400012_CENTER = {COMET}
FRAME_TEST_BUS = {SPACECRAFT}000
FRAME_{SPACECRAFT}000_NAME = 'TEST_BUS'
FRAME_{SPACECRAFT}000_CLASS = 3
FRAME_{SPACECRAFT}000_CLASS_ID = {SPACECRAFT}000
FRAME_{SPACECRAFT}000_CENTER = {SPACECRAFT}
CK_{SPACECRAFT}000_SCLK = {SPACECRAFT}
CK_{SPACECRAFT}000_SPK = {SPACECRAFT}
FRAME_TEST_CAMERA = {CAMERA}
FRAME_{CAMERA}_NAME = 'TEST_CAMERA'
FRAME_{CAMERA}_CLASS = 4
FRAME_{CAMERA}_CLASS_ID = {CAMERA}
FRAME_{CAMERA}_CENTER = {SPACECRAFT}
TKFRAME_{CAMERA}_SPEC = 'MATRIX'
TKFRAME_{CAMERA}_RELATIVE = 'TEST_BUS'
TKFRAME_{CAMERA}_MATRIX = ( 0 1 0  -1 0 0  0 0 1 )
\begintext
"""
# Ticks of a second since J2000.0, counted in TDB: encoded time is ephemeris time.
SCLK = r"""KPL/SCLK
\begindata
SCLK_KERNEL_ID = ( @2009-JAN-1 )
SCLK_DATA_TYPE_999 = ( 1 )
SCLK01_TIME_SYSTEM_999 = ( 1 )
SCLK01_N_FIELDS_999 = ( 1 )
SCLK01_MODULI_999 = ( 4000000000 )
SCLK01_OFFSETS_999 = ( 0 )
SCLK01_OUTPUT_DELIM_999 = ( 1 )
SCLK_PARTITION_START_999 = ( 0.0 )
SCLK_PARTITION_END_999 = ( 4.0E9 )
SCLK01_COEFFICIENTS_999 = ( 0 0 1 )
\begintext
"""
ROTATION = frames.Rotation(
    pole_ra_deg=69.54, pole_dec_deg=64.11, prime_meridian_deg=114.69, period_h=8640 / 696.543884683
)
BUS_FROM_J = frames.rx(0.3) @ frames.rz(-1.1)
POSITION_T_M = np.array([12_000.0, -34_000.0, 56_000.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Text kernels, an SPK of the two-body comet and of a spacecraft at rest in T, a CK of a constant attitude."""
    return write_kernels(tmp_path_factory.mktemp("kernels"))


def write_kernels(folder: Path) -> Path:
    """Write the kernels to a folder, and return it."""
    for name, text in (("a.tpc", PCK), ("a.tls", LSK), ("a.tf", FK), ("a.tsc", SCLK)):
        (folder / name).write_text(text)

    epochs = ET_S + np.arange(-40, 41) * 3600.0
    orbit = [orbit_state_J_km(et) for et in epochs]
    near = ET_S + np.arange(-10, 11) * 60.0
    at_rest = [
        np.r_[ROTATION.J_from_T(spice.julian_date_from_et_s(et)) @ POSITION_T_M / 1000, np.zeros(3)] for et in near
    ]
    handle = spiceypy.spkopn(str(folder / "a.bsp"), "test", 0)
    # Hermite (13) for the comet, whose states come with velocities; Lagrange (9) for positions alone.
    spiceypy.spkw13(handle, COMET, 10, "J2000", epochs[0], epochs[-1], "comet", 7, len(epochs), orbit, epochs)
    spiceypy.spkw09(handle, SPACECRAFT, COMET, "J2000", near[0], near[-1], "craft", 7, len(near), at_rest, near)
    spiceypy.spkcls(handle)

    handle = spiceypy.ckopn(str(folder / "a.bc"), "test", 0)
    ticks = np.array([ET_S - 500, ET_S + 500])
    spiceypy.ckw03(
        handle, ticks[0], ticks[-1], SPACECRAFT * 1000, "J2000", False, "bus", 2, ticks,
        np.array([spiceypy.m2q(BUS_FROM_J)] * 2), np.zeros((2, 3)), 1, ticks[:1],
    )  # fmt: skip
    spiceypy.ckcls(handle)
    spiceypy.kclear()
    return folder


def conic_elements() -> np.ndarray:
    """The built-in orbit as SPICE's conic elements: km, rad, s; μ from the mean motion, n² a³."""
    orbit = frames.ORBIT_67P
    perihelion_km = orbit.perihelion_au * spice.KM_PER_AU
    a_km = perihelion_km / (1 - orbit.eccentricity)
    mu = (np.radians(orbit.mean_motion_deg_day) / spice.SECONDS_PER_DAY) ** 2 * a_km**3
    angles = np.radians([orbit.inclination_deg, orbit.node_deg, orbit.argument_deg])
    return np.array(
        [perihelion_km, orbit.eccentricity, *angles, 0.0, spice.et_s_from_julian_date(orbit.perihelion_jd), mu]
    )


def orbit_state_J_km(et_s: float) -> np.ndarray:
    """Heliocentric state in ICRF axes, km and km/s, by SPICE's propagation of the conic."""
    rotate = spiceypy.pxform("ECLIPJ2000", "J2000", et_s)
    state = spiceypy.conics(conic_elements(), et_s)
    return np.r_[rotate @ state[:3], rotate @ state[3:]]


def loaded() -> int:
    return int(spice._ask("SPICE kernels", "loaded"))


def all_of(folder: Path) -> list[Path]:
    return [folder / f"a.{suffix}" for suffix in ("tls", "tpc", "tf", "tsc", "bsp", "bc")]


# --- the built-in models -------------------------------------------------------------------------------------


@pytest.mark.parametrize("julian_date", [2451545.0, 2456876.0, 2456974.0, 2457247.5886578634, 2457468.5])
def test_rotation_is_that_of_a_text_pck(folder: Path, julian_date: float) -> None:
    with spice.kernels(folder / "a.tpc", folder / "a.tf"):
        ours = ROTATION.J_from_T(julian_date)
        theirs = spice.J_from_T("COMET_FIXED", spice.et_s_from_julian_date(julian_date))
    # 6000 days of 12 rad hold W to 7e4 rad · 2⁻⁵³ ≈ 1e-11 rad.
    between = frames.quaternion(ours @ theirs.T)
    assert 2 * np.linalg.norm(between[1:]) < 1e-9


# NAIF number, right ascension and declination of the pole, and the three constants of the prime meridian, in the
# frame of the body's shape model. The kernels are copies in public repositories (DOI-USGS/ale, layoutit/css.earth).
SHAPE_FRAMES = {
    "67P": (1000012, 69.54, 64.11, 114.69, 696.543884683, 0.0),  # Scholten, Cheops frame document
    "Bennu": (2101955, 85.45864, -60.36468, 150.48977, 2011.143058731885, 2e-6),  # bennu_v17.tpc
    "Ryugu": (2162173, 96.43112, -66.38741, 274.16225, 1131.98280286, 0.0),  # ryugu_v10.tpc
    "Itokawa": (2025143, 90.02564, -67.02704, 129.73, 712.14376110, 0.0),  # itokawa_gaskell_n3.tpc
    "Eros": (2000433, 11.363, 17.232, 326.08, 1639.38928, 0.0),  # eros_alex.tpc
    "Moon": (301, 269.9949, 66.5392, 38.3213, 13.17635815, -1.4e-12),  # pck00011.tpc, without its periodic terms
    "Ceres": (2000001, 291.42763, 66.76033, 170.309, 952.1532635, 0.0),  # CERES18D, dawn_ceres_v06.tpc
    # pck00011.tpc, too
    "Phobos": (401, 317.67071657, 52.88627266, 35.1877444, 1128.84475928, 9.536137031212154e-9),
}


@pytest.mark.parametrize("name", SHAPE_FRAMES)
def test_a_named_body_turns_as_the_kernel_of_its_shape_says(tmp_path: Path, name: str) -> None:
    """The period of 67P has six digits: 3e-6° in 10,000 days of 697°. The others have 13: 1e-7°."""
    number, right_ascension, declination, *meridian = SHAPE_FRAMES[name]
    kernel = tmp_path / "shape.tpc"
    kernel.write_text(f"""KPL/PCK
\\begindata
BODY{number}_POLE_RA = ( {right_ascension} 0. 0. )
BODY{number}_POLE_DEC = ( {declination} 0. 0. )
BODY{number}_PM = ( {meridian[0]} {meridian[1]} {meridian[2]} )
FRAME_OF_SHAPE = 1400012
FRAME_1400012_NAME = 'OF_SHAPE'
FRAME_1400012_CLASS = 2
FRAME_1400012_CLASS_ID = {number}
FRAME_1400012_CENTER = {number}
\\begintext
""")
    for julian_date in (2451545.0, 2456948.25, 2461372.0):  # to 2026
        table = {"title": "t", "body": {"name": name}, "sun": {"julian_date": julian_date}}
        ours = ephemeris.ephemeris(config.parse_scene(table, source="t.toml"))[1]
        with spice.kernels(kernel):
            theirs = spice.J_from_T("OF_SHAPE", spice.et_s_from_julian_date(julian_date)).T
        between = frames.quaternion(ours @ theirs.T)
        assert 2 * np.linalg.norm(between[1:]) < 2e-7


@pytest.mark.parametrize("days", [-540.0, -200.0, -1.0, 0.0, 3.0, 77.7, 540.0])
def test_two_body_ephemeris_is_that_of_spice(days: float) -> None:
    julian_date = frames.ORBIT_67P.perihelion_jd + days
    ours = frames.ORBIT_67P.position_J_au(julian_date)
    theirs = orbit_state_J_km(spice.et_s_from_julian_date(julian_date))[:3] / spice.KM_PER_AU
    # SPICE's obliquity, 84381.448", has two digits more than the built-in one: 2e-10 rad. A Julian date holds
    # 4e-5 s, in which the comet moves 1.4 m or 1e-11 au.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.linalg.norm(theirs))


def test_julian_dates_and_ephemeris_time() -> None:
    assert spice.et_s_from_julian_date(2451545.0) == 0.0
    assert spice.julian_date_from_et_s(86400.0) == 2451546.0
    assert spice.et_s_from_julian_date(JD) == pytest.approx(ET_S, abs=1e-4)  # a Julian date holds 4e-5 s


# --- positions, attitudes, poses -----------------------------------------------------------------------------


def test_sun_position_is_the_opposite_of_the_orbit(folder: Path) -> None:
    with spice.kernels(*all_of(folder)):
        for target in ("67P/CHURYUMOV-GERASIMENKO (1969 R1)", str(COMET)):
            sun_J_au = spice.sun_position_J_au(target, ET_S)
            np.testing.assert_allclose(sun_J_au, -frames.ORBIT_67P.position_J_au(JD), rtol=0, atol=1e-8)
    assert (sun_J_au.shape, sun_J_au.dtype) == ((3,), np.float64)


def test_pose_of_a_spacecraft_at_rest_in_T(folder: Path) -> None:
    K_from_C = frames.rz(np.pi)
    with spice.kernels(*all_of(folder)):
        T_from_J = spice.J_from_T("COMET_FIXED", ET_S).T
        pose = spice.pose_T("TESTCRAFT", str(COMET), "COMET_FIXED", "TEST_CAMERA", ET_S)
        turned = spice.pose_T("TESTCRAFT", str(COMET), "COMET_FIXED", "TEST_CAMERA", ET_S, K_from_C)
    # The epochs were rounded to Julian dates, 2e-5 s, in which T turns by 2e-4 m at 67 km.
    np.testing.assert_allclose(pose.camera_position_T_m, POSITION_T_M, rtol=0, atol=1e-3)
    # The matrix of a TK frame kernel, listed by columns, takes the camera's axes to the bus's.
    bus_from_camera = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(pose.T_from_C, T_from_J @ BUS_FROM_J.T @ bus_from_camera, atol=1e-12)
    np.testing.assert_allclose(pose.T_from_C @ pose.T_from_C.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(turned.T_from_C, pose.T_from_C @ K_from_C, atol=1e-12)
    # The boresight is the bus's z: not touched by a turn about it.
    np.testing.assert_allclose(turned.T_from_C[:, 2], T_from_J @ BUS_FROM_J[2], atol=1e-12)


# --- the kernel pool -----------------------------------------------------------------------------------------


def test_kernels_leave_nothing_behind(folder: Path) -> None:
    with spice.kernels(folder / "a.tls"):
        with spice.kernels(*all_of(folder)), spice.kernels(folder / "a.tpc"):
            assert loaded() == 1 + len(all_of(folder)) + 1
        assert loaded() == 1
        with pytest.raises(ZeroDivisionError), spice.kernels(folder / "a.tpc"):
            _ = 1 / 0
        assert loaded() == 1
    assert loaded() == 0
    assert spiceypy.ktotal("ALL") == 0  # the pool of this process is the user's own


@pytest.mark.parametrize(
    "kind", ["relative", "working folder", "long", "continued", "crlf", "nested", "defining", "lacking"]
)
def test_meta_kernels_as_agencies_and_users_write_them(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Paths relative to the meta-kernel or to the working folder, of more than 80 characters, and the rest."""
    place = tmp_path / ("x" * 90) / "kernels"
    place.mkdir(parents=True)
    for path in all_of(folder):
        (place / path.name).symlink_to(path)
    own = place.parent / "mk"
    own.mkdir()
    value = {
        "relative": "'../kernels'",
        "working folder": "'kernels'",
        "continued": ", ".join(f"'{str(place)[k : k + 50]}+'" for k in range(0, len(str(place)), 50))[:-2] + "'",
    }.get(kind, f"'{place}'")
    names = [path.name for path in all_of(folder)]
    extra = ""
    if kind == "defining":
        names.remove("a.tf")
        extra = FK.partition("\\begindata")[2].partition("\\begintext")[0]
    if kind == "lacking":
        names.append("lost.bsp")
    listed = ", ".join(f"'$K/{name}'" for name in names)
    text = (
        f"KPL/MK\n\\begindata\nPATH_VALUES = ( {value} )\nPATH_SYMBOLS = ( 'K' )\n{extra}"
        f"KERNELS_TO_LOAD = ( {listed} )\n\\begintext\n"
    )
    meta = own / "all.tm"
    meta.write_bytes(text.replace("\n", "\r\n" if kind == "crlf" else "\n").encode())
    if kind == "nested":
        (own / "outer.tm").write_text("KPL/MK\n\\begindata\nKERNELS_TO_LOAD = 'all.tm'\n\\begintext\n")
        meta = own / "outer.tm"
    monkeypatch.chdir(place.parent if kind == "working folder" else tmp_path)
    if kind == "lacking":
        sentence = (
            rf"all\.tm: KERNELS_TO_LOAD names '\$K/lost\.bsp', which is missing; looked for {place}/lost\.bsp\.$"
        )
        with pytest.raises(InputError, match=sentence), spice.kernels(meta):
            pass
        assert loaded() == 0
        return
    with spice.kernels(meta):
        assert np.linalg.norm(spice.sun_position_J_au(str(COMET), ET_S)) > 1
        assert spice.J_from_T("COMET_FIXED", ET_S).shape == (3, 3)  # the frame kernel too
    assert loaded() == 0


def test_meta_kernels_in_a_circle_and_paths_too_long_for_spice(tmp_path: Path) -> None:
    meta = tmp_path / "circle.tm"
    meta.write_text("KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( 'circle.tm', 'circle.tm' )\n")
    with (
        pytest.raises(InputError, match=r"circle\.tm: names meta-kernels more than 3 deep\.$"),
        spice.kernels(meta),
    ):
        pass
    deep = tmp_path / ("y" * 200) / ("z" * 100)
    deep.mkdir(parents=True)
    (deep / "a.tls").write_text(LSK)
    with pytest.raises(InputError, match="SPICE takes paths of at most 255 bytes"), spice.kernels(deep / "a.tls"):
        pass


def test_threads_take_turns(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entered: list[int] = []
    waits = threading.Event()

    class Noted:
        """The lock of the pool, which says that a thread has come and found it taken."""

        lock = spice._pool

        def __enter__(self) -> None:
            if not self.lock.acquire(blocking=False):
                waits.set()
                self.lock.acquire()

        def __exit__(self, *_: object) -> None:
            self.lock.release()

    monkeypatch.setattr(spice, "_pool", Noted())

    def load() -> None:
        with spice.kernels(folder / "a.tls"):
            entered.append(loaded())

    thread = threading.Thread(target=load)
    with spice.kernels(folder / "a.tpc"):
        thread.start()
        assert waits.wait(600)  # it guards against a test that hangs
        assert entered == []
    thread.join(600)
    assert entered == [1]


# --- errors --------------------------------------------------------------------------------------------------


def test_missing_kernels_are_named(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = tmp_path / "nowhere.tm"
    with pytest.raises(InputError, match=r"nowhere\.tm: SPICE kernel file not found\.$"), spice.kernels(nowhere):
        pass
    with pytest.raises(InputError, match="at least one path"), spice.kernels():
        pass
    (tmp_path / "rubbish.bsp").write_bytes(b"DAF/SPK " + bytes(100))
    with pytest.raises(InputError, match=r"rubbish\.bsp: "), spice.kernels(tmp_path / "rubbish.bsp"):
        pass
    assert loaded() == 0
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    with pytest.raises(InputError, match=r"pip install 'vbnfault\[spice\]'"), spice.kernels(folder / "a.tls"):
        pass


def test_what_the_kernels_do_not_hold_is_said_in_a_sentence(folder: Path) -> None:
    far = ET_S + 1e8

    def pose(
        spacecraft: str = "TESTCRAFT", camera_frame: str = "TEST_CAMERA", et_s: float = ET_S, **more: Any
    ) -> Any:
        return spice.pose_T(spacecraft, str(COMET), "COMET_FIXED", camera_frame, et_s, **more)

    cases = [
        (lambda: spice.sun_position_J_au(str(COMET), far), r"Sun from 1000012 at JD 2456174\.\d+ .*no position"),
        (lambda: spice.sun_position_J_au("NOBODY", ET_S), "Sun from NOBODY at .*no body of that name"),
        (lambda: spice.sun_position_J_au("SUN", ET_S), "Sun from SUN at .*: is 0 au away .*from 0.01 to 1000 au"),
        (lambda: spice.J_from_T("NOFRAME", ET_S), "frame NOFRAME at .*: the kernels define no such frame"),
        (lambda: spice.J_from_T("IAU_EROS", ET_S), "frame IAU_EROS at "),
        (lambda: spice.J_from_T("TEST_BUS", ET_S + 5000), "frame TEST_BUS at .*: the kernels hold no attitude"),
        (lambda: pose(et_s=ET_S + 700), "TESTCRAFT from 1000012 in frame COMET_FIXED at .*no position"),
        (lambda: pose(et_s=ET_S + 550), "frame TEST_CAMERA in COMET_FIXED at .*no attitude"),
        (lambda: pose(spacecraft="VOYAGER 9"), "VOYAGER 9 from .*no body of that name"),
        (lambda: pose(camera_frame="TEST_LENS"), "frame TEST_LENS in .*no such frame"),
        (lambda: pose(K_from_C=np.diag([1.0, 1.0, -1.0])), "K_from_C must be a 3 × 3 rotation"),
    ]
    with spice.kernels(*all_of(folder)):
        for ask, says in cases:
            with pytest.raises(InputError, match=says) as caught:
                ask()
            assert "\n" not in str(caught.value)
            assert str(caught.value).endswith(".")
    with pytest.raises(InputError, match="no kernel with positions is loaded"):
        spice.sun_position_J_au(str(COMET), ET_S)


# --- a scene on a spacecraft's way -----------------------------------------------------------------------------


def flown_scene(folder: Path) -> dict[str, Any]:
    """A small scene whose camera is on the spacecraft and looks at the body's centre."""
    far = np.linalg.norm(POSITION_T_M)
    # the bus holds an attitude of no importance: mount the camera so that it looks at the body's centre
    with spice.kernels(*all_of(folder)):
        T_from_K = spice.pose_T("TESTCRAFT", str(COMET), "COMET_FIXED", "TEST_CAMERA", ET_S).T_from_C
    z = -POSITION_T_M / far
    x = frames.unit(np.cross(z, [0.0, 0.0, 1.0]))
    K_from_C = T_from_K.T @ np.column_stack([x, np.cross(z, x), z])
    table = small_scene(
        sun={"julian_date": JD - 200 / 86400},
        spice={
            "kernels": [str(path) for path in all_of(folder)],
            "target": str(COMET),
            "frame": "COMET_FIXED",
            "spacecraft": "TESTCRAFT",
            "camera_frame": "TEST_CAMERA",
            "camera_axes": K_from_C.ravel().tolist(),
            "until_julian_date": JD + 200 / 86400,
        },
    )
    table["camera"]["fov_deg"] = 5.0
    return table


def test_a_scene_on_a_spacecrafts_way(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Camera and Sun of every sample are SPICE's at its own date; the picture looks where the camera does."""
    table = flown_scene(folder)
    far, z = np.linalg.norm(POSITION_T_M), -frames.unit(POSITION_T_M)
    session = Session(config.parse_scene(table, source="test"))
    middle = session.sites[0].position_T_m
    across = np.cross(middle - POSITION_T_M, z)
    assert np.linalg.norm(across) < far * 0.02  # 90 s before ET_S the body turns by 0.7°
    dates = set()
    for index in range(3):
        sample = session.simulate(index).scalars
        dates.add(sample["julian_date"])
        with spice.kernels(*all_of(folder)):
            et_s = spice.et_s_from_julian_date(sample["julian_date"])
            T_from_J = spice.J_from_T("COMET_FIXED", et_s).T
            sun_T = T_from_J @ frames.unit(spice.sun_position_J_au(str(COMET), et_s))
        np.testing.assert_allclose(sample["camera_position_T_m"], POSITION_T_M, atol=0.05)
        np.testing.assert_allclose(sample["sun_direction_T"], sun_T, atol=1e-9)
        np.testing.assert_allclose(sample["T_from_J"], T_from_J, atol=1e-9)
        Lx = np.array(sample["T_from_L"]).T @ sun_T
        np.testing.assert_allclose(
            frames.direction_L(sample["sun_azimuth_deg"], sample["sun_elevation_deg"]), Lx, atol=1e-9
        )
        turned = frames.L_from_C(Lx, sample["roll_deg"], sample["pitch_deg"], sample["yaw_deg"])
        q = frames.quaternion((np.array(sample["T_from_L"]) @ turned).T)
        np.testing.assert_allclose(q, sample["camera_from_T"], atol=1e-9)
    assert len(dates) == 3
    # and a store of it is whole and as planned
    table["dataset"] |= {"samples": 3, "shard_samples": 3}
    (tmp_path / "way.toml").write_text(tomli_w.dumps(table))
    assert run(monkeypatch, "build", tmp_path / "way.toml", "--out", tmp_path / "way.zarr") == 0
    assert run(monkeypatch, "verify", tmp_path / "way.zarr") == 0, capsys.readouterr()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"spacecraft": "X"}, "needs kernels"),
        ({"kernels": ["a.tm"], "spacecraft": "X"}, "needs frame"),
        ({"kernels": ["a.tm"], "frame": "F", "spacecraft": "X"}, "needs camera_frame"),
        ({"kernels": ["a.tm"], "camera_frame": "X"}, "need spacecraft"),
    ],
)
def test_a_way_needs_all_its_keys(table: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        config.parse_scene(small_scene(spice=table), source="test")


def test_a_coma_follows_the_date_of_each_sample(folder: Path, tmp_path: Path) -> None:
    """Its light in the store is that of the Afρ at the Sun's distance in SPICE at the sample's own date."""
    # so steep a power that some minutes change the light by 1e-4, a thousand times the rounding of float32
    keys = {"afrho_cm": 500.0, "reference_au": 1.88, "distance_exponent": 20.0, "affects_ground": False}
    table = flown_scene(folder)
    table["dataset"] |= {"samples": 2, "shard_samples": 2, "layers": ["clean", "radiance", "semantic"]}
    scene = config.parse_scene({**table, "coma": keys}, source="test")
    out = tmp_path / "coma.zarr"
    verified_store(scene, out)
    data = vbnfault.open_dataset(out)
    light, date = data["radiance"][1].values, float(data["julian_date"][1])
    assert np.array_equal(light, Session(scene).simulate(1).layers["radiance"])
    with spice.kernels(*all_of(folder)):
        sun_au, start_au = (
            np.linalg.norm(spice.sun_position_J_au(str(COMET), spice.et_s_from_julian_date(jd)))
            for jd in (date, table["sun"]["julian_date"])
        )
    assert float(data["sun_distance_au"][1]) == pytest.approx(sun_au, rel=1e-9)
    assert abs((start_au / sun_au) ** 20 - 1) > 1e-5
    # the same view with that amount of dust at every distance
    even = keys | {"afrho_cm": 500.0 * (sun_au / 1.88) ** -20, "distance_exponent": 0.0}
    same = Session(config.parse_scene({**table, "coma": even}, source="test")).simulate(1).layers["radiance"]
    sky = data["semantic"][1].values == 0
    assert sky.any()
    np.testing.assert_allclose(light[:, sky], same[:, sky], rtol=1e-6)
    assert (light[:, sky] > 0).all()
