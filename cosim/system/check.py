"""Everything that can be wrong with a system, found before anything runs and reported together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np

from terrafix.cosim.basics.clock import Rate, base_step, text_seconds
from terrafix.cosim.basics.errors import (
    ConfigurationError,
    EpochError,
    RateError,
    SystemCheckError,
    TerrafixError,
    WiringError,
)
from terrafix.cosim.basics.units import check_unit, conversion_factor
from terrafix.cosim.declare.component import Component, FedBy
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.show.tables import Block, Shown
from terrafix.cosim.system.dispersion import overridden
from terrafix.cosim.system.flat import Connection, FlatSystem, Flattened, Record
from terrafix.cosim.system.order import stepping_order
from terrafix.cosim.system.start import Start, starting_order


@dataclass(frozen=True, repr=False)
class Plan(Shown):
    """A checked system: what the master runs.

    Attributes
    ----------
    flat : FlatSystem
    order : list of str
        Component paths in stepping order.
    base : Fraction
        Base step [s].
    grid : Fraction
        What listed times are snapped to [s]: the base step of the components alone, so that a
        recorder moves nobody.
    notes : list of str
        What is allowed but worth knowing.
    start : Start
        How components are initialized.
    epoch : str or None
        What time it is at t = 0.
    """

    flat: FlatSystem
    order: list[str]
    base: Fraction
    grid: Fraction
    notes: list[str]
    start: Start
    epoch: str | None = None

    def content(self) -> dict[str, Any]:
        """Plain types for JSON, components in stepping order."""
        from terrafix.cosim.system.display import plan_content

        return plan_content(self.flat, self.order, self.base, self.notes, self.epoch)

    def _shown(self) -> list[Block]:
        from terrafix.cosim.system.display import plan_shown

        return plan_shown(self.content())


def check(system: Flattened, *, duration: Fraction | None = None, outside: bool = False) -> Plan:
    """Check a system whole.

    Parameters
    ----------
    system : System
    duration : Fraction, optional
        Of the run that is meant [s]: recordings that end before it are found too.
    outside : bool
        Whether somebody else drives the inputs that the system exposes (for export).

    Raises
    ------
    SystemCheckError
        With every problem found.
    """
    problems: list[TerrafixError] = []

    def attempt(action: Callable[[], object]) -> None:
        try:
            action()
        except SystemCheckError as error:
            problems.extend(error.problems)
        except TerrafixError as error:
            problems.append(error)

    try:
        flat = system.flatten()
    except TerrafixError as error:
        raise SystemCheckError(system.name, [error]) from error
    if not flat.components:
        problems.append(
            ConfigurationError(
                "the system has no components\n"
                "  add one: [component.NAME] with a type in its file, or add(...) in Python"
            )
        )
    for path, component in flat.components.items():
        problems.extend(_component_problems(path, component, duration, system.epoch))
    problems.extend(_idle_epoch(flat, system.epoch))
    exposed = {system.resolve(p)[0] for p in system.exposed.values()} if outside else set()
    problems.extend(_unconnected(flat, exposed))
    problems.extend(_two_drivers(flat))
    base, grid = _steps(flat)
    problems.extend(_too_fast(flat, grid))
    problems.extend(_same_records(flat))
    for record in flat.records:
        attempt(lambda r=record: record_rate(flat, r))  # type: ignore[misc]
    for dispersion in flat.dispersions:
        attempt(lambda d=dispersion: d.read_spread(flat.components))  # type: ignore[misc]
    problems.extend(overridden(flat.dispersions))
    order: list[str] = []

    def find_order() -> None:
        order.extend(stepping_order(flat))

    attempt(find_order)
    foreseen: list[str] = []
    if not problems and not any(map(_refused, flat.components.values())):
        fed_by = _feeding_components(flat)
        for path, component in flat.components.items():
            attempt(lambda p=path, c=component: foreseen.extend(_foreseen(p, c, fed_by)))  # type: ignore[misc]
    if problems:
        raise SystemCheckError(system.name, _once(problems))
    start = starting_order(flat, order)
    notes = [*system.notes, *_notes(flat), *_starting_notes(start), *foreseen]
    return Plan(flat, order, base, grid, notes, start, system.epoch)


def _component_problems(
    path: str, component: Component, duration: Fraction | None, epoch: str | None
) -> Iterator[TerrafixError]:
    missing = component.missing_settings()
    for name in missing:
        kind = component.settings()[name].kind()
        yield ConfigurationError(f"'{path}' needs a value for '{name}': it takes {kind}")
    if component.rate is None:
        yield RateError(f'\'{path}\' has no rate\n  give it a period ("0.01 s") or hz ("100 Hz")')
    elif component.rate.last > 0 and not component.has_step():
        yield ConfigurationError(
            f"'{path}' cannot step: {type(component).__name__} must provide _step_impl(t, dt)"
        )
    actions: list[Callable[[], None]] = []
    if not missing and not _refused(component):
        actions.append(component.validate)
        actions.append(lambda: component.validate_epoch(epoch))
        if duration is not None:
            actions.append(lambda: component.validate_duration(float(duration)))
    for port in component.ports.values():
        actions += [lambda f=field: _check_units(f) for field in port.fields.values()]  # type: ignore[misc]
    for action in actions:
        try:
            action()
        except TerrafixError as error:
            yield error


def _refused(component: Component) -> bool:
    """Whether a value was refused, which is reported; None may be one: of a file not named."""
    given, kept = component.given_parameters, component.parameter_values
    return any(given[n] is None and (n not in kept or kept[n] is not None) for n in given)


def _feeding_components(flat: FlatSystem) -> FedBy:
    """Which component drives an input of another."""
    paths = {id(component): path for path, component in flat.components.items()}
    sources = {c.target: flat.components[flat.owner(c.source)] for c in flat.connections}
    return lambda component, port: sources.get(f"{paths[id(component)]}.{port}")


def _foreseen(path: str, component: Component, fed_by: FedBy) -> Iterator[str]:
    for note in component.foreseen(fed_by):
        yield f"'{path}': {note}"


def _once(problems: list[TerrafixError]) -> list[TerrafixError]:
    """Of what is said twice, and of the epoch, the first."""
    kept: dict[str, TerrafixError] = {}
    for problem in problems:
        kept.setdefault("epoch" if isinstance(problem, EpochError) else str(problem), problem)
    return list(kept.values())


def _idle_epoch(flat: FlatSystem, epoch: str | None) -> Iterator[TerrafixError]:
    if epoch is None or not flat.components:
        return
    if not any(component.asks_for_epoch() for component in flat.components.values()):
        yield ConfigurationError(
            f"the epoch '{epoch}' does nothing: no component asks what time it is\n"
            "  leave it out, or add a component that does"
        )


def _check_units(field: Field) -> None:
    for unit in (field.unit,) if isinstance(field.unit, str) else field.unit:
        check_unit(unit)


def _unconnected(flat: FlatSystem, exposed: set[str]) -> Iterator[TerrafixError]:
    driven = {c.target for c in flat.connections} | exposed
    for path, component in flat.components.items():
        for name, port in component.inputs().items():
            if f"{path}.{name}" in driven or port.optional:
                continue
            fits = [f"'{p}'" for p in _fitting(flat, port, path)]
            hint = (
                f"outputs of the same shape, unit and frame: {', '.join(fits)}"
                if fits
                else "no output of the system has its shape, unit and frame"
                + (f": it takes {port.doc}" if port.is_bundle and port.doc else "")
            )
            yield WiringError(
                f"input '{path}.{name}' is not connected and has no default\n  {hint}"
            )


def _fitting(flat: FlatSystem, port: Port[object], own: str) -> Iterator[str]:
    for path, component in flat.components.items():
        if path == own:
            continue
        for name, output in component.outputs().items():
            if (
                output.kind == port.kind
                and set(output.fields) == set(port.fields)
                and all(
                    output.fields[f].shape == port.fields[f].shape
                    and output.fields[f].frame == port.fields[f].frame
                    and output.fields[f].unit == port.fields[f].unit
                    for f in port.fields
                )
            ):
                yield f"{path}.{name}"


def _two_drivers(flat: FlatSystem) -> Iterator[TerrafixError]:
    drivers: dict[str, str] = {}
    for connection in flat.connections:
        if connection.target in drivers:
            yield WiringError(
                f"input '{connection.target}' has two drivers\n"
                f"  '{drivers[connection.target]}' and '{connection.source}': remove one of them"
            )
        drivers[connection.target] = connection.source


def _steps(flat: FlatSystem) -> tuple[Fraction, Fraction]:
    """Base step of everything, and of the components alone (to which listed times are snapped)."""
    own = [c.rate for c in flat.components.values() if c.rate is not None]
    observing = [r.rate for r in flat.records if r.rate is not None]
    numbers = [n for rate in own for n in rate.exact_numbers]
    numbers += [c.delay for c in flat.connections]
    grid = base_step(numbers, [t for rate in own for t in rate.times or ()])
    return base_step([grid, *(n for rate in observing for n in rate.exact_numbers)]), grid


def _too_fast(flat: FlatSystem, grid: Fraction) -> Iterator[TerrafixError]:
    timed = [(f"'{path}'", component.rate) for path, component in flat.components.items()]
    timed += [(f"record '{record.name}'", record.rate) for record in flat.records]
    for what, rate in timed:
        if rate is None or rate.times is None:
            continue
        for early, late in pairwise(rate.times):
            if late - early < grid:
                yield RateError(
                    f"{what} has the times {text_seconds(early)} s and {text_seconds(late)} s, "
                    f"closer than the base step of {text_seconds(grid)} s\n"
                    "  leave one out, or give another component a finer period"
                )
                break


def _same_records(flat: FlatSystem) -> Iterator[TerrafixError]:
    names = [record.name for record in flat.records]
    for name in sorted({n for n in names if names.count(n) > 1}):
        yield ConfigurationError(
            f"two records are called '{name}', one of them in a nested system\n  rename one"
        )


def check_duration(duration: Fraction, base: Fraction) -> None:
    """Raise RateError if a duration [s] is no whole number of base steps: it would be cut."""
    whole = duration // base
    if whole * base == duration:
        return
    if whole:
        near = [text_seconds(n * base) for n in (whole, whole + 1)]
        what, give = "which is no whole number of base steps", f"{near[0]} s or {near[1]} s"
    else:
        what, give = "shorter than the base step", "a longer one"
    raise RateError(
        f"duration is {text_seconds(duration)} s, {what} of {text_seconds(base)} s\n  give {give}"
    )


def record_rate(flat: FlatSystem, record: Record) -> Rate:
    """Rate of a recorder: its own, or that of the one component it watches.

    Raises
    ------
    WiringError
        If a port does not exist.
    RateError
        If it has no rate of its own and its components do not share one.
    """
    owners = []
    for path in record.ports:
        try:
            port = flat.port(path)
        except WiringError as error:
            raise WiringError(f"record '{record.name}' names '{path}'\n  {error}") from error
        if port.is_input:
            raise WiringError(
                f"record '{record.name}' names the input '{path}'\n  {_feeding(flat, path)}"
            )
        strange = [f.dtype for f in port.fields.values() if np.dtype(f.dtype).kind not in "fiub"]
        if strange:
            raise WiringError(
                f"record '{record.name}' names '{path}' of {np.dtype(strange[0])}; "
                "records hold real numbers: publish real and imaginary parts"
            )
        if port.kind == "shared":
            raise WiringError(
                f"record '{record.name}' names the shared port '{path}'\n"
                "  records hold signals and messages, one value for each member"
            )
        owners.append(flat.owner(path))
    if record.rate is not None:
        return record.rate
    rates = {flat.components[o].rate for o in owners}
    if len(rates) > 1:
        raise RateError(
            f"record '{record.name}' watches components of different rates "
            f"({', '.join(sorted(map(str, rates)))})\n  give it a period of its own"
        )
    (rate,) = rates
    if rate is None:
        raise RateError(f"record '{record.name}' watches a component without a rate")
    return rate


def _feeding(flat: FlatSystem, path: str) -> str:
    source = next((c.source for c in flat.connections if c.target == path), None)
    return f"record the output that feeds it: '{source}'" if source else "only outputs are recorded"


def _starting_notes(start: Start) -> Iterator[str]:
    for loop in start.loops:
        yield (
            f"at t = 0, {_listed(loop)} depend on each other: they are repeated from start values "
            "until they stand still"
        )
    if start.dropped:
        yield (
            f"at t = 0, {_listed(start.dropped)} would close a loop through what is initialized "
            "once: the start value of its input stays"
        )


def _listed(links: list[Connection]) -> str:
    return ", ".join(f"'{link}'" for link in links)


def _notes(flat: FlatSystem) -> Iterator[str]:
    for record in flat.records:
        rate = record.rate
        if rate is None or rate.period is None:
            continue
        for path in record.ports:
            source = flat.components[flat.owner(path)].rate
            if flat.port(path).kind != "signal" or source is None or source.period is None:
                continue
            if (rate.period % source.period) or ((rate.offset - source.offset) % source.period):
                yield (
                    f"record '{record.name}' ({rate}) samples '{path}', which is published "
                    f"{source}: between its steps the last value is held"
                )
    for path, component in flat.components.items():
        for name in component.settings():
            if not component.is_default(name) and (reason := component.idle(name)):
                yield reason
        for note in component.capabilities.notes:
            yield f"'{path}': {note}"
    for connection in flat.connections:
        target = flat.port(connection.target)
        if target.at == "start":
            yield (
                f"'{connection.target}' is read at the start of the step: it sees "
                f"'{connection.source}' of one step earlier"
            )
        source_port = flat.port(connection.source)
        for name, field in source_port.fields.items():
            unit, other = field.unit, target.fields[name].unit
            if isinstance(unit, str) and isinstance(other, str) and unit != other:
                factor = conversion_factor(unit, other)
                if factor != 1.0:
                    yield f"'{connection}' is converted from {unit} to {other} (x {factor:g})"
