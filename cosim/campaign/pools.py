"""Where batches are flown: this process, several of this machine, or the workers of a Dask cluster.

Each hands back what a batch returned as soon as it is done, in any order. A worker that is lost
costs its batch the time to be flown again, and nothing else.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType
from typing import Any

from terrafix.cosim.basics.errors import ConfigurationError, StepError
from terrafix.cosim.campaign.batch import BlockResult, Task, fly_batch, single_threaded

Batch = tuple[int, int]
"""First member, and the one after the last."""
Flown = Iterator[list[BlockResult]]
MOST_LOSSES = 3
CONNECT_SECONDS = 5


def in_this_process(task: Task, batches: Sequence[Batch], *, threads: int) -> Flown:
    """Fly one batch after the other; members are stepped in threads."""
    before = os.environ.get("TERRAFIX_THREADS")
    os.environ["TERRAFIX_THREADS"] = str(threads)
    try:
        for first, last in batches:
            yield fly_batch(task, first, last)
    finally:
        if before is None:
            del os.environ["TERRAFIX_THREADS"]
        else:
            os.environ["TERRAFIX_THREADS"] = before


def in_processes(task: Task, batches: Sequence[Batch], *, workers: int) -> Flown:
    """Fly batches in processes of their own."""
    waiting = list(batches)[::-1]
    lost: dict[Batch, int] = {}
    sent = pickle.dumps(task)
    alone = b"__main__" not in sent
    while waiting:
        context = _Spawning()
        pool = ProcessPoolExecutor(workers, context, initializer=_begin_worker)
        running: dict[Any, Batch] = {}
        try:
            while waiting or running:
                while waiting and len(running) < workers + 1:
                    batch = waiting.pop()
                    with _without_main(hidden=alone):  # this is when processes are started
                        running[pool.submit(_fly_sent, sent, *batch)] = batch
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    yield future.result()
                    del running[future]
        except BrokenProcessPool:
            again = list(running.values())
            for batch in again:
                _count_loss(lost, batch, _ends(context.started))
            waiting += again[::-1]
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in context.started:
                if process.is_alive():
                    process.terminate()


def _fly_sent(sent: bytes, first: int, last: int) -> list[BlockResult]:
    """Fly a batch of a task that is read here, where it can be said what is missing."""
    try:
        task = pickle.loads(sent)
    except Exception as error:
        raise ConfigurationError(
            f"a process of the campaign cannot read the system: {type(error).__name__}: {error}\n"
            "  put what it names into a module that can be imported, or give workers=1"
        ) from None
    return fly_batch(task, first, last)


def _ends(processes: Sequence[SpawnProcess]) -> list[int]:
    """How processes of a broken pool ended: exit statuses, without those that the pool ended."""
    for process in processes:
        process.join(timeout=1.0)
    return [p.exitcode for p in processes if p.exitcode not in (None, -signal.SIGTERM)]


class _Spawning(SpawnContext):
    """Starts processes, and remembers them, so that they can be ended before they are done."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]
        """Make a process."""
        made = SpawnProcess(*args, **options)
        self.started.append(made)
        return made


@contextmanager
def _without_main(*, hidden: bool) -> Iterator[None]:
    """Keep new processes from running the user's script once more, which may fly a campaign."""
    main = sys.modules["__main__"]
    if hidden:
        sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _begin_worker() -> None:
    """Leave Ctrl-C to the campaign's process, and end when it ends, however it does."""
    single_threaded()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_follow, args=(parent,), daemon=True).start()


def _follow(parent: Any) -> None:
    parent.join()
    os._exit(1)


def _count_loss(lost: dict[Batch, int], batch: Batch, ends: Sequence[int] = ()) -> None:
    lost[batch] = lost.get(batch, 0) + 1
    if lost[batch] > MOST_LOSSES:
        raise StepError(
            f"the worker that flew members {batch[0]} to {batch[1] - 1} was lost "
            f"{lost[batch]} times{_why(ends)}"
        )


def _why(ends: Sequence[int]) -> str:
    """How a worker ended, and what to try."""
    killed = -getattr(signal, "SIGKILL", 9)
    if not ends or killed in ends:
        said = f": it was killed (signal {-killed})" if ends else ""
        return f"{said}\n  it may need more memory than there is: give fewer workers"
    crashed = f"it crashed (signal {-ends[0]})"
    ended = f"it ended itself (exit status {ends[0]})"
    text = (
        f": {crashed if ends[0] < 0 else ended}\n  code that is no Python does that: an FMU, say, "
        "which has a process of its own with isolate = true"
    )
    if ends[0] == 1:
        text += "; in a script that\n  defines components, fly below `if __name__ == '__main__':`"
    return text


@contextmanager
def _cluster(address: str) -> Iterator[Any]:
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise ConfigurationError(
            "a campaign on Dask needs the package 'distributed'\n"
            "  install it with `pip install terrafix[dask]`"
        ) from None
    if address.startswith("local:"):
        count = address.removeprefix("local:")
        if not count.isdigit() or int(count) < 1:
            raise ConfigurationError(f"'{address}' names no number of workers; write local:2")
        with (
            distributed.LocalCluster(
                n_workers=int(count),
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                silence_logs=50,
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"there is no Dask scheduler at '{address}': {error}\n"
            "  start one with `dask scheduler`, or write local:2 for workers of this machine"
        ) from error
    with client:
        yield client


def on_dask(
    task: Task,
    batches: Sequence[Batch],
    *,
    address: str,
    started: Callable[[Any], None] | None = None,
) -> Flown:
    """Fly batches as tasks of a Dask cluster, a few more of them than it has workers.

    `started` is called with the client once the cluster is there.
    """
    with _cluster(address) as client:
        distributed: Any = import_module("distributed")
        if started is not None:
            started(client)
        workers = client.scheduler_info(n_workers=-1)["workers"]
        ahead = 2 * max(1, sum(w["nthreads"] for w in workers.values()))
        waiting = list(batches)[::-1]
        lost: dict[Batch, int] = {}
        batch_of: dict[str, Batch] = {}
        queue = distributed.as_completed()

        def submit() -> None:
            batch = waiting.pop()
            future = client.submit(_on_worker, task, *batch, pure=False)
            batch_of[future.key] = batch
            queue.add(future)

        while waiting and len(batch_of) < ahead:
            submit()
        for future in queue:
            batch = batch_of.pop(future.key)
            try:
                results = future.result()
            except distributed.KilledWorker:
                _count_loss(lost, batch)
                waiting.append(batch)
            else:
                yield results
            future.release()
            if waiting:
                submit()


def _on_worker(task: Task, first: int, last: int) -> list[BlockResult]:
    single_threaded()
    return fly_batch(task, first, last)
