"""What a checked system and the installed component types consist of, as plain data and tables."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Setting
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.declare.registry import component_entries, component_type, type_name
from terrafix.cosim.system.check import Plan

# ---------------------------------------------------------------------- a checked system


def plan_content(plan: Plan) -> dict[str, Any]:
    """Describe a checked system in plain types, its components in stepping order."""
    flat = plan.flat
    return {
        "system": flat.name,
        "ok": True,
        "base_step_s": float(plan.base),
        "base_step": f"{text_seconds(plan.base)} s",
        "order": list(plan.order),
        "components": {
            path: {"type": type_name(type(flat.components[path])), "rate": _rate(flat, path)}
            for path in plan.order
        },
        "connections": [
            {
                "source": c.source,
                "target": c.target,
                "delay_s": float(c.delay),
                "at": flat.port(c.target).at,
            }
            for c in flat.connections
        ],
        "notes": list(plan.notes),
        "problems": [],
    }


def _rate(flat: Any, path: str) -> str:
    return str(flat.components[path].rate)


def plan_tables(plan: Plan) -> list[Any]:
    """Show a checked system to a person."""
    flat = plan.flat
    table = _table("", "component", "type", "steps")
    for number, path in enumerate(plan.order, 1):
        kind = type_name(type(flat.components[path]))
        table.add_row(str(number), path, kind, escape(_rate(flat, path)))
    shown: list[Any] = [
        Text(
            f"{flat.name}: {len(plan.order)} components in stepping order, "
            f"{len(flat.connections)} connections, base step {text_seconds(plan.base)} s"
        ),
        table,
    ]
    shown += [Text(f"note: {note}") for note in plan.notes]
    return [*shown, Text("ok", style="green")]


# ---------------------------------------------------------------------- component types


def types_content() -> dict[str, Any]:
    """List all installed component types with one line each."""
    listed = []
    for name, entry in sorted(component_entries().items()):
        try:
            doc = _first_line(component_type(name))
        except ConfigurationError as error:  # one package that is broken hides no others
            doc = " ".join(str(error).split())
        listed.append({"type": name, "class": entry.value, "doc": doc})
    return {"components": listed}


def type_content(name: str) -> dict[str, Any]:
    """Describe the parameters and ports of one component type.

    Raises
    ------
    ConfigurationError
        If there is no such type, or it cannot be imported.
    """
    kind = component_type(name)
    ports = {n: p for n, p in kind._declared.items() if isinstance(p, Port)}
    return {
        "type": name,
        "class": f"{kind.__module__}:{kind.__qualname__}",
        "doc": inspect.cleandoc(kind.__doc__ or ""),
        "default_rate": None if kind.default_rate is None else str(kind.default_rate),
        "parameters": [_setting_content(n, s) for n, s in kind.settings().items()],
        "ports": [_port_content(n, p) for n, p in ports.items()],
    }


def _setting_content(name: str, setting: Setting[Any]) -> dict[str, Any]:
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


def _port_content(name: str, port: Port[Any]) -> dict[str, Any]:
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


def _first_line(kind: type[Component]) -> str:
    own = vars(kind).get("__doc__") or ""
    return inspect.cleandoc(own).partition("\n")[0]


# ---------------------------------------------------------------------- tables of types


def types_tables(content: Mapping[str, Any]) -> list[Any]:
    """Show what `types_content` lists."""
    if not content["components"]:
        return [Text("no component types are installed")]
    table = _table("type", "what it is")
    for kind in content["components"]:
        table.add_row(kind["type"], escape(kind["doc"]))
    return [table]


def type_tables(content: Mapping[str, Any]) -> list[Any]:
    """Show what `type_content` describes."""
    shown: list[Any] = [
        Text(f"{content['type']}  ({content['class']})", style="bold"),
        Text(content["doc"]),
        Text(f"\nsteps {content['default_rate'] or 'at the rate that its system gives'}"),
    ]
    if content["parameters"]:
        table = _table("parameter", "takes", "default", "meaning")
        for p in content["parameters"]:
            default = "required" if p["required"] else str(p["default"])
            table.add_row(*(escape(t) for t in (p["name"], p["kind"], default, p["doc"])))
        shown += [Text(), table]
    if content["ports"]:
        table = _table("port", "", "shape", "unit", "frame", "read at", "meaning")
        for port in content["ports"]:
            for row in _port_rows(port):
                table.add_row(*(escape(t) for t in row))
        shown += [Text(), table]
    return shown


def _port_rows(port: Mapping[str, Any]) -> list[list[str]]:
    kind = "" if port["kind"] == "signal" else f" {port['kind']}"
    read = ""
    if port["direction"] == "input":
        read = f"{port['at']}{', optional' if port['optional'] else ''}"
    fields = port["fields"]
    rows = []
    if fields[0]["name"]:
        rows.append([port["name"], f"{port['direction']}{kind}", "", "", "", read, port["doc"]])
    for field in fields:
        unit = field["unit"] if isinstance(field["unit"], str) else ", ".join(field["unit"])
        shape = " x ".join("any" if n is None else str(n) for n in field["shape"]) or "scalar"
        dtype = "" if field["dtype"] == "float64" else f" {field['dtype']}"
        facts = [f"{shape}{dtype}{' at most' if field['ragged'] else ''}", unit]
        facts.append(field["frame"] or "")
        if field["name"]:
            rows.append([f"  .{field['name']}", "", *facts, "", field["doc"]])
        else:
            rows.append([port["name"], f"{port['direction']}{kind}", *facts, read, port["doc"]])
    return rows


def _table(*headers: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for header in headers:
        table.add_column(header, overflow="fold")
    return table
