"""An imported FMU as a component like any other: ``type = "fmu"``, ``file = "..."``."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate, seconds
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.parameters import Choice, FilePath, Flag, Parameter, Table
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
from terrafix.cosim.declare.settling import Settling
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION, MODEL_EXCHANGE
from terrafix.cosim.exchange.fmi.run.fleet import Failures, Fleet, Group, Message, Setup
from terrafix.cosim.exchange.fmi.run.reading import (
    ImportedPort,
    Interface,
    Quantity,
    initial_dependencies,
    read_interface,
)
from terrafix.cosim.exchange.fmi.run.remote import RemoteFleet
from terrafix.cosim.exchange.fmi.run.solvers import SOLVERS
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.memory.messages import MessageReader
from terrafix.cosim.memory.slots import BundleView


class Fmu(Settling):
    """A Functional Mock-up Unit, FMI 2 or 3, one instance for each member.

    Ports, units, arrays and start values are those of its model description. Inputs of an FMU that
    does not say otherwise are read at the start of a step: they hold what was published at the time
    the step begins, as masters of co-simulation have it.
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
    start = Table(doc="parameters and start values of inputs by name, with units")
    units = Table(doc="units of ports by name, where the FMU does not say")
    frames = Table(doc="frames of ports by name, where the FMU does not say")
    solver = Choice(SOLVERS, "cvode", doc="integrator of model exchange")
    tolerance = Parameter(1e-10, positive=True, doc="relative, of that integrator")
    start_time = Parameter(0.0, unit="s", doc="time of the FMU at t = 0")
    isolate = Flag(False, doc="run it in a process of its own: slower, but its crash is survived")
    time_limit = Parameter(
        60.0, unit="s", positive=True, doc="longest answer of an isolated FMU, in real time"
    )

    _interface: Interface | None = None
    _fleet: Fleet | RemoteFleet | None = None
    _needs: dict[str, set[str]] | None = None
    _begun = False

    # ------------------------------------------------------------------ declaration

    @property
    def interface(self) -> Interface:
        """What the FMU declares."""
        if self._interface is None:
            raise ConfigurationError("set the file of the FMU first")
        return self._interface

    def prepare(self) -> None:
        """Read the file, and declare its ports."""
        archive = open_archive(self.given_parameters["file"])
        self._interface = found = read_interface(
            archive, self.given_parameters["kind"], arrays=self.given_parameters["arrays"]
        )
        archive.binary(
            (
                archive.description.coSimulation
                if found.kind == CO_SIMULATION
                else archive.description.modelExchange
            ).modelIdentifier
        )
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
        if found.left_out:
            notes += (f"{', '.join(found.left_out)} cannot be connected: no numbers",)
        self.capabilities = Capabilities(state=found.serialize, notes=notes)  # type: ignore[misc]

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
        if wanted is not None and unit not in ("1", wanted):
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

    def _start_value(self, quantity: Quantity) -> FloatArray:
        given = self._given.get(quantity.name)
        start = given if given is not None else quantity.start
        value = np.zeros(quantity.shape) if start is None else np.asarray(start, dtype=np.float64)
        return value.reshape(quantity.shape)

    def _read_starts(self) -> dict[str, FloatArray]:
        """Values of ``start``, converted to the units of the variables."""
        known = self.settable()
        values: dict[str, FloatArray] = {}
        self._texts: list[tuple[int, str]] = []
        for name, value in self.given_parameters["start"].items():
            if name in self.interface.texts:
                if not isinstance(value, str):
                    raise ConfigurationError(
                        f"'{self.name}.start.{name}' is text, not {value!r}\n  write \"{value}\""
                    )
                self._texts.append((self.interface.texts[name], value))
                continue
            if name not in known:
                raise ConfigurationError(
                    f"'{self.name}.start': the FMU has no parameter or input '{name}'\n"
                    f"  {nearest(name, [*known, *self.interface.texts], what='it has')}"
                )
            quantity = known[name]
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

    def given_starts(self) -> dict[str, FloatArray]:
        """Values of ``start`` in the units of the variables."""
        return dict(self._given)

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
        return self._needs.get(output, super().needed_by(output))

    def begin_start(self) -> None:
        """Instantiate, and enter initialization mode."""
        self._make_fleet()
        assert self._fleet is not None
        self._begun = True
        self._report(self._fleet.enter(self.environment.active.copy()))

    def settle(self, known: Iterable[str], outputs: Iterable[str]) -> None:
        """Set the inputs that are known and get some outputs, in initialization mode."""
        fleet, wanted = self._fleet, set(outputs)
        assert fleet is not None
        groups = self._take_known(set(known))
        self._report(
            fleet.settle(groups, [self._group(*k) for k in self._output_at if k[0] in wanted])
        )
        for port, target, source in self._results_of:
            if port in wanted:
                target[...] = source

    def _initialize_impl(self) -> None:
        if not self._begun:
            self._make_fleet()
        fleet, active = self._fleet, self.environment.active.copy()
        assert fleet is not None
        known = self.known_at_start
        groups = self._take_known(self.taken_at_start() if known is None else known)
        messages = self._fresh_messages()
        finish = fleet.leave if self._begun else fleet.start
        self._begun = False
        self._report(finish(active, messages, groups))
        for target, source in self._results:
            target[...] = source
        self._publish_messages()

    def _make_fleet(self) -> None:
        interface, env = self.interface, self.environment
        self._inputs = [p for p in interface.ports if p.is_input and p.kind == "signal"]
        self._messages = [p for p in interface.ports if p.is_input and p.kind == "message"]
        self._outputs = [p for p in interface.ports if not p.is_input]
        self._published = [p for p in self._outputs if p.kind == "message"]
        read = [(p.name, n, q) for p in self._inputs for n, (q, _) in p.fields.items()]
        written = [(p.name, n, q) for p in self._outputs for n, (q, _) in p.fields.items()]
        written += [(p.name, "t", p.t) for p in self._outputs if p.t]
        written += [(p.name, "sequence", p.sequence) for p in self._outputs if p.sequence]
        inputs, self._input_at = grouped(read)
        outputs, self._output_at = grouped(written)
        setup = Setup(
            str(Path(self.given_parameters["file"]).absolute()),
            interface.kind,
            env.path,
            inputs,
            outputs,
            self._start_settings(),
            self._identities(),
            self.given_parameters["solver"],
            float(self.given_parameters["tolerance"]),
            float(self.given_parameters["start_time"]),
            tuple(self._texts),
        )
        limit = float(self.given_parameters["time_limit"])
        self._fleet = (
            RemoteFleet(setup, env.n_members, limit)
            if self.given_parameters["isolate"]
            else Fleet(setup, env.n_members)
        )
        self._sequence = {p.name: np.zeros(env.n_members, np.int64) for p in self._outputs}
        self._t, self._first = setup.start_time, True
        self._start_time = setup.start_time
        self._skipped = ~env.active
        self._quantity_at = {(port, name): q for port, name, q in (*read, *written)}
        for port, name, quantity in read:
            columns = self._input_at[port, name]
            self._fleet.inputs[:, columns] = self._start_value(quantity).ravel()
        self._bind_copies()

    def _start_settings(self) -> tuple[tuple[str, tuple[int, ...], tuple[float, ...]], ...]:
        known = self.settable()
        return tuple(
            (
                known[name].kind,
                tuple(known[name].references),
                tuple(float(v) for v in value.ravel()),
            )
            for name, value in self._given.items()
            if known[name].causality != "input"
        )

    def _identities(self) -> tuple[tuple[str, tuple[int, ...], tuple[float, ...]], ...]:
        """Seed and member of an FMU of terrafix: its noise is that of the native component."""
        if not self.interface.own:
            return ()
        env = self.environment
        values = {"seed": np.full(env.n_members, env.seed), "member": env.members}
        found = []
        for name, numbers in values.items():
            quantity = self.interface.parameters.get(name)
            if quantity is not None and name not in self._given:
                each = tuple(float(v) for v in numbers)
                found.append((quantity.kind, tuple(quantity.references), each))
        return tuple(found)

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
        fleet = self._fleet
        assert fleet is not None
        groups, left_out = [], False
        for (port, name), columns in self._input_at.items():
            quantity = self._quantity_at[port, name]
            if port in known:
                rows = self._view(port, name).reshape(self.n_members, -1)
                finite = np.isfinite(rows.astype(np.float64)).all(axis=1)
                fleet.inputs[finite, columns] = rows[finite]
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
        fleet = self._fleet
        assert fleet is not None
        for (port, name), columns in self._input_at.items():
            if self.ports[port].at == "end":
                fleet.inputs[:, columns] = self._view(port, name).reshape(self.n_members, -1)

    def _bind_copies(self) -> None:
        """Pairs (target, source) of what is copied before and after each step."""
        fleet = self._fleet
        assert fleet is not None
        n = self.n_members
        self._copies = [
            (fleet.inputs[:, columns], self._view(port, name).reshape(n, -1))
            for (port, name), columns in self._input_at.items()
        ]
        self._results_of = [
            (port, self._view(port, name).reshape(n, -1), fleet.outputs[:, columns])
            for (port, name), columns in self._output_at.items()
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
        active = self.environment.active
        skipped: Sequence[int] = ()
        if not active.all():
            gone = ~active & ~self._skipped
            if gone.any():
                skipped = np.flatnonzero(gone).tolist()
                self._skipped |= gone
        messages = self._fresh_messages() if self._messages else ()
        failures = fleet.step(self._t, dt, messages, skipped)
        self._t = t + self._start_time
        if failures:
            self._report(failures)
        for target, source in self._results:
            target[...] = source
        self._publish_messages()

    def _report(self, failures: Failures) -> None:
        for row, text in failures.items():
            mask = np.zeros(self.n_members, dtype=np.bool_)
            mask[row] = True
            self.fail(mask, text)

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
                chosen = np.asarray(array[rows], dtype=np.float64).reshape(len(rows), -1)
                sent.append(Message(quantity.kind, tuple(quantity.references), rows, chosen))
        return sent

    def _publish_messages(self) -> None:
        """Publish messages where their number has changed."""
        fleet = self._fleet
        assert fleet is not None
        for port in self._published:
            number = fleet.outputs[:, self._output_at[port.name, "sequence"]][:, 0].astype(np.int64)
            new = number > self._sequence[port.name]
            if not new.any():
                continue
            self._sequence[port.name] = number
            t = fleet.outputs[:, self._output_at[port.name, "t"]][:, 0]
            writer = self.port_views[port.name]
            for name, (quantity, _) in port.fields.items():
                rows = fleet.outputs[:, self._output_at[port.name, name]]
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


def grouped(
    quantities: Sequence[tuple[str, str, Quantity]],
) -> tuple[tuple[Group, ...], dict[tuple[str, str], slice]]:
    """Gather quantities by type, side by side in a row; where each one stands."""
    kinds = list(dict.fromkeys(q.kind for _, _, q in quantities))
    groups, where, at = [], {}, 0
    for kind in kinds:
        first, references = at, []
        for port, name, q in quantities:
            if q.kind != kind:
                continue
            references += q.references
            where[port, name] = slice(at, at + q.size)
            at += q.size
        groups.append(Group(kind, tuple(references), first, at - first))
    return tuple(groups), where
