"""Who is due, and when: components of one rate step together, and a heap holds their next ticks."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.system.check import Plan


class Group:
    """Components (or one recorder) that step at the same ticks.

    Attributes
    ----------
    tick : int
        Where it stands.
    next_tick : int or None
        Its next activation; None after the last.
    dt : float
        Length of the step to `tick` [s].
    spacing : int
        Ticks from one activation to the next; 0 where they are listed.
    sample : callable or None
        What looks on at this rate, where it is a recorder.
    """

    def __init__(
        self, rate: Rate, plan: Plan, sample: Callable[[float], None] | None = None
    ) -> None:
        self.rate = rate
        self.sample = sample
        self._base, self._grid = plan.base, plan.grid
        self._numerator, self._denominator = plan.base.numerator, plan.base.denominator
        self.spacing = 0 if rate.period is None else int(rate.period / plan.base)
        self.move_to(0)

    def move_to(self, tick: int) -> None:
        """Stand where everything up to and including `tick` has been done."""
        self._ticks: Iterator[int] = self.rate.ticks(self._base, self._grid, after=tick)
        self.tick = self.rate.last_tick(self._base, self._grid, tick)
        self.dt = 0.0
        self.next_tick = next(self._ticks, None)

    def advance(self) -> None:
        """Move to the next activation."""
        assert self.next_tick is not None
        self.dt = (self.next_tick - self.tick) * self._numerator / self._denominator
        self.tick = self.next_tick
        self.next_tick = next(self._ticks, None)


class Agenda:
    """The groups of a system by number, and what is due next.

    Attributes
    ----------
    groups : list of Group
    heap : list of (int, int)
        Next tick and number of every group that has one, the first of all in front.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self.groups: list[Group] = []
        self.heap: list[tuple[int, int]] = []

    def number(self, rate: Rate) -> int:
        """Number of the group that steps at a rate."""
        for number, group in enumerate(self.groups):
            if group.rate == rate and group.sample is None:
                return number
        self.groups.append(Group(rate, self._plan))
        return len(self.groups) - 1

    def observe(self, rate: Rate, sample: Callable[[float], None]) -> None:
        """Add a recorder."""
        self.groups.append(Group(rate, self._plan, sample))

    def move_to(self, tick: int) -> None:
        """Stand where everything up to and including `tick` has been done."""
        for group in self.groups:
            group.move_to(tick)
        self.heap = [(g.next_tick, i) for i, g in enumerate(self.groups) if g.next_tick is not None]
        heapq.heapify(self.heap)

    def due(self, tick: int) -> tuple[int, ...]:
        """Numbers of the groups whose next activation is `tick`, the next of all."""
        heap = self.heap
        if all(later[0] > tick for later in heap[1:3]):  # the children of the root
            return (heap[0][1],)
        return tuple(sorted(number for next_tick, number in heap if next_tick == tick))

    def advance(self, due: tuple[int, ...]) -> None:
        """Move the groups that are due to their activation."""
        for number in due:  # in the order of the heap
            self.groups[number].advance()
            self._rearm(number)

    def leap(self, number: int, tick: int) -> None:
        """Move the group that is due alone past several activations, up to `tick`."""
        self.groups[number].move_to(tick)
        self._rearm(number)

    def _rearm(self, number: int) -> None:
        next_tick = self.groups[number].next_tick
        if next_tick is None:
            heapq.heappop(self.heap)
        else:
            heapq.heapreplace(self.heap, (next_tick, number))

    def alone(self, number: int, end: int) -> int:
        """How many activations the group that is due alone has up to `end` before anybody else's.

        Recorders look on once the others have stepped: they do not shorten it by their own tick.
        0 where its next activation is not like those that follow.
        """
        group = self.groups[number]
        first, spacing = group.next_tick, group.spacing
        assert first is not None
        if not spacing or first - group.tick != spacing:
            return 0
        others = (t - (self.groups[i].sample is None) for t, i in self.heap if i != number)
        last = min(end, *others) if len(self.heap) > 1 else end
        return (last - first) // spacing + 1
