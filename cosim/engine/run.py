"""One call from a system to a result: check, build, run, record, evaluate.

result = simulate(system, members=100, seed=7, out="run.nc")
print(result.evaluation["position"]["sigma_sample"])
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.clock import Exact, seconds, text_seconds
from terrafix.cosim.basics.errors import (
    CheckpointError,
    ComponentError,
    ConfigurationError,
    RateError,
    StepError,
    TerrafixError,
)
from terrafix.cosim.engine.apart import fly_apart, fly_part
from terrafix.cosim.engine.flight import Flight
from terrafix.cosim.engine.master import EverybodyEndedError, nobody_left
from terrafix.cosim.engine.result import Result
from terrafix.cosim.engine.simulation import Progress, Simulation
from terrafix.cosim.records.checkpoint import read_checkpoint, write_checkpoint
from terrafix.cosim.records.places import Places, result_target
from terrafix.cosim.system.system import System

SLICES = 400  # progress reports per run
MAX_TICKS = 10**12  # days of computing at the master's own pace, whatever the components do


class RunError(StepError):
    """A run that failed in the middle; what it recorded is in `result` (and in its file)."""

    def __init__(self, message: str, result: Result) -> None:
        super().__init__(message)
        self.result = result

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.result)


def simulate(
    system: System,
    *,
    members: int | Sequence[int] | None = None,
    runs: int | None = None,
    seed: int | None = None,
    duration: Exact | None = None,
    out: str | Path | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_every: Exact | None = None,
    resume: str | Path | None = None,
    progress: Progress | None = None,
) -> Result:
    """Run a system.

    Parameters
    ----------
    system : System
    members : int or sequence of int, optional
        How many, or which.
    runs : int, optional
        How many there are in all, where `members` are some of a campaign's.
    seed : int, optional
        Root seed.
    duration : exact time, optional
        [s]; the system's own if absent.
    out : path, optional
        NetCDF file for the result; while the run goes on, its records are in ``<out>.parts``.
    checkpoint : path, optional
        Where checkpoints go; beside `out`, or named after the system, if absent.
    checkpoint_every : exact time, optional
        Simulated seconds between checkpoints.
    resume : path, optional
        Checkpoint to continue from.
    progress : callable, optional
        ``progress(what, fraction)``.

    Raises
    ------
    SystemCheckError, ConfigurationError, CheckpointError
        Before anything runs.
    RunError
        If a component fails; what was recorded is written and in ``error.result``.
    """
    if not isinstance(system, System):
        raise ConfigurationError(
            f"simulate takes a System, not {type(system).__name__}\n"
            "  read a file with terrafix.cosim.files.readers.read_system"
        )
    length = _duration(system, duration)
    out = None if out is None else result_target(out)
    every = None if checkpoint_every is None else seconds(checkpoint_every, "checkpoint interval")
    if every is not None and every <= 0:
        raise RateError(f"checkpoint interval is {text_seconds(every)} s; it must be positive")
    saved = None if resume is None else read_checkpoint(Path(resume))
    places = _places(system, out, checkpoint, resume, saved, checkpointing=every is not None)
    simulation = Simulation(
        system,
        members=members,
        runs=runs,
        seed=seed,
        duration=length,
        folder=places.folder,
        progress=progress,
    )
    keep = True
    try:
        if saved is not None:
            simulation.check_identity(saved)
        _refuse_impossible(simulation, length, saved, every)
        places.occupy(resumed=saved is not None)
        result = _run(simulation, places, saved, length, every, progress)
        keep = False
        return result
    except RunError as error:
        # records are needed to resume, or if the result could not be written
        keep = simulation.checkpoint is not None or error.result.out is None
        raise
    finally:
        places.leave(keep=keep)
        simulation.master.terminate()


def _places(
    system: System,
    out: Path | None,
    checkpoint: str | Path | None,
    resume: str | Path | None,
    saved: dict[str, Any] | None,
    *,
    checkpointing: bool,
) -> Places:
    if resume is None or saved is None:
        target = None if checkpoint is None else Path(checkpoint)
        return Places.of_run(system.name, out=out, checkpoint=target, checkpointing=checkpointing)
    if checkpoint is not None and Path(checkpoint) != Path(resume):
        raise ConfigurationError(
            f"a run resumed from '{resume}' keeps its checkpoints there, not in '{checkpoint}': "
            "its records are beside it\n  give no other checkpoint"
        )
    return Places.of_resumed(Path(resume), saved, out=out)


def _run(
    simulation: Simulation,
    places: Places,
    saved: dict[str, Any] | None,
    length: Fraction,
    every: Fraction | None,
    progress: Progress | None,
) -> Result:
    started = time.perf_counter()
    try:
        if saved is not None:
            simulation.set_state(saved)
            simulation.checkpoint = places.checkpoint
        else:
            simulation.initialize()
        _fly(simulation, length, every, places, progress)
    except EverybodyEndedError:
        return _finish(simulation, simulation.flight(), started, "complete", places)
    except (StepError, KeyboardInterrupt) as error:
        failure: BaseException | None = error
        flight = simulation.flight()
        mistake = isinstance(error.__cause__, ConfigurationError)  # everybody's
        if isinstance(error, ComponentError) and not mistake and len(simulation.members) > 1:
            failure, flight = _apart(simulation, length, error, flight, progress)
        if failure is None:
            return _finish(simulation, flight, started, "complete", places)
        result = _finish(simulation, flight, started, _status(failure), places)
        with suppress(StepError):  # the first failure is the one to report
            simulation.master.terminate()
        raise RunError(_kept(failure, result, simulation.checkpoint), result) from failure
    result = _finish(simulation, simulation.flight(), started, "complete", places)
    try:
        simulation.master.terminate()
    except StepError as error:
        raise RunError(_kept(error, result, None), result) from error
    return result


def _apart(
    simulation: Simulation,
    length: Fraction,
    error: ComponentError,
    flight: Flight,
    progress: Progress | None,
) -> tuple[BaseException | None, Flight]:
    """Fly on without the members for whom a component raised.

    Returns what ended the run all the same, if anything did, and what was flown: where it raises
    for everyone, or this is interrupted, that is `flight`, as far as it came.
    """
    members = simulation.members
    with suppress(StepError):
        simulation.master.terminate()  # its components fly again
    if progress is not None:
        progress(f"flying the others: {error.component} failed", 0.0)

    def fly(part: NDArray[np.int64], until: int | None) -> Flight:
        return fly_part(
            simulation.system,
            part,
            until,
            seed=simulation.seed,
            duration=length,
            runs=simulation.runs,
            recording=True,
        )

    try:
        flight = fly_apart(fly, members, error, all_the_same=False)
    except KeyboardInterrupt as interrupt:
        return interrupt, flight
    except TerrafixError:
        return error, flight
    if len(flight.excluded) == len(members):
        last = flight.excluded[-1]
        return StepError(nobody_left(last, f"{last['t_s']:.9g} s")), flight
    n = sum(e["component"] == error.component for e in flight.excluded)
    flight.notes.append(
        f"'{error.component}' raised with all {len(members)} members: {n} of them were given up, "
        "and the others flown again without them"
    )
    return None, flight


def _refuse_impossible(
    simulation: Simulation, length: Fraction, saved: dict[str, Any] | None, every: Fraction | None
) -> None:
    """Raise what can be known to be wrong before the first step."""
    master, base = simulation.master, simulation.plan.base
    if master.ticks(length) > MAX_TICKS:
        raise RateError(
            f"duration is {text_seconds(length)} s at a base step of {text_seconds(base)} s: "
            f"{master.ticks(length):.3g} ticks, more than {MAX_TICKS:.0e}\n"
            "  fly shorter, or look for a period that makes the base step so fine"
        )
    if saved is not None and saved["master"]["tick"] > master.ticks(length):
        raise CheckpointError(
            f"the checkpoint is at t = {master.seconds(saved['master']['tick']):.9g} s, beyond the "
            f"duration of {text_seconds(length)} s\n  give a longer duration"
        )
    if saved is None and every is None:
        return
    for path, component in simulation.plan.flat.components.items():
        if not component.capabilities.state:
            raise CheckpointError(
                f"'{path}' ({type(component).__name__}) cannot save its state, so a run with it "
                "has no checkpoints\n  run without --checkpoint-every"
            )


def _fly(
    simulation: Simulation,
    length: Fraction,
    every: Fraction | None,
    places: Places,
    progress: Progress | None,
) -> None:
    master = simulation.master
    end = master.ticks(length)
    stops = set(range(max(end // SLICES, 1), end, max(end // SLICES, 1)))
    saves: set[int] = set()
    if every is not None:
        saves = {master.ticks(k * every) for k in range(1, int(length / every) + 1)} - {0}
    for stop in sorted({s for s in stops | saves if master.tick < s < end} | {end}):
        master.run_until(stop)
        if stop in saves:
            state = simulation.get_state() | {"places": places.described()}
            write_checkpoint(places.checkpoint, state)
            simulation.checkpoint = places.checkpoint
        if progress is not None:
            progress("running", stop / end)


def _finish(
    simulation: Simulation, flight: Flight, started: float, status: str, places: Places
) -> Result:
    from terrafix.cosim.records.results import write_netcdf

    wall = time.perf_counter() - started
    result = simulation.result(wall_s=wall, status=status, flight=flight)
    result.notes = places.notes + result.notes
    target = places.result_file(complete=status == "complete")
    if target is not None:
        try:
            write_netcdf(result.dataset, target)
        except ConfigurationError as error:
            what = "the run is complete" if status == "complete" else f"the run {status}"
            raise RunError(
                f"{what}, but {error}\n  its records are kept in '{places.folder}'", result
            ) from error
        result.out = target
    return result


def _status(error: BaseException) -> str:
    return "interrupted" if isinstance(error, KeyboardInterrupt) else f"failed: {error}"


def _kept(error: BaseException, result: Result, checkpoint: Path | None) -> str:
    text = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
    if result.out is not None:
        text += f"\n  what was recorded until then is in {result.out}"
    if checkpoint is not None:
        text += f"\n  resume with --resume {checkpoint}"
    return text


def _duration(system: System, duration: Exact | None) -> Fraction:
    length = system.duration if duration is None else seconds(duration, "duration")
    if length is None:
        raise RateError(f"system '{system.name}' has no duration; give one, such as '600 s'")
    if length <= 0:
        raise RateError(f"duration is {text_seconds(length)} s; it must be positive")
    return length
