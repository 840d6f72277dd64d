r"""A recorded track: a table of times and places, made a smooth motion.

The file is a table (.csv) whose first line names its columns: ``time`` [s], ``latitude``,
``longitude`` [deg] and ``height`` [m]; and where it was recorded the attitude, as ``roll``,
``pitch``, ``heading`` [deg] or as ``q_x``, ``q_y``, ``q_z``, ``q_w``, north-east-down to body.

Places are joined by splines of degree five in the axes of e: through them, or, where they have
noise of a given sigma, as smooth as leaves a residual of that size. Velocity and acceleration are
the spline's. A recorded attitude is joined by a rotation spline, whose rates are continuous; in its
absence flight is coordinated and without sideslip (`terrafix.models.motion.flight`).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import UnivariateSpline, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.frames import earth_rate_cross
from terrafix.models.geometry.quaternion import from_matrix
from terrafix.models.motion.flight import coordinated_axes
from terrafix.models.motion.strapdown import (
    EARTHS,
    Motion,
    at_end,
    from_level,
    gravity,
    increments_between,
    mechanized,
    rotation_rate,
)

PLACE = ("time", "latitude", "longitude", "height")
ANGLES = ("roll", "pitch", "heading")
QUATERNION = ("q_x", "q_y", "q_z", "q_w")

MOST_ACCELERATION = 50.0
"""Beyond which a track has a step in it [m/s^2]: five g, and what noise of its sigma makes."""

MOST_RATE = 2 * np.pi
"""Beyond which a recorded attitude has a step in it [rad/s]."""

_DEGREE = 5
_SLOWEST = 5.0
_UNIT = 1e-3
_SIGMAS = 4 * np.sqrt(6.0)
"""Of the noise of a second difference, in sigmas of a place: times four."""


@dataclass(frozen=True)
class Track:
    """Times, places and attitudes.

    Parameters
    ----------
    t : ndarray, shape (n,)
        [s]
    latitude, longitude, height : ndarray, shape (n,)
        [rad], [rad], [m]
    attitude : Rotation, optional
        Body to north-east-down.
    lines : ndarray of int, shape (n,)
        Of the file, for errors.
    """

    t: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray
    attitude: Rotation | None
    lines: Any


def read_track(path: str | Path) -> Track:
    """Read a track (.csv).

    Raises
    ------
    ValueError
        If columns are missing or unknown, a number is none, times do not increase, a place is not
        on Earth, or an attitude is no rotation; the message names the line.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [(k, row) for k, row in enumerate(csv.reader(file), 1) if any(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"'{path}' is no table (.csv): {error}") from error
    if not rows:
        raise ValueError(f"'{path}' is empty")
    names = [name.strip() for name in rows[0][1]]
    oriented = _orientation(path, names)
    lines = np.array([k for k, _ in rows[1:]], dtype=np.int64)
    table = np.array([_numbers(path, k, names, row) for k, row in rows[1:]], dtype=np.float64)
    if len(table) <= _DEGREE:
        raise ValueError(f"'{path}' has {len(table)} rows; a track has {_DEGREE + 1} or more")
    columns = dict(zip(names, table.T, strict=True))
    t = columns["time"]
    late = np.flatnonzero(np.diff(t) <= 0)
    if len(late):
        k = int(late[0])
        raise ValueError(
            f"'{path}', line {lines[k + 1]}: time {t[k + 1]:g} s does not come after {t[k]:g} s"
        )
    off = np.flatnonzero((np.abs(columns["latitude"]) > 90) | (np.abs(columns["longitude"]) > 360))
    if len(off):
        k = int(off[0])
        raise ValueError(
            f"'{path}', line {lines[k]}: latitude {columns['latitude'][k]:g}, longitude "
            f"{columns['longitude'][k]:g} is no place in degrees"
        )
    attitude = _attitude(path, columns, lines) if oriented else None
    place = (np.radians(columns["latitude"]), np.radians(columns["longitude"]), columns["height"])
    return Track(t, *place, attitude, lines)


def _orientation(path: Path, names: list[str]) -> bool:
    """Whether the columns hold an attitude."""
    allowed = [{*PLACE, *extra} for extra in ((), ANGLES, QUATERNION)]
    if len(names) != len(set(names)) or set(names) not in allowed:
        raise ValueError(
            f"'{path}' has the columns {', '.join(names)}\n  a track has {', '.join(PLACE)} "
            f"(seconds, degrees, meters), and may have {', '.join(ANGLES)}, or "
            f"{', '.join(QUATERNION)}"
        )
    return len(names) > len(PLACE)


def _numbers(path: Path, line: int, names: list[str], row: list[str]) -> list[float]:
    if len(row) != len(names):
        raise ValueError(f"'{path}', line {line}: {len(row)} numbers for {len(names)} columns")
    found = []
    for name, text in zip(names, row, strict=True):
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise ValueError(f"'{path}', line {line}: {name} is '{text.strip()}', not a number")
        found.append(value)
    return found


def _attitude(path: Path, columns: dict[str, FloatArray], lines: Any) -> Rotation:
    """Body to north-east-down, of angles or quaternions."""
    if "roll" in columns:
        angles = np.stack([columns[n] for n in ANGLES], axis=-1)
        steep = np.flatnonzero(np.abs(angles[:, 1]) > 90)
        if len(steep):
            k = int(steep[0])
            raise ValueError(
                f"'{path}', line {lines[k]}: a pitch of {angles[k, 1]:g} degrees is none"
            )
        return Rotation.from_euler("xyz", angles, degrees=True)
    q = np.stack([columns[n] for n in QUATERNION], axis=-1)
    length = np.linalg.norm(q, axis=-1)
    wrong = np.flatnonzero(np.abs(length - 1) > _UNIT)
    if len(wrong):
        k = int(wrong[0])
        raise ValueError(
            f"'{path}', line {lines[k]}: the attitude is no rotation: its quaternion has the "
            f"length {length[k]:.4g}, not 1"
        )
    # a passive quaternion of Shuster's kind, level to body, is an active one of Hamilton's, back
    return Rotation.from_quat(q)


class SmoothTrack:
    """A track as a motion at any time within it.

    Parameters
    ----------
    track : Track
    earth : {"wgs84", "flat"}
        Of the flat Earth the origin is under the first place.
    position_sigma : float
        Of the noise of its places, each axis [m]; zero: none.

    Raises
    ------
    ValueError
        If it has a step in it, an attitude turns faster than an aircraft, or one is to be derived
        where it hardly moves; the message names the line.
    """

    def __init__(self, track: Track, earth: str = "wgs84", position_sigma: float = 0.0) -> None:
        self.track, self.earth = track, earth
        n = len(track.t)
        origin = (track.latitude[0], track.longitude[0])
        place = (track.latitude, track.longitude, track.height, np.zeros((n, 3)))
        r_e, _, q_be = _placed[earth](*place, np.zeros((n, 3)), *origin)
        self._refuse_steps(r_e, position_sigma)
        self._first = r_e[0]
        self._splines = [_spline(track.t, x, position_sigma) for x in (r_e - r_e[0]).T]
        self._turning = None
        if track.attitude is not None:
            level = Rotation.from_quat(q_be)  # level axes to e
            self._turning = self._turned(level * track.attitude)
        else:
            self._refuse_rest()

    def at(self, t: ArrayLike) -> Motion:
        """Position (n, 3) [m], velocity [m/s] and attitude (n, 4) at times (n,) [s]."""
        t = np.asarray(t, dtype=np.float64)
        r_e, v_e, a_e = (np.stack([s(t, k) for s in self._splines], axis=-1) for k in range(3))
        r_e = r_e + self._first
        if self._turning is None:
            return Motion(r_e, v_e, _coordinated[self.earth](r_e, v_e, a_e))
        return Motion(r_e, v_e, self._turning(t).as_quat())

    def _refuse_steps(self, r_e: FloatArray, sigma: float) -> None:
        t, lines = self.track.t, self.track.lines
        h = np.diff(t)[:, None]
        bend = np.diff(np.diff(r_e, axis=0) / h, axis=0)
        acceleration = np.linalg.norm(2 * bend / (h[1:] + h[:-1]), axis=1)
        shortest = np.minimum(h[1:], h[:-1])[:, 0]
        excess = acceleration - _SIGMAS * sigma / shortest**2
        k = int(np.argmax(excess))
        if excess[k] > MOST_ACCELERATION:
            middle = (r_e[k] * h[k + 1] + r_e[k + 2] * h[k]) / (h[k] + h[k + 1])
            off = np.linalg.norm(r_e[k + 1] - middle)
            raise ValueError(
                f"the track has a step at line {lines[k + 1]} (t = {t[k + 1]:g} s): it would take "
                f"{acceleration[k]:.3g} m/s^2, {off:.3g} m off its neighbors\n"
                f"  a track bends by {MOST_ACCELERATION:g} m/s^2 at most; leave the row out, or "
                "say how noisy its places are"
            )

    def _turned(self, body: Rotation) -> RotationSpline:
        t = self.track.t
        rate = (body[:-1].inv() * body[1:]).magnitude() / np.diff(t)
        k = int(np.argmax(rate))
        if rate[k] > MOST_RATE:
            raise ValueError(
                f"the attitude has a step at line {self.track.lines[k + 1]} (t = {t[k + 1]:g} s): "
                f"it would turn by {np.degrees(rate[k]):.0f} deg/s"
            )
        return RotationSpline(t, body)

    def _refuse_rest(self) -> None:
        t = self.track.t
        speed = np.linalg.norm([s(t, 1) for s in self._splines], axis=0)
        k = int(np.argmin(speed))
        if speed[k] < _SLOWEST:
            raise ValueError(
                f"at line {self.track.lines[k]} (t = {t[k]:g} s) the speed is {speed[k]:.3g} m/s: "
                f"no attitude can be derived below {_SLOWEST:g} m/s\n"
                "  leave out what is not flight, or record the attitude"
            )


def _spline(t: FloatArray, x: FloatArray, sigma: float) -> Any:
    if sigma == 0.0:
        return make_interp_spline(t, x, k=_DEGREE)
    return UnivariateSpline(t, x, np.full(len(t), 1 / sigma), k=_DEGREE, s=len(t))


def _coordinate(r_e: Any, v_e: Any, a_e: Any, earth: str) -> Any:
    force = a_e + 2 * earth_rate_cross(rotation_rate(earth), v_e) - gravity(r_e, earth)
    return from_matrix(coordinated_axes(v_e, force))


def _follow(r: Any, v: Any, q: Any, v_end: Any, q_end: Any, dt: Any, earth: str) -> Any:
    """One step toward a velocity and an attitude: motion and increments."""
    motion = Motion(r, v, q)
    dv, dtheta = increments_between(motion, v_end, q_end, dt, earth)
    return *mechanized(motion, dv, dtheta, dt, earth), dv, dtheta, at_end(dv, dtheta)


_placed = {
    e: over_members(
        lambda a, b, h, v, rph, a0, b0, e=e: tuple(from_level(a, b, h, v, rph, e, (a0, b0))),
        *((), (), (), (3,), (3,), (), ()),
    )
    for e in EARTHS
}
_coordinated = {
    e: over_members(lambda r, v, a, e=e: _coordinate(r, v, a, e), *((3,), (3,), (3,)))
    for e in EARTHS
}
follow_array = {
    e: over_members(
        lambda r, v, q, v1, q1, dt, e=e: _follow(r, v, q, v1, q1, dt, e),
        *((3,), (3,), (4,), (3,), (4,), ()),
    )
    for e in EARTHS
}
"""By Earth: position, velocity, attitude, those wanted at the end, and the step, to the motion at
the end, the increments in turning axes, and the change of velocity in the axes of the end."""
