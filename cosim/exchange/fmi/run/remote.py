"""A fleet in a process of its own: a crash or hang there is an error here, and no more.

The other process is ``python -m terrafix.cosim.exchange.fmi.run.remote``. Requests and answers are
pickled frames over its standard input and output, between two processes of ours; what the FMU
itself prints goes to standard error.
"""

from __future__ import annotations

import os
import pickle
import selectors
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.exchange.fmi.run.fleet import Failures, Fleet, Group, Message, Setup

_HEADER = struct.Struct("<Q")
FIRST_LIMIT = 60.0  # imports and unpacking take their time [s]


class ProcessError(TerrafixError):
    """The process that runs foreign code crashed or did not answer."""


class Worker:
    """A process that calls what it is told to.

    Parameters
    ----------
    module : str
        Run with ``python -m``; it calls `serve`.
    what : str
        Names the foreign code in errors.
    """

    def __init__(self, module: str, what: str) -> None:
        self._what = what
        self._process = subprocess.Popen(
            [sys.executable, "-m", module], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests: Any = self._process.stdin
        self._answers: Any = self._process.stdout

    def call(self, name: str, *arguments: Any, limit: float) -> Any:
        """Call a function there and return what it returns, within `limit` seconds.

        Raises
        ------
        ProcessError
            If the process crashes or does not answer in time; it is ended.
        TerrafixError
            What the function raised.
        """
        process = self._process
        try:
            _send(self._requests, (name, arguments))
            answer = _receive(self._answers, time.monotonic() + limit)
        except TimeoutError:
            self.close(kill=True)
            raise ProcessError(f"{self._what} did not answer within {limit:g} s") from None
        except (OSError, EOFError):
            status = process.wait()
            signal = f"signal {-status}" if status < 0 else f"exit status {status}"
            raise ProcessError(f"{self._what} crashed its process ({signal})") from None
        kind, value = answer
        if kind == "error":
            raise value
        return value

    def close(self, *, kill: bool = False) -> None:
        """End the process."""
        process = self._process
        if kill:
            process.kill()
        with suppress(OSError):
            self._requests.close()
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._answers.close()


def _send(stream: Any, value: Any) -> None:
    data = pickle.dumps(value, protocol=5)
    stream.write(_HEADER.pack(len(data)) + data)
    stream.flush()


def _receive(stream: Any, deadline: float | None = None) -> Any:
    (size,) = _HEADER.unpack(_exactly(stream, _HEADER.size, deadline))
    return pickle.loads(_exactly(stream, size, deadline))


def _exactly(stream: Any, n: int, deadline: float | None) -> bytes:
    """Read n bytes; TimeoutError after the deadline, EOFError at the end."""
    parts: list[bytes] = []
    handle = stream.fileno()
    with selectors.DefaultSelector() as selector:
        selector.register(handle, selectors.EVENT_READ)
        while n:
            if deadline is not None and not selector.select(max(0.0, deadline - time.monotonic())):
                raise TimeoutError
            part = os.read(handle, min(n, 1 << 20))
            if not part:
                raise EOFError
            parts.append(part)
            n -= len(part)
    return b"".join(parts)


def serve(functions: dict[str, Any]) -> None:
    """Answer requests until the other side closes its end."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what foreign code prints is not an answer
    requests = os.fdopen(os.dup(0), "rb")
    while True:
        try:
            name, arguments = _receive(requests)
        except EOFError:
            return
        try:
            answer = ("value", functions[name](*arguments))
        except TerrafixError as error:
            answer = ("error", type(error)(str(error)))
        except Exception as error:
            answer = ("error", ConfigurationError(f"{type(error).__name__}: {error}"))
        _send(answers, answer)


class RemoteFleet:
    """What `Fleet` is, in a process of its own."""

    def __init__(self, setup: Setup, n_members: int, limit: float) -> None:
        self.setup = setup
        self.inputs = np.zeros((n_members, sum(g.size for g in setup.inputs)))
        self.outputs = np.zeros((n_members, sum(g.size for g in setup.outputs)))
        self.driven = False
        self._limit = limit
        self._worker = Worker("terrafix.cosim.exchange.fmi.run.remote", f"the FMU '{setup.file}'")
        self._worker.call("make", setup, n_members, limit=FIRST_LIMIT)

    def start(
        self,
        active: NDArray[np.bool_],
        messages: Sequence[Message] = (),
        known: Sequence[Group] | None = None,
    ) -> Failures:
        """As `Fleet.start`."""
        return self._exchange("start", active, messages, known)

    def enter(self, active: NDArray[np.bool_]) -> Failures:
        """As `Fleet.enter`."""
        return self._exchange("enter", active)

    def settle(self, known: Sequence[Group] | None, wanted: Sequence[Group]) -> Failures:
        """As `Fleet.settle`."""
        return self._exchange("settle", known, wanted)

    def leave(
        self,
        active: NDArray[np.bool_],
        messages: Sequence[Message] = (),
        known: Sequence[Group] | None = None,
    ) -> Failures:
        """As `Fleet.leave`."""
        return self._exchange("leave", active, messages, known)

    def step(
        self,
        t: float,
        h: float,
        messages: Sequence[Message] = (),
        skipped: Sequence[int] = (),
    ) -> Failures:
        """As `Fleet.step`."""
        return self._exchange("step", t, h, messages, skipped)

    def _exchange(self, name: str, *arguments: Any) -> Failures:
        failures, outputs = self._worker.call(name, self.inputs, *arguments, limit=self._limit)
        self.outputs[...] = outputs
        return dict(failures)

    def save(self) -> list[bytes]:
        """As `Fleet.save`."""
        saved: list[bytes] = self._worker.call("save", limit=self._limit)
        return saved

    def restore(self, saved: Sequence[bytes]) -> None:
        """As `Fleet.restore`."""
        self._worker.call("restore", list(saved), limit=self._limit)

    def close(self) -> None:
        """Free every instance and end the process."""
        with suppress(TerrafixError):  # it is ended all the same
            self._worker.call("close", limit=self._limit)
        self._worker.close()


def main() -> None:
    """Run a fleet for another process."""
    fleet: list[Fleet] = []

    def make(setup: Setup, n_members: int) -> None:
        fleet.append(Fleet(setup, n_members))

    def exchange(name: str) -> Any:
        def call(inputs: NDArray[np.float64], *arguments: Any) -> Any:
            fleet[0].inputs[...] = inputs
            failures = getattr(fleet[0], name)(*arguments)
            return failures, fleet[0].outputs

        return call

    serve(
        {
            "make": make,
            **{name: exchange(name) for name in ("start", "enter", "settle", "leave")},
            "step": exchange("step"),
            "save": lambda: fleet[0].save(),
            "restore": lambda saved: fleet[0].restore(saved),
            "close": lambda: fleet[0].close(),
        }
    )


if __name__ == "__main__":
    main()
