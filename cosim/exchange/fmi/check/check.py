"""``terrafix check-fmu``: FMPy's validation, and what no checker does.

Whatever calls the FMU runs in another process, check by check: a crash or hang is one finding, and
the next check gets a new process.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.exchange.fmi.check.binary_checks import check_binaries
from terrafix.cosim.exchange.fmi.check.findings import ERROR, NOTE, WARNING, Finding
from terrafix.cosim.exchange.fmi.run.archive import is_c_name, open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION, MODEL_EXCHANGE
from terrafix.cosim.exchange.fmi.run.remote import FIRST_LIMIT, ProcessError, Worker

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
WRONG_STEPS = ("negative", "NaN", "fraction")
"""Steps that no master may ask for; an FMU need not answer."""
WRONG_STEP_LIMIT = 5.0


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
        Breaches of the standard.
    notes : list of Finding
        Warnings and notes.
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

    @property
    def warnings(self) -> list[Finding]:
        """Notes of what is allowed and may hurt."""
        return [found for found in self.notes if found.severity == WARNING]

    def add(self, found: Finding) -> None:
        """File a finding, or a note."""
        into = self.findings if found.severity == ERROR else self.notes
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
    if archive.version == 1:
        raise ConfigurationError(
            f"'{path}' is an FMU of FMI 1.0; terrafix runs it, and checks FMI 2 and 3 alone\n"
            f"  FMPy validates its description: fmpy validate {path}"
        )
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
    for identifier in {offered[kind].modelIdentifier for kind in kinds}:
        if not is_c_name(identifier):
            report.add(
                Finding(
                    "description", ERROR, "modelIdentifier",
                    f"'{identifier}' is no name as in C",
                    "functions of an FMU in C source code, and those of FMI 1, are named after it",
                )
            )  # fmt: skip
    report.checks.append("library")
    for found in check_binaries(archive):
        report.add(found)
    if getattr(description, "scheduledExecution", None) is not None:
        report.kinds += ("scheduled execution",)
        report.add(
            Finding(
                "run", NOTE, "scheduled execution", "it is not checked: only what the FMU offers "
                "besides, its description and its binaries are",
            )
        )  # fmt: skip
    calls = [(kind, name) for kind in kinds for name in CALLING]
    worker: Worker | None = None
    try:
        for number, (kind, name) in enumerate(calls):
            if progress is not None:
                progress(f"{name}, {kind}", number / len(calls))
            if name not in report.checks:
                report.checks.append(name)
            try:
                worker = worker or _fresh(path, kind)
                once = bool(offered[kind].canBeInstantiatedOnlyOncePerProcess)
                if name == "step size":
                    worker = _wrong_steps(worker, report, kind, once=once)
                else:
                    for found in worker.call("check", str(path), kind, name, limit=limit):
                        report.add(found)
                if once and worker is not None:
                    worker.close()
                    worker = None
            except ProcessError as error:
                if worker is not None:
                    worker.close(kill=True)
                worker = None
                report.add(Finding(name, ERROR, kind, str(error), "so does its importer's process"))
            except TerrafixError as error:
                report.add(Finding(name, ERROR, kind, str(error), "no importer gets further"))
                break
    finally:
        if worker is not None:
            worker.close()
    return report


def _fresh(path: str | Path, kind: str) -> Worker:
    """A process with the FMU loaded; the time that takes is none of a check's."""
    worker = Worker("terrafix.cosim.exchange.fmi.check.checks", "the FMU")
    try:
        worker.call("load", str(path), kind, limit=FIRST_LIMIT)
    except BaseException:
        worker.close(kill=True)
        raise
    return worker


def _wrong_steps(worker: Worker, report: Report, kind: str, *, once: bool) -> Worker | None:
    """Ask for steps that no master may ask for, each within a few seconds; `once`: a process."""
    now: Worker | None = worker
    for case in WRONG_STEPS if kind == CO_SIMULATION else ():
        now = now or _fresh(report.path, kind)
        name = f"step size, {case}"
        try:
            for found in now.call("check", str(report.path), kind, name, limit=WRONG_STEP_LIMIT):
                report.add(found)
        except ProcessError as error:
            now.close(kill=True)
            now = None
            what = {"negative": "a negative step", "NaN": "a step of NaN"}.get(case, "a fraction")
            report.add(
                Finding(
                    "step size", WARNING, "doStep", f"asked for {what}, {error}",
                    "one wrong step costs the whole process",
                )
            )  # fmt: skip
        if once and now is not None:
            now.close()
            now = None
    return now


def _validated(path: str | Path) -> list[str]:
    """What FMPy's validation says."""
    from fmpy.validation import validate_fmu

    try:
        return [str(problem).strip().splitlines()[0] for problem in validate_fmu(str(path))]
    except Exception as error:  # FMPy raises many types for what it cannot read
        return [str(error)]
