"""What the statistics say of a filter: consistent, overconfident, conservative, biased.

Each statistic tests hypotheses of its own (`Statistic.judge`). The level is shared among all
families of tests, and within each among epochs and axes (Bonferroni): the probability to accuse a
right filter of anything is at most the level, 1 %.

A bias raises NIS and NEES too, so what NIS says is left out of the verdict where there is a bias.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from terrafix.cosim.campaign.statistics.ensemble import Statistics
from terrafix.cosim.campaign.statistics.hypotheses import Finding

LEVEL = 0.01


@dataclass(frozen=True, repr=False)
class Verdict:
    """The verdict and what it rests on.

    Attributes
    ----------
    words : tuple of str
        The first is the verdict; ``("consistent",)`` where nothing was found.
    findings : list of Finding
    tests : int
        How many hypotheses were tested.
    """

    words: tuple[str, ...]
    findings: list[Finding] = field(default_factory=list)
    tests: int = 0

    @property
    def text(self) -> str:
        """One line."""
        return " and ".join(self.words)

    @property
    def reasons(self) -> list[str]:
        """What it rests on, in sentences."""
        if not self.findings:
            return [f"{self.tests} tests at a level of 1 % in all"]
        return [f"{f.word}: {f.text}" for f in self.findings]

    def summary(self) -> dict[str, Any]:
        """Plain types."""
        return {
            "verdict": self.text,
            "level": LEVEL,
            "tests": self.tests,
            "findings": [{"word": f.word, "text": f.text, "p": f.p} for f in self.findings],
        }

    def __repr__(self) -> str:
        """The verdict, and a line for each finding."""
        if not self.findings:
            return f"<Verdict: {self.text} ({self.reasons[0]})>"
        return f"<Verdict: {self.text}\n  " + "\n  ".join(self.reasons) + ">"


def judge(statistics: Statistics, *, level: float = LEVEL) -> Verdict:
    """Judge a filter by the statistics of its campaign.

    Parameters
    ----------
    statistics : Statistics
        Of at least d + 2 members at the end, where d is the number of axes.
    level : float
        Probability to accuse a right filter of anything, at most.
    """
    n_axes = len(statistics.layout.labels)
    if not (statistics.n >= n_axes + 2).any():
        return Verdict(("undecided",), [_too_few(statistics, n_axes)])
    share = level / sum(len(kind.families) for kind in statistics.kinds)
    evidence = {
        kind: kind.judge(statistics.layout, statistics.sums, share) for kind in statistics.present
    }
    biased = any(f.word == "biased" for findings, _ in evidence.values() for f in findings)
    found = [
        finding
        for kind, (findings, _) in evidence.items()
        for finding in findings
        if not (biased and kind.spoiled_by_bias)
    ]
    known = [f.word for f in found]
    words: list[str] = [w for w in ("biased", "overconfident", "conservative") if w in known]
    if "overconfident" in words and "conservative" in words:
        words.remove("conservative")  # said in the findings; what endangers a mission comes first
    if not words:
        words = list(dict.fromkeys(known))
    return Verdict(tuple(words) or ("consistent",), found, sum(n for _, n in evidence.values()))


def _too_few(statistics: Statistics, n_axes: int) -> Finding:
    most = int(statistics.n.max(initial=0))
    return Finding(
        "undecided", f"{most} members are too few for {n_axes} axes: fly {n_axes + 2} or more", 1.0
    )
