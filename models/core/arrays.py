"""Names of array types, and named arrays in files of NumPy (.npz).

Files are read with errors that say what is wrong with the file.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.formats import ARCHIVE, kind_of

FloatArray = NDArray[np.float64]
"""Real numbers."""
Single = NDArray[np.float32]
"""Real numbers in single precision: pictures, heights."""
ComplexArray = NDArray[np.complex64]
"""Complex numbers in single precision: echo."""


def read_arrays(
    path: Path, keys: Sequence[str], what: str, optional: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read arrays from a file (.npz).

    Parameters
    ----------
    path : Path
    keys : sequence of str
        Arrays that it must hold.
    what : str
        What the file is, for errors: "an echo".
    optional : sequence of str
        Arrays that are read if it holds them.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a file of arrays, is damaged, or lacks some.
    """
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    whole = f"{what} is a file of NumPy (.npz) with the arrays {', '.join(keys)}"
    found, cure = kind_of(path)
    if found and found != ARCHIVE:
        raise ValueError(f"'{path}' is not {what}: it is {found}\n  {whole}\n  {cure}")
    try:
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not hasattr(archive, "files"):
                raise ValueError("it is no file of NumPy (.npz)")
            strange = [name for name in archive.zip.namelist() if not name.endswith(".npy")]
            if strange:
                raise ValueError(f"it is a zip archive of other files ('{strange[0]}')")
            missing = [k for k in keys if k not in archive.files]
            if missing:
                raise ValueError(
                    f"it has no '{missing[0]}'; it holds {', '.join(archive.files) or 'nothing'}"
                )
            return {k: _array(archive, k) for k in (*keys, *optional) if k in archive.files}
    except (OSError, EOFError, BadZipFile, zlib.error, ValueError, KeyError) as error:
        reason = str(error) if isinstance(error, ValueError) else f"it is damaged ({error})"
        if "allow_pickle" in reason:
            reason = "it is damaged, or of a kind that is not known"
        raise ValueError(f"'{path}' is not {what}: {reason}\n  {whole}") from error


def _array(archive: Any, key: str) -> NDArray[Any]:
    _check_size(archive, key)
    try:
        array = np.asarray(archive[key])
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        raise ValueError(
            f"its '{key}' holds Python objects (a list of arrays of several lengths, say), "
            "not an array of numbers"
        ) from error
    if array.dtype.kind not in "biufc":
        raise ValueError(f"its '{key}' holds {array.dtype}, not numbers")
    return array


def _check_size(archive: Any, key: str) -> None:
    """Look whether an array has the bytes that its shape wants, before it gets room for them."""
    info = archive.zip.getinfo(f"{key}.npy")
    with archive.zip.open(info) as member:
        version = np.lib.format.read_magic(member)
        read = {(1, 0): np.lib.format.read_array_header_1_0}
        shape, _, dtype = read.get(version, np.lib.format.read_array_header_2_0)(member)
        wanted = math.prod(shape) * dtype.itemsize + member.tell()
    if not dtype.hasobject and wanted > info.file_size:
        raise ValueError(
            f"its '{key}' is damaged: it says shape {shape} of {dtype}, which is {wanted} bytes, "
            f"and has {info.file_size}"
        )
