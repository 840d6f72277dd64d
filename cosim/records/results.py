"""Labeled results: recorded chunks as an `xarray.Dataset`, and NetCDF files of them."""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.files import replacing
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.records.recorder import MANIFEST, Recorder, Variable, join, read_chunks
from terrafix.cosim.records.recorder import SCHEMA as RECORDS_SCHEMA

if TYPE_CHECKING:
    import xarray

SCHEMA = "terrafix-result/1"
LONGEST_NAME = 32  # of an axis named after all its labels


def time_axes(times: Mapping[str, NDArray[np.float64]]) -> dict[str, str]:
    """Name of each record's time axis.

    Records sampled at the same times share an axis: ``time`` if there is no other, else
    ``time_<record>`` after the first of them.
    """
    first: dict[bytes, str] = {}
    for record, values in times.items():
        first.setdefault(values.tobytes(), record)
    if len(first) == 1:
        return dict.fromkeys(times, "time")
    return {record: f"time_{first[values.tobytes()]}" for record, values in times.items()}


def versions(epoch: str | None = None) -> dict[str, str]:
    """Versions of what the numbers depend on: with an epoch, on tables of what happened then."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version()}
    for package in (*_PACKAGES, *(_DATED if epoch is not None else ())):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


_PACKAGES = ("terrafix", "numpy", "casadi", "scipy", "fmpy")
_DATED = ("pyerfa", "astropy-iers-data", "pymsis", "sgp4")


class _Labels:
    """Dimensions of variables, shared where size and labels agree."""

    def __init__(self) -> None:
        self.coordinates: dict[str, list[str]] = {}

    def names(self, field: Field, shape: tuple[int, ...]) -> list[str]:
        names: list[str] = []
        for axis, size in enumerate(shape):
            last = axis == len(shape) - 1
            name = self._of_labels(list(field.labels)) if last and field.labels else f"dim_{size}"
            while name in names:
                name += "b"
            names.append(name)
        return names

    def _of_labels(self, labels: list[str]) -> str:
        """Name of the axis of these labels alone; NetCDF has no slash in names."""
        name = "_".join(["axis", *labels])
        if len(name) > LONGEST_NAME:
            name = f"axis_{labels[0]}_to_{labels[-1]}"
        name = plain = re.sub(r"[^\w.+-]", "_", name)
        others = 1
        while self.coordinates.setdefault(name, labels) != labels:
            others += 1
            name = f"{plain}_{others}"
        return name


def build_dataset(
    records: Mapping[str, tuple[NDArray[np.float64], list[tuple[str, Field, NDArray[Any]]]]],
    members: NDArray[np.int64],
    attributes: Mapping[str, Any],
    parameters: Mapping[str, tuple[str, NDArray[Any]]] | None = None,
) -> xarray.Dataset:
    """Label recorded arrays.

    Parameters
    ----------
    records : mapping
        By recorder: times (n,), and (name, field, values (n, n_members, *shape)).
    members : ndarray
        Member numbers.
    attributes : mapping
        Of the dataset; anything but text and numbers is stored as JSON.
    parameters : mapping, optional
        Read back from the components: (unit, values (n_members, *shape)) by path.
    """
    import xarray

    labels = _Labels()
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {"member": members}
    seen: set[str] = set()
    axes = time_axes({record: times for record, (times, _) in records.items()})
    for record, (times, arrays) in records.items():
        dimension = axes[record]
        coordinates[dimension] = (dimension, times, {"units": "s", "long_name": "time"})
        for name, field, values in arrays:
            key = name if name not in seen else f"{name}@{record}"
            seen.add(name)
            dims = [dimension, "member", *labels.names(field, values.shape[2:])]
            about = {"units": field.unit_text(), "long_name": field.doc, "frame": field.frame or ""}
            variables[key] = (dims, values, {k: v for k, v in about.items() if v})
    for path, (unit, values) in (parameters or {}).items():
        dims = ["member", *labels.names(Field(), values.shape[1:])]
        variables[f"parameter:{path}"] = (dims, values, {"units": unit})
    coordinates |= labels.coordinates
    plain = {
        k: v if isinstance(v, str | int | float) else json.dumps(v, default=_plain)
        for k, v in attributes.items()
    }
    return xarray.Dataset(variables, coordinates, {"schema": SCHEMA} | plain)


def _plain(value: Any) -> Any:
    """What JSON does not know: numbers and arrays of NumPy, else the text of it."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)


def from_recorders(recorders: list[Recorder]) -> dict[str, Any]:
    """Read back what recorders hold, in the form `build_dataset` takes."""
    found: dict[str, Any] = {}
    for recorder in recorders:
        times, arrays = recorder.history()
        found[recorder.name] = (
            times,
            [(v.name, v.field, arrays[v.name]) for v in recorder.variables],
        )
    return found


def write_netcdf(dataset: xarray.Dataset, path: Path) -> None:
    """Write a dataset to a NetCDF-4 file, whole or not at all."""
    with replacing(path) as partial:
        try:
            dataset.to_netcdf(partial, engine="netcdf4", format="NETCDF4")
        except RuntimeError as error:  # how the library reports a full disk
            raise OSError(str(error)) from error


def read_result(path: str | Path) -> xarray.Dataset:
    """Read a result file.

    Raises
    ------
    ConfigurationError
        If the file is absent, damaged, no result, or of a schema this version cannot read.
    """
    import xarray

    path = Path(path)
    if not path.is_file():
        raise ConfigurationError(f"there is no result file '{path}'")
    try:
        dataset = xarray.load_dataset(path, engine="netcdf4")
    except (OSError, ValueError, RuntimeError) as error:
        raise ConfigurationError(f"'{path}' is damaged or no NetCDF file") from error
    schema = dataset.attrs.get("schema")
    if schema != SCHEMA:
        raise ConfigurationError(
            f"'{path}' has schema {schema!r}; this version reads {SCHEMA!r}\n"
            "  read it with the version of terrafix that wrote it"
        )
    return dataset


def salvage(folder: str | Path) -> xarray.Dataset:
    """Build a dataset from the chunks that an interrupted run left behind.

    Raises
    ------
    ConfigurationError
        If the folder holds no records.
    """
    folder = Path(folder)
    try:
        description = json.loads((folder / MANIFEST).read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise ConfigurationError(f"'{folder}' holds no records: {error}") from error
    schema = description.get("schema") if isinstance(description, dict) else None
    if schema != RECORDS_SCHEMA:
        raise ConfigurationError(
            f"'{folder}' has schema {schema!r}; this version reads {RECORDS_SCHEMA!r}\n"
            "  read it with the version of terrafix that wrote it"
        )
    records: dict[str, Any] = {}
    for name, variables in description["recorders"].items():
        fields = [
            Field(
                tuple(v["shape"]),
                v["unit"] if isinstance(v["unit"], str) else tuple(v["unit"]),
                v["frame"],
                np.dtype(v["dtype"]),
                v["ragged"],
                tuple(v["labels"]),
                v["doc"],
            )
            for v in variables
        ]
        chunks = read_chunks(folder, name)
        if not chunks:
            continue
        declared = [Variable(v["name"], f) for v, f in zip(variables, fields, strict=True)]
        times, arrays = join(chunks, declared, [])
        records[name] = (times, [(d.name, d.field, arrays[d.name]) for d in declared])
    about = description["about"]
    members = np.asarray(about["members"], dtype=np.int64)
    return build_dataset(records, members, about | {"status": "interrupted"})
