r"""Recorded raw echo in CEOS of level 1.0, as ALOS PALSAR's is published.

A file of lines (``IMG-HH-ALPSRP...-H1.0__A``) begins with a record that says how many there are.
The record of a line has a prefix of 412 bytes, then pairs of bytes, in-phase and quadrature, the
bias of which the leader says (``LED-ALPSRP...-H1.0__A``, in the same folder), as it does the
carrier, the sampling rate, the chirp, the track and the attitude. What is left of the window of
reception, where it moved or ended, is zero.

Times of lines are those at which their first sample was received, cut to a millisecond (ISCE3 takes
them so; ISCE2, for those of sending: 38 m along the track). Lines are even: the time of the
first, of which all the others' remainders tell, and the repetition frequency give all. Whether they
are cut or rounded is not published: half a millisecond, 3.5 m along the track, is left open, and is
the standard error `TIME_SIGMA`.

Attitude is told in yaw, pitch and roll from axes along the inertial velocity and to the center of
the Earth to those of the body, in which the antenna looks to the right, by the nominal angle off
nadir. Written so by ISCE3, whose quaternions of a scene these angles reproduce.

No original was at hand.

References
----------
.. [1] NEC TOSHIBA Space Systems, JAXA, "ALOS product format description (PALSAR level 1.0)".
.. [2] Caltech, "ISCE3", stripmap.readers.l0raw.ALOS, and share/nisar/examples/alos_to_nisar_l0b.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.core.ceos import HEADER, Kind, Record, read_records
from terrafix.models.core.formats import CEOS_LEADER, kind_of
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import from_matrix_array
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.motion.orbits.leader import POSITIONS, POSITIONS_NAME, day_of, orbit_of
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, gain_of
from terrafix.models.radar.recordings.lines import places_by_number, places_by_tags, slips_among
from terrafix.models.radar.recordings.recording import (
    IMAGE,
    WHAT,
    AntennaAttitude,
    Recording,
    Sent,
    Track,
    looked_through,
    lost_lines,
    seconds,
)

TIME_SIGMA = 1e-3 / np.sqrt(12)
"""Standard error of all times [s]: they may be cut to a millisecond, or rounded to it."""

_RESOLUTION = 1e-3
"""Of times [s]."""
_DESCRIPTOR, _LINE = (50, 192, 18, 18), (50, 10, 18, 20)
_SUMMARY: Kind = (18, 10, 18, 20)
_ATTITUDE: Kind = (18, 40, 18, 20)
_CALIBRATION: Kind = (18, 120, 18, 20)
_NAMES = {
    _SUMMARY: "its data set summary",
    POSITIONS: POSITIONS_NAME,
    _ATTITUDE: "its attitude record",
    _CALIBRATION: "its calibration record",
}
_SHORTEST = {_SUMMARY: 1858, POSITIONS: 386, _ATTITUDE: 16, _CALIBRATION: 68}
"""Bytes of records that are read."""
_DESCRIPTOR_LENGTH = 720
_PREFIX = 412
_MOST_LINES, _MOST_CELLS = 999_999, 65_536
_FIELDS = {
    "kind": (5, "(4,)u1"),
    "length": (9, ">u4"),
    "number": (13, ">i4"),
    "left": (21, ">i4"),
    "right": (29, ">i4"),
    "year": (37, ">i4"),
    "day": (41, ">i4"),
    "millisecond": (45, ">i4"),
    "prf": (57, ">i4"),
    "scan": (61, ">i4"),
    "compressed": (65, ">i2"),
    "chirp_length": (69, ">i4"),
    "gain": (93, ">i4"),
    "nought": (97, ">i4"),
    "range": (117, ">i4"),
}
"""What is read of the prefix of a line: first byte, counted from 1, and type."""
_SAID = {
    "prf": "the repetition frequency",
    "scan": "the number of the scan",
    "compressed": "whether it is compressed in range",
    "chirp_length": "the length of the chirp",
}
_DAY = 86400.0
_POINT = 120
"""Bytes of a point of attitude."""
_RIGHT = 90.0
_SLIPPED = "their times do not say so: have them corrected by whoever made the file"


class ByteLines:
    """Lines of a file, read when they are wanted.

    Parameters
    ----------
    path : Path
    layout : dtype
        Of the record of a line: `prefix` and `samples`.
    start : int
        Record that the first line is, counted from 0.
    n_cells : int
        Of the widest window, in which `shift` places the samples of a line.
    bias : float
        Of the bytes.
    prefix : ndarray, shape (n_lines,)
        Prefixes of all lines.
    shift : ndarray of int, shape (n_lines,)
        Cells from the nearest range of all lines to the first of each.
    gain : ndarray of float32, shape (n_lines,), optional
    """

    def __init__(
        self,
        path: Path,
        layout: np.dtype[np.void],
        start: int,
        n_cells: int,
        bias: tuple[float, float],
        prefix: NDArray[np.void],
        shift: NDArray[np.intp],
        gain: Single | None,
    ) -> None:
        self.shape = len(prefix), n_cells
        self._path, self._layout, self._start, self._bias = path, layout, start, bias
        self._prefix, self._shift, self._gain = prefix, shift, gain

    def read(self, first: int, last: int) -> ComplexArray:
        """Lines `first` to `last - 1`."""
        n = self._start + len(self._prefix)
        raw = _lines(self._path, self._layout, n)["samples"][
            self._start + first : self._start + last
        ]
        width = raw.shape[1] // 2
        part = np.empty((len(raw), width), np.complex64)
        part.real = raw[:, ::2] - np.float32(self._bias[0])
        part.imag = raw[:, 1::2] - np.float32(self._bias[1])
        prefix = self._prefix[first:last]
        cell = np.arange(width)
        filled = (cell < prefix["left"][:, None]) | (cell >= width - prefix["right"][:, None])
        part[filled] = 0
        same = np.all((part == part[:, :1]) | filled, axis=1)
        part[same | (prefix["nought"] != 0)] = 0
        if self._gain is not None:
            part *= self._gain[first:last, None]
        if width == self.shape[1]:
            return part
        echo = np.zeros((len(part), self.shape[1]), np.complex64)
        for k, at in enumerate(self._shift[first:last]):
            echo[k, at : at + width] = part[k]
        return echo


def read_ceos(path: Path) -> Recording:
    """Read recorded echo (CEOS, level 1.0, ALOS PALSAR).

    Raises
    ------
    ValueError
        If it is of another level, damaged or truncated, a field cannot be, its leader is not
        beside it, or more than `lines.MOST_LOST` of its lines are missing.
    """
    try:
        return _recording(path)
    except (ValueError, OSError) as error:
        raise ValueError(f"'{path}' is not {WHAT}: {error}") from error


def ceos_track(path: Path) -> Track:
    """Track in the leader of a recording (CEOS, level 1.0), or in that of a file of lines.

    Raises
    ------
    ValueError
        If a field cannot be, or the leader is not beside the file.
    OSError
        If it cannot be read.
    """
    records = _records(path if kind_of(path)[0] == CEOS_LEADER else _leader(path))
    epoch, orbit = day_of(records[POSITIONS]), orbit_of(records[POSITIONS])
    return Track(epoch, orbit, _attitude(records, epoch, orbit))


def _recording(path: Path) -> Recording:
    layout, n = _layout(path)
    prefix = np.array(_lines(path, layout, n)["prefix"])
    width = layout["samples"].itemsize // 2
    _check_prefixes(prefix, layout.itemsize, width)
    records = _records(_leader(path))
    summary = records[_SUMMARY]
    kept = _without_calibration(summary, n)
    prefix = prefix[kept]
    sent = _sent(summary, records[_CALIBRATION], prefix)
    ranges = prefix["range"].astype(np.float64)
    spacing = SPEED_OF_LIGHT / (2 * sent.sample_rate)
    shift = np.rint((ranges - ranges.min()) / spacing)
    if not (ranges.min() > 0 and shift.max() < width):
        raise ValueError(
            f"its lines begin at {ranges.min():g} to {ranges.max():g} m (bytes 117 to 120), and "
            f"are {spacing * width:.0f} m long"
        )
    lines = ByteLines(
        *(path, layout, kept.start, width + int(shift.max()), _bias(summary)),
        *(prefix, shift.astype(np.intp), _gain(prefix)),
    )
    neighbors = looked_through(lines)
    epoch, tags = _received(prefix)
    tags -= 2 * ranges / SPEED_OF_LIGHT
    place = places_by_number(prefix["number"].astype(np.float64), "line number (bytes 13 to 16)")
    place = places_by_tags(place, tags, 1 / sent.prf, _RESOLUTION, neighbors)
    since = tags - place / sent.prf
    first = (since.min() + since.max() + _RESOLUTION) / 2
    orbit = orbit_of(records[POSITIONS])
    return Recording(
        *(path, lines, place, lost_lines(neighbors, place)),
        line_time=first + np.arange(int(place[-1]) + 1) / sent.prf,
        first_line=int(prefix["number"][0]),
        near_range=float(ranges.min()),
        sent=sent,
        track=Track(epoch, orbit, _attitude(records, epoch, orbit)),
        time_sigma=TIME_SIGMA,
        slips=slips_among(neighbors, place),
        cure=_SLIPPED,
    )


# ------------------------------------------------------------------ the file of lines


def _layout(path: Path) -> tuple[np.dtype[np.void], int]:
    """Layout of the record of a line, and how many there are."""
    size = path.stat().st_size
    with path.open("rb") as file:
        record = Record(file.read(_DESCRIPTOR_LENGTH), "its descriptor")
        first = file.read(HEADER)
    if len(record.content) < _DESCRIPTOR_LENGTH or len(first) < HEADER:
        raise ValueError(f"it is {size} bytes long: truncated within its descriptor")
    _check_level(record)
    n = record.whole(181, 186, "the number of its lines", 1, _MOST_LINES)
    n_bytes = record.whole(281, 288, "the bytes of samples of a line", 4, 2 * _MOST_CELLS)
    if n_bytes % 2 or record.whole(225, 228, "the bytes of a sample", 1, 16) != 2:
        raise ValueError("its samples are not pairs of bytes (bytes 225 to 228, 281 to 288)")
    length = record.whole(187, 192, "the bytes of the record of a line", 1, 999_999)
    found = int.from_bytes(first[8:], "big")
    if found != length or length < _PREFIX + n_bytes:
        raise ValueError(
            f"its descriptor says that the record of a line has {length} bytes (187 to 192), "
            f"{n_bytes} of them samples, and its first line says {found}"
        )
    if size < _DESCRIPTOR_LENGTH + n * length:
        raise ValueError(
            f"it is truncated: its descriptor says {n} lines of {length} bytes (181 to 192), and "
            f"there are {(size - _DESCRIPTOR_LENGTH) // length}"
        )
    if n < 2:
        raise ValueError("it has one line")
    prefix: Any = {
        "names": list(_FIELDS),
        "formats": [kind for _, kind in _FIELDS.values()],
        "offsets": [at - 1 for at, _ in _FIELDS.values()],
        "itemsize": _PREFIX,
    }
    layout: Any = {
        "names": ["prefix", "samples"],
        "formats": [np.dtype(prefix), f"({n_bytes},)u1"],
        "offsets": [0, _PREFIX],
        "itemsize": length,
    }
    return np.dtype(layout), n


def _check_level(record: Record) -> None:
    code, samples = record.text(429, 432), record.text(401, 428)
    if code == "CI*1":
        return
    told = f"its samples are {samples or 'of a kind that it does not name'} ('{code}')"
    if "C*8" in code or "COMPLEX*8" in samples or "REAL" in samples:
        raise ValueError(f"CEOS, a file of lines\n  {told}: it is {IMAGE} (level 1.1)")
    if code.startswith("IU"):
        raise ValueError(f"CEOS, a file of lines\n  {told}: it is {IMAGE} (level 1.5)")
    raise ValueError(f"CEOS, a file of lines\n  {told}, not pairs of bytes ('CI*1') of level 1.0")


def _lines(path: Path, layout: np.dtype[np.void], n: int) -> NDArray[np.void]:
    return np.memmap(path, layout, "r", _DESCRIPTOR_LENGTH, (n,))


def _check_prefixes(prefix: NDArray[np.void], length: int, width: int) -> None:
    wrong = np.any(prefix["kind"] != np.array(_LINE, np.uint8), axis=1)
    wrong |= prefix["length"] != length
    if wrong.any():
        raise ValueError(
            f"its record {int(np.argmax(wrong)) + 2} is not that of a line of {length} bytes"
        )
    for name, what in _SAID.items():
        change = prefix[name] != prefix[name][0]
        if change.any():
            raise ValueError(
                f"{what} (bytes {_FIELDS[name][0]} on) is {prefix[name][0]}, and from line "
                f"{int(np.argmax(change)) + 1} on {prefix[name][np.argmax(change)]}\n"
                "  cut the file there, and read the parts one by one"
            )
    for name, what in (("scan", "scans (ScanSAR)"), ("compressed", "is compressed in range")):
        if prefix[name][0]:
            raise ValueError(f"it {what} (bytes {_FIELDS[name][0]} on), which is not read")
    filled = prefix["left"] + prefix["right"].astype(np.int64)
    wrong = (prefix["left"] < 0) | (prefix["right"] < 0) | (filled > width)
    if wrong.any():
        raise ValueError(
            f"line {int(np.argmax(wrong)) + 1} is said to be filled by {filled[np.argmax(wrong)]} "
            f"of its {width} cells (bytes 21 to 32)"
        )


def _received(prefix: NDArray[np.void]) -> tuple[np.datetime64, FloatArray]:
    """Day of the first line, and when each was received, from its start on [s]."""
    year, day, millisecond = (prefix[k].astype(np.int64) for k in ("year", "day", "millisecond"))
    for values, least, most, what in (
        (year, 1970, 2200, "the year (bytes 37 to 40)"),
        (day, 1, 366, "the day of the year (bytes 41 to 44)"),
        (millisecond, 0, 86_400_999, "the millisecond of the day (bytes 45 to 48)"),
    ):
        wrong = (values < least) | (values > most)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(f"line {k + 1} says {values[k]} for {what}")
    days = (year - 1970).astype("datetime64[Y]").astype("datetime64[D]") + (day - 1)
    since = (days - days[0]).astype(np.int64)
    return days[0].astype("datetime64[ns]"), since * _DAY + millisecond / 1e3


def _gain(prefix: NDArray[np.void]) -> Single | None:
    """Factors that undo a gain that varies [dB]."""
    gain = prefix["gain"].astype(np.float64)
    return None if np.ptp(gain) == 0 else gain_of(-gain, len(gain))


# ------------------------------------------------------------------ the leader


def _leader(path: Path) -> Path:
    """Leader of a file of lines."""
    name = path.name
    if name[:4].upper() != "IMG-" or name[6:7] != "-":
        raise ValueError(
            "its leader is not known, as it is not named IMG-HH-... (or HV, VH, VV)\n"
            "  let both files have the names that they came with"
        )
    leader = path.with_name(("LED" if name[0] == "I" else "led") + name[6:])
    if not leader.is_file():
        raise ValueError(f"its leader '{leader.name}' is not beside it")
    return leader


def _records(leader: Path) -> dict[Kind, Record]:
    try:
        found = read_records(leader, _NAMES)
    except ValueError as error:
        raise ValueError(f"of its leader '{leader.name}', {error}") from error
    for kind, name in _NAMES.items():
        if kind not in found:
            raise ValueError(f"its leader '{leader.name}' lacks {name.removeprefix('its ')}")
        if len(found[kind].content) < _SHORTEST[kind]:
            raise ValueError(f"{name} has {len(found[kind].content)} bytes")
    return found


def _sent(summary: Record, calibration: Record, prefix: NDArray[np.void]) -> Sent:
    wavelength = summary.number(501, 516, "the wavelength [m]")
    if not wavelength > 0:
        raise ValueError(f"{summary.what} says a wavelength of {wavelength:g} m (bytes 501 to 516)")
    channels = summary.whole(389, 392, "the number of channels", 1, 4)
    pulse_length = 1e-9 * float(prefix["chirp_length"][0])
    band = 1e6 * calibration.number(65, 68, "the bandwidth [MHz]")
    if not (pulse_length > 0 and band > 0):
        raise ValueError(
            f"its pulse is {pulse_length:g} s long (bytes 69 to 72 of a line) and sweeps "
            f"{band:g} Hz (bytes 65 to 68 of {calibration.what})"
        )
    sent = Sent(
        carrier=SPEED_OF_LIGHT / wavelength,
        # of four channels, pulses of two polarizations alternate
        prf=1e-3 * float(prefix["prf"][0]) / (2 if channels == 4 else 1),
        sample_rate=1e6 * summary.number(711, 726, "the sampling rate [MHz]"),
        chirp_rate=-band / pulse_length,
        pulse_length=pulse_length,
    )
    sent.radar(sent.prf)
    return sent


def _bias(summary: Record) -> tuple[float, float]:
    return (
        summary.number(819, 834, "the bias of what is in phase"),
        summary.number(835, 850, "the bias of the quadrature"),
    )


def _without_calibration(summary: Record, n: int) -> slice:
    """Lines that are echo: those of calibration lie at the ends."""
    if not summary.text(1767, 1770) or not summary.number(1767, 1770, "calibration"):
        return slice(0, n)
    stop = summary.whole(1779, 1786, "the last line of calibration at the top", 0, n)
    start = summary.whole(1787, 1794, "the first line of calibration at the bottom", 0, n)
    kept = slice(stop, start - 1 if start else n)
    if kept.stop - kept.start < 2:
        raise ValueError(f"{summary.what} leaves lines {stop + 1} to {kept.stop} to echo")
    return kept


def _attitude(
    records: dict[Kind, Record], epoch: np.datetime64, orbit: Ephemeris
) -> AntennaAttitude:
    """Attitude of the antenna, in the axes of NISAR's: y against the track, z the boresight."""
    record, summary = records[_ATTITUDE], records[_SUMMARY]
    most = (len(record.content) - 16) // _POINT
    n = record.whole(13, 16, "the number of its points", 1, max(most, 1))
    points = [_point(record, k) for k in range(n)]
    year = epoch.astype("datetime64[Y]").astype("datetime64[ns]")
    t = seconds(year - epoch) + np.array([p[0] for p in points])
    if (np.diff(t) <= 0).any():
        raise ValueError(f"the times of {record.what} do not increase")
    clock = summary.number(477, 484, "the clock angle [deg]")
    if abs(clock) != _RIGHT:
        raise ValueError(f"{summary.what} says a clock angle of {clock:g} deg, not across")
    look = np.copysign(np.radians(summary.number(1839, 1854, "the angle off nadir [deg]")), clock)
    since = t + seconds(epoch - orbit.tags[0])
    if not orbit.covers(since).all():
        raise ValueError(f"the times of {record.what} are not those of its orbit")
    r, v = orbit.at(since)
    angles = np.radians([p[1] for p in points])
    body = _body_axes(r, v, angles)
    across = np.array([0.0, np.cos(look), -np.sin(look)])
    boresight = np.array([0.0, np.sin(look), np.cos(look)])
    antenna = np.stack([across, np.array([-1.0, 0.0, 0.0]), boresight])
    return AntennaAttitude(t, from_matrix_array(antenna @ body))


def _point(record: Record, k: int) -> tuple[float, tuple[float, float, float]]:
    """Second of the year, and roll, pitch and yaw [deg]."""
    at = 17 + _POINT * k
    day = record.whole(at, at + 3, f"the day of point {k + 1}", 1, 366)
    since = record.number(at + 4, at + 11, f"the millisecond of point {k + 1}")
    pitch, roll, yaw = (
        record.number(first, first + 13, f"an angle of point {k + 1}")
        for first in (at + 24, at + 38, at + 52)
    )
    return (day - 1) * _DAY + 1e-3 * since, (roll, pitch, yaw)


def _body_axes(r: FloatArray, v: FloatArray, angles: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3), Earth-fixed to body, of angles (n, 3) of roll, pitch, yaw [rad]."""
    down = -r / np.linalg.norm(r, axis=1)[:, None]
    right = np.cross(down, v + np.cross([0.0, 0.0, EARTH.rotation_rate], r))
    right /= np.linalg.norm(right, axis=1)[:, None]
    level = np.stack([np.cross(right, down), right, down], axis=1)
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    turned = np.array(
        [
            [cy * cp, sy * cp, -sp],
            [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr],
            [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr],
        ]
    )
    return np.asarray(np.einsum("ijn,njk->nik", turned, level), np.float64)
