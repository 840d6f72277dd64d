"""Kernels of vectors, members as lanes: C of our own from the function's instructions.

CasADi's instructions of an SX function are straight-line code without branches. Each becomes one
operation on vectors. What depends on nothing but parameters and the length of the step is
computed once per call (`prepare`), the rest at every step (`advance`). ``lanes.c`` says what the
operations are, ``tile.c`` steps a tile of members, ``stretch.c`` gathers tiles and scatters them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from terrafix.cosim.kernels.base import BoundArrays, BoundKernel, Kernel, Specification
from terrafix.cosim.kernels.compiled import EXPORT
from terrafix.cosim.kernels.stretch import Stage, Stretch
from terrafix.cosim.kernels.toolchain import c_source

_INFIX = {"OP_ADD": "+", "OP_SUB": "-", "OP_MUL": "*", "OP_DIV": "/"}
_COMPARISONS = {"OP_LT": "<", "OP_LE": "<=", "OP_EQ": "==", "OP_NE": "!="}
_OWN = {
    "OP_ASSIGN": "{0}",
    "OP_NEG": "-{0}",
    "OP_SQ": "{0} * {0}",
    "OP_TWICE": "{0} + {0}",
    "OP_INV": "1.0 / {0}",
    "OP_SQRT": "SQUARE_ROOT({0})",
    "OP_FABS": "absolute({0})",
    "OP_SIGN": "sign({0})",
    "OP_COPYSIGN": "copy_sign({0}, {1})",
    "OP_NOT": "TRUTH({0} == SPLAT(0.0))",
    "OP_AND": "TRUTH(IS_TRUE({0}) & IS_TRUE({1}))",
    "OP_OR": "TRUTH(IS_TRUE({0}) | IS_TRUE({1}))",
    "OP_IF_ELSE_ZERO": "MASKED(IS_TRUE({0}), {1})",
}
_LIBRARY = {
    1: "exp log sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil erf log1p "
    "expm1",
    2: "pow fmod fmin fmax atan2 hypot remainder",
}
_CALLS = {f"OP_{name.upper()}": (name, n) for n, all_ in _LIBRARY.items() for name in all_.split()}
_CALLS["OP_CONSTPOW"] = ("pow", 2)


class NoVectorsError(Exception):
    """A function that cannot be turned into vector code; the text says why."""


@cache
def _operations() -> dict[int, str]:
    import casadi as ca

    return {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}


@cache
def _texts() -> tuple[str, str]:
    before = EXPORT + "#define LANES 4\n"
    before += "\n".join(map(c_source, ("noise.c", "lanes.c")))
    return before, c_source("tile.c")


def _expression(operation: str, operands: list[str], guard: str | None) -> str:
    if operation in _INFIX:
        return f"{operands[0]} {_INFIX[operation]} {operands[1]}"
    if operation in _COMPARISONS:
        return f"TRUTH({operands[0]} {_COMPARISONS[operation]} {operands[1]})"
    if operation in _OWN:
        return _OWN[operation].format(*operands)
    if operation in _CALLS:
        name, n = _CALLS[operation]
        macro = "EACH" if n == 1 else "EACH_PAIR"
        if guard is not None:
            return f"{macro}_IF(IS_TRUE({guard}), {name}, {', '.join(operands)})"
        return f"{macro}({name}, {', '.join(operands)})"
    raise NoVectorsError(f"it uses {operation}")


def _literal(value: float) -> str:
    if value != value:  # NaN
        return "SPLAT(NAN)"
    if value in (float("inf"), float("-inf")):
        return f"SPLAT({'-' if value < 0 else ''}INFINITY)"
    return f"SPLAT({value.hex()})"


class _Instruction(NamedTuple):
    """One instruction in static single assignment: operands are numbers of instructions."""

    operation: str
    operands: tuple[int, ...]
    place: tuple[int, int]  # of an input or output: which, and which element
    constant: float


def _instructions(function: Any) -> list[_Instruction]:
    written: dict[int, int] = {}  # register to the instruction that wrote it last
    found = []
    for number in range(function.n_instructions()):
        operation = _operations()[function.instruction_id(number)]
        inputs = function.instruction_input(number)
        outputs = function.instruction_output(number)
        place, constant = (0, 0), 0.0
        operands: tuple[int, ...] = ()
        if operation == "OP_INPUT":
            place = (inputs[0], inputs[1])
        elif operation == "OP_CONST":
            constant = function.instruction_constant(number)
        else:
            n = _CALLS[operation][1] if operation in _CALLS else len(inputs)
            operands = tuple(written[i] for i in inputs[:n])
        if operation == "OP_OUTPUT":
            place = (outputs[0], outputs[1])
        else:
            written[outputs[0]] = number
        found.append(_Instruction(operation, operands, place, constant))
    return found


def _guards(instructions: list[_Instruction]) -> dict[int, int]:
    """By instruction, the condition without which nobody looks at its result, where there is one.

    A branch of ``if_else`` costs a call of the mathematical library even where no member takes it.
    """
    always = -1
    guard: dict[int, int] = {}
    for number in range(len(instructions) - 1, -1, -1):
        operation, operands, _, _ = instructions[number]
        own = always if operation == "OP_OUTPUT" else guard.get(number, always)
        for position, operand in enumerate(operands):
            branch = operation == "OP_IF_ELSE_ZERO" and position == 1
            needed = operands[0] if branch else own
            guard[operand] = needed if guard.get(operand, needed) == needed else always
    return {number: needed for number, needed in guard.items() if 0 <= needed < number}


class _Writer:
    """The lines of the functions that are generated."""

    def __init__(self, function: Any, kinds: Sequence[str]) -> None:
        self._constant = [kind in ("constant", "step") for kind in kinds]
        self.prepare: list[str] = []
        self.advance: list[str] = []
        self.publish: list[list[str]] = [[] for _ in range(function.n_out())]
        self.invariants: dict[str, int] = {}
        self.next: dict[str, int] = {}  # different results, in order
        self.used: set[tuple[int, int]] = set()  # elements of arguments
        self._values: dict[int, tuple[str, bool]] = {}  # text, and whether it is invariant
        self._loaded: set[int] = set()
        instructions = _instructions(function)
        self._guards = _guards(instructions)
        for number, instruction in enumerate(instructions):
            self._write(number, instruction)

    def _write(self, number: int, instruction: _Instruction) -> None:
        operation, operands, (which, element), constant = instruction
        if operation == "OP_OUTPUT":
            text = self._variant(operands[0])
            if text not in self.next:
                self.advance.append(f"next[{len(self.next)}] = {text};")
            place = self.next.setdefault(text, len(self.next))
            self.publish[which].append(f"PUT({which}, {element}, {place})")
        elif operation == "OP_CONST":
            self._values[number] = (_literal(constant), True)
        elif operation == "OP_INPUT":
            self.used.add((which, element))
            self._define(number, f"argument[{which}][{element}]", self._constant[which])
        else:
            invariant = all(self._values[i][1] for i in operands)
            guard = None
            if operation in _CALLS and number in self._guards and not invariant:
                guard = self._variant(self._guards[number])
            texts = [self._values[i][0] if invariant else self._variant(i) for i in operands]
            self._define(number, _expression(operation, texts, guard), invariant)

    def _define(self, number: int, expression: str, invariant: bool) -> None:
        name = f"{'c' if invariant else 'v'}{number}"
        (self.prepare if invariant else self.advance).append(f"const V {name} = {expression};")
        self._values[number] = (name, invariant)

    def _variant(self, number: int) -> str:
        """How a value is read in `advance`."""
        text, invariant = self._values[number]
        if not invariant or text.startswith("SPLAT"):
            return text
        place = self.invariants.setdefault(text, len(self.invariants))
        if place not in self._loaded:
            self._loaded.add(place)
            self.advance.append(f"const V k{place} = invariant[{place}];")
        return f"k{place}"


def vector_source(kernel: Kernel) -> tuple[str, int]:
    """C of the function for tiles of members, and how many vectors its invariants take.

    Raises
    ------
    NoVectorsError
        If the function is not made of scalar instructions that this knows.
    """
    if not kernel.function.is_a("SXFunction"):
        kind = kernel.function.class_name()
        raise NoVectorsError(f"it is a {kind}, not made of scalar expressions")
    return _source(kernel.function.serialize(), tuple(a.kind for a in kernel.arguments))


@lru_cache(maxsize=128)
def _source(serialized: str, kinds: tuple[str, ...]) -> tuple[str, int]:
    """Source of a function whose arguments are of these kinds; simulations ask for it again."""
    import casadi as ca

    writer = _Writer(ca.Function.deserialize(serialized), kinds)
    noise = [i for i, kind in enumerate(kinds) if kind == "noise"]
    normals = sorted((i, element) for i, element in writer.used if i in noise)
    pairs = sorted({(i, element // 2) for i, element in normals})
    definitions = {
        "N_NEXT": len(writer.next),
        "N_STREAMS": len(noise),
        "N_NORMALS": len(normals),
        "NORMALS": "".join(f"{{{noise.index(i)}, {element}}}, " for i, element in normals),
        "N_PAIRS": len(pairs),
        "PAIRS": "".join(f"{{{noise.index(i)}, {pair}}}, " for i, pair in pairs),
    }
    before, after = _texts()

    def body(lines: Iterable[str]) -> Iterator[str]:
        return (f"    {line}" for line in lines)

    kept = [f"invariant[{place}] = {name};" for name, place in writer.invariants.items()]
    published = []
    for result, lines in enumerate(writer.publish):
        published += [f"if (wanted[{result}]) {{", *body(lines), "}"]
    lines = [f"#define {name} {value}".rstrip() for name, value in definitions.items()]
    lines += [
        before,
        "static void prepare(const V *const *argument, V *invariant)",
        "{",
        *body(writer.prepare + kept),
        "}",
        "static inline void advance(const V *const *argument, const V *invariant, V *next)",
        "{",
        *body(writer.advance),
        "}",
        "#define PUT(r, i, n) result[r][i] = next[n];",
        "static inline void publish_all(const V *next, V *const *result, const uint8_t *wanted)",
        "{",
        *body(published),
        "}",
        "#undef PUT",
        "#define PUT(r, i, n) result[r][i] = CHOOSE(chosen, next[n], result[r][i]);",
        "static void publish_chosen(const V *next, M chosen, V *const *result,",
        "                           const uint8_t *wanted)",
        "{",
        *body(published),
        "}",
        after,
    ]
    return "\n".join(lines), len(writer.invariants)


class VectorKernel(Kernel):
    """The function's instructions on vectors, in a shared library."""

    kind = "vector"

    def __init__(
        self, specification: Specification, library: ctypes.CDLL, n_invariants: int
    ) -> None:
        super().__init__(specification)
        self._library = library
        self._n_invariants = n_invariants
        self.lanes = ctypes.c_int32.in_dll(library, "terrafix_lanes").value

    def _bind(self, arrays: BoundArrays) -> BoundKernel:
        return VectorBinding(Stage(self, self._library, self._n_invariants, arrays))


class VectorBinding(BoundKernel):
    """A vector kernel with its arrays; alone, it is a stretch of one stage and one tick."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        none = np.zeros((1, 1))
        self._clock = [stage.clock.get(kind, none) for kind in ("time", "step")]
        self._alone = Stretch([stage])

    def __call__(self, step: int) -> int:
        """Step all active members."""
        return self._alone.tick(step, *(float(clock[0, 0]) for clock in self._clock))
