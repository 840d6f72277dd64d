"""FMUs that depend on each other within a step: steps repeated until they agree.

The scheduler orders components so that nobody waits for himself, and refuses a loop of inputs read
at the end. Where FMUs are such a loop, this component steps them together: every step is repeated
from the same states, each time with the inputs that the others' outputs at its end imply, until
these stand still. (With an explicit Euler step inside, that is the implicit Euler method.)
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, WiringError, nearest
from terrafix.cosim.declare.component import ATTRIBUTES, KEYS
from terrafix.cosim.declare.parameters import Count, FileTable, Parameter, Setting, Text
from terrafix.cosim.declare.ports import Capabilities, Input, Output, Port
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION
from terrafix.cosim.exchange.fmi.run.component import Fmu, grouped, identities, usual_step
from terrafix.cosim.exchange.fmi.run.fleet import Setup
from terrafix.cosim.exchange.fmi.run.parameters import Size, Start, start_values
from terrafix.cosim.exchange.fmi.run.places import AnyFleet, make_fleet
from terrafix.cosim.exchange.fmi.run.telling import Telling
from terrafix.cosim.system.wiring import check_connection, port_factor

_CONNECTION = re.compile(r"\s*(\w+)\.(\w+)\s*->\s*(\w+)\.(\w+)\s*\Z")


class FmuLoop(Telling):
    """Several FMUs for co-simulation, iterated in every step until their signals agree.

    Outputs are called ``a_y`` for output y of FMU a; inputs that are not connected within
    likewise, and parameters. The FMUs must be able to get and set their state.
    """

    files = FileTable(doc="the .fmu files by name")
    connect = Text(doc='connections within: "a.y -> b.u, b.y -> a.u"')
    tolerance = Parameter(1e-12, positive=True, doc="of a signal, relative to one plus its size")
    most_iterations = Count(100, minimum=1, doc="steps repeated at most so often")

    _begun = False
    _files: dict[str, Any] | None = None
    _parts: dict[str, Fmu]
    _owner: dict[str, tuple[str, str]]

    def declare_settings(self) -> None:
        """Declare the parameters of the FMUs: ``a_k`` for parameter k of FMU a."""
        files = self.given_parameters.get("files", {})
        if self._files != files:
            self._parts = {}
            for name, file in files.items():
                self._parts[name] = Fmu(file=file, kind=CO_SIMULATION)
                self._parts[name].name = name
            self._files = dict(files)
        settings: dict[str, Setting[object]] = {}
        owner: dict[str, tuple[str, str]] = {}
        for part, fmu in self._parts.items():
            fmu.declare_settings()
            for own, (_, setting) in fmu.own_settings().items():
                name = f"{part}_{own}"
                if name in settings or name in ATTRIBUTES | KEYS or hasattr(FmuLoop, name):
                    before, first = owner.get(name, ("", ""))
                    other = f"'{first}' of FMU '{before}'" if before else "another"
                    raise ConfigurationError(
                        f"'{self.name}': parameter '{own}' of FMU '{part}' would be called "
                        f"'{name}', as {other} is\n  give the FMU another name in files"
                    )
                settings[name], owner[name] = setting, (part, own)
        for name in self._found_settings.keys() - settings.keys():
            if name in self.given_parameters:
                raise ConfigurationError(
                    f"'{self.name}.{name}' was set, but its FMUs have no such parameter\n"
                    f"  {nearest(name, settings, what='they have')}"
                )
        self._found_settings, self._owner = settings, owner

    def set_parameter(self, name: str, value: object, *, bare: bool = True) -> None:
        """Set a parameter by name, of the component or of its FMUs."""
        if name not in self.settings() and not self.missing_settings():
            self.declare_settings()
        super().set_parameter(name, value, bare=bare)
        if isinstance(self._found_settings.get(name), Size):  # arrays have another size
            part, own = self._owner[name]
            self._parts[part].set_parameter(own, value)
            self.declare_settings()

    def prepare(self) -> None:
        """Read the files, and declare parameters, and the ports that are not connected within."""
        self.declare_settings()
        for name, part in self._parts.items():
            self._prepare_part(name, part)
        self._links = [
            self._link(text) for text in self.given_parameters["connect"].split(",") if text.strip()
        ]
        self._factors = [
            port_factor(self._parts[a].ports[y], self._parts[b].ports[u])
            for a, y, b, u in self._links
        ]
        driven = {(b, port) for _, _, b, port in self._links}
        self.ports = {}
        for name, part in self._parts.items():
            for key, port in part.ports.items():
                if not port.is_input or (name, key) not in driven:
                    self._declare(f"{name}_{key}", port)
        serializes = all(p.interface.serialize for p in self._parts.values())
        given = all(p.capabilities.given for p in self._parts.values())
        self.capabilities = Capabilities(state=serializes, given=given)  # type: ignore[misc]

    def _declare(self, name: str, port: Port[Any]) -> None:
        one = port.single
        options: dict[str, Any] = {"unit": one.unit, "frame": one.frame, "doc": port.doc}
        made: Port[Any] = (
            Input(one.fixed_shape, at=port.at, default=port.default, **options)
            if port.is_input
            else Output(one.fixed_shape, **options)
        )
        if name in self.ports or name in self._found_settings or hasattr(FmuLoop, name):
            raise ConfigurationError(
                f"'{self.name}': a port of its FMUs would be called '{name}', as another port or "
                "parameter is\n  give one of the FMUs another name in files"
            )
        made.name = name
        self.ports[name] = made

    def _prepare_part(self, name: str, part: Fmu) -> None:
        part.prepare()
        if not part.interface.state:
            raise ConfigurationError(
                f"'{self.name}': the FMU '{name}' cannot get and set its state, so its steps "
                "cannot be repeated"
            )
        for key, port in part.ports.items():
            if port.kind != "signal" or port.is_bundle or port.single.dtype != np.float64:
                raise ConfigurationError(
                    f"'{self.name}': port '{key}' of '{name}' is no plain signal of real numbers"
                )

    def validate(self) -> None:
        """Refuse parameters that were assigned as attributes."""
        self.refuse_attributes()

    def _link(self, text: str) -> tuple[str, str, str, str]:
        match = _CONNECTION.match(text)
        if match is None:
            raise WiringError(f"'{self.name}': '{text.strip()}' is no connection: write a.y -> b.u")
        ends = match.groups()
        for owner, port in (ends[:2], ends[2:]):
            if owner not in self._parts:
                raise WiringError(
                    f"'{self.name}' has no FMU '{owner}'\n"
                    f"  {nearest(owner, self._parts, what='its FMUs')}"
                )
            if port not in self._parts[owner].ports:
                raise WiringError(
                    f"'{self.name}': FMU '{owner}' has no port '{port}'\n"
                    f"  {nearest(port, self._parts[owner].ports, what='its ports')}"
                )
        source, target = (self._parts[o].ports[p] for o, p in (ends[:2], ends[2:]))
        check_connection(".".join(ends[:2]), source, ".".join(ends[2:]), target)
        return ends  # type: ignore[return-value]

    # ------------------------------------------------------------------ life cycle

    def begin_start(self) -> None:
        """Instantiate all, and enter initialization mode."""
        self._make_fleets()
        self._begun = True
        for name, fleet in self._fleets.items():
            self._tell(fleet, fleet.enter(self.environment.active.copy()), name)

    def settle(self, known: Iterable[str], outputs: Iterable[str]) -> None:
        """Hand on outputs within, in initialization mode, until they stand still."""
        del outputs  # all of them
        self._outside(finite=True, known=set(known))
        most = self.given_parameters["most_iterations"]
        for _ in range(max(most, len(self._parts) + 1)):
            for name, fleet in self._fleets.items():
                groups = fleet.setup.inputs, fleet.setup.outputs
                self._tell(fleet, fleet.settle(*groups), name)
            change = self._inside()
            wanting = (change > self.parameter_values["tolerance"]) & self.environment.active
            if not wanting.any():
                break
        else:
            self.fail(wanting, f"at t = 0, signals did not settle in {most} repetitions")
        self._publish()

    def _initialize_impl(self) -> None:
        if not self._begun:
            self.begin_start()
        self._begun = False
        known = self.known_at_start
        self.settle(self.taken_at_start() if known is None else known, ())
        for name, fleet in self._fleets.items():
            self._tell(fleet, fleet.leave(self.environment.active.copy()), name)
        self._inside()
        self._publish()

    def _make_fleets(self) -> None:
        env = self.environment
        self._fleets: dict[str, AnyFleet] = {}
        self.remarks = []
        self._at: dict[tuple[str, str], slice] = {}
        for name, part in self._parts.items():
            ports = part.interface.ports
            read = [(p.name, "", p.fields[""][0]) for p in ports if p.is_input]
            written = [(p.name, "", p.fields[""][0]) for p in ports if not p.is_input]
            inputs, input_at = grouped(read)
            outputs, output_at = grouped(written)
            self._at |= {(name, port): at for (port, _), at in (input_at | output_at).items()}
            file = str(part.interface.archive.path.absolute())
            setup = Setup(
                file,
                CO_SIMULATION,
                f"{env.path}.{name}",
                inputs,
                outputs,
                (*self._starts(name), *identities(part.interface, env)),
                tolerance=part.tolerance_of_solver(),
            )
            starts = np.zeros((env.n_members, sum(g.size for g in inputs)))
            for port in part.inputs():
                starts[:, self._at[name, port]] = np.asarray(part.ports[port].default).ravel()
            fleet, remark = make_fleet(part.interface, setup, starts, usual_step(self.rate))
            self._fleets[name] = fleet
            self.remarks += [remark] if remark else []
            fleet.inputs[...] = starts
        self._t, self._logged = 0.0, 0

    def _starts(self, part: str) -> list[Start]:
        """Parameters of one FMU that were set, or that members have values of their own of."""
        own = self._parts[part].own_settings()
        return [
            start_values(name, own[key][0], setting, self.parameter_values[name])
            for name, setting in self._found_settings.items()
            for owner, key in (self._owner[name],)
            if owner == part and self.is_handed_on(name, setting)
        ]

    def _outside(self, *, finite: bool = False, known: Collection[str] | None = None) -> None:
        """Take the inputs that come from outside, or those that are known of them."""
        for name, part in self._parts.items():
            for port in part.inputs():
                view = self.port_views.get(f"{name}_{port}")
                if view is None or (known is not None and f"{name}_{port}" not in known):
                    continue
                rows = view.reshape(self.n_members, -1)
                target = self._fleets[name].inputs[:, self._at[name, port]]
                np.copyto(target, rows, where=np.isfinite(rows) if finite else True)

    def _inside(self) -> FloatArray:
        """Hand outputs on to inputs within; by how much these change, for each member."""
        change = np.zeros(self.n_members)
        for (a, y, b, u), factor in zip(self._links, self._factors, strict=True):
            values = self._fleets[a].outputs[:, self._at[a, y]]
            values = values if factor is None else values * factor
            target = self._fleets[b].inputs[:, self._at[b, u]]
            change = np.maximum(
                change, np.max(np.abs(values - target) / (1 + np.abs(values)), axis=1)
            )
            target[...] = values
        return change

    def _step_impl(self, t: float, dt: float) -> None:
        self._outside()
        for fleet in self._fleets.values():
            fleet.mark()
        tolerance = self.parameter_values["tolerance"]
        before, self._t = self._t, t
        for _ in range(self.given_parameters["most_iterations"]):
            for name, fleet in self._fleets.items():
                self._tell(fleet, fleet.step(before, t - before, (), self._gone()), name)
            change = self._inside()
            wanting = (change > tolerance) & self.environment.active
            if not wanting.any():
                break
            for fleet in self._fleets.values():
                fleet.return_to_mark()
        else:
            most = self.given_parameters["most_iterations"]
            self.fail(wanting, f"signals did not settle in {most} repetitions of a step")
        self._publish()

    def _gone(self) -> list[int]:
        rows: list[int] = np.flatnonzero(~self.environment.active).tolist()
        return rows

    def _publish(self) -> None:
        for name, part in self._parts.items():
            for port in part.outputs():
                rows = self._fleets[name].outputs[:, self._at[name, port]]
                view = self.port_views[f"{name}_{port}"]
                view[...] = rows.reshape(view.shape)

    # ------------------------------------------------------------------ state

    def terminate(self) -> None:
        """Free the instances."""
        for fleet in getattr(self, "_fleets", {}).values():
            fleet.close()
        self._fleets = {}

    def _extra_state(self) -> dict[str, Any]:
        return {
            name: {
                "instances": [np.frombuffer(s, dtype=np.uint8) for s in fleet.save()],
                "inputs": fleet.inputs.copy(),
                "outputs": fleet.outputs.copy(),
            }
            for name, fleet in self._fleets.items()
        } | {"t": self._t}

    def _set_extra_state(self, saved: dict[str, Any]) -> None:
        for name, fleet in self._fleets.items():
            kept = saved[name]
            fleet.restore([np.asarray(s, dtype=np.uint8).tobytes() for s in kept["instances"]])
            fleet.inputs[...], fleet.outputs[...] = kept["inputs"], kept["outputs"]
        self._t = float(saved["t"])
