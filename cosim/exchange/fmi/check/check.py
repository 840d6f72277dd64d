"""``terrafix check-fmu``: FMPy's validation, and what no checker does.

Whatever calls the FMU runs in another process, check by check: a crash or hang is one finding, and
the next check gets a new process.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.exchange.fmi.check.binary_checks import check_binaries
from terrafix.cosim.exchange.fmi.check.checks import NOT_MADE
from terrafix.cosim.exchange.fmi.check.findings import ERROR, NOTE, WARNING, Finding
from terrafix.cosim.exchange.fmi.run.archive import Archive, is_c_name, open_archive
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
WRONG_STEPS = ("negative", "zero", "NaN", "fraction", "past")
"""Steps that no master may ask for; an FMU need not answer, save that past the stop time."""
_WRONG = {
    "negative": "a negative step",
    "zero": "a step of zero",
    "NaN": "a step of NaN",
    "fraction": "a fraction of its step",
    "past": "a step past the stop time",
}
_REPEATED = ("state", "reset", "instances", "derivatives", "dependencies")
"""Checks that mean something if the FMU is twice the same."""
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
    version, tool, generated : str
        Of the model, of its exporter, and when, as its description says (empty: nothing).
    checked : str
        When, in UTC.
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
    version: str = ""
    tool: str = ""
    generated: str = ""
    checked: str = field(default_factory=lambda: f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}")
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
            "version": self.version,
            "tool": self.tool,
            "generated": self.generated,
            "checked": self.checked,
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
    report = Report(
        Path(path),
        archive.version,
        description.modelName or "",
        tuple(kinds),
        description.version or "",
        description.generationTool or "",
        description.generationDateAndTime or "",
    )
    report.checks.append("description")
    for problem in _validated(archive):
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
    kinds = [kind for kind in kinds if _has_binary(archive, kind, report)]
    calls = [(kind, name) for kind in kinds for name in CALLING]
    given_up: set[str] = set()
    worker: Worker | None = None
    try:
        for number, (kind, name) in enumerate(calls):
            if kind in given_up:
                continue
            if progress is not None:
                progress(f"{name}, {kind}", number / len(calls))
            fresh = bool(offered[kind].canBeInstantiatedOnlyOncePerProcess)
            try:
                worker = worker or _fresh(path, kind)
                if name not in report.checks:
                    report.checks.append(name)
                if name == "step size":
                    worker = _wrong_steps(worker, report, kind, once=fresh)
                else:
                    found = worker.call("check", str(path), kind, name, limit=limit)
                    for each in _repeatable(path, kind, name, found):
                        report.add(each)
                    if name == "start" and any(f.what.startswith(NOT_MADE) for f in found):
                        given_up.add(kind)
                    fresh |= name == "cycles" and bool(found)
                if fresh and worker is not None:
                    worker.close()
                    worker = None
            except ProcessError as error:
                if worker is not None:
                    worker.close(kill=True)
                worker = None
                report.add(Finding(name, ERROR, kind, str(error), "so does its importer's process"))
            except TerrafixError as error:
                cannot = isinstance(error, ConfigurationError) and "cannot be loaded" in str(error)
                severity = WARNING if cannot else ERROR
                report.add(Finding(name, severity, kind, str(error), "no importer gets further"))
                given_up.add(kind)
    finally:
        if worker is not None:
            worker.close()
    return report


def _has_binary(archive: Archive, kind: str, report: Report) -> bool:
    """Whether this machine can call the FMU; the report says where it cannot."""
    description = archive.description
    interface = description.coSimulation if kind == CO_SIMULATION else description.modelExchange
    try:
        archive.binary(interface.modelIdentifier)
    except ConfigurationError as error:
        why = str(error).splitlines()[0].removeprefix(f"'{archive.path}' ")
        said = f"it was not called: it {why}"
        report.add(Finding("run", NOTE, kind, said, "what it does there was not checked"))
        return False
    return True


def _repeatable(path: str | Path, kind: str, name: str, found: list[Finding]) -> Iterator[Finding]:
    """Findings; notes of an FMU that is not twice the same, which differs for that reason."""
    doubtful = name in _REPEATED and any(f.severity != NOTE for f in found)
    if not doubtful or _same_twice(path, kind):
        yield from found
        return
    for each in found:
        if each.severity == NOTE:
            yield each
    yield Finding(name, NOTE, kind, "two processes get different outputs from it: nothing follows "
                  "from what differs")  # fmt: skip


def _same_twice(path: str | Path, kind: str) -> bool:
    """Whether the FMU gives the same outputs in two processes."""
    samples = []
    for _ in range(2):
        worker = _fresh(path, kind)
        try:
            samples.append(worker.call("sample", str(path), kind, limit=FIRST_LIMIT))
        except TerrafixError:
            return True  # as far as it can be told
        finally:
            worker.close()
    first, second = samples
    return bool(np.array_equal(first, second, equal_nan=True))


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
            report.add(
                Finding(
                    "step size", WARNING, "doStep", f"asked for {_WRONG[case]}, {error}",
                    "one wrong step costs the whole process",
                )
            )  # fmt: skip
        if once and now is not None:
            now.close()
            now = None
    return now


def _validated(archive: Archive) -> list[str]:
    """What FMPy's validation says, and the standard too."""
    from fmpy.validation import validate_fmu

    try:
        found = [str(p).strip().splitlines()[0] for p in validate_fmu(str(archive.path))]
    except Exception as error:  # FMPy raises many types for what it cannot read
        return [str(error)]
    return [problem for problem in found if not _is_of_clocks(problem, archive)]


def _is_of_clocks(problem: str, archive: Archive) -> bool:
    """Whether initial unknowns differ by clocks, which have no start, and clocked variables.

    FMI 3.0 lists outputs that are no "clocked variables" and have an `initial`, and clocked
    variables "that the FMU wishes to initialize".
    """
    match = re.search(r"InitialUnknowns .*Expected \{(.*)\} but was \{(.*)\}\.$", problem)
    if match is None:
        return False
    expected, given = (set(filter(None, map(str.strip, s.split(",")))) for s in match.groups())
    variables = {v.name: v for v in archive.description.modelVariables}
    return all(
        name in variables and (variables[name].type == "Clock" or variables[name].clocks)
        for name in expected ^ given
    )
