"""Acquisition: a filter that starts lost is told where it is, once particles have found it.

A filter's own is a class of a few lines, as its `predict`:

    class Acquire(FilterAcquisition):
        error_state, process, observation, told = STATE, PROCESS, RANGE, ("r", "v")

The last known state goes to the ``start`` of both, the fix to both, and ``acquired`` to the
``restart`` of `predict`. It steps at t = 0 and at a rate at which its process is right: where that
reads increments, at that of the increments.

A member whose fix no particle explains fails: to start anew from a prior of long ago would need the
process to be run again from there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from terrafix.components.filters.family import (
    declare,
    estimate_fields,
    fix_fields,
    says,
    start_fields,
    starting_sigmas,
)
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.component import Component, Environment
from terrafix.cosim.declare.parameters import Count, Parameter
from terrafix.cosim.declare.ports import (
    BundleOutput,
    MessageInput,
    MessageOutput,
    Output,
    State,
)
from terrafix.models.filters.error_state import Block, ErrorState
from terrafix.models.filters.measurement import SAME_INSTANT, Observation
from terrafix.models.filters.particles import Cloud, Particles
from terrafix.models.filters.process import Process
from terrafix.models.geometry.quaternion import IDENTITY

NOTHING = "no particle explains the fix: nothing is finite, or its R is not positive definite"


class FilterAcquisition(Component):
    """Particles from a wide prior, which tell a filter its state once they have found it: base.

    Acquired is a member just after a fix if, for every block that a largest sigma is given of, the
    standard deviation in the direction where it is largest is no larger, and if every part of that
    fix left enough effective particles. Then ``acquired`` is published, once, and it rests.

    Attributes
    ----------
    error_state : ErrorState
        Blocks of now are particles; clones are left out. A considered block is not held back: it is
        as uncertain as what was measured leaves it.
    process : Process
    observation : Observation
        Symbolic, of now; without gate: the noise that it reports is taken at its word.
    told : tuple of str
        Blocks that ``start`` tells and ``acquired`` tells anew; the others start at zero, with a
        sigma.
    sigmas : dict of str to str
        Of the others: the parameter that holds it, ``NAME_sigma0`` unless said otherwise.
    linear : tuple of str
        Blocks that process and observation are nearly linear in, such as a velocity or a bias: they
        need no particles of their own (`terrafix.models.filters.particles`).
    """

    error_state: ClassVar[ErrorState]
    process: ClassVar[Process]
    observation: ClassVar[Observation]
    told: ClassVar[tuple[str, ...]] = ()
    sigmas: ClassVar[dict[str, str]] = {}
    linear: ClassVar[tuple[str, ...]] = ()
    start: Any
    fix: Any
    acquired: Any
    estimate: Any
    _particles: ClassVar[Particles]

    n_particles = Count(2000, minimum=2, doc="particles of a member")
    effective_part = Parameter(
        0.1, minimum=0.0, maximum=1.0, doc="of the particles, least that is enough"
    )
    effective = Output(doc="effective number of particles, the least that the last fix left")
    is_acquired = Output(doc="1 from when it was acquired, else 0")
    resting = State(dtype=np.bool_, start=False, doc="whether it was acquired")

    def __init_subclass__(cls, **options: Any) -> None:
        if says(cls, "error_state", "observation", "told"):
            state = cls.error_state.present
            _check_told(cls, state)
            cls._particles = Particles(state, cls.process, cls.observation, cls.linear)
            start = start_fields(state, cls.told)
            ports: dict[str, Any] = {
                "start": MessageInput(
                    fields=start, needed_at_start=True, doc="wide prior at t = 0"
                ),
                "fix": MessageInput(fields=fix_fields(cls.observation), doc="the fix"),
                "acquired": MessageOutput(fields=start, doc="state to begin anew from, once"),
                "estimate": BundleOutput(
                    estimate_fields(state), doc="mean of the particles, and its covariance"
                ),
            }
            for block in state:
                if block.name in cls.told:
                    ports[f"{block.name}_spread"] = Output(
                        unit=block.unit, doc="sigma in the direction where it is largest"
                    )
                    ports[f"{block.name}_acquired"] = Parameter(
                        np.inf,
                        unit=block.unit,
                        positive=True,
                        infinite=True,
                        doc="largest sigma when acquired, in any direction; infinity: any",
                    )
            declare(cls, **ports)
        super().__init_subclass__(**options)

    @property
    def _sigmas(self) -> dict[str, str]:
        """Parameters of the sigmas of blocks that are not told."""
        return starting_sigmas(self.error_state, self.told, self.sigmas)

    def validate(self) -> None:
        """Check that what process and observation read is declared, and that it can end."""
        process, seen = self.process, self.observation
        known: dict[str, Mapping[str, Any]] = {
            "input": self.inputs(),
            "parameter": self.settings(),
        }
        for reader, kind, names in (
            ("process", "input", process.inputs),
            ("process", "parameter", process.named()),
            ("observation", "input", seen.inputs),
            ("observation", "parameter", seen.parameters),
            ("start", "parameter", dict.fromkeys(self._sigmas.values())),
        ):
            for name in names:
                if name not in known[kind]:
                    raise ConfigurationError(
                        f"the {reader} of {type(self).__name__} reads '{name}', which is no {kind} "
                        f"of it\n  {nearest(name, known[kind], what=f'its {kind}s')}"
                    )
        asked = [f"{name}_acquired" for name in self.told]
        if not any(np.isfinite(self.given_parameters[name]).any() for name in asked):
            raise ConfigurationError(
                f"'{self.name}' would count as acquired whatever its sigma: {', '.join(asked)} "
                "are infinite\n  set one of them"
            )
        if not self.publishes_at_start:
            raise ConfigurationError(
                f"'{self.name}' takes its prior at t = 0, and does not step then: its rate has an "
                "offset\n  give it one without"
            )

    # ------------------------------------------------------------------ life cycle

    def bind(self, environment: Environment) -> None:
        """Get arrays for the particles, as states."""
        super().bind(environment)
        k, n_particles = environment.n_members, self.n_particles
        state, n = self.error_state.present, self.error_state.present.size
        shapes: dict[str, tuple[int, ...]] = {
            f"particles:{b.name}": (n_particles, b.value_size) for b in state
        }
        shapes |= {"kernels": (n_particles, n, n), "weights": (n_particles,)}
        self.state_arrays |= {name: np.zeros((k, *shape)) for name, shape in shapes.items()}

    @property
    def _cloud(self) -> Cloud:
        """The particles of all members, where they are kept."""
        arrays = self.state_arrays
        values = {b.name: arrays[f"particles:{b.name}"] for b in self.error_state.present}
        return Cloud(values, arrays["kernels"], arrays["weights"])

    def _initialize_impl(self) -> None:
        self.fail(~self.start.fresh, "no 'start' was received at t = 0")
        state, n_members = self.error_state.present, self.n_members
        self.is_acquired, self.effective = 0.0, float(self.n_particles)
        who = np.flatnonzero(self.environment.active)
        if not len(who):
            return
        P = np.zeros((n_members, state.size, state.size))
        place = state.places
        rows: list[int] = []
        values: dict[str, FloatArray] = {}
        for block in state:
            if block.name in self.told:
                values[block.name] = getattr(self.start, block.name)
                rows += range(place[block.name].start, place[block.name].stop)
            else:
                values[block.name] = np.tile(_zero(block), (n_members, 1))
                for k in range(place[block.name].start, place[block.name].stop):
                    sigma = self.parameter_values[self._sigmas[block.name]]
                    P[:, k, k] = sigma.reshape(n_members) ** 2
        P[np.ix_(range(n_members), rows, rows)] = self.start.P
        draws = self._draws("start")
        self._cloud.put(
            who,
            self._particles.drawn({n: v[who] for n, v in values.items()}, P[who], draws[who]),
        )
        self._weigh_fix(0.0, who)
        self._tell(0.0, who)

    def _step_impl(self, t: float, dt: float) -> None:
        who = np.flatnonzero(self.environment.active & ~self.resting)
        if not len(who):
            return
        process = self.process
        given = self._given(who, process.inputs, process.named())
        draws = self._draws("process")[who]
        moved = self._particles.moved(self._cloud.of(who), given, dt, t, draws)
        self._cloud.put(who, moved)
        self._weigh_fix(t, who)
        self._tell(t, who)

    def _weigh_fix(self, t: float, who: NDArray[np.int64]) -> None:
        """Weigh the fixes of this instant."""
        fix, seen = self.fix, self.observation
        self._weighed = np.zeros(self.n_members, dtype=np.bool_)
        now = fix.fresh & (np.abs(fix.t - t) <= SAME_INSTANT)
        now &= np.where(now[:, None], fix.present > 0.5, False).any(axis=1)
        who = who[now[who]]
        if not len(who):
            return
        cloud = self._cloud.of(who)
        effective, explained = self._particles.weighed(
            cloud,
            {name: getattr(fix, name)[who] for name in seen.shapes()},
            self._given(who, seen.inputs, seen.parameters),
            lambda trial: self._draws(f"kernels {trial}")[who],
            lambda trial: ndtr(self.normals(f"resampling {trial}", 1)[who, 0]),
        )
        self._cloud.put(who, cloud)
        self.effective[who] = effective
        failed = np.zeros(self.n_members, dtype=np.bool_)
        failed[who[~explained]] = True
        self.fail(failed, NOTHING)
        self._weighed[who[explained]] = True

    def _tell(self, t: float, who: NDArray[np.int64]) -> None:
        """Publish what the particles say, and the start where it is acquired."""
        state = self.error_state.present
        mean, P = self._particles.moments(self._cloud.of(who))
        for name, value in (*mean.items(), ("P", P)):
            getattr(self.estimate, name)[who] = value
        found = self._weighed[who]
        found &= self.effective[who] >= self.effective_part[who] * self.n_particles
        rows: list[int] = []
        for block in state:
            if block.name not in self.told:
                continue
            place = state.places[block.name]
            rows += range(place.start, place.stop)
            largest = np.linalg.eigvalsh(P[:, place, place])[:, -1]
            spread = np.sqrt(np.maximum(largest, 0.0))
            self.port_views[f"{block.name}_spread"][who] = spread
            found &= spread <= self.parameter_values[f"{block.name}_acquired"][who]
        if found.any():
            done = np.zeros(self.n_members, dtype=np.bool_)
            done[who[found]] = True
            told = {n: getattr(self.estimate, n) for n in self.told}
            told["P"] = self.estimate.P[:, rows][:, :, rows]
            self.acquired.publish(t, valid=done, **told)
            self.resting |= done
            self.is_acquired[done] = 1.0

    def _given(
        self, who: NDArray[np.int64], inputs: Mapping[str, int], parameters: Mapping[str, int]
    ) -> dict[str, FloatArray]:
        """Rows of inputs and parameters."""
        found = {n: self.port_views[n] for n in inputs}
        found |= {n: self.parameter_values[n] for n in parameters}
        return {n: array[who].reshape(len(who), -1) for n, array in found.items()}

    def _draws(self, stream: str) -> FloatArray:
        """Draws for the errors of all particles, (n_members, N, n); not kept for later steps."""
        n_particles, n = self.n_particles, self.error_state.present.size
        found = self.normals(stream, n_particles * n).reshape(self.n_members, n_particles, n)
        self._streams.pop((stream, n_particles * n), None)
        return found


def _check_told(cls: type[FilterAcquisition], state: ErrorState) -> None:
    """Raise ValueError if what is told does not fit the error state."""
    names = [block.name for block in state]
    if not cls.told:
        raise ValueError(
            f"{cls.__name__} tells nothing: name in `told` the blocks that its filter is told; the "
            f"blocks are {', '.join(names)}"
        )
    for kind, given in (("told", cls.told), ("sigmas", cls.sigmas)):
        for name in given:
            if name not in names:
                raise ValueError(
                    f"{cls.__name__}.{kind} names '{name}', which is no block of its error state; "
                    f"the blocks are {', '.join(names)}"
                )


def _zero(block: Block) -> FloatArray:
    """Value of a block of which nothing is known."""
    return np.array(IDENTITY if block.is_rotation else [0.0] * block.size)
