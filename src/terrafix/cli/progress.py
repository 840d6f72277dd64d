"""A progress bar on standard error for whatever takes longer than two seconds."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

PATIENCE = 2.0
"""Seconds without a bar."""


class ProgressBar:
    """Shows what is being done and how far it is; called as ``progress(what, fraction)``.

    The bar appears only after two seconds, and vanishes at the end. A timer shows it, so that it
    appears also while nothing is reported.

    Parameters
    ----------
    shown : bool
        False for no bar at all.
    first : str
        What is being done until something is reported.
    on_running : callable, optional
        Called once, at the first report that the simulation is running.
    """

    def __init__(
        self, *, shown: bool, first: str, on_running: Callable[[], None] | None = None
    ) -> None:
        self.running = False
        self._shown = shown
        self._what, self._fraction = first, 0.0
        self._on_running = on_running
        self._lock = threading.Lock()
        self._timer = threading.Timer(PATIENCE, self._appear)
        self._timer.daemon = True
        self._closed = False
        self._bar: Any = None

    def __enter__(self) -> Self:
        if self._shown:
            self._timer.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._timer.cancel()
        with self._lock:
            self._closed = True
            if self._bar is not None:
                self._bar.stop()
                self._bar = None

    def __call__(self, what: str, fraction: float) -> None:
        """Report what is being done, and the fraction of it that is done."""
        with self._lock:
            self._what, self._fraction = what, fraction
            if self._bar is not None:
                self._bar.update(self._bar.task_ids[0], description=what, completed=fraction)
        if what == "running" and not self.running:
            self.running = True
            if self._on_running is not None:
                self._on_running()

    def _appear(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            Progress,
            TaskProgressColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        with self._lock:
            if self._closed:
                return
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                TextColumn("elapsed,"),
                TimeRemainingColumn(),
                TextColumn("left"),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.add_task(self._what, total=1.0, completed=self._fraction)
            self._bar.start()


def stderr_is_terminal() -> bool:
    """Whether a person sees standard error as it is written."""
    return sys.stderr is not None and sys.stderr.isatty()
