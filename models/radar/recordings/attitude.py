"""Attitude of a body on which an antenna is mounted, from that of the antenna in a file of echo."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.formats import CEOS_DATA, CEOS_LEADER, HDF5, kind_of
from terrafix.models.geometry.antenna import nominal_antenna_array
from terrafix.models.geometry.quaternion import (
    from_matrix_array,
    inverse_array,
    product_array,
    rotation_matrix_array,
)
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.radar.recordings.ceos import ceos_track
from terrafix.models.radar.recordings.nisar import l0b_track
from terrafix.models.radar.recordings.recording import Track, seconds

_LEVEL = np.radians(20.0)
"""How far the body's z axis may be from nadir: a radar that is said to look elsewhere than its file
says it does is farther."""


class BodyAttitude:
    """Attitude of a body in orbit.

    Axes of the antenna in its file need not be ours: z is its boresight, and x that of the others
    which lies along the track, forward.

    Parameters
    ----------
    track : Track
    look : float
        Angle off nadir, positive to the right, that the antenna is mounted at: body axes are x
        forward, y right, z to nadir where it looks so far off it [rad].

    Raises
    ------
    ValueError
        If the track has no orbit or no attitude, or the boresight lies elsewhere.
    """

    def __init__(self, track: Track, look: float) -> None:
        if track.orbit is None or track.attitude is None:
            missing = "orbit" if track.orbit is None else "attitude"
            raise ValueError(f"it has no {missing}")
        self.orbit: Ephemeris = track.orbit
        """From whose first state times are counted."""
        self.t: FloatArray = track.attitude.t + seconds(track.epoch - self.orbit.tags[0])
        """Times of the attitude [s]."""
        if len(self.t) < 2 or not self.orbit.covers(self.t).all():
            raise ValueError("its attitude is of one time, or of times without orbit")
        r, v = self.orbit.at(self.t)
        matrix = rotation_matrix_array(track.attitude.q_ae)
        ahead = np.einsum("nij,nj->ni", matrix[:, :2], v)
        nearest = np.argmax(np.abs(ahead[0]))
        x = matrix[:, nearest] * np.sign(ahead[0, nearest])
        z = matrix[:, 2]
        q_se = from_matrix_array(np.stack([x, np.cross(z, x), z], axis=1))
        q_sb = nominal_antenna_array(look, 0.0)
        q_be = product_array(inverse_array(q_sb), q_se)
        nadir = -r / np.linalg.norm(r, axis=1)[:, None]
        down = np.einsum("ni,ni->n", rotation_matrix_array(q_be)[:, 2], nadir)
        off = np.arccos(np.clip(down, -1, 1))
        if off.max() > _LEVEL:
            found = np.degrees(np.arccos(np.einsum("ni,ni->n", z, nadir)[0]))
            side = "right" if z[0] @ np.cross(r[0], v[0]) < 0 else "left"
            raise ValueError(
                f"its boresight is {found:.2f} deg off nadir to the {side}, and is said to be "
                f"mounted at {np.degrees(look):.2f} deg"
            )
        flips = np.sign(np.einsum("ni,ni->n", q_be[1:], q_be[:-1]))
        self._q_be: FloatArray = q_be * np.cumprod(np.append(1.0, flips))[:, None]

    def at(self, t: float) -> FloatArray:
        """Quaternion (4,), Earth-fixed to body, at a time since the first state of the orbit [s].

        Between the file's times the body turns evenly; its sign is continuous.

        Raises
        ------
        ValueError
            If the attitude is not known then.
        """
        if not self.t[0] <= t <= self.t[-1]:
            raise ValueError(
                f"attitude is known from {self.t[0]:.6f} s to {self.t[-1]:.6f} s after the first "
                f"state of the orbit, and not at {t:.6f} s"
            )
        k = min(int(np.searchsorted(self.t, t, side="right")), len(self.t) - 1)
        one, other = self._q_be[k - 1], self._q_be[k]
        part = (t - self.t[k - 1]) / (self.t[k] - self.t[k - 1])
        half = np.arccos(np.clip(one @ other, -1.0, 1.0))
        q = one * np.sinc((1 - part) * half / np.pi) * (1 - part)
        q += other * np.sinc(part * half / np.pi) * part
        return np.asarray(q / np.linalg.norm(q), np.float64)


def read_body_attitude(path: Path, look: float) -> BodyAttitude:
    """Read the attitude of a file of echo: NISAR's HDF5, or CEOS (its lines or its leader).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is of another kind, or has no orbit or no attitude, or they cannot be.
    """
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    found, _ = kind_of(path)
    try:
        if found == HDF5:
            return BodyAttitude(l0b_track(path), look)
        if found in (CEOS_DATA, CEOS_LEADER):
            return BodyAttitude(ceos_track(path), look)
        raise ValueError(
            f"it is {found or 'of a kind that is not known'}; attitude is read from NISAR L0B "
            "(HDF5) and from CEOS of level 1.0"
        )
    except (ValueError, OSError, RuntimeError) as error:
        raise ValueError(f"'{path}' has no attitude that is read: {error}") from error
