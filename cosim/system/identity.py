"""What a run is: everything that was set, in plain types, and how two runs differ in it."""

from __future__ import annotations

from typing import Any

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.registry import component_entries, type_name
from terrafix.cosim.system.check import Plan


def configuration(plan: Plan) -> dict[str, Any]:
    """Everything that was set, in plain types: components, connections, records and the like."""
    flat = plan.flat
    return {
        **({} if plan.epoch is None else {"epoch": plan.epoch}),
        "components": {
            path: {
                "type": _type(type(c)),
                "rate": None if c.rate is None else c.rate.identity(),
                **{
                    n: s.write(c.setting(n))
                    for n, s in c.settings().items()
                    if n in c.given_parameters
                },
            }
            for path, c in flat.components.items()
        },
        "connections": sorted(
            f"{c}" + (f" (delay {text_seconds(c.delay)} s)" if c.delay else "")
            for c in flat.connections
        ),
        "records": {
            r.name: {"ports": list(r.ports), "rate": None if r.rate is None else r.rate.identity()}
            for r in flat.records
        },
        "dispersions": {
            d.name: {
                "kind": d.kind,
                "spread": str(d.write_spread(flat.components)),  # every digit of every number
                "to": list(d.targets),
            }
            | ({"design": d.design} if d.design != "random" else {})
            | ({"limit": d.limit} if d.kind == "truncated" else {})
            for d in flat.dispersions
        },
    }


def _type(kind: type[Component]) -> str:
    """The registered name, which outlives moves of the class; else where the class stands."""
    name = type_name(kind)
    return name if name in component_entries() else f"{kind.__module__}.{kind.__qualname__}"


_OTHER = {"system": "another system", "seed": "another seed", "members": "other members"}


def first_difference(mine: Any, theirs: Any) -> tuple[str, str | None, Any, Any] | None:
    """Part and name of the first setting that differs, and what it is there and here.

    The name is None where a part differs that has no names; None is returned where nothing does.
    """
    for part, values in mine.items():
        other = (theirs or {}).get(part)
        if values == other:
            continue
        if isinstance(values, dict) and isinstance(other, dict):
            for name in sorted(set(values) | set(other)):
                if values.get(name) != other.get(name):
                    return part, name, other.get(name), values.get(name)
        return part, None, other, values
    return None


def difference(key: str, mine: Any, theirs: Any) -> str:
    """Say how a checkpoint's identity differs from that of the system it is given to."""
    if key != "configuration":
        return (
            f"the checkpoint belongs to {_OTHER[key]}: {theirs!r} there, {mine!r} here\n"
            f"  resume it with the {key} it was made with"
        )
    found = first_difference(mine, theirs)
    if found is None:
        return "the checkpoint was made with another configuration"
    part, name, there, here = found
    if name is None:
        return f"the checkpoint was made with other {part}: give the same system file and options"
    return (
        f"the checkpoint was made with other {part}: '{name}' is\n  {there} there\n  {here} here\n"
        "  give the same system file and --set options"
    )
