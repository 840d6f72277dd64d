"""What a campaign has found, taken up block by block."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.campaign.batch import BlockResult
from terrafix.cosim.campaign.statistics.ensemble import Statistics
from terrafix.cosim.campaign.statistics.statistic import SHOWN
from terrafix.cosim.campaign.verdict import Verdict

MOST_NAMED = 1000
"""Failed members listed in a result; all are counted, and all are in the blocks."""


@dataclass(repr=False)
class Outcome:
    """What a campaign has found.

    Attributes
    ----------
    system : str
    seed, runs : int
    statistics : dict of str to Statistics
        By evaluation component.
    verdicts : dict of str to Verdict
    excluded : list of dict
        Failed members, up to `MOST_NAMED`: ``member``, ``component``, ``t_s``, ``reason``.
    n_excluded : int
    parameters : dict of str to ndarray
        Dispersed parameters as they reached the components, of the first `SHOWN` members.
    kernel : str
    wall_s, setup_s : float
        Time of flying and merging; time to check and build before it.
    workers : str
        What flew it.
    configuration : dict
        Everything that was set.
    out : Path or None
    """

    system: str
    doc: str
    seed: int
    runs: int
    duration: Fraction
    configuration: dict[str, Any]
    statistics: dict[str, Statistics]
    workers: str
    setup_s: float
    wall_s: float = 0.0
    kernel: str = ""
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    excluded: list[dict[str, Any]] = field(default_factory=list)
    n_excluded: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    parameter_units: dict[str, str] = field(default_factory=dict)
    graph: str = ""
    source: dict[str, Any] = field(default_factory=dict)
    out: Path | None = None

    def add(self, block: BlockResult) -> None:
        """Take up the statistics and failures of one block; blocks come in order."""
        for path, sums in block.sums.items():
            self.statistics[path].add(sums)
        self.n_excluded += len(block.excluded)
        for each in block.excluded:
            self.reasons[each["reason"]] = self.reasons.get(each["reason"], 0) + 1
            if len(self.excluded) < MOST_NAMED:
                self.excluded.append(each)
        for name, values in block.parameters.items():
            before = [self.parameters[name]] if name in self.parameters else []
            if sum(map(len, before)) < SHOWN:
                self.parameters[name] = np.concatenate([*before, values])
        kinds = {k for k in [*self.kernel.split("+"), *block.kernel.split("+")] if k}
        self.kernel = "+".join(sorted(kinds))


def command(
    system: str,
    settings: Iterable[tuple[str, str]],
    *,
    runs: int,
    seed: int,
    duration: Fraction,
) -> str:
    """The command that flies a campaign again, for a shell: of all that was said, nothing left out.

    The duration is among it, for the file's may change.
    """
    words = ["terrafix", "campaign", system]
    for name, value in settings:
        words += ["--set", f"{name}={value}"]
    words += ["--runs", str(runs), "--seed", str(seed), "--duration", text_seconds(duration)]
    return shlex.join(words)
