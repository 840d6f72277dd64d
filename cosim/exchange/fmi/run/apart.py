"""The process of `RemoteFleet`, and processes of one member each.

Where instances of an FMU disturb each other, each lives in a fork of this process, which has not
loaded the binary: so each has the static data of the file.
"""

from __future__ import annotations

import gc
import os
import signal
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import TerrafixError
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import callbacks_of_fmi2
from terrafix.cosim.exchange.fmi.run.fleet import Ended, Failures, Fleet, Group, Message, Setup
from terrafix.cosim.exchange.fmi.run.reading import REAL
from terrafix.cosim.exchange.fmi.run.remote import (
    answer_requests,
    answered,
    how_it_ended,
    no_answer,
    send,
    serve,
)
from terrafix.cosim.exchange.fmi.run.whole import INTEGER

STEPS = 10
"""Steps of the self-test."""


class _Fork:
    """A copy of this process that calls what it is told to."""

    def __init__(self, functions: Callable[[], dict[str, Any]]) -> None:
        for_it, requests = os.pipe()
        answers, from_it = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # a thread waits for our end
            self._pid = os.fork()
        if not self._pid:
            _live_as_a_fork(functions, for_it, from_it)
        os.close(for_it)
        os.close(from_it)
        self._requests, self._answers = os.fdopen(requests, "wb"), os.fdopen(answers, "rb")
        self._number = 0
        self._status: int | None = None

    def ask(self, name: str, *arguments: Any) -> None:
        """Ask for a call; `answer` has its result."""
        self._number += 1
        with suppress(OSError):  # where it is gone, there is no answer
            send(self._requests, (self._number, name, arguments))

    def answer(self, limit: float) -> Any:
        """What the last call returned.

        Raises
        ------
        ForkError
            If the fork ends or does not answer in time; it is ended.
        TerrafixError
            What the function raised.
        """
        try:
            kind, value = answered(self._answers, self._number, limit, self._alive)
        except TimeoutError:
            self.end()
            raise ForkError(f"the FMU {no_answer(limit)}") from None
        except (OSError, EOFError):
            raise ForkError(f"the FMU {how_it_ended(self.end(0.5))}") from None
        if kind == "error":
            raise value
        return value

    def _alive(self) -> bool:
        if self._status is None:
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            self._status = os.waitstatus_to_exitcode(status) if pid else None
        return self._status is None

    def end(self, grace: float = 0.0) -> int:
        """End it; its exit status."""
        for stream in (self._requests, self._answers):
            with suppress(OSError):
                stream.close()
        until = time.monotonic() + grace
        while self._alive() and time.monotonic() < until:
            time.sleep(0.01)
        if self._alive():
            os.kill(self._pid, signal.SIGKILL)
            self._status = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        assert self._status is not None
        return self._status


class ForkError(TerrafixError):
    """The process of a member ended or did not answer."""


def _live_as_a_fork(functions: Callable[[], dict[str, Any]], requests: int, answers: int) -> None:
    """Answer requests, and end without what belongs to the process that was copied."""
    try:
        handles = {int(path.name) for path in Path("/dev/fd").iterdir()}
        for handle in handles - {0, 1, 2, requests, answers}:
            with suppress(OSError):  # that of the list itself
                os.close(handle)
        try:
            found = functions()
        except TerrafixError as error:  # the binary cannot be loaded, say
            found = _Refusing(error)
        answer_requests(found, os.fdopen(requests, "rb"), os.fdopen(answers, "wb"))
    finally:
        os._exit(0)


class _Refusing(dict[str, Any]):
    """Functions none of which can be called, for one reason."""

    def __init__(self, error: TerrafixError) -> None:
        super().__init__()
        self._error = error

    def __missing__(self, name: str) -> Any:
        raise self._error


class FleetApart:
    """What `Fleet` is, with a process for each member.

    Parameters
    ----------
    setup : Setup
    n_members : int
    limit : float
        Longest answer of a member [s].
    """

    def __init__(self, setup: Setup, n_members: int, limit: float) -> None:
        self.setup = setup
        self.inputs = np.zeros((n_members, sum(g.size for g in setup.inputs)))
        self.outputs = np.zeros((n_members, sum(g.size for g in setup.outputs)))
        self._limit = limit
        self._log: list[tuple[int, int, str]] = []
        self._forks: dict[int, _Fork] = {}
        _prepare(setup)

    def enter(self, active: NDArray[np.bool_]) -> Failures:
        """As `Fleet.enter`."""
        for row in np.flatnonzero(active).tolist():
            self._forks[row] = _Fork(partial(_one_member, _of_one(self.setup, row)))
        return self._exchange("enter", lambda _: (np.ones(1, np.bool_),))

    def settle(self, known: Sequence[Group] | None, wanted: Sequence[Group]) -> Failures:
        """As `Fleet.settle`."""
        return self._exchange("settle", lambda _: (known, wanted))

    def leave(
        self,
        active: NDArray[np.bool_],
        messages: Sequence[Message] = (),
        known: Sequence[Group] | None = None,
    ) -> Failures:
        """As `Fleet.leave`."""
        return self._exchange(
            "leave", lambda row: (active[row : row + 1], _for_one(messages, row), known)
        )

    def step(
        self,
        t: float,
        h: float,
        messages: Sequence[Message] = (),
        skipped: Sequence[int] = (),
    ) -> Failures:
        """As `Fleet.step`."""
        for row in skipped:
            self._end(row)
        return self._exchange("step", lambda row: (t, h, _for_one(messages, row)))

    def _exchange(self, name: str, arguments: Callable[[int], tuple[Any, ...]]) -> Failures:
        for row, fork in self._forks.items():
            fork.ask(name, self.inputs[row : row + 1], *arguments(row))
        failures: Failures = {}
        for row, (own, outputs, log) in self._answers(failures).items():
            self.outputs[row] = outputs[0]
            self._log += [(row, status, text) for _, status, text in log]
            if own:
                failures[row] = own[0]
        for row, said in failures.items():
            if isinstance(said, Ended) and row in self._forks:
                self._forks[row].ask("close")
                with suppress(TerrafixError):
                    self._forks[row].answer(self._limit)
            self._end(row)
        return failures

    def take_log(self) -> Sequence[tuple[int, int, str]]:
        """As `Fleet.take_log`."""
        found, self._log = self._log, []
        return found

    def _answers(self, failures: Failures | None = None) -> dict[int, Any]:
        """What each fork answers; the deaths of forks are failures."""
        found = {}
        for row, fork in self._forks.items():
            try:
                found[row] = fork.answer(self._limit)
            except ForkError as error:
                if failures is None:
                    raise
                failures[row] = str(error)
        return found

    def _end(self, row: int) -> None:
        fork = self._forks.pop(row, None)
        if fork is not None:
            fork.end()

    def _all(self, name: str) -> dict[int, Any]:
        for fork in self._forks.values():
            fork.ask(name)
        return self._answers()

    def save(self) -> list[bytes]:
        """As `Fleet.save`."""
        saved = self._all("save")
        return [saved[row][0] if row in saved else b"" for row in range(len(self.inputs))]

    def restore(self, saved: Sequence[bytes]) -> None:
        """As `Fleet.restore`."""
        for row, fork in self._forks.items():
            fork.ask("restore", [saved[row]])
        self._answers()

    def mark(self) -> None:
        """As `Fleet.mark`."""
        self._all("mark")

    def return_to_mark(self) -> None:
        """As `Fleet.return_to_mark`."""
        self._all("return_to_mark")

    def close(self) -> None:
        """Free every instance and end the processes."""
        for fork in self._forks.values():
            fork.ask("close")
        self._answers({})
        for row in list(self._forks):
            self._end(row)


def _prepare(setup: Setup) -> None:
    """Read the file and import what instances need, once for all forks."""
    open_archive(setup.file)
    callbacks_of_fmi2(0)
    gc.freeze()  # their memory stays shared


def _one_member(setup: Setup) -> dict[str, Any]:
    return _fleet_functions(Fleet(setup, 1))


def _of_one(setup: Setup, row: int) -> Setup:
    """The setup of a member alone."""
    return replace(setup.of([row]), name=f"{setup.name}_{row}")


def _for_one(messages: Sequence[Message], row: int) -> list[Message]:
    return [
        replace(m, rows=np.zeros(1, np.int64), values=m.values[m.rows == row])
        for m in messages
        if (m.rows == row).any()
    ]


# --------------------------------------------------------------------------------- self-test


@dataclass(frozen=True)
class Disturbance:
    """How an instance shows that it is not alone.

    Attributes
    ----------
    column : int
        Of the outputs, or -1 where there are none to compare.
    alone, beside : float
        Values of that output.
    said : str
        What the FMU said where it failed.
    """

    column: int
    alone: float = 0.0
    beside: float = 0.0
    said: str = ""


def rehearse(setup: Setup, inputs: FloatArray, h: float, limit: float) -> Disturbance | None:
    """Step two members for a while, alone and together, and one after the other.

    Parameters
    ----------
    setup : Setup
    inputs : ndarray, shape (2, width)
        Rows of the two. Real inputs move away from them, differently in each member; where the FMU
        refuses that, they stand still, and where it refuses these, none is set.
    h : float
        Step [s].
    limit : float
        Longest time of all [s].

    Returns
    -------
    Disturbance or None
        None also where it cannot be told: an FMU that fails alone, or is never twice the same.
    """
    _prepare(setup)
    untouched = replace(setup, inputs=()), inputs[:, :0], False  # with the FMU's own inputs
    for tried, rows, moved in ((setup, inputs, True), (setup, inputs, False), untouched):
        plays = [(0,)], [(0,)], [(1,)], [(0, 1)], [(0,), (0,)]
        parts = [partial(_play, tried, rows, h, play, moved) for play in plays]
        first, again, second, both, after = _played(parts, limit)
        if isinstance(first, str) or isinstance(second, str) or isinstance(again, str):
            continue  # it does not take these inputs
        kinds = _kinds(setup)
        if not _same(kinds, first[-1], again[-1]).all():
            return None
        expected = np.concatenate([first[-1], second[-1]], axis=1), first[-1]
        for alone, beside in zip(expected, (both, after), strict=True):
            if isinstance(beside, str):
                return Disturbance(-1, said=beside)
            same = _same(kinds, alone, beside[-1])
            if not same.all():
                return _difference(kinds, alone, beside[-1], same)
        return None
    return None


def _kinds(setup: Setup) -> list[str]:
    """Type of each column of the outputs."""
    return [group.kind for group in setup.outputs for _ in range(group.size)]


def _same(kinds: Sequence[str], alone: FloatArray, beside: FloatArray) -> NDArray[np.bool_]:
    """Where two are equal, (..., width); of whole numbers, all 64 bits."""
    whole = np.array([kind in INTEGER for kind in kinds], np.bool_)
    bits = alone.view(np.int64) == beside.view(np.int64)
    real = (alone == beside) | (np.isnan(alone) & np.isnan(beside))
    found: NDArray[np.bool_] = np.where(whole, bits, real)
    return found


def _difference(
    kinds: Sequence[str], alone: FloatArray, beside: FloatArray, same: NDArray[np.bool_]
) -> Disturbance:
    at = tuple(np.argwhere(~same)[-1])
    column = int(at[-1])
    whole = kinds[column] in INTEGER
    values = [(rows.view(np.int64) if whole else rows)[at].item() for rows in (alone, beside)]
    return Disturbance(column, *values)


def _play(
    setup: Setup, inputs: FloatArray, h: float, casts: Sequence[tuple[int, ...]], moved: bool
) -> list[FloatArray] | str:
    """Outputs of the members of each cast, (STEPS + 1, n, width), one cast after another."""
    seen = []
    for rows in casts:
        chosen = list(rows)
        fleet = Fleet(setup.of(chosen), len(rows))
        fleet.inputs[...] = inputs[chosen]
        everybody = np.ones(len(rows), np.bool_)
        failures = fleet.enter(everybody) | fleet.leave(everybody)
        found = [fleet.outputs.copy()]
        for k in range(STEPS):
            if moved:
                fleet.inputs[...] = _moved(setup, inputs, k)[chosen]
            failures |= fleet.step(setup.start_time + k * h, h)
            found.append(fleet.outputs.copy())
        if failures:
            return next(iter(failures.values()))
        fleet.close()
        seen.append(np.array(found))
    return seen


def _moved(setup: Setup, inputs: FloatArray, k: int) -> FloatArray:
    moved = inputs.copy()
    member = 1.0 + np.arange(len(inputs))[:, None]
    for group in setup.inputs:
        if group.kind in REAL:
            columns = slice(group.start, group.start + group.size)
            by = 0.01 * (k + 1) * member
            moved[:, columns] += by * (1 + np.abs(inputs[:, columns]))
    return moved


def _played(plays: Sequence[Callable[[], Any]], limit: float) -> list[Any]:
    """What each returned, in a fork of its own; the text of what ended a fork."""
    forks = [_Fork(partial(dict, play=play)) for play in plays]
    found: list[Any] = []
    for fork in forks:
        fork.ask("play")
    for fork in forks:
        try:
            found.append(fork.answer(limit))
        except TerrafixError as error:
            found.append(str(error))
        fork.end()
    return found


# --------------------------------------------------------------------------------- process


def main() -> None:
    """Run a fleet for another process."""

    def make(setup: Setup, n_members: int, apart: float | None) -> None:
        fleet = Fleet(setup, n_members) if apart is None else FleetApart(setup, n_members, apart)
        functions.update(_fleet_functions(fleet))

    functions: dict[str, Any] = {"make": make, "rehearse": rehearse}
    serve(functions)


def _fleet_functions(fleet: Any) -> dict[str, Any]:
    """What another process may ask of a fleet."""

    def exchange(name: str) -> Any:
        def call(inputs: NDArray[np.float64], *arguments: Any) -> Any:
            fleet.inputs[...] = inputs
            failures = getattr(fleet, name)(*arguments)
            return failures, fleet.outputs, fleet.take_log()

        return call

    plain = ("save", "restore", "mark", "return_to_mark", "close")
    exchanging = ("enter", "settle", "leave", "step")
    return {name: exchange(name) for name in exchanging} | {
        name: getattr(fleet, name) for name in plain
    }
