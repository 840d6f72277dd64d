r"""Particles that find a start: from a prior that is too wide for any Kalman rule, by fixes.

The density of the error state is a sum of kernels, one about each particle [1]_,

.. math::
    p(x) = \sum_i w_i\, N(x \ominus x_i;\, 0, B_i).

A wide prior of covariance :math:`P` is drawn as particles of covariance :math:`(1 - h^2) P` with
kernels :math:`h^2 P`, so that together they are the prior; :math:`h` is the width that is best for
N particles of a normal density in n dimensions, :math:`h^{n+4} = 4 / ((n + 2) N)` [2]_. Kernels
follow the geometry of what was measured, each its own: a range leaves a ring, two leave two peaks,
and a kernel of the covariance of all would smear them. Blocks that process and observation are
nearly linear in (a velocity, a bias) may be left to the kernels: particles then are of the others,
and each kernel holds what the others leave of them [5]_.

A step moves each particle by the filter's own process and a draw of its noise, and its kernel by
the transition. A fix is weighed in parts: :math:`L = \prod L^{\beta_k}`, :math:`\sum \beta_k = 1`
[3]_. In each, about :math:`x_i` with residual :math:`r` and derivative :math:`H`,

.. math::
    S = H B H^T + R / \beta, \qquad K = B H^T S^{-1}, \qquad B' = (I - K H) B, \\
    e \sim N(K r,\; (1 - c) B'), \qquad x' = x_i \oplus e, \qquad B \leftarrow c B', \\
    w' \propto w\; \sqrt{\frac{|R / \beta|}{|S|}}\, e^{-r^T S^{-1} r / 2}\;
        \frac{L^\beta(x')}{\tilde L^\beta(x')},

where :math:`\tilde L^\beta` is the density that the linear measurement :math:`r - H e` has: what
the linearization leaves is weighed. A linear measurement is weighed exactly, whatever c; without
kernels (B = 0) it is the bootstrap filter, :math:`w' \propto w L`. c = 0.9, so that kernels turn
into particles by and by, and particles that were one part ways.

A part is taken if the effective number of particles, :math:`1 / \sum w_i^2`, stays above a tenth of
all; else half of it is tried. Below half of all they are resampled, systematically [4]_.

References
----------
.. [1] D. T. Pham, K. Dahia, C. Musso, "A Kalman-particle kernel filter and its application to
       terrain navigation", Proc. 6th Int. Conf. Information Fusion, 2003. We differ: kernels have
       covariances of their own, are split rather than drawn anew, and linearization is weighed.
.. [2] B. W. Silverman, "Density Estimation for Statistics and Data Analysis", 1986, eq. (4.14).
.. [3] C. Musso, N. Oudjane, F. Le Gland, "Improving regularised particle filters", in "Sequential
       Monte Carlo Methods in Practice", 2001 (progressive correction).
.. [4] G. Kitagawa, "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models",
       J. Computational and Graphical Statistics 5(1), 1996.
.. [5] T. Schoen, F. Gustafsson, P.-J. Nordlund, "Marginalized particle filters for mixed
       linear/nonlinear state-space models", IEEE Trans. Signal Processing 53(7), 2005.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.core.symmetric import ldl, ldl_solve, mirrored, semidefinite_root
from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process, propagate
from terrafix.models.filters.updates import ekf_update

Arrays = Mapping[str, FloatArray]

KEPT = 0.9
"""Part of a kernel's covariance that stays a kernel when a fix is weighed; the rest is drawn."""
RESAMPLED = 0.5
"""Effective part of the particles below which they are resampled."""
TAKEN = 0.1
"""Effective part below which less of a fix is weighed at a time."""
SMALLEST = 2.0**-8
"""Part of a fix that is taken whatever it leaves."""
ROUNDS = 64
"""Trials for one fix; the last takes what is left."""
MEANS = 5
"""Iterations of the mean of rotations."""


def kernel_width(size: int, n_particles: int) -> float:
    """Width h of kernels in `size` dimensions, in sigmas of a normal density."""
    return float((4 / ((size + 2) * n_particles)) ** (1 / (size + 4)))


def effective_number(weights: FloatArray) -> FloatArray:
    """Number of particles that count, (k,), of weights (k, N) of sum one."""
    found: FloatArray = 1 / (weights * weights).sum(axis=1)
    return found


def systematic(weights: FloatArray, u: FloatArray) -> NDArray[np.int64]:
    """Numbers (k, N) of the particles that are kept, of weights (k, N) and one uniform number each.

    A particle of weight w is kept floor(N w) or ceil(N w) times.
    """
    n = weights.shape[1]
    ends = np.cumsum(weights, axis=1)
    ends /= ends[:, -1:]
    places = (u[:, None] + np.arange(n)) / n
    found = np.empty(weights.shape, dtype=np.int64)
    for row, e, p in zip(found, ends, places, strict=True):
        row[:] = np.minimum(np.searchsorted(e, p, side="right"), n - 1)
    return found


def normalized_weights(logarithms: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Weights (k, N) of sum one from logarithms, and whether (k,) any of them is a number.

    What is not a number has no weight; where none has any, all are alike.
    """
    usable = np.isfinite(logarithms)
    some: NDArray[np.bool_] = np.asarray(usable.any(axis=1))
    clean = np.where(usable, logarithms, -np.inf)
    clean[~some] = 0.0
    weights = np.exp(clean - clean.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True), some


@dataclass
class Cloud:
    """Particles of k members.

    Attributes
    ----------
    values : dict of str to ndarray, shape (k, N, size)
        By block.
    kernels : ndarray, shape (k, N, n, n)
    weights : ndarray, shape (k, N)
        Of sum one.
    """

    values: dict[str, FloatArray]
    kernels: FloatArray
    weights: FloatArray

    @property
    def arrays(self) -> list[FloatArray]:
        """All arrays, the blocks' first."""
        return [*self.values.values(), self.kernels, self.weights]

    def of(self, members: Any) -> Cloud:
        """The particles of some of the members: copies."""
        values = {n: v[members] for n, v in self.values.items()}
        return Cloud(values, self.kernels[members], self.weights[members])

    def put(self, members: Any, other: Cloud) -> None:
        """Take over the particles of some members."""
        for own, given in zip(self.arrays, other.arrays, strict=True):
            own[members] = given

    def resampled(self, members: NDArray[np.bool_], u: FloatArray) -> None:
        """Resample the particles of some members, in place."""
        who = np.flatnonzero(members)
        kept = systematic(self.weights[who], u[who])
        for array in [*self.values.values(), self.kernels]:
            array[who] = array[who[:, None], kept]
        self.weights[who] = 1 / self.weights.shape[1]


@dataclass(frozen=True)
class Particles:
    """What particles of a filter do, as functions of arrays.

    Parameters
    ----------
    state : ErrorState
        Without clones.
    process : Process
    observation : Observation
        Symbolic, of now.
    linear : tuple of str
        Blocks that kernels hold from the start.

    Raises
    ------
    ValueError
        If the state has clones, the observation is of an instant or of ensembles, or a linear block
        does not exist or no other does.
    """

    state: ErrorState
    process: Process
    observation: Observation
    linear: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.state.instants:
            raise ValueError(
                f"particles have no clones; the state has some of '{self.state.instants[0]}'"
            )
        if self.observation.instant:
            raise ValueError(
                f"particles are of now; the observation is of the instant "
                f"'{self.observation.instant}'"
            )
        if self.observation.of_ensembles:
            raise ValueError(
                "particles are weighed by a symbolic observation; this one is a function of "
                "ensembles"
            )

        names = [block.name for block in self.state]
        wrong = [name for name in self.linear if name not in names]
        if wrong or len(set(self.linear)) == len(names):
            raise ValueError(
                f"linear blocks are '{', '.join(self.linear)}', of the blocks {', '.join(names)}: "
                "particles are of one block or more, and kernels of others"
            )

    @cached_property
    def _linear(self) -> list[int]:
        """Elements of the error that kernels hold from the start."""
        places = self.state.places
        return [k for name in self.linear for k in range(places[name].start, places[name].stop)]

    @property
    def _shapes(self) -> list[tuple[int, ...]]:
        """Of the values of the blocks, and of a kernel."""
        n = self.state.size
        return [*((b.value_size,) for b in self.state), (n, n)]

    def _named(self, values: tuple[Any, ...]) -> dict[str, Any]:
        return dict(zip((b.name for b in self.state), values, strict=True))

    def drawn(self, start: Arrays, P: FloatArray, normals: FloatArray) -> Cloud:
        """Particles of a prior.

        Parameters
        ----------
        start : mapping of str to ndarray, shape (k, size)
        P : ndarray, shape (k, n, n)
        normals : ndarray, shape (k, N, n)
        """
        k, n_particles, n = normals.shape
        order = sorted(range(n), key=lambda i: i in self._linear)  # stable: those drawn first
        back = [order.index(i) for i in range(n)]
        size = n - len(self._linear)

        def draw(*given: Any) -> Any:
            *values, P, z, h2 = given
            root = semidefinite_root(mirrored(P)[order, order])[back, :]
            kernel = ca.vertcat(ca.repmat(h2, size, 1), ca.SX.ones(n - size))
            error = ca.mtimes(root, ca.sqrt(1 - kernel) * z)
            found = self.state.retract(self._named(tuple(values)), error)
            B = mirrored(ca.mtimes(root, ca.mtimes(ca.diag(kernel), root.T)))
            return (*found.values(), self.state.recentered(B, error))

        h2 = np.full((1, 1), kernel_width(size, n_particles) ** 2)
        made = over_members(draw, *self._shapes, (n,), ())(
            *(start[b.name][:, None] for b in self.state), P[:, None], normals, h2
        )
        *values, kernels = made
        shaped = [np.reshape(v, (k, n_particles, -1)) for v in values]
        return Cloud(
            self._named(tuple(shaped)),
            np.reshape(kernels, (k, n_particles, n, n)),
            np.full((k, n_particles), 1 / n_particles),
        )

    @cached_property
    def _given_sizes(self) -> tuple[dict[str, int], dict[str, int]]:
        """Sizes of what process and observation read besides."""
        seen = self.observation
        return (
            {**self.process.inputs, **self.process.named()},
            {**seen.inputs, **seen.parameters},
        )

    @cached_property
    def _move(self) -> Callable[..., Any]:
        sizes = self._given_sizes[0]
        n_blocks = len(self.state.blocks)

        def move(*given: Any) -> Any:
            values = self._named(given[:n_blocks])
            B, z, step, time, *more = given[n_blocks:]
            told = dict(zip(sizes, more, strict=True))
            moved = propagate(self.state, self.process, values, told, step, time)
            error = ca.mtimes(semidefinite_root(mirrored(moved.spread)), z)
            end = self.state.normalized(self.state.retract(moved.values, error))
            phi = moved.transition
            carried = mirrored(ca.mtimes(phi, ca.mtimes(mirrored(B), phi.T)))
            return (*end.values(), self.state.recentered(carried, error))

        n = self.state.size
        return over_members(move, *self._shapes, (n,), (), (), *((s,) for s in sizes.values()))

    def moved(
        self, cloud: Cloud, given: Arrays, step: float, time: float, normals: FloatArray
    ) -> Cloud:
        """Particles at the end of a step.

        Parameters
        ----------
        cloud : Cloud
        given : mapping of str to ndarray, shape (k, size)
            Inputs and parameters of the process.
        step, time : float
            Its length, and the time at its end [s].
        normals : ndarray, shape (k, N, n)
        """
        clock = [np.full((1, 1), value) for value in (step, time)]
        more = [given[name][:, None] for name in self._given_sizes[0]]
        *values, kernels = self._move(*cloud.arrays[:-1], normals, *clock, *more)
        return self._again(cloud, values, kernels, cloud.weights)

    def _again(
        self, cloud: Cloud, values: list[Any], kernels: FloatArray, weights: FloatArray
    ) -> Cloud:
        shaped = [
            np.reshape(v, old.shape) for v, old in zip(values, cloud.values.values(), strict=True)
        ]
        return Cloud(self._named(tuple(shaped)), np.reshape(kernels, cloud.kernels.shape), weights)

    @cached_property
    def _weigh(self) -> Callable[..., Any]:
        seen, state, n_blocks = self.observation, self.state, len(self.state.blocks)
        fields, sizes = seen.shapes(), self._given_sizes[1]

        def weigh(*given: Any) -> Any:
            values = self._named(given[:n_blocks])
            B, z, beta, *more = given[n_blocks:]
            message = dict(zip(fields, more[: len(fields)], strict=True))
            told = dict(zip(sizes, more[len(fields) :], strict=True))
            about = seen.about(state, values, message, told)
            part = replace(about, noise=lambda error: about.noise(error) / beta)
            kernel = ekf_update(mirrored(B), part, 0.0)
            spread = mirrored(kernel.P)
            error = kernel.correction + ca.mtimes(semidefinite_root(spread), ca.sqrt(1 - KEPT) * z)
            zero = ca.SX.zeros(state.size)
            H = about.sensitivity(zero)
            linear, _, sound = _square(
                kernel.residual - ca.mtimes(H, error), about.covariance(zero)
            )
            true, volume, _ = _square(about.residual(error), about.covariance(error))
            _, of_kernel, _ = _square(kernel.residual, kernel.S)
            _, of_part, _ = _square(kernel.residual, part.covariance(zero))
            weight = -(of_kernel - of_part + kernel.nis + beta * (true + volume - linear)) / 2
            end = state.normalized(state.retract(values, error))
            return (*end.values(), state.recentered(KEPT * spread, error), weight, sound)

        matrices = {"R", *seen.mapped.values()}
        shapes = [s if name in matrices else s[:1] for name, s in fields.items()]
        n = state.size
        return over_members(
            weigh, *self._shapes, (n,), (), *shapes, *((s,) for s in sizes.values())
        )

    def weighed(
        self,
        cloud: Cloud,
        message: Arrays,
        given: Arrays,
        normals: Callable[[int], FloatArray],
        uniform: Callable[[int], FloatArray],
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Weigh a fix, in place, and resample.

        Parameters
        ----------
        cloud : Cloud
        message : mapping of str to ndarray, shape (k, ...)
            The fix by field.
        given : mapping of str to ndarray, shape (k, size)
            Inputs and parameters of the observation.
        normals, uniform : callable
            Of the number of a trial: draws (k, N, n) and (k,).

        Returns
        -------
        effective : ndarray, shape (k,)
            Least effective number of particles that any part left, before it was resampled.
        explained : ndarray of bool, shape (k,)
            Whether any particle has a weight: none has where the noise is not positive definite.
        """
        k, n_particles = cloud.weights.shape
        left, part = np.ones(k), np.ones(k)
        effective, explained = np.full(k, float(n_particles)), np.ones(k, dtype=np.bool_)
        for trial in range(ROUNDS):
            who = np.flatnonzero((left > 0) & explained)
            if not len(who):
                break
            last = trial == ROUNDS - 1
            beta = left[who] if last else np.minimum(part[who], left[who])
            found, logarithms = self._part(
                cloud.of(who),
                {n: v[who] for n, v in message.items()},
                {n: v[who] for n, v in given.items()},
                beta,
                normals(trial)[who],
            )
            found.weights, explained[who] = normalized_weights(logarithms)
            number = effective_number(found.weights)
            enough = (number >= TAKEN * n_particles) | (beta <= SMALLEST) | last
            taken = enough & explained[who]
            part[who] = np.where(taken, 2 * beta, beta / 2)
            done = who[taken]
            left[done] -= beta[taken]
            effective[done] = np.minimum(effective[done], number[taken])
            poor = taken & (number < RESAMPLED * n_particles)
            if poor.any():
                found.resampled(poor, uniform(trial)[who])
            cloud.put(done, found.of(taken))
        return effective, explained

    def _part(
        self, cloud: Cloud, message: Arrays, given: Arrays, beta: FloatArray, normals: FloatArray
    ) -> tuple[Cloud, FloatArray]:
        """Weigh a part of a fix: particles, and logarithms of their weights."""
        fields = [message[name][:, None] for name in self.observation.shapes()]
        more = [given[name][:, None] for name in self._given_sizes[1]]
        *values, kernels, weight, sound = self._weigh(
            *cloud.arrays[:-1], normals, beta[:, None], *fields, *more
        )
        with np.errstate(divide="ignore"):
            logarithms = np.log(cloud.weights) + weight
        made = self._again(cloud, values, kernels, cloud.weights)
        logarithms[sound < 0.5] = -np.inf
        for array in made.arrays[:-1]:  # one that is nowhere has no weight
            logarithms[~np.isfinite(array).reshape(*logarithms.shape, -1).all(axis=2)] = -np.inf
        return made, logarithms

    @cached_property
    def _difference(self) -> Callable[..., Any]:
        shapes = self._shapes[:-1]
        size = len(shapes)
        return over_members(
            lambda *v: self.state.difference(self._named(v[:size]), self._named(v[size:])),
            *shapes,
            *shapes,
        )

    @cached_property
    def _retract(self) -> Callable[..., Any]:
        def retract(*given: Any) -> Any:
            values = self._named(given[:-1])
            return tuple(self.state.normalized(self.state.retract(values, given[-1])).values())

        return over_members(retract, *self._shapes[:-1], (self.state.size,))

    def moments(self, cloud: Cloud) -> tuple[dict[str, FloatArray], FloatArray]:
        """Mean (k, size) by block, and covariance (k, n, n) of the error about it.

        The mean is where the errors' mean is zero, found from the particle of most weight.
        """
        k, _ = cloud.weights.shape
        n = self.state.size
        best = np.argmax(cloud.weights, axis=1)
        mean = [v[np.arange(k), best] for v in cloud.values.values()]
        rotates = any(block.is_rotation for block in self.state)
        for _ in range(MEANS if rotates else 1):
            shift = (self._errors(cloud, mean) * cloud.weights[..., None]).transpose(0, 2, 1)
            shift = np.ascontiguousarray(shift).sum(axis=2)
            turned = self._retract(*mean, shift)
            mean = [np.reshape(v, (k, -1)) for v in turned]
        error, P = self._errors(cloud, mean), np.empty((k, n, n))
        for i in range(n):
            for j in range(i, n):
                product = error[..., i] * error[..., j] + cloud.kernels[..., i, j]
                P[:, i, j] = P[:, j, i] = (cloud.weights * product).sum(axis=1)
        return self._named(tuple(mean)), P

    def _errors(self, cloud: Cloud, mean: list[FloatArray]) -> FloatArray:
        found = self._difference(*cloud.values.values(), *(m[:, None] for m in mean))
        return np.reshape(found, (*cloud.weights.shape, self.state.size))


def _square(residual: Any, S: Any) -> tuple[Any, Any, Any]:
    """Normalized square of a residual, logarithm of the determinant, whether S is positive."""
    L, d, positive = ldl(S, 0.0)
    return ca.dot(residual, ldl_solve(L, d, residual)), ca.sum1(ca.log(d)), positive
