r"""Linear covariance analysis: a campaign predicted from one nominal run and symbolic Jacobians.

The system is flown once without noise. About that run, deviations of everything that components
keep or publish (truth and filter alike, stacked into :math:`z`) are linear in what is drawn:

.. math::
    z_{k+1} = F_k z_k + \sum_s G_{s,k} w_{s,k}, \qquad
    C_{s,k+1} = F_k C_{s,k} F_k^T + G_{s,k} G_{s,k}^T,

with one covariance :math:`C_s` per source :math:`s` (a stream of noise, its draw at the start, a
dispersion). :math:`F` and :math:`G` are put together tick by tick from the Jacobians of the
components' steps, in the order in which they step, through the connections. The error of the
estimate is one more linear function of :math:`z`, so its covariance is that of a campaign's
sample whether or not the filter's model is the truth's; what the filter itself predicts is its
covariance in the nominal run.

Matrices (an estimate's covariance, a fix's) are not deviated: gains are those of the nominal run.
A deviation of a gain acts on the nominal innovation, which is zero where the filter's model of
the mean is the truth's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Exact, seconds
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.evaluation import Evaluation
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.kernels.base import BoundKernel
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.cosim.system.wiring import port_factor

Key = tuple[str, str, str]
"""(kind, component, name): kind ``"state"``, ``"slot"``, ``"held"`` or ``"parameter"``."""
SCHEMA = "terrafix-lincov/1"
AT_ONCE = 4096
"""Ticks after which what was noted of the nominal run is worked off."""
EVERY = 8
"""Ticks that share a Jacobian, that of the middle one, where only one group of components steps
and nothing is published but signals: a power of two. A spacecraft turns by 0.005 degrees then."""
UNOBSERVED = 0.5
"""Part of a variance that fixes leave, above which its direction counts as not observed."""


class Direction(NamedTuple):
    """A direction of the error: what part of its variance without fixes remains with them.

    `components` are in sigma without fixes, by axis, of unit length.
    """

    remaining: float
    components: FloatArray


@dataclass
class LinearCovariance:
    """What is predicted of a campaign.

    Attributes
    ----------
    path : str
        Of the evaluation component.
    labels, units : list of str
        Of each axis.
    times : ndarray, shape (n_epochs,)
        [s]
    filter : ndarray, shape (n_epochs, n_axes, n_axes)
        Covariance that the filter predicts.
    sources : dict of str to ndarray, shape (n_epochs, n_axes, n_axes)
        Covariance of the error by source: the error budget.
    directions : list of Direction
        Directions of the error at the end by what the fixes leave of them, the largest first;
        empty where the evaluation publishes no covariance.
    """

    path: str
    labels: list[str]
    units: list[str]
    times: FloatArray
    filter: FloatArray
    sources: dict[str, FloatArray] = field(default_factory=dict)
    directions: list[Direction] = field(default_factory=list)

    @property
    def total(self) -> FloatArray:
        """Covariance of the error, (n_epochs, n_axes, n_axes)."""
        return sum(self.sources.values(), np.zeros_like(self.filter))

    @property
    def sigma_filter(self) -> FloatArray:
        """Sigma that the filter predicts, (n_epochs, n_axes)."""
        return np.sqrt(np.diagonal(self.filter, axis1=1, axis2=2))

    @property
    def sigma(self) -> FloatArray:
        """Sigma that a campaign's sample will show, (n_epochs, n_axes)."""
        return np.sqrt(np.diagonal(self.total, axis1=1, axis2=2))

    def budget(self) -> dict[str, FloatArray]:
        """Sigma at the end due to each source alone, (n_axes,), the largest contribution first."""
        total = np.diagonal(self.total[-1])
        found = {name: np.sqrt(np.diagonal(c[-1])) for name, c in self.sources.items()}
        return dict(sorted(found.items(), key=lambda item: -float((item[1] ** 2 / total).max())))

    def unobserved(self) -> list[Direction]:
        """Directions of which the fixes leave more than `UNOBSERVED`."""
        return [d for d in self.directions if d.remaining > UNOBSERVED]

    def dataset(self) -> Any:
        """As an `xarray.Dataset`."""
        import xarray

        n = len(self.labels)
        both = ("time", "axis", "axis_b")
        remaining = [d.remaining for d in self.directions]
        vectors = [d.components for d in self.directions]
        return xarray.Dataset(
            {
                "filter": (both, self.filter),
                "error": (
                    ("source", *both),
                    np.stack(list(self.sources.values()))
                    if self.sources
                    else np.zeros((0, *self.filter.shape)),
                ),
                "remaining": ("direction", np.array(remaining, dtype=np.float64)),
                "direction_components": (
                    ("direction", "axis"),
                    np.array(vectors, dtype=np.float64).reshape(-1, n),
                ),
            },
            {
                "time": ("time", self.times, {"units": "s"}),
                "axis": self.labels,
                "axis_b": self.labels,
                "unit": ("axis", self.units),
                "source": np.array(list(self.sources), dtype=object),
            },
            {"path": self.path, "schema": SCHEMA},
        )

    @classmethod
    def of_dataset(cls, dataset: Any) -> LinearCovariance:
        """The inverse of `dataset`."""
        return cls(
            str(dataset.attrs["path"]),
            [str(v) for v in dataset["axis"].values],
            [str(v) for v in dataset["unit"].values],
            dataset["time"].values,
            dataset["filter"].values,
            {str(s): dataset["error"].values[i] for i, s in enumerate(dataset["source"].values)},
            [
                Direction(float(r), v)
                for r, v in zip(
                    dataset["remaining"].values, dataset["direction_components"].values, strict=True
                )
            ],
        )


def linear_covariance(system: System, *, duration: Exact | None = None) -> LinearCovariance:
    """Predict a campaign of a system.

    Parameters
    ----------
    system : System
        Of symbolic components, and one evaluation that offers an `error_model`.
    duration : exact time, optional
        [s]; the system's own if absent.

    Raises
    ------
    ConfigurationError
        If a component cannot be linearized; it is named.
    """
    length = system.duration if duration is None else seconds(duration, "duration")
    if length is None:
        raise ConfigurationError(f"system '{system.name}' has no duration; give one")
    simulation = Simulation(system, members=1, duration=length, recording=False, quiet=True)
    try:
        analysis = _Analysis(simulation)
        analysis.fly(simulation.master.ticks(length))
        result = analysis.result()
    finally:
        simulation.master.terminate()
    result.directions = _directions(system, length, result)
    return result


class _Call(NamedTuple):
    """One step of one component in the nominal run."""

    path: str
    arguments: list[FloatArray]
    valid: dict[str, bool]


class _Noted(NamedTuple):
    """The calls of one tick, and of how many ticks they are an example."""

    calls: list[_Call]
    repeat: int


class _Listening(BoundKernel):
    """A kernel that notes what it is called with."""

    def __init__(self, component: _Linear, kernel: BoundKernel) -> None:
        self._component = component
        self.kernel = kernel

    def __call__(self, step: int) -> int:
        component = self._component
        arguments = [a.reshape(-1).copy() for a in component.needed]
        failed = self.kernel(step)
        messages = component.component._messages
        valid = {name: bool(flag[0] > 0.5) for name, flag in messages.items()}
        component.calls.append(_Call(component.path, arguments, valid))
        return failed


class _Linear:
    """A symbolic component, and the Jacobian of its step by what deviates."""

    def __init__(self, path: str, component: SymbolicComponent, analysis: _Analysis) -> None:
        import casadi as ca

        self.path = path
        self.component = component
        self.calls: list[_Call] = []
        model = component.model
        vectors = [n for n in model.states if len(model.shape(n)) == 1]
        self.states = {n: int(np.prod(model.shape(n))) for n in vectors}
        self.inputs = {}
        for n in model.inputs:
            if n.endswith((".fresh", ".t")) or len(model.shape(n)) > 1:
                continue
            source = analysis.source(path, n)
            if source is not None:
                self.inputs[n] = source
        self.parameters = [
            n for n in model.parameters if ("parameter", path, n) in analysis.dispersed
        ]
        wanted = analysis.read.get(path, set())
        self.outputs = [n for n in model.outputs if n in wanted and len(model.shape(n)) == 1]
        self.noise = {n: int(np.prod(model.shape(n))) for n in model.noise}
        self.step_jacobian, self.step_arguments = self._jacobian(ca, start=False)
        self.start_jacobian, self.start_arguments = self._jacobian(ca, start=True)
        arrays = component.arguments()
        self.needed = [arrays[n] for n in self.step_arguments]
        self.listening = _Listening(self, component._call)

    def columns(self, *, start: bool) -> list[tuple[str, str]]:
        """What the Jacobian is taken by: (kind, name), in order."""
        kinds = [] if start else [("state", n) for n in self.states]
        kinds += [("input", n) for n in self.inputs] + [("parameter", n) for n in self.parameters]
        return kinds + [("noise", n) for n in self.noise]

    def _jacobian(self, ca: Any, *, start: bool) -> tuple[Any, list[str]]:
        """Function of the arguments that matter to the Jacobian, and their names."""
        model = self.component.model
        function = model.initial_function() if start else model.step_function()
        states = [] if start else [f"state:{n}" for n in model.states]
        names = [*model.inputs, *states, *model.parameters, *model.noise]
        names += ["step"] * (model.step is not None) + ["time"] * (model.time is not None)
        symbols = {n: ca.SX.sym(f"a{i}", function.numel_in(i)) for i, n in enumerate(names)}
        results = function.call(list(symbols.values()))
        result_of = dict(
            zip([*model.outputs, *(f"state:{n}" for n in model.states)], results, strict=True)
        )
        rows = [result_of[n] for n in self.outputs] + [result_of[f"state:{n}"] for n in self.states]
        prefix = {"state": "state:", "input": "", "parameter": "", "noise": ""}
        by = [symbols[prefix[kind] + n] for kind, n in self.columns(start=start)]
        if not rows or not by:
            return None, []
        jacobian = ca.densify(ca.jacobian(ca.vertcat(*rows), ca.vertcat(*by)))
        free = {e.element_hash() for e in ca.symvar(jacobian)}
        needed = [n for n in names if any(e.element_hash() in free for e in symbols[n].elements())]
        made = ca.Function("jacobian", [symbols[n] for n in needed], [jacobian], {"cse": True})
        return made, needed

    def evaluate(self, calls: list[_Call]) -> FloatArray:
        """Jacobians of some steps, (n, rows, columns)."""
        return _evaluated(self.step_jacobian, [c.arguments for c in calls])


def _evaluated(function: Any, arguments: list[list[FloatArray]]) -> FloatArray:
    n = len(arguments)
    rows, columns = function.size_out(0)
    given = [np.stack(a, axis=1) for a in zip(*arguments, strict=True)]
    if not given:
        return np.broadcast_to(np.asarray(function()["o0"]), (n, rows, columns))
    flat = np.asarray(_mapped(function, n)(*given))
    return flat.reshape(rows, n, columns).transpose(1, 0, 2)


@lru_cache(maxsize=64)
def _mapped(function: Any, n: int) -> Any:
    return function.map(n)


class _Analysis:
    """Deviations of one system, and how they move."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        flat = simulation.plan.flat
        self.order = simulation.plan.order
        evaluations = {p: c for p, c in flat.components.items() if isinstance(c, Evaluation)}
        if len(evaluations) != 1:
            raise ConfigurationError(
                f"linear covariance analysis needs one evaluation component, and system "
                f"'{simulation.system.name}' has {len(evaluations)}"
            )
        ((self.evaluation_path, self.evaluation),) = evaluations.items()
        try:
            self.error_model = self.evaluation.error_model()
        except NotImplementedError:
            raise ConfigurationError(
                f"'{self.evaluation_path}' ({type(self.evaluation).__name__}) offers no "
                "error_model, which linear covariance analysis needs"
            ) from None
        for path, component in flat.components.items():
            if component is not self.evaluation and not isinstance(component, SymbolicComponent):
                raise ConfigurationError(
                    f"'{path}' ({type(component).__name__}) has no symbolic Jacobian, so the "
                    "system cannot be linearized\n  fly a campaign instead"
                )
        self._error_jacobian = _error_jacobian(self.error_model)
        self.connections = {c.target: c for c in flat.connections}
        self.dispersed: dict[Key, Dispersion] = {}
        for d in flat.dispersions:
            for target in d.targets:
                owner, _, name = target.rpartition(".")
                self.dispersed["parameter", owner, name] = d
        self._find_read()
        self.linear = {
            path: _Linear(path, c, self)
            for path, c in flat.components.items()
            if isinstance(c, SymbolicComponent)
        }
        self._lay_out()
        self.errors: list[tuple[float, dict[str, FloatArray]]] = []

    # ------------------------------------------------------------------ who reads what

    def source(self, path: str, name: str) -> tuple[Key, FloatArray | None] | None:
        """Where an input comes from, and its unit conversion; None if it does not deviate."""
        head, _, tail = name.partition(".")
        connection = self.connections.get(f"{path}.{head}")
        if connection is None:
            return None
        flat = self.simulation.plan.flat
        owner, _, port_name = connection.source.rpartition(".")
        port = flat.components[path].ports[head]
        if connection.delay or port.window or port.queue > 1:
            what = "a delay" if connection.delay else "a window or queue"
            raise ConfigurationError(
                f"the connection to '{path}.{head}' has {what}, which is not linearized\n"
                "  fly a campaign instead"
            )
        factor = port_factor(flat.components[owner].ports[port_name], port)
        if factor is not None:
            factor = self._part(port, tail, factor)
        full = f"{port_name}.{tail}" if tail else port_name
        key: Key = ("held", path, name) if port.at == "start" else ("slot", owner, full)
        return key, factor

    @staticmethod
    def _part(port: Any, tail: str, factor: FloatArray) -> FloatArray | None:
        start = 0
        for name, each in port.fields.items():
            part = factor[start : start + each.size]
            if name == tail:
                return part
            start += each.size
        return None

    def slot_of(self, path: str, name: str) -> Key:
        """The slot behind an input, whenever it is read."""
        head, _, tail = name.partition(".")
        owner, _, port_name = self.connections[f"{path}.{head}"].source.rpartition(".")
        return "slot", owner, f"{port_name}.{tail}" if tail else port_name

    def _find_read(self) -> None:
        self.read: dict[str, set[str]] = {}
        flat = self.simulation.plan.flat
        readers = [
            (p, list(c.model.inputs))
            for p, c in flat.components.items()
            if isinstance(c, SymbolicComponent)
        ]
        readers.append((self.evaluation_path, list(self.error_model.inputs)))
        for path, names in readers:
            for name in names:
                if f"{path}.{name.partition('.')[0]}" in self.connections:
                    _, owner, full = self.slot_of(path, name)
                    self.read.setdefault(owner, set()).add(full)

    def _lay_out(self) -> None:
        """Give everything that deviates a place in z, and every source a number."""
        self.place: dict[Key, slice] = {}
        self.held: dict[Key, Key] = {}
        size = 0

        def room(key: Key, n: int) -> None:
            nonlocal size
            if key not in self.place:
                self.place[key] = slice(size, size + n)
                size += n

        self.sources: list[str] = []
        for path, linear in self.linear.items():
            model = linear.component.model
            for name, n in linear.states.items():
                room(("state", path, name), n)
            for name in linear.outputs:
                room(("slot", path, name), int(np.prod(model.shape(name))))
            for name, (key, _) in linear.inputs.items():
                if key[0] == "held":
                    room(key, int(np.prod(model.shape(name))))
                    self.held[key] = self.slot_of(path, name)
            for name in linear.noise:
                self.sources += [f"{path}.{name} at the start", f"{path}.{name}"]
        names = list(dict.fromkeys(d.name for d in self.dispersed.values()))
        self.sources += [f"dispersion {name}" for name in names]
        number = {name: i for i, name in enumerate(self.sources)}
        components = self.simulation.plan.flat.components
        starts = []
        for key, d in self.dispersed.items():
            linear = self.linear[key[1]]
            room(key, int(np.prod(linear.component.model.shape(key[2]))))
            starts.append((number[f"dispersion {d.name}"], key, d))
        self.size = size
        self.C = np.zeros((len(self.sources), size, size))
        for i, key, d in starts:
            # targets of one dispersion take the same draw
            for other_i, other, _ in starts:
                if other_i == i:
                    nominal = components[key[1]]._settings[key[2]][0]
                    self.C[i, self.place[key], self.place[other]] = _dispersed_covariance(
                        d, components, nominal
                    )

    # ------------------------------------------------------------------ moving

    def fly(self, end: int) -> None:
        """Fly the nominal run and move the covariances along with it."""
        plan, master = self.simulation.plan, self.simulation.master
        rate = self.evaluation.rate
        assert rate is not None
        self._epochs = {0} if rate.starts_at_zero else set()
        for tick in rate.ticks(plan.base, plan.grid):
            if tick > end:
                break
            self._epochs.add(tick)
        self._place_of = {path: i for i, path in enumerate(self.order)}
        self._programs: dict[bool, Any] = {True: {}, False: {}}
        self.simulation.initialize()
        self._start()
        if 0 in self._epochs:
            self._evaluate(0.0)
        self._noted: list[_Noted] = []
        while master.tick < end:
            self._advance(end)
        self._move()

    def _advance(self, end: int) -> None:
        """Fly to the next tick; or a stretch of ticks, noting those whose Jacobians serve all."""
        master = self.simulation.master
        pending = [(g.next_tick, g) for g in master.agenda.groups if g.next_tick is not None]
        first = min(tick for tick, _ in pending)
        if first > end:
            self._run(end, listening=False)
            return
        due = [g for tick, g in pending if tick == first]
        self._note(first, 1)
        group = due[0]
        if len(due) > 1 or not group.spacing or not self._regular(group):
            return
        others = [tick for tick, g in pending if g is not group]
        last = min([end, *(tick - 1 for tick in others)])
        n_blocks = ((last - first) // group.spacing - 1) // EVERY
        for _ in range(max(n_blocks, 0)):
            start = master.tick
            self._run(start + (EVERY // 2 - 1) * group.spacing, listening=False)
            self._note(start + EVERY // 2 * group.spacing, EVERY)
            self._run(start + EVERY * group.spacing, listening=False)

    def _regular(self, group: Any) -> bool:
        """Whether the components that step with a group publish signals alone."""
        master = self.simulation.master
        number = master.agenda.groups.index(group)
        mine = [p for p, n in master.group_of.items() if n == number]
        return bool(mine) and all(
            p in self.linear and not self.linear[p].component._messages for p in mine
        )

    def _run(self, tick: int, *, listening: bool) -> None:
        """Fly on; stretches of ticks are handed to compiled code where nobody listens."""
        master = self.simulation.master
        for linear in self.linear.values():
            linear.component._call = linear.listening if listening else linear.listening.kernel
        master.programs = self._programs[listening]
        master.run_until(tick)

    def _note(self, tick: int, repeat: int) -> None:
        for linear in self.linear.values():
            linear.calls.clear()
        self._run(tick, listening=True)
        calls = [call for linear in self.linear.values() for call in linear.calls]
        calls.sort(key=lambda call: self._place_of[call.path])
        self._noted.append(_Noted(calls, repeat))
        if tick in self._epochs:
            self._move()
            self._evaluate(self.simulation.master.seconds(tick))
        elif len(self._noted) > AT_ONCE:
            self._move()

    def _start(self) -> None:
        """Deviations at t = 0."""
        for path in self.order:
            linear = self.linear.get(path)
            if linear is None or linear.start_jacobian is None:
                continue
            arrays = linear.component.arguments()
            arrays |= {n: np.zeros((1, size)) for n, size in linear.noise.items()}
            arrays |= {"step": np.zeros(1), "time": np.zeros(1)}
            given = [arrays[n].reshape(-1) for n in linear.start_arguments]
            J = _evaluated(linear.start_jacobian, [given])[0]
            F = np.eye(self.size)
            G: dict[str, FloatArray] = {}
            rows = self._rows(linear, dict.fromkeys(linear.component._messages, True))
            column = 0
            for row in rows.values():
                F[row] = 0.0
            for kind, name in linear.columns(start=True):
                n, place, factor = self._column(linear, kind, name)
                for key, row in rows.items():
                    block = J[self._row_of(linear, key), column : column + n]
                    if kind == "noise":
                        G.setdefault(name, np.zeros((self.size, n)))[row] = block
                    elif place is not None:
                        F[row, place] += block if factor is None else block * factor
                column += n
            self.C = F @ self.C @ F.T
            for name, g in G.items():
                self.C[self.sources.index(f"{path}.{name} at the start")] += g @ g.T
        self._hold(list(self.linear))

    def _hold(self, paths: list[str]) -> None:
        """Latch what is read at the start of the next step."""
        F = np.eye(self.size)
        changed = False
        for key, slot in self.held.items():
            if key[1] in paths and slot in self.place:
                F[self.place[key]] = 0.0
                _, factor = self.linear[key[1]].inputs[key[2]]
                block = np.eye(self.place[slot].stop - self.place[slot].start)
                F[self.place[key], self.place[slot]] = block if factor is None else block * factor
                changed = True
        if changed:
            self.C = F @ self.C @ F.T

    def _column(
        self, linear: _Linear, kind: str, name: str
    ) -> tuple[int, slice | None, FloatArray | None]:
        """Width of a column group, where it is in z, and its unit conversion."""
        size = int(np.prod(linear.component.model.shape(name)))
        if kind == "noise":
            return size, None, None
        if kind == "input":
            key, factor = linear.inputs[name]
            return size, self.place.get(key), factor
        return size, self.place[(kind, linear.path, name)], None

    def _rows(self, linear: _Linear, valid: Mapping[str, bool]) -> dict[Key, slice]:
        """What a step changes in z: states, and outputs that were published."""
        keys: list[Key] = [
            ("slot", linear.path, n) for n in linear.outputs if valid.get(n.partition(".")[0], True)
        ]
        keys += [("state", linear.path, n) for n in linear.states]
        return {key: self.place[key] for key in keys}

    def _row_of(self, linear: _Linear, key: Key) -> slice:
        start = 0
        model = linear.component.model
        for kind, names in (("slot", linear.outputs), ("state", list(linear.states))):
            for name in names:
                n = int(np.prod(model.shape(name)))
                if (kind, name) == (key[0], key[2]):
                    return slice(start, start + n)
                start += n
        raise KeyError(key)

    def _move(self) -> None:
        """Move the covariances over what was noted, what is alike together."""
        start, noted = 0, self._noted
        kinds = [
            ([(c.path, tuple(c.valid.items())) for c in each.calls], each.repeat) for each in noted
        ]
        while start < len(noted):
            n = 1
            while start + n < len(kinds) and kinds[start + n] == kinds[start]:
                n += 1
            calls = [each.calls for each in noted[start : start + n]]
            if calls[0]:
                self._step([list(each) for each in zip(*calls, strict=True)], noted[start].repeat)
            start += n
        self._noted = []

    def _step(self, calls: list[list[_Call]], repeat: int) -> None:
        """Move over n ticks at which the same components step, each of them `repeat` times.

        `calls[c][k]` is the call of component c at tick k.
        """
        n = len(calls[0])
        paths = [c[0].path for c in calls]
        n_noise = {}
        width = 0
        for path in paths:
            for name, size in self.linear[path].noise.items():
                n_noise[path, name] = slice(self.size + width, self.size + width + size)
                width += size
        # every quantity as rows over (z before, noise of the tick)
        rows = np.zeros((n, self.size, self.size + width))
        rows[:, np.arange(self.size), np.arange(self.size)] = 1.0
        for each in calls:
            linear = self.linear[each[0].path]
            if linear.step_jacobian is None:
                continue
            J = linear.evaluate(each)
            parts = []
            for kind, name in linear.columns(start=False):
                size, place, factor = self._column(linear, kind, name)
                if kind == "noise":
                    block = np.zeros((n, size, self.size + width))
                    at = n_noise[linear.path, name]
                    block[:, np.arange(size), np.arange(at.start, at.stop)] = 1.0
                elif place is None:
                    block = np.zeros((n, size, self.size + width))
                else:
                    block = rows[:, place] if factor is None else rows[:, place] * factor[:, None]
                parts.append(block)
            changed = J @ np.concatenate(parts, axis=1)
            for key, place in self._rows(linear, each[0].valid).items():
                rows[:, place] = changed[:, self._row_of(linear, key)]
        for key, slot in self.held.items():
            if key[1] in paths and slot in self.place:
                _, factor = self.linear[key[1]].inputs[key[2]]
                block = rows[:, self.place[slot]]
                rows[:, self.place[key]] = block if factor is None else block * factor[:, None]
        F, G = rows[:, :, : self.size], rows[:, :, self.size :]
        self._propagate(F, G, n_noise, repeat)

    def _propagate(
        self,
        F: FloatArray,
        G: FloatArray,
        n_noise: Mapping[tuple[str, str], slice],
        repeat: int,
    ) -> None:
        """Apply n transitions, each `repeat` times (a power of two).

        Up to the last of all, only what the next one reads is moved; where transitions are
        repeated, one that is not comes after them.
        """
        eye = np.eye(self.size)
        moved = np.flatnonzero(np.any(eye != F, axis=(0, 2)) | np.any(G != 0.0, axis=(0, 2)))
        used = np.flatnonzero(np.any(F[:, moved] != 0.0, axis=(0, 1)))
        noise = {}
        for (path, name), at in n_noise.items():
            g = G[:, :, at.start - self.size : at.stop - self.size]
            if np.any(g):
                noise[f"{path}.{name}"] = g
        f = np.ascontiguousarray(F[:, used][:, :, used])
        phi = np.eye(len(used))
        added = np.zeros((len(noise), len(used), len(used)))
        q = [g[:, used] @ g[:, used].transpose(0, 2, 1) for g in noise.values()]
        done = 1
        while done < repeat:
            q = [f @ each @ f.transpose(0, 2, 1) + each for each in q]
            f = f @ f
            done *= 2
        for k in range(len(f) - (repeat == 1)):
            phi = f[k] @ phi
            if q:
                added = f[k] @ added @ f[k].T
                for i, each in enumerate(q):
                    added[i] += each[k]
        whole = eye.copy()
        whole[np.ix_(used, used)] = phi
        self.C = whole @ self.C @ whole.T
        for i, name in enumerate(noise):
            self.C[self.sources.index(name)][np.ix_(used, used)] += added[i]
        if repeat > 1:
            return
        self.C = F[-1] @ self.C @ F[-1].T
        for name, g in noise.items():
            self.C[self.sources.index(name)] += g[-1] @ g[-1].T

    # ------------------------------------------------------------------ the error

    def _evaluate(self, t: float) -> None:
        model = self.error_model
        evaluation = self.evaluation
        values = []
        E = np.zeros((int(model.outputs["error"].numel()), self.size))
        for name in model.inputs:
            head, _, tail = name.partition(".")
            view = evaluation._views[head]
            values.append(np.asarray(getattr(view, tail) if tail else view)[0])
        J = np.asarray(self._error_jacobian(*values))
        column = 0
        for name in model.inputs:
            size = int(np.prod(model.shape(name)))
            found = self.source(self.evaluation_path, name)
            assert found is not None
            key, factor = self.slot_of(self.evaluation_path, name), found[1]
            if key in self.place:
                block = J[:, column : column + size]
                E[:, self.place[key]] += block if factor is None else block * factor
            column += size
        covariance = E @ self.C @ E.T
        given = {name: covariance[i] for i, name in enumerate(self.sources)}
        self.errors.append((t, given))

    def result(self) -> LinearCovariance:
        """Gather what was predicted."""
        times, history = self.simulation.history(self.evaluation_path)
        sigma = np.concatenate(
            [history[f"{q.name}_sigma"][:, 0] for q in self.evaluation.quantities], axis=1
        )
        if "covariance" in history:
            filtered = history["covariance"][:, 0]
        else:
            filtered = sigma[:, :, None] ** 2 * np.eye(sigma.shape[1])
        sources = {name: np.stack([each[name] for _, each in self.errors]) for name in self.sources}
        quantities = self.evaluation.quantities
        return LinearCovariance(
            self.evaluation_path,
            [f"{q.name} {axis}" for q in quantities for axis in q.axes],
            [q.unit for q in quantities for _ in q.axes],
            times,
            filtered,
            {name: c for name, c in sources.items() if np.any(c)},
        )


def _error_jacobian(model: Any) -> Any:
    """Derivative of the error by all inputs of its model, one after the other."""
    import casadi as ca

    symbols = list(model.inputs.values())
    by = ca.vertcat(*(ca.vec(s) for s in symbols))
    jacobian = ca.jacobian(ca.SX(model.outputs["error"]), by)
    return ca.Function("by", symbols, [ca.densify(jacobian)])


def _dispersed_covariance(d: Dispersion, components: Any, nominal: FloatArray) -> FloatArray:
    """Covariance of a dispersion's draw, for a parameter of the given nominal value."""
    spread = d.read_spread(components)
    shape = np.shape(nominal)
    value: FloatArray = np.asarray(nominal, dtype=np.float64).reshape(-1)
    if d.kind == "multivariate":
        return spread
    if d.kind == "list":
        flat = spread.reshape(len(spread), -1)
        found: FloatArray = np.atleast_2d(np.cov(flat.T, bias=True))
        return found
    width = np.broadcast_to(spread, shape).reshape(-1)
    if d.kind == "normal":
        return np.diag(width**2)
    if d.kind == "uniform":
        return np.diag(width**2 / 3)
    if d.kind == "truncated":
        from scipy.stats import truncnorm

        return np.diag(width**2 * truncnorm.var(-d.limit, d.limit))
    return np.diag((value * np.log(width)) ** 2 / 3)  # to first order


def _directions(system: System, length: Any, result: LinearCovariance) -> list[Direction]:
    """Compare the filter's covariance with that of a filter which gets no fix."""
    deaf = Simulation(system, members=1, duration=length, recording=False, quiet=True)
    try:
        path = result.path
        flat = deaf.plan.flat
        corrector = next(
            (
                c.source.rpartition(".")[0]
                for c in flat.connections
                if c.target.rpartition(".")[0] == path and flat.port(c.source).kind == "message"
            ),
            None,
        )
        if corrector is None or "covariance" not in flat.components[path].outputs():
            return []
        for name, port in flat.components[corrector].inputs().items():
            if port.kind == "message":
                reader = flat.components[corrector]._views[name]
                waiting = deaf.master.entries[corrector]
                waiting.before = tuple(
                    t for t in waiting.before if getattr(t, "__self__", None) is not reader
                )
        deaf.initialize()
        deaf.run_until(length)
        without = deaf.history(path)[1]["covariance"][-1, 0]
    finally:
        deaf.master.terminate()
    from scipy.linalg import eigh

    sigma = np.sqrt(np.diagonal(without))
    scale = np.outer(sigma, sigma)
    values, vectors = eigh(result.filter[-1] / scale, without / scale)
    found = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        direction = (without / scale) @ vector
        found.append(Direction(float(value), direction / np.linalg.norm(direction)))
    return found
