"""Recorded orbits: Sentinel-1 orbit files (.EOF), and the state between their epochs.

Seconds are counted in atomic time (TAI), which every state of such a file is tagged with: between
two UTC tags lies one more where a leap second was inserted.

Position between two epochs is the cubic that takes position and velocity at both (Hermite); the
velocity is its derivative. The error of position grows with the fourth power of the spacing: at
the 10 s of an orbit file it is a fraction of a millimeter in a low Earth orbit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.formats import kind_of
from terrafix.models.geometry.earth import EARTH

MAX_BYTES = 64 * 1024 * 1024
"""Largest orbit file read; a day of state vectors every 10 s takes 5 MB."""

_FIELDS = {"X": "m", "Y": "m", "Z": "m", "VX": "m/s", "VY": "m/s", "VZ": "m/s"}
_LEAP = ":60"
"""How the tag of a leap second ends, before its fraction."""


@dataclass(frozen=True)
class Ephemeris:
    """Earth-fixed states of a satellite at increasing epochs.

    Parameters
    ----------
    utc : ndarray of datetime64[ns], shape (n_epochs,)
        Epochs, UTC; within a leap second, the tag of the second after it.
    t : ndarray, shape (n_epochs,)
        Epochs in seconds since the first.
    r_e : ndarray, shape (n_epochs, 3)
        Position [m], Earth-fixed.
    v_e : ndarray, shape (n_epochs, 3)
        Velocity relative to the rotating Earth [m/s], Earth-fixed.

    Raises
    ------
    ValueError
        If the shapes disagree, there are fewer than two epochs, they do not increase, or a state is
        not finite.
    """

    utc: NDArray[np.datetime64]
    t: FloatArray
    r_e: FloatArray
    v_e: FloatArray

    def __post_init__(self) -> None:
        n = len(self.t)
        shapes = (self.utc.shape, self.t.shape, self.r_e.shape, self.v_e.shape)
        if shapes != ((n,), (n,), (n, 3), (n, 3)):
            raise ValueError(
                f"an ephemeris wants shapes (n,), (n,), (n, 3) and (n, 3), got {shapes}"
            )
        if n < 2:
            raise ValueError(f"an ephemeris wants two epochs at least, got {n}")
        if not np.all(np.diff(self.t) > 0):
            k = int(np.argmin(np.diff(self.t) > 0))
            raise ValueError(f"the epochs do not increase from number {k} to {k + 1}")
        for name, states in (("position", self.r_e), ("velocity", self.v_e)):
            bad = ~np.isfinite(states).all(axis=1)
            if bad.any():
                raise ValueError(f"the {name} at epoch {int(np.argmax(bad))} is not finite")

    def at(self, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Interpolate position [m] and velocity [m/s], two (..., 3), at times (...).

        Parameters
        ----------
        t : array_like
            Seconds since the first epoch.

        Raises
        ------
        ValueError
            If a time is outside the epochs, or not a number.
        """
        t = np.asarray(t, dtype=np.float64)
        outside = ~((t >= self.t[0]) & (t <= self.t[-1]))
        if outside.any():
            first = t[outside].flat[0]
            raise ValueError(
                f"cannot extrapolate to {first} s: the ephemeris covers {self.t[0]} s to "
                f"{self.t[-1]} s after {self.utc[0]} UTC"
            )
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        h = (self.t[k + 1] - self.t[k])[..., None]
        s = (t - self.t[k])[..., None] / h
        r0, r1, v0, v1 = self.r_e[k], self.r_e[k + 1], self.v_e[k], self.v_e[k + 1]
        chord = (r1 - r0) / h
        # r = r0 + h s (v0 + s (c2 + s c3)): small terms added to r0 keep its last bits
        c2, c3 = 3 * chord - 2 * v0 - v1, v0 + v1 - 2 * chord
        r = r0 + h * s * (v0 + s * (c2 + s * c3))
        return r, v0 + s * (2 * c2 + 3 * s * c3)


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
    atomic = [osv.find("TAI") is not None for osv in vectors]
    if any(atomic):
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
        return Ephemeris(utc, t, states[:, :3].copy(), states[:, 3:].copy())
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
