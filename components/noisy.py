"""Symbolic components with noise: what zero parameters cancel is neither drawn nor computed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model


class NoisyComponent(SymbolicComponent):
    """A symbolic component whose noise is scaled by parameters from zero on.

    In a simulation its model is without the noise that parameters cancel which are zero for every
    member, dispersions included. Streams are named, so the numbers of the others stay. Where
    parameters can still change (an exported FMU), and where noise is a constant (a linear
    analysis), the model is whole.
    """

    _silent: tuple[Any, dict[frozenset[str], Model]] | None = None

    @property
    def model(self) -> Any:
        """The model, without the noise that is zero for every member."""
        whole: Any = self.whole_model
        if self.lent is None or self.lent.quiet:
            return whole
        return self.model_without(
            n
            for n, s in self.settings().items()
            if isinstance(s, Parameter)
            and self.vanishes(s)
            and n in whole.parameters
            and not self.parameter_values[n].any()
        )

    def vanishes(self, parameter: Parameter) -> bool:
        """Whether a parameter leaves the model where it is zero for every member: a sigma does."""
        return parameter.minimum == 0.0

    def model_without(self, parameters: Iterable[str]) -> Model:
        """The whole model with parameters of value zero, and without the noise they cancel."""
        whole: Any = self.whole_model
        zero = frozenset(parameters)
        if self._silent is None or self._silent[0] is not whole:
            self._silent = (whole, {})
        known = self._silent[1]
        if zero not in known:
            known[zero] = whole.without_noise_of(zero)
        return known[zero]

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: no models, which are made there."""
        return {k: v for k, v in super().__getstate__().items() if k != "_silent"}
