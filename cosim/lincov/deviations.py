r"""Linear covariance analysis: a campaign predicted from one nominal run and symbolic Jacobians.

The system is flown once without noise. About that run, deviations of everything that components
keep or publish (truth and filter alike, stacked into :math:`z`) are linear in what is drawn, once
at the start (:math:`d`) or at every step (:math:`w`):

.. math::
    z_{k+1} = F_k z_k + \sum_s G_{s,k} w_{s,k}, \qquad z_0 = S_0 d

.. math::
    S_{k+1} = F_k S_k, \qquad C_{s,k+1} = F_k C_{s,k} F_k^T + G_{s,k} G_{s,k}^T,

with one covariance per source :math:`s`: of a stream of noise, :math:`C_s`; of a draw at the start
or a dispersion, that of its part of :math:`d` seen through :math:`S`. :math:`F` and :math:`G` are
put together tick by tick from the Jacobians of the components' steps, in the order in which they
step, through the connections. The error of the estimate is one more linear function of :math:`z`,
so its covariance is that of a campaign's sample whether or not the filter's model is the truth's;
what the filter itself predicts is its covariance in the nominal run.

What can only be stepped has no Jacobian, and is taken where no noise reaches it: `shadows`.

Matrices (an estimate's covariance, a fix's) are not deviated: gains are those of the nominal run.
A deviation of a gain acts on the nominal innovation, which is zero where the filter's model of
the mean is the truth's.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Exact, seconds
from terrafix.cosim.basics.errors import ConfigurationError, StepError
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.lincov.jacobians import Call, Key, Linear, Listener, Notes, error_jacobian
from terrafix.cosim.lincov.layout import Layout, Wires
from terrafix.cosim.lincov.observability import directions
from terrafix.cosim.lincov.prediction import LinearCovariance
from terrafix.cosim.lincov.transitions import Chain, chained, reached, repeated
from terrafix.cosim.system.system import System

AT_ONCE = 512
"""Ticks after which what was noted of the nominal run is worked off."""
EVERY = 17
"""Ticks that share a Jacobian, that of the middle one, where only one group of components steps
and nothing is published but signals: odd, so that what changes evenly cancels. Just above a power
of two, where powers of a matrix are cheapest."""


def linear_covariance(system: System, *, duration: Exact | None = None) -> LinearCovariance:
    """Predict a campaign of a system.

    Parameters
    ----------
    system : System
        Of symbolic components, others that no noise reaches (an orbit from an FMU, say), and one
        evaluation that offers an `error_model`.
    duration : exact time, optional
        [s]; the system's own if absent.

    Raises
    ------
    ConfigurationError
        If a component cannot be linearized; it is named.
    StepError
        If the nominal run fails, or a member flown beside it.
    """
    length = system.duration if duration is None else seconds(duration, "duration")
    if length is None:
        raise ConfigurationError(f"system '{system.name}' has no duration; give one")
    made = partial(Simulation, system, duration=length, recording=False, quiet=True)
    simulation = made(members=1)
    try:
        wires = Wires(simulation.plan, system.name)
        if wires.shadows.n_members > 1:
            simulation.master.terminate()
            simulation = made(members=wires.shadows.n_members)
            wires = Wires(simulation.plan, system.name)
        analysis = _Analysis(simulation, wires)
        analysis.fly(simulation.master.ticks(length))
        result = analysis.result()
    finally:
        simulation.master.terminate()
    result.directions = directions(system, length, result.path, result.filter[-1])
    return result


class _Noted(NamedTuple):
    """The calls of one tick, and of how many ticks they are an example."""

    calls: list[Call]
    repeat: int


class _Steps(NamedTuple):
    """What n ticks change of z, `rows`, by what they read of it, `columns`, and by noise."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    f: FloatArray
    g: dict[str, FloatArray]


class _Analysis:
    """Deviations of one system, and how they move."""

    def __init__(self, simulation: Simulation, wires: Wires) -> None:
        self._simulation = simulation
        self._wires = wires
        self._error_jacobian = error_jacobian(wires.error_model)
        self._layout = Layout(simulation.plan, wires)
        wires.shadows.spread(self._layout.sigma())
        self._notes = Notes()
        self._noted: list[_Noted] = []
        self._errors: list[dict[str, FloatArray]] = []
        for linear in self._layout.linear.values():
            if isinstance(linear, Linear):
                linear.component.call = Listener(linear, self._notes)

    # ------------------------------------------------------------------ the nominal run

    def fly(self, end: int) -> None:
        """Fly the nominal run and move the deviations along with it."""
        plan, master = self._simulation.plan, self._simulation.master
        rate = self._wires.evaluation.rate
        assert rate is not None
        self._epochs = {0} if rate.starts_at_zero else set()
        for tick in rate.ticks(plan.base, plan.grid):
            if tick > end:
                break
            self._epochs.add(tick)
        self._simulation.initialize()
        self._start()
        if 0 in self._epochs:
            self._evaluate()
        while master.tick < end:
            self._advance(end)
        self._move()

    def _advance(self, end: int) -> None:
        """Fly to the next tick; or a stretch of ticks, noting those whose Jacobians serve all."""
        master = self._simulation.master
        groups = master.agenda.groups
        pending = [(g.next_tick, i) for i, g in enumerate(groups) if g.next_tick is not None]
        first = min((tick for tick, _ in pending), default=end + 1)
        if first > end:
            master.run_until(end)
            return
        due = [number for tick, number in pending if tick == first]
        self._note(first, 1)
        spacing = groups[due[0]].spacing
        if len(due) > 1 or not spacing or not self._regular(due[0]):
            return
        last = min([end, *(tick - 1 for tick, number in pending if number != due[0])])
        n_blocks = ((last - first) // spacing - 1) // EVERY
        for k in range(n_blocks):
            before = first + (k * EVERY + EVERY // 2) * spacing
            master.run_until(before)
            self._note(before + spacing, EVERY)
        if n_blocks > 0:
            master.run_until(first + n_blocks * EVERY * spacing)

    def _regular(self, number: int) -> bool:
        """Whether the components that step with a group publish signals alone."""
        components, group_of = (
            self._simulation.plan.flat.components,
            self._simulation.master.group_of,
        )
        mine = [components[path] for path, group in group_of.items() if group == number]
        ports = [port for component in mine for port in component.outputs().values()]
        return (
            bool(mine)
            and self._wires.evaluation not in mine
            and all(port.kind != "message" for port in ports)
        )

    def _note(self, tick: int, repeat: int) -> None:
        """Fly to a tick, noting the Jacobians of all steps, which are made there alone."""
        master = self._simulation.master
        due = [number for number, g in enumerate(master.agenda.groups) if g.next_tick == tick]
        self._notes.listening, self._notes.calls = True, []
        master.run_until(tick)
        self._notes.listening = False
        self._refuse_lost()
        stepped = [
            Call(path, each.jacobian(), ())  # before what reads it; it reads parameters alone
            for path, each in self._layout.stepped.items()
            if each.written and master.group_of[path] in due
        ]
        self._noted.append(_Noted([*stepped, *self._notes.calls], repeat))
        if tick in self._epochs:
            self._move()
            self._evaluate()
        elif len(self._noted) > AT_ONCE:
            self._move()

    def _refuse_lost(self) -> None:
        """Refuse to go on without one of the members that are compared."""
        master = self._simulation.master
        for lost in (*master.excluded, *master.ended):
            raise StepError(
                f"'{lost['component']}' at t = {lost['t_s']:.9g} s, in a member with a parameter "
                f"beside its nominal value: {lost['reason']}\n  fly a campaign instead"
            )

    # ------------------------------------------------------------------ moving

    def _start(self) -> None:
        """Deviations at t = 0."""
        layout = self._layout
        self._S = layout.start()
        self._C: dict[str, FloatArray] = {}
        for path in self._simulation.plan.order:
            linear = layout.linear.get(path)
            jacobian = None if linear is None else linear.at_start()
            if linear is None or jacobian is None:
                continue
            changed = np.zeros((len(jacobian), layout.n_draws))
            for key, columns, factor in linear.reads[True]:
                block = jacobian[:, columns] if factor is None else jacobian[:, columns] * factor
                if key[0] == "noise":
                    changed[:, layout.draws[f"{path}.{key[2]} at the start"][0]] += block
                elif key in layout.place:
                    changed += block @ self._S[layout.place[key]]
            for key, rows, _ in linear.written:
                self._S[layout.place[key]] = changed[rows]
        for key, (slot, factor) in layout.held.items():
            latched = self._S[layout.place[slot]]
            self._S[layout.place[key]] = latched if factor is None else latched * factor[:, None]

    def _move(self) -> None:
        """Move over what was noted, what is alike together."""
        start, noted = 0, self._noted
        kinds = [([(c.path, c.published) for c in each.calls], each.repeat) for each in noted]
        while start < len(noted):
            n = 1
            while start + n < len(kinds) and kinds[start + n] == kinds[start]:
                n += 1
            calls = [each.calls for each in noted[start : start + n]]
            if calls[0]:
                steps = self._steps([list(each) for each in zip(*calls, strict=True)])
                self._apply(steps, noted[start].repeat)
            start += n
        self._noted = []

    def _columns(self, calls: Sequence[Call]) -> dict[Key, slice]:
        """What a tick reads before it changes that, and its noise: columns of its transition."""
        layout = self._layout
        found: dict[Key, slice] = {}
        written: set[Key] = set()
        width = 0
        for call in calls:
            linear = layout.linear[call.path]
            for key, columns, _ in linear.reads[False]:
                outside = key in layout.place and key not in written
                if key not in found and (outside or key[0] == "noise"):
                    found[key] = slice(width, width + columns.stop - columns.start)
                    width = found[key].stop
            written |= {w.key for w in linear.now_written(call.published)}
        return found

    def _steps(self, calls: list[list[Call]]) -> _Steps:
        """Put n ticks together at which the same components step.

        `calls[c][k]` is the call of component c at tick k.
        """
        layout = self._layout
        first = [each[0] for each in calls]
        columns_of = self._columns(first)
        n, width = len(calls[0]), max((c.stop for c in columns_of.values()), default=0)
        now: dict[Key, FloatArray] = {}  # of what was changed, by what the ticks read
        for each in calls:
            linear = layout.linear[each[0].path]
            jacobian = np.array([call.jacobian for call in each])
            changed = np.zeros((n, jacobian.shape[1], width))
            for key, columns, factor in linear.reads[False]:
                block = jacobian[:, :, columns]
                block = block if factor is None else block * factor
                if key in now:
                    changed += block @ now[key]
                elif key in columns_of:
                    changed[:, :, columns_of[key]] += block
            for key, rows, _ in linear.now_written(each[0].published):
                now[key] = changed[:, rows]
        stepping = {call.path for call in first}
        for key, (slot, factor) in layout.held.items():
            if key[1] in stepping and slot in now:
                now[key] = now[slot] if factor is None else now[slot] * factor[:, None]
        return self._selected(now, columns_of)

    def _selected(self, now: dict[Key, FloatArray], columns_of: dict[Key, slice]) -> _Steps:
        """Only what matters: columns that are not zero, of noise by source."""
        place = self._layout.place
        every = [np.arange(self._layout.size)[place[key]] for key in now]
        f = np.concatenate([now[key] for key in now], axis=1)
        g, inside, columns = {}, [], []
        for key, at in columns_of.items():
            if key[0] != "noise":
                inside.append(np.arange(at.start, at.stop))
                columns.append(np.arange(self._layout.size)[place[key]])
            elif f[:, :, at].any():
                g[f"{key[1]}.{key[2]}"] = f[:, :, at]
        chosen = np.concatenate([*inside, np.zeros(0, dtype=np.intp)])
        matter = f[:, :, chosen].any(axis=(0, 1))
        whole = np.concatenate([*columns, np.zeros(0, dtype=np.intp)])
        return _Steps(np.concatenate(every), whole[matter], f[:, :, chosen[matter]], g)

    def _apply(self, steps: _Steps, repeat: int) -> None:
        """Make n steps, each of them `repeat` times; all but the last among what is read alone."""
        rows, columns, f, g = steps
        inner, driven = _among_read(steps)
        reach = reached(inner, driven)
        q = np.zeros((len(f), len(g), len(reach), len(reach)))
        for i, part in enumerate(driven):
            q[:, i] = part[:, reach] @ part[:, reach].swapaxes(1, 2)
        before = repeated(inner[:-1], q[:-1], reach, repeat)
        last = repeated(inner[-1:], q[-1:], reach, repeat - 1)
        chain = chained(
            Chain(*(np.concatenate(pair) for pair in zip(before, last, strict=True))), reach
        )
        product = f[-1] @ chain.product
        self._S[rows] = product @ self._S[columns]
        for C in self._C.values():
            C[rows] = product @ C[columns]
            C[:, rows] = C[:, columns] @ product.T
        through = f[-1][:, reach]
        for (source, each), added in zip(g.items(), chain.added, strict=True):
            C = self._C.setdefault(source, np.zeros((self._layout.size,) * 2))
            C[np.ix_(rows, rows)] += through @ added @ through.T + each[-1] @ each[-1].T

    # ------------------------------------------------------------------ the error

    def _evaluate(self) -> None:
        """Covariance of the error, by source, where the nominal run stands."""
        wires, layout = self._wires, self._layout
        model = wires.error_model
        values = []
        for name in model.inputs:
            head, _, tail = name.partition(".")
            view = getattr(wires.evaluation, head)
            values.append(np.asarray(getattr(view, tail) if tail else view)[0])
        jacobian = np.asarray(self._error_jacobian(*values))
        E = np.zeros((len(jacobian), layout.size))
        column = 0
        for name in model.inputs:
            size = int(np.prod(model.shape(name)))
            found = wires.source(wires.evaluation_path, name)
            if (
                found is not None
                and (key := wires.slot_of(wires.evaluation_path, name)) in layout.place
            ):
                block, factor = jacobian[:, column : column + size], found[1]
                E[:, layout.place[key]] += block if factor is None else block * factor
            column += size
        S = E @ self._S
        self._errors.append(
            {name: S[:, at] @ cov @ S[:, at].T for name, (at, cov) in layout.draws.items()}
            | {name: E @ C @ E.T for name, C in self._C.items()}
        )

    def result(self) -> LinearCovariance:
        """Gather what was predicted."""
        wires = self._wires
        times, history = self._simulation.history(wires.evaluation_path)
        quantities = wires.evaluation.quantities
        sigma = np.concatenate([history[f"{q.name}_sigma"][:, 0] for q in quantities], axis=1)
        if "covariance" in history:
            filtered = history["covariance"][:, 0]
        else:
            filtered = sigma[:, :, None] ** 2 * np.eye(sigma.shape[1])
        none = np.zeros(filtered.shape[1:])
        sources = {
            name: np.stack([each.get(name, none) for each in self._errors])
            for name in self._layout.sources
        }
        return LinearCovariance(
            wires.evaluation_path,
            [f"{q.name} {axis}" for q in quantities for axis in q.axes],
            [q.unit for q in quantities for _ in q.axes],
            times,
            filtered,
            {name: c for name, c in sources.items() if np.any(c)},
        )


def _among_read(steps: _Steps) -> tuple[FloatArray, list[FloatArray]]:
    """Transitions of what is read, and what each source of noise does to that."""
    row_of = {place: i for i, place in enumerate(steps.rows)}
    changed = np.array([place in row_of for place in steps.columns], dtype=np.bool_)
    mine = [row_of[place] for place in steps.columns[changed]]
    inner = np.tile(np.eye(len(changed)), (len(steps.f), 1, 1))
    inner[:, changed] = steps.f[:, mine]
    driven = []
    for each in steps.g.values():
        part = np.zeros((len(each), len(changed), each.shape[2]))
        part[:, changed] = each[:, mine]
        driven.append(part)
    return inner, driven
