"""Files of HDF5, read by netCDF4: groups, values, epochs.

Texts of a fixed length may end in bytes that are not theirs: of an epoch its date and whole
seconds are read, and a fraction is refused.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.formats import HDF5

_MOST = 50_000_000
"""Numbers of a data set that is read whole."""
_EPOCH = re.compile(r"seconds since (\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(\.\d*[1-9])?")


def opened(path: Path) -> Any:
    """A file of HDF5, open, whose values come as they are.

    Raises
    ------
    ValueError
        If it is damaged.
    """
    from netCDF4 import Dataset

    try:
        file = Dataset(path)
    except OSError as error:
        raise ValueError(f"it is {HDF5}\n  it is damaged ({error})") from error
    file.set_auto_maskandscale(False)
    return file


def has_group(file: Any, name: str) -> bool:
    """Whether there is a group of this path."""
    for part in name.split("/"):
        if part not in file.groups:
            return False
        file = file.groups[part]
    return True


def values_of(group: Any, name: str, shape: tuple[int, ...]) -> FloatArray:
    """A data set of finite numbers; -1 in the shape is any length.

    Raises
    ------
    ValueError
        If it is missing, of another shape, or not finite.
    """
    if name not in group.variables:
        raise ValueError(f"its '{group.path}' has no '{name}'")
    size = math.prod(group[name].shape)
    if size > _MOST:
        raise ValueError(f"'{name}' says that it has {size} numbers, more than are read")
    values = np.asarray(group[name][...], np.float64)
    if len(values.shape) != len(shape) or any(
        m not in (-1, k) for k, m in zip(values.shape, shape, strict=True)
    ):
        raise ValueError(f"'{name}' has shape {values.shape}, not {shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"'{name}' is not finite")
    return values


def epoch_of(times: Any) -> np.datetime64:
    """Epoch from which a data set counts seconds.

    Raises
    ------
    ValueError
        If it names none.
    """
    units = str(getattr(times, "units", ""))
    found = _EPOCH.match(units)
    if found is None:
        raise ValueError(f"its '{times.name}' counts '{units}', not seconds since an epoch")
    if found[3]:
        raise ValueError(f"its '{times.name}' counts '{units}', not from a whole second")
    return np.datetime64(f"{found[1]}T{found[2]}", "ns")
