"""What deviates in a system: who reads what, where it stands in z, and what drives it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.evaluation import Evaluation
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.lincov.jacobians import Key, Linear
from terrafix.cosim.lincov.shadows import Shadows, Stepped
from terrafix.cosim.system.check import Plan
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.wiring import port_factor


class Wires:
    """Where the inputs of a system come from.

    Attributes
    ----------
    symbolic : dict of str to SymbolicComponent
    stepped : list of str
        Others that deviate, with dispersed parameters alone.
    dispersed : dict of Key to list of Dispersion
    shadows : Shadows
        Members that show how they do.

    Raises
    ------
    ConfigurationError
        If the system has not one evaluation, or a component that cannot be linearized.
    """

    def __init__(self, plan: Plan, system: str) -> None:
        self._components = plan.flat.components
        self._connections = {c.target: c for c in plan.flat.connections}
        evaluations = {p: c for p, c in self._components.items() if isinstance(c, Evaluation)}
        if len(evaluations) != 1:
            raise ConfigurationError(
                f"linear covariance analysis needs one evaluation component, and system "
                f"'{system}' has {len(evaluations)}"
            )
        ((self.evaluation_path, self.evaluation),) = evaluations.items()
        try:
            self.error_model = self.evaluation.error_model()
        except NotImplementedError:
            raise ConfigurationError(
                f"'{self.evaluation_path}' ({type(self.evaluation).__name__}) offers no "
                "error_model, which linear covariance analysis needs"
            ) from None
        self.symbolic: dict[str, SymbolicComponent] = {}
        for path, component in self._components.items():
            if isinstance(component, SymbolicComponent) and component.capabilities.symbolic:
                self.symbolic[path] = component
            elif component is not self.evaluation and not component.capabilities.given:
                raise _refused(path, component, "may draw noise of its own")
        self.dispersed: dict[Key, list[Dispersion]] = {}
        for d in plan.flat.dispersions:
            for target in d.targets:
                self.dispersed.setdefault(("parameter", *_split(target)), []).append(d)
        self._sources: dict[str, list[str]] = {path: [] for path in self._components}
        for target, c in self._connections.items():
            self._sources[_split(target)[0]].append(_split(c.source)[0])
        self.stepped: list[str] = []
        shadowed: set[Key] = set()
        for path in self._components:
            if path not in self.symbolic and path != self.evaluation_path:
                self._refuse_noise(path)
                upstream = self._upstream(path)
                keys = {k for k in self.dispersed if k[1] in upstream and self._is_parameter(k)}
                self.stepped += [path] if keys else []
                shadowed |= keys
        self.shadows = Shadows(self._components, [k for k in self.dispersed if k in shadowed])

    def _upstream(self, path: str) -> list[str]:
        """A component, and whatever reaches it through connections, the nearest first."""
        found, seen = [path], {path}
        for owner in found:  # which grows
            more = [s for s in dict.fromkeys(self._sources[owner]) if s not in seen]
            found += more
            seen.update(more)
        return found

    def _refuse_noise(self, path: str) -> None:
        """Refuse a component without a Jacobian if noise reaches it."""
        for name in self._components[path].inputs():
            connection = self._connections.get(f"{path}.{name}")
            if connection is None:
                continue
            upstream = self._upstream(_split(connection.source)[0])
            noisy = [p for p in upstream if p in self.symbolic and self.symbolic[p].model.noise]
            if noisy:
                why = (
                    f"its input '{name}' reads '{connection.source}', which deviates with the "
                    f"noise of '{noisy[0]}'"
                )
                raise _refused(path, self._components[path], why)

    def _is_parameter(self, key: Key) -> bool:
        return isinstance(self._components[key[1]].settings().get(key[2]), Parameter)

    def source(self, path: str, name: str) -> tuple[Key, FloatArray | None] | None:
        """Where an input comes from, and its unit conversion; None if it does not deviate."""
        head, _, tail = name.partition(".")
        connection = self._connections.get(f"{path}.{head}")
        if connection is None:
            return None
        owner, _, port_name = connection.source.rpartition(".")
        if owner not in self.symbolic and owner not in self.stepped:
            return None
        port = self._components[path].ports[head]
        if connection.delay or port.window or port.queue > 1:
            what = "a delay" if connection.delay else "a window or queue"
            raise ConfigurationError(
                f"the connection to '{path}.{head}' has {what}, which is not linearized\n"
                "  fly a campaign instead"
            )
        factor = port_factor(self._components[owner].ports[port_name], port)
        if factor is not None:
            factor = _part(port, tail, factor)
        if port.at == "start":
            return ("held", path, name), factor
        return self.slot_of(path, name), factor

    def slot_of(self, path: str, name: str) -> Key:
        """The slot behind an input, whenever it is read."""
        head, _, tail = name.partition(".")
        owner, _, port_name = self._connections[f"{path}.{head}"].source.rpartition(".")
        return "slot", owner, f"{port_name}.{tail}" if tail else port_name

    def inputs(self, path: str) -> dict[str, tuple[Key, FloatArray | None]]:
        """Inputs of a symbolic component that deviate: vectors, but for times and freshness."""
        model = self.symbolic[path].model
        found = {}
        for name in model.inputs:
            if not name.endswith((".fresh", ".t")) and len(model.shape(name)) == 1:
                source = self.source(path, name)
                if source is not None:
                    found[name] = source
        return found

    def outputs_read(self) -> dict[str, set[str]]:
        """By component, those of its outputs that anybody reads."""
        found: dict[str, set[str]] = {}
        readers = [(p, list(c.model.inputs)) for p, c in self.symbolic.items()]
        readers.append((self.evaluation_path, list(self.error_model.inputs)))
        for path, names in readers:
            for name in names:
                if f"{path}.{name.partition('.')[0]}" in self._connections:
                    _, owner, full = self.slot_of(path, name)
                    found.setdefault(owner, set()).add(full)
        return found


def _split(port: str) -> tuple[str, str]:
    """The component, and the name in it."""
    owner, _, name = port.rpartition(".")
    return owner, name


def _refused(path: str, component: Component, why: str) -> ConfigurationError:
    return ConfigurationError(
        f"'{path}' ({type(component).__name__}) has no symbolic Jacobian, as all that can only be "
        f"stepped (FMUs, components in Python), and {why}, so the system cannot be linearized\n"
        "  fly a campaign instead, which takes its dispersions"
    )


def _part(port: Any, tail: str, factor: FloatArray) -> FloatArray | None:
    start = 0
    for name, each in port.fields.items():
        if name == tail:
            return factor[start : start + each.size]
        start += each.size
    return None


class Layout:
    """Places in z of everything that deviates, and the draws that it starts from.

    Attributes
    ----------
    linear : dict of str to Linear or Stepped
    place : dict of Key to slice
    size : int
        Of z.
    held : dict of Key to (Key, ndarray or None)
        What is latched when a step ends, from where, with the conversion of units.
    sources : list of str
        Of noise, dispersions last.
    draws : dict of str to (slice, ndarray)
        Of sources that draw once, at the start: their columns, and the covariance of the draw.
    n_draws : int
    effects : list of (Key, str, ndarray)
        Dispersed parameters: by which draw, and how.
    """

    def __init__(self, plan: Plan, wires: Wires) -> None:
        read = wires.outputs_read()
        self.stepped = {
            path: Stepped(
                path,
                plan.flat.components[path],
                read.get(path, ()),
                [key[2] for key in wires.shadows.numbers if key[1] == path],
                wires.shadows,
            )
            for path in wires.stepped
        }
        self.linear: dict[str, Linear | Stepped] = {**self.stepped}
        for path, component in wires.symbolic.items():
            self.linear[path] = Linear(
                path,
                component,
                wires.inputs(path),
                [*read.get(path, ())],
                [
                    n
                    for n in component.model.parameters
                    if ("parameter", path, n) in wires.dispersed
                ],
            )
        self.place: dict[Key, slice] = {}
        self.held: dict[Key, tuple[Key, FloatArray | None]] = {}
        self.sources: list[str] = []
        self.draws: dict[str, tuple[slice, FloatArray]] = {}
        self.size = self.n_draws = 0
        for path, linear in self.linear.items():
            for name in linear.states:
                self._room(("state", path, name), linear.sizes[name])
            for name in linear.outputs:
                self._room(("slot", path, name), linear.sizes[name])
            for name, (key, factor) in linear.inputs.items():
                if key[0] == "held":
                    self._room(key, linear.sizes[name])
                    self.held[key] = (wires.slot_of(path, name), factor)
            for name in linear.noise:
                self.sources += [f"{path}.{name} at the start", f"{path}.{name}"]
                self._draw(f"{path}.{name} at the start", np.eye(linear.sizes[name]))
        self.held = {key: found for key, found in self.held.items() if found[0] in self.place}
        self.effects: list[tuple[Key, str, FloatArray]] = []
        for key, several in wires.dispersed.items():
            for d in several:
                self._disperse(key, d, plan.flat.components)

    def _room(self, key: Key, size: int) -> None:
        if key not in self.place:
            self.place[key] = slice(self.size, self.size + size)
            self.size += size

    def _draw(self, source: str, covariance: FloatArray) -> None:
        n = len(covariance)
        self.draws[source] = (slice(self.n_draws, self.n_draws + n), covariance)
        self.n_draws += n

    def _disperse(self, key: Key, d: Dispersion, components: Mapping[str, Component]) -> None:
        """Give a dispersed parameter its place; targets of one dispersion take the same draw."""
        _, owner, name = key
        linear = self.linear.get(owner)
        if linear is None or name not in linear.parameters:
            raise ConfigurationError(
                f"dispersion '{d.name}' feeds '{owner}.{name}', which is no parameter of a "
                "symbolic model, so that its effect cannot be linearized\n"
                "  fly a campaign instead"
            )
        self._room(key, linear.sizes[name])
        nominal = linear.component.parameter_values[name][0].reshape(-1)
        source = f"dispersion {d.name}"
        if source not in self.draws:
            self.sources.append(source)
            self._draw(source, _covariance(d, components, len(nominal)))
        self.effects.append((key, source, _effect(d, nominal)))

    def sigma(self) -> dict[Key, FloatArray]:
        """Standard deviation of the numbers of every dispersed parameter."""
        variance: dict[Key, FloatArray] = {}
        for key, source, effect in self.effects:
            added = np.diagonal(effect @ self.draws[source][1] @ effect.T)
            variance[key] = variance.get(key, np.zeros(len(added))) + added
        return {key: np.sqrt(each) for key, each in variance.items()}

    def start(self) -> FloatArray:
        """Derivative of z by the draws before anything starts, (size, n_draws)."""
        found = np.zeros((self.size, self.n_draws))
        for key, source, effect in self.effects:
            found[self.place[key], self.draws[source][0]] = effect
        return found


def _covariance(d: Dispersion, components: Mapping[str, Any], size: int) -> FloatArray:
    """Covariance of a dispersion's draw, of as many numbers as the parameter has."""
    spread = d.read_spread(components)
    if d.kind == "multivariate":
        return spread
    if d.kind == "list":
        flat = spread.reshape(len(spread), -1)
        found: FloatArray = np.atleast_2d(np.cov(flat.T, bias=True))
        return found
    width = np.broadcast_to(spread.reshape(-1), size)
    if d.kind == "normal":
        return np.diag(width**2)
    if d.kind == "truncated":
        from scipy.stats import truncnorm

        return np.diag(width**2 * truncnorm.var(-d.limit, d.limit))
    width = np.log(width) if d.kind == "log_uniform" else width
    return np.diag(width**2 / 3)


def _effect(d: Dispersion, nominal: FloatArray) -> FloatArray:
    """What a draw changes a parameter by: itself; of a factor's logarithm, to first order."""
    return np.diag(nominal) if d.kind == "log_uniform" else np.eye(len(nominal))
