r"""Phase history in CPHD, the standard of NGA, read by sarkit.

Each vector holds, at frequencies :math:`f` in equal steps, the phase

.. math:: 2\pi\,\mathrm{SGN}\, f\, (\mathrm{TOA} - \mathrm{TOA}_{SRP}),

of a scatterer whose echo comes in :math:`\mathrm{TOA} - \mathrm{TOA}_{SRP}` later than that of the
stabilization reference point. The antenna is taken to be in the middle between where it sent and
where it received, from which ranges differ by half the delay to a fraction of a millimeter.

References
----------
.. [1] NGA.STND.0068-1, "Compensated Phase History Data (CPHD), Design and Implementation
       Description", version 1.1.0, 2021.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray
from terrafix.models.core.extras import optional
from terrafix.models.geometry.geodesy import local_axes
from terrafix.models.radar.phase_history import PhaseHistory

_EVEN = 1e-3
"""How far the frequencies of vectors may be from those of the first, in steps."""
_TAPS = 8
"""Samples on either side that one at another frequency is made of."""
_APART = 1e-3
"""How far apart antennas that send and receive may be, relative to the range."""
_PLACES = ("TxPos", "RcvPos", "SRPPos")
_NUMBERS = ("TxTime", "RcvTime", "FX1", "FX2", "SC0", "SCSS")


def read_cphd(path: Path, channel: str = "") -> PhaseHistory:
    """Read a channel of phase history (CPHD, FX domain).

    Vectors whose frequencies differ are resampled to those of the first. Places are east, north and
    up of the image area's reference point (IARP), the ground being level there.

    Parameters
    ----------
    path : Path
    channel : str
        Its identifier; need not be named where there is one.

    Raises
    ------
    ImportError
        If sarkit is not installed.
    ValueError
        If the file is damaged, has no such channel or several and none is named, is of the TOA
        domain, compressed or bistatic, or its vectors have no band in common.
    """
    cphd = optional("sarkit.cphd", "phase history in CPHD", "sar")
    try:
        with path.open("rb") as file, cphd.Reader(file) as reader:
            return _history(path, reader, channel)
    except Exception as error:  # what damages make of its XML, its header and its numbers
        if isinstance(error, MemoryError | ImportError):
            raise
        reason = str(error) if isinstance(error, ValueError) else f"it is damaged ({error!r})"
        raise ValueError(f"'{path}' is no phase history that is read: {reason}") from error


def _history(path: Path, reader: Any, channel: str) -> PhaseHistory:
    tree = reader.metadata.xmltree
    _check_kind(tree)
    name = _chosen([e.text for e in tree.findall("{*}Data/{*}Channel/{*}Identifier")], channel)
    n, k = _size(path, tree, name)
    vectors = reader.read_pvps(name)
    numbers = {key: _values(vectors, key, (n,)) for key in _NUMBERS}
    sent, received, srp = (_values(vectors, key, (n, 3)) for key in _PLACES)
    first, steps, frequency = numbers["SC0"], numbers["SCSS"], _common_band(numbers, k)
    phase = _at(_complex(reader.read_signal(name)), first, steps, frequency)
    if "AmpSF" in vectors.dtype.names:
        phase *= _values(vectors, "AmpSF", (n,)).astype(np.float32)[:, None]
    if "SIGNAL" in vectors.dtype.names:
        phase[np.asarray(vectors["SIGNAL"]) == 0] = 0
    if _text(tree, "Global/SGN") == "+1":
        phase = phase.conj()
    middle = (sent + received) / 2
    reference = np.linalg.norm(middle - srp, axis=1)
    if (np.linalg.norm(sent - received, axis=1) > _APART * reference).any():
        raise ValueError("it was sent and received in different places (bistatic)")
    center = np.array([float(_text(tree, f"SceneCoordinates/IARP/ECF/{x}")) for x in "XYZ"])
    return PhaseHistory(
        *(phase, frequency, (middle - center) @ local_axes(center).T, reference),
        (numbers["TxTime"] + numbers["RcvTime"]) / 2,
    )


def _check_kind(tree: Any) -> None:
    if tree.find("{*}Data/{*}SignalCompressionID") is not None:
        raise ValueError("its signal is compressed")
    domain, sign = _text(tree, "Global/DomainType"), _text(tree, "Global/SGN")
    if domain != "FX":
        raise ValueError(f"it is in the domain '{domain}': transform its vectors to FX")
    if sign not in ("+1", "-1"):
        raise ValueError(f"its Global/SGN is '{sign}', not +1 or -1")


def _chosen(found: list[str], channel: str) -> str:
    told = ", ".join(found) or "none"
    if channel and channel not in found:
        raise ValueError(f"it has no channel '{channel}'; it has {told}")
    if not channel and len(found) != 1:
        raise ValueError(f"it has several channels: {told}\n  name one" if found else "it is empty")
    return channel or found[0]


def _size(path: Path, tree: Any, name: str) -> tuple[int, int]:
    """Vectors and samples of a channel, which the file is long enough for."""
    channels = tree.findall("{*}Data/{*}Channel")
    node = next(c for c in channels if c.findtext("{*}Identifier") == name)
    n, k = (int(node.findtext(f"{{*}}{key}")) for key in ("NumVectors", "NumSamples"))
    size, each = path.stat().st_size, {"CI2": 2, "CI4": 4, "CF8": 8}
    form = _text(tree, "Data/SignalArrayFormat")
    if form not in each:
        raise ValueError(f"its samples are '{form}', not CI2, CI4 or CF8")
    if not (n >= 2 and k >= 2 and n * k * each[form] <= size):
        raise ValueError(f"it says {n} vectors of {k} samples, and has {size} bytes")
    return n, k


def _values(vectors: NDArray[np.void], name: str, shape: tuple[int, ...]) -> FloatArray:
    if name not in (vectors.dtype.names or ()):
        raise ValueError(f"its vectors have no '{name}'")
    values = np.asarray(vectors[name], np.float64)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"'{name}' of its vectors is not finite, or of another shape")
    return values


def _common_band(numbers: dict[str, FloatArray], k: int) -> FloatArray:
    """Frequencies of the first vector that lie in the saved band of every one [Hz]."""
    first, step = numbers["SC0"], numbers["SCSS"]
    if not (step > 0).all():
        raise ValueError("the steps between its frequencies (SCSS) are not above zero")
    margin = 0 if _alike(first, step, k) else _TAPS
    last = first + step * (k - 1)
    low = max(numbers["FX1"].max(), (first + margin * step).max())
    high = min(numbers["FX2"].min(), (last - margin * step).min())
    cells = np.arange(k)
    frequency = first[0] + step[0] * cells
    slack = _EVEN * step[0]
    common = frequency[(frequency >= low - slack) & (frequency <= high + slack)]
    if len(common) < 2:
        raise ValueError("no frequencies are in the band of all its vectors (FX1, FX2, SC0, SCSS)")
    return np.asarray(common, np.float64)


def _alike(first: FloatArray, step: FloatArray, k: int) -> bool:
    off = np.abs(first - first[0]) + k * np.abs(step - step[0])
    return bool(off.max() <= _EVEN * step[0])


def _at(
    signal: ComplexArray, first: FloatArray, step: FloatArray, frequency: FloatArray
) -> ComplexArray:
    """Vectors at common frequencies [Hz], by their own sinc where theirs differ."""
    n, k = signal.shape
    start = round((frequency[0] - first[0]) / step[0])
    if _alike(first, step, k):
        return np.ascontiguousarray(signal[:, start : start + len(frequency)])
    found = np.empty((n, len(frequency)), np.complex64)
    taps = np.arange(1 - _TAPS, _TAPS + 1)
    for i in range(n):
        x = (frequency - first[i]) / step[i]
        below = np.floor(x).astype(np.intp)
        near = np.clip(below[:, None] + taps, 0, k - 1)
        u = x[:, None] - (below[:, None] + taps)
        weights = np.sinc(u) * np.cos(np.pi * u / (2 * _TAPS)) ** 2
        found[i] = np.einsum("ij,ij->i", weights, signal[i][near])
    return found


def _complex(signal: NDArray[Any]) -> ComplexArray:
    if signal.dtype.names is None:
        return signal.astype(np.complex64)
    made: ComplexArray = np.empty(signal.shape, np.complex64)
    made.real, made.imag = (signal[name] for name in signal.dtype.names)
    return made


def _text(tree: Any, name: str) -> str:
    path = "/".join(f"{{*}}{part}" for part in name.split("/"))
    text = tree.findtext(path)
    if text is None:
        raise ValueError(f"its XML has no {name}")
    return str(text).strip()
