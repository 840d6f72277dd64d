"""A batch: consecutive members of a campaign flown together, summed up block by block.

A batch is what a worker is given. It knows the campaign (`Task`) and which members are its own,
and returns blocks; two batches know nothing of one another.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ComponentError, ConfigurationError, StepError
from terrafix.cosim.campaign.statistics.ensemble import STATISTICS, block_of
from terrafix.cosim.campaign.statistics.statistic import BLOCK, Layout, Statistic, Sums
from terrafix.cosim.declare.evaluation import Evaluation
from terrafix.cosim.engine.apart import fly_apart, fly_part
from terrafix.cosim.engine.flight import Flight
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.system import System

BATCH_BYTES = 48 * 2**20
"""Of evaluation histories that a batch holds in memory: this decides how many members it has."""
LARGEST = 512


@dataclass(frozen=True)
class FileSource:
    """A system as a worker can read it: its file and what was set on the command line."""

    path: str
    settings: tuple[tuple[str, str], ...] = ()

    def read(self) -> System:
        """Read the file."""
        from terrafix.cosim.files.readers import read_system

        return read_system(self.path, list(self.settings))


@dataclass(frozen=True)
class Task:
    """What every batch of a campaign has in common.

    Attributes
    ----------
    source : FileSource or System
        Where workers get the system from.
    runs : int
        Members in all.
    seed : int
    duration : Fraction
        [s]
    histories : str or None
        Folder for full records, one NetCDF file per block.
    kinds : tuple of Statistic
        What is summed up; `STATISTICS` if absent.
    block : int
        Members of a block: 1 where they are flown one at a time.
    key : str
        Unlike that of any other campaign.
    """

    source: FileSource | System
    runs: int
    seed: int
    duration: Fraction
    histories: str | None = None
    kinds: tuple[Statistic, ...] = field(default_factory=lambda: tuple(STATISTICS))
    block: int = BLOCK
    key: str = field(default_factory=lambda: uuid4().hex)


@dataclass
class BlockResult:
    """What a batch returns for each block of members.

    Attributes
    ----------
    number : int
    sums : dict of str to (dict of str to ndarray)
        By evaluation component.
    parameters : dict of str to ndarray
        Dispersed parameters as they reached the components, (n_members, ...).
    excluded : list of dict
        Members that failed.
    kernel : str
    """

    number: int
    sums: dict[str, Sums]
    parameters: dict[str, NDArray[Any]]
    excluded: list[dict[str, Any]]
    kernel: str


_systems: dict[str, System] = {}


def _system(task: Task) -> System:
    """The system, read once in each process: its models and kernels are kept."""
    if task.key not in _systems:
        _systems.clear()
        source = task.source
        _systems[task.key] = source.read() if isinstance(source, FileSource) else source
    return _systems[task.key]


def layouts(simulation: Simulation, duration: Fraction) -> dict[str, Layout]:
    """What the evaluation components publish, and when."""
    plan = simulation.plan
    found = {}
    for path, component in plan.flat.components.items():
        if isinstance(component, Evaluation):
            assert component.rate is not None
            end = int(duration / plan.base)
            ticks = [0] if component.rate.starts_at_zero else []
            for tick in component.rate.ticks(plan.base, plan.grid):
                if tick > end:
                    break
                ticks.append(tick)
            times = np.array([simulation.master.seconds(tick) for tick in ticks])
            found[path] = Layout.of(path, component, times)
    if not found:
        raise ConfigurationError(
            f"system '{simulation.system.name}' has no evaluation component, so a campaign would "
            "have no statistics\n"
            "  add one (terrafix components lists the types), or use terrafix run"
        )
    return found


def members_per_batch(simulation: Simulation, found: Mapping[str, Layout]) -> int:
    """Members whose histories fit into `BATCH_BYTES`: a whole number of blocks."""
    one = 0
    for path, layout in found.items():
        component = simulation.plan.flat.components[path]
        row = sum(f.size for p in component.outputs().values() for f in p.fields.values())
        one += 8 * 4 * row * len(layout.times)  # in the recorder, joined, and cut
    return BLOCK * max(1, min(LARGEST, BATCH_BYTES // max(one, 1)) // BLOCK)


def fly_batch(task: Task, first: int, last: int) -> list[BlockResult]:
    """Fly members `first` up to `last`, not included; `first` begins a block.

    Raises
    ------
    ConfigurationError
        If the system cannot be flown at all.
    """
    system = _system(task)
    members = np.arange(first, last)
    gc.collect()  # what earlier batches left in cycles: memory must not grow with their number
    simulation = Simulation(
        system,
        members=members.tolist(),
        seed=task.seed,
        duration=task.duration,
        runs=task.runs,
        recording=task.histories is not None,
    )
    try:
        flight = _fly(task, simulation)
        if task.histories is not None:
            _write_histories(task, simulation, flight)
        return _blocks(task, simulation, flight)
    finally:
        simulation.master.terminate()


def _fly(task: Task, simulation: Simulation) -> Flight:
    """Fly all members of a simulation; those for whom a component raises are given up."""
    members = simulation.members

    def part(some: NDArray[np.int64], until: int | None) -> Flight:
        return fly_part(
            simulation.system,
            some,
            until,
            seed=task.seed,
            duration=task.duration,
            runs=task.runs,
            recording=task.histories is not None,
        )

    try:
        simulation.initialize()
        simulation.run_until(task.duration)
    except ComponentError as error:
        if len(members) == 1:
            simulation.master.give_up(error)
            return simulation.flight()
        simulation.master.terminate()  # its components fly again
        return fly_apart(part, members, error, all_the_same=True)
    except StepError:
        if simulation.master.active.any():  # it was a recorder
            raise
    return simulation.flight()


def _padded(
    found: tuple[NDArray[np.float64], dict[str, NDArray[Any]]], layout: Layout
) -> dict[str, NDArray[Any]]:
    times, arrays = found
    missing = len(layout.times) - len(times)
    if not missing:
        return arrays
    return {
        name: np.concatenate([a, np.full((missing, *a.shape[1:]), np.nan)])
        for name, a in arrays.items()
    }


def _blocks(task: Task, simulation: Simulation, flight: Flight) -> list[BlockResult]:
    found = layouts(simulation, task.duration)
    members = flight.members
    histories = {p: _padded(simulation.history(p, flight), layout) for p, layout in found.items()}
    results = []
    for start in range(0, len(members), task.block):
        part = slice(start, start + task.block)
        first = int(members[start])
        sums = {}
        for path, layout in found.items():
            cut = {name: np.ascontiguousarray(a[:, part]) for name, a in histories[path].items()}
            sums[path] = block_of(layout, cut, first=first, kinds=task.kinds)
        mine = set(members[part].tolist())
        excluded = (e for e in flight.excluded if e["member"] in mine)
        results.append(
            BlockResult(
                first // task.block,
                sums,
                {name: values[part].copy() for name, (_, values) in flight.parameters.items()},
                sorted(excluded, key=lambda e: e["member"]),
                simulation.kernel,
            )
        )
    return results


def _write_histories(task: Task, simulation: Simulation, flight: Flight) -> None:
    from terrafix.cosim.records.results import write_netcdf

    assert task.histories is not None
    folder = Path(task.histories)
    folder.mkdir(parents=True, exist_ok=True)
    dataset = simulation.result(wall_s=0.0, status="part of a campaign", flight=flight).dataset
    members = flight.members
    for start in range(0, len(members), task.block):
        part = dataset.isel(member=slice(start, start + task.block))
        part.attrs |= {
            "excluded": "",
            "evaluation": "",
            "members": str(members[start : start + task.block]),
        }
        write_netcdf(part, folder / f"{int(members[start]) // task.block:06d}.nc")


def single_threaded() -> None:
    """Say that this process is one of several: members are not stepped in threads of its own."""
    os.environ["TERRAFIX_THREADS"] = "1"
