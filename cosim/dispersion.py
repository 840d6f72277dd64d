r"""Dispersions: named draws, one per member, that feed one or more numeric parameters.

A dispersion adds :math:`\sigma \cdot n` (normal) or :math:`h \cdot (2u - 1)` (uniform, half-width
:math:`h`) to every parameter it names. The draw is a function of root seed, member and the
dispersion's name: two parameters fed by one dispersion get the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.errors import ConfigurationError, nearest
from terrafix.cosim.noise import NormalStream
from terrafix.cosim.parameters import Parameter

if TYPE_CHECKING:
    from terrafix.cosim.component import Component

FloatArray = NDArray[np.float64]
KINDS = {"normal": "sigma", "uniform": "half_width"}


@dataclass(frozen=True)
class Dispersion:
    """One named draw per member.

    Parameters
    ----------
    name : str
        Own name of the draw; the numbers depend on it and not on what it feeds.
    targets : tuple of str
        Paths of numeric parameters, ``"ekf.r0_e"``; all of one shape and unit.
    spread : float, array or text with a unit
        Standard deviation (normal) or half-width (uniform), in the parameters' unit.
    kind : {"normal", "uniform"}
    """

    name: str
    targets: tuple[str, ...]
    spread: Any
    kind: str = "normal"

    def below(self, prefix: str) -> Dispersion:
        """The same dispersion seen from a system that contains this one as `prefix`."""
        return replace(
            self, name=f"{prefix}.{self.name}", targets=tuple(f"{prefix}.{t}" for t in self.targets)
        )

    def parameter(self, components: dict[str, Component]) -> Parameter:
        """The declaration that all targets share.

        Raises
        ------
        ConfigurationError
            If a target does not exist, is not numeric, or they differ in shape or unit.
        """
        if self.kind not in KINDS:
            raise ConfigurationError(
                f"dispersion '{self.name}' is of kind '{self.kind}'; it takes {' or '.join(KINDS)}"
            )
        if not self.targets:
            raise ConfigurationError(
                f"dispersion '{self.name}' feeds no parameter\n"
                '  name one or more, as in to = ["orbit.r0_i"]'
            )
        found: list[Parameter] = []
        for target in self.targets:
            owner, _, name = target.rpartition(".")
            if owner not in components:
                raise ConfigurationError(
                    f"dispersion '{self.name}' feeds '{target}', but there is no component "
                    f"'{owner}'\n  {nearest(owner, components, what='components')}"
                )
            settings = components[owner].settings()
            setting = settings.get(name)
            if not isinstance(setting, Parameter):
                numeric = [n for n, s in settings.items() if isinstance(s, Parameter)]
                raise ConfigurationError(
                    f"dispersion '{self.name}' feeds '{target}', which is no numeric parameter\n"
                    f"  {nearest(name, numeric, what='numeric parameters')}"
                )
            found.append(setting)
        first = found[0]
        for target, other in zip(self.targets, found, strict=True):
            if (other.shape, other.unit) != (first.shape, first.unit):
                raise ConfigurationError(
                    f"dispersion '{self.name}' feeds parameters of different kinds\n"
                    f"  {self.targets[0]}  {first.kind()}\n  {target}  {other.kind()}"
                )
        return first

    def read_spread(self, components: dict[str, Component], *, bare: bool = True) -> FloatArray:
        """The spread as an array in the targets' unit; ConfigurationError if it cannot be one.

        `bare` allows numbers without a unit.
        """
        parameter = self.parameter(components)
        like = Parameter(shape=parameter.shape, unit=parameter.unit, minimum=0.0)
        return like.read(
            self.spread, where=f"{KINDS[self.kind]} of dispersion '{self.name}'", bare=bare
        )

    def apply(
        self, components: dict[str, Component], *, seed: int, members: NDArray[np.int64]
    ) -> FloatArray:
        """Add the draws to the bound parameters; return them, shape (n_members, *shape)."""
        spread = self.read_spread(components)
        stream = NormalStream(seed, "dispersion", self.name, members)
        n = max(int(np.prod(spread.shape)), 1)
        if self.kind == "normal":
            unit_draw = stream.draw(0, n)
        else:
            unit_draw = 2.0 * stream.uniform(0, n) - 1.0
        draws = unit_draw.reshape(len(members), *spread.shape) * spread
        for target in self.targets:
            owner, _, name = target.rpartition(".")
            component = components[owner]
            values = component._settings[name]
            values += draws
            declared = component.settings()[name]
            assert isinstance(declared, Parameter)
            declared._check_range(values, f"'{target}' after dispersion '{self.name}'")
        return draws
