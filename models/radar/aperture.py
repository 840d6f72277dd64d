"""An aperture: where a radar on an aircraft was while it received, and what it can hear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.ground import Ground
from terrafix.models.motion.sampled import SampledArc
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, Radar

MARGIN = 12
"""Cells beyond both ends of the swath that are summed, whose sidelobes reach into it."""
CUT = 0.66
"""Part of the first null up to which scatterers are summed: the pattern has fallen by 15 dB."""
_HALF_POWER = 0.886
"""Width of a uniform aperture's pattern at half power, one way, relative to its first null."""
_UNIT = 1e-6
"""How far from one the length of a quaternion may be."""


@dataclass(frozen=True)
class Aperture:
    """Where a radar was while it received, and what it received of.

    Parameters
    ----------
    radar : Radar
    t : ndarray, shape (n_pulses,)
        Times of the pulses [s].
    r : ndarray, shape (n_pulses, 3)
        Places of the antenna [m], in the frame of a `Ground`.
    axis : ndarray, shape (n_pulses, 3)
        Unit vector along the antenna's long side: the beam is centered across it.
    beamwidth : float
        At half power, one way, along the track [rad].
    near_range : float
        Slant range of the first cell [m].
    n_cells : int
        Cells of a line.
    side : {1, -1}
        To the right of the track, or to the left.

    Raises
    ------
    ValueError
        If shapes do not fit, times are not those of the repetition frequency, or the beam holds
        Doppler frequencies that it does not sample.
    """

    radar: Radar
    t: FloatArray
    r: FloatArray
    axis: FloatArray
    beamwidth: float
    near_range: float
    n_cells: int
    side: int = 1

    def __post_init__(self) -> None:
        n = len(self.t)
        if n < 2 or self.r.shape != (n, 3) or self.axis.shape != (n, 3):
            raise ValueError(
                f"an aperture is places and axes of {n} pulses, two at least, got shapes "
                f"{self.r.shape} and {self.axis.shape}"
            )
        if self.side not in (1, -1):
            raise ValueError(f"a radar looks to side 1 (right) or -1 (left), not {self.side}")
        if not (self.near_range > 0 and self.n_cells >= 2):
            raise ValueError(
                f"a swath of {self.n_cells} cells from {self.near_range} m holds nothing"
            )
        if np.abs(np.diff(self.t) * self.radar.prf - 1).max() > 1e-6:
            raise ValueError(
                f"pulses of an aperture are 1/{self.radar.prf:g} s apart: its times are not"
            )
        lit = 2 * self.speed * self.beamwidth / self.radar.wavelength
        if lit > self.radar.prf:
            raise ValueError(
                f"a beam of {np.degrees(self.beamwidth):.1f} deg holds {lit:.0f} Hz of Doppler at "
                f"{self.speed:.1f} m/s, and {self.radar.prf:.0f} pulses a second sample less\n"
                "  raise the repetition frequency, or narrow the beam"
            )

    @property
    def middle(self) -> int:
        """Pulse in the middle."""
        return len(self.t) // 2

    @property
    def velocity(self) -> FloatArray:
        """Mean velocity (3,) [m/s]."""
        return np.asarray((self.r[-1] - self.r[0]) / (self.t[-1] - self.t[0]))

    @property
    def speed(self) -> float:
        """Of the mean velocity [m/s]."""
        return float(np.linalg.norm(self.velocity))

    @property
    def null(self) -> float:
        """Sine at which the pattern first vanishes."""
        return self.beamwidth / _HALF_POWER

    @property
    def slant_range(self) -> FloatArray:
        """Of the cells (n_cells,) [m]."""
        return np.asarray(self.near_range + self.radar.range_spacing * np.arange(self.n_cells))

    @property
    def cell_area(self) -> float:
        """Of a resolution cell in the slant plane, in the middle of the swath [m^2]."""
        duration = len(self.t) / self.radar.prf
        distance = float(self.slant_range.mean())
        along = self.radar.wavelength * distance / (2 * self.speed * duration)
        return along * SPEED_OF_LIGHT / (2 * self.radar.bandwidth)


@dataclass(frozen=True)
class Antenna:
    """How an antenna sits on an aircraft, and what it lights.

    Parameters
    ----------
    beamwidth : float
        At half power, one way, along the track [rad].
    side : {1, -1}
        To the right, or to the left.
    squint : float
        Of the beam, forward of the wing [rad].
    depression : float
        Of the beam's center below the wings [rad].
    elevation_beamwidth : float
        From the near to the far edge of what is lit [rad].
    """

    beamwidth: float
    side: int = 1
    squint: float = 0.0
    depression: float = float(np.radians(40.0))
    elevation_beamwidth: float = float(np.radians(30.0))

    @property
    def axis(self) -> FloatArray:
        """Unit vector along its long side, in body axes forward, right, down."""
        return np.array([np.cos(self.squint), -self.side * np.sin(self.squint), 0.0])


def flown_aperture(
    radar: Radar,
    antenna: Antenna,
    t: FloatArray,
    r: FloatArray,
    q: FloatArray,
    *,
    near_range: float,
    n_cells: int,
) -> Aperture:
    """Aperture of all pulses that are sent between the first and the last sample of a motion.

    Parameters
    ----------
    radar : Radar
    antenna : Antenna
    t : ndarray, shape (n,)
        Times of the samples [s].
    r : ndarray, shape (n, 3)
        Places of the antenna [m], in the frame of a `Ground`.
    q : ndarray, shape (n, 4)
        Attitude, that frame to body, scalar last.
    near_range : float
        Slant range of the first cell [m].
    n_cells : int
        Cells of a line.

    Raises
    ------
    ValueError
        If times run backward, an attitude is no rotation, or less than two pulses are sent.
    """
    from scipy.spatial.transform import Rotation, RotationSpline

    arc = SampledArc(t, r)
    length = np.linalg.norm(q, axis=1)
    if not np.all(np.abs(length - 1) < _UNIT):
        k = int(np.argmax(~(np.abs(length - 1) < _UNIT)))
        raise ValueError(f"the attitude at {t[k]:.3f} s is no rotation: its length is {length[k]}")
    n = int(np.floor((t[-1] - t[0]) * radar.prf + _UNIT))
    if n < 2:
        raise ValueError(f"{n} pulses are sent between {t[0]:.3f} and {t[-1]:.3f} s: two at least")
    pulses: FloatArray = (t[0] + t[-1]) / 2 + (np.arange(n) - (n - 1) / 2) / radar.prf
    # a passive rotation to body is an active one from body
    axis = RotationSpline(t, Rotation.from_quat(q))(pulses).apply(antenna.axis)
    return Aperture(
        radar,
        pulses,
        arc.position(pulses),
        axis,
        antenna.beamwidth,
        near_range,
        n_cells,
        antenna.side,
    )


def require_lit(
    antenna: Antenna, aperture: Aperture, ground: Ground, height: float, q: FloatArray
) -> None:
    """Raise ValueError if a bank has lifted the beam off the swath, or dropped it short.

    Parameters
    ----------
    antenna : Antenna
    aperture : Aperture
    ground : Ground
        Frame of the aperture.
    height : float
        Of the terrain in the swath [m].
    q : ndarray, shape (4,)
        Attitude in the middle of the aperture, the ground's frame to body, scalar last.
    """
    from scipy.spatial.transform import Rotation

    r, v = aperture.r[aperture.middle], aperture.velocity
    p = ground.seen(r, v, aperture.slant_range[[0, -1]], 0.0, height, aperture.side)
    sight = (p - r) / np.linalg.norm(p - r, axis=1, keepdims=True)
    below = np.arcsin(Rotation.from_quat(q).inv().apply(sight)[:, 2])
    half = antenna.elevation_beamwidth / 2
    edges = antenna.depression - half, antenna.depression + half
    if below.min() < edges[0] or below.max() > edges[1]:
        near, far = np.degrees(below)
        raise ValueError(
            f"the swath lies {far:.0f} to {near:.0f} deg below the wings, and the beam lights "
            f"{np.degrees(edges[0]):.0f} to {np.degrees(edges[1]):.0f} deg\n"
            "  fly with less bank, or choose another swath or another depression of the antenna"
        )
