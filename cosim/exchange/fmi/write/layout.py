"""Where everything of an exported FMU is kept, and what its functions read and write.

A component, or a system of symbolic components with its schedule, becomes a list of parts and one
array of numbers; ``core.h`` says what the tables mean that are filled here. Nothing here is text:
`code`, beside it, writes C, and `description` XML.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np

from terrafix.cosim.basics.clock import Rate, base_step
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import docstring
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.exchange.fmi.write.variables import PortVariables, Variable
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.system.flat import Connection
from terrafix.cosim.system.wiring import port_factor

TIME = 0
MOST_TEXT = 400  # of a component's path and a stream's name, in the hash of core.c


@dataclass
class Call:
    """A function, the places of its arguments, and of those it takes tangents of."""

    function: Any
    arguments: list[int]
    seeds: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Target:
    """Where a result goes; `message` is the number of the message it belongs to, or -1."""

    offset: int
    size: int
    message: int = -1


@dataclass(frozen=True)
class Copy:
    """Numbers that are copied, with a factor each; or one integer."""

    source: int
    target: int
    size: int = 1
    factor: tuple[float, ...] = ()
    integer: bool = False


@dataclass(frozen=True)
class Received:
    """A message that a part reads."""

    name: str
    sequence: int
    seen: int
    fresh: int
    required: bool


@dataclass(frozen=True)
class Published:
    """A message that a part publishes; `valid` is a place among its results, or -1."""

    valid: int
    t: int
    sequence: int


@dataclass(frozen=True)
class Stream:
    """Standard normals of a part."""

    path: str
    name: str
    offset: int
    size: int


@dataclass
class Part:
    """One component of the FMU."""

    name: str
    component: SymbolicComponent
    rate: Rate
    base: Fraction
    grid: Fraction
    initial: Call
    step: Call
    initial_forward: Call
    step_forward: Call
    targets: list[Target]
    n_outputs: int
    state: int
    before: int
    n_state: int
    step_length: int
    streams: list[Stream]
    received: list[Received]
    published: list[Published]
    convert: list[Copy]
    latch: list[Copy]


@dataclass
class Continuous:
    """What model exchange needs of a part with derivatives."""

    rate: Call
    rate_forward: Call
    targets: list[Target]
    n_outputs: int
    states: list[Variable]
    places: list[int]
    derivatives: list[Variable]
    has_discrete: bool


@dataclass
class Source:
    """What is exported: components by path, in the order of stepping, and how they are joined.

    Attributes
    ----------
    name : str
        Of the model.
    doc : str
    components : dict of str to SymbolicComponent
    connections : list of Connection
    outside : dict of str to str
        Names of the ports shown outside, by path of the port.
    base, grid : Fraction
        Length of a tick, and what listed times are snapped to [s].
    start : mapping
        Start values of inputs, by path of the port and field (``"t"``, ``"sequence"``).
    seed : int
    duration : Fraction or None
    single : bool
        One component whose parameters are named without its path.
    """

    name: str
    doc: str
    components: dict[str, SymbolicComponent]
    connections: list[Connection]
    outside: dict[str, str]
    base: Fraction
    grid: Fraction
    start: Mapping[str, Mapping[str, Any]]
    seed: int
    duration: Fraction | None
    single: bool

    @classmethod
    def of_component(
        cls,
        component: SymbolicComponent,
        *,
        path: str,
        base: Fraction | None = None,
        grid: Fraction | None = None,
        start: Mapping[str, Mapping[str, Any]] | None = None,
        seed: int = 0,
        duration: Fraction | None = None,
    ) -> Source:
        """A component by itself: every port is shown."""
        rate = component.rate
        assert rate is not None
        tick = base or base_step(rate.exact_numbers, rate.times or ())
        outside = {f"{path}.{name}": name for name in component.ports}
        doc = docstring(type(component)).partition("\n")[0]
        return cls(
            path.replace(".", "_"),
            doc,
            {path: component},
            [],
            outside,
            tick,
            grid or tick,
            start or {},
            seed,
            duration,
            single=True,
        )


class Layout:
    """Places, variables, parts and dependencies of an exported FMU.

    Parameters
    ----------
    source : Source
    scalars : bool
        Declare the elements of arrays as variables, and no arrays.

    Attributes
    ----------
    source : Source
    reals, integers : list of Variable
        Declared variables, in the order of their places.
    arrays : list of Variable
        The reals, before arrays become scalars.
    ports : list of PortVariables
        Of arrays, also where scalars are declared.
    parts : list of Part
    continuous : Continuous or None
    start_real : list of float
        What every place holds at first.
    n_integers : int
    seed, member : int
        Places of these two.
    """

    def __init__(self, source: Source, *, scalars: bool = False) -> None:
        self.source = source
        self.reals: list[Variable] = []
        self.integers: list[Variable] = []
        self.ports: list[PortVariables] = []
        self.start_real: list[float] = []
        self.start_integer: list[int] = []
        self._place: dict[str, int] = {}  # "path.port[.field]" to place in `real`
        self._sequence: dict[str, int] = {}  # "path.port" to place in `integer`
        self.streams: list[Stream] = []
        self._check()
        self._real("time", "independent", (), 0.0, unit="s", doc="time")
        self._seed_and_member()
        self._outside(inputs=True)
        self._outside(inputs=False)
        self._parameters()
        self._continuous_variables()
        self.n_variable_reals = len(self.start_real)
        self.n_variable_integers = len(self.start_integer)
        self._inner_outputs()
        self.parts = [self._part(path) for path in source.components]
        self.continuous = self._continuous()
        self._nominals()
        self.arrays = self.reals
        if scalars:
            self._declare_elements()

    # ------------------------------------------------------------------ allocation

    def _keep(self, size: int, start: Any = 0.0) -> int:
        """Allocate numbers that no variable shows."""
        offset = len(self.start_real)
        self.start_real += [float(v) for v in np.broadcast_to(start, (size,))]
        return offset

    def _keep_integer(self) -> int:
        self.start_integer.append(0)
        return len(self.start_integer) - 1

    def _real(
        self, name: str, causality: str, shape: tuple[int, ...], start: Any, **options: Any
    ) -> Variable:
        size = int(np.prod(shape, dtype=np.int64))
        offset = self._keep(size, np.asarray(0.0 if start is None else start).ravel())
        made = Variable(name, "real", causality, offset, shape, start, **options)
        self.reals.append(made)
        return made

    def _integer(self, name: str, causality: str, start: int | None, **options: Any) -> Variable:
        offset = self._keep_integer()
        self.start_integer[offset] = start or 0
        made = Variable(
            name,
            "integer",
            causality,
            offset,
            (),
            start,
            discrete=causality != "parameter",
            **options,
        )
        self.integers.append(made)
        return made

    # ------------------------------------------------------------------ what is shown

    def _check(self) -> None:
        source = self.source
        for path, component in source.components.items():
            for name, port in component.ports.items():
                what = None
                if port.kind == "shared":
                    what = "a shared value"
                elif port.window:
                    what = "a window"
                elif any(f.ragged for f in port.fields.values()):
                    what = "a ragged message"
                elif port.is_input and port.queue > 1:
                    what = "a queue of messages"
                if what:
                    raise ConfigurationError(
                        f"'{path}' cannot be exported: port '{name}' is {what}, which FMI has not"
                    )
            if len(path) > MOST_TEXT:
                raise ConfigurationError(f"'{path}' is too long a path to be exported")
        for connection in source.connections:
            if connection.delay:
                raise ConfigurationError(
                    f"'{connection}' has a delay, which an exported system does not carry\n"
                    "  export its parts one by one, or remove the delay"
                )
        if not any(
            not source.components[p.rpartition(".")[0]].ports[p.rpartition(".")[2]].is_input
            for p in source.outside
        ):
            raise ConfigurationError(
                f"'{source.name}' shows no output\n"
                '  expose one in the system file: [expose] r_e = "orbit.r_e"'
            )

    def _seed_and_member(self) -> None:
        noisy = any(c.model.noise for c in self.source.components.values())
        if not noisy:
            self.seed = self.member = -1
            return
        self.seed = self._integer(
            "seed", "parameter", self.source.seed, doc="root seed of the noise", minimum=0
        ).offset
        self.member = self._integer(
            "member", "parameter", 0, doc="member of the ensemble: its own noise", minimum=0
        ).offset

    def _port(self, path: str) -> tuple[SymbolicComponent, Port[Any]]:
        owner, _, name = path.rpartition(".")
        component = self.source.components[owner]
        return component, component.ports[name]

    def _outside(self, *, inputs: bool) -> None:
        for path, shown in self.source.outside.items():
            _, port = self._port(path)
            if port.is_input == inputs:
                self.ports.append(self._port_variables(path, shown, port))

    def _port_variables(self, path: str, shown: str, port: Port[Any]) -> PortVariables:
        causality = "input" if port.is_input else "output"
        made = PortVariables(shown, port.kind, port.is_input, port.at)
        given = self.source.start.get(path, {})
        at_start = port.is_input and port.at == "start"
        for name, each in port.fields.items():
            start: Any = None
            if port.is_input:
                default = port.default if port.default is not None else 0.0
                if isinstance(default, dict):
                    default = default.get(name, 0.0)
                start = np.broadcast_to(
                    np.asarray(given.get(name, default), dtype=np.float64), each.fixed_shape
                )
            full = f"{shown}.{name}" if name else shown
            variable = self._real(
                full,
                causality,
                each.fixed_shape,
                start,
                unit=each.unit,
                frame=each.frame,
                doc=_sentence(each.doc or port.doc),
                at_start=at_start,
            )
            made.fields[name] = variable
            self._place[f"{path}.{name}" if name else path] = variable.offset
        if port.kind == "message":
            made.t = self._real(
                f"{shown}.t",
                causality,
                (),
                float(given.get("t", 0.0)) if port.is_input else None,
                unit="s",
                doc=f"time of validity of '{shown}'",
                at_start=at_start,
            )
            made.sequence = self._integer(
                f"{shown}.sequence",
                causality,
                int(given.get("sequence", 0)) if port.is_input else None,
                doc=f"number of messages of '{shown}' so far: a new number is a new message",
                minimum=0,
                at_start=at_start,
            )
            self._place[f"{path}.t"] = made.t.offset
            self._sequence[path] = made.sequence.offset
        return made

    def _parameters(self) -> None:
        for path, component in self.source.components.items():
            for name in component.model.parameters:
                declared = component.settings()[name]
                assert isinstance(declared, Parameter)
                variable = self._real(
                    name if self.source.single else f"{path}.{name}",
                    "parameter",
                    declared.shape,
                    np.asarray(component.setting(name), dtype=np.float64),
                    unit=declared.unit,
                    frame=declared.frame,
                    doc=_sentence(declared.doc),
                    minimum=declared.minimum,
                    maximum=declared.maximum,
                    positive=declared.positive,
                    infinite=declared.infinite,
                )
                self._place[f"{path}:{name}"] = variable.offset

    def _continuous_variables(self) -> None:
        """Declare continuous states that no output shows, and derivatives, for model exchange."""
        self._states: list[Variable] = []
        self._derivatives: list[Variable] = []
        components = list(self.source.components.items())
        if len(components) != 1 or not components[0][1].model.derivatives:
            return
        if self.source.connections:  # of its outputs with its inputs, held from step to step
            return
        import casadi as ca

        _, component = components[0]
        model = component.model
        taken = {v.name for v in self.reals}
        for name in model.derivatives:
            output = model.outputs.get(name)
            shape = component.state_shape(name)
            same = output is not None and ca.is_equal(ca.SX(output), model.states[name], 0)
            if same:
                variable = next(v for v in self.reals if v.name == name)
            else:
                shown = name if name not in taken else f"state.{name}"
                variable = self._real(shown, "local", shape, None, doc="continuous state")
            self._states.append(variable)
        for name, state in zip(model.derivatives, self._states, strict=True):
            self._derivatives.append(
                self._real(
                    f"der({state.name})",
                    "local",
                    state.shape,
                    None,
                    unit=_rate_unit(state.unit),
                    frame=state.frame,
                    doc=f"derivative of '{name}'",
                    derivative_of=state,
                )
            )

    def _inner_outputs(self) -> None:
        """Places of outputs that are not shown, and of what nobody drives."""
        for path, component in self.source.components.items():
            for name, port in component.outputs().items():
                where = f"{path}.{name}"
                if where in self.source.outside:
                    continue
                for key, each in port.fields.items():
                    self._place[f"{where}.{key}" if key else where] = self._keep(each.size)
                if port.kind == "message":
                    self._place[f"{where}.t"] = self._keep(1)
                    self._sequence[where] = self._keep_integer()

    # ------------------------------------------------------------------ parts

    def _part(self, path: str) -> Part:
        component = self.source.components[path]
        model = component.model
        prefix = f"part{list(self.source.components).index(path)}"
        convert: list[Copy] = []
        latch: list[Copy] = []
        received: list[Received] = []
        fresh: dict[str, int] = {}
        places: dict[str, int] = {}
        for name, port in component.inputs().items():
            self._bind_input(path, name, port, places, fresh, convert, latch, received)
        inputs = []
        for name in model.inputs:
            head, _, tail = name.partition(".")
            inputs.append(fresh[head] if tail == "fresh" else places[name])
        parameters = [self._place[f"{path}:{n}"] for n in model.parameters]
        streams = []
        for name in model.noise:
            size = _size(model, name)
            streams.append(Stream(path, name, self._keep(size), size))
        self.streams += streams
        noise = [s.offset for s in streams]
        step_length = self._keep(1)
        clock = [step_length] if model.step is not None else []
        clock += [TIME] if model.time is not None else []
        sizes = {n: _size(model, n) for n in model.states}
        n_state = sum(sizes.values())
        state, before = self._keep(n_state), self._keep(n_state)
        offsets = dict(zip(sizes, np.cumsum([0, *sizes.values()])[:-1].tolist(), strict=True))
        self._state_place = {n: state + o for n, o in offsets.items()}
        targets, published = self._targets(path, component)
        n_outputs = len(targets)
        targets += [Target(state + o, sizes[n]) for n, o in offsets.items()]
        rest = [*parameters, *noise, *clock]
        initial = Call(model.initial_function(f"{prefix}_initial"), [*inputs, *rest])
        states_before = [before + o for o in offsets.values()]
        step = Call(model.step_function(f"{prefix}_step"), [*inputs, *states_before, *rest])
        n_in = len(inputs)
        by_parameter = list(range(n_in + len(parameters)))
        rate = component.rate
        assert rate is not None
        return Part(
            path,
            component,
            rate,
            self.source.base,
            self.source.grid,
            initial,
            step,
            _forward(initial, f"{prefix}_initial_forward", by_parameter, n_outputs),
            _forward(step, f"{prefix}_step_forward", list(range(n_in)), n_outputs),
            targets,
            n_outputs,
            state,
            before,
            n_state,
            step_length,
            streams,
            received,
            published,
            convert,
            latch,
        )

    def _bind_input(
        self,
        path: str,
        name: str,
        port: Port[Any],
        places: dict[str, int],
        fresh: dict[str, int],
        convert: list[Copy],
        latch: list[Copy],
        received: list[Received],
    ) -> None:
        """Find where a part reads an input: a variable, another's output, or a copy of them."""
        where = f"{path}.{name}"
        connection = next((c for c in self.source.connections if c.target == where), None)
        factors: dict[str, tuple[float, ...]] = {}
        source: str | None = where if where in self.source.outside else None
        if connection is not None:
            source = connection.source
            factor = port_factor(self._port(source)[1], port)
            if factor is not None:
                flat, at = factor.ravel(), 0
                for key, each in port.fields.items():
                    factors[key] = tuple(float(f) for f in flat[at : at + each.size])
                    at += each.size
        # from within, nothing is held at the start
        late = port.at == "start" and source is not None
        lists = latch if late else convert
        keys = [*port.fields, *(["t"] if port.kind == "message" else [])]
        for key in keys:
            label = f"{name}.{key}" if key else name
            size = 1 if key == "t" and key not in port.fields else port.fields[key].size
            if source is None:
                default = port.default if port.default is not None else 0.0
                if isinstance(default, dict):
                    default = default.get(key, 0.0)
                places[label] = self._keep(size, default if key != "t" else 0.0)
                continue
            origin = self._place[f"{source}.{key}" if key else source]
            if not late and not factors.get(key):
                places[label] = origin
                continue
            start = self.start_real[origin : origin + size] if source == where else np.nan
            places[label] = self._keep(size, start if late else 0.0)
            lists.append(Copy(origin, places[label], size, factors.get(key, ())))
        if port.kind != "message":
            return
        sequence = self._sequence[source] if source is not None else self._keep_integer()
        if late:
            own = self._keep_integer()
            latch.append(Copy(sequence, own, integer=True))
            sequence = own
        wanted = f"{name}.fresh" in self.source.components[path].model.inputs
        fresh[name] = self._keep(1) if wanted else -1
        shown = self.source.outside.get(where, where)
        received.append(
            Received(shown, sequence, self._keep_integer(), fresh[name], port.needed_at_start)
        )

    def _targets(
        self, path: str, component: SymbolicComponent
    ) -> tuple[list[Target], list[Published]]:
        model = component.model
        messages = {
            n: i
            for i, n in enumerate(n for n, p in component.outputs().items() if p.kind == "message")
        }
        targets: list[Target] = []
        valid = dict.fromkeys(messages, -1)
        at = 0
        for name in model.outputs:
            head, _, tail = name.partition(".")
            size = _size(model, name)
            if tail == "valid" and head in messages:
                valid[head] = at
                targets.append(Target(self._keep(1), 1))
            else:
                targets.append(Target(self._place[f"{path}.{name}"], size, messages.get(head, -1)))
            at += size
        published = [
            Published(valid[n], self._place[f"{path}.{n}.t"], self._sequence[f"{path}.{n}"])
            for n in messages
        ]
        return targets, published

    def _continuous(self) -> Continuous | None:
        if not self._states:
            return None
        part = self.parts[0]
        model = part.component.model
        function = model.rate_function("part0_rate")
        n_in, n_state = len(model.inputs), len(model.states)
        arguments = list(part.step.arguments)
        arguments[n_in : n_in + n_state] = list(self._state_place.values())
        targets = part.targets[: part.n_outputs]
        targets += [Target(d.offset, d.size) for d in self._derivatives]
        rate = Call(function, arguments)
        by = [*range(n_in)]
        by += [n_in + i for i, n in enumerate(model.states) if n in model.derivatives]
        places: list[int] = []
        for name, variable in zip(model.derivatives, self._states, strict=True):
            variable.state = self._state_place[name]
            places += range(variable.state, variable.state + variable.size)
        continuous = Continuous(
            rate,
            _forward(rate, "part0_rate_forward", by, len(targets)),
            targets,
            part.n_outputs,
            self._states,
            places,
            self._derivatives,
            has_discrete=any(n not in model.derivatives for n in model.states),
        )
        self._mark_discrete(model, continuous)
        return continuous

    def _mark_discrete(self, model: Any, continuous: Continuous) -> None:
        """Outputs that depend on discrete states change at the events of the schedule alone."""
        import casadi as ca

        discrete = [s for n, s in model.states.items() if n not in model.derivatives]
        if not discrete:
            return
        symbols = ca.vertcat(*(ca.vec(s) for s in discrete))
        for port in self.ports:
            for name, variable in port.fields.items():
                full = f"{port.name}.{name}" if name else port.name
                if not port.is_input and full in model.outputs:
                    variable.discrete = bool(ca.depends_on(ca.SX(model.outputs[full]), symbols))

    def _nominals(self) -> None:
        """Sizes of continuous states, from the start values: what integrators scale errors by."""
        if self.continuous is None:
            return
        part = self.parts[0]
        values = part.initial.function(
            *(
                np.asarray(self.start_real[a : a + part.initial.function.numel_in(i)])
                for i, a in enumerate(part.initial.arguments)
            )
        )
        results = values if isinstance(values, tuple | list) else (values,)
        at = {t.offset: np.asarray(v).ravel() for t, v in zip(part.targets, results, strict=True)}
        for variable in self.continuous.states:
            assert variable.state is not None
            size = float(np.max(np.abs(at[variable.state]), initial=0.0))
            variable.nominal = size if np.isfinite(size) and size > 0 else 1.0

    def _declare_elements(self) -> None:
        """Put the elements of arrays in their places, among the continuous states too."""
        elements = {v: v.elements() for v in self.arrays}
        self.reals = [e for each in elements.values() for e in each]
        for variable, each in elements.items():
            if variable.derivative_of is not None:
                for element, state in zip(each, elements[variable.derivative_of], strict=True):
                    element.derivative_of = state
        if (continuous := self.continuous) is not None:
            continuous.states = [e for v in continuous.states for e in elements[v]]
            continuous.derivatives = [e for v in continuous.derivatives for e in elements[v]]


def _size(model: Any, name: str) -> int:
    return int(np.prod(model.shape(name), dtype=np.int64))


def _sentence(text: str) -> str:
    return " ".join(text.split())


def _rate_unit(unit: Any) -> Any:
    if not isinstance(unit, str):
        return "1"
    if unit in ("", "1"):
        return "1/s"
    return {"m": "m/s", "m/s": "m/s^2", "rad": "rad/s"}.get(unit, f"{unit}/s")


def _forward(call: Call, name: str, by: Sequence[int], n_outputs: int) -> Call:
    """Forward derivative of the first results by some arguments, given tangents of these."""
    import casadi as ca

    function = call.function
    symbols = [ca.SX.sym(f"x{i}", function.numel_in(i)) for i in range(function.n_in())]
    results = function.call(symbols)
    results = results[:n_outputs]
    seeds = [ca.SX.sym(f"d{i}", function.numel_in(i)) for i in by]
    if seeds and results:
        tangent = ca.jtimes(
            ca.vertcat(*results), ca.vertcat(*(symbols[i] for i in by)), ca.vertcat(*seeds)
        )
        ends = np.cumsum([0] + [r.numel() for r in results]).tolist()
        tangents = [ca.densify(tangent[a:b]) for a, b in pairwise(ends)]
    else:
        tangents = [ca.SX.zeros(r.numel()) for r in results]
    made = ca.Function(name, [*symbols, *seeds], tangents, {"cse": True})
    return Call(made, list(call.arguments), [call.arguments[i] for i in by])
