r"""Tests of hypotheses about a filter, and what they find.

Each is a test of a null hypothesis that leaves room for what no engineer would call wrong, five
percent of the root mean square error in any direction: a sigma within five percent, a mean error
within :math:`\sqrt{1.05^2 - 1} = 0.32` sigma; and a correlation within 0.05.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray

SIGMA_TOLERANCE = 0.05
BIAS_TOLERANCE = ((1 + SIGMA_TOLERANCE) ** 2 - 1) ** 0.5
CORRELATION_TOLERANCE = 0.05


@dataclass(frozen=True)
class Finding:
    """One hypothesis that was rejected.

    Attributes
    ----------
    word : str
        ``"biased"``, ``"overconfident"``, ``"conservative"`` or ``"correlated innovations"``.
    text : str
        The numbers behind it, in a sentence.
    p : float
        Smallest p-value, multiplied by how many tests its family made.
    """

    word: str
    text: str
    p: float


Evidence = tuple[list[Finding], int]
"""What was found, and by how many tests."""


def judge_ratios(
    ratio: FloatArray, dof: FloatArray, describe: Callable[[Any], str], share: float
) -> Evidence:
    """Test mean squares against one, over and under.

    Parameters
    ----------
    ratio, dof : ndarray
        Of one shape: ``dof * ratio`` is chi-square of ``dof`` degrees of freedom.
    describe : callable
        Says in a sentence what stands at an index.
    share : float
        Level of all these tests together.
    """
    from scipy.stats import chi2

    over, under = (1 + SIGMA_TOLERANCE) ** 2, (1 - SIGMA_TOLERANCE) ** 2
    n_tests = 2 * ratio.size
    p_over = chi2.sf(dof * ratio / over, dof) * n_tests
    p_under = chi2.cdf(dof * ratio / under, dof) * n_tests
    found = []
    for word, p in (("overconfident", p_over), ("conservative", p_under)):
        if np.isfinite(p).any():
            worst = np.unravel_index(int(np.nanargmin(p)), ratio.shape)
            if p[worst] < share:
                found.append(Finding(word, describe(worst), float(p[worst])))
    return found, n_tests
