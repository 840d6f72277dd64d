"""What stands behind ports while a simulation runs: slots, and the views components see.

A *slot* holds what an output published, ensemble axis first. A reader is a view of a slot: the
slot's own memory where nothing has to be converted, latched or delayed, else a private copy that
a `links.Transfer` fills.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray, read_only
from terrafix.cosim.basics.errors import CheckpointError
from terrafix.cosim.memory.fields import Field

Saved = dict[str, Any]


UNWRITTEN = np.uint64(0x7FF8_0000_0000_7E44)
"""Bits of a NaN that no computation gives: stands where nothing was published."""


class SignalSlot:
    """Memory of one signal: a flat row per member, and a shaped view for each field.

    Attributes
    ----------
    data : ndarray, shape (n_members, width)
        All fields side by side (of the field's dtype if the port has one field).
    views : dict of str to ndarray, shape (n_members, *shape)
        Writable windows into `data`.
    """

    def __init__(self, fields: Mapping[str, Field], n_members: int) -> None:
        dtype = np.dtype(next(iter(fields.values())).dtype)
        width = sum(f.size for f in fields.values())
        empty = np.nan if dtype.kind in "fc" else 0
        self.data: NDArray[Any] = np.full((n_members, width), empty, dtype=dtype)
        if dtype == np.float64:
            self.data.view(np.uint64)[...] = UNWRITTEN
        self.views: dict[str, NDArray[Any]] = {}
        start = 0
        for name, each in fields.items():
            columns = self.data[:, start : start + each.size]
            self.views[name] = _strided(columns, each.fixed_shape)
            start += each.size

    @property
    def never_written(self) -> bool:
        """Whether nothing was published here yet (known of float64 alone)."""
        if self.data.dtype != np.float64 or not self.data.size:
            return False
        return bool((self.data.view(np.uint64) == UNWRITTEN).all())

    def get_state(self) -> Saved:
        """Arrays that reproduce the slot."""
        return {"data": self.data.copy()}

    def set_state(self, saved: Saved) -> None:
        """Put back what `get_state` gave."""
        restore(self.data, saved["data"])


def _strided(columns: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """View part of each row as an array of `shape`, without a copy."""
    strides, step = [], columns.itemsize
    for extent in reversed(shape):
        strides.append(step)
        step *= extent
    return np.lib.stride_tricks.as_strided(
        columns, (columns.shape[0], *shape), (columns.strides[0], *reversed(strides))
    )


def restore(target: NDArray[Any], source: NDArray[Any]) -> None:
    """Put a saved array back; CheckpointError if it has another shape."""
    if target.shape != np.shape(source):
        raise CheckpointError(f"saved array has shape {np.shape(source)}, expected {target.shape}")
    target[...] = source


class BundleView:
    """Fields of a bundle by name; assigning copies into the published array."""

    def __init__(self, views: Mapping[str, NDArray[Any]], *, writable: bool) -> None:
        for name, array in views.items():
            self.__dict__[name] = array if writable else read_only(array)
        self.__dict__["_writable"] = writable

    def __getattr__(self, name: str) -> FloatArray:
        fields = [k for k in self.__dict__ if not k.startswith("_")]
        raise AttributeError(f"there is no field '{name}'; the fields are {fields}")

    def __setattr__(self, name: str, value: object) -> None:
        if not self.__dict__["_writable"]:
            raise AttributeError(
                f"field '{name}' is an input: components do not write their inputs"
            )
        getattr(self, name)[...] = value


class WindowView:
    """All samples of a signal since the consumer's last step.

    Attributes
    ----------
    samples : ndarray, shape (n_members, n_samples, *shape)
    times : ndarray, shape (n_samples,)
        When each was published [s].
    """

    def __init__(self, source: NDArray[Any], capacity: int, factor: FloatArray | None) -> None:
        self._source = source
        self._factor = None if factor is None else factor.reshape(source.shape[1:])
        n_members = source.shape[0]
        self._values: NDArray[Any] = np.empty(
            (n_members, capacity, *source.shape[1:]), dtype=source.dtype
        )
        self._times = np.empty(capacity)
        self.n_samples = 0

    @property
    def samples(self) -> NDArray[Any]:
        """The samples, oldest first."""
        return self._values[:, : self.n_samples]

    @property
    def times(self) -> FloatArray:
        """The time of each sample [s]."""
        return self._times[: self.n_samples]

    def collect(self, t: float) -> None:
        """Append what the source holds now."""
        if self.n_samples == len(self._times):
            self._grow()
        self._values[:, self.n_samples] = self._source
        if self._factor is not None:
            self._values[:, self.n_samples] *= self._factor
        self._times[self.n_samples] = t
        self.n_samples += 1

    def _grow(self) -> None:
        values = np.empty_like(
            self._values,
            shape=(self._values.shape[0], 2 * len(self._times), *self._values.shape[2:]),
        )
        values[:, : self.n_samples] = self.samples
        self._values = values
        self._times = np.concatenate([self._times, np.empty_like(self._times)])

    def clear(self) -> None:
        """Forget the samples once the consumer has stepped."""
        self.n_samples = 0

    def get_state(self) -> Saved:
        """Arrays that reproduce the window."""
        return {"samples": self.samples.copy(), "times": self.times.copy()}

    def set_state(self, saved: Saved) -> None:
        """Put back what `get_state` gave."""
        while len(self._times) < len(saved["times"]):
            self._grow()
        self.n_samples = len(saved["times"])
        self._values[:, : self.n_samples] = saved["samples"]
        self._times[: self.n_samples] = saved["times"]


class SharedSlot:
    """One value for all members; readers hold the slot and see what was put last."""

    def __init__(self, field: Field, name: str, *, value: Any = None) -> None:
        self._field = field
        self._name = name
        self.value = value
        self.version = 0

    def put(self, value: Any) -> None:
        """Publish an array by reference, after checking its shape and type."""
        array = np.asarray(value)
        expected = self._field.shape
        matches = len(expected) == array.ndim and all(
            e is None or e == n for e, n in zip(expected, array.shape, strict=True)
        )
        if not matches or array.dtype != np.dtype(self._field.dtype):
            raise ValueError(
                f"shared port '{self._name}' takes shape {expected} of "
                f"{np.dtype(self._field.dtype)}, got {array.shape} of {array.dtype}"
            )
        self.value = read_only(array)
        self.version += 1

    def refer_to(self, other: SharedSlot) -> None:
        """Hold what another slot holds now."""
        self.value, self.version = other.value, other.version

    def get_state(self) -> Saved:
        """Arrays that reproduce the slot."""
        value = self.value
        return {"version": self.version} | ({} if value is None else {"value": np.array(value)})

    def set_state(self, saved: Saved) -> None:
        """Put back what `get_state` gave; what initialization published again is kept."""
        if int(saved["version"]) != self.version and "value" in saved:
            self.put(saved["value"])
        self.version = int(saved["version"])
