"""Define what happens to raw DN on board before they are sent: companding to fewer codes, and lossy compression.

The chain goes on with the DN that the ground restores. Bits that are lost on the way (the fault `transmission`) are
lost in restored lines: real packets hold codes, so that one error spreads over more pixels than here. What faults
make of restored DN is companded again, for no other DN can arrive.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from ...core.errors import VbnfaultError
from .contract import Effect, Exposure, FaultStep
from .output import Raw

if TYPE_CHECKING:
    from ..sensor import Sensor

_LEAST_PX = 32  # JPEG 2000 with OpenCV's six resolutions needs as many pixels each way


class Companding(Effect):
    """Reduce raw DN to fewer codes by a table, from which the ground restores DN.

    With steps that grow as the square root of the signal, as its shot noise does, 8 bits hold 12 with little loss:
    Cassini's cameras (Porco et al. 2004, doi 10.1007/s11214-004-1456-7), the Mars rovers' Pancam (Bell et al. 2003,
    doi 10.1029/2003JE002070). HiRISE chooses one of several tables from 14 to 8 bits (McEwen et al. 2007, doi
    10.1029/2005JE002605).
    """

    name = "companding"
    after = "stuck_pixels"

    law: Literal["square_root", "linear"] = Field(
        "square_root",
        description="square_root or linear: DN, bias included, grow as the square of the codes, or as the codes",
    )
    bits: int = Field(8, ge=1, le=16, description="bits of a code")
    levels_dn: tuple[Annotated[int, Field(ge=0, le=65535)], ...] = Field(
        (),
        max_length=65536,
        description="DN that the ground restores for each code, rising, in place of law and bits",
    )

    @field_validator("levels_dn")
    @classmethod
    def _rising(cls, levels: tuple[int, ...]) -> tuple[int, ...]:
        if len(levels) == 1 or any(b <= a for a, b in pairwise(levels)):
            raise ValueError("must hold two DN or more, each above the one before")
        return levels

    @property
    def codes(self) -> int:
        """Return the number of codes."""
        return len(self.levels_dn) or 2**self.bits

    def tables(self, top_dn: int) -> tuple[Raw, Raw]:
        """Return the code of each DN up to the highest, and the DN of each code, uint16[n]."""
        return _tables(self, top_dn)

    def apply(self, signal: Raw, exposure: Exposure) -> Raw:
        """Return the restored DN."""
        code_of, dn_of = self.tables(exposure.sensor.readout.top_dn)
        return dn_of[code_of[signal]]


@lru_cache(maxsize=8)
def _tables(companding: Companding, top_dn: int) -> tuple[Raw, Raw]:
    def level(code: Any) -> Any:
        if companding.levels_dn:
            return np.interp(code, np.arange(companding.codes), companding.levels_dn)
        return top_dn * (code / (companding.codes - 1)) ** (2 if companding.law == "square_root" else 1)

    code = np.arange(companding.codes, dtype=np.float64)
    # a code begins halfway to the one before: of the levels of a list, or of the square roots
    code_of = np.searchsorted(level(code[1:] - 0.5), np.arange(top_dn + 1), side="right")
    return code_of.astype(np.uint16), np.rint(np.minimum(level(code), top_dn)).astype(np.uint16)


class Compression(Effect):
    """Compress raw DN with loss, each colour of a mosaic for itself.

    The codes of `companding` are compressed, where the sensor has it; else JPEG takes the upper 8 bits. JPEG's
    cosine transform in blocks of 8 × 8 is what Cassini's cameras had (Porco et al. 2004). The wavelets of JPEG 2000
    stand for those of ICER on the Mars rovers (Kiely & Klimesh 2003, IPN Progress Report 42-155).
    """

    name = "compression"
    after = "companding"
    spreads = True

    codec: Literal["jpeg", "jpeg2000"] = Field(description="the compression: jpeg or jpeg2000")
    quality: int = Field(90, ge=1, le=100, description="of jpeg: the scale of libjpeg")
    bits_per_px: float = Field(2.0, ge=0.05, le=16, description="of jpeg2000: size of the compressed image at most")

    def check(self, sensor: Sensor) -> None:
        """Raise ValueError where JPEG, of 8 bits, would get more."""
        given = _companding(sensor)
        if self.codec == "jpeg" and given is not None and given.codes > 256:
            raise ValueError(
                f"effects.companding gives {given.codes} codes; must be at most 256, of 8 bits, where "
                "effects.compression.codec = 'jpeg'"
            )

    def apply(self, signal: Raw, exposure: Exposure) -> Raw:
        """Return the restored DN."""
        readout = exposure.sensor.readout
        bits = min(readout.bits, 8) if self.codec == "jpeg" else readout.bits
        companding = _companding(exposure.sensor) or Companding(law="linear", bits=bits)
        code_of, dn_of = companding.tables(readout.top_dn)
        codes, (rows, columns) = code_of[signal], np.shape(exposure.sensor.pattern.tile)
        for y in range(rows):
            for x in range(columns):
                codes[y::rows, x::columns] = self._restored(codes[y::rows, x::columns])
        return dn_of[np.minimum(codes, companding.codes - 1)]

    def _restored(self, plane: Raw) -> NDArray[Any]:
        """Return the codes of one colour, uint16[y, x], after compression."""
        height, width = plane.shape
        below, right = max(_LEAST_PX - height, 0), max(_LEAST_PX - width, 0)
        plane = cv2.copyMakeBorder(plane, 0, below, 0, right, cv2.BORDER_REFLECT)
        if self.codec == "jpeg":
            done, data = cv2.imencode(".jpg", plane.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, self.quality])
        else:
            rate = max(round(1000 * self.bits_per_px / 16), 1)  # of OpenCV, in thousandths of 16 bits
            done, data = cv2.imencode(".jp2", plane, [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, rate])
        if not done:
            raise VbnfaultError(f"effects.compression: OpenCV {cv2.__version__} cannot encode {self.codec}")
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))[:height, :width]


class RawStep(FaultStep):
    """Let faults act on the raw DN, which stay DN of the codes of `companding`, where the sensor has it."""

    name = "raw"
    after = "compression"

    def apply(self, signal: Raw, exposure: Exposure) -> Raw:
        """Return the restored DN with the faults of this step."""
        acted, companding = super().apply(signal, exposure), _companding(exposure.sensor)
        return companding.apply(acted, exposure) if companding and exposure.acts.get(self.name) else acted


def _companding(sensor: Sensor) -> Companding | None:
    return next((effect for effect in sensor.effects if isinstance(effect, Companding)), None)
