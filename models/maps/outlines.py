r"""Outlines of lakes: rings of geodetic longitude and latitude, their area, center and points.

Edges are great circles of the authalic sphere, whose areas are those of the ellipsoid. A point of
geodetic latitude :math:`\varphi` lies on it at the authalic latitude :math:`\beta`,

.. math::
    \sin\beta = \frac{q(\varphi)}{q(\pi/2)}, \qquad
    q(\varphi) = (1 - e^2) \left( \frac{\sin\varphi}{1 - e^2 \sin^2\varphi}
                 + \frac{1}{e} \operatorname{artanh}(e \sin\varphi) \right), \qquad
    R^2 = \tfrac12 a^2 q(\pi/2).

With unit vectors :math:`p_k` of the vertices, :math:`\theta_k` the angle between neighbors and
:math:`c` any direction near the lake, the vector area :math:`S` and the area :math:`A` are

.. math::
    S = \tfrac12 \sum_k \theta_k \frac{p_k \times p_{k+1}}{\lVert p_k \times p_{k+1} \rVert}, \qquad
    A = R^2 \sum_k 2 \arctan \frac{c \cdot \left( (p_k - c) \times (p_{k+1} - c) \right)}
        {1 + c \cdot p_k + p_k \cdot p_{k+1} + p_{k+1} \cdot c}.

:math:`S` is the mean direction of the surface times its area: the center lies in it, exactly.
Vectors know no date line and no pole. The lake is the smaller side of its ring. Between these
edges and geodesics of the ellipsoid, or straight lines of a map, lie centimeters where vertices
are 600 m apart.

References
----------
.. [1] J. P. Snyder, "Map Projections: A Working Manual", USGS Professional Paper 1395, 1987,
       eq. (3-11) to (3-13).
.. [2] A. Van Oosterom, J. Strackee, "The Solid Angle of a Plane Triangle", IEEE Transactions on
       Biomedical Engineering 30(2), 1983, eq. (8).
.. [3] RFC 7946, "The GeoJSON Format", 2016: sections 3.1.6 (orientation) and 3.1.9 (180 degrees).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef

_E = float(np.sqrt(EARTH.flattening * (2 - EARTH.flattening)))
_BLOCK = 32
"""Edges tested together for crossings; neighbors along a ring are neighbors in space."""
_WIDEST = np.cos(np.radians(60.0))
"""Of the angle from the center of a ring to its farthest vertex."""
_THINNEST, _ROUNDING = 1e-9, 1e-15
"""Of squared perimeter, and of perimeter: area below which a ring is a line."""


def _q(sine: FloatArray) -> FloatArray:
    return np.asarray(
        (1 - _E**2) * (sine / (1 - (_E * sine) ** 2) + np.arctanh(_E * sine) / _E), np.float64
    )


_Q_POLE = float(_q(np.array(1.0)))
AUTHALIC_RADIUS = float(EARTH.radius * np.sqrt(_Q_POLE / 2))
"""Radius of the sphere with the area of the ellipsoid [m]."""


def authalic_vectors(longitude: ArrayLike, latitude: ArrayLike) -> FloatArray:
    """Unit vectors (..., 3) of geodetic places [rad] on the authalic sphere."""
    longitude, latitude = np.broadcast_arrays(longitude, latitude)
    sine = np.clip(_q(np.sin(latitude)) / _Q_POLE, -1.0, 1.0)
    cosine = np.sqrt((1 - sine) * (1 + sine))
    return np.stack([cosine * np.cos(longitude), cosine * np.sin(longitude), sine], axis=-1)


def _geodetic(p: FloatArray) -> tuple[float, float]:
    """Longitude and geodetic latitude [rad] of a vector, any length, by Newton's method."""
    x, y, z = (float(c) for c in p / np.linalg.norm(p))
    latitude = float(np.arctan2(z, np.hypot(x, y)))
    for _ in range(8):
        sine, cosine = float(np.sin(latitude)), float(np.cos(latitude))
        if cosine < 1e-9:
            break
        slope = 2 * (1 - _E**2) * cosine / (1 - (_E * sine) ** 2) ** 2
        latitude += (z * _Q_POLE - float(_q(np.array(sine)))) / slope
    return float(np.arctan2(y, x)), latitude


def _vector_area(p: FloatArray) -> FloatArray:
    """Integral of the direction over what a ring of unit vectors (K, 3) encloses."""
    ahead = np.roll(p, -1, axis=0)
    cross = np.cross(p, ahead - p)  # small where the edge is: no loss of digits
    sine = np.linalg.norm(cross, axis=1)
    angle = np.arctan2(sine, np.einsum("ij,ij->i", p, ahead))
    ratio = np.divide(angle, sine, out=np.ones_like(sine), where=sine > 0)
    return np.asarray(0.5 * (ratio[:, None] * cross).sum(axis=0))


def _enclosed(p: FloatArray, c: FloatArray) -> float:
    """Area on the unit sphere that a ring of unit vectors encloses, counterclockwise positive."""
    ahead = np.roll(p, -1, axis=0)
    triple = np.cross(p - c, ahead - c) @ c
    rest = 1 + p @ c + np.einsum("ij,ij->i", p, ahead) + ahead @ c
    return float(2 * np.arctan2(triple, rest).sum())


def _plane(p: FloatArray, c: FloatArray) -> FloatArray:
    """Gnomonic projection about a direction: great circles are straight; shape (..., 2)."""
    axis = np.eye(3)[int(np.argmin(np.abs(c)))]
    right = np.cross(axis, c)
    right /= np.linalg.norm(right)
    up = np.cross(c, right)
    d = p - c
    return np.asarray(np.stack([d @ right, d @ up], axis=-1) / (p @ c)[..., None])


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Positive where a to b to c turns left."""
    u, v = b - a, c - a
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def _pairs(low: FloatArray, high: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs (i <= j) of boxes (n, 2) that overlap."""
    found_i, found_j = [], []
    for i in range(len(low)):
        meets = np.all((low[i:] <= high[i]) & (high[i:] >= low[i]), axis=1)
        (j,) = np.nonzero(meets)
        found_i.append(np.full(len(j), i))
        found_j.append(j + i)
    return np.concatenate(found_i), np.concatenate(found_j)


def crossing(xy: FloatArray) -> tuple[int, int] | None:
    """Two edges of a ring (K, 2) in a plane that cross, or None. Edge k starts at vertex k.

    Edges that only touch do not cross, unless the ring passes through itself in a vertex.
    """
    n = len(xy)
    ahead = np.roll(xy, -1, axis=0)
    low, high = np.minimum(xy, ahead), np.maximum(xy, ahead)
    starts = np.arange(0, n, _BLOCK)
    blocks = _pairs(np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts))
    inner = np.arange(_BLOCK)
    for begin in range(0, len(blocks[0]), 256):
        i, j = (starts[b[begin : begin + 256]] for b in blocks)
        i, j = np.broadcast_arrays(
            i[:, None, None] + inner[:, None], j[:, None, None] + inner[None, :]
        )
        i, j = i.ravel(), j.ravel()
        ordered = (i < j) & (j < n)
        i, j = i[ordered], j[ordered]
        near = np.all((low[i] <= high[j]) & (low[j] <= high[i]), axis=1)
        i, j = i[near], j[near]
        a, b, c, d = xy[i], ahead[i], xy[j], ahead[j]
        apart = (_turn(a, b, c) * _turn(a, b, d) < 0) & (_turn(c, d, a) * _turn(c, d, b) < 0)
        if apart.any():
            k = int(np.argmax(apart))
            return int(i[k]), int(j[k])
    return _passing(xy)


def _passing(xy: FloatArray) -> tuple[int, int] | None:
    """Two visits of a ring to one vertex between which it passes through itself, or None."""
    _, inverse, counts = np.unique(xy, axis=0, return_inverse=True, return_counts=True)
    n = len(xy)
    inverse = inverse.ravel()
    for point in np.flatnonzero(counts > 1):
        visits = [int(k) for k in np.flatnonzero(inverse == point)]
        angles = {}
        for k in visits:
            steps = (xy[(k + 1) % n] - xy[k], xy[k - 1] - xy[k])
            angles[k] = [float(np.arctan2(s[1], s[0])) for s in steps]
        for a, i in enumerate(visits):
            for j in visits[a + 1 :]:
                sector = (angles[i][1] - angles[i][0]) % (2 * np.pi)
                inside = [0 < (t - angles[i][0]) % (2 * np.pi) < sector for t in angles[j]]
                if inside[0] != inside[1]:
                    return i, j
    return None


def _inside(xy: FloatArray, point: FloatArray) -> NDArray[np.bool_]:
    """Whether points (..., 2) are within a ring (K, 2) of a plane, by counting crossings."""
    ahead = np.roll(xy, -1, axis=0)
    x, y = point[..., None, 0], point[..., None, 1]
    spans = (xy[:, 1] > y) != (ahead[:, 1] > y)
    rise = np.where(spans, ahead[:, 1] - xy[:, 1], 1.0)
    at = xy[:, 0] + (y - xy[:, 1]) * (ahead[:, 0] - xy[:, 0]) / rise
    return np.asarray((spans & (x < at)).sum(axis=-1) % 2 == 1)


def wrapped(longitude: ArrayLike) -> FloatArray:
    """Longitudes [rad] in (-pi, pi]; those that are within are left to the last bit."""
    longitude = np.asarray(longitude, np.float64)
    turns = np.ceil((longitude - np.pi) / (2 * np.pi))
    return np.asarray(np.where(turns == 0, longitude, longitude - 2 * np.pi * turns))


def _place(ring: FloatArray, k: int) -> str:
    longitude, latitude = np.degrees(ring[k])
    return f"longitude {longitude:.5f}, latitude {latitude:.5f} deg"


def ring_from_degrees(degrees: ArrayLike, what: str, *, closed: bool = True) -> FloatArray:
    """Ring of a file: longitude, latitude (K, 2) [deg] to [rad], checked and opened.

    Parameters
    ----------
    degrees : array_like, shape (K, 2)
    what : str
        Whose ring it is, for errors.
    closed : bool
        Whether the format repeats the first point at the end.

    Raises
    ------
    ValueError
        If it is not closed though its format says so, is not finite, or holds no degrees.
    """
    ring = np.asarray(degrees, np.float64)
    if ring.ndim != 2 or ring.shape[1] != 2:
        raise ValueError(f"{what} needs longitude and latitude of each point")
    if not len(ring):
        raise ValueError(f"{what} has a ring without points")
    _check_degrees(ring, what)
    if closed:
        if (ring[0] != ring[-1]).any():
            raise ValueError(
                f"{what} is open: it starts at {_place(np.radians(ring), 0)}, and ends at "
                f"{_place(np.radians(ring), -1)}\n  repeat the first point at the end; "
                "a file that was cut off looks like this, too"
            )
        ring = ring[:-1]
    return np.radians(ring)


def _check_degrees(ring: FloatArray, what: str) -> None:
    wrong = ~np.isfinite(ring).all(axis=1)
    if wrong.any():
        raise ValueError(
            f"{what}: {int(wrong.sum())} of its {len(ring)} points are not finite, the first is "
            f"point {int(np.argmax(wrong)) + 1}"
        )
    longitude, latitude = np.abs(ring).T
    if (longitude > 1000).any() or (latitude > 1000).any():
        k = int(np.argmax(np.maximum(longitude, latitude) > 1000))
        raise ValueError(
            f"{what} is in meters of a projection, not in degrees: point {k + 1} is "
            f"({ring[k, 0]:.10g}, {ring[k, 1]:.10g})\n"
            "  convert it to longitude and latitude of WGS-84 (ogr2ogr -t_srs EPSG:4326)"
        )
    if (latitude > 90).any():
        k = int(np.argmax(latitude > 90))
        swapped = "; longitude stands first" if (longitude <= 90).all() else ""
        raise ValueError(
            f"{what}: the latitude of point {k + 1} is {ring[k, 1]:.10g} deg, beyond 90{swapped}"
        )
    if (longitude > 540).any():
        k = int(np.argmax(longitude > 540))
        raise ValueError(f"{what}: the longitude of point {k + 1} is {ring[k, 0]:.10g} deg")


def _cleaned(given: ArrayLike, what: str, *, outer: bool) -> FloatArray:
    """Ring without closing, repeated and out-and-back vertices, turned as `Outline` says."""
    ring = np.array(given, np.float64)
    if ring.ndim != 2 or ring.shape[1] != 2:
        raise ValueError(f"{what} needs longitude and latitude of each point")
    _check_degrees(np.degrees(ring), what)
    ring[:, 0] = wrapped(ring[:, 0])
    p = authalic_vectors(ring[:, 0], ring[:, 1])
    given_points = len(np.unique(p, axis=0))
    while len(ring) > 1:
        behind, ahead = np.roll(p, 1, axis=0), np.roll(p, -1, axis=0)
        drop = (p == behind).all(axis=1)
        if drop[0]:  # closed: the first vertex stays the first
            drop[:] = False
            drop[-1] = True
        elif not drop.any():
            back = (behind == ahead).all(axis=1)
            drop[np.argmax(back)] = back.any()
        if not drop.any():
            break
        ring, p = ring[~drop], p[~drop]
    if len(np.unique(p, axis=0)) < 3:
        lines = "" if given_points < 3 else " on a line that runs out and back"
        raise ValueError(
            f"{what} has {given_points} distinct points{lines}, and a ring has at least three\n"
            "  leave it out, or export the lake as a polygon"
        )
    s = _vector_area(p)
    size = float(np.linalg.norm(s))
    perimeter = float(np.linalg.norm(p - np.roll(p, -1, axis=0), axis=1).sum())
    middle = p.mean(axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-300)
    if (p @ middle).min() < _WIDEST:
        raise ValueError(f"{what} reaches over more of the Earth than a lake can")
    found = crossing(_plane(p, middle))
    if found is not None:
        i, j = found
        raise ValueError(
            f"{what} crosses itself: near {_place(ring, i)} and {_place(ring, j)}\n"
            "  mend it, as with ogr2ogr -makevalid, or leave it out"
        )
    if size <= _THINNEST * perimeter**2 + _ROUNDING * perimeter or _straight(ring):
        raise ValueError(f"{what} has no area: its points lie on a line")
    if (float(s @ middle) > 0) != outer:
        ring = ring[::-1]
    return np.ascontiguousarray(ring)


def _straight(ring: FloatArray) -> bool:
    """Whether points lie on a straight line of longitude and latitude."""
    d = ring - ring[0]
    d[:, 0] = wrapped(d[:, 0])
    if np.ptp(d[:, 0]) >= np.pi:  # around a pole
        return False
    spread = np.linalg.svd(d - d.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= _THINNEST * spread[0])


@dataclass(frozen=True, eq=False)
class Outline:
    """Shoreline of a lake and of its islands, cleaned.

    Seen from above the outer ring runs counterclockwise and islands run clockwise (RFC 7946), so
    that signed areas add up to the water. No vertex is repeated, at the end neither. Vertices
    where the ring runs out and straight back (along 180 degrees to a pole) are dropped.

    Parameters
    ----------
    name : str
        What messages call it.
    outer : ndarray, shape (K, 2)
        Longitude, latitude [rad] of WGS-84, in either direction.
    islands : sequence of ndarray, shape (K, 2)
        Rings within it [rad].
    height : float
        Of the surface above the ellipsoid [m].

    Raises
    ------
    ValueError
        If a ring crosses itself, has fewer than three distinct points or no area, is not finite,
        is not in angles, or an island is no part of the lake.
    """

    name: str
    outer: FloatArray
    islands: Sequence[FloatArray] = ()
    height: float = 0.0

    def __post_init__(self) -> None:
        whose = f"the outline of '{self.name}'"
        object.__setattr__(self, "outer", _cleaned(self.outer, whose, outer=True))
        islands = tuple(
            _cleaned(ring, f"island {k + 1} of '{self.name}'", outer=False)
            for k, ring in enumerate(self.islands)
        )
        object.__setattr__(self, "islands", islands)
        if not np.isfinite(self.height):
            raise ValueError(f"{whose}: its height is {self.height} m")
        for k, ring in enumerate(islands):
            # the first vertex mostly answers for all
            if not (self.contains(*ring[0]) or self.contains(*ring.T).any()):
                raise ValueError(
                    f"island {k + 1} of '{self.name}' lies outside of it, at {_place(ring, 0)}"
                )
        if not self.area > 0:
            raise ValueError(f"the islands of '{self.name}' cover more than the lake")

    @cached_property
    def _vectors(self) -> FloatArray:
        return authalic_vectors(self.outer[:, 0], self.outer[:, 1])

    @cached_property
    def _middle(self) -> FloatArray:
        s = _vector_area(self._vectors)
        return np.asarray(s / np.linalg.norm(s))

    @cached_property
    def outer_area(self) -> float:
        """Within the outer ring, islands included, on the ellipsoid [m^2]."""
        return _enclosed(self._vectors, self._middle) * AUTHALIC_RADIUS**2

    @cached_property
    def area(self) -> float:
        """Of the water, islands not included, on the ellipsoid [m^2]."""
        rings = (authalic_vectors(r[:, 0], r[:, 1]) for r in self.islands)
        islands = sum(_enclosed(p, self._middle) for p in rings)  # clockwise: negative
        return self.outer_area + islands * AUTHALIC_RADIUS**2

    @cached_property
    def centroid(self) -> tuple[float, float]:
        """Longitude and latitude [rad] of the mean direction within the outer ring."""
        return _geodetic(self._middle)

    @cached_property
    def points(self) -> FloatArray:
        """Vertices of the outer ring (K, 3) [m], Earth-fixed, at the height of the lake."""
        return ecef(self.outer[:, 1], self.outer[:, 0], self.height)

    @cached_property
    def island_points(self) -> tuple[FloatArray, ...]:
        """Vertices of each island (K, 3) [m], Earth-fixed, at the height of the lake."""
        return tuple(ecef(ring[:, 1], ring[:, 0], self.height) for ring in self.islands)

    @cached_property
    def circle(self) -> tuple[FloatArray, float]:
        """Center (3,) [m], Earth-fixed, over the centroid, and radius [m] to the farthest vertex.

        The straight edges between vertices lie within, too.
        """
        longitude, latitude = self.centroid
        center = ecef(latitude, longitude, self.height)
        return center, float(np.linalg.norm(self.points - center, axis=1).max())

    def contains(self, longitude: ArrayLike, latitude: ArrayLike) -> NDArray[np.bool_]:
        """Whether places (...) [rad] are within the outer ring."""
        p = authalic_vectors(longitude, latitude)
        ahead = p @ self._middle > _WIDEST / 2
        p = np.where(ahead[..., None], p, self._middle)
        ring = _plane(self._vectors, self._middle)
        return np.asarray(ahead & _inside(ring, _plane(p, self._middle)))


def rings_of(
    lake: int, starts: NDArray[np.int64], owner: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.intp], tuple[int, ...]]:
    """Which vertices of a catalog are those of a lake: its shore, then its islands.

    Parameters
    ----------
    lake : int
    starts : ndarray of int, shape (R + 1,)
        Where rings start in the vertices, and where the last one ends; lake k's shore is ring k.
    owner : ndarray of int, shape (R,), optional
        Lake of each ring; without it the shore alone.

    Returns
    -------
    ndarray of int
    tuple of int
        Where among them the rings start.
    """
    rings = [lake] if owner is None else [int(k) for k in np.flatnonzero(owner == lake)]
    parts = [np.arange(starts[k], starts[k + 1]) for k in rings]
    begins = np.cumsum([0, *(len(part) for part in parts[:-1])])
    return np.concatenate(parts), tuple(int(k) for k in begins)


def joined(parts: Sequence[Sequence[FloatArray]], what: str) -> list[list[FloatArray]]:
    """Polygons with the cuts along 180 degrees undone, which RFC 7946 (3.1.9) asks of writers.

    Edges along that meridian which two parts run through in opposite directions are no shore.

    Parameters
    ----------
    parts : sequence of sequences of ndarray, shape (K, 2)
        Polygons: rings of longitude, latitude [rad], the outer one first.
    what : str
        Whose they are, for errors.

    Raises
    ------
    ValueError
        If parts meet in 180 degrees but do not fit.
    """
    east = [_on_seam(part, np.pi) for part in parts]
    west = [_on_seam(part, -np.pi) for part in parts]
    cut = [k for k in range(len(parts)) if east[k] or west[k]]
    if not (any(east) and any(west)):
        return [list(part) for part in parts]
    runs: set[tuple[tuple[float, float], tuple[float, float]]] = set()
    for k in cut:
        ring = _cleaned(parts[k][0], what, outer=True)
        here = [(float(lon), float(lat)) for lon, lat in ring]
        runs.update(zip(here, here[1:] + here[:1], strict=True))
    shore = [(a, b) for a, b in runs if (b, a) not in runs]
    edges = dict(sorted(shore))
    if len(edges) < len(shore) or any(a[0] == b[0] == np.pi for a, b in shore):
        raise ValueError(f"{what} is cut at 180 deg into parts that do not fit together")
    rings = []
    while edges:
        start, at = edges.popitem()
        ring_of = [start]
        while at != start:
            ring_of.append(at)
            if at not in edges:
                raise ValueError(f"{what} is cut at 180 deg into parts that do not fit together")
            at = edges.pop(at)
        rings.append(np.array(ring_of))
    sizes = [float(np.linalg.norm(_vector_area(authalic_vectors(*r.T)))) for r in rings]
    rings = [rings[k] for k in np.argsort(sizes)[::-1]]
    islands = [ring for k in cut for ring in parts[k][1:]]
    whole = [[rings[0], *rings[1:], *islands]]
    return whole + [list(part) for k, part in enumerate(parts) if k not in cut]


def _on_seam(part: Sequence[FloatArray], longitude: float) -> bool:
    """Whether an edge of a polygon's outer ring runs along a meridian [rad]."""
    on = np.asarray(part[0])[:, 0] == longitude
    return bool((on & np.roll(on, -1)).any())
