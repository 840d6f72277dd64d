"""Messages while a simulation runs: the latest value of each member, and who has read it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray, Mask, read_only
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.memory.slots import Saved, SignalSlot, restore


class MessageSlot(SignalSlot):
    """Memory of one message: the latest valid value of each member, with its time and number.

    Attributes
    ----------
    t : ndarray, shape (n_members,)
        Time of validity [s]; NaN before the first message.
    sequence : ndarray of int64, shape (n_members,)
        Number of messages published so far to each member.
    count : ndarray of int64, shape (n_members,)
        Used length of the first axis of a ragged message.
    version : int
        Grows with every publication that reached any member.
    """

    def __init__(self, fields: Mapping[str, Field], n_members: int) -> None:
        super().__init__(fields, n_members)
        self.t = np.full(n_members, np.nan)
        self.sequence = np.zeros(n_members, dtype=np.int64)
        self.count = np.zeros(n_members, dtype=np.int64)
        self.version = 0

    def copy_from(self, other: MessageSlot, factor: FloatArray | None = None) -> None:
        """Take over value, time and sequence of another slot, converted by `factor`."""
        if factor is None:
            self.data[...] = other.data
        else:
            np.multiply(other.data, factor, out=self.data)
        self.t[...] = other.t
        self.sequence[...] = other.sequence
        self.count[...] = other.count
        self.version = other.version

    def get_state(self) -> Saved:
        """Arrays that reproduce the slot."""
        return super().get_state() | {
            "t": self.t.copy(),
            "sequence": self.sequence.copy(),
            "count": self.count.copy(),
            "version": self.version,
        }

    def set_state(self, saved: Saved) -> None:
        """Put back what `get_state` gave."""
        super().set_state(saved)
        restore(self.t, saved["t"])
        restore(self.sequence, saved["sequence"])
        restore(self.count, saved["count"])
        self.version = int(saved["version"])


class MessageWriter:
    """What a component publishes messages with.

    Attributes
    ----------
    slot : MessageSlot
    draft : dict of str to ndarray
        Arrays a kernel may fill before `publish_draft`; consumers do not see them.
    """

    def __init__(
        self, name: str, fields: Mapping[str, Field], n_members: int, active: Mask
    ) -> None:
        self.slot = MessageSlot(fields, n_members)
        ragged = (f.fixed_shape[0] for f in fields.values() if f.ragged)
        self._capacity = max(ragged, default=0)
        self._name = name
        self._active = active
        self._draft: MessageSlot | None = None
        self._fields = dict(fields)

    @property
    def draft(self) -> dict[str, NDArray[Any]]:
        """Scratch arrays of every field, shape (n_members, *shape)."""
        if self._draft is None:
            self._draft = MessageSlot(self._fields, len(self.slot.t))
        return self._draft.views

    def publish_draft(self, t: float, valid: Mask) -> None:
        """Publish what stands in `draft` to the members in `valid`."""
        assert self._draft is not None
        self._commit(t, valid & self._active, self._draft.data)

    def publish(
        self,
        t: float | FloatArray,
        value: object = None,
        *,
        valid: Mask | None = None,
        count: object = None,
        **fields: object,
    ) -> None:
        """Publish a message.

        Parameters
        ----------
        t : float or ndarray, shape (n_members,)
            Time of validity [s].
        value : array_like, shape (n_members, *shape)
            Of a message with one field.
        valid : ndarray of bool, shape (n_members,), optional
            Members that receive it; all if absent.
        count : array_like of int, optional
            Used length of a ragged message.
        **fields : array_like
            Of a message with named fields; all must be given.
        """
        mask = self._active if valid is None else (valid & self._active)
        draft = self.draft
        given = {"": value} if "" in draft else fields
        missing = set(draft) - {k for k, v in given.items() if v is not None}
        extra = set(given) - set(draft)
        if missing or extra:
            raise ValueError(
                f"message '{self._name}' has fields {sorted(draft)}; "
                f"missing {sorted(missing)}, unknown {sorted(extra)}"
            )
        for name, each in given.items():
            draft[name][...] = each
        if self._capacity:
            if count is None:
                raise ValueError(f"message '{self._name}' is ragged; give its count")
            counts = np.broadcast_to(np.asarray(count, dtype=np.int64), mask.shape)
            outside = mask & ((counts < 0) | (counts > self._capacity))
            if outside.any():
                raise ValueError(
                    f"message '{self._name}' holds up to {self._capacity}, its count is "
                    f"{counts[outside][0]}"
                )
            np.copyto(self.slot.count, counts, where=mask)
        assert self._draft is not None
        self._commit(t, mask, self._draft.data)

    def _commit(self, t: float | FloatArray, mask: Mask, data: NDArray[Any]) -> None:
        if not mask.any():
            return
        slot = self.slot
        np.copyto(slot.data, data, where=mask[:, None])
        np.copyto(slot.t, t, where=mask)
        slot.sequence += mask
        slot.version += 1


class MessageReader:
    """What a component sees of a message.

    Attributes
    ----------
    fresh : ndarray of bool, shape (n_members,)
        A message came since this component's last step.
    t : ndarray, shape (n_members,)
        Time of validity [s].
    sequence : ndarray of int64, shape (n_members,)
        Number of the message; a changed number is a new message.
    count : ndarray of int64, shape (n_members,)
        Used length of a ragged message.
    value : ndarray, shape (n_members, *shape)
        Of a message with one field; named fields are attributes.
    overruns : int
        Messages lost, over all members, because they were replaced before they were read.
    queued : list of dict
        With a queue deeper than one: the unread messages, oldest first, each with ``t``,
        ``valid`` (n_members,) and its fields.
    """

    def __init__(self, slot: MessageSlot, *, depth: int = 1, at_zero: bool = True) -> None:
        self.depth = depth
        self.slot = slot
        self._at_zero = at_zero
        self.fresh: Mask = np.zeros(len(slot.t), dtype=np.bool_)
        self.fresh_number = np.zeros(len(slot.t))  # the same for kernels: 0.0 or 1.0
        self.overruns = 0
        self._seen = np.zeros(len(slot.t), dtype=np.int64)
        self._version = 0
        self._collected = 0
        self._last_collected = np.zeros(len(slot.t), dtype=np.int64)
        self._any_fresh = False
        self._waiting: list[Saved] = []
        self._released: list[Saved] | None = None
        self.queued: list[Saved] = []
        self._fields = {name: read_only(view) for name, view in slot.views.items()}
        self.t = read_only(slot.t)
        self.sequence = read_only(slot.sequence)
        self.count = read_only(slot.count)

    @property
    def value(self) -> NDArray[Any]:
        """The value of a message with a single field."""
        return self._fields[""]

    def __getattr__(self, name: str) -> NDArray[Any]:
        fields = self.__dict__.get("_fields", {})
        if name in fields:
            view: NDArray[Any] = fields[name]
            return view
        raise AttributeError(f"there is no field '{name}'; the fields are {sorted(fields)}")

    @property
    def waiting(self) -> bool:
        """Whether a message came that `refresh` has not seen."""
        return self.slot.version != self._version

    def collect(self, slot: MessageSlot) -> None:
        """Keep a copy of what was just published to `slot` (queues deeper than one)."""
        if slot.version == self._collected:
            return
        self._collected = slot.version
        valid = slot.sequence > self._last_collected
        self._last_collected[:] = slot.sequence
        record: Saved = {"valid": valid, "t": slot.t.copy(), "sequence": slot.sequence.copy()}
        record |= {name or "value": view.copy() for name, view in slot.views.items()}
        record["count"] = slot.count.copy()
        self._waiting.append(record)
        if len(self._waiting) > self.depth:
            self.overruns += int(self._waiting.pop(0)["valid"].sum())

    def release(self) -> None:
        """Let the next step see what waits now, and nothing later (queues read at the start)."""
        self._released, self._waiting = self._waiting, []

    def refresh(self, tick: int) -> None:
        """Before the component steps: find out what is new.

        At t = 0 this is so for components that step or publish then; for others, messages stay
        unread until their first step.
        """
        if tick == 0 and not self._at_zero:
            return
        slot = self.slot
        if slot.version == self._version:
            if self._any_fresh:
                self.fresh[:] = False
                self.fresh_number[:] = 0.0
                self.queued = []
                self._any_fresh = False
            return
        np.greater(slot.sequence, self._seen, out=self.fresh)
        self.fresh_number[:] = self.fresh
        if self.depth == 1:
            unread = slot.sequence - self._seen - 1
            self.overruns += int(unread[unread > 0].sum())
        elif self._released is None:
            self.queued, self._waiting = self._waiting, []
        else:
            self.queued, self._released = self._released, []
        self._seen[:] = slot.sequence
        self._version = slot.version
        self._any_fresh = True

    def get_state(self) -> Saved:
        """Arrays that reproduce the reader."""
        return {
            "fresh": self.fresh.copy(),
            "seen": self._seen.copy(),
            "version": self._version,
            "collected": self._collected,
            "last_collected": self._last_collected.copy(),
            "overruns": self.overruns,
            "waiting": [dict(record) for record in self._waiting],
            "released": self._released and [dict(record) for record in self._released],
        }

    def set_state(self, saved: Saved) -> None:
        """Put back what `get_state` gave."""
        restore(self.fresh, saved["fresh"])
        self.fresh_number[:] = self.fresh
        self._any_fresh = bool(self.fresh.any())
        restore(self._seen, saved["seen"])
        self._version = int(saved["version"])
        self._collected = int(saved["collected"])
        restore(self._last_collected, saved["last_collected"])
        self.overruns = int(saved["overruns"])
        self._waiting = [dict(record) for record in saved["waiting"]]
        self._released = saved["released"] and [dict(record) for record in saved["released"]]
