"""What a check of an FMU found: what, where, and why it matters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

ERROR, WARNING, NOTE = "error", "warning", "note"


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    Attributes
    ----------
    check : str
        Which check found it.
    severity : {"error", "warning", "note"}
        An error is a breach of the standard, and alone a finding. A warning is allowed and may
        hurt; a note says what was not checked, or what may surprise.
    where : str
        Variable, function or file.
    what : str
    why : str
        Why it matters.
    """

    check: str
    severity: str
    where: str
    what: str
    why: str = ""

    def summary(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return dict(vars(self))
