r"""Products of transitions, and the covariances that noise adds on the way.

A tick takes what it reads of the deviations, :math:`u`, to :math:`f u + g w` with white
:math:`w`; what it does not change stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray


class Chain(NamedTuple):
    """Several transitions as one.

    Attributes
    ----------
    product : ndarray, shape (..., m, m)
    added : ndarray, shape (..., n_sources, r, r)
        Covariance that each source of noise added, of the elements that noise reaches.
    """

    product: FloatArray
    added: FloatArray


def reached(f: FloatArray, driven: Sequence[FloatArray]) -> NDArray[np.intp]:
    """Elements that noise gets to, at once or by way of others.

    Parameters
    ----------
    f : ndarray, shape (n, m, m)
        Transitions.
    driven : sequence of ndarray, shape (n, m, n_noise)
        What each source of noise does at each.
    """
    links = np.any(f != 0.0, axis=0)
    found = np.zeros(f.shape[1], dtype=np.bool_)
    for each in driven:
        found |= np.any(each != 0.0, axis=(0, 2))
    while True:
        more = found | links[:, found].any(axis=1)
        if (more == found).all():
            return np.flatnonzero(found)
        found = more


def repeated(f: FloatArray, q: FloatArray, reach: NDArray[np.intp], times: int) -> Chain:
    """Each of n transitions `times` times, by repeated squaring.

    Parameters
    ----------
    f : ndarray, shape (n, m, m)
    q : ndarray, shape (n, n_sources, r, r)
        Covariance that each source adds at every transition.
    reach : ndarray of int, shape (r,)
        Elements that noise reaches: no other element depends on these.
    """
    inside = np.ix_(np.arange(len(f)), reach, reach)

    def carried(by: FloatArray, covariance: FloatArray) -> FloatArray:
        part = by[inside][:, None]
        moved: FloatArray = part @ covariance @ part.swapaxes(-1, -2)
        return moved

    product: FloatArray = np.broadcast_to(np.eye(f.shape[1]), f.shape)
    added = np.zeros_like(q)
    for bit in f"{times:b}" if times else "":
        added = added + carried(product, added)
        product = product @ product
        if bit == "1":
            added = carried(f, added) + q
            product = f @ product
    return Chain(product, added)


def chained(parts: Chain, reach: NDArray[np.intp]) -> Chain:
    """One after the other, the first of the first axis first."""
    product = np.eye(parts.product.shape[-1])
    added = np.zeros(parts.added.shape[1:])
    small = parts.product[np.ix_(np.arange(len(parts.product)), reach, reach)]
    for k, each in enumerate(parts.product):
        product = each @ product
        added = small[k] @ added @ small[k].T + parts.added[k]
    return Chain(product, added)
