"""Read SPICE kernels: the Sun's position, the target's attitude and the pose of a spacecraft's camera at an epoch.

This is the only module that imports spiceypy, an optional extra (`pip install 'vbnfault[spice]'`). Frames are as in
`frames`: J international celestial (SPICE's "J2000"), T target body-fixed, C camera; matrices are named
TargetFromSource. Positions are geometric, without light time or aberration, like those of the built-in two-body
ephemeris.

SPICE runs in a separate process, which starts when the first question is sent to SPICE. A damaged kernel can crash
CSPICE in native code; such a crash ends only the separate process. If the calling program also uses spiceypy, this
module neither sees nor changes the program's kernels. The separate process keeps all kernels in one pool. Kernels
are therefore loaded only within a `with` block:

    with kernels("mission.tm"):
        et_s = et_s_from_julian_date(2456875.5)
        sun_J_au = sun_position_J_au("CHURYUMOV-GERASIMENKO", et_s)
        T_from_J = J_from_T("67P/C-G_CK", et_s).T
"""

from __future__ import annotations

import atexit
import importlib.util
import math
import os
import pickle
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..frames import J2000_JD
from ..process import environment
from . import path_checks, user_files

F64 = NDArray[np.float64]

KM_PER_AU = 149597870.7  # IAU 2012 Resolution B2, exact
METRES_PER_KM = 1000.0
SECONDS_PER_DAY = 86400.0
J_FRAME = "J2000"  # SPICE's name for the ICRF axes

# CSPICE is not thread-safe, and all threads would share one pool of kernels.
_pool = threading.RLock()

# Explanations of SPICE's short messages. For all other errors, the message quotes SPICE's text.
_MEANINGS = {
    "SPICE(SPKINSUFFDATA)": "the kernels hold no position at that epoch",
    "SPICE(NOLOADEDFILES)": "no kernel with positions is loaded",
    "SPICE(NOFRAMECONNECT)": "the kernels hold no attitude at that epoch",
    "SPICE(FRAMEDATANOTFOUND)": "the kernels do not define that frame in full",
    "SPICE(KERNELVARNOTFOUND)": "a constant of that body is missing from the kernels",
    "SPICE(UNKNOWNFRAME)": "the kernels define no such frame",
    "SPICE(IDCODENOTFOUND)": "the kernels know no body of that name",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class SpacecraftState:
    """Hold a camera's position and attitude in the target's body-fixed frame.

    Attributes
    ----------
    camera_position_T_m
        float64[3], metres from the target's centre, frame T.
    T_from_C
        float64[3, 3], camera axes (x image right, y image down, z boresight) in T.
    """

    camera_position_T_m: F64
    T_from_C: F64


@contextmanager
def kernels(*paths: str | Path) -> Iterator[None]:
    """Load kernels for the duration of a `with` block, in the given order; later kernels take precedence.

    The kernels of an outer block stay loaded when this block ends. Other threads that use this module wait until
    this block ends.

    Parameters
    ----------
    paths
        Kernels of any type, including meta-kernels, which may name further ones. A relative path in a meta-kernel,
        also one of PATH_VALUES, is looked for from the meta-kernel's own folder, then from the working folder.

    Raises
    ------
    InputError
        spiceypy is not installed, no path is given, or a kernel (or a kernel that a meta-kernel names) is missing
        or unreadable.
    """
    if not paths:
        raise InputError("SPICE kernels: at least one path is needed.")
    _check_installed("SPICE kernels")
    with tempfile.TemporaryDirectory(prefix="vbnfault-") as scratch, _pool:
        listed = [(path, kernel) for path in paths for kernel in _kernels_of(Path(path), Path(scratch))]
        before = int(_ask("SPICE kernels", "loaded"))
        reader = _reader
        try:
            try:
                for path, kernel in listed:
                    _ask(str(path), "load", str(kernel), os.getcwd())
            except InputError:
                if before == 0:  # SPICE keeps records of a refused file, so end its process
                    _end()
                raise
            yield
        finally:
            if reader is _reader is not None:  # a process that has ended has no pool to unload from
                _ask("SPICE kernels", "unload", before)


def read_dsk(path: str | Path) -> tuple[F64, NDArray[np.int64]]:
    """Return the triangular plates of a NAIF DSK: those of all its segments of type 2.

    These segments must belong to the same body and surface.

    Parameters
    ----------
    path
        Path of the file, which `user_files.read_input` has already checked.

    Returns
    -------
    vertices_km, faces
        float64[n, 3] in the body-fixed frame that the segments name, and int64[m, 3], vertex numbers from 0.

    Raises
    ------
    InputError
        spiceypy is not installed, the file is not a DSK, the file is damaged, no segment is of type 2, or the
        segments belong to several surfaces.
    """
    _check_installed(str(path))
    size = path_checks.file_status(path)
    more_s = 0.0 if size is None else size.st_size / _DSK_BYTES_PER_S
    reader = _Reader()  # a process for this file only, since SPICE keeps records of a refused file
    try:
        vertices_km, faces = _answer(reader, str(path), "dsk", os.path.abspath(path), cpu_s=_CPU_S + more_s)
    finally:
        reader.close()
    return vertices_km, faces


def et_s_from_julian_date(julian_date: float) -> float:
    """Return the ephemeris time, seconds TDB past J2000.0, of a TDB Julian date."""
    return (julian_date - J2000_JD) * SECONDS_PER_DAY


def julian_date_from_et_s(et_s: float) -> float:
    """Return the TDB Julian date of an ephemeris time, which is in seconds TDB past J2000.0."""
    return J2000_JD + et_s / SECONDS_PER_DAY


def sun_position_J_au(target: str, et_s: float) -> F64:
    """Return the geometric position of the Sun from the target's centre, float64[3] au, frame J.

    `frames.Orbit.position_J_au` has the opposite direction: from the Sun to the target.

    Parameters
    ----------
    target
        SPICE name or number of the body.
    et_s
        Ephemeris time, seconds TDB past J2000.0.

    Raises
    ------
    InputError
        The body is unknown, or the kernels hold no position at the epoch, or one that no scene may have.
    """
    purpose = f"Sun from {target} at {_epoch(et_s)}"
    position_km = _ask(purpose, "position_km", "SUN", et_s, J_FRAME, str(target))
    sun_J_au = np.asarray(position_km, dtype=np.float64) / KM_PER_AU
    if not 0.01 <= (distance_au := float(np.linalg.norm(sun_J_au))) <= 1000:
        raise InputError(f"{purpose}: is {distance_au:.4g} au away by the kernels; must be from 0.01 to 1000 au.")
    return sun_J_au


def J_from_T(frame: str, et_s: float) -> F64:
    """Return the rotation matrix from a body-fixed frame T to the ICRF axes, float64[3, 3].

    The transpose of this matrix is T_from_J.

    Parameters
    ----------
    frame
        SPICE name of the body-fixed frame, such as "IAU_EROS" or "67P/C-G_CK". The axes of this frame must be those
        of the shape model.
    et_s
        Ephemeris time, seconds TDB past J2000.0.

    Raises
    ------
    InputError
        The frame is unknown, or the kernels hold no attitude at the epoch.
    """
    return np.asarray(_ask(f"frame {frame} at {_epoch(et_s)}", "pxform", frame, J_FRAME, et_s), dtype=np.float64)


def pose_T(
    spacecraft: str, target: str, frame: str, camera_frame: str, et_s: float, K_from_C: F64 | None = None
) -> SpacecraftState:
    """Return the position and attitude of a spacecraft's camera in the target's body-fixed frame.

    Parameters
    ----------
    spacecraft, target
        SPICE names or numbers of the spacecraft (or camera) and of the body.
    frame, camera_frame
        SPICE names of the body-fixed frame T and of the camera's frame K, such as "ROS_NAVCAM-A".
    et_s
        Ephemeris time, seconds TDB past J2000.0.
    K_from_C
        Rotation float64[3, 3] from C (x image right, y image down, z boresight) to K. The frame kernel of the
        instrument describes this rotation. By default K is C.

    Raises
    ------
    InputError
        A body or frame is unknown, the kernels hold no position or attitude at the epoch, or K_from_C is not a
        rotation.
    """
    mounting = np.eye(3) if K_from_C is None else np.asarray(K_from_C, dtype=np.float64)
    if mounting.shape != (3, 3) or not (
        np.allclose(mounting @ mounting.T, np.eye(3), atol=1e-9) and np.linalg.det(mounting) > 0
    ):
        raise InputError(f"camera frame {camera_frame}: K_from_C must be a 3 × 3 rotation matrix.")
    purpose = f"{spacecraft} from {target} in frame {frame} at {_epoch(et_s)}"
    position_km = _ask(purpose, "position_km", str(spacecraft), et_s, frame, str(target))
    purpose = f"frame {camera_frame} in {frame} at {_epoch(et_s)}"
    T_from_K = np.asarray(_ask(purpose, "pxform", camera_frame, frame, et_s), dtype=np.float64)
    return SpacecraftState(
        camera_position_T_m=np.asarray(position_km, dtype=np.float64) * METRES_PER_KM,
        T_from_C=T_from_K @ mounting,
    )


def _epoch(et_s: float) -> str:
    """Return the text of an ephemeris time, as a Julian date, for an error message."""
    return f"JD {julian_date_from_et_s(et_s):.6f} TDB"


# --- the files ------------------------------------------------------------------------------------------------

_BINARY = (b"DAF/", b"DAS/", b"NAIF/")
_DATA = re.compile(rb"\\begindata(.*?)(?:\\begintext|\Z)", re.DOTALL)
_ASSIGNED = re.compile(rb"([A-Za-z0-9_/$.-]+)[ \t]*\+?=\s*(\((?:'(?:[^'\n]|'')*'|[^()'])*\)|'(?:[^'\n]|'')*')")
_TEXT = re.compile(rb"'((?:[^'\n]|'')*)'")
_LISTING = (b"PATH_VALUES", b"PATH_SYMBOLS", b"KERNELS_TO_LOAD")
_DEEPEST_META_KERNEL = 3
_LONGEST_SPICE_PATH = 255
_MOST_KERNELS = 5000  # of a meta-kernel: about what SPICE holds


def _check_installed(purpose: str) -> None:
    """Raise InputError if spiceypy is not installed; the message begins with `purpose`."""
    if importlib.util.find_spec("spiceypy") is None:
        raise InputError(f"{purpose}: needs spiceypy: pip install 'vbnfault[spice]'.")


def _kernels_of(path: Path, scratch: Path, depth: int = 0) -> list[Path]:
    """Return the kernels to load for a path: itself, or what it names and defines if it is a meta-kernel.

    Each is a regular file, because a pipe would block SPICE. Meta-kernels are not left to SPICE, which cuts a path
    after 80 characters, takes it as relative to the working folder, and refuses a meta-kernel in another one. What
    a meta-kernel defines beside its list goes to a file in the folder `scratch`. Raises InputError.
    """
    path_checks.check_path(str(path), "SPICE kernel")
    if len(os.fsencode(path)) > _LONGEST_SPICE_PATH:
        raise InputError(f"{path}: SPICE takes paths of at most {_LONGEST_SPICE_PATH} bytes; name it relatively.")
    if user_files.head_of_input(path, "SPICE kernel", 8).startswith(_BINARY):
        user_files.check_input(path, "SPICE kernel")
        return [path]
    text = user_files.read_input(path, "SPICE text kernel")
    values: dict[bytes, list[str]] = {}
    defined = b""
    for data in _DATA.findall(text):
        for name, value in _ASSIGNED.findall(data):
            texts = [os.fsdecode(t.replace(b"''", b"'")) for t in _TEXT.findall(value)]
            values.setdefault(name.upper(), []).extend(texts)
        defined += _ASSIGNED.sub(lambda match: b"" if match[1].upper() in _LISTING else match[0], data)
    if b"KERNELS_TO_LOAD" not in values:
        return [path]
    if depth == _DEEPEST_META_KERNEL:
        raise InputError(f"{path}: names meta-kernels more than {_DEEPEST_META_KERNEL} deep.")
    folders, symbols, listed = (_continued(values.get(name, [])) for name in _LISTING)
    kernels = []
    if b"=" in defined:
        kernels.append(scratch / f"{len(list(scratch.iterdir()))}{path.suffix}")
        kernels[0].write_bytes(b"KPL/MK\n\\begindata\n" + defined.replace(b"\r", b"") + b"\n\\begintext\n")
    for named in listed:
        full = named
        for symbol, folder in sorted(zip(symbols, folders, strict=False), key=lambda pair: -len(pair[0])):
            full = full.replace(f"${symbol}", folder)
        places = dict.fromkeys([path.parent / full, Path(full)])
        place = next((place for place in places if path_checks.file_status(place) is not None), None)
        if place is None:
            looked = " and ".join(os.path.abspath(place) for place in places)
            raise InputError(f"{path}: KERNELS_TO_LOAD names {named!r}, which is missing; looked for {looked}.")
        kernels += _kernels_of(place, scratch, depth + 1)
        if len(kernels) > _MOST_KERNELS:
            raise InputError(f"{path}: names more than {_MOST_KERNELS} kernels.")
    return kernels


def _continued(pieces: list[str]) -> list[str]:
    """Return texts of a kernel's list with each that ends in "+" joined to the next."""
    return "\0".join(pieces).replace("+\0", "").removesuffix("+").split("\0") if pieces else []


# --- the process that SPICE runs in ---------------------------------------------------------------------------

# CPU time limit for one question. An undamaged kernel needs only a small part of this time.
_CPU_S = 15.0
_DSK_BYTES_PER_S = 5e6
_ADDRESS_SPACE_BYTES = 6 << 30
_DSK_MOST_SEGMENTS = 10_000
_PLATE_BYTES, _VERTEX_BYTES = 12, 24  # smallest numbers of bytes that a DSK of type 2 stores


class _Reader:
    """Run a separate process for SPICE, which answers one question after the other."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        paths = environment.import_path()
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                f"import sys; sys.path[:] = {paths!r}; from vbnfault.core.files import spice; spice.serve()",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C does not reach the SPICE process; it ends with its input
        )

    def ask(self, question: tuple[Any, ...]) -> Any:
        """Return the answer to a question. Raises EOFError or OSError if the process ends before it answers."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        pickle.dump(question, self.process.stdin)
        self.process.stdin.flush()
        return pickle.load(self.process.stdout)

    def close(self) -> int:
        """End the process and return its exit code. The code is negative if a signal ended the process."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with suppress(OSError):
            self.process.stdin.close()
        code = self.process.wait()
        self.process.stdout.close()
        return code


_reader: _Reader | None = None


@atexit.register
def _end() -> None:
    """End the shared SPICE process if the current process started it."""
    global _reader
    if _reader is not None and _reader.owner == os.getpid():
        _reader.close()
    _reader = None


def _ask(purpose: str, name: str, *arguments: Any, cpu_s: float = _CPU_S) -> Any:
    """Return the answer of the shared SPICE process to a question of `_QUESTIONS`.

    Raises InputError, with a message that begins with `purpose`, if SPICE refuses the question or the process ends.
    """
    global _reader
    _check_installed(purpose)
    with _pool:
        if _reader is None or _reader.owner != os.getpid():  # after a fork, the pipes belong to the parent process
            _reader = _Reader()
        try:
            return _answer(_reader, purpose, name, *arguments, cpu_s=cpu_s)
        finally:
            if _reader.process.returncode is not None:
                _reader = None


def _answer(reader: _Reader, purpose: str, name: str, *arguments: Any, cpu_s: float) -> Any:
    """Return the answer of a process to a question. Raises InputError if the process refuses it or has ended."""
    try:
        kind, answer = reader.ask((name, arguments, cpu_s))
    except (EOFError, OSError, pickle.UnpicklingError):
        raise InputError(f"{purpose}: SPICE {_cause(reader.close())}: a kernel is damaged.") from None
    except BaseException:  # without this, the next question after an interrupt would get this answer
        reader.process.kill()
        reader.close()
        raise
    if kind == "refused":
        raise InputError(f"{purpose}: {answer}.")
    return answer


def _cause(code: int) -> str:
    """Return the reason for an exit code of the SPICE process, as text for an error message."""
    if -code == getattr(signal, "SIGXCPU", 0):
        return "does not come to an end"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"aborted ({name})"


def serve() -> None:
    """Answer questions from standard input until the input ends. The SPICE process runs only this function."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # CSPICE prints to file descriptor 1, and its text must not mix with the answers
    questions = sys.stdin.buffer
    for limit, value in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_AS, _ADDRESS_SPACE_BYTES)):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
    import spiceypy

    while True:
        try:
            name, arguments, cpu_s = pickle.load(questions)
        except EOFError:
            return
        used = resource.getrusage(resource.RUSAGE_SELF)
        until = math.ceil(used.ru_utime + used.ru_stime + cpu_s)
        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(
            resource.RLIMIT_CPU, (until if hard == resource.RLIM_INFINITY else min(until, hard), hard)
        )
        try:
            answer = "done", _QUESTIONS[name](spiceypy, *arguments)
        except InputError as error:
            answer = "refused", str(error)
        except spiceypy.utils.exceptions.SpiceyError as error:
            answer = "refused", _meaning(error)
        except MemoryError:
            answer = "refused", "takes more memory than a kernel may"
        except Exception as error:  # spiceypy raises such errors if a text or number is too large for C
            answer = "refused", f"SPICE refuses it ({type(error).__name__})"
        pickle.dump(answer, answers)
        answers.flush()


def _load(spiceypy: Any, path: str, folder: str) -> None:
    """Load a kernel; a relative path is relative to `folder`."""
    os.chdir(folder)
    spiceypy.furnsh(path)


def _unload(spiceypy: Any, before: int) -> None:
    """Unload all kernels except the first `before`, including kernels from a meta-kernel that failed to load."""
    for index in range(spiceypy.ktotal("ALL") - 1, before - 1, -1):
        with suppress(spiceypy.utils.exceptions.SpiceyError):
            spiceypy.unload(spiceypy.kdata(index, "ALL")[0])


def _dsk(spiceypy: Any, path: str) -> tuple[F64, NDArray[np.int64]]:
    """Return the vertices in km and the faces of a DSK, for `read_dsk`.

    A damaged file may state any number of vertices and plates. Therefore the code compares these numbers with the
    size of the file before it allocates memory.
    """
    vertices: list[F64] = []
    faces: list[NDArray[np.int64]] = []
    surfaces: set[tuple[int, int]] = set()
    base = segments = 0
    room = os.path.getsize(path)
    handle = spiceypy.dasopr(path)
    with spiceypy.no_found_check():
        segment, exists = spiceypy.dlabfs(handle)
        while exists:
            segments += 1
            if segments > _DSK_MOST_SEGMENTS:
                raise InputError(f"has more than {_DSK_MOST_SEGMENTS} segments")
            about = spiceypy.dskgd(handle, segment)
            if about.dtype == 2:
                vertices_n, faces_n = spiceypy.dskz02(handle, segment)
                room -= _VERTEX_BYTES * vertices_n + _PLATE_BYTES * faces_n
                if min(vertices_n, faces_n) < 0 or room < 0:
                    raise InputError(f"has no room for the {vertices_n} vertices and {faces_n} plates it names")
                vertices.append(np.array(spiceypy.dskv02(handle, segment, 1, vertices_n), dtype=np.float64))
                plates = np.array(spiceypy.dskp02(handle, segment, 1, faces_n), dtype=np.int64)
                if faces_n and not (plates.min() >= 1 and plates.max() <= vertices_n):
                    raise InputError(f"has plates that name vertices outside 1 to {vertices_n}")
                faces.append(plates - 1 + base)
                base += vertices_n
                surfaces.add((about.center, about.surfce))
            segment, exists = spiceypy.dlafns(handle, segment)
    if not faces:
        raise InputError("expected a DSK segment of type 2 (triangular plates), found none")
    if len(surfaces) > 1:
        listed = ", ".join(f"body {body} surface {surface}" for body, surface in sorted(surfaces))
        raise InputError(f"expected the segments of one surface, found {listed}")
    return np.concatenate(vertices), np.concatenate(faces)


_QUESTIONS: dict[str, Callable[..., Any]] = {
    "load": _load,
    "unload": _unload,
    "loaded": lambda spiceypy: spiceypy.ktotal("ALL"),
    "position_km": lambda spiceypy, body, et_s, frame, target: np.asarray(
        spiceypy.spkpos(body, et_s, frame, "NONE", target)[0], dtype=np.float64
    ),
    "pxform": lambda spiceypy, frame, other, et_s: np.asarray(spiceypy.pxform(frame, other, et_s)),
    "dsk": _dsk,
}


def _meaning(error: Any) -> str:
    """Return the explanation of a spiceypy error, as one clause without a full stop."""
    short = str(getattr(error, "short", ""))
    if short in _MEANINGS:
        return _MEANINGS[short]
    # SPICE's explanation has several sentences, and the first sentence describes the error.
    words = " ".join(str(getattr(error, "long", "") or error).split())
    return f"SPICE says: {words.split('. ')[0].rstrip('.')}"
