r"""Dispersions: named draws, one per member, that feed one or more numeric parameters.

Each kind turns uniform numbers :math:`u` of a member into a change of every parameter it names:

=============  ================  =============================================================
kind           spread            change of the value :math:`p`
=============  ================  =============================================================
normal         ``sigma``         :math:`p + \sigma\, \Phi^{-1}(u)`
uniform        ``half_width``    :math:`p + h\, (2u - 1)`
truncated      ``sigma``         as normal, given that it lies within ``limit`` sigma (3)
log_uniform    ``factor``        :math:`p\, f^{2u - 1}`: between :math:`p/f` and :math:`p f`
multivariate   ``covariance``    :math:`p + L\, \Phi^{-1}(u)`, :math:`L L^T` the covariance
list           ``values``        the values in turn: member :math:`m` takes number m mod n
=============  ================  =============================================================

The numbers are those of a stream of the dispersion's own name (two parameters fed by one
dispersion get the same), or columns of a design over all runs of a campaign: a Latin hypercube or
a Sobol sequence, which fill the space of all dispersions of that design together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.noise import NormalStream, normal_quantile, stream_key
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import State

if TYPE_CHECKING:
    from terrafix.cosim.declare.component import Component

KINDS = {
    "normal": "sigma",
    "uniform": "half_width",
    "truncated": "sigma",
    "log_uniform": "factor",
    "multivariate": "covariance",
    "list": "values",
}
DESIGNS = ("random", "latin_hypercube", "sobol")


@dataclass(frozen=True)
class Dispersion:
    """One named draw per member.

    Parameters
    ----------
    name : str
        Own name of the draw; the numbers depend on it and not on what it feeds.
    targets : tuple of str
        Paths of numeric parameters, ``"ekf.r0_e"``, or of states that a component in Python
        declares; all of one shape and unit.
    spread : float, array or text with a unit
        What the kind calls its spread, in the parameters' unit (a covariance: in its square; a
        factor: without).
    kind : str
        One of `KINDS`.
    design : str
        One of `DESIGNS`.
    limit : float
        Of a truncated draw, in sigma.
    doc : str
        What it stands for.
    """

    name: str
    targets: tuple[str, ...]
    spread: Any
    kind: str = "normal"
    design: str = "random"
    limit: float = 3.0
    doc: str = ""

    def below(self, prefix: str) -> Dispersion:
        """The same dispersion seen from a system that contains this one as `prefix`."""
        return replace(
            self, name=f"{prefix}.{self.name}", targets=tuple(f"{prefix}.{t}" for t in self.targets)
        )

    # ------------------------------------------------------------------ checks

    def parameter(self, components: Mapping[str, Component]) -> Parameter:
        """The declaration that all targets share.

        Raises
        ------
        ConfigurationError
            If a target does not exist, is not numeric, or they differ in shape or unit.
        """
        if self.kind not in KINDS:
            raise ConfigurationError(
                f"dispersion '{self.name}' is of kind '{self.kind}'\n"
                f"  {nearest(self.kind, KINDS, what='kinds')}"
            )
        if self.design not in DESIGNS:
            raise ConfigurationError(
                f"dispersion '{self.name}' is of design '{self.design}'\n"
                f"  {nearest(self.design, DESIGNS, what='designs')}"
            )
        if self.kind == "list" and self.design != "random":
            raise ConfigurationError(
                f"dispersion '{self.name}' is a list: members take its values in turn, and no "
                f"{self.design} design would be applied\n  leave out the design"
            )
        if not self.targets:
            raise ConfigurationError(
                f"dispersion '{self.name}' feeds no parameter\n"
                '  name one or more, as in to = ["orbit.r0_i"]'
            )
        if len(set(self.targets)) != len(self.targets):
            raise ConfigurationError(f"dispersion '{self.name}' feeds a parameter twice")
        found = [self._declaration(target, components) for target in self.targets]
        first = found[0]
        for target, other in zip(self.targets, found, strict=True):
            if (other.shape, other.unit) != (first.shape, first.unit):
                raise ConfigurationError(
                    f"dispersion '{self.name}' feeds parameters of different kinds\n"
                    f"  {self.targets[0]}  {first.kind()}\n  {target}  {other.kind()}"
                )
        return first

    def _declaration(self, target: str, components: Mapping[str, Component]) -> Parameter:
        owner, _, name = target.rpartition(".")
        if owner not in components:
            raise ConfigurationError(
                f"dispersion '{self.name}' feeds '{target}', but there is no component "
                f"'{owner}'\n  {nearest(owner, components, what='components')}"
            )
        component = components[owner]
        settings = component.settings()
        setting = settings.get(name)
        if isinstance(setting, Parameter):
            reason = component.idle(name)
            if reason is not None:
                raise ConfigurationError(
                    f"dispersion '{self.name}' feeds '{target}'\n  {reason}\n"
                    "  choose otherwise, or leave it out"
                )
            absent = setting.required and name not in component.given_parameters
            if absent and name not in component.missing_settings():
                raise ConfigurationError(
                    f"dispersion '{self.name}' feeds '{target}', which has no value to begin with\n"
                    f"  give it one: {name} = ..."
                )
            return setting
        state = component.declarations.get(name)
        if isinstance(state, State) and np.dtype(state.field.dtype) == np.float64:
            return Parameter(
                shape=state.field.fixed_shape, unit=state.field.unit, frame=state.field.frame
            )
        numeric = [n for n, s in settings.items() if isinstance(s, Parameter)]
        numeric += [n for n, d in component.declarations.items() if isinstance(d, State)]
        raise ConfigurationError(
            f"dispersion '{self.name}' feeds '{target}', which is no numeric parameter\n"
            f"  {nearest(name, numeric, what='numeric parameters')}"
        )

    def read_spread(self, components: Mapping[str, Component], *, bare: bool = True) -> FloatArray:
        """The spread as an array in the targets' unit; ConfigurationError if it cannot be one.

        `bare` allows numbers without a unit.
        """
        parameter = self.parameter(components)
        where = f"{KINDS[self.kind]} of dispersion '{self.name}'"
        shape, unit = parameter.shape, parameter.unit
        size = int(np.prod(shape))
        if self.kind == "list":
            if not isinstance(self.spread, Sequence | np.ndarray) or not len(self.spread):
                raise ConfigurationError(
                    f"{where} is {self.spread!r}, not a list of values\n"
                    '  write values = ["1 m", "2 m"]'
                )
            one = Parameter(shape=shape, unit=unit, frame=parameter.frame)
            if isinstance(self.spread, str):
                whole = Parameter(shape=(self._count(where), *shape), unit=unit)
                return whole.read(self.spread, where=where, bare=bare)
            return np.stack([one.read(value, where=where, bare=bare) for value in self.spread])
        if self.kind == "multivariate":
            if not isinstance(unit, str):
                raise ConfigurationError(
                    f"{where}: '{self.targets[0]}' has units of its own for each element\n"
                    "  give every element a dispersion of another kind"
                )
            squared = "1" if unit in ("", "1") else f"({unit})^2"
            like = Parameter(shape=(size, size), unit=squared)
            covariance = like.read(self.spread, where=where, bare=bare)
            self._factor(covariance)
            return covariance
        if self.kind == "log_uniform":
            like = Parameter(shape=shape, unit="1")
            factor = like.read(self.spread, where=where, bare=True)
            if np.any(factor < 1.0) or not np.any(factor > 1.0):
                raise ConfigurationError(
                    f"{where} is {self.spread}; a factor of 2 means between half and twice the "
                    "value\n  give one above 1"
                )
            return factor
        if self.kind == "truncated" and not (np.isfinite(self.limit) and self.limit > 0):
            raise ConfigurationError(
                f"limit of dispersion '{self.name}' is {self.limit!r}; it is a positive number of "
                "sigma"
            )
        like = Parameter(shape=shape, unit=unit, minimum=0.0)
        spread = like.read(self.spread, where=where, bare=bare)
        if not np.any(spread > 0):
            raise ConfigurationError(
                f"{where} is zero: it would not be applied\n  give a spread, or remove it"
            )
        return spread

    def write_spread(self, components: Mapping[str, Component]) -> Any:
        """The spread as it is written in a file, with its unit."""
        spread, parameter = self.read_spread(components), self.parameter(components)
        if self.kind == "list":
            return [parameter.write(value) for value in spread]
        if self.kind == "log_uniform":
            return spread.tolist()
        if self.kind == "multivariate":
            unit = str(parameter.unit)
            squared = "1" if unit in ("", "1") else f"({unit})^2"
            return Parameter(shape=spread.shape, unit=squared).write(spread)
        return parameter.write(spread)

    def _count(self, where: str) -> int:
        text = str(self.spread)
        if not text.lstrip().startswith("["):
            raise ConfigurationError(
                f'{where} is \'{text}\', not a list of values\n  write values = ["1 m", "2 m"]'
            )
        depth, count = 0, 1
        for character in text:
            depth += (character == "[") - (character == "]")
            count += character == "," and depth == 1
        return count

    def _factor(self, covariance: FloatArray) -> FloatArray:
        """Lower Cholesky factor, after a scaling that leaves units out of the question."""
        name = f"covariance of dispersion '{self.name}'"
        if not np.allclose(covariance, covariance.T, rtol=1e-12, atol=0):
            raise ConfigurationError(f"{name} is not symmetric")
        sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        if not np.all(sigma > 0):
            raise ConfigurationError(
                f"{name} is not positive definite: its diagonal is "
                f"{np.diagonal(covariance).tolist()}"
            )
        try:
            scaled = np.linalg.cholesky(covariance / np.outer(sigma, sigma))
        except np.linalg.LinAlgError:
            smallest = np.linalg.eigvalsh(covariance / np.outer(sigma, sigma))[0]
            raise ConfigurationError(
                f"{name} is not positive definite: as correlations, its smallest eigenvalue is "
                f"{smallest:.3g}"
            ) from None
        factor: FloatArray = sigma[:, None] * scaled
        return factor

    # ------------------------------------------------------------------ draws

    def dimensions(self, components: Mapping[str, Component]) -> int:
        """How many uniform numbers a member takes."""
        if self.kind == "list":
            return 0
        return max(int(np.prod(self.parameter(components).shape)), 1)

    def apply(
        self,
        components: Mapping[str, Component],
        *,
        seed: int,
        members: NDArray[np.int64],
        uniform: FloatArray | None = None,
    ) -> FloatArray:
        """Change the bound parameters; return what was drawn, shape (n_members, *shape).

        `uniform` are the members' rows of a design, (n_members, dimensions); without it they are
        drawn from the dispersion's own stream.
        """
        spread = self.read_spread(components)
        shape = self.parameter(components).shape
        n = self.dimensions(components)
        if uniform is None and n:
            uniform = NormalStream(seed, "dispersion", self.name, members).uniform(0, n)
        drawn = self._drawn(uniform, spread, shape, members)
        for target in self.targets:
            owner, _, name = target.rpartition(".")
            component = components[owner]
            declared = component.settings().get(name)
            values = (
                component.parameter_values if declared is not None else component.state_arrays
            )[name]
            if self.kind == "list":
                values[...] = drawn
            elif self.kind == "log_uniform":
                values *= drawn
            else:
                values += drawn
            if isinstance(declared, Parameter):
                declared.check_range(values, f"'{target}' after dispersion '{self.name}'")
        return drawn

    def _drawn(
        self,
        uniform: FloatArray | None,
        spread: FloatArray,
        shape: tuple[int, ...],
        members: NDArray[np.int64],
    ) -> FloatArray:
        if self.kind == "list":
            chosen: FloatArray = spread[members % len(spread)]
            return chosen
        assert uniform is not None
        if self.kind == "multivariate":
            L = self._factor(spread)
            normal = normal_quantile(uniform)
            # element by element: a member's draw does not depend on how many others there are
            parts = (L[None, :, k] * normal[:, k, None] for k in range(len(L)))
            return sum(parts, np.zeros_like(normal)).reshape(len(members), *shape)
        u = uniform.reshape(len(members), *shape)
        if self.kind == "normal":
            return normal_quantile(u) * spread
        if self.kind == "uniform":
            return (2.0 * u - 1.0) * spread
        if self.kind == "truncated":
            from scipy.special import ndtr

            outside = float(ndtr(-self.limit))
            return normal_quantile(outside + (1.0 - 2.0 * outside) * u) * spread
        return np.asarray(spread ** (2.0 * u - 1.0), dtype=np.float64)


def apply_all(
    dispersions: Sequence[Dispersion],
    components: Mapping[str, Component],
    *,
    seed: int,
    members: NDArray[np.int64],
    runs: int,
) -> dict[str, FloatArray]:
    """Apply every dispersion to the bound parameters; return what was drawn, by name.

    `runs` is how many members there are in all, over which designs are laid out.
    """
    places: dict[str, tuple[int, int]] = {}
    totals = dict.fromkeys(DESIGNS, 0)
    for d in dispersions:
        if d.design != "random":
            n = d.dimensions(components)
            places[d.name] = (totals[d.design], n)
            totals[d.design] += n
    drawn = {}
    for d in dispersions:
        rows = None
        if d.name in places:
            if members.max() >= runs:
                raise ConfigurationError(
                    f"dispersion '{d.name}' is a {d.design} design of {runs} runs, and has no "
                    f"member {members.max()}\n  say how many runs there are in all"
                )
            start, n = places[d.name]
            rows = _design(d.design, totals[d.design], seed, runs)[members, start : start + n]
        drawn[d.name] = d.apply(components, seed=seed, members=members, uniform=rows)
    return drawn


@lru_cache(maxsize=2)
def _design(design: str, dimensions: int, seed: int, runs: int) -> FloatArray:
    """Uniform numbers of all runs, shape (runs, dimensions), inside (0, 1)."""
    from scipy.stats import qmc

    generator = np.random.default_rng(stream_key(seed, "dispersion", design))
    if design == "latin_hypercube":
        rows = qmc.LatinHypercube(dimensions, seed=generator).random(runs)
    else:
        powers = 1 << max(runs - 1, 0).bit_length()  # balanced only in powers of two
        rows = qmc.Sobol(dimensions, seed=generator).random(powers)[:runs]
    return np.clip(np.asarray(rows, dtype=np.float64), 2.0**-53, 1 - 2.0**-53)


def overridden(dispersions: Sequence[Dispersion]) -> list[ConfigurationError]:
    """What would not be applied because another dispersion sets the same parameter."""
    problems = []
    fed: dict[str, list[Dispersion]] = {}
    for d in dispersions:
        for target in d.targets:
            fed.setdefault(target, []).append(d)
    for target, several in fed.items():
        lists = [d.name for d in several if d.kind == "list"]
        if lists and len(several) > 1:
            others = [d.name for d in several if d.name != lists[0]]
            problems.append(
                ConfigurationError(
                    f"'{target}' takes its values from dispersion '{lists[0]}', and is fed by "
                    f"{', '.join(map(repr, others))} too: one of them would not be applied"
                )
            )
    return problems
