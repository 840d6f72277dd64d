"""``terrafix check-fmu``: FMPy's validation, and what no checker does.

Whatever calls the FMU runs in another process, check by check: a crash or hang is one finding, and
the next check gets a new process.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.errors import TerrafixError
from terrafix.cosim.exchange.fmi.check.binary_checks import check_binaries
from terrafix.cosim.exchange.fmi.check.findings import ERROR, NOTE, Finding
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION, MODEL_EXCHANGE
from terrafix.cosim.exchange.fmi.run.remote import ProcessError, Worker

CALLING = (
    "start",
    "run",
    "derivatives",
    "state",
    "reset",
    "instances",
    "cycles",
    "step size",
    "dependencies",
)
"""Checks that call the binary, as `terrafix.cosim.exchange.fmi.check.checks` has them."""
LIMIT = 120.0
"""Longest time of one check [s]."""


@dataclass
class Report:
    """What the checks of one FMU said.

    Attributes
    ----------
    path : Path
    fmi : {2, 3}
    model : str
    kinds : tuple of str
    checks : list of str
        What was checked.
    findings : list of Finding
        Errors and warnings.
    notes : list of Finding
    """

    path: Path
    fmi: int
    model: str
    kinds: tuple[str, ...]
    checks: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    notes: list[Finding] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether there is no finding."""
        return not self.findings

    def add(self, found: Finding) -> None:
        """File a finding, or a note."""
        into = self.notes if found.severity == NOTE else self.findings
        if found not in into:
            into.append(found)

    def summary(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return {
            "path": str(self.path),
            "ok": self.ok,
            "fmi": self.fmi,
            "model": self.model,
            "kinds": list(self.kinds),
            "checks": self.checks,
            "findings": [f.summary() for f in self.findings],
            "notes": [f.summary() for f in self.notes],
        }


def check_fmu(
    path: str | Path,
    *,
    progress: Callable[[str, float], None] | None = None,
    limit: float = LIMIT,
) -> Report:
    """Check an FMU.

    Raises
    ------
    ConfigurationError
        If it is no FMU, of FMI 1, damaged or unsafe.
    """
    archive = open_archive(path)
    description = archive.description
    offered = {
        CO_SIMULATION: description.coSimulation,
        MODEL_EXCHANGE: description.modelExchange,
    }
    kinds = [kind for kind, interface in offered.items() if interface is not None]
    report = Report(Path(path), archive.version, description.modelName or "", tuple(kinds))
    report.checks.append("description")
    for problem in _validated(path):
        report.add(
            Finding(
                "description", ERROR, "modelDescription.xml", problem,
                "importers that validate refuse the FMU",
            )
        )  # fmt: skip
    report.checks.append("library")
    for found in check_binaries(archive):
        report.add(found)
    calls = [(kind, name) for kind in kinds for name in CALLING]
    worker: Worker | None = None
    try:
        for number, (kind, name) in enumerate(calls):
            if progress is not None:
                progress(f"{name}, {kind}", number / len(calls))
            if name not in report.checks:
                report.checks.append(name)
            worker = worker or Worker("terrafix.cosim.exchange.fmi.check.checks", "the FMU")
            try:
                for found in worker.call("check", str(path), kind, name, limit=limit):
                    report.add(found)
            except ProcessError as error:
                worker.close(kill=True)
                worker = None
                report.add(Finding(name, ERROR, kind, str(error), "so does its importer's process"))
            except TerrafixError as error:
                report.add(Finding(name, ERROR, kind, str(error), "no importer gets further"))
                break
            if worker is not None and offered[kind].canBeInstantiatedOnlyOncePerProcess:
                worker.close()
                worker = None
    finally:
        if worker is not None:
            worker.close()
    return report


def _validated(path: str | Path) -> list[str]:
    """What FMPy's validation says."""
    from fmpy.validation import validate_fmu

    try:
        return [str(problem).strip().splitlines()[0] for problem in validate_fmu(str(path))]
    except Exception as error:  # FMPy raises many types for what it cannot read
        return [str(error)]
