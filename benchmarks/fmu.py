"""What FMUs cost: stepping one here, in FMPy and in ecos; exporting; compiling for five platforms.

    python benchmarks/fmu.py

The FMU has three doubles in and three out and almost nothing between, so that what is timed is the
calls: set, step, get. Reference is FMPy's low-level loop over the same FMU in the same run.
"""

from __future__ import annotations

import importlib.util
import tempfile
import time
from pathlib import Path

import casadi as ca
import numpy as np

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run import fleet
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.fleet import Fleet, Group, Setup
from terrafix.cosim.exchange.fmi.run.reading import read_interface
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.system.system import System
from terrafix.models.core.model import Model

N = 20_000
OPEN_LOOP = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"


class Sum(SymbolicComponent):
    """Three numbers added up."""

    default_rate = Rate("0.01")

    u = Input((3,), unit="1", at="start", default=0.0, doc="added at each step")
    y = Output((3,), unit="1", doc="the sum")

    def build_model(self) -> Model:
        x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 3)
        return Model("sum", inputs={"u": u}, states={"x": x}, next={"x": x + u}, outputs={"y": x})


def best(action, repeats=5) -> float:
    """Shortest time of several [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def own(file: Path, *, driver: bool) -> float:
    """Microseconds for set, step, get of one instance."""
    interface = read_interface(open_archive(file))
    groups = {}
    for port in interface.ports:
        quantity = port.fields[""][0]
        group = Group(quantity.kind, tuple(quantity.references), 0, quantity.size)
        groups[port.is_input] = (group,)
    made = Fleet(Setup(str(file), CO_SIMULATION, "sum", groups[True], groups[False]), 1)
    chosen = fleet._driver
    if not driver:
        fleet._driver = lambda: None  # type: ignore[assignment]
    everybody = np.ones(1, dtype=np.bool_)
    made.enter(everybody)
    made.leave(everybody)
    fleet._driver = chosen
    assert (made.drive is not None) == driver
    ticks = [0]

    def loop() -> None:
        for k in range(ticks[0], ticks[0] + N):
            made.inputs[0, 0] = k
            made.step(k * 0.01, 0.01)
        ticks[0] += N

    cost = best(loop) / N * 1e6
    made.close()
    return cost


def scheduled(file: Path, n: int) -> float:
    """Microseconds for one component step of two FMUs feeding each other in our scheduler."""
    with System("pair") as system:
        for name in "ab":
            system.add(Fmu(file=file, rate=Rate("0.01")), name)
        system.connect("a.y", "b.u")
        system.connect("b.y", "a.u")
    simulation = Simulation(system)
    simulation.initialize()
    start = time.perf_counter()
    simulation.run_until(str(n * 0.01))
    cost = (time.perf_counter() - start) / (2 * n) * 1e6
    simulation.master.terminate()
    return cost


def in_fmpy(file: Path) -> float:
    """The same loop through FMPy's low-level interface (FMI 2)."""
    from fmpy.fmi2 import FMU2Slave

    archive = open_archive(file)
    description = archive.description
    slave = FMU2Slave(
        guid=description.guid,
        unzipDirectory=str(archive.folder),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="sum",
    )
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    variables = description.modelVariables
    inputs = [v.valueReference for v in variables if v.causality == "input"]
    outputs = [v.valueReference for v in variables if v.causality == "output"]
    ticks = [0]

    def loop() -> None:
        for k in range(ticks[0], ticks[0] + N // 4):
            slave.setReal(inputs, [float(k), 0.0, 0.0])
            slave.doStep(k * 0.01, 0.01)
            slave.getReal(outputs)
        ticks[0] += N // 4

    cost = best(loop) / (N // 4) * 1e6
    slave.terminate()
    slave.freeInstance()
    return cost


def in_ecos(file: Path) -> float | None:
    """A step of two connected instances in ecos, per component."""
    if importlib.util.find_spec("ecospy") is None:
        return None
    try:
        from ecospy import EcosSimulation, EcosSimulationStructure
    except OSError:
        return None
    with EcosSimulationStructure() as structure:
        for name in "ab":
            structure.add_model(name, str(file))
        for k in (1, 2, 3):
            structure.make_real_connection(f"a::y[{k}]", f"b::u[{k}]")
            structure.make_real_connection(f"b::y[{k}]", f"a::u[{k}]")
        with EcosSimulation(step_size=0.01, structure=structure) as simulation:
            simulation.init(0.0)
            return best(lambda: simulation.step(N)) / (2 * N) * 1e6


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for fmi in (2, 3):
            files[fmi] = Path(folder, f"sum{fmi}.fmu")
            export_fmu(Sum(), files[fmi], fmi=fmi)
        reference = in_fmpy(files[2])
        rows = [("FMPy, low-level loop (FMI 2)", reference)]
        for fmi in (2, 3):
            rows.append((f"terrafix, ctypes (FMI {fmi})", own(files[fmi], driver=False)))
            if fleet._driver() is not None:
                rows.append(
                    (f"terrafix, compiled driver (FMI {fmi})", own(files[fmi], driver=True))
                )
            rows.append(
                (f"terrafix, two components scheduled (FMI {fmi})", scheduled(files[fmi], N))
            )
        if (cost := in_ecos(files[2])) is not None:
            rows.append(("ecos, two components (FMI 2)", cost))
        print("set, step, get of three doubles, microseconds per component step")
        for label, cost in rows:
            print(f"  {label:<48} {cost:7.2f}  {cost / reference:5.2f} of FMPy")
        system = read_system(OPEN_LOOP)
        for name in ("orbit", "imu", "predict", "correct"):
            seconds = best(
                lambda n=name: export_fmu(system, Path(folder, "x.fmu"), component=n), repeats=1
            )
            print(f"export of '{name}' for the host: {seconds:.1f} s")
        if importlib.util.find_spec("ziglang") is not None:
            target = Path(folder, "all.fmu")

            def everywhere() -> None:
                export_fmu(system, target, component="orbit", platforms="all")

            everywhere()
            print(f"export of 'orbit' for five platforms, cache warm: {best(everywhere, 2):.1f} s")


if __name__ == "__main__":
    main()
