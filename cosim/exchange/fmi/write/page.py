"""The page and the picture inside an exported FMU: what it is, its ports, its equations."""

from __future__ import annotations

import io
import sys
from html import escape
from inspect import getdoc
from typing import Any

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.declare.component import docstring
from terrafix.cosim.exchange.fmi.write.layout import Layout, Part
from terrafix.cosim.exchange.fmi.write.variables import Variable

_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em;"
    "color:#222}table{border-collapse:collapse;width:100%}td,th{border-bottom:1px solid #ccd;"
    "padding:.3em .6em;text-align:left;vertical-align:top}th{background:#f3f6f9}"
    "pre{background:#f3f6f9;padding:1em;overflow-x:auto;white-space:pre-wrap}code{font-size:.95em}"
)


def page(layout: Layout) -> str:
    """Write documentation/index.html: one page, without anything from outside."""
    source = layout.source
    tick = text_seconds(source.base)
    body = [
        f"<h1>{escape(source.name)}</h1>",
        f"<p>{escape(source.doc)}</p>",
        "<h2>Time</h2>",
        f"<p>Steps are multiples of {tick} s; another step is refused (Discard). Time inside is a "
        "count of these ticks.</p><ul>",
    ]
    body += [f"<li><b>{escape(p.name)}</b> steps {escape(str(p.rate))}</li>" for p in layout.parts]
    body.append("</ul>")
    body.append(
        "<p>Inputs <em>read at the end of a step</em> belong to the time the step ends: set them "
        "to their value at t + h before the step from t to t + h, and the results are those of the "
        "native component. A master that sets all inputs to their values at t delays each such "
        "link by one step. Inputs <em>read at the start</em> belong to the time the step begins. "
        "A message is its fields, its time of validity <code>.t</code> and its number "
        "<code>.sequence</code>: a new number is a new message.</p>"
    )
    if layout.continuous is not None:
        body.append(
            "<p>In model exchange, the equations below are integrated by the importer; in "
            "co-simulation, by the classical Runge-Kutta method of order four over each step.</p>"
        )
    for causality, title in (
        ("input", "Inputs"),
        ("output", "Outputs"),
        ("parameter", "Parameters"),
        ("local", "Local variables"),
    ):
        chosen = [v for v in [*layout.reals, *layout.integers] if v.causality == causality]
        if chosen:
            body += [f"<h2>{title}</h2>", _table(chosen)]
    body.append("<h2>Equations</h2>")
    for part in layout.parts:
        text = "\n\n".join(filter(None, (docstring(type(part.component)), _equations(part))))
        body.append(f"<h3>{escape(part.name)}</h3><pre>{escape(text)}</pre>")
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(source.name)}'
        f"</title><style>{_STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )


def _equations(part: Part) -> str:
    """Docstring of the module in which the function stands that builds the model."""
    build = type(part.component).build_model
    for name in build.__code__.co_names:
        module = getattr(build.__globals__.get(name), "__module__", "")
        if name.endswith("_model") and module in sys.modules:
            return getdoc(sys.modules[module]) or ""
    return ""


def _table(variables: list[Variable]) -> str:
    rows = ["<tr><th>Name</th><th>Shape</th><th>Unit</th><th>Frame</th><th>Meaning</th></tr>"]
    for v in variables:
        unit = v.unit if isinstance(v.unit, str) else ", ".join(v.unit)
        shape = " x ".join(map(str, v.shape)) or "-"
        doc = v.doc
        if v.causality == "input":
            doc += "; read at the start of a step" if v.at_start else "; read at the end of a step"
        if v.causality == "parameter":
            values = v.starts() if v.kind == "real" else [v.start]
            shown = ", ".join(f"{x:.9g}" for x in values[:9])
            doc += f" (start: {shown}{', ...' if len(values) > 9 else ''})"
        cells = (f"<code>{escape(v.name)}</code>", shape, escape(unit), v.frame or "-", escape(doc))
        rows.append("<tr>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>")
    return f"<table>{''.join(rows)}</table>"


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
