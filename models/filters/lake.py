r"""A satellite's filter that knows lakes: what it estimates, and what its camera measures.

State: position and velocity, inertial; where they are considered, the camera's misalignment about
its own axes, the scale by which the catalog's outlines are too small, and what the catalog's
vertices are off. Gravity with the second zonal harmonic, white acceleration of density :math:`Q_a`.

Measured are the six moments of an outline in the frame: area, centroid, second central moments. A
vertex :math:`q_k`, Earth-fixed, lies at :math:`d_k = C q_k - o` in camera axes, whose rotation
:math:`C` and offset :math:`o` depend on the estimate alone; its pixel :math:`p_k` depends on
:math:`d_k`, and the moments :math:`m` on all pixels. With :math:`G_k = (\partial m / \partial p_k)
(\partial p_k / \partial d_k)` the derivative is two sums over the vertices,

.. math::
    H = \Bigl( \sum_k G_k \otimes q_k \Bigr) \frac{\partial C}{\partial x}
        - \Bigl( \sum_k G_k \Bigr) \frac{\partial o}{\partial x},

each factor derived symbolically.

A catalog whose vertices are off, each by itself by :math:`\sigma` per axis, biases all six moments,
constantly but for the slow change of the view, with the covariance :math:`\sigma^2 \sum_k G_k
G_k^T`. Let :math:`L` be the Cholesky factor of the sum: the bias is :math:`L b`, and b has six
independent elements of :math:`\sigma`. These are considered, not the vertices.

References
----------
.. [1] "Spacecraft position estimation in LEO using terrain relative Kalman filtering". We differ:
       the Earth turns between frames (2.4 km in 7 s); the covariance of the measurement is that of
       the contour's noise, with its correlations; second moments are measured, too, which tell the
       yaw from the cross-track velocity; the update is iterated, without which so small a noise
       diverges from 70 km.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.filters.ensembles import Arrays, EnsembleObservation
from terrafix.models.filters.error_state import Carried, ErrorState, considered, vector
from terrafix.models.filters.measurement import TIME
from terrafix.models.filters.process import Process
from terrafix.models.geometry.earth import EARTH
from terrafix.models.images.polygons import moments
from terrafix.models.maps.outlines import rings_of
from terrafix.models.motion.gravity import j2_acceleration
from terrafix.models.motion.kepler import coasted, coasting
from terrafix.models.sensors.camera import CAMERA, POINTING, STATE_SIZES, Seen

COASTING = Carried(
    ("r", "v"),
    lambda x, time: ca.vertcat(*coasted(x[:3], x[3:], time, EARTH.mu)),
    lambda x, time: coasting(x[:3], x[3:], time, EARTH.mu),
)
"""Errors bend along an orbit: they are those at the last look, carried by two-body motion."""

ORBIT = ErrorState(
    vector("r", unit="m", frame="i"), vector("v", unit="m/s", frame="i"), carried=COASTING
)
"""Position and velocity, inertial."""

CONSIDERED = ErrorState(
    *ORBIT,
    considered(vector("attitude", unit="rad", frame="c")),
    considered(vector("scale", 1)),
    considered(vector("outline", 6, unit="m")),
    carried=COASTING,
)
"""The same, with what the camera and the catalog do not know."""

MOMENTS = {
    "area": "px^2",
    "center_u": "px",
    "center_v": "px",
    "moment_uu": "px^2",
    "moment_vv": "px^2",
    "moment_uv": "px^2",
}
"""Measured elements: area, centroid, second central moments of an outline in the frame."""

CATALOG = ("vertices", "starts", "center", "owner")
"""Shared arrays of a lake catalog: all vertices, where each ring's begin, the lakes' middles, and
which lake a ring is of; without it islands do not count."""


def orbit_process() -> Process:
    """Gravity with the second zonal harmonic, and white acceleration."""
    names = ("mu", "radius", "j2")
    return Process(
        rates=lambda x, given, noise, _: {
            "r": x["v"],
            "v": j2_acceleration(x["r"], *(given[name] for name in names)) + noise["push"],
        },
        noise={"push": ("accel_psd", 3)},
        parameters=dict.fromkeys(names, 1),
    )


def state_columns(state: ErrorState) -> list[int]:
    """Columns of a derivative of `Seen` that are of the blocks of a state, in its order."""
    begins = dict(zip(STATE_SIZES, np.cumsum([0, *STATE_SIZES.values()]), strict=False))
    seen = (block for block in state if block.name in begins)
    return [begins[block.name] + i for block in seen for i in range(block.size)]


def outlines_seen(
    values: Arrays, given: Arrays
) -> Iterator[tuple[NDArray[np.intp], Seen, tuple[int, ...]]]:
    """Rows of the estimates that look at one lake, its outline and the starts of its rings."""
    lakes = np.asarray(given["lake"]).reshape(-1).astype(np.int64)
    for lake in np.unique(lakes):
        rows = np.flatnonzero(lakes == lake)
        index, starts = rings_of(int(lake), given["starts"], given.get("owner"))
        own = {n: v[rows] for n, v in values.items()}
        told = {n: given[n][rows] for n in (*CAMERA, *POINTING, TIME) if n in given}
        yield rows, Seen(own, told, given["vertices"][index], given["center"][lake]), starts


Look = tuple[NDArray[np.intp], FloatArray, FloatArray]
"""Rows of estimates that look at one lake, what they measure (k, m), its derivative (k, m, n)."""


def both_at_once(
    looks: Callable[[Arrays, Arrays], Iterable[Look]], m: int, n: int
) -> tuple[Callable[[Arrays, Arrays], FloatArray], Callable[[Arrays, Arrays], FloatArray]]:
    """Prediction and derivative, as an observation of ensembles has them, of looks at lakes.

    Both are asked of the same estimates: what these see is kept from one to the other.
    """
    kept: list[tuple[Arrays, Arrays, list[Look]]] = []

    def seen(values: Arrays, given: Arrays) -> list[Look]:
        last = kept[:]  # another thread may put its own there meanwhile
        if last and last[0][0] is values and last[0][1] is given:
            return last[0][2]
        found = list(looks(values, given))
        kept[:] = [(values, given, found)]
        return found

    def predict(values: Arrays, given: Arrays) -> FloatArray:
        y = np.empty((len(values["r"]), m))
        for rows, own, _ in seen(values, given):
            y[rows] = own
        return y

    def derivative(values: Arrays, given: Arrays) -> FloatArray:
        H = np.empty((len(values["r"]), m, n))
        for rows, _, own in seen(values, given):
            H[rows] = own
        return H

    return predict, derivative


def lake_observation(state: ErrorState) -> EnsembleObservation:
    """Moments of the outline of a lake of the catalog, which the fix names by its number.

    Of blocks of `CONSIDERED`, whichever `state` has.
    """
    columns = state_columns(state)
    off_outline = "outline" in [block.name for block in state]

    def looks(values: Arrays, given: Arrays) -> Iterator[Look]:
        for rows, seen, starts in outlines_seen(values, given):
            y, J = moments(seen.pixels, starts)
            H = seen.derivative(J)[..., columns]
            if off_outline:
                L = seen.factor(J)
                y = y + np.einsum("kij,kj->ki", L, values["outline"][rows])
                H = np.concatenate([H, L], axis=2)
            y[seen.depth.min(axis=1) <= 0.0] = np.nan
            yield rows, y, H

    predict, derivative = both_at_once(looks, len(MOMENTS), state.size)
    return EnsembleObservation(
        predict,
        MOMENTS,
        derivative=derivative,
        fields=[vector("lake", 1)],
        parameters=CAMERA,
        shared=CATALOG,
    )
