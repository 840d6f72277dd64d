"""Ensemble kernels: one call steps every member of one symbolic component.

A kernel is built from a function of flat columns, in CasADi's calling convention, and bound to
the arrays it works on. Calling what was bound draws the noise of that step, evaluates the
function for every active member and writes the results of those whose results are all finite; a
member that fails keeps its old values, is marked, and is not stepped again while the mark stands.

There are two kinds with the same meaning: ``"c"``, the function's C compiled together with the
driver ``kernel.c``, and ``"vm"``, CasADi's virtual machine, where no compiler works. They agree
to the last bit on arithmetic and square roots, noise included, and to the accuracy of the
mathematical library on the rest. Callers need not know which they hold.
"""

from __future__ import annotations

import ctypes
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from terrafix.cosim import toolchain
from terrafix.cosim.errors import ConfigurationError
from terrafix.cosim.noise import NormalBlocks, NormalStream, check_members
from terrafix.cosim.toolchain import CompilationError

FloatArray = NDArray[np.float64]
_KINDS = ("array", "noise", "shared")
_DRAWN_AT_ONCE = 2048  # pairs of normals: 32 kB of scratch
_LANES = 4  # ciphers side by side: with more, one member alone pays for numbers it does not use


class Argument(NamedTuple):
    """One argument of the function, in order.

    `kind` is ``"array"`` (one row of `size` numbers per member), ``"shared"`` (one row for all)
    or ``"noise"`` (standard normals drawn by the kernel, for which no array is bound).
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
class _Arrays:
    """Checked views of what is bound: rows of shape (n_members or 1, size), no copies."""

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
        ``"c"`` or ``"vm"``.
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
            raise ValueError(f"kernel '{self.name}': declared {declared}, the function has {actual}")
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
            Per noise argument, `terrafix.cosim.noise.stream_key` of its stream.
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
        bound = _Arrays(
            {
                a.name: self._rows(arrays, a.name, a.size, 1 if a.kind == "shared" else n_members)
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
    def _bind(self, arrays: _Arrays) -> BoundKernel: ...

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


def build_kernel(
    function: Any, arguments: Sequence[Argument], results: Sequence[Result]
) -> Kernel:
    """Build one kernel; see `build_kernels`."""
    return build_kernels([Specification(function, arguments, results)])[0]


def build_kernels(
    specifications: Sequence[Specification],
    progress: Callable[[int, int], None] | None = None,
) -> list[Kernel]:
    """Build several kernels, compiling those that are not in the cache side by side.

    Parameters
    ----------
    specifications : sequence of Specification
        Function, arguments and results of each. The function is a CasADi function of dense
        columns; its name must not be that of a C keyword or function.
    progress : callable, optional
        Called with (sources done, sources in all) as compilations end.

    Raises
    ------
    ConfigurationError
        If ``TERRAFIX_KERNEL`` is wrong, or is ``c`` and compilation fails.
    ValueError
        If a declaration does not fit its function.
    """
    virtual: list[Kernel] = [VirtualMachineKernel(s) for s in specifications]
    if toolchain.find_compiler() is None:
        return virtual
    sources = [_source(kernel) for kernel in virtual]
    distinct = list(dict.fromkeys(sources))
    loaded: dict[str, ctypes.CDLL | CompilationError] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        futures = {pool.submit(toolchain.load, source): source for source in distinct}
        for future in as_completed(futures):
            try:
                loaded[futures[future]] = future.result()
            except CompilationError as error:
                if toolchain.compilation_required():
                    raise ConfigurationError(
                        f"TERRAFIX_KERNEL=c asks for compiled kernels, which cannot be had: {error}"
                    ) from error
                loaded[futures[future]] = error
            if progress:
                progress(len(loaded), len(distinct))
    kernels: list[Kernel] = []
    for specification, kernel, source in zip(specifications, virtual, sources, strict=True):
        library = loaded[source]
        if isinstance(library, CompilationError):
            kernel.note = f"kernel '{kernel.name}': CasADi virtual machine ({library})"
            kernels.append(kernel)
        else:
            kernels.append(CompiledKernel(specification, library))
    return kernels


# ------------------------------------------------------------------------------------ compiled C


@cache
def _driver() -> str:
    return Path(__file__).with_name("kernel.c").read_text()


def _pairs(argument: Argument) -> int:
    return (argument.size + 1) // 2


def _chunk(noise: Sequence[Argument]) -> int:
    """Members whose noise is drawn at once."""
    return min(64, max(1, _DRAWN_AT_ONCE // max(1, sum(map(_pairs, noise)))))


def _source(kernel: Kernel) -> str:
    """C of the function, generated by CasADi, followed by the driver."""
    import casadi as ca

    generator = ca.CodeGenerator("model.c", {"with_header": False})
    generator.add(kernel.function)
    position = {argument.name: i for i, argument in enumerate(kernel.arguments)}
    definitions = {
        "TERRAFIX_FUNCTION": kernel.name,
        "N_ARGUMENTS": len(kernel.arguments),
        "N_RESULTS": len(kernel.results),
        "N_NOISE": len(kernel.noise),
        "N_NEXT": sum(r.size for r in kernel.results),
        "RESULT_SIZES": "".join(f"{r.size}, " for r in kernel.results),
        "NOISE_ARGUMENTS": "".join(f"{position[a.name]}, " for a in kernel.noise),
        "NOISE_SIZES": "".join(f"{a.size}, " for a in kernel.noise),
        "SZ_ARG": kernel.function.sz_arg(),
        "SZ_RES": kernel.function.sz_res(),
        "CHUNK": _chunk(kernel.noise),
        "LANES": _LANES,
    }
    lines = ["#define CASADI_SYMBOL_EXPORT static", generator.dump()]
    lines += [f"#define {name} {value}".rstrip() for name, value in definitions.items()]
    return "\n".join([*lines, _driver()])


def _structure(kernel: Kernel) -> type[ctypes.Structure]:
    """``struct binding`` of ``kernel.c``."""
    n_arguments, n_results = len(kernel.arguments) + 1, len(kernel.results) + 1

    class Structure(ctypes.Structure):
        _fields_ = (
            ("step", ctypes.c_int64),
            ("n_members", ctypes.c_int64),
            ("members", ctypes.c_void_p),
            ("active", ctypes.c_void_p),
            ("failed", ctypes.c_void_p),
            ("iw", ctypes.c_void_p),
            ("w", ctypes.c_void_p),
            ("next", ctypes.c_void_p),
            ("noise", ctypes.c_void_p),
            ("argument", ctypes.c_void_p * n_arguments),
            ("argument_stride", ctypes.c_int64 * n_arguments),
            ("result", ctypes.c_void_p * n_results),
            ("result_stride", ctypes.c_int64 * n_results),
            ("noise_key", ctypes.c_uint64 * (len(kernel.noise) + 1)),
        )

    return Structure


class CompiledKernel(Kernel):
    """The function's C behind the driver ``kernel.c``, in a shared library."""

    kind = "c"

    def __init__(self, specification: Specification, library: ctypes.CDLL) -> None:
        super().__init__(specification)
        self._structure = _structure(self)
        self._library = library

    def _bind(self, arrays: _Arrays) -> BoundKernel:
        function, noise = self.function, self.noise
        scratch = {
            "iw": np.zeros(function.sz_iw() + 1, dtype=np.int64),
            "w": np.zeros(function.sz_w() + 1),
            "next": np.zeros(sum(r.size for r in self.results) + 1),
            "noise": np.zeros(sum(2 * (_pairs(a) * _chunk(noise) + _LANES) for a in noise) + 1),
            "members": arrays.members,
            "active": arrays.active,
            "failed": arrays.failed,
        }
        binding: Any = self._structure(n_members=len(arrays.members))
        for name, array in scratch.items():
            setattr(binding, name, array.ctypes.data)
        for i, argument in enumerate(self.arguments):
            if argument.kind != "noise":
                rows = arrays.arguments[argument.name]
                binding.argument[i] = rows.ctypes.data
                binding.argument_stride[i] = 0 if len(rows) == 1 else rows.strides[0] // 8
        for i, rows in enumerate(arrays.results.values()):
            binding.result[i] = rows.ctypes.data
            binding.result_stride[i] = rows.strides[0] // 8
        for i, argument in enumerate(noise):
            binding.noise_key[i] = arrays.noise_keys[argument.name]
        return _CompiledBinding(self._library, binding, (arrays, scratch))


class _CompiledBinding(BoundKernel):
    def __init__(self, library: ctypes.CDLL, binding: Any, kept: object) -> None:
        # no argument types: checking them would double the cost of a call, hence also the step
        # number in the structure, where it has 64 bits
        self._step = library["terrafix_step"]
        self._step.restype = ctypes.c_int64
        self._binding = binding
        self._reference = ctypes.byref(binding)
        self._kept = kept

    def __call__(self, step: int) -> int:
        self._binding.step = step
        failed: int = self._step(self._reference)
        return failed


# ------------------------------------------------------------------------- the virtual machine


class VirtualMachineKernel(Kernel):
    """The function interpreted by CasADi, one buffered call per member."""

    kind = "vm"

    def _bind(self, arrays: _Arrays) -> BoundKernel:
        return _VirtualMachineBinding(self, arrays)


class _VirtualMachineBinding(BoundKernel):
    def __init__(self, kernel: Kernel, arrays: _Arrays) -> None:
        n_members = len(arrays.members)
        self._kept = arrays
        self._active = arrays.active
        self._failed = arrays.failed
        rows = dict(arrays.arguments)
        self._noise = []
        for argument in kernel.noise:
            stream = NormalStream.from_key(arrays.noise_keys[argument.name], arrays.members)
            rows[argument.name] = np.zeros((n_members, argument.size))
            self._noise.append((rows[argument.name], NormalBlocks(stream, argument.size)))
        self._next = np.zeros((n_members, sum(r.size for r in kernel.results)))
        ends = np.cumsum([0, *(r.size for r in kernel.results)])
        self._columns = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        self._copies = [
            (target, self._next[:, columns])
            for target, columns in zip(arrays.results.values(), self._columns, strict=True)
        ]
        self._buffers = []  # kept, because what evaluates them does not keep them
        self._evaluations = []
        for member in range(n_members):
            buffer, evaluate = kernel.function.buffer()
            for i, argument in enumerate(kernel.arguments):
                row = 0 if argument.kind == "shared" else member
                buffer.set_arg(i, memoryview(rows[argument.name][row]))
            for i, columns in enumerate(self._columns):
                buffer.set_res(i, memoryview(self._next[member, columns]))
            self._buffers.append(buffer)
            self._evaluations.append(evaluate)

    def __call__(self, step: int) -> int:
        for drawn, blocks in self._noise:
            drawn[:] = blocks.draw(step)
        chosen = (self._active != 0) & (self._failed == 0)
        self._next.fill(np.nan)  # stands where nothing is computed: inactive members, failures
        for member in chosen.nonzero()[0].tolist():
            self._evaluations[member]()
        good = np.isfinite(self._next).all(axis=1)
        for target, source in self._copies:
            np.copyto(target, source, where=good[:, None])
        bad = chosen & ~good
        self._failed[bad] = 1
        return int(bad.sum())
