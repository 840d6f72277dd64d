"""From a model description to ports, parameters and capabilities.

An FMU that terrafix exported says in an annotation which variables form a port, what kind it is,
its frames and when inputs are read. Of any other FMU, scalars called ``r[1]``, ``r[2]``, ... that
belong together form an array port, everything else is a port of its own; names that are no
identifiers are written with underscores.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.units import SI_BASE, check_unit, unit_by_definition, unit_by_name
from terrafix.cosim.exchange.fmi.run.archive import Archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION, MODEL_EXCHANGE
from terrafix.cosim.exchange.fmi.run.clocks import TRIGGERED
from terrafix.cosim.exchange.fmi.run.whole import BOOLEAN, INTEGER, whole_start
from terrafix.cosim.memory.fields import Field, Unit

REAL = ("Real", "Float64", "Float32")
CONNECTED = ("input", "output")
PARAMETERS = ("parameter", "structuralParameter")
_SETTABLE = ("exact", "approx")
_KNOWN = ("input", "parameter", "structuralParameter", "independent")
_ELEMENT = re.compile(r"(.+)\[(\d+(?:,\d+)*)\]\Z")


@dataclass
class Quantity:
    """One or several variables of an FMU that are a number or an array together.

    Attributes
    ----------
    name : str
        As the FMU has it, without indices.
    kind : str
        Type of the variables: ``Float64``, ``Real``, ...
    references : list of int
        Value references: one of an FMI 3 array, one for each scalar.
    shape : tuple of int
    unit : str or tuple of str
    start : list of float or int, or None
    causality, variability : str
    doc : str
    base : int
        Index of the first element, in names.
    variables : sequence
        As FMPy read them.
    texts : list of str or None
        Start values of a String.
    initial : str or None
        How the start is found, as far as the description says.
    items : dict of str to int
        Of an enumeration, by name.
    """

    name: str
    kind: str
    references: list[int]
    shape: tuple[int, ...]
    unit: Unit = "1"
    start: list[float] | list[int] | None = None
    causality: str = "local"
    variability: str = "continuous"
    doc: str = ""
    base: int = 1
    variables: Sequence[Any] = ()
    texts: list[str] | None = None
    initial: str | None = None
    items: dict[str, int] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape, dtype=np.int64))

    def scalars(self) -> list[str]:
        """Names of its elements as FMI 2 has them: ``r[1]``, ``P[1,2]``."""
        if not self.shape:
            return [self.name]
        return [
            f"{self.name}[{','.join(str(i + self.base) for i in index)}]"
            for index in np.ndindex(self.shape)
        ]

    def field(self, frame: str | None = None) -> Field:
        """The port's field for it."""
        dtype: Any = np.float64
        if self.kind in BOOLEAN:
            dtype = np.bool_
        elif self.kind in INTEGER:
            dtype = np.int64
        return Field(self.shape, self.unit, frame, dtype, doc=self.doc)


@dataclass
class ImportedPort:
    """A port and the variables behind it.

    Attributes
    ----------
    name : str
    kind : {"signal", "message"}
    is_input : bool
    at : {"start", "end"} or None
        None where the FMU does not say.
    fields : dict of str to (Quantity, frame)
    t, sequence : Quantity or None
        Of a message.
    """

    name: str
    kind: str
    is_input: bool
    at: str | None
    fields: dict[str, tuple[Quantity, str | None]] = field(default_factory=dict)
    t: Quantity | None = None
    sequence: Quantity | None = None


@dataclass
class Interface:
    """What terrafix needs to know of an FMU.

    Attributes
    ----------
    archive : Archive
    kind : str
        ``"co-simulation"`` or ``"model exchange"``: how it is run.
    ports : list of ImportedPort
    parameters : dict of str to Quantity
        Numbers.
    text_parameters : dict of str to Quantity
    left_out : list of str
        Inputs and outputs of types that have no port (text, binary, clocks).
    state, serialize : bool
        Whether its state can be got and set, and written as bytes.
    own : bool
        Whether terrafix wrote it.
    once : bool
        Whether it says that a process can have one instance of it.
    texts : dict of str to int
        Value references of texts that may be set before initialization, by name.
    """

    archive: Archive
    kind: str
    ports: list[ImportedPort]
    parameters: dict[str, Quantity]
    left_out: list[str]
    state: bool
    serialize: bool
    own: bool
    once: bool = False
    text_parameters: dict[str, Quantity] = field(default_factory=dict)
    texts: dict[str, int] = field(default_factory=dict)

    @property
    def event_mode(self) -> bool:
        """Whether its co-simulation is to be run with event mode (FMI 3): it has it, and a use.

        Discrete inputs are set and clocks tick there. Without them an FMU handles events itself.
        """
        return uses_event_mode(self.archive, self.kind)

    @property
    def input_clocks(self) -> list[str]:
        """Clocks that its environment should let tick."""
        return [clock.name for clock in self.archive.clocks]

    @property
    def clocked_inputs(self) -> list[str]:
        """Inputs that can be connected and belong to clocks."""
        variables = self.archive.description.modelVariables
        inputs = [v for v in variables if v.causality == "input" and v.type != "Clock"]
        return [v.name for v in inputs if v.clocks and v.name not in self.left_out]

    @property
    def silent_clocks(self) -> list[str]:
        """Those that never tick here: triggered ones, and all where there is no event mode."""
        driven = self.kind != CO_SIMULATION or self.event_mode
        return [c.name for c in self.archive.clocks if c.kind == TRIGGERED or not driven]

    @property
    def said_of_parameters(self) -> list[Any]:
        """What the annotation says of parameters: frames, and which must be positive."""
        found = self.archive.annotation
        return [] if found is None else list(found.iter("Parameter"))

    def copy(self) -> Interface:
        """One whose ports can be added to, and their units changed."""
        ports = [
            replace(p, fields={n: (replace(q), frame) for n, (q, frame) in p.fields.items()})
            for p in self.ports
        ]
        return replace(self, ports=ports)


def uses_event_mode(archive: Archive, kind: str) -> bool:
    """Whether an FMU has event mode in co-simulation (FMI 3), and a use for it."""
    interface = archive.description.coSimulation
    if kind != CO_SIMULATION or not getattr(interface, "hasEventMode", False):
        return False
    return any(
        v.type == "Clock" or (v.causality == "input" and v.variability == "discrete")
        for v in archive.description.modelVariables
    )


def read_interface(
    archive: Archive,
    kind: str = "auto",
    *,
    arrays: bool = True,
    sizes: Mapping[int, int] | None = None,
) -> Interface:
    """Read ports, parameters and capabilities; without `arrays`, every scalar is a port.

    `sizes` are values of structural parameters by reference, where they are not the start values.

    Raises
    ------
    ConfigurationError
        If it does not offer `kind`, or a port cannot be made of it.
    """
    description = archive.description
    offered = []
    if description.coSimulation is not None:
        offered.append(CO_SIMULATION)
    if description.modelExchange is not None:
        offered.append(MODEL_EXCHANGE)
    if not offered:
        raise ConfigurationError(
            f"'{archive.path}' offers neither co-simulation nor model exchange\n"
            "  terrafix does not run scheduled execution"
        )
    chosen = offered[0] if kind == "auto" else kind
    if chosen not in offered:
        raise ConfigurationError(
            f"'{archive.path}' offers {' and '.join(offered)}, not {kind}\n"
            f'  write kind = "{offered[0]}", or leave it out'
        )
    interface = description.coSimulation if chosen == CO_SIMULATION else description.modelExchange
    quantities, left_out = _quantities(archive, arrays=arrays, sizes=sizes or {})
    parameters = [q for q in quantities if q.causality in PARAMETERS]
    found = archive.annotation if arrays else None
    ports = _own_ports(archive, found, quantities) if found is not None else _ports(quantities)
    return Interface(
        archive,
        chosen,
        ports,
        {q.name: q for q in parameters if q.kind != "String"},
        left_out,
        bool(interface.canGetAndSetFMUstate),
        bool(interface.canGetAndSetFMUstate and interface.canSerializeFMUstate),
        own=archive.annotation is not None,
        once=bool(interface.canBeInstantiatedOnlyOncePerProcess),
        text_parameters={q.name: q for q in parameters if q.kind == "String"},
        texts=_settable_texts(description),
    )


def _settable_texts(description: Any) -> dict[str, int]:
    return {
        v.name: int(v.valueReference)
        for v in description.modelVariables
        if v.type == "String"
        and not v.dimensions
        and v.variability != "constant"
        and (v.causality in ("input", "parameter") or v.initial in _SETTABLE)
    }


# --------------------------------------------------------------------------------- variables


class Observable:
    """Local variables and parameters by their names, whole or one element.

    Parameters
    ----------
    archive : Archive
    arrays : bool
        Whether elements form arrays.
    sizes : mapping of int to int
        Values of structural parameters by reference.
    """

    def __init__(self, archive: Archive, *, arrays: bool, sizes: Mapping[int, int]) -> None:
        self._archive, self._sizes = archive, sizes
        self._ways = (True, False) if arrays else (False,)
        self._read: dict[bool, dict[str, Quantity]] = {}

    def find(self, name: str, where: str) -> Quantity:
        """One of them; `where` names who asks.

        Raises
        ------
        ConfigurationError
            If there is none of numbers.
        """
        for together in self._ways:
            if together not in self._read:
                wanted = ("local", "calculatedParameter", *PARAMETERS)
                found, _ = _quantities(
                    self._archive, arrays=together, sizes=self._sizes, wanted=wanted
                )
                numbers = [q for q in reversed(found) if q.kind != "String"]
                self._read[together] = {q.name: q for q in numbers}
            if name in self._read[together]:
                return replace(self._read[together][name])
        known = {v.name: v for v in self._archive.description.modelVariables}
        if name not in known:
            raise ConfigurationError(
                f"{where}: the FMU has no variable '{name}'\n"
                f"  {nearest(name, known, what='it has')}"
            )
        variable = known[name]
        raise ConfigurationError(
            f"{where}: '{name}' is {variable.causality or 'local'} of type {variable.type}; it "
            "takes local variables and parameters that are numbers"
        )


def _quantities(
    archive: Archive,
    *,
    arrays: bool,
    sizes: Mapping[int, int],
    wanted: Sequence[str] = (*CONNECTED, *PARAMETERS),
) -> tuple[list[Quantity], list[str]]:
    """Inputs, outputs and parameters, elements of arrays together."""
    units = Units(archive)
    groups: dict[tuple[str, str], list[tuple[tuple[int, ...], Any]]] = {}
    left_out = []
    for variable in archive.description.modelVariables:
        causality = variable.causality or "local"
        if causality not in wanted:
            continue
        if variable.name in archive.negated:
            left_out += [variable.name] if causality in CONNECTED else []
            continue
        text = variable.type == "String" and variable.causality in PARAMETERS
        if not text and variable.type not in (*REAL, *INTEGER, *BOOLEAN):
            if variable.causality in ("input", "output"):
                left_out.append(variable.name)
            continue
        match = None if not arrays or variable.dimensions else _ELEMENT.match(variable.name)
        name = match[1] if match else variable.name
        index = tuple(int(i) for i in match[2].split(",")) if match else ()
        groups.setdefault((name, causality), []).append((index, variable))
    quantities = []
    for (name, _), members in groups.items():
        members.sort(key=lambda pair: pair[0])
        shape = _extent([index for index, _ in members])
        same = len({(v.type, v.variability) for _, v in members}) == 1
        if shape is not None and same:
            made = _quantity(name, shape, [v for _, v in members], units, sizes)
            made.base = min(min(index) for index, _ in members) if shape else 1
            quantities.append(made)
        else:
            quantities += [_quantity(v.name, (), [v], units, sizes) for _, v in members]
    return quantities, left_out


def _extent(indices: Sequence[tuple[int, ...]]) -> tuple[int, ...] | None:
    """Shape that the indices fill, from 1 (or 0) on; None if they do not."""
    if indices == [()]:
        return ()
    if len({len(i) for i in indices}) != 1 or not indices[0]:
        return None
    low = np.min(indices, axis=0)
    shape = tuple(int(n) for n in np.max(indices, axis=0) - low + 1)
    if math.prod(shape) != len(indices):
        return None
    full = [tuple(int(k) for k in np.array(i) + low) for i in np.ndindex(shape)]
    return shape if list(indices) == full and low.max() <= 1 else None


def _quantity(
    name: str,
    shape: tuple[int, ...],
    members: Sequence[Any],
    units_of: Units,
    sizes: Mapping[int, int],
) -> Quantity:
    first = members[0]
    if first.dimensions or first.shape:
        shape = tuple(
            sizes.get(d.valueReference, n) if d.start is None else n
            for d, n in zip(first.dimensions, map(int, first.shape or ()), strict=True)
        )
    units = tuple(units_of(v) for v in members)
    unit: Unit = units[0] if len(set(units)) == 1 else units
    if len(shape) == 2 and not isinstance(unit, str):
        last = units[: shape[-1]]
        unit = last if units == last * shape[0] else "1"
    text = first.type == "String"
    size = int(np.prod(shape, dtype=np.int64))
    starts = None if text else _starts(members)
    if starts is not None and len(starts) != size:  # of the size that it has otherwise
        starts = starts * size if len(starts) == 1 else None
    return Quantity(
        name,
        first.type,
        [int(v.valueReference) for v in members],
        shape,
        unit,
        starts,
        first.causality,
        first.variability or "continuous",
        " ".join((first.description or "").split()),
        variables=tuple(members),
        texts=_texts(members, size) if text else None,
        initial=first.initial,
        items=_items(first),
    )


def _items(variable: Any) -> dict[str, int]:
    """Items of an enumeration by name."""
    declared = getattr(variable.declaredType, "items", None) or ()
    return {
        str(item.name): k + 1 if item.value is None else int(item.value)
        for k, item in enumerate(declared)
    }


class Units:
    """Units of an FMU's variables: what its UnitDefinitions say, and where they say nothing, SI."""

    def __init__(self, archive: Archive) -> None:
        self._own = archive.annotation is not None
        self._defined = {u.name: u.baseUnit for u in archive.description.unitDefinitions}
        self._read: dict[str, str] = {}

    def __call__(self, variable: Any) -> str:
        """The unit of a variable."""
        name = variable.unit
        if name is None and variable.declaredType is not None:
            name = variable.declaredType.unit
        if name in (None, "", "-", "1"):
            return "1"
        if name not in self._read:
            self._read[name] = self._meaning(str(name))
        return self._read[name]

    def _meaning(self, name: str) -> str:
        base = self._defined.get(name)
        if base is not None and not self._own:
            powers = {symbol: int(getattr(base, symbol)) for symbol in SI_BASE}
            return unit_by_definition(name, float(base.factor), powers, float(base.offset))
        if not self._own:
            return unit_by_name(name)
        try:
            check_unit(name)
        except ConfigurationError:
            return "1"
        return name


def _texts(members: Sequence[Any], size: int) -> list[str] | None:
    found: list[str] = []
    for text in (v.start for v in members):
        found += [] if text is None else [text] if isinstance(text, str) else [str(t) for t in text]
    return found if len(found) == size else None


def _starts(members: Sequence[Any]) -> list[float] | list[int] | None:
    texts = [v.start for v in members]
    if any(t is None for t in texts):
        return None
    words: list[str] = []
    for text in texts:
        if isinstance(text, str):
            words += text.split()
        else:
            words += [str(x) for x in np.asarray(text).ravel()]
    kind = members[0].type
    if kind in INTEGER:
        return [whole_start(members[0].name, kind, w) for w in words]
    try:
        return [1.0 if w == "true" else 0.0 if w == "false" else float(w) for w in words]
    except ValueError as error:
        word = str(error).rpartition(": ")[2]
        raise ConfigurationError(
            f"the FMU says that '{members[0].name}' ({kind}) starts at {word}"
        ) from error


# --------------------------------------------------------------------------------- dependencies


def initial_dependencies(interface: Interface) -> dict[str, set[str]]:
    """Input ports that each output port depends on in initialization mode.

    As InitialUnknowns declare; where these do not list an output, as Outputs do, if it depends on
    inputs alone. What is not declared depends on all inputs; a start that is exact on none.
    """
    description = interface.archive.description
    inputs: dict[str, str] = {}
    outputs: dict[str, list[str]] = {}
    for port in interface.ports:
        names = [n for q, _ in port.fields.values() for n in {q.name, *q.scalars()}]
        if port.is_input and port.kind == "signal":
            inputs |= dict.fromkeys(names, port.name)
        elif not port.is_input:
            outputs[port.name] = names
    everything = set(inputs.values())
    at_start = {u.variable.name: u for u in description.initialUnknowns}
    later = {u.variable.name: u for u in description.outputs}
    variables = {v.name: v for v in description.modelVariables}

    def needs(name: str) -> set[str]:
        known = at_start.get(name) or later.get(name)
        if name not in at_start and variables[name].initial == "exact":
            return set()
        if known is None or known.dependencies is None:
            return everything
        found = set()
        for variable in known.dependencies:
            if variable.name in inputs:
                found.add(inputs[variable.name])
            elif name not in at_start and variable.causality not in _KNOWN:
                return everything  # a state, whose own start is not declared
        return found

    def of_port(names: Iterable[str]) -> set[str]:
        found = [needs(n) for n in names if n in variables]
        return everything if any(f is everything for f in found) else set().union(*found)

    return {port: of_port(names) for port, names in outputs.items()}


# --------------------------------------------------------------------------------- ports


def _ports(quantities: Iterable[Quantity]) -> list[ImportedPort]:
    ports, taken = [], set[str]()
    for q in quantities:
        if q.causality not in ("input", "output"):
            continue
        name = re.sub(r"\W+", "_", q.name).strip("_") or "port"
        name = name if not name[0].isdigit() else f"v{name}"
        while name in taken:
            name += "_"
        taken.add(name)
        port = ImportedPort(name, "signal", q.causality == "input", None)
        port.fields[""] = (q, None)
        ports.append(port)
    return ports


def _own_ports(archive: Archive, interface: Any, quantities: list[Quantity]) -> list[ImportedPort]:
    """Ports by the annotation of an FMU of terrafix."""
    by_name = {q.name: q for q in quantities}
    ports = []
    for element in interface.iter("Port"):
        is_input = "at" in element.attrib
        port = ImportedPort(element.get("name"), element.get("kind"), is_input, element.get("at"))
        for each in element.iter("Field"):
            variable = each.get("variable")
            if variable not in by_name:
                raise ConfigurationError(
                    f"'{archive.path}': its annotation names '{variable}', which is no variable\n"
                    "  the description was changed after it was exported"
                )
            quantity = by_name[variable]
            if each.get("units"):
                quantity.unit = tuple(each.get("units").split("|"))
            port.fields[each.get("name", "")] = (quantity, each.get("frame"))
        if port.kind == "message":
            port.t = by_name[f"{port.name}.t"]
            port.sequence = by_name[f"{port.name}.sequence"]
        ports.append(port)
    return ports
