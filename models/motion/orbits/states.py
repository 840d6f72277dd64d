r"""States as they were read from a file of any format, made one ephemeris, and what they must obey.

A satellite of the Earth falls: relative to axes that turn at :math:`\omega`

.. math::
    \ddot r + 2\, \omega \times \dot r + \omega \times (\omega \times r)
        = -\mu\, r / \lVert r \rVert^3

to some thousandths. States that do not, or whose velocities are not the derivative of their
positions, are in other units, other axes, or at other epochs than the file says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.formats import kind_of
from terrafix.models.core.timescales import Instant
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.ephemeris import MAX_BYTES, Ephemeris
from terrafix.models.motion.epochs import atomic, read_tags, seconds_since_first
from terrafix.models.motion.orbits.axes import to_earth_fixed

FARTHEST = 1.5e9
"""Beyond which nothing stays with the Earth: its Hill sphere [m]."""
UNLIKE = 0.03
"""Share of gravity, or of a velocity, by which states may be off what they obey, in the median."""

_FEWEST = 8
"""States from which their motion is told."""
_FARTHEST_APART = 1.0
"""Angle about the Earth [rad] between states from which it is told, too."""
_OMEGA = np.array([0.0, 0.0, EARTH.rotation_rate])


@dataclass(frozen=True)
class States:
    """States as a file has them, in meters and seconds.

    Parameters
    ----------
    tags : sequence of str
        Epochs.
    scale, frame : str
        As `scale_named` and `frame_named` have them.
    r : ndarray, shape (n, 3)
        [m]
    v : ndarray, shape (n, 3), optional
        [m/s]
    ends : sequence of int
        Numbers of the states with which parts of the file end.
    """

    tags: Sequence[str]
    scale: str
    frame: str
    r: FloatArray
    v: FloatArray | None
    ends: tuple[int, ...] = ()

    def ephemeris(self) -> Ephemeris:
        """Make an Earth-fixed ephemeris.

        Raises
        ------
        ValueError
            If an epoch or a state cannot be, or the frame is not read.
        ImportError
            If leap seconds or frames are needed, and the extra ``truth`` is not installed.
        """
        tags, within = read_tags(self.tags, self.scale)
        t = seconds_since_first(tags, within, self.scale)
        check_distance(self.r)
        r, v = to_earth_fixed(self.frame, lambda: atomic(tags, within, self.scale), self.r, self.v)
        first = None
        if self.scale != "UTC":
            known = atomic(tags[:1], within[:1], self.scale)
            first = Instant(int(known.day[0]), float(known.seconds[0]))
        made = Ephemeris(tags, t, r, v, self.scale, first, self.ends)
        check_motion(made)
        return made


def check_distance(r: FloatArray) -> None:
    """Raise ValueError if a position (n, 3) [m] is not that of a satellite of the Earth."""
    distance = np.linalg.norm(r, axis=1)
    near, far = distance < EARTH.polar_radius, distance > FARTHEST
    for wrong, where in ((near, "inside the Earth"), (far, "beyond what orbits the Earth")):
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(
                f"state {k} lies {where}, {distance[k]:.6g} m from its center\n"
                "  look at the unit of its positions"
            )


def check_motion(orbit: Ephemeris) -> None:
    """Raise ValueError if Earth-fixed states do not move as a satellite does.

    Fewer than eight, or farther apart than a radian about the Earth, are believed.
    """
    h, r = np.diff(orbit.t), np.linalg.norm(orbit.r_e, axis=1)
    turned = np.median(h) * np.sqrt(EARTH.mu / np.median(r) ** 3)
    if len(orbit.t) < _FEWEST or turned > _FARTHEST_APART:
        return
    if orbit.v_e is not None:
        _check_velocities(orbit, orbit.v_e)
    k = np.flatnonzero(orbit.known & (h <= np.median(h) * (1 + 1e-6)))
    if not len(k):
        return
    h = (orbit.t[k + 1] - orbit.t[k])[:, None]
    (r0, v0), (rm, vm), (r1, v1) = (orbit.at(orbit.t[k] + s * h[:, 0]) for s in (0.0, 0.5, 1.0))
    pulls = [-EARTH.mu * r / np.linalg.norm(r, axis=1)[:, None] ** 3 for r in (r0, rm, r1)]
    turns = [
        -2 * np.cross(_OMEGA, v) - np.cross(_OMEGA, np.cross(_OMEGA, r))
        for r, v in ((r0, v0), (rm, vm), (r1, v1))
    ]
    mean_pull, mean_turn = ((a + 4 * b + c) / 6 for a, b, c in (pulls, turns))
    felt, size = (v1 - v0) / h, np.linalg.norm(mean_pull, axis=1)
    fixed = float(np.median(np.linalg.norm(felt - mean_pull - mean_turn, axis=1) / size))
    inertial = float(np.median(np.linalg.norm(felt - mean_pull, axis=1) / size))
    if fixed <= UNLIKE:
        return
    if inertial <= UNLIKE:
        raise ValueError(
            "its states are said to be Earth-fixed and move as in inertial axes\n"
            "  have its frame named as it is"
        )
    raise ValueError(
        f"its states do not move as a satellite of the Earth does: {100 * fixed:.3g} % of gravity "
        "is missing\n  look at its units, its frame and its epochs"
    )


def _check_velocities(orbit: Ephemeris, v_e: FloatArray) -> None:
    alone = Ephemeris(orbit.tags, orbit.t, orbit.r_e, None, orbit.scale, orbit.first, orbit.ends)
    inner = np.arange(3, len(orbit.t) - 3)
    inner = inner[orbit.known[inner - 1] & orbit.known[inner]]
    if not len(inner):
        return
    v, given = alone.at(orbit.t[inner])[1], v_e[inner]
    speed, told = (float(np.median(np.linalg.norm(u, axis=1))) for u in (v, given))
    differ = float(np.median(np.linalg.norm(given - v, axis=1)))
    if differ > UNLIKE * speed:
        raise ValueError(
            f"its velocities are not those of its positions: {told:.6g} against {speed:.6g} m/s, "
            f"which differ by {differ:.3g} m/s\n"
            "  velocities are relative to the axes that positions are in; look at their unit"
        )


def read_text(path: Path, what: str) -> str:
    """Text of an orbit file.

    Raises
    ------
    ValueError
        If it is too large, empty, or no text.
    OSError
        If it cannot be read.
    """
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES} bytes, which no orbit file is")
    found, cure = kind_of(path)
    if found not in ("", "text", "XML"):
        raise ValueError(f"it is {found}, no {what}\n  {cure}")
    try:
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"it is no text, and no {what}") from error


def number(text: str, where: str) -> float:
    """A finite number.

    Raises
    ------
    ValueError
        If it is none.
    """
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{where} has '{text}', not a number") from None
    if not np.isfinite(value):
        raise ValueError(f"{where} has '{text}', not a finite number")
    return value
