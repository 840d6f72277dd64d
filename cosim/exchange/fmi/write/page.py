"""The page and the picture inside an exported FMU: what it is, its ports, its equations."""

from __future__ import annotations

import io
import sys
from inspect import getdoc
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.declare.component import docstring
from terrafix.cosim.exchange.fmi.write.layout import Layout, Part
from terrafix.cosim.exchange.fmi.write.variables import Variable
from terrafix.cosim.show.templates import filled

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_TITLES = {
    "input": "Inputs",
    "output": "Outputs",
    "parameter": "Parameters",
    "local": "Local variables",
}


def page(layout: Layout) -> str:
    """Write documentation/index.html: one page, without anything from outside."""
    source = layout.source
    variables = [*layout.arrays, *layout.integers]
    rows = {
        title: [_row(v) for v in variables if v.causality == causality]
        for causality, title in _TITLES.items()
    }
    return filled(
        _TEMPLATE,
        name=source.name,
        doc=source.doc,
        tick=text_seconds(source.base),
        parts=[{"name": p.name, "rate": p.rate, "text": _text(p)} for p in layout.parts],
        continuous=layout.continuous is not None,
        tables=[(title, found) for title, found in rows.items() if found],
    )


def _text(part: Part) -> str:
    """What a component says of itself, and where its equations stand."""
    return "\n\n".join(filter(None, (docstring(type(part.component)), _equations(part))))


def _equations(part: Part) -> str:
    """Docstring of the module in which the function stands that builds the model."""
    build = type(part.component).build_model
    for name in build.__code__.co_names:
        module = getattr(build.__globals__.get(name), "__module__", "")
        if name.endswith("_model") and module in sys.modules:
            return getdoc(sys.modules[module]) or ""
    return ""


def _row(v: Variable) -> dict[str, str]:
    """A variable as its table shows it."""
    doc = v.doc
    if v.causality == "input":
        doc += "; read at the start of a step" if v.at_start else "; read at the end of a step"
    if v.causality == "parameter":
        values = v.starts() if v.kind == "real" else [v.start]
        shown = ", ".join(f"{x:.9g}" for x in values[:9])
        doc += f" (start: {shown}{', ...' if len(values) > 9 else ''})"
    return {
        "name": v.name,
        "shape": " x ".join(map(str, v.shape)) or "-",
        "unit": v.unit if isinstance(v.unit, str) else ", ".join(v.unit),
        "frame": v.frame or "-",
        "doc": doc,
    }


def icon(layout: Layout) -> bytes:
    """Draw the icon: a box with its name, inputs on the left, outputs on the right."""
    from matplotlib.figure import Figure

    inputs = [p.name for p in layout.ports if p.is_input]
    outputs = [p.name for p in layout.ports if not p.is_input]
    figure = Figure(figsize=(3, 3))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    axes.set_axis_off()
    axes.add_patch(_box())
    name = layout.source.name
    axes.text(0.5, 0.5, name.replace("_", "\n"), ha="center", va="center", size=13, weight="bold")
    for names, x, align in ((inputs, 0.1, "left"), (outputs, 0.9, "right")):
        for k, text in enumerate(names[:8]):
            y = 0.92 - (k + 0.5) * 0.84 / min(8, len(names))
            axes.plot([x - 0.05, x + 0.01] if align == "left" else [x - 0.01, x + 0.05], [y, y],
                      color="#33475b", linewidth=1.5)  # fmt: skip
            axes.text(x + (0.02 if align == "left" else -0.02), y, text, size=7, ha=align,
                      va="center", color="#33475b")  # fmt: skip
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=64, transparent=True, metadata={"Software": None})
    return buffer.getvalue()


def _box() -> Any:
    from matplotlib.patches import FancyBboxPatch

    return FancyBboxPatch(
        (0.1, 0.08), 0.8, 0.84, boxstyle="round,pad=0,rounding_size=0.05",
        facecolor="#f3f6f9", edgecolor="#33475b", linewidth=2,
    )  # fmt: skip
