r"""Ephemerides: states of a satellite at epochs, and the state between them.

Seconds are counted in atomic time (TAI): between two UTC tags lies one more where a leap second
was inserted.

Between two epochs position is the polynomial of degree seven, order eight, that takes the
neighborhood's positions: those of eight epochs, or, where velocities are known, positions and
velocities of four (Hermite). Velocity is its derivative. For circular motion of radius :math:`r`
and rate :math:`n` the error of position in the middle of an interval :math:`h`, away from the
ends, is

.. math::
    \frac{9}{16} \frac{9}{16} \frac{r (n h)^8}{8!} \;\text{(Hermite)}, \qquad
    \left(\frac{105}{16}\right)^2 \frac{r (n h)^8}{8!} \;\text{(positions alone)}.

`Ephemeris.error` estimates it for the states that are there. Nothing is interpolated across a gap,
an interval several times longer than those about it, nor between two parts of a file.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.formats import kind_of
from terrafix.models.core.timescales import Instant
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.epochs import atomic

MAX_BYTES = 64 * 1024 * 1024
"""Largest orbit file read; a day of state vectors every 10 s takes 5 MB."""
GAP = 2.5
"""An interval is a gap that is longer than this times the median of those about it."""

_FIELDS = {"X": "m", "Y": "m", "Z": "m", "VX": "m/s", "VY": "m/s", "VZ": "m/s"}
_LEAP = ":60"
"""How the tag of a leap second ends, before its fraction."""
_NEIGHBORS = 4
"""Intervals on each side that one is compared with."""
_ORDER = 8


@dataclass(frozen=True)
class Ephemeris:
    """Earth-fixed states of a satellite at increasing epochs.

    Parameters
    ----------
    tags : ndarray of datetime64[ns], shape (n_epochs,)
        Epochs as they are tagged; within a leap second, the tag of the second after it.
    t : ndarray, shape (n_epochs,)
        Epochs in seconds since the first.
    r_e : ndarray, shape (n_epochs, 3)
        Position [m], Earth-fixed.
    v_e : ndarray, shape (n_epochs, 3), optional
        Velocity relative to the rotating Earth [m/s], Earth-fixed.
    scale : str
        Time scale of the tags: "UTC", "GPS", "TAI" or "TT".
    first : Instant, optional
        The first epoch, where it is known without a table of leap seconds.
    ends : sequence of int
        Numbers of the states with which parts of a file end: what follows is not joined. The next
        part may begin at the same epoch, from which on it holds.

    Raises
    ------
    ValueError
        If the shapes disagree, there are fewer than two epochs, they do not increase, or a state is
        not finite.
    """

    tags: NDArray[np.datetime64]
    t: FloatArray
    r_e: FloatArray
    v_e: FloatArray | None = None
    scale: str = "UTC"
    first: Instant | None = None
    ends: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.t)
        speeds = np.zeros((n, 3)) if self.v_e is None else self.v_e
        shapes = (self.tags.shape, self.t.shape, self.r_e.shape, speeds.shape)
        if shapes != ((n,), (n,), (n, 3), (n, 3)):
            raise ValueError(
                f"an ephemeris wants shapes (n,), (n,), (n, 3) and (n, 3), got {shapes}"
            )
        if n < 2:
            raise ValueError(f"an ephemeris wants two epochs at least, got {n}")
        later = np.diff(self.t) > 0
        touching = [k for k in self.ends if k < n - 1 and self.t[k + 1] == self.t[k]]
        later[touching] = True
        if not later.all():
            k = int(np.argmin(later))
            if self.t[k + 1] == self.t[k]:
                raise ValueError(f"the epochs number {k} and {k + 1} are the same: {self.tags[k]}")
            raise ValueError(f"the epochs do not increase from number {k} to {k + 1}")
        for name, states in (("position", self.r_e), ("velocity", speeds)):
            bad = ~np.isfinite(states).all(axis=1)
            if bad.any():
                raise ValueError(f"the {name} at epoch {int(np.argmax(bad))} is not finite")

    # ------------------------------------------------------------------ what is covered

    @cached_property
    def _torn(self) -> NDArray[np.bool_]:
        """Which intervals are not interpolated, (n - 1,)."""
        h = np.diff(self.t)
        padded = np.pad(h, _NEIGHBORS, constant_values=np.nan)
        about = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBORS + 1)
        torn = np.asarray(h > GAP * np.nanmedian(about, axis=1))
        torn[[k for k in self.ends if k < len(torn)]] = True
        return torn

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which intervals between epochs are interpolated, (n_epochs - 1,)."""
        return ~self._torn

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Begin and end [s] of each interval of which nothing is known."""
        torn = self._torn & (np.diff(self.t) > 0)
        return [(float(self.t[k]), float(self.t[k + 1])) for k in np.flatnonzero(torn)]

    def gap_within(self, first: float, last: float) -> tuple[float, float] | None:
        """The first gap that a span of time [s] meets."""
        return next((gap for gap in self.gaps if gap[0] < last and gap[1] > first), None)

    def covers(self, t: ArrayLike) -> NDArray[np.bool_]:
        """Whether states are known at times [s], (...)."""
        t = np.asarray(t, np.float64)
        inside = (t >= self.t[0]) & (t <= self.t[-1])
        return np.asarray(inside & ~self._torn[self._interval(np.where(inside, t, self.t[0]))])

    def tag(self, t: float) -> str:
        """A time [s] as the file would tag it, to the millisecond."""
        k = int(np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 1))
        tagged = self.tags[k] + np.timedelta64(round((t - self.t[k]) * 1e3), "ms")
        return f"{tagged.astype('datetime64[ms]')} {self.scale}"

    def instant0(self) -> Instant:
        """The first epoch.

        Raises
        ------
        ImportError
            If it is tagged in UTC alone, and the table of leap seconds is not installed.
        """
        if self.first is not None:
            return self.first
        found = atomic(self.tags[:1], np.zeros(1, np.bool_), self.scale)
        return Instant(int(found.day[0]), float(found.seconds[0]))

    def since_first(self, instant: Instant) -> float:
        """Seconds from the first epoch to an instant."""
        return float(instant.minus(self.instant0()))

    # ------------------------------------------------------------------ interpolation

    def at(self, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Interpolate position [m] and velocity [m/s], two (..., 3), at times (...).

        Parameters
        ----------
        t : array_like
            Seconds since the first epoch.

        Raises
        ------
        ValueError
            If a time is outside the epochs, in a gap between them, or not a number.
        """
        t = np.asarray(t, dtype=np.float64)
        outside = ~((t >= self.t[0]) & (t <= self.t[-1]))
        if outside.any():
            first = t[outside].flat[0]
            raise ValueError(
                f"cannot extrapolate to {first} s: the ephemeris covers {self.t[0]} s to "
                f"{self.t[-1]} s after {self.tags[0]} {self.scale}"
            )
        k = self._interval(t)
        if self._torn[k].any():
            lost = np.atleast_1d(k)[np.atleast_1d(self._torn[k])][0]
            raise ValueError(
                f"no states are known between {self.t[lost]} s and {self.t[lost + 1]} s after "
                f"{self.tags[0]} {self.scale}"
            )
        return self._evaluated(self._polynomials, k, t)

    def _interval(self, t: FloatArray) -> NDArray[np.intp]:
        """Interval of each time; where one begins that is not known, the one that ends there."""
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        return np.asarray(k - (self._torn[k] & (t == self.t[k]) & (k > 0)))

    def _evaluated(
        self, polynomials: tuple[FloatArray, FloatArray], k: NDArray[np.intp], t: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        coefficients, width = polynomials
        degree = np.arange(1.0, coefficients.shape[1] + 1)
        s = ((t - self.t[k]) / width[k])[..., None]
        powers = s ** (degree - 1)
        c = coefficients[k]
        # what is added to the state before it is small: its last bits are kept
        r = self.r_e[k] + np.einsum("...p,...pi->...i", powers * s, c)
        return r, np.einsum("...p,...pi->...i", powers * degree, c) / width[k][..., None]

    @cached_property
    def _polynomials(self) -> tuple[FloatArray, FloatArray]:
        return self._fitted(_ORDER)

    @cached_property
    def _errors(self) -> FloatArray:
        """Estimated error of positions in the middle of each interval [m]; zero where torn."""
        k = np.flatnonzero(self.known)
        middle = (self.t[k] + self.t[k + 1]) / 2
        first, last = self._parts
        few = (last - first + 1)[k].min(initial=len(self.t)) < self._nodes(_ORDER + 2)
        other = self._fitted(_ORDER - 2 if few else _ORDER + 2)
        one, two = (self._evaluated(p, k, middle)[0] for p in (self._polynomials, other))
        errors = np.zeros(len(self.t) - 1)
        errors[k] = np.linalg.norm(one - two, axis=1)
        return errors

    def error(self, first: float = -np.inf, last: float = np.inf) -> float:
        """Largest error of interpolated positions in a span of time [m], estimated.

        The difference to two orders up in the middle of each interval. What the states themselves
        err by from one to the next counts, too; where they are too few for that order, it is the
        difference to two orders down, an upper bound.
        """
        within = (self.t[:-1] < last) & (self.t[1:] > first)
        return float(self._errors[within].max(initial=0.0))

    @cached_property
    def _parts(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First and last state of the part that each interval lies in."""
        borders = np.flatnonzero(self._torn)
        first = np.concatenate([[0], borders + 1])
        last = np.concatenate([borders, [len(self.t) - 1]])
        part = np.searchsorted(borders, np.arange(len(self.t) - 1))
        return first[part], last[part]

    def _nodes(self, order: int) -> int:
        return order if self.v_e is None else order // 2

    def _fitted(self, order: int) -> tuple[FloatArray, FloatArray]:
        """Polynomials of an order through the states about each interval.

        Returns
        -------
        coefficients : ndarray, shape (n - 1, order - 1, 3)
            Of the powers from the first on of the time since the state before, in widths [m].
        width : ndarray, shape (n - 1,)
            [s]
        """
        first, last = self._parts
        known = np.minimum(self._nodes(order), last - first + 1)
        coefficients = np.zeros((len(known), order - 1, 3))
        width = np.ones(len(known))
        for m in np.unique(known[~self._torn]):
            k = np.flatnonzero((known == m) & ~self._torn)
            start = np.clip(k - (m - 2) // 2, first[k], last[k] - m + 1)
            solved, width[k] = self._through(k, start[:, None] + np.arange(m))
            coefficients[k, : solved.shape[1]] = solved
        return coefficients, width

    def _through(
        self, k: NDArray[np.intp], window: NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:
        """Polynomials through the states (n, m) of a window about intervals (n,)."""
        m = window.shape[1]
        since = self.t[window] - self.t[k][:, None]
        width = np.abs(since).max(axis=1)
        others = since != 0.0
        x, alike = np.unique(since / width[:, None], axis=0, return_inverse=True)
        degree = np.arange(1.0, (m if self.v_e is None else 2 * m))
        rows = (x[..., None] ** degree)[x != 0.0].reshape(len(x), m - 1, -1)
        known = (self.r_e[window] - self.r_e[k][:, None])[others].reshape(len(k), m - 1, 3)
        if self.v_e is not None:
            rows = np.concatenate([rows, degree * x[..., None] ** (degree - 1)], axis=1)
            known = np.concatenate([known, self.v_e[window] * width[:, None, None]], axis=1)
        return np.linalg.inv(rows)[alike.ravel()] @ known, width


def read_eof(path: str | Path) -> Ephemeris:
    """Read a Sentinel-1 restituted or precise orbit file.

    Raises
    ------
    ValueError
        If the file is not such a file, or is truncated or damaged; the message names the file and
        what is missing.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: larger than {MAX_BYTES} bytes, which no orbit file is")
    content = path.read_bytes()
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise ValueError(f"{path}: declares a document type, which no orbit file does")
    try:
        root = ET.fromstring(content)
    except ET.ParseError as error:
        found, cure = kind_of(path)
        if found not in ("", "empty", "text", "XML"):
            raise ValueError(f"{path}: it is {found}, no orbit file (.EOF)\n  {cure}") from error
        raise ValueError(f"{path}: damaged or truncated orbit file: {error}") from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # files differ in their namespace
    _expect(path, root, "Ref_Frame", "EARTH_FIXED")
    _expect(path, root, "Time_Reference", "UTC")
    block = root.find(".//List_of_OSVs")
    if block is None:
        raise ValueError(f"{path}: has no List_of_OSVs")
    vectors = block.findall("OSV")
    declared = block.get("count", "")
    if declared != str(len(vectors)):
        raise ValueError(
            f"{path}: holds {len(vectors)} state vectors but declares {declared or 'no count'}"
        )
    utc = _epochs(path, vectors, "UTC")
    tagged = [osv.find("TAI") is not None for osv in vectors]
    if any(tagged):
        t = _seconds(_epochs(path, vectors, "TAI"))
        leaps = t - _seconds(utc)
        if np.any(leaps != np.round(leaps)) or np.any(np.diff(leaps) < 0):
            k = int(np.argmax((leaps != np.round(leaps)) | (np.diff(leaps, prepend=0.0) < 0)))
            raise ValueError(
                f"{path}: TAI and UTC of state vector {k} do not differ as those of the first, by "
                "whole seconds"
            )
    else:
        t = _seconds(utc)
        _refuse_leap_seconds(path, utc)
    states = np.array([_state(path, i, osv) for i, osv in enumerate(vectors)], np.float64)
    states = states.reshape(-1, 6)
    distance = np.linalg.norm(states[:, :3], axis=1)
    if np.any(distance < EARTH.polar_radius):
        k = int(np.argmin(distance))
        raise ValueError(
            f"{path}: state vector {k} lies inside the Earth, {distance[k]:.6g} m from its center; "
            "positions are in meters"
        )
    try:
        first = _first(path, vectors) if any(tagged) else None
        return Ephemeris(utc, t, states[:, :3].copy(), states[:, 3:].copy(), first=first)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _expect(path: Path, root: ET.Element, tag: str, value: str) -> None:
    found = root.findtext(f".//{tag}")
    if found is None:
        raise ValueError(f"{path}: has no {tag}; is it an orbit file (.EOF)?")
    if found.strip() != value:
        raise ValueError(f"{path}: {tag} is '{found.strip()}', only '{value}' is read")


def _text(path: Path, index: int, osv: ET.Element, tag: str) -> str:
    text = osv.findtext(tag)
    if text is None or not text.strip():
        raise ValueError(f"{path}: state vector {index} has no {tag}")
    return text.strip()


def _first(path: Path, vectors: list[ET.Element]) -> Instant:
    found = atomic(_epochs(path, vectors[:1], "TAI"), np.zeros(1, np.bool_), "TAI")
    return Instant(int(found.day[0]), float(found.seconds[0]))


def _seconds(epochs: NDArray[np.datetime64]) -> FloatArray:
    return np.asarray((epochs - epochs[:1]).astype(np.int64) / 1e9)


def _refuse_leap_seconds(path: Path, utc: NDArray[np.datetime64]) -> None:
    """Raise ValueError where UTC tags span the end of a half-year, when leap seconds come."""
    for day in np.unique(utc.astype("datetime64[D]"))[1:]:
        if str(day)[5:] in ("01-01", "07-01"):
            raise ValueError(
                f"{path}: spans the start of {day}, where a leap second may lie, and has no TAI\n"
                "  give every state its TAI, as orbit files do"
            )


def _epochs(path: Path, vectors: list[ET.Element], scale: str) -> NDArray[np.datetime64]:
    """Tags of all states in a time scale, "UTC" or "TAI"."""
    epochs = [_epoch(path, i, osv, scale) for i, osv in enumerate(vectors)]
    return np.array(epochs, "datetime64[ns]")


def _epoch(path: Path, index: int, osv: ET.Element, scale: str) -> np.datetime64:
    text = _text(path, index, osv, scale)
    written, whole = text.removeprefix(f"{scale}="), np.timedelta64(0, "s")
    if scale == "UTC" and written[16:19] == _LEAP:
        written, whole = f"{written[:16]}:59{written[19:]}", np.timedelta64(1, "s")
    try:
        epoch = np.datetime64(written, "ns") + whole
    except ValueError as error:
        raise ValueError(f"{path}: state vector {index} has the epoch '{text}'") from error
    if np.isnat(epoch):
        raise ValueError(f"{path}: state vector {index} has the epoch '{text}'")
    return epoch


def _state(path: Path, index: int, osv: ET.Element) -> list[float]:
    values = []
    for tag, unit in _FIELDS.items():
        text = _text(path, index, osv, tag)
        found = osv.find(tag)
        given = unit if found is None else found.get("unit", unit)
        if given != unit:
            raise ValueError(f"{path}: state vector {index} has {tag} in '{given}', not '{unit}'")
        try:
            values.append(float(text))
        except ValueError as error:
            raise ValueError(
                f"{path}: state vector {index} has '{text}' for {tag}, not a number"
            ) from error
    return values
