"""A run with foreign code in its process: if that ends the process, somebody is left to say so."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import warnings
from typing import TYPE_CHECKING

from terrafix.cosim.basics.errors import StepError

if TYPE_CHECKING:
    from terrafix.cosim.system.system import System

_PASSED_ON = ("SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT")
"""Signals by which somebody ends a run; any other is told."""


_KEPT = "with isolate = true it has one of its own, and the run keeps its records"


def watch_foreign_code(system: System, kept: str = _KEPT) -> None:
    """Go on in a copy of this process, if FMUs run in it, and wait for its end here.

    The copy ends with this process. This one leaves with the status of the copy. `kept` says what
    is left where the FMU ends it, and what to do.

    Raises
    ------
    StepError
        Here, if the copy ended otherwise than Python does.
    """
    named = _foreign(system)
    if not named or not hasattr(os, "fork") or sys.stdout is not sys.__stdout__:
        return
    from terrafix.cosim.exchange.fmi.run.remote import end_with

    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    ended, end = os.pipe()
    life, live = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of libraries, at rest
        child = os.fork()
    if not child:
        os.close(ended)
        os.close(live)
        os.setpgid(0, 0)  # a terminal interrupts the one that waits, which hands it on
        end_with(life)
        atexit.register(os.write, end, b".")
        return
    os.close(end)
    os.close(life)
    signal.signal(signal.SIGINT, lambda *_: os.kill(child, signal.SIGINT))
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    os.set_blocking(ended, False)
    try:
        orderly = bool(os.read(ended, 1))
    except BlockingIOError:  # held by what an FMU started
        orderly = False
    if status >= 0 and orderly:
        sys.exit(status)
    passed_on = [getattr(signal, name) for name in _PASSED_ON if hasattr(signal, name)]
    if status < 0 and -status in passed_on:
        signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    how = f"crashed it (signal {-status})" if status < 0 else f"ended it (exit status {status})"
    raise StepError(
        f"{' or '.join(named)}, which runs in the process of the simulation, {how}\n  {kept}"
    )


def _foreign(system: System) -> list[str]:
    """FMUs that run in this process, by their paths in the system."""
    if "terrafix.cosim.exchange.fmi.run.component" not in sys.modules:
        return []
    from terrafix.cosim.exchange.fmi.run.component import Fmu
    from terrafix.cosim.exchange.fmi.run.loop import FmuLoop

    return [
        f"'{path}'"
        for path, component in system.flatten().components.items()
        if (isinstance(component, Fmu) and not component.setting("isolate"))
        or isinstance(component, FmuLoop)
    ]
