"""Declarations of ports, states and parameters: class attributes that are a component's interface.

A declaration says name, shape, unit, frame and meaning. The arrays behind it are made when a
simulation is built; on a component, ``self.delta_v`` is then the array, ensemble axis first.

Kinds of port
-------------
signal
    held until rewritten; one array, or a bundle of named fields;
message
    value, time of validity and validity per member; fresh once per consumer;
window
    (input) all samples of a signal since the consumer's last step;
shared
    one value for all members, passed by reference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any, Generic, Literal, Self, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.memory.fields import Field, Unit, quoted
from terrafix.cosim.memory.messages import MessageReader, MessageWriter
from terrafix.cosim.memory.slots import BundleView, WindowView

When = Literal["start", "end"]
Kind = Literal["signal", "message", "shared"]
Default = ArrayLike | Mapping[str, ArrayLike]
"""What an unconnected input reads: of a bundle by field."""
View_co = TypeVar("View_co", covariant=True)
MOST_WRITTEN = 9  # numbers of an array
LONGEST_WRITTEN = 60  # characters of a value
MOST_FIELDS = 3  # of a bundle, in a repr
_OF_MESSAGES = ("t", "value", "valid", "count", "fresh", "sequence")  # what every message has


class Declaration:
    """Anything declared as a class attribute; learns its name from the class body."""

    name: str = ""
    doc: str = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def _arguments(self) -> list[str]:
        """What its constructor was given, as it is written in Python; its meaning left out."""
        return []

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._arguments())})"

    def _absent(self, obj: object, what: str) -> AttributeError:
        """What a person is told who reads a component outside a simulation."""
        owner = getattr(obj, "name", "") or type(obj).__name__
        return AttributeError(f"'{owner}.{self.name}' {what}", name=self.name, obj=obj)


def written(value: object) -> str:
    """Write a value as in Python, in one short line."""
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist() if value.size <= MOST_WRITTEN else f"array {value.shape}"
    text = str(value)
    return text if len(text) <= LONGEST_WRITTEN else f"{text[: LONGEST_WRITTEN - 3]}..."


class Port(Declaration, Generic[View_co]):
    """Base of all ports. Reading one on a component gives its `View_co`, once bound.

    Attributes
    ----------
    kind : {"signal", "message", "shared"}
    is_input : bool
    fields : dict of str to Field
        A single field named ``""`` unless the port is a bundle.
    at : {"start", "end"}
        When an input is read.
    default : float, array or None
        What an unconnected input reads; None if it must be connected.
    queue : int
        How many unread messages are kept.
    window : bool
        Whether an input collects all samples since the last step.
    needed_at_start : bool
        Whether a message must have come at t = 0; members without it are excluded.
    """

    kind: Kind = "signal"
    is_input: bool = False

    def __init__(
        self,
        shape: Sequence[int | None] = (),
        *,
        unit: Unit = "1",
        frame: str | None = None,
        dtype: DTypeLike = np.float64,
        ragged: bool = False,
        labels: Sequence[str] = (),
        fields: Mapping[str, Field] | None = None,
        doc: str = "",
        at: When = "end",
        default: Default | None = None,
        queue: int = 1,
        window: bool = False,
        optional: bool = False,
        needed_at_start: bool = False,
    ) -> None:
        if isinstance(shape, int) or any(n is not None and n < 1 for n in shape):
            raise ConfigurationError(f"shape is {shape}; it is a tuple of sizes, such as (3,)")
        if fields is None:
            one = Field(tuple(shape), unit, frame, dtype, ragged, tuple(labels), doc)
            self.fields: dict[str, Field] = {"": one}
        else:
            self.fields = dict(fields)
            if not self.fields or "" in self.fields:
                raise ConfigurationError("a bundle needs named fields")
            for name, each in self.fields.items():
                if not name.isidentifier():
                    raise ConfigurationError(
                        f"'{name}' cannot name a field: use letters, digits and underscores"
                    )
                if self.kind == "message" and name in _OF_MESSAGES:
                    raise ConfigurationError(
                        f"'{name}' cannot name a field: it is what every message has\n"
                        f"  call it otherwise than {', '.join(_OF_MESSAGES)}"
                    )
                if each.ragged or np.dtype(each.dtype) != np.float64:
                    raise ConfigurationError(f"field '{name}': bundles hold float64, not ragged")
        if ragged and not shape:
            raise ConfigurationError("a ragged port needs a capacity as its first extent")
        if ragged and self.kind != "message":
            raise ConfigurationError(
                "only a message is ragged: its count travels with it\n"
                "  declare a message, or a shared port with an open extent (None)"
            )
        if self.kind != "shared" and any(None in f.shape for f in self.fields.values()):
            raise ConfigurationError(
                f"shape {tuple(shape)} is open; only shared ports may be\n"
                "  declare a ragged message with a capacity"
            )
        if window and at == "start":
            raise ConfigurationError(
                "a window is read at the end of the step: it holds the samples up to then"
            )
        if at not in ("start", "end"):
            raise ConfigurationError(f"an input is read at 'start' or 'end', not '{at}'")
        if queue < 1:
            raise ConfigurationError(f"queue depth is {queue}; it must be at least 1")
        self.doc = doc
        self.at: When = at
        self.default = default
        self.queue = queue
        self.window = window
        self.needed_at_start = needed_at_start
        self.optional = optional or default is not None

    @property
    def is_bundle(self) -> bool:
        """Whether the port has named fields."""
        return "" not in self.fields

    @property
    def single(self) -> Field:
        """The field of a port that is no bundle."""
        return self.fields[""]

    def _arguments(self) -> list[str]:
        given = self._bundled() if self.is_bundle else self.single.arguments()
        if self.at != "end":
            given.append(f"at={quoted(self.at)}")
        if self.default is not None:
            given.append(f"default={written(self.default)}")
        elif self.optional:
            given.append("optional=True")
        if self.queue != 1:
            given.append(f"queue={self.queue}")
        if self.needed_at_start:
            given.append("needed_at_start=True")
        return given

    def _bundled(self) -> list[str]:
        listed = [f"{quoted(name)}: {field!r}" for name, field in self.fields.items()]
        if len(listed) > MOST_FIELDS + 1:
            listed[MOST_FIELDS:] = [f"... {len(listed) - MOST_FIELDS} more"]
        keyword = "fields=" if self.kind == "message" else ""
        return [f"{keyword}{{{', '.join(listed)}}}"]

    @overload
    def __get__(self, obj: None, owner: type) -> Self: ...
    @overload
    def __get__(self, obj: object, owner: type) -> View_co: ...
    def __get__(self, obj: object | None, owner: type) -> Self | View_co:
        if obj is None:
            return self
        try:
            return obj.port_views[self.name]  # type: ignore[attr-defined, no-any-return]
        except KeyError:
            what = f'is a port: it has a value only in a simulation; ["{self.name}"] names it'
            raise self._absent(obj, what) from None

    def __set__(self, obj: object, value: object) -> None:
        raise AttributeError(f"'{self.name}' is an input: components do not write their inputs")


class Input(Port[FloatArray]):
    """A signal that is read: ndarray, shape (n_members, *shape), not writable."""

    is_input = True


class Output(Port[FloatArray]):
    """A signal that is published; assigning copies into the published array."""

    def __set__(self, obj: object, value: object) -> None:
        array = obj.port_views[self.name]  # type: ignore[attr-defined]
        try:
            array[...] = value
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"output '{self.name}' takes {array.dtype} of shape {array.shape}, members first, "
                f"not {_described(value)}"
            ) from error


def _described(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} of shape {value.shape}"
    return f"{value!r}"[:60]


class BundleInput(Port[BundleView]):
    """A signal of several named fields that is read: ``self.prior.r_e``."""

    is_input = True

    def __init__(
        self,
        fields: Mapping[str, Field],
        *,
        at: When = "end",
        default: Default | None = None,
        optional: bool = False,
        doc: str = "",
    ) -> None:
        super().__init__(fields=fields, at=at, default=default, optional=optional, doc=doc)


class BundleOutput(Port[BundleView]):
    """A signal of several named fields that is published."""

    def __init__(self, fields: Mapping[str, Field], *, doc: str = "") -> None:
        super().__init__(fields=fields, doc=doc)

    def __set__(self, obj: object, value: object) -> None:
        raise AttributeError(f"'{self.name}' is a bundle: assign to its fields")


class MessageInput(Port[MessageReader]):
    """A message that is read: ``self.fix.fresh``, ``self.fix.t``, ``self.fix.y``."""

    kind = "message"
    is_input = True


class MessageOutput(Port[MessageWriter]):
    """A message that is published with ``self.fix.publish(t, valid=..., y=...)``."""

    kind = "message"

    def __set__(self, obj: object, value: object) -> None:
        raise AttributeError(f"'{self.name}' is a message: call its publish(...)")


class WindowInput(Port[WindowView]):
    """All samples of a signal since the last step: ``self.echo.samples``, ``self.echo.times``."""

    is_input = True

    def __init__(
        self,
        shape: Sequence[int | None] = (),
        *,
        unit: Unit = "1",
        frame: str | None = None,
        dtype: DTypeLike = np.float64,
        labels: Sequence[str] = (),
        at: When = "end",
        default: Default | None = None,
        optional: bool = False,
        doc: str = "",
    ) -> None:
        super().__init__(
            shape,
            unit=unit,
            frame=frame,
            dtype=dtype,
            labels=labels,
            at=at,
            default=default,
            optional=optional,
            window=True,
            doc=doc,
        )


class _Shared(Port[NDArray[Any]]):
    """One value for all members, passed by reference."""

    kind = "shared"

    @overload
    def __get__(self, obj: None, owner: type) -> Self: ...
    @overload
    def __get__(self, obj: object, owner: type) -> NDArray[Any]: ...
    def __get__(self, obj: object | None, owner: type) -> Self | NDArray[Any]:
        if obj is None:
            return self
        slot: Any = super().__get__(obj, owner)
        return slot.value  # type: ignore[no-any-return]


class SharedInput(_Shared):
    """One value for all members, read by reference."""

    is_input = True


class SharedOutput(_Shared):
    """One value for all members; assigning publishes the array itself, without a copy."""

    def __set__(self, obj: object, value: object) -> None:
        obj.port_views[self.name].put(value)  # type: ignore[attr-defined]


class State(Declaration):
    """An array kept between steps: ndarray, shape (n_members, *shape). Part of checkpoints."""

    def __init__(
        self,
        shape: Sequence[int] = (),
        *,
        unit: Unit = "1",
        frame: str | None = None,
        dtype: DTypeLike = np.float64,
        start: ArrayLike = 0,
        doc: str = "",
    ) -> None:
        self.field = Field(tuple(shape), unit, frame, dtype, doc=doc)
        self.start = start
        self.doc = doc

    def _arguments(self) -> list[str]:
        start = [] if np.array_equal(self.start, 0) else [f"start={written(self.start)}"]
        return [*self.field.arguments(), *start]

    @overload
    def __get__(self, obj: None, owner: type) -> Self: ...
    @overload
    def __get__(self, obj: object, owner: type) -> NDArray[Any]: ...
    def __get__(self, obj: object | None, owner: type) -> Self | NDArray[Any]:
        if obj is None:
            return self
        try:
            return obj.state_arrays[self.name]  # type: ignore[attr-defined, no-any-return]
        except KeyError:
            raise self._absent(obj, "is a state: it has a value only in a simulation") from None

    def __set__(self, obj: object, value: object) -> None:
        obj.state_arrays[self.name][...] = value  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Capabilities:
    """What a component can do, asked before it is used (as in an FMU's model description).

    Parameters
    ----------
    state : bool
        `get_state` and `set_state` reproduce the component: checkpoints are possible.
    symbolic : bool
        It offers a symbolic model: kernels, Jacobians, export.
    deterministic : bool
        The same inputs and seed give the same bytes.
    given : bool
        It draws no noise: what it publishes follows from the time, its parameters and what it
        reads, and where it reads nothing, nothing of it deviates but with dispersed parameters.
    """

    state: bool = True
    symbolic: bool = False
    deterministic: bool = True
    given: bool = False
    notes: tuple[str, ...] = dataclass_field(default=())
