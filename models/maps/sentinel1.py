r"""Level-1 images of Sentinel-1 (SLC, GRD): their pixels, and when and at what range each was seen.

The annotation (.xml) of an image gives its timing and the orbit; with these a pixel is a time of
zero Doppler and a slant range, and its place follows from where the ground is
(`terrafix.models.geometry.geolocation`). The annotation's own grid of places is not interpolated:
its points lie on the processor's terrain, kilometers apart, and between bursts it jumps.

Images of bursts (IW, EW) have some of the ground twice. Here their lines are put in one sequence,
each burst up to the middle of what it shares with the next. Times of bursts are whole numbers of
lines apart.

What the annotation calls the azimuth time of a place lies later than the line's, by an amount that
grows along the swath (the radar moves on between sending and receiving). It is taken from its grid,

.. math:: t(l, \tau) = t_l + c_0 + c_1 \tau.

In ground range, :math:`R = \sum_k g_k (d - d_0)^k` at distance :math:`d` from the first sample, by
the coefficients that are nearest in time.

References
----------
.. [1] "Sentinel-1 Product Specification", S1-RS-MDA-52-7441, ESA.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray
from terrafix.models.core.extras import optional
from terrafix.models.core.formats import kind_of
from terrafix.models.geometry.geodesy import ecef
from terrafix.models.geometry.geolocation import ground_point
from terrafix.models.maps.raster import LARGEST, opened
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.motion.epochs import read_tags

SPEED_OF_LIGHT = 299_792_458.0
MAX_BYTES = 64 * 1024 * 1024
"""Largest annotation read; they have some 2 MB."""
_ROUNDS, _CLOSE = 20, 1e-9
"""Of the search for the time of zero Doppler [s]."""
_PIXELS = {"complex_int16": "Complex", "uint16": "Detected"}
"""What files hold, and what annotations call it."""


@dataclass(frozen=True, eq=False)
class Sentinel1:
    """An image of Sentinel-1: lines and samples, each with a time and a range.

    Parameters
    ----------
    path : Path
        Of its pixels (.tiff).
    shape : (int, int)
        Lines, without those that bursts share, and samples of the whole product.
    first_time, line_time : float
        Of the first line, and from line to line [s], on the clock of `orbit`.
    ranges : tuple
        Times [s] and, for each, first distance [m] and coefficients by which distances are slant
        ranges.
    sample_spacing : float
        Distance from sample to sample [m].
    orbit : Ephemeris
    later : (float, float)
        c_0 [s] and c_1 [s/m of slant range].
    file_lines : ndarray of int, shape (n_lines,)
        Where each line is in the product's file.
    offset : (int, int)
        Line and sample of the product with which the file begins.
    grid : ndarray, shape (n, 5)
        The annotation's places: time on the clock of `orbit` [s], slant range [m], latitude,
        longitude [rad], height [m].
    """

    path: Path
    shape: tuple[int, int]
    first_time: float
    line_time: float
    ranges: tuple[FloatArray, FloatArray, FloatArray]
    sample_spacing: float
    orbit: Ephemeris
    later: tuple[float, float]
    file_lines: NDArray[np.intp]
    offset: tuple[int, int]
    grid: FloatArray

    def seen_at(self, line: ArrayLike, sample: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Time of zero Doppler [s] and slant range [m] of pixels, fractional, shape (...)."""
        line, sample = np.broadcast_arrays(
            np.asarray(line, np.float64), np.asarray(sample, np.float64)
        )
        t = self.first_time + self.line_time * line
        R = self._slant_range(t, sample * self.sample_spacing)
        return t + self.later[0] + self.later[1] * R, R

    def pixels(self, p_e: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Line and sample, fractional, of points (..., 3) [m]; NaN where it did not pass by."""
        p = np.asarray(p_e, np.float64)
        t = np.full(p.shape[:-1], self.first_time + self.line_time * self.shape[0] / 2)
        for _ in range(_ROUNDS):
            r, v = self.orbit.at(np.clip(t, self.orbit.t[0], self.orbit.t[-1]))
            ahead = np.sum((p - r) * v, axis=-1) / np.sum(v * v, axis=-1)
            t = t + ahead
            if np.abs(ahead).max(initial=0.0) < _CLOSE:
                break
        there = (t >= self.orbit.t[0]) & (t <= self.orbit.t[-1])
        r, v = self.orbit.at(np.where(there, t, self.orbit.t[0]))
        R = np.linalg.norm(p - r, axis=-1)
        right = np.sum(np.cross(v, r) * (p - r), axis=-1) > 0
        t = t - self.later[0] - self.later[1] * R
        line = (t - self.first_time) / self.line_time
        sample = self._distance(t, R) / self.sample_spacing
        there &= right
        return np.where(there, line, np.nan), np.where(there, sample, np.nan)

    def read(self, lines: slice, samples: slice) -> ComplexArray:
        """Pixels of a window, complex; zero beyond what the file holds.

        Raises
        ------
        ValueError
            If it is too large, or the file is damaged.
        """
        n = lines.stop - lines.start, samples.stop - samples.start
        if n[0] * n[1] > LARGEST // 2:
            raise ValueError(f"'{self.path.name}': {n[0]} x {n[1]} pixels are too many to hold")
        out = np.zeros(n, np.complex64)
        errors = optional("rasterio.errors", "an image of Sentinel-1", extra="sar")
        windows = optional("rasterio.windows", "an image of Sentinel-1", extra="sar")
        wanted = self.file_lines[lines] - self.offset[0]
        first = samples.start - self.offset[1]
        with opened(self.path) as dataset:
            held = dataset.height, dataset.width
            left, right = max(first, 0), min(first + n[1], held[1])
            inside = (wanted >= 0) & (wanted < held[0])
            if left >= right or not inside.any():
                return out
            for part in np.split(
                np.flatnonzero(inside), np.flatnonzero(np.diff(wanted[inside]) != 1) + 1
            ):
                top, height = int(wanted[part[0]]), len(part)
                window = windows.Window(left, top, right - left, height)
                try:
                    raw = dataset.read(1, window=window)
                except errors.RasterioError as error:
                    raise ValueError(f"'{self.path}' is damaged: {error}") from error
                out[part[0] : part[0] + height, left - first : right - first] = raw
        return out

    def misclosure(self) -> FloatArray:
        """Distances [m] of the annotation's places from where orbit, time and range put them."""
        t, R, latitude, longitude, height = self.grid.T
        r, v = self.orbit.at(t)
        p = ground_point(r, v, R, 0.0, height)
        return np.asarray(np.linalg.norm(p - ecef(latitude, longitude, height), axis=-1))

    def _slant_range(self, t: FloatArray, distance: FloatArray) -> FloatArray:
        times, origins, coefficients = self.ranges
        k = np.abs(np.asarray(t)[..., None] - times).argmin(axis=-1)
        d = distance - origins[k]
        R = np.zeros(np.shape(d))
        for c in coefficients.T[::-1]:
            R = R * d + c[k]
        return np.asarray(R)

    def _distance(self, t: FloatArray, R: FloatArray) -> FloatArray:
        """Inverse of `_slant_range`: Newton, from a straight line through both ends."""
        end = self.shape[1] * self.sample_spacing
        near, far = (self._slant_range(t, np.full(np.shape(R), d)) for d in (0.0, end))
        slope = (far - near) / end
        d = (R - near) / slope
        for _ in range(_ROUNDS):
            change = (R - self._slant_range(t, d)) / slope
            d = d + change
            if np.abs(change).max(initial=0.0) < 1e-4:
                break
        return np.asarray(d)


def read_sentinel1(path: Path, annotation: Path, offset: tuple[int, int] = (0, 0)) -> Sentinel1:
    """Open an image of Sentinel-1.

    Parameters
    ----------
    path : Path
        Of its pixels (.tiff).
    annotation : Path
        Of its annotation (.xml).
    offset : (int, int)
        Line and sample of the product with which the file begins, where it was cut.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If one of them is another file, or the two do not belong together.
    """
    root = _annotation(annotation)
    try:
        found = _read(root, path, offset)
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"'{annotation}' is no annotation of an image of Sentinel-1 that is read: {error}\n"
            "  name the file of the folder annotation that has the name of the image"
        ) from error
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    with opened(path) as dataset:
        kind = root.findtext("imageAnnotation/imageInformation/pixelValue")
        if _PIXELS.get(dataset.dtypes[0]) != kind or dataset.count != 1:
            raise ValueError(
                f"'{path}' has {dataset.count} bands of {dataset.dtypes[0]}, its annotation says "
                f"{kind}\n  name the annotation of this image"
            )
        held = dataset.height, dataset.width
    whole = _whole(root)
    if any(o < 0 or o + h > w for o, h, w in zip(offset, held, whole, strict=True)):
        raise ValueError(
            f"'{path}' has {held[0]} lines of {held[1]} samples from {offset[0]}, {offset[1]} on; "
            f"its annotation is of {whole[0]} of {whole[1]}\n  name the annotation of this image, "
            "and where it was cut from it"
        )
    return found


def _annotation(path: Path) -> ET.Element:
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    found, _ = kind_of(path)
    if found != "XML" or path.stat().st_size > MAX_BYTES:
        raise ValueError(f"'{path}' is no annotation of Sentinel-1 (.xml)")
    raw = path.read_bytes()
    if b"<!ENTITY" in raw:
        raise ValueError(f"'{path}' is no annotation of Sentinel-1: it declares entities")
    try:
        return ET.fromstring(raw)
    except ET.ParseError as error:
        raise ValueError(f"'{path}' is damaged: {error}") from error


def _whole(root: ET.Element) -> tuple[int, int]:
    about = root.find("imageAnnotation/imageInformation")
    return int(_number(about, "numberOfLines")), int(_number(about, "numberOfSamples"))


def _number(element: ET.Element | None, name: str) -> float:
    text = None if element is None else element.findtext(name)
    if text is None:
        raise ValueError(f"it has no {name}")
    return float(text)


def _texts(root: ET.Element, where: str, name: str) -> list[str]:
    return [e.findtext(name) or "" for e in root.findall(where)]


def _read(root: ET.Element, path: Path, offset: tuple[int, int]) -> Sentinel1:
    about = root.find("imageAnnotation/imageInformation")
    n_lines, n_samples = _whole(root)
    orbit = _orbit(root)

    def seconds(texts: list[str]) -> FloatArray:
        return np.asarray((read_tags(texts, "UTC")[0] - orbit.tags[0]) / np.timedelta64(1, "s"))

    line_time = _number(about, "azimuthTimeInterval")
    starts = _texts(root, "swathTiming/burstList/burst", "azimuthTime")
    t0 = seconds(
        starts or _texts(root, "imageAnnotation/imageInformation", "productFirstLineUtcTime")
    )
    lines = np.arange(n_lines)
    if starts:
        n_lines = int(_number(root.find("swathTiming"), "linesPerBurst"))
        lines = _in_sequence(root, np.rint((t0 - t0[0]) / line_time).astype(int), n_lines)
    ranges = _ranges(root, about, seconds)
    spacing = ranges[3]
    points = [
        [
            float(e.findtext(n) or "nan")
            for n in ("line", "pixel", "latitude", "longitude", "height")
        ]
        + [float(e.findtext("slantRangeTime") or "nan") * SPEED_OF_LIGHT / 2]
        for e in root.findall("geolocationGrid/geolocationGridPointList/geolocationGridPoint")
    ]
    line, _, latitude, longitude, height, R = np.array(points).T
    t = seconds(
        _texts(root, "geolocationGrid/geolocationGridPointList/geolocationGridPoint", "azimuthTime")
    )
    if starts:
        burst = np.minimum(line // n_lines, len(t0) - 1).astype(int)
        own = t0[burst] + (line - burst * n_lines) * line_time
    else:
        own = t0[0] + line * line_time
    slope, constant = np.polyfit(R, t - own, 1)
    return Sentinel1(
        path,
        (len(lines), n_samples),
        float(t0[0]),
        line_time,
        ranges[:3],
        spacing,
        orbit,
        (float(constant), float(slope)),
        lines,
        offset,
        np.column_stack([t, R, np.radians(latitude), np.radians(longitude), height]),
    )


def _orbit(root: ET.Element) -> Ephemeris:
    where = "generalAnnotation/orbitList/orbit"
    if {*_texts(root, where, "frame")} != {"Earth Fixed"}:
        raise ValueError("its orbit is not Earth-fixed")
    tags, _ = read_tags(_texts(root, where, "time"), "UTC")
    r, v = (
        np.array([[_number(e.find(what), a) for a in "xyz"] for e in root.findall(where)])
        for what in ("position", "velocity")
    )
    return Ephemeris(tags, (tags - tags[0]) / np.timedelta64(1, "s"), r, v)


def _in_sequence(root: ET.Element, starts: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    """Line in the file of each line of the sequence of bursts, of which each holds n."""
    valid = []
    for k, burst in enumerate(root.findall("swathTiming/burstList/burst")):
        seen = np.fromstring(burst.findtext("firstValidSample") or "", dtype=int, sep=" ") >= 0
        if len(seen) != n or not seen.any():
            raise ValueError(f"its burst {k + 1} has no valid lines")
        valid.append(starts[k] + np.flatnonzero(seen)[[0, -1]])
    ends = [(a[1] + b[0]) // 2 for a, b in pairwise(valid)]
    bounds = [0, *(e + 1 for e in ends), int(starts[-1]) + n]
    return np.concatenate(
        [
            k * n + np.arange(first, last) - starts[k]
            for k, (first, last) in enumerate(pairwise(bounds))
        ]
    )


def _ranges(
    root: ET.Element, about: ET.Element | None, seconds: Callable[[list[str]], FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Times, origins and coefficients of slant ranges by distances, and the spacing of samples."""
    products = root.find("generalAnnotation/productInformation")
    if products is not None and products.findtext("projection") == "Slant Range":
        near = _number(about, "slantRangeTime") * SPEED_OF_LIGHT / 2
        spacing = SPEED_OF_LIGHT / (2 * _number(products, "rangeSamplingRate"))
        return np.zeros(1), np.zeros(1), np.array([[near, 1.0]]), spacing
    where = "coordinateConversion/coordinateConversionList/coordinateConversion"
    times = seconds(_texts(root, where, "azimuthTime"))
    entries = root.findall(where)
    if not entries:
        raise ValueError("it has no conversion from ground range to slant range")
    origins = np.array([_number(e, "gr0") for e in entries])
    coefficients = np.array(
        [[float(c) for c in (e.findtext("grsrCoefficients") or "").split()] for e in entries]
    )
    return times, origins, coefficients, _number(about, "rangePixelSpacing")
