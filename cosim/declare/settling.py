"""Components that take inputs while they find their start, as FMI's initialization mode has it.

When others are initialized, an input read at the start of a step holds nothing. A `Settling`
component takes the sources' initial outputs there too, and gives an output as soon as the inputs
that this depends on are known; so several that wait for each other can be started together.
"""

from __future__ import annotations

from collections.abc import Iterable

from terrafix.cosim.declare.component import Component


class Settling(Component):
    """Base of components whose start may follow from any connected signal.

    The master calls `begin_start` and `settle` where several wait for each other, and
    `initialize` in any case, once every input is known that will be.

    Attributes
    ----------
    known_at_start : frozenset of str or None
        Inputs that hold a value of t = 0 in `initialize`; None where nobody said.
    undriven : frozenset of str
        Inputs that nothing is connected to.
    in_parts : bool
        Whether it can give outputs before `initialize`.
    """

    known_at_start: frozenset[str] | None = None
    undriven: frozenset[str] = frozenset()
    in_parts = True

    def taken_at_start(self) -> set[str]:
        """Signal inputs that it takes before `initialize`, whenever a step reads them."""
        return {n for n, p in self.inputs().items() if p.kind == "signal" and not p.window}

    def needed_by(self, output: str) -> set[str]:
        """Inputs that an output depends on at t = 0."""
        return self.taken_at_start()

    def begin_start(self) -> None:
        """Make ready to settle."""

    def settle(self, known: Iterable[str], outputs: Iterable[str]) -> None:
        """Take the inputs that are known, and publish some outputs; may be repeated."""
        raise NotImplementedError(f"{type(self).__name__} must provide settle(known, outputs)")
