"""An imported FMU as a component like any other: ``type = "fmu"``, ``file = "..."``."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.clock import Rate, seconds
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.units import UNDEFINED
from terrafix.cosim.declare.component import ATTRIBUTES, KEYS, Environment
from terrafix.cosim.declare.parameters import (
    Choice,
    FilePath,
    Flag,
    Parameter,
    Setting,
    Table,
)
from terrafix.cosim.declare.ports import (
    BundleInput,
    BundleOutput,
    Capabilities,
    Input,
    MessageInput,
    MessageOutput,
    Output,
    Port,
)
from terrafix.cosim.exchange.fmi.run.archive import is_c_name, open_archive
from terrafix.cosim.exchange.fmi.run.binding import (
    CO_SIMULATION,
    MODEL_EXCHANGE,
    note_what_waits,
)
from terrafix.cosim.exchange.fmi.run.fleet import Fleet, Group, Message, Setup
from terrafix.cosim.exchange.fmi.run.parameters import (
    EXACT,
    STRUCTURAL,
    Size,
    Start,
    declared_setting,
    setting_names,
    start_values,
)
from terrafix.cosim.exchange.fmi.run.places import AnyFleet, make_fleet
from terrafix.cosim.exchange.fmi.run.reading import (
    REAL,
    ImportedPort,
    Interface,
    Observable,
    Quantity,
    initial_dependencies,
    read_interface,
)
from terrafix.cosim.exchange.fmi.run.solvers import SOLVERS
from terrafix.cosim.exchange.fmi.run.telling import Telling
from terrafix.cosim.exchange.fmi.run.whole import BOOLEAN, INTEGER, MOST, cells, read_whole
from terrafix.cosim.kernels.chain import Compiled, CompiledStep, Copies, can_copy
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.memory.messages import MessageReader
from terrafix.cosim.memory.slots import BundleView


class Fmu(Compiled, Telling):
    """A Functional Mock-up Unit, FMI 2 or 3 (1.0: co-simulation), one instance for each member.

    Ports, units, arrays and start values are those of its model description, and so are parameters,
    which are set by name like any other. Inputs of an FMU that does not say otherwise are read at
    the start of a step: they hold what was published at the time the step begins, as masters of
    co-simulation have it.
    """

    file = FilePath(doc="the .fmu file")
    kind = Choice(("auto", CO_SIMULATION, MODEL_EXCHANGE), "auto", doc="how it is run")
    inputs_read = Choice(
        ("declared", "start", "end"),
        "declared",
        doc="when inputs are read: as the FMU declares (start, if it does not say)",
    )
    hold_start_values = Flag(
        False, doc="inputs read at the start keep their start values through the first step"
    )
    arrays = Flag(True, doc="elements r[1], r[2], ... of FMI 2 form an array port")
    start = Table(doc="start values of inputs, also parameters, by the FMU's names, with units")
    units = Table(doc="units of ports by name, where the FMU does not say")
    frames = Table(doc="frames of ports by name, where the FMU does not say")
    observe = Table(doc='local variables and parameters that outputs show: { height = "body.h" }')
    solver = Choice(SOLVERS, "cvode", doc="integrator of model exchange")
    tolerance = Parameter(
        0.0,
        minimum=0.0,
        doc="relative, of that integrator (0: 1e-10), or handed on to the FMU's own in "
        "co-simulation (0: what its default experiment says)",
    )
    start_time = Parameter(0.0, unit="s", doc="time of the FMU at t = 0")
    isolate = Flag(False, doc="run it in a process of its own: slower, but its crash is survived")
    time_limit = Parameter(
        60.0, unit="s", positive=True, doc="longest answer of an isolated FMU, in real time"
    )

    _interface: Interface | None = None
    _found: tuple[Any, Interface] | None = None
    _from_start: set[str] | frozenset[str] = frozenset()
    _quantities: dict[str, Quantity]
    _fleet: AnyFleet | None = None
    _needs: dict[str, set[str]] | None = None
    _begun = False

    # ------------------------------------------------------------------ declaration

    @property
    def interface(self) -> Interface:
        """What the FMU declares."""
        if self._interface is None:
            raise ConfigurationError("set the file of the FMU first")
        return self._interface

    def declare_settings(self) -> None:
        """Declare the parameters of the FMU."""
        if "file" not in self.given_parameters:
            return
        archive = open_archive(self.given_parameters["file"])
        sizes = self._sizes()
        kind, arrays = self.given_parameters["kind"], self.given_parameters["arrays"]
        key = (archive.folder, kind, arrays, sizes)
        if self._found is not None and self._found[0] == key:
            return
        found = read_interface(archive, kind, arrays=arrays, sizes=sizes)
        quantities = found.parameters | found.text_parameters
        if found.own:  # those of the run
            quantities = {n: q for n, q in quantities.items() if n not in ("seed", "member")}
        names = setting_names(quantities.values(), _is_something)
        self._quantities = {names[n]: q for n, q in quantities.items()}
        said = {e.get("variable"): e for e in found.said_of_parameters}
        settings = {n: declared_setting(q, said.get(q.name)) for n, q in self._quantities.items()}
        for name in self._found_settings.keys() - settings.keys():
            if name in self.given_parameters:
                raise ConfigurationError(
                    f"'{self.name}.{name}' was set, but '{archive.path}' has no such parameter\n"
                    f"  {nearest(name, settings, what='it has')}"
                )
        for name in settings.keys() & self.given_parameters.keys():
            if self.given_parameters[name] is not None:
                settings[name].read(self.given_parameters[name], where=f"'{self.name}.{name}'")
        self._found_settings, self._found = settings, (key, found)

    def _sizes(self) -> dict[int, int]:
        """Structural parameters that were set, by reference."""
        return {
            self._quantities[n].references[0]: int(self.given_parameters[n])
            for n, s in self._found_settings.items()
            if isinstance(s, Size) and self.given_parameters.get(n) is not None
        }

    def set_parameter(self, name: str, value: object, *, bare: bool = True) -> None:
        """Set a parameter by name, of the component or of its FMU."""
        if name not in self.settings() and not self.missing_settings():
            self.declare_settings()
        super().set_parameter(name, value, bare=bare)
        self._from_start -= {name}
        if isinstance(self._found_settings.get(name), Size):
            self.declare_settings()  # arrays have another size

    def prepare(self) -> None:
        """Read the file, and declare its parameters and ports."""
        self.declare_settings()
        self._take_parameters_of_start()
        assert self._found is not None
        self._interface = found = self._found[1].copy()
        archive = found.archive
        identifier = (
            archive.description.coSimulation
            if found.kind == CO_SIMULATION
            else archive.description.modelExchange
        ).modelIdentifier
        archive.binary(identifier)
        self._observe()
        self._needs = None
        self._given = self._read_starts()
        self.ports = {port.name: self._port(port) for port in found.ports}
        for table in ("units", "frames"):
            for name in self.given_parameters[table]:
                if name not in self.ports:
                    raise ConfigurationError(
                        f"'{self.name}.{table}' names '{name}', which is no port\n"
                        f"  {nearest(name, self.ports, what='its ports')}"
                    )
        if self.rate is None and (period := self._default_period()) is not None:
            self.rate = Rate(period)
        notes: tuple[str, ...] = ()
        if not found.serialize:
            notes = ("its state cannot be saved: no checkpoints",)
        self.in_parts = archive.version > 1
        if archive.version == 1:
            self._prepare_fmi1()
            notes = ("FMI 1.0 cannot save its state: no checkpoints",)
        if not is_c_name(identifier):
            notes += (f"its modelIdentifier '{identifier}' is no name as in C, which FMI demands",)
        clocks = found.input_clocks
        negated = [name for name in found.left_out if name in archive.negated]
        if negated:
            notes += (f"{', '.join(negated)} cannot be connected: negated aliases of FMI 1.0",)
        left_out = [name for name in found.left_out if name not in {*clocks, *negated}]
        if left_out:
            notes += (f"{', '.join(left_out)} cannot be connected: no numbers",)
        if silent := found.silent_clocks:
            notes += (f"its clocks {', '.join(silent)} never tick: nothing here triggers them",)
        if clocked := found.clocked_inputs:
            notes += (
                f"its inputs {', '.join(clocked)} are set when they change, not by their clocks",
            )
        noisy = found.own and "seed" in found.parameters
        self.capabilities = Capabilities(  # type: ignore[misc]
            state=found.serialize, given=not noisy, notes=notes
        )

    def _prepare_fmi1(self) -> None:
        """Refuse what FMI 1.0 has no function for."""
        if self.given_parameters["tolerance"]:
            raise ConfigurationError(
                f"'{self.name}.tolerance' does nothing: FMI 1.0 hands no tolerance to an FMU for "
                "co-simulation\n  leave it out"
            )

    def _take_parameters_of_start(self) -> None:
        """Make values of ``start`` that are of parameters values of these."""
        assert self._found is not None
        by_name = {q.name: n for n, q in self._quantities.items()}
        start = dict(self.given_parameters["start"])
        for name in start.keys() & self._found[1].texts.keys():
            self._check_text(name, start[name])
        beyond = {n for n, value in start.items() if self._is_beyond_doubles(n, value)}
        meant = {by_name[n]: n for n in start if n in by_name and n not in beyond}
        self._from_start = set(self._from_start)
        for own in self.in_order_of_setting(meant):
            where = f"'{self.name}.start.{meant[own]}'"
            if own in self.given_parameters and own not in self._from_start:
                raise ConfigurationError(
                    f"{where} and '{self.name}.{own}' give one parameter two values\n"
                    "  leave out that of start"
                )
            value = self.settings()[own].read(start.pop(meant[own]), where=where)
            self.parameter_values[own] = self.given_parameters[own] = value
            self._from_start.add(own)
            if isinstance(self._found_settings[own], Size):
                self.declare_settings()  # arrays have another size
        self.parameter_values["start"] = self.given_parameters["start"] = start

    def _check_text(self, name: str, value: object) -> None:
        if not isinstance(value, str):
            raise ConfigurationError(
                f"'{self.name}.start.{name}' is text, not {value!r}\n  write \"{value}\""
            )

    def _is_beyond_doubles(self, name: str, value: object) -> bool:
        """Whether a whole number is one that a parameter, a double, does not hold.

        Raises
        ------
        ConfigurationError
            If its type does not hold it.
        """
        assert self._found is not None
        archive, quantity = self._found[1].archive, self._found[1].parameters.get(name)
        kinds = (*INTEGER, *BOOLEAN) if isinstance(value, int | float) else INTEGER
        if quantity is None or quantity.kind not in kinds or quantity.items:
            return False
        where = f"'{self.name}.start.{name}'"
        read = read_whole(value, quantity.kind, archive.version, quantity.shape, where=where)
        return any(abs(int(number)) > EXACT for number in read.ravel())

    def _observe(self) -> None:
        """Add an output for each variable that `observe` names."""
        interface = self.interface
        taken = {port.name for port in interface.ports}
        observable = Observable(
            interface.archive, arrays=self.given_parameters["arrays"], sizes=self._sizes()
        )
        for name, variable in self.given_parameters["observe"].items():
            where = f"'{self.name}.observe.{name}'"
            if not re.fullmatch(r"[A-Za-z]\w*", name) or name in taken:
                why = "is a port of the FMU" if name in taken else "is no name of a port"
                raise ConfigurationError(f"{where}: '{name}' {why}\n  choose another name")
            quantity = observable.find(str(variable), where)
            port = ImportedPort(name, "signal", False, None, {"": (quantity, None)})
            interface.ports.append(port)

    def tolerance_of_solver(self) -> float | None:
        """What is set, or in co-simulation what the FMU's default experiment says."""
        if given := float(self.given_parameters["tolerance"]):
            return given
        experiment = self.interface.archive.description.defaultExperiment
        own = None if experiment is None else experiment.tolerance
        return float(own) if own and self.interface.kind == CO_SIMULATION else None

    def _default_period(self) -> Fraction | None:
        experiment = self.interface.archive.description.defaultExperiment
        step = None if experiment is None else experiment.stepSize
        return None if step is None else Fraction(str(step)).limit_denominator(10**9)

    def _port(self, port: ImportedPort) -> Port[Any]:
        chosen = self.given_parameters["inputs_read"]
        at: Any = (port.at or "start") if chosen == "declared" else chosen
        fields = {n: self._field(port.name, q, f) for n, (q, f) in port.fields.items()}
        doc = next((q.doc for q, _ in port.fields.values()), "")
        made: Port[Any]
        if port.kind == "message" and port.is_input:
            made = MessageInput(fields=fields, at=at, optional=True, doc=doc)
        elif port.kind == "message":
            made = MessageOutput(fields=fields, doc=doc)
        elif "" not in fields and port.is_input:
            starts = {n: self._start_value(q) for n, (q, _) in port.fields.items()}
            made = BundleInput(fields, at=at, default=starts, doc=doc)
        elif "" not in fields:
            made = BundleOutput(fields, doc=doc)
        else:
            one = fields[""]
            options: dict[str, Any] = {"unit": one.unit, "frame": one.frame, "dtype": one.dtype}
            if port.is_input:
                default = self._start_value(port.fields[""][0])
                made = Input(one.fixed_shape, at=at, default=default, doc=doc, **options)
            else:
                made = Output(one.fixed_shape, doc=doc, **options)
        made.name = port.name
        return made

    def _field(self, port: str, quantity: Quantity, frame: str | None) -> Field:
        unit, wanted = quantity.unit, self.given_parameters["units"].get(port)
        known = isinstance(unit, str) and not unit.endswith(UNDEFINED) and unit != "1"
        if wanted is not None and (known or not isinstance(unit, str)) and unit != wanted:
            raise ConfigurationError(
                f"'{self.name}.units' says {wanted} for '{port}', the FMU says {unit}\n"
                "  leave it out: units are converted where ports are connected"
            )
        if wanted is not None:
            quantity.unit = str(wanted)
        other = self.given_parameters["frames"].get(port)
        if other is not None and frame not in (None, other):
            raise ConfigurationError(
                f"'{self.name}.frames' says {other} for '{port}', the FMU says {frame}"
            )
        return quantity.field(frame or other)

    def _start_value(self, quantity: Quantity) -> NDArray[Any]:
        given: Any = self._given.get(quantity.name)
        start = given if given is not None else quantity.start
        dtype = np.int64 if quantity.kind in INTEGER else np.float64
        if start is None:
            return np.zeros(quantity.shape, dtype)
        if quantity.kind == "UInt64" and (most := max(np.array(start, object).ravel())) > MOST:
            raise ConfigurationError(
                f"'{self.name}': '{quantity.name}' (UInt64) starts at {most}; a port holds at most "
                f"{MOST}"
            )
        return np.asarray(start, dtype=dtype).reshape(quantity.shape)

    def _read_starts(self) -> dict[str, NDArray[Any]]:
        """Values of ``start``, converted to the units of the variables."""
        known = self.settable()
        values: dict[str, NDArray[Any]] = {}
        self._texts: list[Start] = []
        for name, value in self.given_parameters["start"].items():
            if name in self.interface.texts:
                self._check_text(name, value)
                self._texts.append(Start(name, "String", (self.interface.texts[name],), (value,)))
                continue
            if name not in known:
                raise ConfigurationError(
                    f"'{self.name}.start': the FMU has no parameter or input '{name}'\n"
                    f"  {nearest(name, [*known, *self.interface.texts], what='it has')}"
                )
            quantity = known[name]
            if quantity.kind in (*INTEGER, *BOOLEAN):
                values[name] = read_whole(
                    value,
                    quantity.kind,
                    self.interface.archive.version,
                    quantity.shape,
                    where=f"'{self.name}.start.{name}'",
                )
                continue
            # nobody says what a foreign array's elements have in common
            reader = Parameter(
                shape=quantity.shape, unit=quantity.unit, frame="of the FMU", infinite=True
            )
            values[name] = reader.read(value, where=f"'{self.name}.start.{name}'")
        return values

    def settable(self) -> dict[str, Quantity]:
        """Parameters, inputs, and outputs with a start value of their own: what ``start`` names."""
        return self.interface.parameters | {
            q.name: q
            for port in self.interface.ports
            for q, _ in port.fields.values()
            if port.is_input or (q.initial in ("exact", "approx") and q.variability != "constant")
        }

    def own_settings(self) -> dict[str, tuple[Quantity, Setting[object]]]:
        """Parameters of the FMU by the names they have here, and how they are declared."""
        return {n: (self._quantities[n], s) for n, s in self._found_settings.items()}

    def given_starts(self) -> dict[str, NDArray[Any]]:
        """Numbers that were set, by the FMU's names, in the units of the variables."""
        found = dict(self._given)
        for start in self._start_settings():
            if start.name in self._quantities and not isinstance(start.rows, tuple):
                found[self._quantities[start.name].name] = start.rows[0]
        return found

    def scalar_names(self) -> dict[str, tuple[str, int]]:
        """Names of the FMU's scalar inputs and outputs: the port, and the place in it."""
        names: dict[str, tuple[str, int]] = {}
        for port in self.interface.ports:
            quantities = [q for q, _ in port.fields.values()]
            quantities += [q for q in (port.t, port.sequence) if q is not None]
            scalars = [name for q in quantities for name in q.scalars()]
            names |= {name: (port.name, k) for k, name in enumerate(scalars)}
        return names

    def validate(self) -> None:
        """Refuse an FMU whose step does not fit its rate."""
        if self._interface is None:
            return  # its file was refused, and that was said
        self.refuse_attributes()
        interface = self.interface
        step = getattr(interface.archive.description.coSimulation, "fixedInternalStepSize", None)
        tick = float(step or 0.0)
        if interface.own:
            tick = float(seconds(interface.archive.annotation.get("tick", "0"), "tick"))
        if interface.kind != CO_SIMULATION or not tick or self.rate is None:
            return
        for time in self.rate.exact_numbers or self.rate.times or ():
            if time and abs(float(time) / tick - round(float(time) / tick)) > 1e-6:
                raise ConfigurationError(
                    f"'{self.name}' steps {self.rate}, but its FMU takes multiples of {tick:.9g} s"
                    "\n  give it such a rate, or export it with another"
                )

    # ------------------------------------------------------------------ life cycle

    def taken_at_start(self) -> set[str]:
        """Inputs that it takes in initialization mode: all but those that hold start values."""
        held = self.given_parameters["hold_start_values"]
        return {n for n in super().taken_at_start() if not held or self.ports[n].at == "end"}

    def needed_by(self, output: str) -> set[str]:
        """Inputs that an output depends on in initialization mode, as the FMU declares."""
        if self._needs is None:
            self._needs = initial_dependencies(self.interface)
        found = self._needs.get(output)
        return super().needed_by(output) if found is None else found

    def begin_start(self) -> None:
        """Instantiate, and enter initialization mode."""
        self._make_fleet()
        assert self._fleet is not None
        self._begun = True
        self._tell(self._fleet, self._fleet.enter(self.environment.active.copy()))

    def settle(self, known: Iterable[str], outputs: Iterable[str]) -> None:
        """Set the inputs that are known and get some outputs, in initialization mode."""
        fleet, wanted = self._fleet, set(outputs)
        assert fleet is not None
        groups = [self._group(*k) for k in self._output_at if k[0] in wanted]
        self._tell(fleet, fleet.settle(self._take_known(set(known)), groups))
        for port, target, source in self._results_of:
            if port in wanted:
                target[...] = source

    def _initialize_impl(self) -> None:
        if not self._begun:
            self.begin_start()
        self._begun = False
        fleet = self._fleet
        assert fleet is not None
        known = self.known_at_start
        groups = self._take_known(self.taken_at_start() if known is None else known)
        active, messages = self.environment.active.copy(), self._fresh_messages()
        self._tell(fleet, fleet.leave(active, messages, groups))
        for target, source in self._results:
            target[...] = source
        self._publish_messages()

    def _make_fleet(self) -> None:
        interface, env = self.interface, self.environment
        self._inputs = [p for p in interface.ports if p.is_input and p.kind == "signal"]
        self._messages = [p for p in interface.ports if p.is_input and p.kind == "message"]
        self._outputs = [p for p in interface.ports if not p.is_input]
        self._published = [p for p in self._outputs if p.kind == "message"]
        read = [
            (p.name, n, q)
            for p in self._inputs
            for n, (q, _) in p.fields.items()
            # what nobody gives a value keeps that of the FMU
            if p.name not in self.undriven or q.start is not None or q.name in self._given
        ]
        written = [(p.name, n, q) for p in self._outputs for n, (q, _) in p.fields.items()]
        written += [(p.name, "t", p.t) for p in self._outputs if p.t]
        written += [(p.name, "sequence", p.sequence) for p in self._outputs if p.sequence]
        apart = interface.kind != CO_SIMULATION or interface.event_mode
        inputs, self._input_at = grouped(read, discrete_apart=apart)
        outputs, self._output_at = grouped(written)
        setup = Setup(
            str(Path(self.given_parameters["file"]).absolute()),
            interface.kind,
            env.path,
            inputs,
            outputs,
            (*self._start_settings(), *identities(interface, env, self._given)),
            self.given_parameters["solver"],
            self.tolerance_of_solver(),
            interface.event_mode,
            float(self.given_parameters["start_time"]),
        )
        starts = np.zeros((env.n_members, sum(g.size for g in inputs)))
        self._quantity_at = {(port, name): q for port, name, q in (*read, *written)}
        for port, name, quantity in read:
            columns = cells(starts, quantity.kind, self._input_at[port, name])
            columns[...] = self._start_value(quantity).ravel()
        self._fleet, remark = make_fleet(
            interface,
            setup,
            starts,
            usual_step(self.rate),
            isolate=self.given_parameters["isolate"],
            limit=float(self.given_parameters["time_limit"]),
        )
        self.remarks = [remark] if remark else []
        self._sequence = {p.name: np.zeros(env.n_members, np.int64) for p in self._outputs}
        self._t, self._first, self._logged = setup.start_time, True, 0
        self._start_time = setup.start_time
        self._skipped = ~env.active
        self._fleet.inputs[...] = starts
        self._bind_copies()

    def _start_settings(self) -> list[Start]:
        """What was set, or what members have values of their own of; not the inputs."""
        found = [
            start_values(name, self._quantities[name], setting, self.parameter_values[name])
            for name, setting in self._found_settings.items()
            if self.is_handed_on(name, setting)
        ]
        known = self.settable()
        for name, value in self._given.items():  # outputs, and numbers that no double holds
            q = known[name]
            if q.causality != "input":
                structural = q.causality == STRUCTURAL
                rows = value.reshape(1, -1)
                found.append(Start(name, q.kind, tuple(q.references), rows, structural))
        return [*found, *self._texts]

    def _view(self, port: str, name: str) -> NDArray[Any]:
        view = self.port_views[port]
        if isinstance(view, BundleView):
            found: NDArray[Any] = view.__dict__[name]
            return found
        plain: NDArray[Any] = view
        return plain

    def _take_known(self, known: Collection[str]) -> list[Group] | None:
        """Copy into the rows what is known at the start: inputs that may be set; None if all may.

        An input that is not known keeps its start value; the FMU its own, where it gives none.
        """
        groups, left_out = [], False
        for port, name in self._input_at:
            quantity = self._quantity_at[port, name]
            if port in known:
                rows = self._view(port, name).reshape(self.n_members, -1)
                finite = np.isfinite(rows.astype(np.float64)).all(axis=1)
                self._input_cells(port, name)[finite] = rows[finite]
            elif quantity.start is None and quantity.name not in self._given:
                left_out = True
                continue
            groups.append(self._group(port, name))
        return groups if left_out else None

    def _group(self, port: str, name: str) -> Group:
        """One quantity by itself."""
        quantity = self._quantity_at[port, name]
        places = self._input_at if (port, name) in self._input_at else self._output_at
        columns = places[port, name]
        return Group(quantity.kind, tuple(quantity.references), columns.start, quantity.size)

    def _take_late_inputs(self) -> None:
        """Copy inputs into the rows, but not those that are read at the start of a step."""
        for port, name in self._input_at:
            if self.ports[port].at == "end":
                rows = self._view(port, name).reshape(self.n_members, -1)
                self._input_cells(port, name)[...] = rows

    def _input_cells(self, port: str, name: str) -> NDArray[Any]:
        """What the FMU will read, (n_members, size), in the type of the port."""
        assert self._fleet is not None
        key = port, name
        return cells(self._fleet.inputs, self._quantity_at[key].kind, self._input_at[key])

    def _output_cells(self, port: str, name: str) -> NDArray[Any]:
        """What the FMU has written."""
        assert self._fleet is not None
        key = port, name
        return cells(self._fleet.outputs, self._quantity_at[key].kind, self._output_at[key])

    def _bind_copies(self) -> None:
        """Pairs (target, source) of what is copied before and after each step."""
        n = self.n_members
        self._copies = [
            (self._input_cells(port, name), self._view(port, name).reshape(n, -1))
            for port, name in self._input_at
        ]
        self._results_of = [
            (port, self._view(port, name).reshape(n, -1), self._output_cells(port, name))
            for port, name in self._output_at
            if self.ports[port].kind == "signal"
        ]
        self._results = [(target, source) for _, target, source in self._results_of]

    def _step_impl(self, t: float, dt: float) -> None:
        fleet = self._fleet
        assert fleet is not None
        if self._first and self.given_parameters["hold_start_values"]:
            self._take_late_inputs()
        else:
            for target, source in self._copies:
                target[...] = source
        self._first = False
        skipped = () if self.environment.active.all() else self._newly_gone()
        messages = self._fresh_messages() if self._messages else ()
        # not dt: the FMU must find the end of its step at t_now + h, to the last bit
        now = t + self._start_time
        failures = fleet.step(self._t, now - self._t, messages, skipped)
        self._t = now
        self._tell(fleet, failures)
        for target, source in self._results:
            target[...] = source
        self._publish_messages()

    def _newly_gone(self) -> list[int]:
        """Rows of members that fly no more since this was last asked."""
        gone = ~self.environment.active & ~self._skipped
        self._skipped |= gone
        rows: list[int] = np.flatnonzero(gone).tolist()
        return rows

    # ------------------------------------------------------------------ compiled steps

    def compiled_step(self) -> CompiledStep | None:
        """The step by the compiled driver, where it is signals in, step, signals out."""
        fleet = self._fleet
        plain = type(self)._step_impl is Fmu._step_impl and type(self).step is Fmu.step
        plain &= not (self._messages or self._published)
        if not plain or self.given_parameters["hold_start_values"]:
            return None
        if not isinstance(fleet, Fleet) or fleet.drive is None:
            return None
        if not all(can_copy(*pair) for pair in (*self._copies, *self._results)):
            return None
        taken = Copies([(target, source, None) for target, source in self._copies])
        given = Copies([(target, source, None) for target, source in self._results])
        return fleet.drive.component_step(taken, given, self._start_time)

    def _drive(self) -> tuple[Fleet, Any]:
        fleet = self._fleet
        assert isinstance(fleet, Fleet)
        assert fleet.drive is not None
        return fleet, fleet.drive.binding

    def begin_compiled(self) -> None:
        """Tell the driver who flies no more, and where the FMU stands."""
        fleet, binding = self._drive()
        if not self.environment.active.all() and (gone := self._newly_gone()):
            fleet.leave_out(gone)
        binding.t = self._t

    def end_compiled(self) -> None:
        """Take over how far the driver has stepped."""
        _, binding = self._drive()
        if binding.steps:
            self.step_index += binding.steps
            self._first = False
            self._t, binding.steps = binding.t, 0

    def attend_compiled(self) -> None:
        """Report what failed or was logged in a step, and publish."""
        fleet, _ = self._drive()
        self.end_compiled()
        self._tell(fleet, fleet.after_compiled())
        note_what_waits()
        for target, source in self._results:
            target[...] = source

    # ------------------------------------------------------------------ messages

    def _fresh_messages(self) -> list[Message]:
        """What came since the last step, for the members it came to."""
        sent = []
        for port in self._messages:
            view = self.port_views[port.name]
            if not isinstance(view, MessageReader) or not view.fresh.any():
                continue
            rows = np.flatnonzero(view.fresh)
            values = [(q, view.slot.views[n]) for n, (q, _) in port.fields.items()]
            assert port.t is not None
            assert port.sequence is not None
            values += [(port.t, view.t), (port.sequence, view.sequence)]
            for quantity, array in values:
                chosen = np.asarray(array[rows]).reshape(len(rows), -1)
                sent.append(Message(quantity.kind, tuple(quantity.references), rows, chosen))
        return sent

    def _publish_messages(self) -> None:
        """Publish messages where their number has changed."""
        for port in self._published:
            number = self._output_cells(port.name, "sequence")[:, 0].astype(np.int64)
            new = number > self._sequence[port.name]
            if not new.any():
                continue
            self._sequence[port.name] = number
            t = self._output_cells(port.name, "t")[:, 0]
            writer = self.port_views[port.name]
            for name, (quantity, _) in port.fields.items():
                rows = self._output_cells(port.name, name)
                writer.draft[name][...] = rows.reshape(self.n_members, *quantity.shape)
            writer.publish_draft(t, new)

    # ------------------------------------------------------------------ state

    def terminate(self) -> None:
        """Free the instances."""
        fleet, self._fleet = self._fleet, None
        if fleet is not None:
            fleet.close()

    def _extra_state(self) -> dict[str, Any]:
        assert self._fleet is not None
        return {
            "instances": [np.frombuffer(s, dtype=np.uint8) for s in self._fleet.save()],
            "sequence": {k: v.copy() for k, v in self._sequence.items()},
            "outputs": self._fleet.outputs.copy(),
            "t": self._t,
            "first": self._first,
        }

    def _set_extra_state(self, saved: dict[str, Any]) -> None:
        assert self._fleet is not None
        self._fleet.restore([np.asarray(s, dtype=np.uint8).tobytes() for s in saved["instances"]])
        self._fleet.outputs[...] = saved["outputs"]
        for name, numbers in saved["sequence"].items():
            self._sequence[name][...] = numbers
        self._t, self._first = float(saved["t"]), bool(saved["first"])


def identities(interface: Interface, env: Environment, given: Collection[str] = ()) -> list[Start]:
    """Seed and member of an FMU of terrafix: its noise is that of the native component."""
    if not interface.own:
        return []
    values = {"seed": np.full(env.n_members, env.seed), "member": env.members}
    found = []
    for name, numbers in values.items():
        q = interface.parameters.get(name)
        if q is not None and name not in given:
            rows = np.asarray(numbers).reshape(-1, 1)
            found.append(Start(name, q.kind, tuple(q.references), rows))
    return found


def usual_step(rate: Rate | None) -> float:
    """Length of a step [s]; of the first, where times are listed."""
    if rate is None or rate.times is None:
        return float((rate and rate.period) or 0)
    return float(next((t for t in rate.times if t), 0))


def _is_something(name: str) -> bool:
    """Whether a name of a component or of its table in a file means something else."""
    return hasattr(Fmu, name) or name in ATTRIBUTES | KEYS or name in ("rate", "given_parameters")


def grouped(
    quantities: Sequence[tuple[str, str, Quantity]], *, discrete_apart: bool = False
) -> tuple[tuple[Group, ...], dict[tuple[str, str], slice]]:
    """Gather quantities by type, side by side in a row; where each one stands.

    With `discrete_apart`, what is set in event mode alone is not mixed with what is continuous.
    """

    def key(q: Quantity) -> tuple[str, bool]:
        return q.kind, discrete_apart and (q.variability == "discrete" or q.kind not in REAL)

    kinds = list(dict.fromkeys(key(q) for _, _, q in quantities))
    groups, where, at = [], {}, 0
    for kind, discrete in kinds:
        first, references = at, []
        for port, name, q in quantities:
            if key(q) != (kind, discrete):
                continue
            references += q.references
            where[port, name] = slice(at, at + q.size)
            at += q.size
        groups.append(Group(kind, tuple(references), first, at - first, discrete))
    return tuple(groups), where
