r"""The shore of a lake that is seen in part: matched to the catalog, and what that measures.

A contour that leaves the frame has moments of its own; its shore still lies where the catalog's
does. `match_shores` looks from the prior, follows normals of the predicted outline to the contour
(`terrafix.models.images.shore`), and corrects the prior by Gauss-Newton steps until the
correspondence of both no longer changes,

.. math:: \hat x = \arg\min \sum_j (z_j - w_j(x))^2 + (x - x_0)^T P_0^{-1} (x - x_0).

From a prior of many pixels the outline is searched first, over the shifts and scales that the
prior allows. Told to the filter is not that estimate, which the prior is part of, but six weighted
sums of the observed pixels, :math:`y = \sum_k W_k p_k`, and the weights: what the same sums of the
catalog's outline are in the frame, :math:`\sum_k W_k \pi_k(x)`, is a smooth function of the
estimate, without a search in it, that any rule may iterate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.filters.ensembles import Arrays, EnsembleObservation
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.lake import (
    CATALOG,
    Look,
    both_at_once,
    outlines_seen,
    state_columns,
)
from terrafix.models.images.shore import ELEMENTS, Crossings, Weights, crossings, places, weights
from terrafix.models.sensors.camera import CAMERA, Seen

MOST_VERTICES = 256
"""Of an outline that looks are matched to."""

SHORE = {f"sum_{k}": "1" for k in range(ELEMENTS)}
"""Measured elements: weighted sums of pixels of the shore, in sigmas of their noise."""

SHORE_REASONS = ("", "too little shore", "not found", "more than one place")
"""Why a shore is not matched."""

_STEPS = 12
_STILL = 0.05
"""Movement of the outline at which the correspondence is kept [px]."""
_KNOWN = 0.2
"""Uncertainty of the outline up to which the prior's correspondence is taken [px]."""
_NARROW = 12.0
"""Uncertainty of the outline up to which its shore is found along normals [px]."""
_LEAST, _LEAST_SEARCHED = 24, 80
"""Segments of shore that must be seen: where it is expected, and where it must be searched."""
_SHARE = 0.8
"""Of the shore that was seen: how much must be matched."""
_LOOSE = 3.0
"""Noise of an outline that was placed by a search [px]."""
_REACH = 4.5
"""How far it is searched, in standard deviations of the prior."""
_CLEARLY = 4.0
"""How many times the mean square of the best must be that of another place."""
_SAME = 1.0
"""Distance of outlines up to which they are one place [px]."""
_LOOSELY, _CATALOG = 1.5, 0.5
"""Distances left of a match at most: in sigmas of the contour, and for the catalog's error [px]."""


@dataclass(frozen=True, eq=False)
class Shore:
    """A contour of a lake, as a camera saw it.

    Parameters
    ----------
    contour : ndarray, shape (M, 2) [px]
    shown : ndarray of bool, shape (M,)
        Which segments, from vertex k to k + 1, are a shore that was seen.
    sigma : float
        Of every coordinate of every vertex [px], positive.
    """

    contour: FloatArray
    shown: NDArray[np.bool_]
    sigma: float


@dataclass(frozen=True, eq=False)
class _Fit:
    """A match, the outline that it places, and the mean square of the distances left [px^2]."""

    match: Weights
    outline: FloatArray
    cost: float


class _Camera:
    """What one camera sees of one outline, from any estimate of one member."""

    def __init__(self, given: Mapping[str, FloatArray], points: FloatArray, center: FloatArray):
        self._given, self._points, self._center = given, points, center

    def __call__(self, x: FloatArray) -> Seen:
        values = {"r": x[None, :3], "v": x[None, 3:6]}
        return Seen(values, self._given, self._points, self._center)


def match_shores(
    x0: FloatArray,
    P0: FloatArray,
    given: Mapping[str, FloatArray],
    points: FloatArray,
    center: FloatArray,
    shores: Sequence[Shore],
) -> list[Weights | str]:
    """Recognize the shore of one lake on what k cameras saw, each from a prior of its own.

    Parameters
    ----------
    x0 : ndarray, shape (k, 6)
        Position [m] and velocity [m/s], inertial.
    P0 : ndarray, shape (k, 6, 6)
    given : mapping of str to ndarray, shape (k, size)
        As `Seen` takes it.
    points : ndarray, shape (K, 3)
        Of the catalog, Earth-fixed [m].
    center : ndarray, shape (3,)
    shores : sequence of Shore
        What each saw.

    Returns
    -------
    list of Weights or str
        Or which of `SHORE_REASONS` keeps it from being one.
    """
    seen = Seen({"r": x0[:, :3], "v": x0[:, 3:]}, given, points, center)
    spread = _spread(seen, P0)
    found: list[Weights | str] = ["not found"] * len(shores)
    known = []
    for k, shore in enumerate(shores):
        if shore.shown.sum() < _LEAST:
            found[k] = "too little shore"
        elif seen.depth[k].min() <= 0:
            continue
        elif spread[k].max() < _KNOWN:  # the shores correspond as they are
            known.append(k)
        else:
            own = {name: values[k : k + 1] for name, values in given.items()}
            look = _Camera(own, points, center)
            found[k] = _match(look, x0[k], P0[k], spread[k], shore)
    if known:
        for k, near in zip(known, _near(seen.pixels, spread, shores, known), strict=True):
            fit = _judged(seen.pixels[k], near, shores[k])
            found[k] = fit if isinstance(fit, str) else fit.match
    return found


def _near(
    outlines: FloatArray, spread: FloatArray, shores: Sequence[Shore], known: Sequence[int]
) -> list[Crossings]:
    """Where shores that correspond as they are lie by their outlines (k, K, 2)."""
    told = [shores[k] for k in known]
    return crossings(
        list(outlines[known]),
        [shore.contour for shore in told],
        [shore.shown for shore in told],
        [4 * spread[k].max() + 4 * shores[k].sigma + _CATALOG for k in known],
    )


def _match(
    look: _Camera, x0: FloatArray, P0: FloatArray, spread: FloatArray, shore: Shore
) -> Weights | str:
    """Recognize a shore whose outline must be moved first."""
    information: FloatArray = np.linalg.inv(P0).astype(np.float64)
    if spread.max() < _NARROW:
        fit = _fit(look, x0, x0, information, shore, 4 * spread.max() + 4 * shore.sigma)
        return fit if isinstance(fit, str) else fit.match
    if shore.shown.sum() < _LEAST_SEARCHED:
        return "too little shore"
    fits = [
        fit
        for start in _starts(look, x0, P0, spread, information, shore)
        if not isinstance(fit := _fit(look, x0, start, information, shore, _NARROW), str)
    ]
    if not fits:
        return "not found"
    best = min(fits, key=lambda fit: fit.cost)
    for fit in fits:
        apart = np.abs(fit.outline - best.outline).max() > _SAME
        if apart and fit.cost < _CLEARLY * best.cost:
            return "more than one place"
    return best.match


def _spread(seen: Seen, P: FloatArray) -> FloatArray:
    """Standard deviations (k, 2) of the middle of an outline in the frame [px], of P (k, 6, 6)."""
    k, n = seen.depth.shape
    mean = np.zeros((k, 2, n, 2))
    mean[:, 0, :, 0] = mean[:, 1, :, 1] = 1 / n
    H = seen.derivative(mean)[..., :6]
    return np.asarray(np.sqrt(np.sum(H @ P * H, axis=2)))


def _starts(
    look: _Camera,
    x0: FloatArray,
    P0: FloatArray,
    spread: FloatArray,
    information: FloatArray,
    shore: Shore,
) -> list[FloatArray]:
    """Estimates from which the predicted outline lies near the one that was seen."""
    seen = look(x0)
    outline = seen.pixels[0]
    depth = float(seen.depth.mean())
    down = x0[:3] / np.linalg.norm(x0[:3])
    stretch = _REACH * np.sqrt(down @ P0[:3, :3] @ down) / depth
    n = max(1, int(np.ceil(np.ptp(outline, axis=0).max() * stretch / _NARROW)))
    scales = np.exp(np.linspace(-1, 1, 2 * n + 1) * np.log1p(stretch))
    points = (shore.contour + np.roll(shore.contour, -1, axis=0))[shore.shown] / 2
    found = places(outline, points, _REACH * spread, scales)
    middle = outline.mean(axis=0)
    starts = []
    for shift, scale in zip(found.shift, found.scale, strict=True):
        target = middle + shift + scale * (outline - middle)
        x = x0
        for _ in range(_STEPS):
            now = look(x)
            every = np.eye(target.size).reshape(1, -1, *target.shape)
            H = now.derivative(every)[0, :, :6]
            gain = H.T / _LOOSE**2
            step = np.linalg.solve(
                information + gain @ H,
                gain @ (target - now.pixels[0]).ravel() - information @ (x - x0),
            )
            x = x + step
            if np.abs(H @ step).max() < _STILL:
                break
        starts.append(x)
    return starts


def _fit(
    look: _Camera,
    x0: FloatArray,
    start: FloatArray,
    information: FloatArray,
    shore: Shore,
    reach: float,
) -> _Fit | str:
    """Correct a start until the shores correspond."""
    x, close = start, 4 * shore.sigma + 0.5
    n = len(shore.contour)
    for _ in range(_STEPS):
        seen = look(x)
        outline = seen.pixels[0]
        (found,) = crossings([outline], [shore.contour], [shore.shown], [reach])
        if len(found.edge) < _LEAST:
            return "not found"
        told = weights(found, outline, shore.sigma, n)
        H = seen.derivative(told.of_vertices[None])[0, :, :6]
        residual = told.value - _sums(told.of_vertices[None], outline[None])[0]
        step = np.linalg.solve(information + H.T @ H, H.T @ residual - information @ (x - x0))
        moved = np.abs(_moved(seen, step)).max()
        if moved < _STILL and reach <= 2 * close:
            return _judged(outline, found, shore)
        x = x + step
        reach = max(close, min(reach, 3 * moved + close)) if moved < reach else reach
    return "not found"


def _moved(seen: Seen, step: FloatArray) -> FloatArray:
    """How far a step moves the ends of an outline [px], to first order."""
    pixels = seen.pixels[0]
    corners = [*pixels.argmin(axis=0), *pixels.argmax(axis=0)]
    by = np.zeros((1, 2 * len(corners), len(pixels), 2))
    for k, vertex in enumerate(corners):
        by[0, 2 * k, vertex, 0] = by[0, 2 * k + 1, vertex, 1] = 1.0
    return seen.derivative(by)[0, :, :6] @ step


def _judged(outline: FloatArray, found: Crossings, shore: Shore) -> _Fit | str:
    """A match, if most of the shore that was seen is matched, and closely."""
    if len(found.edge) < _LEAST:
        return "not found"
    cost = float(np.mean(found.distance**2))
    alike = min(1.0, len(outline) / len(shore.contour))
    share = np.bincount(found.segment).astype(np.bool_).sum() / (alike * shore.shown.sum())
    if share < _SHARE or cost > (_LOOSELY * shore.sigma + _CATALOG) ** 2:
        return "not found"
    return _Fit(weights(found, outline, shore.sigma, len(shore.contour)), outline, cost)


def _sums(W: FloatArray, pixels: FloatArray) -> FloatArray:
    """Weighted sums (k, 6) of pixels (k, K, 2), with weights (k, 6, K, 2)."""
    k = len(W)
    return np.asarray(np.matmul(W.reshape(k, ELEMENTS, -1), pixels.reshape(k, -1, 1))[..., 0])


def shore_observation(state: ErrorState) -> EnsembleObservation:
    """Weighted sums of the pixels of a lake's shore, with the weights of the fix.

    Of blocks of `terrafix.models.filters.lake.CONSIDERED`, whichever `state` has.
    """
    columns = state_columns(state)

    def looks(values: Arrays, given: Arrays) -> Iterator[Look]:
        shores = {name: told for name, told in given.items() if name != "owner"}
        for rows, seen, _ in outlines_seen(values, shores):
            W = given["weights"][rows].reshape(-1, ELEMENTS, MOST_VERTICES, 2)
            W = W[:, :, : seen.pixels.shape[1]]
            yield rows, _sums(W, seen.pixels), seen.derivative(W)[..., columns]

    predict, derivative = both_at_once(looks, ELEMENTS, state.size)
    return EnsembleObservation(
        predict,
        SHORE,
        derivative=derivative,
        fields=[
            vector("lake", 1),
            vector("weights", ELEMENTS * MOST_VERTICES * 2, unit="1/px"),
        ],
        parameters=CAMERA,
        shared=CATALOG,
    )
