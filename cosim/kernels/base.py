"""What every kind of kernel has in common: its interface, and the checks when arrays are bound."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.noise import check_members

_SHARED = ("shared", "step", "time")
_KINDS = ("array", "constant", "noise", *_SHARED)


class Argument(NamedTuple):
    """One argument of the function, in order.

    `kind` is ``"array"`` (one row of `size` numbers per member), ``"constant"`` (as an array, but
    its numbers do not change between calls), ``"shared"`` (one row for all), ``"step"`` and
    ``"time"`` (one number for all: the length of the step, the time at its end), or ``"noise"``
    (standard normals drawn by the kernel, for which no array is bound).
    """

    name: str
    size: int
    kind: str


class Result(NamedTuple):
    """One result of the function, in order: one row of `size` numbers per member."""

    name: str
    size: int


class Specification(NamedTuple):
    """What a kernel is built from: the arguments of `build_kernel`."""

    function: Any
    arguments: Sequence[Argument]
    results: Sequence[Result]


class BoundKernel(ABC):
    """A kernel with the arrays it reads and writes."""

    @abstractmethod
    def __call__(self, step: int) -> int:
        """Step all active members; return how many failed now.

        `step` is the number under which noise is drawn, a 64-bit integer of either sign.
        """


@dataclass(frozen=True)
class BoundArrays:
    """What `Kernel.bind` was given, checked: views of shape (n_members or 1, size), no copies."""

    arguments: Mapping[str, FloatArray]
    results: Mapping[str, FloatArray]
    members: NDArray[np.int64]
    noise_keys: Mapping[str, int]
    active: NDArray[np.uint8]
    failed: NDArray[np.uint8]


class Kernel(ABC):
    """The step of one symbolic component for whole ensembles.

    Attributes
    ----------
    kind : str
        ``"vector"``, ``"c"`` or ``"vm"``.
    note : str
        One line for the user if the kernel is not of the kind that was hoped for, else empty.
    """

    kind: str
    note: str = ""

    def __init__(self, specification: Specification) -> None:
        function, arguments, results = specification
        self.name = str(function.name())
        self.function = function
        self.arguments = tuple(Argument(*argument) for argument in arguments)
        self.results = tuple(Result(*result) for result in results)
        self._check_function()

    def _check_function(self) -> None:
        function = self.function
        declared = [[(a.size, 1) for a in self.arguments], [(r.size, 1) for r in self.results]]
        actual = [
            [function.size_in(i) for i in range(function.n_in())],
            [function.size_out(i) for i in range(function.n_out())],
        ]
        if declared != actual:
            raise ValueError(
                f"kernel '{self.name}': declared {declared}, the function has {actual}"
            )
        sparse = [i for i in range(function.n_in()) if not function.sparsity_in(i).is_dense()]
        sparse += [i for i in range(function.n_out()) if not function.sparsity_out(i).is_dense()]
        if sparse:
            raise ValueError(f"kernel '{self.name}': sparse columns; densify them")
        for argument in self.arguments:
            if argument.kind not in _KINDS:
                raise ValueError(
                    f"kernel '{self.name}': argument '{argument.name}' is of kind "
                    f"'{argument.kind}'; the kinds are {', '.join(_KINDS)}"
                )

    @property
    def noise(self) -> tuple[Argument, ...]:
        """The arguments that the kernel draws."""
        return tuple(a for a in self.arguments if a.kind == "noise")

    def bind(
        self,
        n_members: int,
        arrays: Mapping[str, FloatArray],
        results: Mapping[str, FloatArray],
        *,
        members: NDArray[np.int64],
        noise_keys: Mapping[str, int],
        active: NDArray[np.uint8] | NDArray[np.bool_],
        failed: NDArray[np.uint8],
    ) -> BoundKernel:
        """Bind the arrays; they are read and written in place from then on, never copied.

        Parameters
        ----------
        n_members : int
            Members in the ensemble, N.
        arrays : mapping of str to ndarray of float64
            Per argument, shape (N, ...) with `size` numbers per member, each member's contiguous;
            the members may be apart (fields of a record). A shared argument has no first axis,
            or one of length 1.
        results : mapping of str to ndarray of float64
            As above. A result may be the array of an argument, member for member.
        members : ndarray of int64, shape (N,)
            Identities of the members, which their noise depends on.
        noise_keys : mapping of str to int
            Per noise argument, `terrafix.cosim.basics.noise.stream_key` of its stream.
        active : ndarray of uint8 or bool, shape (N,)
            Members to step; read at each call.
        failed : ndarray of uint8, shape (N,)
            Members that failed: set to 1 by the kernel, cleared by the caller. They are not
            stepped.

        Raises
        ------
        ValueError
            If something is missing, or is not of its type, shape or layout.
        """
        bound = BoundArrays(
            {
                a.name: self._rows(arrays, a.name, a.size, 1 if a.kind in _SHARED else n_members)
                for a in self.arguments
                if a.kind != "noise"
            },
            {r.name: self._rows(results, r.name, r.size, n_members) for r in self.results},
            check_members(members),
            {a.name: noise_keys[a.name] for a in self.noise if a.name in noise_keys},
            self._mask(active, "active", n_members),
            self._mask(failed, "failed", n_members),
        )
        missing = [a.name for a in self.noise if a.name not in noise_keys]
        if missing:
            raise ValueError(f"kernel '{self.name}': no noise key for {missing}")
        for name, rows in bound.results.items():
            if not rows.flags.writeable:
                raise ValueError(f"kernel '{self.name}': result '{name}' is read-only")
        if bound.members.shape != (n_members,):
            raise ValueError(
                f"kernel '{self.name}': {n_members} members, {bound.members.shape} identities"
            )
        return self._bind(bound)

    @abstractmethod
    def _bind(self, arrays: BoundArrays) -> BoundKernel: ...

    def _rows(
        self, arrays: Mapping[str, FloatArray], name: str, size: int, n_rows: int
    ) -> FloatArray:
        if name not in arrays:
            raise ValueError(f"kernel '{self.name}': no array for '{name}'")
        array = arrays[name]
        fits = array.dtype == np.float64 and array.size == n_rows * size
        fits = fits and (n_rows == 1 or array.shape[0] == n_rows)
        rows = array.reshape(n_rows, size) if fits else array
        if not fits or not np.may_share_memory(rows, array):
            raise ValueError(
                f"kernel '{self.name}': array '{name}' has shape {array.shape}, strides "
                f"{array.strides} and type {array.dtype}; needed are {n_rows} rows of {size} "
                "contiguous float64"
            )
        row_stride, stride = rows.strides
        if (size > 1 and stride != 8) or row_stride % 8 or not rows.flags.aligned:
            raise ValueError(
                f"kernel '{self.name}': the rows of array '{name}' are not contiguous and aligned"
            )
        return rows

    def _mask(self, mask: NDArray[Any], name: str, n_members: int) -> NDArray[np.uint8]:
        if mask.shape != (n_members,) or mask.itemsize != 1 or not mask.flags.c_contiguous:
            raise ValueError(
                f"kernel '{self.name}': '{name}' has shape {mask.shape} and type {mask.dtype}; "
                f"needed are {n_members} contiguous bytes or booleans"
            )
        return mask.view(np.uint8)
