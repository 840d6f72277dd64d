"""What terrafix raises: one type per kind of mistake, all under `TerrafixError`.

A message says what was attempted, what each side is, and the next thing to try.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import Any


class TerrafixError(Exception):
    """Base of every error raised on purpose."""


class ConfigurationError(TerrafixError):
    """A name, value, file or option that cannot be used."""


class WiringError(TerrafixError):
    """Ports that cannot be connected, or are not connected though they must be."""


class RateError(TerrafixError):
    """A period, offset, delay or time that is not exact or does not fit."""


class CheckpointError(TerrafixError):
    """A checkpoint that cannot be written, read, or used with this system."""


class StepError(TerrafixError):
    """A component that failed while the simulation was running."""


class ComponentError(StepError):
    """What a component raised, with all members that it stepped.

    Attributes
    ----------
    component : str
        Its path.
    tick : int
    t_s : float
    reason : str
        What it raised, in one line or more.
    """

    def __init__(self, component: str, tick: int, t_s: float, reason: str) -> None:
        super().__init__(f"'{component}' failed at t = {t_s:.9g} s (tick {tick})\n  {reason}")
        self.component, self.tick, self.t_s, self.reason = component, tick, t_s, reason

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.component, self.tick, self.t_s, self.reason)


class EpochError(ConfigurationError):
    """An epoch that is missing, or that cannot be used: said once for all who ask for it."""


class SystemCheckError(TerrafixError):
    """Every problem found in one system, reported together.

    Attributes
    ----------
    problems : tuple of TerrafixError
        At least one.
    """

    def __init__(self, system: str, problems: Sequence[TerrafixError], file: str = "") -> None:
        self.system, self.file = system, file
        self.problems = tuple(problems)
        count = len(self.problems)
        where = f" ({file})" if file else ""
        lines = [f"system '{system}'{where} has {count} problem{'s' if count > 1 else ''}"]
        lines += [f"{type(p).__name__}: {p}" for p in self.problems]
        super().__init__("\n".join(lines))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.system, self.problems, self.file)


def nearest(name: str, candidates: Iterable[str], *, what: str = "") -> str:
    """Return a hint naming the nearest candidate, or all of them if none is near.

    Parameters
    ----------
    name : str
        What was written.
    candidates : iterable of str
        What could have been meant.
    what : str
        Plural noun for the candidates, used when none is near.
    """
    names = sorted(set(candidates))
    lowered = {n.lower(): n for n in names}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.6)
    if close:
        return f"did you mean '{lowered[close[0]]}'?"
    if not names:
        return f"there are no {what}" if what else "there is nothing to choose from"
    return f"{what or 'known'}: {', '.join(names)}"
