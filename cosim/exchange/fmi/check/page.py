"""The page of a check: one HTML file that needs nothing outside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from terrafix.cosim.basics.files import writable_target, write_atomically
from terrafix.cosim.exchange.fmi.check.check import CALLING, Report
from terrafix.cosim.show.templates import filled

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_ASKED = {
    "description": "modelDescription.xml by the schema and rules of FMI (FMPy's validation)",
    "library": "binaries of all platforms: functions, symbols, libraries wanted",
    "start": "start values of the description against those in the binary",
    "run": "a start and steps with its own start values",
    "derivatives": "directional derivatives against differences",
    "state": "steps again after the state was set back, and from bytes in another instance",
    "reset": "steps again after a reset",
    "instances": "two instances at once against one alone",
    "cycles": "a thousand instances one after another",
    "step size": "steps that no master may ask for",
    "dependencies": "what changes although the description names no dependency",
}


def page(report: Report) -> str:
    """Write the page of a check."""
    found = [*report.findings, *report.notes]
    rank = {"error": 2, "warning": 1}
    worst: dict[str, int] = {}
    for each in found:
        worst[each.check] = max(worst.get(each.check, 0), rank.get(each.severity, 0))
    looked_at = {*report.checks, *(name for name, found in worst.items() if found)}
    said = ("no finding", "warnings", "breaches")
    return filled(
        _TEMPLATE,
        model=report.model or report.path.name,
        facts=_facts(report),
        findings=report.findings,
        warnings=report.warnings,
        notes=[each for each in report.notes if each not in report.warnings],
        asked=[
            (name, what, said[worst.get(name, 0)] if name in looked_at else "not checked")
            for name, what in _ASKED.items()
        ],
    )


def _facts(report: Report) -> list[tuple[str, Any]]:
    from importlib.metadata import version

    called = any(name in report.checks for name in CALLING)
    facts = [
        ("file", report.path),
        ("version", report.version),
        ("exported by", report.tool),
        ("on", report.generated),
        ("FMI", report.fmi),
        ("interfaces", ", ".join(report.kinds)),
        ("called", "yes, in a process of its own" if called else "no"),
        ("checked by", f"terrafix {version('terrafix')}, FMPy {version('fmpy')}"),
        ("at", report.checked),
    ]
    return [(term, value) for term, value in facts if value]


def write_page(report: Report, target: str | Path) -> Path:
    """Write the page of a check to a file.

    Raises
    ------
    ConfigurationError
        If the file cannot be written.
    """
    path = writable_target(target, (".html", ".htm"))
    text = page(report).encode()
    write_atomically(path, lambda f: f.write(text))
    return path
