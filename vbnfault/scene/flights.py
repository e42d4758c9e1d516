"""Define the tables `[[trajectory.flight]]` of a scene file: flights whose poses are computed, not read.

A flight makes sequences, which `world.flights` flies. The keys alone, before a body is loaded, say how many
sequences there are and how many frames each has. A key with bounds is drawn once for a sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from ..core.tables import Table, pair_within
from . import keyed_random

_MOST_FRAMES = 1_000_000
_LENGTH_M = (0.01, 1e12)
_SPEED_M_S = (1e-6, 1e6)

if TYPE_CHECKING:
    Length = float | tuple[float, float]
    Speed = float | tuple[float, float]
    Offset = float | tuple[float, float]
    Start = float | tuple[float, float]
    Half = float | tuple[float, float]
    Turn = float | tuple[float, float]
    Latitude = float | tuple[float, float]
    Tilt = float | tuple[float, float]
    Elevation = tuple[float, float]
else:

    def _bounded(low: float, high: float) -> object:
        """Return the type of a number, or of two bounds between which it is drawn."""
        return Annotated[float, Field(ge=low, le=high)] | pair_within(low, high)

    Length, Speed = _bounded(*_LENGTH_M), _bounded(*_SPEED_M_S)
    Offset, Start = _bounded(0, _LENGTH_M[1]), _bounded(-1e9, 1e9)
    Half, Turn, Latitude = _bounded(0, 180), _bounded(-360, 360), _bounded(-90, 90)
    Tilt, Elevation = _bounded(0, 90), pair_within(-90, 90)
Range = Annotated[float, Field(ge=_LENGTH_M[0], le=_LENGTH_M[1])]


class _Flight(Table):
    """Hold the keys of every flight."""

    sequences: int = Field(1, ge=1, le=100_000, description="how often it is flown, each time drawn anew")
    frames: int = Field(ge=1, le=_MOST_FRAMES, description="of each sequence")
    period_s: float = Field(ge=1e-6, le=1e9, description="time from one frame to the next")
    start_s: Start = Field(0.0, description="time of the first frame after sun.julian_date, or bounds")
    offset_deg: Tilt = Field(
        0.0, description="constant angle between the boresight and what it is aimed at, or bounds"
    )
    attitude_noise_deg: float = Field(
        0.01, ge=0, le=10, description="standard deviation about each axis of the camera, a Gauss-Markov process"
    )
    attitude_time_s: float = Field(
        100.0, ge=1e-3, le=1e9, description="correlation time of the attitude's noise: after it, 1/e is left"
    )
    roll: Literal["pole", "sun"] = Field(
        "pole", description="what is up in the image: the north pole of the body's rotation, or the Sun"
    )

    @property
    def duration_s(self) -> float:
        """Return the time from the first to the last frame."""
        return (self.frames - 1) * self.period_s


class ApproachFlight(_Flight):
    """Fly straight and evenly towards the body's centre of mass, in axes that do not turn."""

    kind: Literal["approach"] = Field(description="along a line towards the body")
    range_m: tuple[Range, Range] = Field(description="distance from the centre of mass, first and last")
    speed_m_s: Speed | None = Field(
        None, description="or bounds; the flight then ends before the last distance. Default: reaches it"
    )
    phase_deg: Half = Field((0.0, 120.0), description="angle at the body between camera and Sun, first; or bounds")

    @model_validator(mode="after")
    def _towards(self) -> ApproachFlight:
        first, last = self.range_m
        if last >= first:
            raise ValueError(
                f"range_m = {list(self.range_m)}: bounds reversed, an approach begins at the first and ends at the "
                "last, which must be nearer"
            )
        speed = 0.0 if self.speed_m_s is None else bounds_of(self.speed_m_s)[1]
        if speed * self.duration_s > first - last:
            raise ValueError(
                f"speed_m_s = {speed:g}: {self.duration_s:g} s of flight would pass the last of range_m = "
                f"{list(self.range_m)}; must be at most {(first - last) / self.duration_s:.4g}"
            )
        return self


class OrbitFlight(_Flight):
    """Orbit the body in its gravity, with the circular speed of a point mass at first."""

    kind: Literal["orbit"] = Field(description="around the body")
    radius_m: Length = Field(description="distance from the centre of mass at the first frame, or bounds")
    inclination_deg: Half = Field(
        (0.0, 180.0), description="to the body's equator, above 90 against its rotation; or bounds"
    )
    node_deg: Turn = Field(
        (0.0, 360.0), description="ascending node from T's x axis at the first frame, eastward; or bounds"
    )
    argument_deg: Turn = Field((0.0, 360.0), description="from the node to the first position, or bounds")


class FlybyFlight(_Flight):
    """Pass the body on a hyperbola in its gravity; the middle of the sequence is the time nearest to it."""

    kind: Literal["flyby"] = Field(description="past the body")
    closest_m: Length = Field(description="least distance from the centre of mass, or bounds")
    speed_m_s: Speed = Field(description="speed far away, or bounds; a point mass bends the path by it")
    phase_deg: Half = Field(
        (0.0, 120.0), description="angle at the body between camera and Sun at the least distance, or bounds"
    )


class _SiteFlight(_Flight):
    """Hold the keys of a flight over a site of the body's shape. Where it is in sight, the highest ground is it."""

    latitude_deg: Latitude = Field((-90.0, 90.0), description="of the site from T's origin, north; or bounds")
    longitude_deg: Turn = Field((0.0, 360.0), description="of the site from T's x axis, eastward; or bounds")
    max_slope_deg: float = Field(35.0, ge=0, le=90, description="of a site's facet against gravity and rotation")
    sun_elevation_deg: Elevation = Field(
        (10.0, 90.0),
        description="allowed elevations of the Sun at the site, half-way through the sequence; if it must be up, "
        "the site is in sunlight",
    )
    look: Literal["site", "down"] = Field(
        "site", description="what the camera is aimed at: the site, the second one of a hop; or straight down"
    )


class DescentFlight(_SiteFlight):
    """Fall freely from a height to a lower one, straight above the site at the last frame."""

    kind: Literal["descent"] = Field(description="to a site")
    height_m: Length = Field(description="above the site, along its vertical, at the first frame; or bounds")
    end_height_m: Length = Field(description="above the site at the last frame, or bounds")
    aside_m: Offset = Field(0.0, description="distance from the site's vertical at the first frame, or bounds")

    @model_validator(mode="after")
    def _down(self) -> DescentFlight:
        if bounds_of(self.end_height_m)[1] >= bounds_of(self.height_m)[0]:
            raise ValueError(
                f"end_height_m = {bounds_of(self.end_height_m)[1]:g}: must be below height_m, "
                f"{bounds_of(self.height_m)[0]:g}"
            )
        if self.frames < 2:
            raise ValueError(f"frames = {self.frames}: must be at least 2, the first and the last of the descent")
        return self


class HoverFlight(_SiteFlight):
    """Keep a station above a site: parabolas between thrusts, within a dead band about the station."""

    kind: Literal["hover"] = Field(description="above a site")
    height_m: Length = Field(description="of the station above the site, along its vertical; or bounds")
    dead_band_m: Length = Field(5.0, description="height and width of the band of positions, or bounds")

    @model_validator(mode="after")
    def _above_ground(self) -> HoverFlight:
        if bounds_of(self.dead_band_m)[1] >= 2 * bounds_of(self.height_m)[0]:
            raise ValueError(
                f"dead_band_m = {bounds_of(self.dead_band_m)[1]:g}: must be below "
                f"{2 * bounds_of(self.height_m)[0]:g}, twice height_m"
            )
        return self


class RelocationFlight(_SiteFlight):
    """Hop freely from a site to another one, as a lander that moves; the flight lasts for the sequence."""

    kind: Literal["relocation"] = Field(description="from a site to another one")
    distance_m: Length = Field(description="from one site to the other in a straight line, or bounds")
    height_m: Length = Field(10.0, description="of the camera above its site, at first and at last; or bounds")

    @model_validator(mode="after")
    def _moves(self) -> RelocationFlight:
        if self.frames < 2:
            raise ValueError(f"frames = {self.frames}: must be at least 2, the first and the last of the hop")
        return self


AnyFlight = Annotated[
    ApproachFlight | OrbitFlight | FlybyFlight | DescentFlight | HoverFlight | RelocationFlight,
    Field(discriminator="kind"),
]


def frames_of(flights: Sequence[AnyFlight]) -> tuple[int, ...]:
    """Return the number of frames of each sequence that flights make."""
    return tuple(flight.frames for flight in flights for _ in range(flight.sequences))


def numbered(flights: Sequence[AnyFlight]) -> list[tuple[AnyFlight, int]]:
    """Return the flight of each sequence, and the number of the sequence among those of its kind, from 0.

    The number is the key of what is drawn, so that flights of other kinds do not change a sequence.
    """
    counts: dict[str, int] = {}
    out = []
    for flight in flights:
        for _ in range(flight.sequences):
            number = counts.setdefault(flight.kind, 0)
            counts[flight.kind] += 1
            out.append((flight, number))
    return out


def drawn(seed: int, flight: AnyFlight, number: int, key: str, attempt: int = 0) -> float:
    """Return the value of a key in a sequence of a flight, drawn if it has bounds; `attempt` counts its tries."""
    low, high = bounds_of(getattr(flight, key))
    return low + (high - low) * uniform(seed, flight, number, key, attempt)


def uniform(seed: int, flight: AnyFlight, number: int, name: str, attempt: int = 0) -> float:
    """Return a random number in [0, 1) of a sequence of a flight; `attempt` counts its tries."""
    of = f"{flight.kind}/{name}/{attempt}"
    return float(keyed_random.keyed_uniform(seed, np.array([number]), "flight", of)[0])


def bounds_of(value: float | tuple[float, float]) -> tuple[float, float]:
    """Return the bounds of a value; those of a number are equal."""
    return value if isinstance(value, tuple) else (value, value)
