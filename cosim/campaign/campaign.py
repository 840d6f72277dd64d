"""One call from a system to the statistics of many members, and the verdict.

result = run_campaign("system.toml", runs=100)
print(result.verdicts["evaluation"].text)
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import Exact, seconds, text_seconds
from terrafix.cosim.basics.errors import ConfigurationError, RateError, StepError, TerrafixError
from terrafix.cosim.basics.files import write_atomically
from terrafix.cosim.basics.machine import processors
from terrafix.cosim.campaign import pools
from terrafix.cosim.campaign.batch import (
    BlockResult,
    FileSource,
    Task,
    layouts,
    members_per_batch,
)
from terrafix.cosim.campaign.results import CampaignResult
from terrafix.cosim.campaign.statistics.ensemble import STANDARD, STATISTICS, Statistics
from terrafix.cosim.campaign.statistics.statistic import BLOCK
from terrafix.cosim.campaign.store import RESULT, SUMMARY, Store
from terrafix.cosim.campaign.verdict import judge
from terrafix.cosim.engine.simulation import MAX_MEMBER, Simulation, flown_alone
from terrafix.cosim.system.identity import configuration
from terrafix.cosim.system.system import System

Progress = Callable[[str, float], None]


class CampaignError(StepError):
    """A campaign that ended early; what is done is in its folder, if it has one."""


def run_campaign(
    source: System | FileSource | str | Path,
    *,
    runs: int,
    settings: Sequence[tuple[str, str]] = (),
    seed: int | None = None,
    duration: Exact | None = None,
    workers: int | None = None,
    dask: str | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    histories: bool = False,
    batch: int | None = None,
    progress: Progress | None = None,
    started: Callable[[Any], None] | None = None,
) -> CampaignResult:
    """Fly a campaign.

    Parameters
    ----------
    source : System, FileSource or path
        A path is that of a system file, which each process reads for itself; a system needs
        components that can be pickled where several processes fly it.
    runs : int
        Members.
    settings : sequence of (str, str)
        ``("orbit.gravity", "j2")``, applied to the file, after those of a `FileSource`.
    seed : int, optional
        Root seed; the system's own if absent.
    duration : exact time, optional
        [s]; the system's own if absent.
    workers : int, optional
        Processes of this machine; one per processor if absent. A campaign of one batch is flown
        in this process by as many threads.
    dask : str, optional
        Address of a Dask scheduler, or ``"local:2"``.
    out : path, optional
        Folder of the campaign.
    resume : bool
        Complete what is in `out`.
    histories : bool
        Keep full records of every member, in `out`.
    batch : int, optional
        Members flown together; chosen by memory if absent. Changes no bit of the result.
    progress : callable, optional
        ``progress(what, fraction)``.
    started : callable, optional
        Called with the Dask client once there is one.

    Raises
    ------
    SystemCheckError, ConfigurationError, CheckpointError
        Before anything runs.
    CampaignError
        If it ends early.
    """
    began = time.perf_counter()
    _check_numbers(runs, workers, batch, resume=resume, out=out, histories=histories)
    source = _source(source, settings)
    system = source.read() if isinstance(source, FileSource) else source
    length = system.duration if duration is None else seconds(duration, "duration")
    if length is None or length <= 0:
        raise RateError(f"system '{system.name}' has no duration; give one, such as '600 s'")
    root = system.seed if seed is None else seed
    kinds = tuple(STATISTICS)
    simulation = Simulation(
        system, members=[0], seed=root, duration=length, runs=runs, recording=False
    )
    try:
        found = layouts(simulation, length)
        result = CampaignResult(
            system=system.name,
            doc=system.doc,
            seed=root,
            runs=runs,
            duration=length,
            configuration=configuration(simulation.plan),
            statistics={path: Statistics(layout, kinds) for path, layout in found.items()},
            workers="",
            setup_s=0.0,
            source=_described(source),
            parameter_units={name: unit for name, (unit, _) in simulation.parameters.items()},
        )
        path = flown_alone(simulation.plan)
        if path is not None and batch is not None:
            raise ConfigurationError(
                f"batch does nothing: '{path}' shares what is of one member, so members are flown "
                "one at a time\n  leave it out"
            )
        block = BLOCK if path is None else 1
        size = block if path is not None else batch or members_per_batch(simulation, found)
    finally:
        simulation.master.terminate()
    store = None
    if out is not None:
        result.out = Path(out)
        store = Store(result.out, _identity(result, histories=histories), resume=resume)
    try:
        kept = str(Path(out) / "histories") if out and histories else None
        task = Task(source, runs, root, length, kept, kinds, block)
        result.setup_s = time.perf_counter() - began
        _fly(result, task, store, size, workers, dask, progress, started)
        result.verdicts = {path: judge(s) for path, s in result.statistics.items()}
        result.wall_s = time.perf_counter() - began - result.setup_s
        if progress is not None and store is not None:
            progress("writing", 1.0)
        if store is not None:
            _write(result, system)
        return result
    finally:
        if store is not None:
            store.close()


def _check_numbers(
    runs: int,
    workers: int | None,
    batch: int | None,
    *,
    resume: bool,
    out: object,
    histories: bool,
) -> None:
    for name, value, most in (("runs", runs, MAX_MEMBER), ("workers", workers, 4096)):
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise ConfigurationError(f"{name} is {value!r}; it is a whole number from 1 to {most}")
    if batch is not None and (batch < 1 or batch % BLOCK):
        raise ConfigurationError(f"batch is {batch!r}; it is a multiple of {BLOCK}")
    if out is None and (resume or histories):
        what = "resume a campaign" if resume else "keep histories"
        raise ConfigurationError(f"to {what}, say where its folder is\n  give --out DIR")


def _source(
    source: System | FileSource | str | Path, settings: Sequence[tuple[str, str]]
) -> System | FileSource:
    """What workers are given; a path is absolute, for they may stand elsewhere."""
    if isinstance(source, System):
        if settings:
            raise ConfigurationError(
                f"system '{source.name}' is built already, so settings cannot be applied\n"
                "  give the path of its file, or set the parameters of its components"
            )
        return source
    if isinstance(source, str | Path):
        source = FileSource(str(source))
    if not isinstance(source, FileSource):
        raise ConfigurationError(
            f"a campaign flies a system or the path of its file, not {type(source).__name__}"
        )
    more = tuple((name, value) for name, value in settings)
    return FileSource(str(Path(source.path).absolute()), source.settings + more)


def _described(source: FileSource | System) -> dict[str, Any]:
    """Where the system was read from, for reports that read it again."""
    if isinstance(source, System):
        return {}
    return {"path": source.path, "settings": [*map(list, source.settings)]}


def _drawn(system: System) -> str:
    """The system's diagram as SVG."""
    from terrafix.cosim.system.graph import Diagram

    text = Diagram(system).svg()
    return text[text.index("<svg") :]


def _identity(result: CampaignResult, *, histories: bool) -> dict[str, Any]:
    from terrafix.cosim.records.results import versions

    kept = next(iter(result.statistics.values())).kinds
    added = [type(kind).__qualname__ for kind in kept if kind not in STANDARD]
    plain: dict[str, Any] = json.loads(
        json.dumps(
            {
                "system": result.system,
                "seed": result.seed,
                "runs": result.runs,
                "duration": f"{text_seconds(result.duration)} s",
                "histories": histories,
                "configuration": result.configuration,
                "versions": versions(result.configuration.get("epoch")),
            }
            | ({"statistics": added} if added else {}),
            default=str,
        )
    )
    return plain


def _fly(
    result: CampaignResult,
    task: Task,
    store: Store | None,
    size: int,
    workers: int | None,
    dask: str | None,
    progress: Progress | None,
    started: Callable[[Any], None] | None,
) -> None:
    n_blocks = -(-result.runs // task.block)
    done = store.done() & set(range(n_blocks)) if store is not None else set()
    ready: dict[int, BlockResult | None] = dict.fromkeys(sorted(done))
    merged = 0

    def merge() -> None:
        nonlocal merged
        while merged in ready:
            block = ready.pop(merged)
            if block is None and store is not None:
                block = store.read(merged)
            if block is None:  # damaged: flown again below
                return
            result.add(block)
            merged += 1
            if progress is not None:
                progress("flying", merged / n_blocks)

    merge()
    result.workers = "nobody: all blocks were there"
    while merged < n_blocks:
        missing = [b for b in range(merged, n_blocks) if b not in ready]
        batches = _batches(missing, size, task, workers, dask)
        flown, result.workers = _flown(task, batches, workers, dask, started)
        n_done = len(done)
        try:
            for blocks in flown:
                for block in blocks:
                    if store is not None:
                        store.write(block)
                    ready[block.number] = block
                    n_done += 1
                merge()
        except KeyboardInterrupt as error:
            raise CampaignError(_kept("interrupted", n_done, n_blocks, task, result)) from error
        except TerrafixError as error:
            if n_done == 0 and isinstance(error, ConfigurationError):
                if store is not None:
                    store.forget()
                raise
            raise CampaignError(_kept(str(error), n_done, n_blocks, task, result)) from error
        finally:
            flown.close()  # type: ignore[attr-defined]
    if all(not s.n[-1] for s in result.statistics.values()):
        last = result.excluded[-1] if result.excluded else {"reason": "nothing was evaluated"}
        raise CampaignError(
            f"no member is left of {result.runs}\n  the last failed: {last['reason']}"
        )


def _batches(
    missing: list[int], size: int, task: Task, workers: int | None, dask: str | None
) -> list[pools.Batch]:
    """Consecutive blocks together, up to `size` members; enough batches that nobody is idle."""
    n_workers = workers or processors()
    block, runs = task.block, task.runs
    share = -(-len(missing) // n_workers) * block
    largest = min(size, share) if dask is None and len(missing) * block > size else size
    per_batch = max(1, largest // block)
    batches: list[pools.Batch] = []
    start = 0
    while start < len(missing):
        end = start + 1
        while (
            end < len(missing) and end - start < per_batch and missing[end] == missing[end - 1] + 1
        ):
            end += 1
        batches.append((missing[start] * block, min((missing[end - 1] + 1) * block, runs)))
        start = end
    return batches


def _flown(
    task: Task,
    batches: list[pools.Batch],
    workers: int | None,
    dask: str | None,
    started: Callable[[Any], None] | None,
) -> tuple[Iterable[list[BlockResult]], str]:
    if dask is not None:
        return pools.on_dask(task, batches, address=dask, started=started), f"Dask at {dask}"
    count = workers or processors()
    if len(batches) == 1 or count == 1:
        text = "this process" + (f", {count} threads" if count > 1 else "")
        return pools.in_this_process(task, batches, threads=count), text
    count = min(count, len(batches))
    _refuse_unpicklable(task)
    return pools.in_processes(task, batches, workers=count), f"{count} processes"


def _refuse_unpicklable(task: Task) -> None:
    import pickle

    try:
        pickle.dumps(task)
    except Exception as error:
        raise ConfigurationError(
            f"this system cannot be sent to other processes: {error}\n"
            "  give workers=1, or a FileSource, which each process reads for itself"
        ) from error


def _kept(what: str, done: int, total: int, task: Task, result: CampaignResult) -> str:
    blocks = f"blocks of {task.block} members" if task.block > 1 else "members"
    if result.out is None:
        return f"{what}\n  {done} of {total} {blocks} were done; none is kept"
    return (
        f"{what}\n  {done} of {total} {blocks} are done, and kept in "
        f"'{result.out}'\n  complete them with --out {result.out} --resume"
    )


def _write(result: CampaignResult, system: System) -> None:
    from terrafix.cosim.records.results import write_netcdf

    assert result.out is not None
    try:
        result.graph = _drawn(system)
        write_netcdf(result.dataset(), result.out / RESULT)
        text = json.dumps(result.summary(), indent=1).encode()
        write_atomically(result.out / SUMMARY, lambda f: f.write(text))
    except ConfigurationError as error:
        raise CampaignError(
            f"the campaign is complete, but {error}\n"
            f"  make room, and write it with --out {result.out} --resume"
        ) from error
