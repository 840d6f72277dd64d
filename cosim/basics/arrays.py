"""Names of array types, and views that cannot be written."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""The one alias for arrays of real numbers."""
Mask = NDArray[np.bool_]
"""Members that something holds for, shape (n_members,)."""


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view that cannot be written."""
    view = array.view()
    view.flags.writeable = False
    return view
