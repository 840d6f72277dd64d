"""A system as a diagram: Mermaid text, or a picture drawn in layers from left to right.

A component stands to the right of all whose outputs it reads at the end of its step. Solid lines
are signals, dashed ones messages, dotted ones shared values; what is read at the start of a step or
comes with a delay runs back underneath.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.registry import type_name
from terrafix.cosim.system.check import Plan, check
from terrafix.cosim.system.flat import Connection, FlatSystem, Flattened
from terrafix.cosim.system.order import is_feedthrough

BOX, GAP, LINE = 2.3, 2.9, 0.26  # width of a box, gap between layers, height of a line [inch]
STYLES = {"signal": "-", "message": "--", "shared": ":"}
DIAGRAMS = (".svg", ".png", ".mmd")
COLORS = {"signal": "#33475b", "message": "#b3541e", "shared": "#2e7d4f"}


@dataclass
class Arrow:
    """All connections from one component to another that are drawn as one line."""

    source: str
    target: str
    kind: str
    back: bool
    labels: list[str] = field(default_factory=list)

    @property
    def label(self) -> str:
        """Ports on the way, named once where both ends agree, and why the arrow runs back."""
        text = ", ".join(self.labels)
        if self.back and "delay" not in text:
            text += ", read at the start of the step"
        return text


def _label(connection: Connection) -> str:
    source, target = connection.source.rpartition(".")[2], connection.target.rpartition(".")[2]
    text = source if source == target else f"{source} → {target}"
    return f"{text} (delay {text_seconds(connection.delay)} s)" if connection.delay else text


def arrows(flat: FlatSystem) -> list[Arrow]:
    """Bundle the connections of a system by ends, kind and direction."""
    found: dict[tuple[str, str, str, bool], Arrow] = {}
    for connection in flat.connections:
        source, target = flat.owner(connection.source), flat.owner(connection.target)
        kind, back = flat.port(connection.source).kind, not is_feedthrough(flat, connection)
        key = (source, target, kind, back)
        arrow = found.setdefault(key, Arrow(source, target, kind, back))
        arrow.labels.append(_label(connection))
    return list(found.values())


def _title(flat: FlatSystem, path: str) -> tuple[str, str, str]:
    component = flat.components[path]
    return path, type_name(type(component)), str(component.rate)


class Diagram:
    """A system as it was when drawn: a picture in a notebook, Mermaid text elsewhere.

    Raises
    ------
    SystemCheckError
        If the system has problems.
    """

    def __init__(self, system: Flattened) -> None:
        self.plan = check(system)
        self.mermaid = _mermaid(self.plan)

    def __repr__(self) -> str:
        return self.mermaid.rstrip()

    def _repr_svg_(self) -> str:
        return self.svg().replace("<svg ", '<svg style="max-width:100%;height:auto" ', 1)

    def svg(self) -> str:
        """The picture as SVG."""
        drawn = BytesIO()
        self._draw(drawn, "svg")
        return drawn.getvalue().decode()

    def _draw(self, target: Path | BytesIO, kind: str) -> None:
        """The same system gives the same file."""
        from matplotlib import rc_context

        about = {"Date": None} if kind == "svg" else {}
        with rc_context({"svg.hashsalt": "terrafix"}):
            _picture(self.plan).savefig(target, format=kind, dpi=130, metadata=about)

    def save(self, path: str | Path) -> None:
        """Draw to an .svg or .png file, or write Mermaid text to an .mmd file.

        Raises
        ------
        ConfigurationError
            If the file is of another kind, or cannot be written.
        """
        path = Path(path)
        kind = path.suffix.lower()
        if kind not in DIAGRAMS:
            raise ConfigurationError(
                f"'{path}' is no {' or '.join(DIAGRAMS)} file\n"
                f"  its ending says what is written: name it '{path.with_suffix('.svg').name}'"
            )
        try:
            if kind == ".mmd":
                path.write_text(self.mermaid, encoding="utf-8")
            else:
                self._draw(path, kind.removeprefix("."))
        except OSError as error:
            raise ConfigurationError(f"cannot write '{path}': {error.strerror}") from error


def _mermaid(plan: Plan) -> str:
    names = {path: f"c{i}" for i, path in enumerate(plan.order)}
    lines = ["flowchart LR"]
    for path in plan.order:
        name, kind, rate = _title(plan.flat, path)
        lines.append(f'    {names[path]}["<b>{name}</b><br/>{kind}<br/>{rate}"]')
    shapes = {"signal": "-->", "message": "-.->", "shared": "==>"}
    for arrow in arrows(plan.flat):
        link = f'{shapes[arrow.kind]}|"{arrow.label}"|'
        lines.append(f"    {names[arrow.source]} {link} {names[arrow.target]}")
    return "\n".join(lines) + "\n"


# ------------------------------------------------------------------------------- picture


@dataclass
class _Box:
    """A component, or the place where a long arrow passes through a layer."""

    layer: int
    lines: int = 0
    y: float = 0.0
    inputs: list[Any] = field(default_factory=list)
    outputs: list[Any] = field(default_factory=list)
    returns_in: list[int] = field(default_factory=list)
    returns_out: list[int] = field(default_factory=list)

    @property
    def height(self) -> float:
        """Height with one line for each arrow on its busier side [inch]."""
        busier = max(
            len(self.inputs) + len(self.returns_in), len(self.outputs) + len(self.returns_out)
        )
        return max(self.lines, busier) * LINE + (0.2 if self.lines else 0.0)

    def entry(self, key: Any) -> float:
        """Height at which an arrow comes in on the left; what runs back is lowest."""
        return self._end([*self.inputs, *self.returns_in], key)

    def exit(self, key: Any) -> float:
        """Height at which an arrow leaves on the right; what runs back is lowest."""
        return self._end([*self.outputs, *self.returns_out], key)

    def _end(self, side: list[Any], key: Any) -> float:
        return self.y + ((len(side) - 1) / 2 - side.index(key)) * LINE


def _layers(order: list[str], forward: list[Arrow]) -> dict[str, int]:
    layer = dict.fromkeys(order, 0)
    for path in order:
        for arrow in forward:
            if arrow.target == path:
                layer[path] = max(layer[path], layer[arrow.source] + 1)
    readers = defaultdict(list)
    for arrow in forward:
        readers[arrow.source].append(arrow.target)
    for path in reversed(order):  # a source stands next to its first reader
        if readers[path]:
            layer[path] = min(layer[r] for r in readers[path]) - 1
    return layer


def _place(
    order: list[str], all_arrows: list[Arrow]
) -> tuple[dict[Any, _Box], dict[int, list[Any]]]:
    """Boxes of components and of arrows passing through, in layers, ordered to avoid crossings."""
    forward = [a for a in all_arrows if not a.back]
    layer = _layers(order, forward)
    boxes: dict[Any, _Box] = {path: _Box(layer[path], lines=3) for path in order}
    for number, arrow in enumerate(forward):
        chain: list[Any] = [arrow.source]
        for between in range(layer[arrow.source] + 1, layer[arrow.target]):
            boxes[number, between] = _Box(between)
            chain.append((number, between))
        chain.append(arrow.target)
        for a, b in pairwise(chain):
            boxes[a].outputs.append((number, b))
            boxes[b].inputs.append((number, a))
    columns: dict[int, list[Any]] = defaultdict(list)
    for key, box in boxes.items():
        columns[box.layer].append(key)
    for number, arrow in enumerate(a for a in all_arrows if a.back):
        boxes[arrow.source].returns_out.append(number)
        boxes[arrow.target].returns_in.append(number)
    for sweep in range(8):
        for index in sorted(columns, reverse=bool(sweep % 2)):
            _stack(boxes, columns[index])
            columns[index].sort(key=lambda key: -_wish(boxes, key))
            _stack(boxes, columns[index])
    for box in boxes.values():
        box.outputs.sort(key=lambda end: -boxes[end[1]].y)
        box.inputs.sort(key=lambda end: -boxes[end[1]].y)
    return boxes, columns


def _wish(boxes: dict[Any, _Box], key: Any) -> float:
    """Where a box would stand if only its neighbors counted."""
    box = boxes[key]
    near = [boxes[other].y for _, other in (*box.inputs, *box.outputs)]
    return sum(near) / len(near) if near else 0.0


def _stack(boxes: dict[Any, _Box], column: list[Any]) -> None:
    """Put the boxes of a layer one under another, as near to where they wish as they fit."""
    heights = [boxes[key].height + 0.35 for key in column]
    top = sum(heights) / 2
    shift = sum(_wish(boxes, key) for key in column) / len(column)
    for key, height in zip(column, heights, strict=True):
        boxes[key].y = top - height / 2 + shift
        top -= height


def _picture(plan: Plan) -> Any:
    """The figure of a checked system."""
    from matplotlib.figure import Figure

    found = arrows(plan.flat)
    boxes, columns = _place(plan.order, found)
    back = [a for a in found if a.back]
    low = min(b.y - b.height / 2 for b in boxes.values()) - 0.5
    high = max(b.y + b.height / 2 for b in boxes.values()) + 0.7
    bottom = low - 0.45 * len(back) - 0.2
    right = len(columns) * (BOX + GAP) - GAP
    figure = Figure(figsize=(right + 1.2, high - bottom + 0.2))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(-0.6, right + 0.6)
    axes.set_ylim(bottom - 0.1, high + 0.1)
    axes.set_axis_off()
    axes.text(-0.3, high - 0.3, plan.flat.name, fontsize=15, weight="bold")
    forward = [a for a in found if not a.back]
    for number, arrow in enumerate(forward):
        _draw_forward(axes, boxes, number, arrow)
    for lane, arrow in enumerate(back):
        _draw_back(axes, boxes, lane, arrow, low - 0.45 * lane)
    for name in plan.order:
        _draw_box(axes, boxes[name], _title(plan.flat, name))
    return figure


def _left(box: _Box) -> float:
    return box.layer * (BOX + GAP)


def _draw_box(axes: Any, box: _Box, title: tuple[str, str, str]) -> None:
    from matplotlib.patches import FancyBboxPatch

    x = _left(box)
    axes.add_patch(
        FancyBboxPatch(
            (x, box.y - box.height / 2),
            BOX,
            box.height,
            boxstyle="round,pad=0,rounding_size=0.08",
            facecolor="#f3f6f9",
            edgecolor="#33475b",
            linewidth=1.3,
            zorder=3,
        )
    )
    middle = x + BOX / 2
    for text, dy, size, weight in zip(
        title, (LINE, 0, -LINE), (11, 9, 9), ("bold", "normal", "normal"), strict=True
    ):
        axes.text(
            middle, box.y + dy, text, size=size, weight=weight, ha="center", va="center", zorder=4
        )


def _draw_forward(axes: Any, boxes: dict[Any, _Box], number: int, arrow: Arrow) -> None:
    from matplotlib.path import Path as Curve

    points = []
    here: Any = arrow.source
    while here != arrow.target:
        following = next(b for k, b in boxes[here].outputs if k == number)
        here_box, next_box = boxes[here], boxes[following]
        start = (_left(here_box) + BOX, here_box.exit((number, following)))
        points.append((start, (_left(next_box), next_box.entry((number, here)))))
        here = following
    vertices, codes = [points[0][0]], [Curve.MOVETO]
    for start, end in points:
        if vertices[-1] != start:
            vertices.append(start)
            codes.append(Curve.LINETO)
        bend, landing = 0.45 * GAP, end[0] - 0.9
        vertices += [(start[0] + bend, start[1]), (landing - bend, end[1]), (landing, end[1]), end]
        codes += [Curve.CURVE4, Curve.CURVE4, Curve.CURVE4, Curve.LINETO]
    _stroke(axes, Curve(vertices, codes), arrow)
    x, y = points[-1][1]
    _write(axes, x - 0.14, y, arrow.label, arrow, "right")


def _draw_back(axes: Any, boxes: dict[Any, _Box], number: int, arrow: Arrow, lane: float) -> None:
    from matplotlib.path import Path as Curve

    source, target = boxes[arrow.source], boxes[arrow.target]
    x0, x1 = _left(source) + BOX, _left(target)
    y0, y1 = source.exit(number), target.entry(number)
    aside = 0.25 + 0.12 * (number % 4)  # in the gaps beside the boxes, each line apart
    vertices = [(x0, y0), (x0 + aside, y0), (x0 + aside, lane)]
    vertices += [(x1 - aside, lane), (x1 - aside, y1), (x1, y1)]
    _stroke(axes, Curve(vertices, [Curve.MOVETO, *[Curve.LINETO] * 5]), arrow)
    _write(axes, (x0 + x1) / 2, lane, arrow.label, arrow, "center")


def _write(axes: Any, x: float, y: float, text: str, arrow: Arrow, align: str) -> None:
    color = COLORS[arrow.kind]
    axes.text(x, y + 0.03, text, size=7.5, ha=align, va="bottom", color=color, zorder=5)


def _stroke(axes: Any, curve: Any, arrow: Arrow) -> None:
    from matplotlib.patches import FancyArrowPatch

    axes.add_patch(
        FancyArrowPatch(
            path=curve,
            arrowstyle="-|>,head_length=5,head_width=2.5",
            linestyle=STYLES[arrow.kind],
            color=COLORS[arrow.kind],
            linewidth=1.1,
            zorder=2,
        )
    )
