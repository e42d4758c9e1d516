"""SPICE kernels: where the Sun, the target's axes and a spacecraft's camera are at an epoch.

The only importer of spiceypy, an optional extra (`pip install 'vbnfault[spice]'`). Frames as in `frames`:
J international celestial (SPICE's "J2000"), T target body-fixed, C camera; matrices are named TargetFromSource.
Positions are geometric, without light time or aberration, as those of the built-in two-body ephemeris.

SPICE keeps its kernels in one pool of the process, so they are loaded for the length of a `with` block only:

    with kernels("mission.tm"):
        et_s = et_s_from_utc("2014-08-06T00:00:00")
        sun_J_au = sun_position_J_au("CHURYUMOV-GERASIMENKO", et_s)
        T_from_J = J_from_T("67P/C-G_CK", et_s).T
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vbnfault.errors import InputError
from vbnfault.frames import J2000_JD

F64 = NDArray[np.float64]

KM_PER_AU = 149597870.7  # IAU 2012 Resolution B2, exact
METRES_PER_KM = 1000.0
SECONDS_PER_DAY = 86400.0
J_FRAME = "J2000"  # SPICE's name of the ICRF axes

# CSPICE is not thread-safe, and two threads would see each other's kernels.
_pool = threading.RLock()

# SPICE short message → what it means here; the others are given in SPICE's own words.
_MEANINGS = {
    "SPICE(SPKINSUFFDATA)": "the kernels hold no position at that epoch",
    "SPICE(NOLOADEDFILES)": "no kernel with positions is loaded",
    "SPICE(NOFRAMECONNECT)": "the kernels hold no attitude at that epoch",
    "SPICE(FRAMEDATANOTFOUND)": "the kernels do not define that frame in full",
    "SPICE(KERNELVARNOTFOUND)": "a constant of that body is missing from the kernels",
    "SPICE(UNKNOWNFRAME)": "the kernels define no such frame",
    "SPICE(IDCODENOTFOUND)": "the kernels know no body of that name",
    "SPICE(NOLEAPSECONDS)": "no leap-second kernel is loaded",
    "SPICE(MISSINGTIMEINFO)": "no leap-second kernel is loaded",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """A camera's place and attitude in the target's body-fixed frame.

    Attributes
    ----------
    camera_position_T_m
        float64[3], metres from the target's centre, frame T.
    T_from_C
        float64[3, 3], camera axes (x image right, y image down, z boresight) in T.
    """

    camera_position_T_m: F64
    T_from_C: F64


def load_spiceypy(purpose: str) -> Any:
    """The module spiceypy; `purpose` opens the sentence of the InputError raised where it is not installed."""
    try:
        import spiceypy
    except ImportError:
        raise InputError(f"{purpose}: needs spiceypy: pip install 'vbnfault[spice]'.") from None
    return spiceypy


@contextmanager
def reported(purpose: str) -> Iterator[Any]:
    """Give spiceypy to a block that holds the kernel pool alone, and turn its errors into an InputError.

    Parameters
    ----------
    purpose
        Opens the sentence: a file, or what was asked for and when.
    """
    spiceypy = load_spiceypy(purpose)
    with _pool:
        try:
            yield spiceypy
        except spiceypy.utils.exceptions.SpiceyError as error:
            raise InputError(f"{purpose}: {_meaning(error)}.") from None


@contextmanager
def kernels(*paths: str | Path) -> Iterator[None]:
    """Load kernels for the length of a block, in the order given; later ones take precedence.

    Parameters
    ----------
    paths
        Kernels of any type, meta-kernels among them. SPICE reads the relative paths within a meta-kernel from the
        folder the program runs in, unless its PATH_VALUES say otherwise. Kernels that were loaded before stay
        loaded after the block; other threads that use this module wait until it ends.

    Raises
    ------
    InputError
        spiceypy is not installed, no path is given, or a kernel (or one that a meta-kernel names) is missing or
        unreadable.
    """
    if not paths:
        raise InputError("SPICE kernels: at least one path is needed.")
    spiceypy = load_spiceypy("SPICE kernels")
    for path in paths:
        if not Path(path).is_file():
            raise InputError(f"{path}: SPICE kernel not found.")
    with _pool:
        before = spiceypy.ktotal("ALL")
        try:
            for path in paths:
                with reported(str(path)):
                    spiceypy.furnsh(str(path))
            yield
        finally:
            _unload(spiceypy, [str(path) for path in paths], before)


def et_s_from_julian_date(julian_date: float) -> float:
    """Ephemeris time, seconds TDB past J2000.0, of a TDB Julian date."""
    return (julian_date - J2000_JD) * SECONDS_PER_DAY


def julian_date_from_et_s(et_s: float) -> float:
    """TDB Julian date of an ephemeris time: the inverse of `et_s_from_julian_date`."""
    return J2000_JD + et_s / SECONDS_PER_DAY


def et_s_from_utc(utc: str) -> float:
    """Ephemeris time, seconds TDB past J2000.0, of a UTC text such as "2014-08-06T12:00:00".

    Raises
    ------
    InputError
        No leap-second kernel is loaded, or the text is no time.
    """
    with reported(f"UTC {utc!r}") as spiceypy:
        return float(spiceypy.str2et(utc))


def sun_position_J_au(target: str, et_s: float) -> F64:
    """Geometric position of the Sun from the target's centre, float64[3] au, frame J.

    The opposite of `frames.Orbit.position_J_au`, which is the target's position from the Sun.

    Parameters
    ----------
    target
        SPICE name or number of the body.
    et_s
        Ephemeris time, seconds TDB past J2000.0.

    Raises
    ------
    InputError
        Unknown body, or no position at the epoch.
    """
    with reported(f"Sun from {target} at {_epoch(et_s)}") as spiceypy:
        position_km, _ = spiceypy.spkpos("SUN", et_s, J_FRAME, "NONE", str(target))
    return np.asarray(position_km, dtype=np.float64) / KM_PER_AU


def J_from_T(frame: str, et_s: float) -> F64:
    """Attitude of a body-fixed frame, float64[3, 3]: T to ICRF axes; its transpose is T_from_J.

    Parameters
    ----------
    frame
        SPICE name of the body-fixed frame, such as "IAU_EROS" or "67P/C-G_CK"; its axes have to be the shape's.
    et_s
        Ephemeris time, seconds TDB past J2000.0.

    Raises
    ------
    InputError
        Unknown frame, or no attitude at the epoch.
    """
    with reported(f"frame {frame} at {_epoch(et_s)}") as spiceypy:
        return np.asarray(spiceypy.pxform(frame, J_FRAME, et_s), dtype=np.float64)


def pose_T(
    spacecraft: str, target: str, frame: str, camera_frame: str, et_s: float, K_from_C: F64 | None = None
) -> Pose:
    """Where a spacecraft's camera is and where it looks, in the target's body-fixed frame.

    Parameters
    ----------
    spacecraft, target
        SPICE names or numbers of the spacecraft (or camera) and of the body.
    frame, camera_frame
        SPICE names of the body-fixed frame T and of the camera's frame K, such as "ROS_NAVCAM-A".
    et_s
        Ephemeris time, seconds TDB past J2000.0.
    K_from_C
        float64[3, 3], a rotation: axes of C (x image right, y image down, z boresight) in K, as the instrument's
        frame kernel describes them; default: K is C.

    Raises
    ------
    InputError
        Unknown body or frame, no position or attitude at the epoch, or K_from_C is no rotation.
    """
    mounting = np.eye(3) if K_from_C is None else np.asarray(K_from_C, dtype=np.float64)
    if mounting.shape != (3, 3) or not (
        np.allclose(mounting @ mounting.T, np.eye(3), atol=1e-9) and np.linalg.det(mounting) > 0
    ):
        raise InputError(f"camera frame {camera_frame}: K_from_C must be a 3 × 3 rotation matrix.")
    with reported(f"{spacecraft} from {target} in frame {frame} at {_epoch(et_s)}") as spiceypy:
        position_km, _ = spiceypy.spkpos(str(spacecraft), et_s, frame, "NONE", str(target))
    with reported(f"frame {camera_frame} in {frame} at {_epoch(et_s)}") as spiceypy:
        T_from_K = np.asarray(spiceypy.pxform(camera_frame, frame, et_s), dtype=np.float64)
    return Pose(
        camera_position_T_m=np.asarray(position_km, dtype=np.float64) * METRES_PER_KM,
        T_from_C=T_from_K @ mounting,
    )


def _epoch(et_s: float) -> str:
    return f"JD {julian_date_from_et_s(et_s):.6f} TDB"


def _meaning(error: Any) -> str:
    """One clause, without a full stop, for an error of spiceypy."""
    short = str(getattr(error, "short", ""))
    if short in _MEANINGS:
        return _MEANINGS[short]
    # SPICE explains over several sentences; the first says what went wrong.
    words = " ".join(str(getattr(error, "long", "") or error).split())
    return f"SPICE says: {words.split('. ')[0].rstrip('.')}"


def _unload(spiceypy: Any, paths: list[str], before: int) -> None:
    for path in reversed(paths):
        with suppress(spiceypy.utils.exceptions.SpiceyError):
            spiceypy.unload(path)
    # A meta-kernel that failed half-way leaves what it had loaded by then.
    for index in range(spiceypy.ktotal("ALL") - 1, before - 1, -1):
        with suppress(spiceypy.utils.exceptions.SpiceyError):
            spiceypy.unload(spiceypy.kdata(index, "ALL")[0])
