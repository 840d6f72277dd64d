r"""Recorded raw echo in the HDF5 of NISAR's level 0B (RRSD), which other radars' echo is put into.

A channel, ``A/HH`` say, is what was sent at one frequency in one polarization and received in
another. Its samples are pairs of 16-bit codes, which ``BFPQLUT`` (65536,) turns into numbers (the
quantizer of blocks in floating point). A line whose codes are all one was lost. Slant ranges are
half the delay of a sample times the speed of light; the carrier, the sweep of the chirp and its
length are as sent, and the rates of sampling and of pulses follow from the spacing of ranges and
of times.

The track is that of the file: state vectors, Earth-fixed, between which
`terrafix.models.motion.ephemeris` interpolates, and quaternions, scalar first, that turn
components along the antenna's axes into Earth-fixed ones, z being the boresight.

References
----------
.. [1] NASA JPL, "NISAR L0B product specification", D-102268.
.. [2] Caltech, "ISCE3", nisar.products.readers.Raw (what each of the data sets means).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.core.formats import HDF5
from terrafix.models.core.hdf5 import epoch_of, has_group, opened, values_of
from terrafix.models.geometry.quaternion import from_scalar_first
from terrafix.models.motion.orbits.hdf5 import orbit_of
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, gain_of
from terrafix.models.radar.recordings.lines import (
    on_grid,
    places_by_number,
    places_by_time,
    slips_among,
)
from terrafix.models.radar.recordings.recording import (
    FORMATS,
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

BANDS = ("LSAR", "SSAR")
_SLIPPED = "its 'UTCtime' does not say so: have the times corrected by whoever made the file"
_TOLD = 6
"""Names of what a file of another kind holds that are told."""
_N_CODES = 65536
_MOST_COMPRESSED = 300
"""Samples of echo in a byte at most: zlib makes a thousandth of zeros, four bytes each."""
_EVEN = 1e-4
"""How far ranges may be from even spacing, in cells."""
_UNIT = 1e-3
"""How far the length of a quaternion may be from one."""


class CodeLines:
    """Lines of one channel of a file, read when they are wanted.

    Parameters
    ----------
    path : Path
    name : str
        Of the data set.
    shape : tuple of int
    table : ndarray of float32, shape (65536,), optional
        What each code stands for; None where samples are numbers.
    valid : sequence of ndarray of int, each (n_lines, 2)
        First sample and that after the last of each part of the lines that holds echo.
    gain : ndarray of float32, shape (n_lines,), optional
    """

    def __init__(
        self,
        path: Path,
        name: str,
        shape: tuple[int, int],
        table: Single | None,
        valid: list[NDArray[np.int64]],
        gain: Single | None,
    ) -> None:
        self.shape = shape
        self._path, self._name, self._table = path, name, table
        self._valid, self._gain = valid, gain

    def read(self, first: int, last: int) -> ComplexArray:
        """Lines `first` to `last - 1`."""
        with opened(self._path) as file:
            raw = file[self._name][first:last]
        parts = (raw["r"], raw["i"])
        lost = np.all([np.all(p == p[:, :1], axis=1) for p in parts], axis=0)
        echo: ComplexArray = np.empty(raw.shape, np.complex64)
        echo.real, echo.imag = parts if self._table is None else (self._table[p] for p in parts)
        echo[lost] = 0
        if self._valid:
            cell = np.arange(self.shape[1])
            spans = [v[first:last, :, None] for v in self._valid]
            echo[~np.any([(cell >= v[:, 0]) & (cell < v[:, 1]) for v in spans], axis=0)] = 0
        return echo if self._gain is None else echo * self._gain[first:last, None]


def read_l0b(path: Path, channel: str = "") -> Recording:
    """Read one channel of recorded echo (NISAR L0B, HDF5).

    Parameters
    ----------
    path : Path
    channel : str
        ``"A/HH"``, say; need not be named where there is one.

    Raises
    ------
    ValueError
        If it is damaged, no such file, lacks a part or has one that cannot be, has no such channel
        or several and none is named, or more than `lines.MOST_LOST` of its lines are missing.
    """
    try:
        with opened(path) as file:
            return _recording(path, file, channel)
    except (ValueError, RuntimeError, OSError) as error:
        reason = str(error) if isinstance(error, ValueError) else f"it is damaged ({error})"
        raise ValueError(f"'{path}' is not {WHAT}: {reason}") from error


def l0b_track(path: Path) -> Track:
    """Track of a file (NISAR L0B, HDF5).

    Raises
    ------
    ValueError
        If it is of another kind, or a part cannot be.
    """
    with opened(path) as file:
        root = _root(file)
        times = f"{root}/lowRateTelemetry/orbit"
        if not has_group(file, times):
            raise ValueError("it has no orbit")
        return _track(file[root], epoch_of(file[times]["time"]))


def _root(file: Any) -> str:
    band = next((b for b in BANDS if has_group(file, f"science/{b}/RRSD/swaths")), None)
    if band is None:
        raise ValueError(_another(file))
    return f"science/{band}/RRSD"


def _recording(path: Path, file: Any, channel: str) -> Recording:
    root = _root(file)
    name = _chosen(channels(file[f"{root}/swaths"]), channel)
    sent_group, samples = name.rpartition("/rx")[0], f"{root}/swaths/{name}"
    tx = file[f"{root}/swaths/{sent_group}"]
    n, n_cells = shape = _shape(file[samples])
    if n * n_cells > _MOST_COMPRESSED * path.stat().st_size:
        raise ValueError(
            f"it says {n} lines of {n_cells} cells, and has {path.stat().st_size} bytes"
        )
    times = values_of(tx, "UTCtime", (n,))
    epoch = epoch_of(tx["UTCtime"])
    place = places_by_time(times, "UTCtime")
    first_line = 1
    if "rangeLineIndex" in tx.variables:
        numbers = values_of(tx, "rangeLineIndex", (n,))
        first_line = int(numbers[0])
        if not np.array_equal(place, places_by_number(numbers, "rangeLineIndex")):
            raise ValueError("'UTCtime' and 'rangeLineIndex' do not agree where lines were lost")
    ranges = values_of(tx, "slantRange", (n_cells,))
    line_time = on_grid(times, place)
    sent = Sent(
        carrier=_number(tx, "centerFrequency"),
        prf=float((len(line_time) - 1) / (line_time[-1] - line_time[0])),
        sample_rate=SPEED_OF_LIGHT / (2 * _spacing(ranges)),
        chirp_rate=_number(tx, "chirpSlope"),
        pulse_length=_number(tx, "chirpDuration"),
    )
    sent.radar(sent.prf)
    rx = file[samples.rpartition("/")[0]]
    lines = CodeLines(
        *(path, samples, shape, _table(rx, file[samples]), _valid(tx, n), _gain(rx, n))
    )
    neighbors = looked_through(lines)
    return Recording(
        *(path, lines, place, lost_lines(neighbors, place), line_time, first_line),
        near_range=float(ranges[0]),
        sent=sent,
        track=_track(file[root], epoch),
        slips=slips_among(neighbors, place),
        cure=_SLIPPED,
    )


def channels(swaths: Any) -> dict[str, str]:
    """Channels of a group of swaths: name, and data set within the group."""
    found = {}
    for frequency, group in swaths.groups.items():
        for tx, sent in group.groups.items():
            for rx, received in sent.groups.items():
                data = f"{tx.removeprefix('tx')}{rx.removeprefix('rx')}"
                if data in received.variables:
                    name = f"{frequency.removeprefix('frequency')}/{data}"
                    found[name] = f"{frequency}/{tx}/{rx}/{data}"
    return found


def _chosen(found: dict[str, str], channel: str) -> str:
    if channel in found:
        return found[channel]
    told = ", ".join(found) or "none"
    if channel:
        raise ValueError(f"it has no channel '{channel}'; it has {told}")
    if len(found) != 1:
        raise ValueError(f"it has several channels: {told}\n  name one" if found else "it is empty")
    return next(iter(found.values()))


def _another(file: Any) -> str:
    """What a file is that is no level 0B."""
    products = [
        name
        for band in BANDS
        if has_group(file, f"science/{band}")
        for name in file[f"science/{band}"].groups
        if name != "identification"
    ]
    held = ", ".join([*file.groups, *file.variables][:_TOLD]) or "nothing"
    told = f"a NISAR product '{products[0]}': {IMAGE}" if products else f"it holds {held}"
    cure = "if it holds raw echo, read it with h5py or xarray, and write its arrays with"
    return f"it is {HDF5}\n  {told}\n  {FORMATS}\n  {cure} numpy.savez"


def _shape(data: Any) -> tuple[int, int]:
    if len(data.shape) != 2 or min(data.shape) < 2:
        raise ValueError(f"its echo has shape {data.shape}, not lines and cells")
    if data.dtype.names != ("r", "i"):
        raise ValueError("its samples are not pairs 'r', 'i' of a type that is read")
    return int(data.shape[0]), int(data.shape[1])


def _number(group: Any, name: str) -> float:
    return float(values_of(group, name, ()))


def _spacing(ranges: FloatArray) -> float:
    spacing = float(ranges[-1] - ranges[0]) / (len(ranges) - 1)
    off = ranges - (ranges[0] + spacing * np.arange(len(ranges)))
    if not (ranges[0] > 0 and spacing > 0 and np.abs(off).max() <= _EVEN * spacing):
        raise ValueError("'slantRange' does not rise evenly from a range above zero")
    return spacing


def _table(rx: Any, data: Any) -> Single | None:
    kinds = {data.dtype[k].kind for k in ("r", "i")}
    if kinds == {"f"}:
        return None
    if any(data.dtype[k] != np.uint16 for k in ("r", "i")):
        raise ValueError(f"its samples are {data.dtype}, not codes of 16 bits or floats")
    return values_of(rx, "BFPQLUT", (_N_CODES,)).astype(np.float32)


def _valid(tx: Any, n: int) -> list[NDArray[np.int64]]:
    names = sorted(k for k in tx.variables if re.fullmatch(r"validSamplesSubSwath\d+", k))
    return [values_of(tx, k, (n, 2)).astype(np.int64) for k in names]


def _gain(rx: Any, n: int) -> Single | None:
    """Factors that undo an attenuation that varies, in dB."""
    if "attenuation" not in rx.variables:
        return None
    attenuation = values_of(rx, "attenuation", (n, -1))
    if np.ptp(attenuation, axis=0).max() == 0:
        return None
    units = str(getattr(rx["attenuation"], "units", ""))
    if not units.lower().startswith("db") or np.ptp(attenuation, axis=1).max() > 0:
        raise ValueError(
            "its attenuation varies, and is not told in dB alike for all receivers\n"
            "  have it undone by whoever made the file"
        )
    return gain_of(attenuation[:, 0], n)


def _track(root: Any, epoch: np.datetime64) -> Track:
    low = root.groups.get("lowRateTelemetry")
    groups = {} if low is None else low.groups
    orbit, attitude = groups.get("orbit"), groups.get("attitude")
    return Track(
        epoch,
        None if orbit is None else orbit_of(orbit),
        None if attitude is None else _attitude(attitude, epoch),
    )


def _attitude(group: Any, epoch: np.datetime64) -> AntennaAttitude:
    t = values_of(group, "time", (-1,))
    q = values_of(group, "quaternions", (len(t), 4))
    if (np.diff(t) <= 0).any() or np.abs(np.linalg.norm(q, axis=1) - 1).max() > _UNIT:
        raise ValueError("its attitude is no unit quaternions at times that increase")
    return AntennaAttitude(t + seconds(epoch_of(group["time"]) - epoch), from_scalar_first(q))
