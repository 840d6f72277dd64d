r"""From an orbit to where an image lies on a reference, and from there to a place with covariance.

A row of an image is when the beam's center passed, a column is a slant range; with the Doppler
frequency of that center each pixel is a place on the terrain, as far as position and velocity are
known, and that place has a pixel on the reference. Errors of position and velocity move the image
on the reference, turn and stretch it a little: by how much is linearized about the estimate, in
axes of its covariance, at a fixed height.

What is recognized is a pixel of the reference, with a covariance :math:`C`. Its place :math:`p` on
the terrain has

.. math:: D = J C J^T + \sigma_a^2 a a^T + \sigma_c^2 c c^T + \sigma_u^2 w w^T, \qquad
          J = \frac{\partial p}{\partial(i, j)}, \quad w = \frac{\partial p}{\partial h},

with :math:`a, c` along the track and across it, and :math:`w` how the place moves where the terrain
is higher than known: up, and in slant geometry towards the radar of the reference, for what was
seen at a range is nearer if it is higher. A reference of level ground, or of few tie points, does
not tell whether it is in slant geometry: then up and across are taken each by itself, which holds
in either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.geometry.geolocation import Height, ground_point, track_axes
from terrafix.models.images.matching import (
    Match,
    Prediction,
    Searchable,
    matched,
    refused,
    searched_span,
)
from terrafix.models.images.reference import Reference
from terrafix.models.motion.arc import earth_fixed_acceleration_array

_SPACING, _FINE = (32.0, 33), (4.0, 513)
"""From one predicted pixel to the next [pixels], and most along an axis; those of a map, which has
the relief between them."""
_UNSURE = 5e-4
"""Of a linear map, that tie points of a reference may have wrong: half a pixel in a thousand."""
_SPAN = 300.0
"""About the heights found at first, that places are taken as parabolas of height in [m]."""
_ROUNDS, _CLOSE = 60, 0.05
_FEWEST, _ROUGH = 24, 0.3
"""Nodes that a parabola is put through, and what it may leave of them (rms) [pixels]."""
_TRIES, _SETTLED = 6, 0.5
"""Predictions for a place on a map, and how far off the last may be [pixels]: a place that is a
pixel off moves relief by some hundredths."""
_PIXELS, _RISE = 2.0, 5.0
"""Differences for the slopes of a place, by pixels and by height [m]."""


@dataclass(frozen=True)
class View:
    r"""How an image was seen, as an estimate has it.

    Parameters
    ----------
    r, v : ndarray, shape (3,)
        Position [m] and velocity [m/s] when the beam's center passed `row`, Earth-fixed.
    row, column : float
        Of the beam's center on the image, fractional.
    row_time : float
        From row to row [s].
    slant_range, column_range : float
        To the beam's center, and from column to column [m].
    sine : float
        Of the angle of the beam's center ahead of broadside.
    side : {1, -1}
        To the right of the track, or to the left.
    time_sigma, range_sigma : float
        Standard errors of time [s] and slant range [m].
    """

    r: FloatArray
    v: FloatArray
    row: float
    column: float
    row_time: float
    slant_range: float
    column_range: float
    sine: float
    side: int = 1
    time_sigma: float = 0.0
    range_sigma: float = 0.0

    def points(self, rows: FloatArray, columns: FloatArray, height: FloatArray) -> FloatArray:
        """Places (n_rows, n_columns, 3) [m] of pixels at heights (n_rows, n_columns) [m]."""
        t = ((rows - self.row) * self.row_time)[:, None]
        a = np.asarray(earth_fixed_acceleration_array(self.r, self.v))
        r, v = self.r + self.v * t + a * t * t / 2, self.v + a * t
        R = self.slant_range + (columns - self.column) * self.column_range
        return ground_point(r[:, None], v[:, None], R, self.sine, height, self.side)


def predicted(
    view: View, P: FloatArray, reference: Reference, terrain: Height, shape: tuple[int, int]
) -> Prediction:
    """Where the pixels of an image, and those about it, lie on a reference.

    Parameters
    ----------
    view : View
    P : ndarray, shape (6, 6)
        Covariance of position [m] and velocity [m/s].
    reference : Reference
    terrain : callable
        Height [m] at latitudes and longitudes [rad]; NaN where it is not known.
    shape : tuple of int
        Rows and columns of the image.

    Raises
    ------
    ValueError
        If what is seen is not on the ground.
    """
    covariance, linear = _uncertainty(view, P, terrain, shape)
    spans = [
        searched_span(n, float(np.sqrt(variance)))
        for n, variance in zip(shape, np.diag(covariance), strict=True)
    ]
    rows, columns, places, inside = _nodes(view, reference, terrain, spans, _SPACING)
    places, slant = _smooth(places, inside)
    if not slant:
        rows, columns, places, _ = _nodes(view, reference, terrain, spans, _FINE)
    return Prediction(rows, columns, places, covariance, linear, slant)


def _nodes(
    view: View,
    reference: Reference,
    terrain: Height,
    spans: list[tuple[int, int]],
    spacing: tuple[float, int],
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Rows, columns, their places on the reference, and which are inside it."""
    rows, columns = (
        np.linspace(low, high, int(np.clip(np.ceil((high - low) / spacing[0]) + 1, 2, spacing[1])))
        for low, high in spans
    )
    latitude, longitude, height = _on_terrain(view, rows, columns, terrain)
    row, column, inside = reference.pixel(latitude, longitude, height)
    return rows, columns, np.stack([row, column], axis=-1), inside


def recognized(
    image: Searchable,
    amplitude: Searchable,
    view: View,
    P: FloatArray,
    reference: Reference,
    terrain: Height,
) -> Match:
    """Find where an image lies on a reference, from where an estimate predicts it.

    On a map, which is not in slant geometry, what is predicted of relief belongs to the place where
    the estimate looks. It is predicted anew for the place that is found, until that stays.

    Parameters
    ----------
    image, amplitude : Searchable
        The image, and the reference's.
    view, P, reference, terrain
        As of `predicted`.

    Raises
    ------
    ValueError
        If what is seen is not on the ground.
    """
    c, own = (view.row, view.column), view
    for _ in range(_TRIES):
        where = predicted(own, P, reference, terrain, image.shape)
        match = matched(image, amplitude, where, c)
        off = np.array([match.row, match.column]) - where.at([c[0]], [c[1]])[0, 0]
        if not match.accepted or where.slant or np.abs(off).max() < _SETTLED:
            return match
        latitude, longitude, _ = reference.place(match.row, match.column)
        found = ecef(latitude, longitude, terrain(latitude, longitude))
        here = _on_terrain(own, np.array([c[0]]), np.array([c[1]]), terrain)
        seen = ecef(*(a[0, 0] for a in here))
        if not np.isfinite(found).all():
            return refused("its place has no height")
        own = replace(own, r=own.r + found - seen)
    return refused("its place on a map does not settle")


def _smooth(places: FloatArray, inside: NDArray[np.bool_]) -> tuple[FloatArray, bool]:
    """Places (n_i, n_j, 2) as a parabola of row and column, where they nearly are one; if so.

    In slant geometry they are, as two radars see relief nearly alike. What is not smooth comes of
    where the estimate sees it from, wrongly: a tenth of a pixel, of which the center would have
    its own part. Of a map that is not in slant geometry relief is real, and is kept.
    """
    if inside.sum() < _FEWEST:
        return places, True
    i, j = np.meshgrid(*(np.linspace(-1, 1, n) for n in inside.shape), indexing="ij")
    terms = np.stack([np.ones_like(i), i, j, i * i, i * j, j * j], axis=-1)
    fitted = terms @ np.linalg.lstsq(terms[inside], places[inside], rcond=None)[0]
    rough = np.sqrt(np.mean((places - fitted)[inside] ** 2, axis=0))
    smooth = bool(rough.max() < _ROUGH)
    return fitted if smooth else places, smooth


def _uncertainty(
    view: View, P: FloatArray, terrain: Height, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Covariances of an image's shift (2, 2) [pixels^2] and of a linear map of it (4, 4)."""
    c = np.array([view.row]), np.array([view.column])
    latitude, longitude, _ = geodetic(view.points(*c, np.zeros((1, 1)))[0, 0])
    h = np.nan_to_num(np.asarray(terrain(latitude, longitude), np.float64))
    rows, columns = (
        np.array([center - n / 2, center, center + n / 2])
        for center, n in zip((view.row, view.column), shape, strict=True)
    )
    at = np.full((3, 3), float(h))
    own = view.points(rows, columns, at)
    steps = np.stack([own[2, 1] - own[0, 1], own[1, 2] - own[1, 0]], axis=1) / np.array(shape)
    onto = np.linalg.pinv(steps)
    y, x = np.meshgrid(rows - view.row, columns - view.column, indexing="ij")
    design = np.stack([np.ones(9), y.ravel(), x.ravel()], axis=1)
    values, vectors = np.linalg.eigh(P)
    moved = []
    for s, vector in zip(np.sqrt(np.maximum(values, 0.0)), vectors.T, strict=True):
        r, v = view.r + s * vector[:3], view.v + s * vector[3:]
        sine = view.sine * float(np.linalg.norm(view.v) / np.linalg.norm(v))
        other = replace(view, r=r, v=v, sine=sine)
        shift = ((other.points(rows, columns, at) - own) @ onto.T).reshape(9, 2)
        moved.append(np.linalg.lstsq(design, shift, rcond=None)[0].T)
    M = np.array(moved)  # axes of the covariance, row and column, shift and by rows and columns
    measured = np.square([view.time_sigma / view.row_time, view.range_sigma / view.column_range])
    shifts, slopes = M[:, :, 0], M[:, :, 1:].reshape(-1, 4)
    return shifts.T @ shifts + np.diag(measured), slopes.T @ slopes + _UNSURE**2 * np.eye(4)


def _on_terrain(
    view: View, rows: FloatArray, columns: FloatArray, terrain: Height
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude [rad] and height [m] of pixels, (n_rows, n_columns) each.

    Along the height places are parabolas; where the terrain is not known, it is as its mean.
    """
    shape = len(rows), len(columns)
    first = np.stack(geodetic(view.points(rows, columns, np.zeros(shape)))[:2])
    found = np.asarray(terrain(*first), np.float64)
    known = np.isfinite(found)
    if not known.any():
        found = np.zeros(shape)
    low, high = float(np.nanmin(found)) - _SPAN, float(np.nanmax(found)) + _SPAN
    middle, half = (low + high) / 2, (high - low) / 2
    p = [geodetic(view.points(rows, columns, np.full(shape, h))) for h in (low, middle, high)]
    a, b, c = (np.stack(q[:2]) for q in p)
    a, c = (q - 2 * np.pi * np.rint((q - b) / (2 * np.pi)) for q in (a, c))
    slope, bend = (c - a) / 2, (a + c) / 2 - b
    mean = float(np.nanmean(found))
    h = np.where(known, found, mean)
    for _ in range(_ROUNDS):
        u = np.clip((h - middle) / half, -1.5, 1.5)
        latitude, longitude = b + slope * u + bend * u * u
        there = np.asarray(terrain(latitude, longitude), np.float64)
        rise = np.where(np.isfinite(there), there, mean) - h
        h = h + 0.7 * rise
        if np.abs(rise).max() < _CLOSE:
            break
    return latitude, longitude, h


def placed(
    reference: Reference, terrain: Height, match: Match, view: View, sigma: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Place (3,) [m] of a match on the terrain, and the covariance (3, 3) [m^2] of its error.

    Parameters
    ----------
    reference : Reference
    terrain : callable
        Height [m] at latitudes and longitudes [rad].
    match : Match
    view : View
        Of who sees it.
    sigma : ndarray, shape (3,)
        Errors of the reference's places along the track and across it, and of its heights [m].

    Raises
    ------
    ValueError
        If it is outside the reference's tie points, or its height is not known.
    """

    def at(row: float, column: float, rise: float = 0.0) -> FloatArray:
        def raised(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
            return np.asarray(terrain(latitude, longitude) + rise)

        return ecef(*reference.place_on(raised, row, column))

    p = at(match.row, match.column)
    J = np.empty((3, 2))
    for k, knots in enumerate((reference.rows, reference.columns)):
        ends = []
        for sign in (1, -1):
            pixel = np.array([match.row, match.column])
            pixel[k] = np.clip(pixel[k] + sign * _PIXELS, knots[0], knots[-1])
            ends.append((pixel[k], at(*pixel)))
        J[:, k] = (ends[0][1] - ends[1][1]) / (ends[0][0] - ends[1][0])
    along, across, up = track_axes(p, view.v)
    D = J @ match.covariance @ J.T
    axes = [(sigma[0], along), (sigma[1], across)]
    if reference.tells_heights:
        raised, lowered = (at(match.row, match.column, s * _RISE) for s in (1, -1))
        axes.append((sigma[2], (raised - lowered) / (2 * _RISE)))
    else:
        one_range = np.cross(view.v, view.r - p)
        axes += [(sigma[2], up), (sigma[2], one_range / float(one_range @ up) - up)]
    for s, u in axes:
        D += s * s * np.outer(u, u)
    return p, D
