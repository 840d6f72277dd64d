"""Components whose step is a symbolic model: stepped for all members by one kernel call.

The model satisfies a small protocol (`SymbolicModel`); nothing here knows which mathematics it
holds. Names in the model are bound to ports by name: ``"delta_v"`` to a signal, ``"fix.y"`` to a
field of a bundle or message, ``"fix.fresh"`` and ``"fix.t"`` to a message's freshness and time of
validity, and the output ``"fix.valid"`` says which members a message reaches.

A message never received is NaN, and a member whose results are not all finite fails: guard what
comes from a message with ``if_else(fresh, ..., 0)``, also in the fields of an answer that is not
sent.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.noise import stream_key
from terrafix.cosim.declare.component import Component, Environment
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Capabilities
from terrafix.cosim.kernels.build import Argument, BoundKernel, Kernel, Result, Specification
from terrafix.cosim.kernels.stretch import Stage
from terrafix.cosim.kernels.toolchain import cache_directory, wanted_kernel
from terrafix.cosim.memory.messages import MessageReader, MessageWriter
from terrafix.cosim.memory.slots import BundleView

NOT_FINITE = "result is not finite"
Symbols = Mapping[str, Any]


class SymbolicModel(Protocol):
    """What is needed of a model: names, shapes, and functions of flat row-major arguments."""

    @property
    def name(self) -> str:
        """Identifier; names the generated functions."""

    @property
    def inputs(self) -> Symbols:
        """Inputs by name."""

    @property
    def outputs(self) -> Symbols:
        """Outputs by name."""

    @property
    def states(self) -> Symbols:
        """States by name."""

    @property
    def parameters(self) -> Symbols:
        """Parameters by name."""

    @property
    def noise(self) -> Symbols:
        """Noise vectors by name, standard normal."""

    @property
    def step(self) -> Any:
        """Symbol of the step length, or None."""

    @property
    def time(self) -> Any:
        """Symbol of the time, or None."""

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of a named quantity."""

    def uses(self, parameter: str) -> bool:
        """Whether any expression depends on a parameter."""

    @property
    def derivatives(self) -> Symbols:
        """Derivatives of continuous states by name."""

    def step_function(self, name: str | None = None) -> Any:
        """(inputs, states, parameters, noise, step, time) to (outputs, states)."""

    def initial_function(self, name: str | None = None) -> Any:
        """(inputs, parameters, noise, step, time) to (outputs, states)."""

    def rate_function(self, name: str | None = None) -> Any:
        """(inputs, states, parameters, noise, step, time) to (outputs, derivatives)."""


class SymbolicComponent(Component):
    """A component that is a model plus ports and a rate.

    A subclass declares ports and parameters and provides `build_model`, which may look at
    structural settings (choices, flags, counts) but not at numbers: those are arguments of the
    kernel, one value per member.
    """

    capabilities: ClassVar[Capabilities] = Capabilities(symbolic=True)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "time" in cls.declarations:
            raise TypeError(
                f"{cls.__name__} declares reserved names ['time']: a kernel gets the clock's time "
                "under that name\n  call it otherwise; a model that needs the clock's says "
                "Model(..., time=symbol)"
            )

    def build_model(self) -> SymbolicModel:
        """Build the model for the present structural settings."""
        raise NotImplementedError(f"{type(self).__name__} must provide build_model()")

    @property
    def model(self) -> SymbolicModel:
        """The model that is stepped: `whole_model`, unless a subclass leaves parts out."""
        return self.whole_model

    @property
    def whole_model(self) -> SymbolicModel:
        """The model, built on first need for the present settings."""
        structure = tuple(
            (n, self.given_parameters.get(n))
            for n, s in self.settings().items()
            if not isinstance(s, Parameter)
        )
        if self._model is None or self._model[0] != structure:
            try:
                self._model = (structure, self.build_model())
            except ValueError as error:
                who = f"'{self.name}'" if self.name else type(self).__name__
                raise ConfigurationError(f"{who} cannot build its model: {error}") from error
        return self._model[1]

    _model: tuple[Any, SymbolicModel] | None = None
    _kept: tuple[SymbolicModel, Any, Kernel] | None = None

    @property
    def kept_kernel(self) -> Kernel | None:
        """The kernel of an earlier simulation of this component, if it would be made alike now."""
        if self._kept is None:
            return None
        model, made, kernel = self._kept
        alike = model is self.model and made == (self.environment.quiet, _asked_for())
        return kernel if alike else None

    def keep_kernel(self, kernel: Kernel) -> None:
        """Keep a kernel for later simulations."""
        self._kept = self.model, (self.environment.quiet, _asked_for()), kernel

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: neither models nor kernels, which are made there."""
        left = {"_model", "_kept", "kernel", "call"}
        return {k: v for k, v in self.__dict__.items() if k not in left}

    def takes(self, name: str) -> bool:
        """Whether a parameter has any effect, as the choices are now."""
        return not isinstance(self.settings()[name], Parameter) or self.whole_model.uses(name)

    def validate(self) -> None:
        """Check that every name of the model is a port or parameter of this component."""
        model = self.model
        for name in model.inputs:
            self._check_name(name, self.inputs(), {"fresh", "t"}, "input")
        for name in model.outputs:
            self._check_name(name, self.outputs(), {"valid"}, "output")
        for name in model.parameters:
            if not isinstance(self.settings().get(name), Parameter):
                raise ConfigurationError(
                    f"model '{model.name}' has a parameter '{name}' that {type(self).__name__} "
                    "does not declare"
                )

    def _check_name(self, name: str, ports: Mapping[str, Any], extra: set[str], side: str) -> None:
        head, _, tail = name.partition(".")
        port = ports.get(head)
        if port is None:
            raise ConfigurationError(
                f"model '{self.model.name}' has an {side} '{name}', but {type(self).__name__} has "
                f"no such port\n  {nearest(head, ports, what='its ports')}"
            )
        ragged = side == "output" and any(field.ragged for field in port.fields.values())
        if port.window or port.kind == "shared" or ragged:
            kind = "window" if port.window else "shared" if port.kind == "shared" else "ragged"
            raise ConfigurationError(
                f"model '{self.model.name}' has an {side} '{name}', but port '{head}' is {kind}\n"
                "  a symbolic model takes signals and messages of fixed shape"
            )
        known = set(port.fields) | (extra if port.kind == "message" else set())
        if tail not in known:
            raise ConfigurationError(
                f"model '{self.model.name}' has an {side} '{name}', but port '{head}' has no "
                f"'{tail}'\n  {nearest(tail, known)}"
            )
        if tail in port.fields and self.model.shape(name) != port.fields[tail].shape:
            size = int(np.prod(self.model.shape(name)))
            if not size == port.fields[tail].size == 1:  # a number, whatever axes it has
                raise ConfigurationError(
                    f"model '{self.model.name}': '{name}' has shape {self.model.shape(name)}, "
                    f"the port declares {port.fields[tail].shape}"
                )

    # ------------------------------------------------------------------ kernels

    def kernel_request(self) -> Specification:
        """What to build the step kernel from: function, arguments, results."""
        model = self.model

        def size(name: str) -> int:
            return int(np.prod(model.shape(name), dtype=np.int64))

        arguments = [Argument(n, size(n), "array") for n in model.inputs]
        arguments += [Argument(f"state:{n}", size(n), "array") for n in model.states]
        arguments += [Argument(n, size(n), "constant") for n in model.parameters]
        kind = "constant" if self._environment is not None and self._environment.quiet else "noise"
        arguments += [Argument(n, size(n), kind) for n in model.noise]
        if model.step is not None:
            arguments.append(Argument("step", 1, "step"))
        if model.time is not None:
            arguments.append(Argument("time", 1, "time"))
        results = [Result(n, size(n)) for n in model.outputs]
        results += [Result(f"state:{n}", size(n)) for n in model.states]
        return Specification(model.step_function(), arguments, results)

    def bind(self, environment: Environment) -> None:
        """Get arrays for states and parameters."""
        super().bind(environment)
        n = environment.n_members
        for name in self.model.states:
            self.state_arrays[name] = np.zeros((n, *self.state_shape(name)))
        self._dt = np.zeros(1)
        self._t = np.zeros(1)
        self._failed = np.zeros(n, dtype=np.uint8)
        self.messages: dict[str, FloatArray] = {}

    def state_shape(self, name: str) -> tuple[int, ...]:
        """Shape of a state of one member; ``()`` for a scalar."""
        shape = self.model.shape(name)
        return () if shape == (1,) else shape

    def bind_kernel(self, kernel: Kernel) -> None:
        """Tie the kernel to this component's arrays, once ports are bound."""
        env = self.environment
        model = self.model
        arrays = self.arguments()
        results = {n: self._output_array(n) for n in model.outputs}
        results |= {f"state:{n}": self.state_arrays[n] for n in model.states}
        keys = {n: stream_key(env.seed, env.path, n) for n in model.noise}
        self.kernel = kernel
        self.call: BoundKernel = kernel.bind(
            env.n_members,
            arrays,
            results,
            members=env.members,
            noise_keys=keys,
            active=env.active,
            failed=self._failed,
        )

    def arguments(self) -> dict[str, FloatArray]:
        """The arrays that a step reads, by the names of `kernel_request`."""
        model = self.model
        arrays = {n: self._input_array(n) for n in model.inputs}
        arrays |= {f"state:{n}": self.state_arrays[n] for n in model.states}
        arrays |= {n: self.parameter_values[n] for n in model.parameters}
        if self.environment.quiet:
            n_members = self.n_members
            arrays |= {n: np.zeros((n_members, *model.shape(n))) for n in model.noise}
        return arrays | {"step": self._dt, "time": self._t}

    def _input_array(self, name: str) -> FloatArray:
        head, _, tail = name.partition(".")
        view = self.port_views[head]
        if isinstance(view, MessageReader):
            if tail == "fresh":
                return view.fresh_number
            return view.t if tail == "t" else view.slot.views[tail]
        if isinstance(view, BundleView):
            array: FloatArray = view.__dict__[tail]
            return array
        plain: FloatArray = view
        return plain

    def _output_array(self, name: str) -> FloatArray:
        head, _, tail = name.partition(".")
        view = self.port_views[head]
        if isinstance(view, MessageWriter):
            self.messages.setdefault(head, np.ones(self.n_members))
            if tail == "valid":
                return self.messages[head]
            draft: FloatArray = view.draft[tail]
            return draft
        if isinstance(view, BundleView):
            array: FloatArray = view.__dict__[tail]
            return array
        plain: FloatArray = view
        return plain

    # ------------------------------------------------------------------ life cycle

    def _initialize_impl(self) -> None:
        model, env = self.model, self.environment
        for name, port in self.inputs().items():
            if port.needed_at_start:
                self.fail(~self.port_views[name].fresh, f"no '{name}' was received at t = 0")
        function = model.initial_function()
        rows = [self._input_array(n).reshape(self.n_members, -1) for n in model.inputs]
        rows += [self.parameter_values[n].reshape(self.n_members, -1) for n in model.parameters]
        rows += [self.normals(n, int(np.prod(model.shape(n)))) for n in model.noise]
        clock = [0.0] * ((model.step is not None) + (model.time is not None))
        targets = [*(self._output_array(n) for n in model.outputs)]
        targets += [self.state_arrays[n] for n in model.states]
        flying = np.flatnonzero(env.active)
        values = _each_member(function, [r[flying] for r in rows], clock, len(flying))
        finite = np.ones(len(flying), dtype=np.bool_)
        for value in values:
            finite &= np.isfinite(value).all(axis=1)
        for m in flying[~finite]:
            self.fail(env.members == env.members[m], self._unfinished_start(m))
        started = flying[finite]
        for target, value in zip(targets, values, strict=True):
            target[started] = value[finite].reshape(-1, *target.shape[1:])
        if self.publishes_at_start:
            self._publish_messages(0.0)

    def _unfinished_start(self, m: int) -> str:
        """Why the start of member number `m` is not finite, as far as its inputs tell."""
        heads = {n: self.ports.get(n.partition(".")[0]) for n in self.model.inputs}
        signals = [n for n, port in heads.items() if port is not None and port.kind == "signal"]
        unwritten = [n for n in signals if not np.isfinite(self._input_array(n)[m]).all()]
        if not unwritten:
            return "start is not finite"
        return f"start is not finite: nothing was published at t = 0 for {', '.join(unwritten)}"

    def _step_impl(self, t: float, dt: float) -> None:
        self._t[0] = t
        self._dt[0] = dt
        if self.call(self.step_index):
            failed = self._failed.astype(np.bool_)
            self._failed[:] = 0
            self.fail(failed, NOT_FINITE)
        if self.messages:
            self._publish_messages(t)

    @property
    def kernel_stage(self) -> Stage | None:
        """What a stretch needs; None where a step is more than a call of a vector kernel."""
        stage: Stage | None = getattr(self.call, "stage", None)
        return None if self.messages else stage

    def stretched(self, n_steps: int, t: float, dt: float) -> None:
        """Note that a stretch made `n_steps` steps of this component, the last at `t` [s]."""
        self.step_index += n_steps
        self._t[0] = t
        self._dt[0] = dt

    def _publish_messages(self, t: float) -> None:
        for name, valid in self.messages.items():
            mask = valid > 0.5
            if mask.any():
                self.port_views[name].publish_draft(t, mask)


def _asked_for() -> tuple[str, ...]:
    """What of the user's environment decides how kernels are made."""
    return wanted_kernel(), os.environ.get("TERRAFIX_CC", ""), str(cache_directory())


def _each_member(
    function: Any, rows: list[FloatArray], clock: list[float], n_members: int
) -> list[FloatArray]:
    """Evaluate a function of columns for every member: results of shape (n_members, size)."""
    if not n_members:
        return [np.empty((0, function.numel_out(i))) for i in range(function.n_out())]
    whole = function.map(n_members)
    columns = [np.asfortranarray(r.T) for r in rows]
    arguments = [*columns, *(np.full((1, n_members), value) for value in clock)]
    results = whole.call(arguments)  # a list, also of a function without arguments
    return [np.asarray(r.full(), dtype=np.float64).T for r in results]
