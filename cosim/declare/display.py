"""How the parameters and ports of a component look: as plain data, in tables, and in ``help()``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Parameter, Setting
from terrafix.cosim.declare.ports import Port, written
from terrafix.cosim.show.tables import Block, Table, first, named

MOST_ROWS = 10
MOST_FIELDS = 5  # of a bundle, by name
Settings = Mapping[str, Setting[object]]
Ports = Mapping[str, Port[object]]

# ---------------------------------------------------------------------- as plain data


def setting_content(name: str, setting: Setting[object]) -> dict[str, Any]:
    """Describe a parameter in plain types."""
    default = None
    if not setting.required:
        default = setting.write(setting.read(setting.default, where=f"default of '{name}'"))
    return {
        "name": name,
        "kind": setting.kind(),
        "required": setting.required,
        "default": default,
        "doc": setting.doc,
    }


def port_content(name: str, port: Port[object]) -> dict[str, Any]:
    """Describe a port in plain types."""
    fields = [
        {
            "name": n,
            "shape": list(f.shape),
            "unit": f.unit if isinstance(f.unit, str) else list(f.unit),
            "frame": f.frame,
            "dtype": str(np.dtype(f.dtype)),
            "ragged": f.ragged,
            "labels": list(f.labels),
            "doc": f.doc,
        }
        for n, f in port.fields.items()
    ]
    content: dict[str, Any] = {
        "name": name,
        "direction": "input" if port.is_input else "output",
        "kind": "window" if port.window else port.kind,
        "fields": fields,
        "doc": port.doc,
    }
    if port.is_input:
        content |= {"at": port.at, "optional": port.optional, "default": port.default}
    if port.kind == "message" and port.is_input:
        content["queue"] = port.queue
    return content


# ---------------------------------------------------------------------- tables of a type


def setting_table(settings: Sequence[Mapping[str, Any]]) -> Table:
    """What can be set, from `setting_content`."""
    return Table(
        ["parameter", "takes", "default", "meaning"],
        [
            [p["name"], p["kind"], "required" if p["required"] else str(p["default"]), p["doc"]]
            for p in settings
        ],
    )


def port_table(ports: Sequence[Mapping[str, Any]]) -> Table:
    """Ports with the fields of bundles one under another, from `port_content`."""
    return Table(
        ["port", "", "shape", "unit", "frame", "read at", "meaning"],
        [row for port in ports for row in _port_rows(port)],
    )


def _port_rows(port: Mapping[str, Any]) -> Iterator[list[str]]:
    what, read = _what(port), ""
    if port["direction"] == "input":
        read = f"{port['at']}{', optional' if port['optional'] else ''}"
    fields = port["fields"]
    if fields[0]["name"]:
        yield [port["name"], what, "", "", "", read, port["doc"]]
    for field in fields:
        if field["name"]:
            yield [f"  .{field['name']}", "", *_facts(field), "", field["doc"]]
        else:
            yield [port["name"], what, *_facts(field), read, port["doc"]]


def _what(port: Mapping[str, Any]) -> str:
    return str(port["direction"]) + ("" if port["kind"] == "signal" else f" {port['kind']}")


def _facts(field: Mapping[str, Any]) -> list[str]:
    """Shape, unit and frame of a field."""
    unit = field["unit"] if isinstance(field["unit"], str) else ", ".join(field["unit"])
    shape = " x ".join("any" if n is None else str(n) for n in field["shape"]) or "scalar"
    dtype = "" if field["dtype"] == "float64" else f" {field['dtype']}"
    most = " at most" if field["ragged"] else ""
    return [f"{shape}{dtype}{most}", unit, field["frame"] or ""]


# ---------------------------------------------------------------------- one component


def component_shown(
    title: str, rate: Rate | None, settings: Settings, values: Mapping[str, Any], ports: Ports
) -> list[Block]:
    """A component: its parameters with values and units, and its ports, both cut if many."""
    from rich.text import Text

    header = Text(title, style="bold")
    header.append(f", steps {rate}" if rate else ", has no rate yet", style="not bold")
    shown: list[Block] = [header]
    kept, more = first(settings.items(), MOST_ROWS)
    if kept:
        rows = [[name, _value(name, s, values)] for name, s in kept]
        shown += ["", Table(["parameter", "value"], rows), *_and_more(more)]
    listed, more = first(ports.items(), MOST_ROWS)
    if listed:
        table = Table(
            ["port", "", "shape", "unit", "frame"],
            [_port_row(port_content(name, port)) for name, port in listed],
        )
        shown += ["", table, *_and_more(more)]
    return shown


def _and_more(count: int) -> list[Block]:
    from rich.text import Text

    return [Text(f"and {count} more", style="dim")] if count else []


def _value(name: str, setting: Setting[object], values: Mapping[str, Any]) -> str:
    if name not in values and setting.required:
        return "missing"
    value = values.get(name, setting.default)
    if not isinstance(setting, Parameter):
        return str(value) if isinstance(value, str) else written(setting.write(value))
    array = np.asarray(value, dtype=np.float64)
    numbers = written(array) if array.size > 9 else _numbers(array)
    return numbers if setting.unit in ("1", "") else f"{numbers} {setting.unit_text()}"


def _numbers(array: np.ndarray[Any, Any]) -> str:
    """Six digits of each number."""
    if array.ndim == 0:
        return f"{float(array):.6g}"
    return f"[{', '.join(_numbers(part) for part in array)}]"


def _port_row(port: Mapping[str, Any]) -> list[str]:
    if port["fields"][0]["name"]:
        facts = [named([f["name"] for f in port["fields"]], MOST_FIELDS), "", ""]
    else:
        facts = _facts(port["fields"][0])
    start = ", read at the start" if port.get("at") == "start" else ""
    return [port["name"], _what(port) + start, *facts]


# ---------------------------------------------------------------------- help


def help_text(doc: str, rate: Rate | None, settings: Settings, ports: Ports) -> str:
    """A docstring followed by what the class declares, in the same style."""
    sections = [doc.rstrip()] if doc.strip() else []
    if settings or ports:
        lines = []
        for name, setting in settings.items():
            default = "required" if setting.required else f"default {written(setting.default)}"
            lines += _entry(name, f"{setting.kind()}, {default}", setting.doc)
        lines += _entry(
            "rate", f"Rate, {f'default {rate!r}' if rate else 'required'}", "when it steps"
        )
        sections.append(_section("Parameters", lines))
    for title, is_input in (("Inputs", True), ("Outputs", False)):
        contents = [port_content(n, p) for n, p in ports.items() if p.is_input == is_input]
        if contents:
            sections.append(_section(title, [line for c in contents for line in _port_lines(c)]))
    return "\n\n".join(sections)


def _section(title: str, lines: Sequence[str]) -> str:
    return "\n".join([title, "-" * len(title), *lines])


def _entry(name: str, facts: str, doc: str) -> list[str]:
    return [f"{name} : {facts}", *([f"    {doc}"] if doc else [])]


def _port_lines(port: Mapping[str, Any]) -> list[str]:
    manner = [] if port["kind"] == "signal" else [port["kind"]]
    manner += ["read at the start of the step"] if port.get("at") == "start" else []
    manner += ["optional"] if port.get("optional") else []
    if not port["fields"][0]["name"]:
        return _entry(port["name"], ", ".join([_in_words(port["fields"][0]), *manner]), port["doc"])
    lines = _entry(port["name"], ", ".join(["bundle", *manner]), port["doc"])
    for field in port["fields"]:
        meaning = f": {field['doc']}" if field["doc"] else ""
        lines.append(f"    .{field['name']} {_in_words(field)}{meaning}")
    return lines


def _in_words(field: Mapping[str, Any]) -> str:
    _, unit, frame = _facts(field)
    shape = f"array {tuple(field['shape'])}" if field["shape"] else "number"
    dtype = "" if field["dtype"] == "float64" else f" of {field['dtype']}"
    unit = "" if unit in ("1", "") else f" [{unit}]"
    return f"{shape}{dtype}{unit}{f', frame {frame}' if frame else ''}"
