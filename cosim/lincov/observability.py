"""Which directions of the error the fixes tell something of, and which they do not."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.lincov.prediction import Direction
from terrafix.cosim.memory.messages import MessageSlot
from terrafix.cosim.system.system import System


def directions(
    system: System, duration: Fraction, path: str, covariance: FloatArray
) -> list[Direction]:
    """Compare the filter's covariance at the end with that of a filter which gets no fix.

    Parameters
    ----------
    system : System
    duration : Fraction
        [s]
    path : str
        Of the evaluation component.
    covariance : ndarray, shape (n_axes, n_axes)
        What the filter predicts at the end, with fixes.

    Returns
    -------
    list of Direction
        The least observed first; empty where the evaluation publishes no covariance, or is not
        fed by messages.
    """
    deaf = Simulation(system, members=1, duration=duration, recording=False, quiet=True)
    try:
        flat = deaf.plan.flat
        corrector = next(
            (
                c.source.rpartition(".")[0]
                for c in flat.connections
                if c.target.rpartition(".")[0] == path and flat.port(c.source).kind == "message"
            ),
            None,
        )
        if corrector is None or "covariance" not in flat.components[path].outputs():
            return []
        for name, port in flat.components[corrector].inputs().items():
            reader = deaf.master.wiring.readers.get(f"{corrector}.{name}")
            if reader is not None:
                reader.slot = MessageSlot(port.fields, 1)  # nobody publishes to it
        deaf.run_until(duration)
        without = deaf.history(path)[1]["covariance"][-1, 0]
    finally:
        deaf.master.terminate()
    return compared(covariance, without)


def compared(covariance: FloatArray, without: FloatArray) -> list[Direction]:
    r"""Directions :math:`v` with :math:`P v = \lambda P_0 v`, the largest :math:`\lambda` first.

    Parameters
    ----------
    covariance, without : ndarray, shape (n_axes, n_axes)
        With fixes, :math:`P`, and without, :math:`P_0`.
    """
    sigma = np.sqrt(np.diagonal(without))
    scale = np.outer(sigma, sigma)
    root = np.linalg.cholesky(without / scale)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ (covariance / scale) @ inverse.T)
    found = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        direction = root @ vector  # of the error, not of what measures it
        found.append(Direction(float(value), direction / np.linalg.norm(direction)))
    return found
