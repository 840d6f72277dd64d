r"""Sums over the pulses of a radar on a track: echo of scatterers, and images by back projection.

Each pulse is sent and received from one place (stop and hop): at 70 m/s and 2 km the antenna moves
by a micrometer until the echo is back. What a pulse receives is the sum over scatterers of

.. math::
    a_i\, g_i\, e^{-j 4\pi (R_i - R_{i,0}) / \lambda}\, \delta(R - R_i), \qquad
    R_i = \lVert p_i - r \rVert, \qquad
    g_i = \bigl(1 - (s_i / s_0)^2\bigr)^3,

with :math:`R_{i,0}` the range at the pulse in the middle, :math:`s_i` the sine of the angle off the
plane across the antenna's long side, and :math:`s_0` that of the pattern's first null: within 0.02
of the main lobe, :math:`\operatorname{sinc}^2(s / s_0)`, of a uniform aperture used both ways.
Impulses lie between cells, so each is shared by the two cells about it, in proportion to its
distance from them.

The sums are what costs: some 1e9 terms for the echo of a second. They are compiled from
``pulses.c`` by whoever can (`terrafix.components.sensors.compiled`) and handed to the models, which
know no compiler; `ArraySums` computes the same with arrays, ten times slower.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.core.parallel import batches, over
from terrafix.models.radar.chirp import unit_phasor

_PULSES, _PIXELS = 16, 1024
"""Pulses and pixels that a thread sums at a time."""


@dataclass(frozen=True)
class Impulses:
    """Scatterers as they lie about a middle pulse.

    Parameters
    ----------
    line : ndarray of float32, shape (3, n)
        From the middle antenna to each [m].
    slant_range : ndarray of float32, shape (n,)
        Their lengths [m].
    cell : ndarray of float32, shape (n,)
        Place of each among the cells of the sum at the middle pulse, fractional.
    reflection : ndarray of complex64, shape (n,)
        As seen at the middle pulse.
    """

    line: Single
    slant_range: Single
    cell: Single
    reflection: ComplexArray


@dataclass(frozen=True)
class Pulses:
    """Where pulses were sent, and what of the scatterers each may light.

    Parameters
    ----------
    way : ndarray, shape (n_pulses, 3)
        From the middle antenna [m].
    axis : ndarray, shape (n_pulses, 3)
        Unit vector along the antenna's long side: the beam is centered across it.
    first, last : ndarray of int64, shape (n_pulses,)
        Scatterers that may be lit: from the first up to, but not including, the last.
    wavelength : float
        [m]
    spacing : float
        Range between cells of the sum [m].
    null : float
        Sine at which the pattern first vanishes.
    cut : float
        Part of `null` beyond which nothing is summed.
    n_cells : int
        Cells of a line of the sum.
    """

    way: FloatArray
    axis: FloatArray
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    wavelength: float
    spacing: float
    null: float
    cut: float
    n_cells: int

    def part(self, rows: slice) -> Pulses:
        """Some of the pulses."""
        return replace(
            self,
            way=self.way[rows],
            axis=self.axis[rows],
            first=self.first[rows],
            last=self.last[rows],
        )


@dataclass(frozen=True)
class Profiles:
    """Compressed echo of pulses, for back projection.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_pulses, n_cells)
        Cell c is at the range ``near + c * spacing`` beyond `reference`, and a scatterer has the
        phase of its range beyond it.
    r : ndarray, shape (n_pulses, 3)
        Places of the antenna [m].
    reference : ndarray, shape (n_pulses,)
        Range to which the echo was compensated [m].
    near, spacing : float
        [m]
    wavelength : float
        [m]
    """

    echo: ComplexArray
    r: FloatArray
    reference: FloatArray
    near: float
    spacing: float
    wavelength: float


class PulseSums(Protocol):
    """What sums over pulses."""

    def add_impulses(self, out: ComplexArray, scatterers: Impulses, pulses: Pulses) -> None:
        """Add the impulses of scatterers to lines (n_pulses, n_cells)."""

    def back_projected(self, profiles: Profiles, p: FloatArray) -> ComplexArray:
        """Sum over pulses of the echo at points (n, 3) [m], turned back: shape (n,)."""


class ArraySums:
    """The sums with NumPy."""

    def add_impulses(self, out: ComplexArray, scatterers: Impulses, pulses: Pulses) -> None:
        """Add the impulses of scatterers to lines (n_pulses, n_cells)."""

        def add(rows: slice) -> None:
            for p in range(rows.start, rows.stop):
                out[p] += _line(scatterers, pulses, p)

        over(batches(len(out), _PULSES), add)

    def back_projected(self, profiles: Profiles, p: FloatArray) -> ComplexArray:
        """Sum over pulses of the echo at points (n, 3) [m], turned back: shape (n,)."""
        out = np.zeros(len(p), np.complex64)

        def add(pixels: slice) -> None:
            for line, r, reference in zip(
                profiles.echo, profiles.r, profiles.reference, strict=True
            ):
                beyond = np.linalg.norm(p[pixels] - r, axis=1) - reference
                cell = (beyond - profiles.near) / profiles.spacing
                inside = (cell >= 0) & (cell < len(line) - 1)
                cell = np.where(inside, cell, 0.0)
                k = cell.astype(np.intp)
                far = (cell - k).astype(np.float32)
                value = line[k] + far * (line[k + 1] - line[k])
                out[pixels] += inside * value * unit_phasor(2 / profiles.wavelength * beyond)

        over(batches(len(p), _PIXELS), add)
        return out


def _line(scatterers: Impulses, pulses: Pulses, p: int) -> NDArray[np.complex128]:
    """Impulses of one pulse, as ``terrafix_impulses`` of ``pulses.c`` sums them."""
    part = slice(pulses.first[p], pulses.last[p])
    way, axis = pulses.way[p], pulses.axis[p]
    line, R0 = scatterers.line[:, part], scatterers.slant_range[part]
    more = np.float32(way @ way) - 2 * (way.astype(np.float32) @ line)
    R = np.sqrt(R0 * R0 + more)
    change = more / (R + R0)
    sine = (axis.astype(np.float32) @ line - np.float32(axis @ way)) / (R * np.float32(pulses.null))
    cell = scatterers.cell[part] + change / np.float32(pulses.spacing)
    lit = (np.abs(sine) < pulses.cut) & (cell >= 0) & (cell < pulses.n_cells - 1)
    sine, cell, change = sine[lit], cell[lit], change[lit]
    seen = scatterers.reflection[part][lit] * (1 - sine * sine) ** 3
    seen *= unit_phasor(-2 / pulses.wavelength * change)
    k = cell.astype(np.intp)
    far = cell - k
    out = np.zeros(pulses.n_cells, np.complex128)
    for offset, share in ((0, 1 - far), (1, far)):
        out.real += np.bincount(k + offset, seen.real * share, pulses.n_cells)
        out.imag += np.bincount(k + offset, seen.imag * share, pulses.n_cells)
    return out


def c_source() -> str:
    """C of the compiled sums; whoever compiles it defines ``TERRAFIX_KEY``, a string."""
    return Path(__file__).with_name("pulses.c").read_text()


class CompiledSums:
    """The sums, compiled.

    Parameters
    ----------
    library : ctypes.CDLL
        Made of `c_source`.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        pointer, count, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
        self._impulses: Any = library["terrafix_impulses"]
        self._impulses.restype = None
        self._impulses.argtypes = [count, *[pointer] * 11, *[real] * 4, count, pointer]
        self._back_projection: Any = library["terrafix_back_projection"]
        self._back_projection.restype = None
        self._back_projection.argtypes = [
            *(count, count, pointer, pointer, pointer, real, real, real),
            *(count, pointer, pointer),
        ]

    def add_impulses(self, out: ComplexArray, scatterers: Impulses, pulses: Pulses) -> None:
        """Add the impulses of scatterers to lines (n_pulses, n_cells)."""
        if out.shape != (len(pulses.way), pulses.n_cells) or not out.flags.c_contiguous:
            raise ValueError(f"lines of shape {out.shape} are not those of the pulses")
        shared = [np.ascontiguousarray(a, np.float32) for a in scatterers.line]
        shared += [np.ascontiguousarray(scatterers.slant_range, np.float32)]
        shared += [np.ascontiguousarray(scatterers.cell, np.float32)]
        both = scatterers.reflection.real, scatterers.reflection.imag
        shared += [np.ascontiguousarray(a, np.float32) for a in both]

        def add(rows: slice) -> None:
            own, lines = pulses.part(rows), out[rows]
            arrays: list[NDArray[Any]] = [
                np.ascontiguousarray(own.way, np.float64),
                np.ascontiguousarray(own.axis, np.float64),
                np.ascontiguousarray(own.first, np.int64),
                np.ascontiguousarray(own.last, np.int64),
                *shared,
            ]
            self._impulses(
                *(len(lines), *(a.ctypes.data for a in arrays)),
                *(own.wavelength, 1 / own.spacing, own.null, own.cut),
                *(own.n_cells, lines.ctypes.data),
            )

        over(batches(len(out), _PULSES), add)

    def back_projected(self, profiles: Profiles, p: FloatArray) -> ComplexArray:
        """Sum over pulses of the echo at points (n, 3) [m], turned back: shape (n,)."""
        echo = np.ascontiguousarray(profiles.echo, np.complex64)
        r, reference, p = (
            np.ascontiguousarray(a, np.float64) for a in (profiles.r, profiles.reference, p)
        )
        out = np.zeros(len(p), np.complex64)

        def add(pixels: slice) -> None:
            points, sums = p[pixels], out[pixels]
            self._back_projection(
                *(*echo.shape, echo.ctypes.data, r.ctypes.data, reference.ctypes.data),
                *(profiles.near, 1 / profiles.spacing, profiles.wavelength),
                *(len(points), points.ctypes.data, sums.ctypes.data),
            )

        over(batches(len(p), _PIXELS), add)
        return out
