"""One call from a system to a result: check, build, run, record, evaluate.

result = simulate(system, members=100, seed=7, out="run.nc")
print(result.evaluation["position"]["sigma_sample"])
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.buffers import SignalSlot
from terrafix.cosim.check import Plan, check, record_rate
from terrafix.cosim.checkpoint import read_checkpoint, write_checkpoint
from terrafix.cosim.clock import Exact, seconds, text_seconds
from terrafix.cosim.errors import (
    CheckpointError,
    ConfigurationError,
    RateError,
    StepError,
    TerrafixError,
)
from terrafix.cosim.evaluation import Evaluation
from terrafix.cosim.kernels import build_kernels
from terrafix.cosim.master import Master
from terrafix.cosim.parameters import Parameter
from terrafix.cosim.record import Recorder, write_manifest
from terrafix.cosim.symbolic import SymbolicComponent
from terrafix.cosim.system import System

if TYPE_CHECKING:
    import xarray

Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done, often."""
SLICES = 400  # progress reports per run
MAX_MEMBER = 2**32 - 1  # a word of the counter that noise is drawn from


@dataclass
class Result:
    """What a run gives back.

    Attributes
    ----------
    system : str
        Name of the system.
    seed : int
    members : int
        Number of members flown.
    excluded : list of dict
        Failed members: ``member``, ``component``, ``t_s``, ``reason``.
    ticks, component_steps : int
    wall_s, setup_s : float
        Running time, and the time to check, build and compile before it.
    kernel : str
        Which kind of kernel stepped the symbolic components.
    evaluation : dict
        What the evaluation component publishes; with several, by component path.
    dataset : xarray.Dataset
        Records, parameters as they reached the components, configuration.
    status : str
        ``"complete"`` or what ended the run early.
    """

    system: str
    seed: int
    members: int
    excluded: list[dict[str, Any]]
    ticks: int
    component_steps: int
    wall_s: float
    setup_s: float
    kernel: str
    evaluation: dict[str, Any]
    dataset: xarray.Dataset
    status: str = "complete"
    overruns: dict[str, int] = field(default_factory=dict)
    out: Path | None = None

    def summary(self) -> dict[str, Any]:
        """Plain types for JSON."""
        names = (
            "system seed members excluded ticks component_steps wall_s setup_s kernel "
            "evaluation status overruns"
        )
        return {n: getattr(self, n) for n in names.split()}


class RunError(StepError):
    """A run that failed in the middle; what it recorded is in `result` (and in its file)."""

    def __init__(self, message: str, result: Result) -> None:
        super().__init__(message)
        self.result = result


class Simulation:
    """A system built for one ensemble: what `simulate` runs, for use step by step.

    Parameters
    ----------
    system : System
    members : int or sequence of int, optional
        How many members, or which (a part of an ensemble keeps its numbers and draws).
    seed : int, optional
        Root seed; the system's own if absent.
    duration : exact time, optional
        How long it will run [s]: recordings that end earlier are refused.
    folder : Path, optional
        Where records are kept while the run goes on.

    Attributes
    ----------
    checkpoint : Path or None
        What an interrupted run can be resumed from.

    Raises
    ------
    SystemCheckError
        With every problem of the system.
    """

    def __init__(
        self,
        system: System,
        *,
        members: int | Sequence[int] | None = None,
        seed: int | None = None,
        duration: Exact | None = None,
        folder: Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        started = time.perf_counter()
        self.system = system
        length = None if duration is None else seconds(duration, "duration")
        self.plan: Plan = check(system, duration=length)
        self.members = _member_numbers(system.members if members is None else members)
        self.seed = system.seed if seed is None else seed
        self.folder = folder
        self.checkpoint: Path | None = None
        try:
            self.master = Master(self.plan, seed=self.seed, members=self.members)
            self.kernel = self._build_kernels(progress)
            self.recorders = self._make_recorders()
        except BaseException:
            for component in self.plan.flat.components.values():
                component.release()
            raise
        self.parameters = self._read_back()
        self.configuration = configuration(self.plan)
        self.initialized = False
        self.setup_s = time.perf_counter() - started

    def _build_kernels(self, progress: Progress | None) -> str:
        symbolic = {
            p: c for p, c in self.plan.flat.components.items() if isinstance(c, SymbolicComponent)
        }
        if not symbolic:
            return "none"
        requests = [c.kernel_request() for c in symbolic.values()]

        def report(done: int, total: int) -> None:
            if progress is not None:
                progress("compiling kernels", done / total)

        kernels = build_kernels(requests, progress=report)
        for component, kernel in zip(symbolic.values(), kernels, strict=True):
            component.bind_kernel(kernel)
        return "+".join(sorted({k.kind for k in kernels}))

    def _make_recorders(self) -> list[Recorder]:
        recorders = []
        flat, wiring = self.plan.flat, self.master.wiring

        def recorder(name: str, ports: Sequence[str]) -> Recorder:
            slots = {}
            for path in ports:
                slot = wiring.slots[path]
                assert isinstance(slot, SignalSlot)
                slots[path] = (flat.port(path), slot)
            return Recorder(name, slots, self.master.active, self.folder)

        for record in flat.records:
            made = recorder(record.name, record.ports)
            self.master.observe(record_rate(flat, record), made.sample)
            recorders.append(made)
        self._histories: dict[str, Recorder] = {}
        taken = {r.name for r in flat.records}
        for path, component in flat.components.items():
            if isinstance(component, Evaluation):
                name = path.replace(".", "_")
                while name in taken:
                    name += "_history"
                taken.add(name)
                made = recorder(name, [f"{path}.{p}" for p in component.recorded_ports()])
                assert component.rate is not None
                self.master.observe(component.rate, made.sample)
                recorders.append(made)
                self._histories[path] = made
        return recorders

    def _read_back(self) -> dict[str, tuple[str, NDArray[Any]]]:
        """Dispersed parameters as they reached the components."""
        found = {}
        for dispersion in self.plan.flat.dispersions:
            for target in dispersion.targets:
                owner, _, name = target.rpartition(".")
                component = self.plan.flat.components[owner]
                declared = component.settings()[name]
                assert isinstance(declared, Parameter)
                found[target] = (declared.unit_text(), component._settings[name].copy())
        return found

    # ------------------------------------------------------------------ running

    def initialize(self) -> None:
        """Publish everything at t = 0."""
        self._initialize(observe=True)

    def _initialize(self, *, observe: bool) -> None:
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_manifest(self.folder, self.recorders, self.attributes("interrupted"))
        self.master.initialize(observe=observe)
        self.initialized = True

    def run_until(self, t: Exact) -> None:
        """Step to time `t` [s]; initializes first if that was not done."""
        if not self.initialized:
            self.initialize()
        self.master.run_until(self.master.ticks(seconds(t, "time")))

    def get_state(self) -> dict[str, Any]:
        """Everything that is needed to continue from here in another process."""
        return {
            "master": self.master.get_state(),
            "recorders": {r.name: r.get_state() for r in self.recorders},
            "identity": self._identity(),
            "versions": _versions(),
        }

    def set_state(self, saved: dict[str, Any]) -> None:
        """Continue from a saved state.

        Raises
        ------
        CheckpointError
            If it belongs to another system, seed or ensemble; the difference is named.
        """
        mine, theirs = self._identity(), saved["identity"]
        differing = [k for k in mine if mine[k] != theirs.get(k)]
        if differing:
            key = differing[0]
            raise CheckpointError(_difference(key, mine[key], theirs.get(key)))
        if self.folder is not None and not self.folder.is_dir():
            raise CheckpointError(
                f"the records that belong to the checkpoint are gone: there is no folder "
                f"'{self.folder}'\n"
                "  a run that has ended keeps them in its result; start again without --resume"
            )
        if not self.initialized:
            self._initialize(observe=False)
        self.master.set_state(saved["master"])
        for recorder in self.recorders:
            recorder.set_state(saved["recorders"][recorder.name])

    def _identity(self) -> dict[str, Any]:
        return {
            "system": self.system.name,
            "seed": self.seed,
            "members": [int(m) for m in self.members],
            "configuration": self.configuration,
        }

    # ------------------------------------------------------------------ results

    def attributes(self, status: str) -> dict[str, Any]:
        """What is stored with every result."""
        from terrafix.cosim.results import cpu_name, versions

        return {
            "system": self.system.name,
            "doc": self.system.doc,
            "status": status,
            "seed": self.seed,
            "members": [int(m) for m in self.members],
            "excluded": self.master.excluded,
            "base_step_s": text_seconds(self.plan.base),
            "order": self.plan.order,
            "kernel": self.kernel,
            "versions": versions(),
            "cpu": cpu_name(),
            "configuration": self.configuration,
        }

    def evaluate(self) -> dict[str, Any]:
        """What evaluation components publish, from what was recorded so far."""
        found = {}
        for path, recorder in self._histories.items():
            component = self.plan.flat.components[path]
            assert isinstance(component, Evaluation)
            times, arrays = recorder.history()
            history = {n.removeprefix(f"{path}."): a for n, a in arrays.items()}
            found[path] = component.summarize(times, history)
        return next(iter(found.values())) if len(found) == 1 else found

    def result(self, *, wall_s: float, status: str = "complete") -> Result:
        """Gather what was recorded."""
        from terrafix.cosim.results import build_dataset, from_recorders

        try:
            evaluation = self.evaluate()
        except Exception:
            if status == "complete":
                raise
            evaluation = {}  # a history cut short must not cost the records
        attributes = self.attributes(status) | {"evaluation": evaluation}
        dataset = build_dataset(
            from_recorders(self.recorders), self.members, attributes, self.parameters
        )
        readers = self.master.wiring.readers
        return Result(
            system=self.system.name,
            seed=self.seed,
            members=len(self.members),
            excluded=list(self.master.excluded),
            ticks=self.master.tick,
            component_steps=self.master.component_steps,
            wall_s=wall_s,
            setup_s=self.setup_s,
            kernel=self.kernel,
            evaluation=evaluation,
            dataset=dataset,
            status=status,
            overruns={path: r.overruns for path, r in readers.items() if r.overruns},
        )


def simulate(
    system: System,
    *,
    members: int | Sequence[int] | None = None,
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
    length = _duration(system, duration)
    out = None if out is None else _writable(Path(out))
    if resume is not None and checkpoint is not None and Path(checkpoint) != Path(resume):
        raise ConfigurationError(
            f"a run resumed from '{resume}' keeps its checkpoints there, not in '{checkpoint}': "
            "its records are beside it\n  give no other checkpoint"
        )
    saved = None if resume is None else read_checkpoint(Path(resume))
    every = None if checkpoint_every is None else seconds(checkpoint_every, "checkpoint interval")
    if every is not None and every <= 0:
        raise RateError(f"checkpoint interval is {text_seconds(every)} s; it must be positive")
    target = _checkpoint_path(system, checkpoint or resume, out)
    folder = _folder(out, target if every is not None or saved is not None else None)
    simulation = Simulation(
        system, members=members, seed=seed, duration=length, folder=folder, progress=progress
    )
    try:
        _refuse_impossible(simulation, length, saved, every)
        if folder is not None and saved is None:
            _rescue(folder)
        started = time.perf_counter()
        try:
            if saved is not None:
                simulation.set_state(saved)
                simulation.checkpoint = target
            else:
                simulation.initialize()
            _fly(simulation, length, every, target, progress)
        except (StepError, KeyboardInterrupt) as error:
            result = _finish(simulation, started, _status(error), out)
            with suppress(StepError):  # the first failure is the one to report
                simulation.master.terminate()
            raise RunError(_kept(error, result, simulation.checkpoint), result) from error
        result = _finish(simulation, started, "complete", out)
        try:
            simulation.master.terminate()
        except StepError as error:
            raise RunError(_kept(error, result, None), result) from error
        return result
    finally:
        simulation.master.terminate()


def _refuse_impossible(
    simulation: Simulation, length: Fraction, saved: dict[str, Any] | None, every: Fraction | None
) -> None:
    """Raise what can be known to be wrong before the first step."""
    master, base = simulation.master, simulation.plan.base
    if master.ticks(length) == 0:
        raise RateError(
            f"duration is {text_seconds(length)} s, shorter than the base step of "
            f"{text_seconds(base)} s\n  give a longer one"
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
    target: Path,
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
            write_checkpoint(target, simulation.get_state())
            simulation.checkpoint = target
        if progress is not None:
            progress("running", stop / end)


def _finish(simulation: Simulation, started: float, status: str, out: Path | None) -> Result:
    from terrafix.cosim.results import write_netcdf

    wall = time.perf_counter() - started
    result = simulation.result(wall_s=wall, status=status)
    if out is not None:
        write_netcdf(result.dataset, out)
        result.out = out
    superfluous = status == "complete" or (out is not None and simulation.checkpoint is None)
    if simulation.folder is not None and superfluous:
        shutil.rmtree(simulation.folder, ignore_errors=True)
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


def _member_numbers(members: int | Sequence[int]) -> NDArray[np.int64]:
    if isinstance(members, bool) or (isinstance(members, int) and members < 1):
        raise ConfigurationError(f"members is {members}; an ensemble has at least 1")
    numbers = np.arange(members) if isinstance(members, int) else np.asarray(members)
    if (
        numbers.ndim != 1
        or not len(numbers)
        or numbers.dtype.kind not in "iu"
        or len(set(numbers.tolist())) != len(numbers)
        or numbers.min() < 0
        or numbers.max() > MAX_MEMBER
    ):
        raise ConfigurationError(
            f"members {members} must be different whole numbers from 0 to {MAX_MEMBER}"
        )
    return numbers.astype(np.int64)


def _duration(system: System, duration: Exact | None) -> Fraction:
    length = system.duration if duration is None else seconds(duration, "duration")
    if length is None:
        raise RateError(f"system '{system.name}' has no duration; give one, such as '600 s'")
    if length <= 0:
        raise RateError(f"duration is {text_seconds(length)} s; it must be positive")
    return length


def _writable(out: Path) -> Path:
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file in it")
    if not out.parent.is_dir():
        raise ConfigurationError(f"cannot write '{out}': there is no folder '{out.parent}'")
    try:
        probe = out.with_name(f".{out.name}.probe")
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigurationError(f"cannot write '{out}': {error.strerror or error}") from error
    return out


def _checkpoint_path(system: System, given: str | Path | None, out: Path | None) -> Path:
    if given is not None:
        return Path(given)
    return out.with_suffix(".ckpt") if out is not None else Path(f"{system.name}.ckpt")


def _folder(out: Path | None, checkpoint: Path | None) -> Path | None:
    """Where records live during the run: with the checkpoint if there is one, else with `out`."""
    anchor = checkpoint or out
    return None if anchor is None else anchor.with_name(f"{anchor.name}.parts")


def _rescue(folder: Path) -> None:
    """Turn what an interrupted run left into a file of its own before its folder is used again.

    What cannot be read is moved aside, never removed.
    """
    from terrafix.cosim.results import salvage, write_netcdf

    if not folder.is_dir():
        return
    number = 0
    while (target := folder.with_name(f"{folder.stem}.interrupted{number or ''}.nc")).exists() or (
        aside := target.with_suffix(".parts")
    ).exists():
        number += 1
    if any(folder.glob("*.npz")):
        try:
            write_netcdf(salvage(folder), target)
        except TerrafixError:
            folder.rename(aside)
            return
    shutil.rmtree(folder)


def configuration(plan: Plan) -> dict[str, Any]:
    """Everything that was set, in plain types: components, connections, records, dispersions."""
    flat = plan.flat
    return {
        "components": {
            path: {
                "type": f"{type(c).__module__}.{type(c).__qualname__}",
                "rate": str(c.rate),
                **{n: s.write(c.setting(n)) for n, s in c.settings().items() if n in c._base},
            }
            for path, c in flat.components.items()
        },
        "connections": sorted(
            f"{c}" + (f" (delay {text_seconds(c.delay)} s)" if c.delay else "")
            for c in flat.connections
        ),
        "records": {r.name: {"ports": list(r.ports), "rate": str(r.rate)} for r in flat.records},
        "dispersions": {
            d.name: {"kind": d.kind, "spread": str(d.spread), "to": list(d.targets)}
            for d in flat.dispersions
        },
    }


def _versions() -> dict[str, str]:
    from terrafix.cosim.results import versions

    return versions()


_OTHER = {"system": "another system", "seed": "another seed", "members": "other members"}


def _difference(key: str, mine: Any, theirs: Any) -> str:
    if key != "configuration":
        return (
            f"the checkpoint belongs to {_OTHER[key]}: {theirs!r} there, {mine!r} here\n"
            f"  resume it with the {key} it was made with"
        )
    for part, values in mine.items():
        other = (theirs or {}).get(part)
        if values == other:
            continue
        if isinstance(values, dict) and isinstance(other, dict):
            for name in sorted(set(values) | set(other)):
                if values.get(name) != other.get(name):
                    return (
                        f"the checkpoint was made with other {part}: '{name}' is\n"
                        f"  {other.get(name)} there\n  {values.get(name)} here\n"
                        "  give the same system file and --set options"
                    )
        return f"the checkpoint was made with other {part}: give the same system file and options"
    return "the checkpoint was made with another configuration"
