r"""What can only be stepped: how it follows parameters, by members that fly beside the nominal one.

A component without a Jacobian that neither draws noise nor reads what noise reaches (a truth, say,
from an FMU) publishes the same in every member, but for dispersed parameters, its own or of those
that it reads: constants :math:`p`, so that of what it publishes :math:`S(t)\, p` deviates. Central
differences between two members for each number of `p` give :math:`S` at every step.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.lincov.jacobians import Key, Read, Written

STEP = 0.25
"""Of a difference to either side, in sigma of the parameter: what it is wrong by is a hundredth of
what is left out by being linear, and outputs are told apart by as many digits as that leaves."""


class Shadows:
    """Members beside the nominal one: two for each number of some parameters.

    Number k is a step above its nominal value in member 2k + 1, and as far below in member 2k + 2.

    Parameters
    ----------
    components : mapping of str to Component
        Bound.
    parameters : collection of Key

    Attributes
    ----------
    numbers : dict of Key to slice
        Which numbers k are those of a parameter.
    n_members : int
        With the nominal one.
    """

    def __init__(self, components: Mapping[str, Component], parameters: Collection[Key]) -> None:
        self._values = {key: components[key[1]].parameter_values[key[2]] for key in parameters}
        self._declared = {key: components[key[1]].settings()[key[2]] for key in parameters}
        self.numbers: dict[Key, slice] = {}
        n = 0
        for key, values in self._values.items():
            self.numbers[key] = slice(n, n + values[0].size)
            n += values[0].size
        self.n_members = 1 + 2 * n
        self._widths = np.zeros(n)

    def spread(self, sigma: Mapping[Key, FloatArray]) -> None:
        """Set the parameters of all members but the nominal one apart.

        Raises
        ------
        ConfigurationError
            If a value beside the nominal one is not allowed.
        """
        for key, at in self.numbers.items():
            values = self._values[key]
            rows = values.reshape(self.n_members, -1)
            for element, k in enumerate(range(at.start, at.stop)):
                above, below = 2 * k + 1, 2 * k + 2
                rows[above, element] += STEP * sigma[key][element]
                rows[below, element] -= STEP * sigma[key][element]
                self._widths[k] = rows[above, element] - rows[below, element]
                self._check(key, values[above])
                self._check(key, values[below])

    def _check(self, key: Key, value: FloatArray) -> None:
        declared = self._declared[key]
        assert isinstance(declared, Parameter)
        try:
            declared.check_range(value, f"'{key[1]}.{key[2]}'")
        except ConfigurationError as error:
            raise ConfigurationError(
                f"{error}\n  a value beside the nominal one, for a difference where there is no "
                "symbolic Jacobian\n  fly a campaign instead"
            ) from None

    def derivative(self, values: FloatArray) -> FloatArray:
        """Derivative (size, n_numbers) of what members have, (n_members, size); of nothing, 0."""
        widths = np.where(self._widths > 0.0, self._widths, 1.0)  # without sigma: no difference
        derivative: FloatArray = (values[1::2] - values[2::2]).T / widths
        return np.where(np.isfinite(derivative), derivative, 0.0)


class Stepped:
    """A component that can only be stepped; to the layout, what `Linear` is of a symbolic one.

    Parameters
    ----------
    path : str
    component : Component
        Bound.
    outputs : collection of str
        Those that anybody reads.
    parameters : sequence of str
        Those that are dispersed.
    shadows : Shadows
    """

    states: Sequence[str] = ()
    noise: Sequence[str] = ()

    def __init__(
        self,
        path: str,
        component: Component,
        outputs: Collection[str],
        parameters: Sequence[str],
        shadows: Shadows,
    ) -> None:
        self.path = path
        self.component = component
        self.parameters = list(parameters)
        self.inputs: dict[str, tuple[Key, FloatArray | None]] = {}
        self.outputs: list[str] = []
        for port, declared in component.outputs().items():
            for tail, field in declared.fields.items():
                name = f"{port}.{tail}" if tail else port
                if name in outputs:
                    self._refuse(name, declared.kind, len(field.shape))
                    self.outputs.append(name)
        self.sizes = {n: component.parameter_values[n][0].size for n in self.parameters}
        self.written: list[Written] = []
        n_rows = 0
        for name in self.outputs:
            size = self.sizes[name] = self._values(name).shape[1]
            self.written.append(Written(("slot", path, name), slice(n_rows, n_rows + size), ""))
            n_rows += size
        reads = [Read(key, columns, None) for key, columns in shadows.numbers.items()]
        self.reads = {True: reads, False: reads}
        self._shadows = shadows

    def _refuse(self, name: str, kind: str, n_axes: int) -> None:
        if kind == "message" or n_axes > 1:
            what = "a message" if kind == "message" else "a matrix"
            raise ConfigurationError(
                f"'{self.path}.{name}' is {what} of what has no symbolic Jacobian, and follows "
                "dispersed parameters, which is not linearized\n  fly a campaign instead"
            )

    def _values(self, output: str) -> FloatArray:
        head, _, tail = output.partition(".")
        view = self.component.port_views[head]
        values = np.asarray(getattr(view, tail) if tail else view, dtype=np.float64)
        return values.reshape(len(values), -1)

    def now_written(self, published: Sequence[bool]) -> list[Written]:
        """What a step changes."""
        return self.written

    def at_start(self) -> FloatArray | None:
        """Jacobian of the values at t = 0; None where nothing is written."""
        return self.jacobian() if self.written else None

    def jacobian(self) -> FloatArray:
        """Derivative of what it has published last by the numbers of all shadows' parameters."""
        return self._shadows.derivative(np.hstack([self._values(n) for n in self.outputs]))
