r"""Evaluation components: errors, predicted sigma, NEES and NIS, and what follows over an ensemble.

An evaluation binds truth, estimate and covariance through its own ports and publishes, per
quantity, the error (estimate minus truth) and the predicted sigma. What `run` prints and draws
is computed here from the recorded history, so that it is the same for one run, an ensemble, a
resumed run and a result read from a file.

With :math:`n` degrees of freedom and :math:`N` independent values, the mean of NEES or NIS lies
in :math:`[\chi^2_{nN}(0.025), \chi^2_{nN}(0.975)] / N` with probability 0.95.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.ensembles import (
    chi_square_interval,
    member_mean,
    root_mean_square,
    sample_sigma,
)
from terrafix.cosim.declare.component import Component

History = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Quantity:
    """One evaluated quantity: the ports that carry its error and its predicted sigma.

    Attributes
    ----------
    name : str
        ``"position"``; the error port is ``position_error``, the sigma port ``position_sigma``.
    unit : str
        SI.
    axes : tuple of str
        One label per component.
    """

    name: str
    unit: str
    axes: tuple[str, ...]


class Evaluation(Component):
    """Base of evaluation components. A subclass declares its ports and `quantities`.

    The error and sigma of quantity ``q`` are output ports ``q_error`` and ``q_sigma``, shape
    (n_axes,). What a campaign judges a filter by goes by these names, all optional: ``nees``;
    ``covariance``, of all axes of all quantities in their order; ``nis`` with ``nis_dof``, and
    ``normalized_innovation``, NaN where nothing was measured.

    Attributes
    ----------
    quantities : tuple of Quantity
    nees_axes : int, optional
        Number of axes that ``nees`` is of, where it is not all of them.
    measurements : tuple of str
        Of several measurements, their names: ``NAME_nis`` and ``NAME_nis_dof`` are judged one by
        one, too.
    white : bool
        Whether innovations of a sound filter are white; not where something is not corrected that
        all of them depend on.
    """

    quantities: ClassVar[tuple[Quantity, ...]] = ()
    nees_axes: ClassVar[int | None] = None
    measurements: ClassVar[tuple[str, ...]] = ()
    white: ClassVar[bool] = True

    def error_model(self) -> Any:
        """Errors of all quantities, in one output ``error``, as a function of the inputs' fields.

        Needed to predict a campaign by linear covariance analysis.
        """
        raise NotImplementedError

    def recorded_ports(self) -> list[str]:
        """Output ports whose history `summarize` needs."""
        return [n for n, p in self.outputs().items() if p.kind != "shared"]

    def summarize(self, times: FloatArray, history: History) -> dict[str, Any]:
        """Summarize a recorded history in plain types (JSON).

        Parameters
        ----------
        times : ndarray, shape (n,)
            [s]
        history : mapping of str to ndarray, shape (n, n_members, ...)
            By port name; failed members are NaN.
        """
        del times
        summary: dict[str, Any] = {}
        for q in self.quantities:
            error, sigma = history[f"{q.name}_error"], history[f"{q.name}_sigma"]
            if not len(error):
                continue
            summary[q.name] = {
                "unit": q.unit,
                "axes": list(q.axes),
                "error": _plain(member_mean(error[-1:])[0]),
                "sigma_predicted": _plain(root_mean_square(sigma[-1:])[0]),
                "sigma_sample": _plain(sample_sigma(error[-1:])[0]),
            }
        return summary


def _plain(values: FloatArray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in np.atleast_1d(values)]


def consistency(values: FloatArray, dof: float, *, independent_epochs: bool) -> dict[str, Any]:
    """Mean over epochs and members with its 95 % interval, and the fraction of epochs inside.

    Parameters
    ----------
    values : ndarray, shape (n_epochs, n_members)
        NEES or NIS; NaN where there is none.
    dof : float
        Degrees of freedom of one value.
    independent_epochs : bool
        True for NIS (white innovations: every value counts). NEES is correlated from epoch to
        epoch: its interval is that of a single epoch.
    """
    finite = np.isfinite(values)
    n_members = int(finite.any(axis=0).sum())
    if not n_members:
        return {"mean": None, "interval_95": None, "dof": dof, "fraction_inside": None}
    count = int(finite.sum()) if independent_epochs else n_members
    mean = float(np.where(finite, values, 0.0).sum() / finite.sum())
    epochs = finite.any(axis=1)
    per_epoch = member_mean(values[epochs])
    bounds = np.array([chi_square_interval(dof, int(n)) for n in finite[epochs].sum(axis=1)])
    inside = (per_epoch >= bounds[:, 0]) & (per_epoch <= bounds[:, 1])
    return {
        "mean": mean,
        "interval_95": list(chi_square_interval(dof, count)),
        "dof": dof,
        "fraction_inside": float(inside.mean()),
    }
