"""A fleet in a process of its own: a crash or hang there is an error here, and no more.

The other process runs `terrafix.cosim.exchange.fmi.run.apart`. Requests and answers are
pickled frames over its standard input and output, between two processes of ours; what the FMU
itself prints goes to standard error. Frames are numbered, and where the FMU forks, the first
process alone answers. A process there, and what an FMU started in it, ends with this one, however
this one ends.
"""

from __future__ import annotations

import os
import pickle
import select
import selectors
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.exchange.fmi.run.fleet import Failures, Group, Message, Setup

_HEADER = struct.Struct("<Q")
_LOOK = 0.2  # how often it is looked whether a silent process is there [s]
_GRACE = 1.0  # to end by itself, for a process that nobody asks any more [s]
FIRST_LIMIT = 60.0  # imports and unpacking take their time [s]
MODULE = "terrafix.cosim.exchange.fmi.run.apart"


class ProcessError(TerrafixError):
    """The process that runs foreign code crashed or did not answer."""


class Worker:
    """A process that calls what it is told to.

    Parameters
    ----------
    module : str
        Its `main` calls `serve`.
    what : str
        Names the foreign code in errors.
    """

    def __init__(self, module: str, what: str) -> None:
        self._what = what
        self._number = 0
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from {module} import main; main()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # what the FMU starts can be ended with it
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
            If the process ends or does not answer in time; it is ended.
        TerrafixError
            What the function raised.
        """
        self._number += 1
        try:
            send(self._requests, (self._number, name, arguments))
            answer = answered(
                self._answers, self._number, limit, lambda: self._process.poll() is None
            )
        except TimeoutError:
            self.close(kill=True)
            raise ProcessError(f"{self._what} {no_answer(limit)}") from None
        except (OSError, EOFError):
            raise ProcessError(f"{self._what} {how_it_ended(self._status())}") from None
        kind, value = answer
        if kind == "error":
            raise value
        return value

    def _status(self) -> int:
        """Exit status of a process that has closed its end, and should be gone."""
        try:
            return self._process.wait(timeout=_GRACE)
        except subprocess.TimeoutExpired:
            self.close(kill=True)
            return -signal.SIGKILL

    def close(self, *, kill: bool = False) -> None:
        """End the process, and what it started."""
        process = self._process
        with suppress(OSError):
            self._requests.close()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=0 if kill else 10)
        with suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
        process.wait()
        self._answers.close()


def no_answer(limit: float) -> str:
    """What is said of a process that hangs."""
    return f"did not answer within {limit:g} s"


def how_it_ended(status: int) -> str:
    """What is said of a process that ended by itself."""
    if status < 0:
        return f"crashed its process (signal {-status})"
    return f"ended its process (exit status {status})"


def send(stream: Any, value: Any) -> None:
    """Write a frame."""
    data = pickle.dumps(value, protocol=5)
    stream.write(_HEADER.pack(len(data)) + data)
    stream.flush()


def receive(
    stream: Any, deadline: float | None = None, alive: Callable[[], bool] | None = None
) -> Any:
    """Read a frame.

    Raises
    ------
    TimeoutError
        After the deadline.
    EOFError
        At the end, or where nothing comes and `alive` says that nothing will.
    """
    (size,) = _HEADER.unpack(_exactly(stream, _HEADER.size, deadline, alive))
    return pickle.loads(_exactly(stream, size, deadline, alive))


def answered(stream: Any, number: int, limit: float, alive: Callable[[], bool]) -> Any:
    """The answer to a request, by its number."""
    deadline = time.monotonic() + limit
    while True:
        found, *answer = receive(stream, deadline, alive)
        if found == number:
            return answer


def _exactly(
    stream: Any, n: int, deadline: float | None, alive: Callable[[], bool] | None
) -> bytes:
    parts: list[bytes] = []
    handle = stream.fileno()
    with selectors.DefaultSelector() as selector:
        selector.register(handle, selectors.EVENT_READ)
        while n:
            while deadline is not None:
                lives = alive is None or alive()  # before looking: its last words are read
                if selector.select(max(0.0, min(_LOOK, deadline - time.monotonic()))):
                    break
                if not lives:
                    raise EOFError
                if time.monotonic() >= deadline:
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
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)  # nor are requests what it may read
    os.close(nothing)
    answer_requests(functions, requests, answers)


def answer_requests(functions: dict[str, Any], requests: Any, answers: Any) -> None:
    """Answer requests from a stream to another, in this process and no copy of it."""
    process = os.getpid()
    end_with(requests.fileno())
    while True:
        try:
            number, name, arguments = receive(requests)
        except EOFError:
            return
        try:
            answer = (number, "value", functions[name](*arguments))
        except TerrafixError as error:
            answer = (number, "error", type(error)(str(error)))
        except Exception as error:
            answer = (number, "error", ConfigurationError(f"{type(error).__name__}: {error}"))
        if os.getpid() != process:  # the FMU forked, and this is the copy
            os._exit(0)
        send(answers, answer)


def end_with(handle: int) -> None:
    """End this process, in whatever it hangs, when nobody holds the other end of a pipe."""
    if not hasattr(select, "poll"):
        return
    ended = select.POLLHUP | select.POLLERR | select.POLLNVAL

    def watch() -> None:
        poll = select.poll()
        poll.register(handle, 0)
        while not any(event & ended for _, event in poll.poll()):
            pass
        time.sleep(_GRACE)
        mine = os.getpgrp() == os.getpid()
        (os.killpg if mine else os.kill)(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


class RemoteFleet:
    """What `Fleet` is, in a process of its own; `apart`: in one for each member."""

    def __init__(self, setup: Setup, n_members: int, limit: float, *, apart: bool = False) -> None:
        self.setup = setup
        self.inputs = np.zeros((n_members, sum(g.size for g in setup.inputs)))
        self.outputs = np.zeros((n_members, sum(g.size for g in setup.outputs)))
        self._log: Sequence[tuple[int, int, str]] = ()
        self._limit = limit + FIRST_LIMIT if apart else limit  # each member has `limit`
        self._worker = Worker(MODULE, f"the FMU '{setup.file}'")
        own_limit = limit if apart else None
        self._worker.call("make", setup, n_members, own_limit, limit=FIRST_LIMIT)

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
        answer = self._worker.call(name, self.inputs, *arguments, limit=self._limit)
        failures, outputs, self._log = answer
        self.outputs[...] = outputs
        return dict(failures)

    def take_log(self) -> Sequence[tuple[int, int, str]]:
        """As `Fleet.take_log`."""
        found, self._log = self._log, ()
        return found

    def save(self) -> list[bytes]:
        """As `Fleet.save`."""
        saved: list[bytes] = self._worker.call("save", limit=self._limit)
        return saved

    def restore(self, saved: Sequence[bytes]) -> None:
        """As `Fleet.restore`."""
        self._worker.call("restore", list(saved), limit=self._limit)

    def mark(self) -> None:
        """As `Fleet.mark`."""
        self._worker.call("mark", limit=self._limit)

    def return_to_mark(self) -> None:
        """As `Fleet.return_to_mark`."""
        self._worker.call("return_to_mark", limit=self._limit)

    def close(self) -> None:
        """Free every instance and end the process."""
        with suppress(TerrafixError):  # it is ended all the same
            self._worker.call("close", limit=self._limit)
        self._worker.close()
