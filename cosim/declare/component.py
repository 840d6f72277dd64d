"""The contract of a component: declared ports, states and parameters, and a life cycle.

A subclass provides, in this order of need:

1. declarations as class attributes (ports, parameters and states);
2. ``_step_impl(t, dt)``: read inputs, advance states, publish outputs at time `t`;
3. ``_initialize_impl()``: publish outputs at t = 0 (by default nothing is published);
4. ``validate()``: raise what is wrong with its parameters, before anything runs;
5. ``_extra_state`` / ``_set_extra_state`` where something other than declared states is kept.

A component reaches for nothing but its own ports, parameters, states and `normals`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.cosim.basics.arrays import FloatArray, Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, RateError, WiringError, nearest
from terrafix.cosim.basics.noise import NormalBlocks, NormalStream
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter, Setting, shown
from terrafix.cosim.declare.ports import Capabilities, Declaration, Port, State
from terrafix.cosim.show.tables import Block, Shown

ATTRIBUTES = frozenset(
    {"name", "doc", "rate", "ports", "step_index", "kernel", "call", "messages"}
)  # of every component
KEYS = frozenset({"type", "period", "offset", "times", "doc"})  # of its table in a file


def _own(base: type) -> bool:
    """Whether a base class is the contract itself, whose attributes no declaration may hide."""
    return base.__module__ in (
        "terrafix.cosim.declare.component",
        "terrafix.cosim.kernels.symbolic",
    )


FedBy = Callable[["Component", str], "Component | None"]
"""Tells which component drives an input of another."""


class Owner(Protocol):
    """What has ports: a component, or a system that exposes some."""

    name: str


@dataclass(frozen=True, repr=False)
class PortRef:
    """A port of one component, as written ``imu["delta_v"]``, and its declaration."""

    component: Owner
    port: str
    declared: Port[object]

    def __str__(self) -> str:
        return f"{self.component.name or '(unnamed)'}.{self.port}"

    def __repr__(self) -> str:
        return f"<{self}: {self.declared!r}>"


class _Documentation:
    """Docstring of a component type: as it was written, then its parameters and ports.

    Made when somebody asks for it; ``vars(kind)["__doc__"].written`` is the text alone.
    """

    def __init__(self, written: str | None) -> None:
        self.written = written

    def __get__(self, obj: object, owner: type[Component]) -> str:
        from terrafix.cosim.declare.display import help_text

        doc = next(filter(None, (docstring(k) for k in owner.__mro__ if k is not Component)), "")
        ports = {n: d for n, d in owner.declarations.items() if isinstance(d, Port)}
        return help_text(doc, owner.default_rate, owner.settings(), ports)


def docstring(kind: type) -> str:
    """The docstring of a class as it was written there, without what `help` adds to it."""
    found = vars(kind).get("__doc__")
    return inspect.cleandoc(getattr(found, "written", found) or "")


class _Settings:
    """``settings()``, of a type or of a component: its declared parameters by name.

    Those of a component are also what `declare_settings` found (the parameters of an FMU).
    """

    def __get__(
        self, obj: Component | None, owner: type[Component]
    ) -> Callable[[], dict[str, Setting[object]]]:
        if obj is not None and obj._all_settings[0] is obj._found_settings:
            return lambda: obj._all_settings[1]
        declared = {n: d for n, d in owner.declarations.items() if isinstance(d, Setting)}
        if obj is None:
            return lambda: declared
        obj._all_settings = _, every = obj._found_settings, declared | obj._found_settings
        return lambda: every


class _CallTip:
    """Signature of a component type: its parameters are keyword arguments."""

    def __get__(self, obj: object, owner: type[Component]) -> inspect.Signature:
        if owner is Component or owner.__init__ is not Component.__init__:
            raise AttributeError("__signature__")  # it has one of its own
        only = inspect.Parameter.KEYWORD_ONLY
        listed = [
            inspect.Parameter(
                name,
                only,
                default=inspect.Parameter.empty if setting.required else setting.default,
                annotation=setting.kind(),
            )
            for name, setting in owner.settings().items()
        ]
        rate = inspect.Parameter("rate", only, default=owner.default_rate, annotation="Rate")
        return inspect.Signature([*listed, rate])


@dataclass
class Environment:
    """What a running simulation lends a component.

    Attributes
    ----------
    path : str
        Where the component stands in the system, ``"nav.predict"``.
    seed : int
        Root seed of the ensemble.
    members : ndarray of int64, shape (n_members,)
        Numbers of the members flown here (a part of an ensemble keeps its numbers).
    active : ndarray of bool, shape (n_members,)
        Members that have not failed.
    fail : callable
        ``fail(mask, reason)`` excludes members from here on.
    quiet : bool
        Every draw of noise is zero: the nominal run, about which errors are linearized.
    end : callable, optional
        ``end(mask, reason)`` ends the runs of members when this tick is over, which is no failure.
    epoch : str, optional
        What time it is at t = 0, as the system has it: text whose meaning components know.
    """

    path: str
    seed: int
    members: NDArray[np.int64]
    active: Mask
    fail: Callable[[Mask, str], None]
    quiet: bool = False
    end: Callable[[Mask, str], None] | None = None
    epoch: str | None = None

    @property
    def n_members(self) -> int:
        """Number of members flown here."""
        return len(self.members)


class Component(Shown):
    """Base of every component.

    Parameters
    ----------
    rate : Rate, optional
        When it steps; `default_rate` of the class if absent.
    **settings
        Declared parameters by name.

    Attributes
    ----------
    doc : str
        What it is for in its system.
    declarations : dict of str to Declaration
        Of the class: ports, states and parameters.
    ports : dict of str to Port
    given_parameters : dict
        Parameters as they were set: before dispersions, without members. None stands for one that
        was refused, and reported; where None is a value, `parameter_values` then lacks it.
    parameter_values : dict
        Parameters as they are now: while a simulation runs, numeric ones have a row per member.
    state_arrays, port_views : dict
        What `bind` lends: arrays of states, and what stands behind each port.

    Raises
    ------
    ConfigurationError
        If a name is unknown, a required parameter is absent, or a value cannot be used.
    """

    capabilities: ClassVar[Capabilities] = Capabilities()
    default_rate: ClassVar[Rate | None] = None
    declarations: ClassVar[dict[str, Declaration]] = {}
    __signature__ = _CallTip()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        declared: dict[str, Declaration] = {}
        for base in reversed(cls.__mro__):
            for name, value in vars(base).items():
                if isinstance(value, Declaration):
                    declared[name] = value
                elif name in declared:
                    del declared[name]  # a subclass took the name for something else
        settings = {n for n, d in declared.items() if isinstance(d, Setting)}
        clash = (set(declared) & ATTRIBUTES) | (settings & KEYS)
        clash |= {n for n in declared if n.startswith("_")}
        clash |= {n for n in declared for base in cls.__mro__ if n in vars(base) and _own(base)}
        if clash:
            raise TypeError(f"{cls.__name__} declares reserved names {sorted(clash)}")
        cls.declarations = declared
        cls.__doc__ = _Documentation(vars(cls).get("__doc__"))  # type: ignore[assignment]

    def __init__(self, *, rate: Rate | None = None, **settings: object) -> None:
        self.name = self.doc = ""
        self.rate = rate or self.default_rate
        if self.rate is not None and not isinstance(self.rate, Rate):
            raise RateError(
                f"the rate of a {type(self).__name__} is {self.rate!r}\n"
                '  write Rate("0.01") for a period, or Rate(hz=100)'
            )
        self.ports: dict[str, Port[object]] = {}
        self.port_views: dict[str, Any] = {}
        self.state_arrays: dict[str, NDArray[Any]] = {}
        self.parameter_values: dict[str, Any] = {}
        self.given_parameters: dict[str, Any] = {}
        self._found_settings: dict[str, Setting[object]] = {}
        self._all_settings: tuple[Any, dict[str, Setting[object]]] = None, {}
        self._environment: Environment | None = None
        self._streams: dict[tuple[str, int], NormalBlocks] = {}
        self.step_index = 0
        self.remarks: list[str] = []
        declared = self.settings()
        for name, value in self.declarations.items():
            if isinstance(value, Port):
                self.ports[name] = value
        later = [n for n in settings if n not in declared]
        if later and not self.declares_settings():
            raise self._unknown_parameter(later[0])
        for name, setting in declared.items():
            if name in settings:
                self.set_parameter(name, settings[name])
            elif not setting.required:
                self.parameter_values[name] = self.given_parameters[name] = setting.read(
                    setting.default, where=f"default of '{name}'"
                )
        if later:
            self.declare_settings()
        for name in self.in_order_of_setting(later):
            self.set_parameter(name, settings[name])

    # ------------------------------------------------------------------ settings and ports

    settings = _Settings()

    def declare_settings(self) -> None:
        """Find the parameters that depend on others (an FMU's, on its file), once these are set."""

    @classmethod
    def declares_settings(cls) -> bool:
        """Whether it has parameters besides those of its type."""
        return cls.declare_settings is not Component.declare_settings

    def in_order_of_setting(self, names: Iterable[str]) -> list[str]:
        """Names of parameters, those first that decide the structure, and so what others take."""
        settings = self.settings()
        return sorted(names, key=lambda name: isinstance(settings.get(name), Parameter))

    def _unknown_parameter(self, name: str) -> ConfigurationError:
        known = self.settings()
        return ConfigurationError(
            f"{type(self).__name__} has no parameter '{name}'\n"
            f"  {nearest(name, known, what='its parameters')}"
        )

    def set_parameter(self, name: str, value: object, *, bare: bool = True) -> None:
        """Set a parameter by name, as assigning it does; `bare` allows numbers without a unit."""
        if self._environment is not None:
            raise ConfigurationError(
                f"'{self.name}.{name}' cannot be set while a simulation runs; set it before"
            )
        where = f"'{self.name}.{name}'" if self.name else f"{type(self).__name__} '{name}'"
        setting = self.settings().get(name)
        if setting is None:
            raise self._unknown_parameter(name)
        self.parameter_values[name] = self.given_parameters[name] = setting.read(
            value, where=where, bare=bare
        )

    def setting(self, name: str) -> Any:
        """The value that was set (for numeric parameters: before dispersions, without members)."""
        if name in self._found_settings and name not in self.given_parameters:
            declared = self._found_settings[name]
            return None if declared.required else declared.default
        return self.given_parameters[name]

    def is_default(self, name: str) -> bool:
        """Whether a parameter stands as its declaration has it."""
        declared = self.settings()[name]
        if declared.required or name not in self.given_parameters:
            return name not in self.given_parameters
        default = declared.read(declared.default, where=f"default of '{name}'")
        return bool(np.all(np.asarray(self.given_parameters[name] == default)))

    def takes(self, name: str) -> bool:
        """Whether a parameter has any effect, as the others are now; override where it may not."""
        return name in self.settings()

    def idle(self, name: str) -> str | None:
        """Why a parameter would change nothing, in words; None if it has an effect."""
        if self.missing_settings() or self.takes(name):
            return None
        chosen = [
            f"{n} = {shown(self.setting(n))}"
            for n, s in self.settings().items()
            if isinstance(s, Choice | Flag)
        ]
        with_these = f" with {', '.join(chosen)}" if chosen else ""
        return f"'{self.name}' does not take '{name}'{with_these}: it would change nothing"

    def alone(self) -> bool:
        """Whether what it shares is of one member, as it is set: members fly one at a time."""
        return False

    def missing_settings(self) -> list[str]:
        """Names of required parameters that were not given."""
        declared = type(self).settings()
        return [n for n, s in declared.items() if s.required and n not in self.given_parameters]

    def __getitem__(self, port: str) -> PortRef:
        """Name a port: ``imu["delta_v"]``.

        Raises
        ------
        WiringError
            If there is no such port.
        """
        if port not in self.ports:
            raise WiringError(
                f"'{self.name or type(self).__name__}' has no port '{port}'\n"
                f"  {nearest(port, self.ports, what='its ports')}"
            )
        return PortRef(self, port, self.ports[port])

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.ports)

    def __dir__(self) -> Iterable[str]:
        return sorted({*super().__dir__(), *self.ports})

    def _shown(self) -> list[Block]:
        from terrafix.cosim.declare.display import component_shown

        title = type(self).__name__ + (f" '{self.name}'" if self.name else "")
        return component_shown(title, self.rate, self.settings(), self.given_parameters, self.ports)

    def inputs(self) -> dict[str, Port[object]]:
        """Input ports by name."""
        return {n: p for n, p in self.ports.items() if p.is_input}

    def outputs(self) -> dict[str, Port[object]]:
        """Output ports by name."""
        return {n: p for n, p in self.ports.items() if not p.is_input}

    # ------------------------------------------------------------------ life cycle

    def prepare(self) -> None:
        """Declare ports that depend on parameters (an FMU's, say), once these are set."""

    def validate(self) -> None:
        """Raise ConfigurationError if the parameters cannot work (files, combinations)."""

    def validate_duration(self, duration: float) -> None:
        """Raise ConfigurationError if it cannot serve a run of `duration` [s] (a recording)."""

    def validate_epoch(self, epoch: str | None) -> None:
        """Raise ConfigurationError if it cannot serve a system of an `epoch`, or of none.

        An EpochError, where the epoch itself is missing or wrong, is told once for all components.
        """

    def foreseen(self, fed_by: FedBy) -> Iterable[str]:
        """Tell what may become narrow in a flight, by what feeds it, once all else is right.

        ``fed_by(component, "port")`` is the component that drives an input, or None.

        Raises
        ------
        ConfigurationError
            If it cannot work.
        """
        return ()

    @classmethod
    def asks_for_epoch(cls) -> bool:
        """Whether an epoch makes a difference to it: whether a class provides `validate_epoch`."""
        return cls.validate_epoch is not Component.validate_epoch

    def bind(self, environment: Environment) -> None:
        """Get arrays for states and parameters; called once, before ports are bound."""
        self._environment = environment
        self.step_index = 0
        n = environment.n_members
        for name, declared in self.declarations.items():
            if isinstance(declared, State):
                field = declared.field
                self.state_arrays[name] = np.empty((n, *field.fixed_shape), dtype=field.dtype)
                self.state_arrays[name][...] = declared.start
        for name, setting in self.settings().items():
            found = name in self._found_settings and not setting.required
            if isinstance(setting, Parameter) and (found or name in self.given_parameters):
                base = np.asarray(self.setting(name), dtype=np.float64)
                self.parameter_values[name] = np.broadcast_to(base, (n, *base.shape)).copy()

    def release(self) -> None:
        """Give back what `bind` lent; the component can be simulated again."""
        self._environment = None
        self.port_views = {}
        self.state_arrays = {}
        self._streams = {}
        self.parameter_values = dict(self.given_parameters)

    @property
    def lent(self) -> Environment | None:
        """What a simulation lends it now; None outside of one."""
        return self._environment

    @classmethod
    def has_step(cls) -> bool:
        """Whether it can step: whether a class provides `_step_impl`."""
        return cls._step_impl is not Component._step_impl

    @property
    def environment(self) -> Environment:
        """What the running simulation lends; only while one is built."""
        if self._environment is None:
            raise ConfigurationError(f"'{self.name}' is not part of a running simulation")
        return self._environment

    @property
    def n_members(self) -> int:
        """Number of ensemble members flown here."""
        return self.environment.n_members

    @property
    def publishes_at_start(self) -> bool:
        """Whether messages may be published at t = 0: whether 0 is one of the activations."""
        return self.rate is not None and self.rate.starts_at_zero

    @property
    def takes_messages_at_start(self) -> bool:
        """Whether messages of t = 0 are read at initialization, rather than by the first step.

        They are where 0 is one of the activations and the component does something then.
        """
        return self.acts_at_start() and self.publishes_at_start

    @classmethod
    def acts_at_start(cls) -> bool:
        """Whether it does something at t = 0: whether a class provides `_initialize_impl`."""
        return cls._initialize_impl is not Component._initialize_impl

    def scheduled(self, t: float) -> float:
        """The time of this activation as it was listed, before it was snapped to a tick at `t` [s].

        For the time of validity of what a component with listed times publishes; `t` itself where
        a period is the schedule.
        """
        if self.rate is None or self.rate.times is None or self.step_index == 0:
            return t
        return float(self.rate.times[self.step_index - (not self.rate.starts_at_zero)])

    def initialize(self) -> None:
        """Publish outputs at t = 0."""
        self._initialize_impl()

    def step(self, t: float, dt: float) -> None:
        """Advance from ``t - dt`` to `t` [s] and publish outputs at `t`."""
        self.step_index += 1
        self._step_impl(t, dt)

    def terminate(self) -> None:
        """Give back files and the like at the end of a run, whether it failed or not."""

    def _initialize_impl(self) -> None:
        """Publish outputs at t = 0; override where there are any."""

    def _step_impl(self, t: float, dt: float) -> None:
        raise NotImplementedError(f"{type(self).__name__} must provide _step_impl(t, dt)")

    # ------------------------------------------------------------------ services

    def normals(self, stream: str, n: int) -> FloatArray:
        """Standard normal numbers of this step, shape (n_members, n).

        They depend on the root seed, the member, this component's path, the stream's name and
        the number of this component's step, and on nothing else: asked twice in a step, a stream
        gives the same numbers twice.
        """
        if self.environment.quiet:
            return np.zeros((self.n_members, n))
        source = self._streams.get((stream, n))
        if source is None:
            if n < 1:
                raise ValueError(f"stream '{stream}' was asked for {n} numbers")
            env = self.environment
            numbers = NormalStream(env.seed, env.path, stream, env.members)
            source = self._streams[stream, n] = NormalBlocks(numbers, n)
        return source.draw(self.step_index)

    def fail(self, mask: ArrayLike, reason: str) -> None:
        """Exclude the members in `mask` (n_members,) from here on, with a reason."""
        self.environment.fail(np.asarray(mask, dtype=np.bool_), reason)

    def end_run(self, mask: ArrayLike, reason: str) -> None:
        """End the runs of the members in `mask` (n_members,) after this tick: they are complete."""
        end = self.environment.end or self.environment.fail
        end(np.asarray(mask, dtype=np.bool_), reason)

    def get_state(self) -> dict[str, Any]:
        """Arrays and plain values that reproduce this component."""
        saved: dict[str, Any] = {name: array.copy() for name, array in self.state_arrays.items()}
        extra = deepcopy(self._extra_state())
        return {"states": saved, "step_index": self.step_index, "extra": extra}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Put back what `get_state` gave."""
        for name, array in saved["states"].items():
            self.state_arrays[name][...] = array
        self.step_index = int(saved["step_index"])
        self._set_extra_state(deepcopy(saved["extra"]))

    def _extra_state(self) -> dict[str, Any]:
        """State that is not declared: a flat dict of arrays, numbers and texts."""
        return {}

    def _set_extra_state(self, saved: dict[str, Any]) -> None:
        """Put back what `_extra_state` gave."""
