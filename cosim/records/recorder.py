"""Recorders: they observe ports at their own rate and cannot influence a run.

While a run goes on, samples are kept in chunks. With a folder, each chunk is written to a file
of its own as soon as it is full or two seconds old, so that what was recorded survives a kill;
at the end the chunks become labeled arrays (`terrafix.cosim.records.results`).
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.files import write_atomically
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.memory.messages import MessageSlot
from terrafix.cosim.memory.slots import SignalSlot

Arrays = dict[str, NDArray[Any]]
CHUNK_BYTES = 8 * 2**20
FLUSH_SECONDS = 2.0
MANIFEST = "manifest.json"
SCHEMA = "terrafix-records/1"


@dataclass(frozen=True)
class Variable:
    """One recorded array.

    Attributes
    ----------
    name : str
        Path of the port, with the field: ``"predict.prior.r_e"``.
    field : Field
        Shape, unit, frame, meaning.
    """

    name: str
    field: Field


class Recorder:
    """Samples of some ports on one time axis.

    Parameters
    ----------
    name : str
    slots : mapping of str to (port, slot)
        By port path.
    members : int
    active : ndarray of bool, shape (n_members,)
        Members that have failed are recorded as NaN.
    folder : Path, optional
        Where chunks are written.
    """

    def __init__(
        self,
        name: str,
        slots: Mapping[str, tuple[Port[Any], SignalSlot]],
        active: NDArray[np.bool_],
        folder: Path | None,
    ) -> None:
        self.name = name
        self.folder = folder
        self._active = active
        self.variables: list[Variable] = []
        self._sources: list[NDArray[Any]] = []
        self._messages: list[tuple[MessageSlot, list[int]]] = []
        for path, (port, slot) in slots.items():
            indices = []
            for field_name, view in slot.views.items():
                field = port.fields[field_name]
                indices.append(len(self.variables))
                self.variables.append(
                    Variable(f"{path}.{field_name}" if field_name else path, field)
                )
                self._sources.append(view)
            if isinstance(slot, MessageSlot):
                self._messages.append((slot, indices))
                self.variables.append(
                    Variable(f"{path}.t", Field(unit="s", doc="time of validity"))
                )
                self._sources.append(slot.t)
                indices.append(len(self.variables) - 1)
                if any(f.ragged for f in port.fields.values()):
                    count = Field(dtype=np.int64, doc="used length of the first axis")
                    self.variables.append(Variable(f"{path}.count", count))
                    self._sources.append(slot.count)
        self._counts = [  # of messages: not NaN but 0 where there is none
            next((i for i, s in enumerate(self._sources) if s is m.count), None)
            for m, _ in self._messages
        ]
        self._last_sequence = [m.sequence.copy() for m, _ in self._messages]
        row = sum(s.nbytes for s in self._sources) + 8
        self._capacity = int(np.clip(CHUNK_BYTES // max(row, 1), 1, 1024))
        self._chunk = [np.empty((self._capacity, *s.shape), dtype=s.dtype) for s in self._sources]
        self._times = np.empty(self._capacity)
        self._used = 0
        self._done: list[tuple[NDArray[np.float64], list[NDArray[Any]]]] = []
        self._n_files = 0
        self.n_samples = 0
        self._last_flush = time.monotonic()

    def sample(self, t: float) -> None:
        """Take one sample of every variable at time `t` [s]."""
        i = self._used
        self._times[i] = t
        for target, source in zip(self._chunk, self._sources, strict=True):
            target[i] = source
        for number, (slot, indices) in enumerate(self._messages):
            last = self._last_sequence[number]
            stale = slot.sequence == last
            if stale.any():
                for index in indices:
                    self._blank(index, i, stale)
                count = self._counts[number]
                if count is not None:
                    self._chunk[count][i, stale] = 0
            last[:] = slot.sequence
        if not self._active.all():
            for index in range(len(self._chunk)):
                self._blank(index, i, ~self._active)
        self._used = i + 1
        self.n_samples += 1
        if self._used == self._capacity or (
            self.folder is not None and time.monotonic() - self._last_flush > FLUSH_SECONDS
        ):
            self.flush()

    def _blank(self, index: int, i: int, mask: NDArray[np.bool_]) -> None:
        if self._chunk[index].dtype.kind in "fc":
            self._chunk[index][i, mask] = np.nan

    def flush(self) -> None:
        """Move the samples taken so far out of the working chunk: to a file, if in a folder."""
        self._last_flush = time.monotonic()
        if not self._used:
            return
        times = self._times[: self._used].copy()
        values = [c[: self._used].copy() for c in self._chunk]
        self._used = 0
        if self.folder is None:
            self._done.append((times, values))
            return
        target = self.folder / f"{self.name}.{self._n_files:06d}.npz"
        self._n_files += 1
        arrays: dict[str, Any] = {f"v{i}": v for i, v in enumerate(values)}
        write_atomically(target, lambda f: np.savez(f, t=times, **arrays))

    def history(self) -> tuple[NDArray[np.float64], Arrays]:
        """All samples: times (n,), and by name arrays (n, n_members, *shape)."""
        self.flush()
        chunks = self._done if self.folder is None else read_chunks(self.folder, self.name)
        return join(chunks, self.variables, [s.shape for s in self._sources])

    def get_state(self) -> dict[str, Any]:
        """What a checkpoint needs: everything sampled is flushed first."""
        self.flush()
        return {"n_samples": self.n_samples, "sequence": [s.copy() for s in self._last_sequence]}

    def set_state(self, saved: Mapping[str, Any]) -> None:
        """Continue after a checkpoint: samples taken later are dropped."""
        n = int(saved["n_samples"])
        for mine, kept in zip(self._last_sequence, saved["sequence"], strict=True):
            mine[:] = kept
        self._used = 0
        if self.folder is None:
            times, arrays = join(self._done, self.variables, [s.shape for s in self._sources])
            self._done = [(times[:n], [arrays[v.name][:n] for v in self.variables])]
        else:
            self._cut_files(n)
        self.n_samples = n

    def _cut_files(self, n: int) -> None:
        assert self.folder is not None
        files = chunk_files(self.folder, self.name)
        kept = 0
        for number, file in enumerate(files):
            if file.name != f"{self.name}.{number:06d}.npz":
                break  # one is missing
            (times, values) = _read_chunk(file)
            use = min(len(times), n - kept)
            if use <= 0:
                file.unlink()
                continue
            if use < len(times):
                arrays: dict[str, Any] = {f"v{i}": v[:use] for i, v in enumerate(values)}
                write_atomically(file, partial(np.savez, t=times[:use], **arrays))
            kept += use
            self._n_files = number + 1
        if kept < n:
            raise ConfigurationError(
                f"'{self.folder}' holds {kept} samples of record '{self.name}', the checkpoint "
                f"needs {n}\n  records and checkpoint belong together: keep both"
            )


def join(
    chunks: list[tuple[NDArray[np.float64], list[NDArray[Any]]]],
    variables: list[Variable],
    shapes: list[tuple[int, ...]],
) -> tuple[NDArray[np.float64], Arrays]:
    """Times and values of all samples, from chunks in their order."""
    if not chunks:
        empty = {
            v.name: np.empty((0, *shape), dtype=v.field.dtype)
            for v, shape in zip(variables, shapes, strict=True)
        }
        return np.empty(0), empty
    times = np.concatenate([t for t, _ in chunks])
    return times, {
        v.name: np.concatenate([values[i] for _, values in chunks]) for i, v in enumerate(variables)
    }


def chunk_files(folder: Path, name: str) -> list[Path]:
    """Files of one recorder, oldest first."""
    return sorted(folder.glob(f"{name}.[0-9][0-9][0-9][0-9][0-9][0-9].npz"))


def _read_chunk(file: Path) -> tuple[NDArray[np.float64], list[NDArray[Any]]]:
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
            return stored["t"], [stored[f"v{i}"] for i in range(len(stored.files) - 1)]
    except Exception as error:  # a damaged file may fail in any way
        raise ConfigurationError(f"records in '{file}' are damaged: {error}") from error


def read_chunks(folder: Path, name: str) -> list[tuple[NDArray[np.float64], list[NDArray[Any]]]]:
    """Read what a record left in a folder, in the order it was written."""
    return [_read_chunk(file) for file in chunk_files(folder, name)]


def write_manifest(folder: Path, recorders: list[Recorder], about: dict[str, Any]) -> None:
    """Describe the chunks so that they can be read without the run that wrote them."""
    description = {
        "schema": SCHEMA,
        "about": about,
        "recorders": {
            r.name: [
                {
                    "name": v.name,
                    "shape": list(v.field.fixed_shape),
                    "unit": v.field.unit,
                    "frame": v.field.frame,
                    "dtype": np.dtype(v.field.dtype).str,
                    "labels": list(v.field.labels),
                    "ragged": v.field.ragged,
                    "doc": v.field.doc,
                }
                for v in r.variables
            ]
            for r in recorders
        },
    }
    text = json.dumps(description).encode()
    write_atomically(folder / MANIFEST, lambda f: f.write(text))
