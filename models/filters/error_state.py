r"""What a filter estimates, and the coordinates of its error: blocks, one after the other.

The error :math:`e` of an estimate :math:`\hat x` is truth minus estimate, in the sense of

.. math::
    x = \hat x \oplus e, \qquad e = x \ominus \hat x,

block by block: a vector adds, :math:`x = \hat x + e`; a rotation is a unit quaternion
(`terrafix.models.geometry.quaternion`) whose error is a rotation vector :math:`\theta`, in the
axes that it leads to (left) or those that it comes from (right),

.. math::
    q = \delta q(\theta) \otimes \hat q \quad\text{or}\quad q = \hat q \otimes \delta q(\theta).

A covariance is that of :math:`e` about one estimate. About another, :math:`\hat x' = \hat x \oplus
c`, the error is :math:`e' = (\hat x \oplus e) \ominus \hat x'`, and its covariance
:math:`J P J^T` with :math:`J = \partial e' / \partial e` at :math:`e = c`: the identity for
vectors, not for rotations (`ErrorState.recentering`).

Errors of several blocks may be those of an earlier instant, carried along by a known motion
:math:`K` (`Carried`): after the age :math:`\tau`, the time since the last correction,

.. math::
    x = K_\tau\bigl(K_{-\tau}(\hat x) + K'_{-\tau}\, e\bigr), \qquad
    e = K'_\tau \bigl(K_{-\tau}(x) - K_{-\tau}(\hat x)\bigr),

with the derivatives :math:`K'` about the estimate, so that :math:`x = \hat x + e` to first order: a
covariance, its transition and the derivative of a measurement at the estimate are those of a
vector. What was normally distributed when the estimate was corrected stays so in :math:`e` as long
as nature moves by :math:`K`, however far errors grow and however they bend; on correction the age
is zero again.

References
----------
.. [1] C. Hertzberg, R. Wagner, U. Frese, L. Schroeder, "Integrating generic sensor fusion
       algorithms with sound state representations through encapsulation of manifolds",
       Information Fusion 14(1), 2013.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.core.symmetric import mirrored
from terrafix.models.geometry.quaternion import (
    IDENTITY,
    from_rotation_vector,
    inverse,
    normalized,
    product,
    rotation_vector,
)

Values = Mapping[str, Any]
"""Of the blocks by name: columns of symbols, (4, 1) of a rotation."""

SIDES = ("left", "right")
"""Of a rotation's error: in the axes it leads to, or in those it comes from."""

XYZ = ("x", "y", "z")

AGE = "age"
"""Name of the time since the last correction, where errors are carried along."""


@dataclass(frozen=True)
class Block:
    """A part of what is estimated.

    Parameters
    ----------
    name : str
        An identifier; the estimate's field, and a part of the names of its parameters.
    size : int
        Of its error.
    unit : str
        Of its error; a rotation's value has none.
    frame : str, optional
    labels : tuple of str
        Of the elements of its error; x, y, z of three, else their numbers, nothing of one.
    side : {"", "left", "right"}
        Of a rotation; empty for a vector.
    considered : bool
        It counts in every covariance, and is never corrected.
    clone_of : str
        The block of which it is a copy at an earlier instant.
    instant : str
        Name of that instant; clones of one instant share it.
    """

    name: str
    size: int = 3
    unit: str = "1"
    frame: str | None = None
    labels: tuple[str, ...] = ()
    side: str = ""
    considered: bool = False
    clone_of: str = ""
    instant: str = ""

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"'{self.name}' cannot name a block: use letters, digits, underscores")
        if self.size < 1:
            raise ValueError(f"block '{self.name}' has size {self.size}; it has 1 element or more")
        if self.labels and len(self.labels) != self.size:
            raise ValueError(
                f"block '{self.name}' has {len(self.labels)} labels for {self.size} elements"
            )

    @property
    def is_rotation(self) -> bool:
        """Whether its value is a quaternion."""
        return bool(self.side)

    @property
    def value_size(self) -> int:
        """Number of elements of its value."""
        return 4 if self.is_rotation else self.size

    @property
    def axes(self) -> tuple[str, ...]:
        """Labels of the elements of its error."""
        if self.labels:
            return self.labels
        if self.size == 1:
            return ("",)
        return XYZ if self.size == 3 else tuple(str(k + 1) for k in range(self.size))

    def plus(self, value: Any, error: Any) -> Any:
        """Retract: the value that is off by an error."""
        if not self.is_rotation:
            return value + error
        turn = from_rotation_vector(error)
        return product(turn, value) if self.side == "left" else product(value, turn)

    def minus(self, value: Any, other: Any) -> Any:
        """Difference: the error that takes `other` to `value`."""
        if not self.is_rotation:
            return value - other
        if self.side == "left":
            return rotation_vector(product(value, inverse(other)))
        return rotation_vector(product(inverse(other), value))

    def start(self) -> Any:
        """What it is where nothing is known: zero, or no rotation."""
        return ca.SX(list(IDENTITY)) if self.is_rotation else ca.SX.zeros(self.size)


def vector(
    name: str,
    size: int = 3,
    *,
    unit: str = "1",
    frame: str | None = None,
    labels: Sequence[str] = (),
) -> Block:
    """A block that adds: a position, a bias, a constant."""
    return Block(name, size, unit, frame, tuple(labels))


def rotation(name: str, *, side: str = "", frame: str | None = None) -> Block:
    """A block that is a unit quaternion; its error is a rotation vector [rad].

    Raises
    ------
    ValueError
        If the side is neither of `SIDES`.
    """
    if side not in SIDES:
        said = f"is on the side '{side}'" if side else "has no side"
        raise ValueError(
            f"the error of rotation '{name}' {said}; it is on the left (in the axes it leads to) "
            'or on the right (in those it comes from): say side="left" or side="right"'
        )
    return Block(name, 3, "rad", frame, side=side)


def considered(block: Block) -> Block:
    """The same block, in every covariance and never corrected: a Schmidt filter's."""
    return replace(block, considered=True)


def clone(block: Block, instant: str) -> Block:
    """A copy of a block at an instant, ``NAME_at_INSTANT``; it stays as it was then.

    A message named as the instant makes it, anew each time.
    """
    return replace(block, name=f"{block.name}_at_{instant}", clone_of=block.name, instant=instant)


@dataclass(frozen=True)
class Carried:
    """Vectors whose errors are those at the last correction, carried along by a motion.

    Parameters
    ----------
    blocks : tuple of str
    motion : callable
        Of their values, one below the other (n, 1), and a time [s] of either sign: their values
        after that time. It is undone by the same time backward, and near that of the process: what
        the two differ by bends what is carried.
    derivative : callable
        Likewise, the derivative (n, n) of the values after by those before.
    """

    blocks: tuple[str, ...]
    motion: Callable[[Any, Any], Any]
    derivative: Callable[[Any, Any], Any]

    def plus(self, values: Any, error: Any, age: Any) -> Any:
        """Values (n, 1) that are off by an error (n, 1)."""
        return self.motion(self._off(values, error, age), age)

    def minus(self, values: Any, others: Any, age: Any) -> Any:
        """The error (n, 1) that takes others to values, about the others."""
        then = self.motion(others, -age)
        return ca.mtimes(self.derivative(then, age), self.motion(values, -age) - then)

    def slope(self, values: Any, error: Any, age: Any) -> Any:
        """Derivative (n, n) of `plus` by the error."""
        off = self._off(values, error, age)
        return ca.mtimes(self.derivative(off, age), self.derivative(values, -age))

    def _off(self, values: Any, error: Any, age: Any) -> Any:
        """Values at the last correction, off by an error that has been carried since."""
        return self.motion(values, -age) + ca.mtimes(self.derivative(values, -age), error)


class _Values(dict[str, Any]):
    """Values by block; a name that is none is answered with those that are."""

    def __missing__(self, name: str) -> Any:
        raise ValueError(f"there is no block '{name}'; the blocks are {', '.join(self)}")


@dataclass(frozen=True)
class ErrorState:
    """Blocks in their order: what is estimated, and the coordinates of its error.

    Parameters
    ----------
    blocks : tuple of Block
    carried : Carried, optional
        Blocks whose errors are those at the last correction, carried along. An estimate then has
        an age, the time since [s]; values without one are new.

    Raises
    ------
    ValueError
        If there is none, names clash, a clone is of no block, or what is carried is no vector.
    """

    blocks: tuple[Block, ...]
    carried: Carried | None = None

    def __init__(self, *blocks: Block, carried: Carried | None = None) -> None:
        object.__setattr__(self, "blocks", tuple(blocks))
        object.__setattr__(self, "carried", carried)
        names = [block.name for block in blocks]
        if not names:
            raise ValueError("an error state has one block or more")
        names += [f"t_{instant}" for instant in self.instants]
        own = {"P", "t", AGE} if carried else {"P", "t"}
        twice = sorted({name for name in names if names.count(name) > 1} | own & set(names))
        if twice:
            raise ValueError(
                f"two things of an error state are called '{twice[0]}'; blocks have names of their "
                "own, and P is the covariance, t the time, age that since the last correction"
            )
        vectors = [b.name for b in blocks if not b.is_rotation]
        wrong = [name for name in (carried.blocks if carried else ()) if name not in vectors]
        if wrong:
            raise ValueError(
                f"'{wrong[0]}' is carried, and no vector of the error state; its vectors are "
                f"{', '.join(vectors) or 'none'}"
            )
        for block in blocks:
            of = next((b for b in blocks if b.name == block.clone_of), None)
            if block.clone_of and (of is None or of.value_size != block.value_size):
                raise ValueError(
                    f"'{block.name}' is a clone of '{block.clone_of}', which is no block like it; "
                    f"the blocks are {', '.join(b.name for b in blocks)}"
                )

    def __iter__(self) -> Iterator[Block]:
        return iter(self.blocks)

    @cached_property
    def size(self) -> int:
        """Number of elements of the error."""
        return sum(block.size for block in self.blocks)

    @cached_property
    def places(self) -> dict[str, slice]:
        """Where each block's error lies."""
        found, at = {}, 0
        for block in self.blocks:
            found[block.name] = slice(at, at + block.size)
            at += block.size
        return found

    @cached_property
    def present(self) -> ErrorState:
        """The blocks that are of now: without clones."""
        now = (block for block in self.blocks if not block.clone_of)
        return ErrorState(*now, carried=self.carried)

    @property
    def instants(self) -> tuple[str, ...]:
        """Names of the instants that clones are of."""
        return tuple(dict.fromkeys(b.instant for b in self.blocks if b.clone_of))

    @property
    def times(self) -> tuple[str, ...]:
        """Names of the times that an estimate holds: of its clones, and its age."""
        clones = tuple(f"t_{instant}" for instant in self.instants)
        return (*clones, AGE) if self.carried else clones

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all elements of the error: ``"r_e x"``."""
        return tuple(f"{b.name} {axis}".rstrip() for b in self.blocks for axis in b.axes)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each element of the error."""
        return tuple(block.unit for block in self.blocks for _ in range(block.size))

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shapes of the fields of an estimate: values, the times of clones, the covariance P."""
        values = {block.name: (block.value_size, 1) for block in self.blocks}
        times = dict.fromkeys(self.times, (1, 1))
        return values | times | {"P": (self.size, self.size)}

    def symbols(self, name: str) -> dict[str, Any]:
        """Symbols of an estimate by field, named for `name`."""
        return {k: ca.SX.sym(f"{name}_{k}", *shape) for k, shape in self.shapes.items()}

    def part(self, error: Any, name: str) -> Any:
        """Rows of a block in an error, or in a matrix of which each row is an element's."""
        place = self.places[name]
        return error[place.start : place.stop, :]

    def retract(self, values: Values, error: Any) -> dict[str, Any]:
        """Values that are off by an error (n, 1)."""
        off = _Values(
            {b.name: b.plus(values[b.name], self.part(error, b.name)) for b in self.blocks}
        )
        if self.carried and AGE in values:
            moved = self.carried.plus(
                self._along(values), error[self._carried_places, :], values[AGE]
            )
            ends = itertools.accumulate(values[n].shape[0] for n in self.carried.blocks)
            off |= zip(self.carried.blocks, ca.vertsplit(moved, [0, *ends]), strict=True)
        return off

    def _along(self, values: Values) -> Any:
        """Values of what is carried, one below the other."""
        assert self.carried is not None
        return ca.vertcat(*(values[name] for name in self.carried.blocks))

    @cached_property
    def _carried_places(self) -> list[int]:
        """Elements of the error that are carried."""
        names = self.carried.blocks if self.carried else ()
        return [k for n in names for k in range(self.places[n].start, self.places[n].stop)]

    def normalized(self, values: Values) -> dict[str, Any]:
        """Values whose quaternions are of unit length, which they lose by and by to rounding."""
        return {
            b.name: normalized(values[b.name]) if b.is_rotation else values[b.name]
            for b in self.blocks
        }

    def difference(self, values: Values, others: Values) -> Any:
        """The error (n, 1) that takes `others` to `values`, of the others' age."""
        error = ca.vertcat(*(b.minus(values[b.name], others[b.name]) for b in self.blocks))
        if self.carried and AGE in others:
            error[self._carried_places, :] = self.carried.minus(
                self._along(values), self._along(others), others[AGE]
            )
        return error

    def flat_difference(self, *values: Any) -> Any:
        """`difference` of the values of all blocks and then of the others', one by one.

        Last of all may come the others' age.
        """
        names = [block.name for block in self.blocks]
        n = len(names)
        others = dict(zip((*names, AGE), values[n:], strict=False))
        return self.difference(dict(zip(names, values[:n], strict=True)), others)

    @cached_property
    def difference_of_arrays(self) -> Callable[..., FloatArray]:
        """`flat_difference` of arrays (..., size): errors (..., n); with an age, if it has one."""
        if not self.is_curved:
            return self._subtracted
        shapes = [(block.value_size,) for block in self.blocks]
        ages = [(1,)] if self.carried else []
        found = over_members(self.flat_difference, *shapes, *shapes, *ages)

        def difference(*values: FloatArray) -> FloatArray:
            errors: FloatArray = found(*values)
            return errors if self.size > 1 else errors[..., None]

        return difference

    def _subtracted(self, *values: FloatArray) -> FloatArray:
        """`difference_of_arrays` where all blocks add."""
        n = len(self.blocks)
        one, other = (np.concatenate(part, axis=-1) for part in (values[:n], values[n:]))
        return np.asarray(one - other)

    @property
    def is_curved(self) -> bool:
        """Whether errors about two estimates differ by more than a constant."""
        return bool(self.carried) or any(block.is_rotation for block in self.blocks)

    def recentering(self, correction: Any, prior: Values | None = None) -> Any:
        """Derivative (n, n) of the error about a corrected estimate by that about the prior.

        At the correction (n, 1) itself, where the first is zero. A rotation's is that of the
        rotation vectors alone, and the same on either side but for its transpose; of what is
        carried the prior is needed, values that have an age.
        """
        parts = []
        for block in self.blocks:
            if not block.is_rotation:
                parts.append(ca.SX.eye(block.size))
                continue
            own, delta = self.part(correction, block.name), ca.SX.sym("delta", 3)
            about, off = from_rotation_vector(own), from_rotation_vector(own + delta)
            turn = rotation_vector(
                product(off, inverse(about))
                if block.side == "left"
                else product(inverse(about), off)
            )
            parts.append(ca.substitute(ca.jacobian(turn, delta), delta, ca.SX.zeros(3)))
        J = ca.diagcat(*parts)
        if self.carried and prior is not None and AGE in prior:
            own = self._carried_places  # about the corrected estimate, which is new: a sum
            J[own, own] = self.carried.slope(self._along(prior), correction[own, :], prior[AGE])
        return J

    def recentered(self, P: Any, correction: Any, prior: Values | None = None) -> Any:
        """A covariance (n, n) about the corrected estimate, from that about the prior."""
        if not self.is_curved:
            return P
        J = self.recentering(correction, prior)
        return mirrored(ca.mtimes(J, ca.mtimes(P, J.T)))

    def cloning(self, instant: str) -> Any:
        """Derivative (n, n) of the error with clones of an instant made anew by that before."""
        J = ca.SX.eye(self.size)
        for block in self.blocks:
            if block.instant == instant:
                own, of = self.places[block.name], self.places[block.clone_of]
                J[own, :] = 0
                for k in range(block.size):
                    J[own.start + k, of.start + k] = 1
        return J

    def cloned(self, values: Values, instant: str, time: Any) -> dict[str, Any]:
        """An estimate (values, ``P``) whose clones of an instant are those of now."""
        J = self.cloning(instant)
        made = dict(values)
        made |= {b.name: values[b.clone_of] for b in self.blocks if b.instant == instant}
        made["P"] = mirrored(ca.mtimes(J, ca.mtimes(mirrored(values["P"]), J.T)))
        made[f"t_{instant}"] = time
        return made

    @property
    def text(self) -> str:
        """Its blocks in a line, for records: ``"r_e 3, v_e 3, q_mu left"``."""
        return ", ".join(f"{b.name} {b.side or b.size}" for b in self.blocks)

    @classmethod
    def from_text(cls, text: str) -> ErrorState:
        """Read blocks as `text` writes them: names, sizes and sides.

        Raises
        ------
        ValueError
            If it is none.
        """
        blocks = []
        for part in text.split(","):
            name, _, kind = part.strip().partition(" ")
            if kind in SIDES:
                blocks.append(rotation(name, side=kind))
            elif kind.isdecimal():
                blocks.append(vector(name, int(kind)))
            else:
                raise ValueError(f"'{part.strip()}' is no block: a name, and a size or a side")
        return cls(*blocks)

    @property
    def kept(self) -> tuple[int, ...]:
        """Elements of the error that no measurement corrects: of considered blocks."""
        return tuple(
            k
            for b in self.blocks
            if b.considered
            for k in range(self.places[b.name].start, self.places[b.name].stop)
        )
