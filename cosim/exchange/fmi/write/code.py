"""The C of an exported FMU: CasADi's functions, and ``model.c``, the tables of ``core.h``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.cosim.exchange.fmi.write.layout import Call, Copy, Layout, Part, Target
from terrafix.cosim.exchange.fmi.write.variables import Variable
from terrafix.cosim.kernels.compiled import without_null_checks
from terrafix.cosim.kernels.toolchain import c_source

LANES = 4  # as in core.c
SMALL = 2000  # instructions of a function that shares a file with others
_ARGUMENTS = "const double **, double **, long long int *, double *, int"
FIXED = ("core.h", "core.c", "portable.h")


def sources(layout: Layout, version: int) -> tuple[dict[str, str], str]:
    """All C of an FMU by file name, but for the headers of FMI; and its instantiation token.

    The token is the hash of that C: what the binary and the description must agree on.

    Parameters
    ----------
    layout : Layout
    version : {2, 3}
        Of FMI.
    """
    here = Path(__file__).parent
    texts = {name: (here / name).read_text() for name in (*FIXED, f"fmi{version}.c")}
    texts["noise.c"] = c_source("noise.c")
    texts["sizes.h"] = sizes_source(layout)
    texts["model.c"] = model_source(layout)
    functions = _functions(layout)
    small = [f for f in functions if f.n_instructions() < SMALL]
    if small:
        texts["functions.c"] = function_source("functions.c", small)
    for function in functions:
        if function not in small:
            name = f"{function.name()}.c"
            texts[name] = function_source(name, [function])
    digest = sha256("\0".join(f"{k}\0{v}" for k, v in sorted(texts.items())).encode()).hexdigest()
    ends = (0, 8, 12, 16, 20, 32)
    token = "{" + "-".join(digest[a:b] for a, b in pairwise(ends)) + "}"
    texts["sizes.h"] += f"#define TOKEN {_text(token)}\n#define TOKEN_LENGTH (sizeof TOKEN - 1)\n"
    return texts, token


def compiled(names: Iterable[str]) -> list[str]:
    """Those of an FMU's sources that are compiled; the others are included."""
    return sorted(n for n in names if n.endswith(".c") and n != "noise.c")


def headers(version: int) -> dict[str, str]:
    """The headers of FMI, from the installed FMPy."""
    import fmpy

    names = {
        2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
        3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
    }
    folder = Path(fmpy.__file__).parent / "c-code"
    return {name: (folder / name).read_text() for name in names[version]}


def _functions(layout: Layout) -> list[Any]:
    calls: list[Call] = []
    for part in layout.parts:
        calls += [part.initial, part.step, part.initial_forward, part.step_forward]
    if layout.continuous is not None:
        calls += [layout.continuous.rate, layout.continuous.rate_forward]
    return [call.function for call in calls]


def sizes_source(layout: Layout) -> str:
    """Extents of the arrays of `struct instance`."""
    functions = _functions(layout)
    most = {
        name: max(int(getattr(f, f"sz_{name}")()) for f in functions)
        for name in ("arg", "res", "iw", "w")
    }
    n_next = max(
        [sum(t.size for t in p.targets) for p in layout.parts]
        + [sum(t.size for t in layout.continuous.targets) if layout.continuous else 0]
    )
    noise = max((s.size for s in layout.streams), default=0)
    base = layout.source.base
    sizes = {
        "TICK_NUMERATOR": f"INT64_C({base.numerator})",
        "TICK_DENOMINATOR": f"INT64_C({base.denominator})",
        "TIME": 0,
        "SEED": max(layout.seed, 0),
        "MEMBER": max(layout.member, 0),
        "N_PARTS": len(layout.parts),
        "N_REAL": len(layout.start_real),
        "N_INTEGER": max(1, len(layout.start_integer)),
        "N_STREAMS": max(1, len(layout.streams)),
        "N_MESSAGES": max(1, *(len(p.published) for p in layout.parts), 1),
        "N_NEXT": max(1, n_next),
        "N_NOISE": noise + 2 * LANES + 2,
        "N_ARG": most["arg"] + 1,
        "N_RES": most["res"] + 1,
        "N_IW": most["iw"] + 1,
        "N_W": most["w"] + 1,
    }
    lines = [f"#define {name} {value}" for name, value in sizes.items()]
    return "\n".join(["/* Generated: extents of what core.h declares. */", *lines, ""])


def function_source(name: str, functions: Sequence[Any]) -> str:
    """Functions as CasADi writes them; long ones have files of their own, compiled side by side."""
    import casadi as ca

    generator = ca.CodeGenerator(name, {"with_header": False})
    for function in functions:
        generator.add(function)
    head = '#include "portable.h"\n#define CASADI_SYMBOL_EXPORT WITHIN\n'
    return head + without_null_checks(generator.dump())


def model_source(layout: Layout) -> str:
    """The tables, and the prototypes of the functions."""
    lines = [
        f"/* Generated by terrafix: the tables of '{layout.source.name}'. */",
        '#include "core.h"',
        "#include <math.h>",
        "",
        *(f"WITHIN int {f.name()}({_ARGUMENTS});" for f in _functions(layout)),
        "",
        "const char instantiation_token[] = TOKEN;",
        "",
        *_variable_tables(layout),
        *_start_tables(layout),
    ]
    key = 0
    for number, part in enumerate(layout.parts):
        lines += _part_tables(number, part, key)
        key += len(part.streams)
    lines += ["const struct part parts[] = {"]
    lines += [_part_row(number, part) for number, part in enumerate(layout.parts)]
    lines += ["};", "", *_continuous_tables(layout), ""]
    return "\n".join(lines)


# --------------------------------------------------------------------------------- tables


def _variable_tables(layout: Layout) -> list[str]:
    owner = [i for i, v in enumerate(layout.reals) for _ in range(v.size)]
    return [
        "const struct variable real_variable[] = {",
        *(_variable_row(v) for v in layout.reals),
        "};",
        "const struct variable integer_variable[] = {",
        *(_variable_row(v) for v in layout.integers),
        "    {0}};",
        f"const int32_t n_real_variables = {len(layout.reals)};",
        f"const int32_t n_integer_variables = {len(layout.integers)};",
        f"const int32_t n_variable_reals = {layout.n_variable_reals};",
        _numbers("int32_t", "owner_of_real", owner, static=False),
    ]


def _variable_row(variable: Variable) -> str:
    flags = ["POSITIVE"] * variable.positive + ["INFINITE"] * variable.infinite
    flags += ["DISCRETE"] * variable.discrete + ["DERIVATIVE"] * variable.is_derivative
    flags += ["STATE"] * (variable.state is not None)
    largest = 2**63 - 1.0 if variable.kind == "integer" else math.inf
    minimum = -largest if variable.minimum is None else variable.minimum
    maximum = largest if variable.maximum is None else variable.maximum
    columns = variable.shape[1] if len(variable.shape) == 2 else 0
    state = -1 if variable.state is None else variable.state
    return (
        f"    {{{_text(variable.name)}, {variable.causality.upper()}, {variable.offset}, "
        f"{variable.size}, {_number(minimum)}, {_number(maximum)}, {' | '.join(flags) or '0'}, "
        f"{columns}, {state}}},"
    )


def _start_tables(layout: Layout) -> list[str]:
    return [
        _numbers("double", "real_start", layout.start_real, static=False),
        _numbers("int64_t", "integer_start", layout.start_integer, static=False),
        "",
    ]


def _part_tables(number: int, part: Part, first_key: int) -> list[str]:
    name = f"part{number}"
    lines = [f"/* {part.name} */"]
    for label in ("initial", "step", "initial_forward", "step_forward"):
        lines += _call_tables(f"{name}_{label}", getattr(part, label))
    lines.append(_targets(f"{name}_target", part.targets))
    lines += [
        f"static const struct stream {name}_stream[] = {{",
        *(
            f"    {{{_text(s.path)}, {_text(s.name)}, {first_key + k}, {s.offset}, {s.size}}},"
            for k, s in enumerate(part.streams)
        ),
        "    {0}};",
        f"static const struct received {name}_received[] = {{",
        *(
            f"    {{{_text(m.name)}, {m.sequence}, {m.seen}, {m.fresh}, {int(m.required)}}},"
            for m in part.received
        ),
        "    {0}};",
        f"static const struct published {name}_published[] = {{",
        *(f"    {{{m.valid}, {m.t}, {m.sequence}}}," for m in part.published),
        "    {0}};",
    ]
    for label, copies in (("convert", part.convert), ("latch", part.latch)):
        lines += _copies(f"{name}_{label}", copies)
    lines.append(_numbers("int64_t", f"{name}_listed", _listed(part)))
    lines.append("")
    return lines


def _call_tables(name: str, call: Call) -> list[str]:
    return [
        _numbers("int32_t", f"{name}_argument", call.arguments),
        _numbers("int32_t", f"{name}_seed", call.seeds),
    ]


def _call(name: str, call: Call) -> str:
    return (
        f"{{{call.function.name()}, {name}_argument, {len(call.arguments)}, "
        f"{name}_seed, {len(call.seeds)}}}"
    )


def _copies(name: str, copies: Sequence[Copy]) -> list[str]:
    lines = [
        _numbers("double", f"{name}_factor{k}", c.factor) for k, c in enumerate(copies) if c.factor
    ]
    lines.append(f"static const struct copy {name}[] = {{")
    for k, c in enumerate(copies):
        factor = f"{name}_factor{k}" if c.factor else "0"
        lines.append(f"    {{{c.source}, {c.target}, {c.size}, {factor}, {int(c.integer)}}},")
    lines.append("    {0}};")
    return lines


def _listed(part: Part) -> list[int]:
    return [] if part.rate.times is None else list(part.rate.ticks(part.base, part.grid))


def _part_row(number: int, part: Part) -> str:
    name = f"part{number}"
    rate, base = part.rate, part.base
    period = 0 if rate.period is None else int(rate.period / base)
    first = 0 if rate.period is None else int(rate.offset / base) or period
    fields = {
        "name": _text(part.name),
        **{
            label: _call(f"{name}_{label}", getattr(part, label))
            for label in ("initial", "step", "initial_forward", "step_forward")
        },
        "target": f"{name}_target",
        "n_target": len(part.targets),
        "n_output": part.n_outputs,
        "state": part.state,
        "before": part.before,
        "n_state": part.n_state,
        "step_length": part.step_length,
        "stream": f"{name}_stream",
        "n_stream": len(part.streams),
        "received": f"{name}_received",
        "n_received": len(part.received),
        "published": f"{name}_published",
        "n_published": len(part.published),
        "convert": f"{name}_convert",
        "latch": f"{name}_latch",
        "n_convert": len(part.convert),
        "n_latch": len(part.latch),
        "first": first,
        "period": period,
        "listed": f"{name}_listed",
        "n_listed": len(_listed(part)),
        "starts_at_zero": int(rate.starts_at_zero),
    }
    return "    {" + ",\n     ".join(f".{k} = {v}" for k, v in fields.items()) + "},"


def _continuous_tables(layout: Layout) -> list[str]:
    c = layout.continuous
    if c is None:
        return ["const struct continuous continuous = {.n_state = 0};"]
    nominal = [v.nominal for v in c.states for _ in range(v.size)]
    return [
        *_call_tables("part0_rate", c.rate),
        *_call_tables("part0_rate_forward", c.rate_forward),
        _targets("rate_target", c.targets),
        _numbers("int32_t", "continuous_state", c.places),
        _numbers("double", "continuous_nominal", [float(n or 1.0) for n in nominal]),
        "const struct continuous continuous = {",
        f"    .rate = {_call('part0_rate', c.rate)},",
        f"    .rate_forward = {_call('part0_rate_forward', c.rate_forward)},",
        f"    .target = rate_target, .n_target = {len(c.targets)}, .n_output = {c.n_outputs},",
        f"    .state = continuous_state, .n_state = {len(c.places)},",
        f"    .nominal = continuous_nominal, .has_discrete = {int(c.has_discrete)}}};",
    ]


def _targets(name: str, targets: Iterable[Target]) -> str:
    rows = ", ".join(f"{{{t.offset}, {t.size}, {t.message}}}" for t in targets)
    return f"static const struct target {name}[] = {{{rows}, {{0}}}};"


def _numbers(kind: str, name: str, values: Sequence[Any], *, static: bool = True) -> str:
    shown = [_number(v) if kind == "double" else str(int(v)) for v in values] or ["0"]
    lines, line = [], ""
    for text in shown:
        if len(line) + len(text) > 92:
            lines.append(line)
            line = ""
        line += text + ", "
    prefix = "static const" if static else "const"
    body = "\n    ".join([*lines, line.rstrip(", ")])
    return f"{prefix} {kind} {name}[] = {{\n    {body}}};"


def _number(value: float) -> str:
    """A double as C reads it back to the last bit."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(np.float64(value)))


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
