"""What a step of an FMU costs, in chains of 1, 10 and 100, beside ecos and FMPy in the same run.

    python benchmarks/fmu_steps.py [--quick]
    python benchmarks/fmu_steps.py members      # load time and memory of 100 members
    python benchmarks/fmu_steps.py million      # an FMU with a million variables

The FMUs do almost nothing, so that what is timed is the calls of a master: set, step, get. They are
compiled here from the C below, with all doubles, with a double, a whole number and a truth value,
and with six types. Chains are a -> b -> c -> ..., every input connected; ecos connects no Float32,
Int64 and UInt8, and leaves those alone. "recorded" is with somebody who looks on at every step.
Times are the shortest of several, of the processor; of isolated FMUs, which wait for another
process, on the wall. Another master that is not installed is left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.platforms import host_platform
from terrafix.cosim.exchange.fmi.write.binaries import build
from terrafix.cosim.system.system import System

STEP = 0.01
KINDS = {
    "doubles": (2, ("Real", "Real", "Real")),
    "mixed": (2, ("Real", "Integer", "Boolean")),
    "six types": (3, ("Float64", "Float32", "Int32", "Int64", "UInt8", "Boolean")),
}
"""FMI and the types of the inputs; the outputs are the same."""
C_TYPES = {
    2: {"Real": "double", "Integer": "int", "Boolean": "int"},
    3: {
        "Float64": "double",
        "Float32": "float",
        "Int32": "int32_t",
        "Int64": "int64_t",
        "UInt8": "uint8_t",
        "Boolean": "_Bool",
    },
}
_C = """
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#define EXPORT __attribute__((visibility("default")))
struct inst { double v[WIDTH]; };
EXPORT int fmiVDoStep(struct inst *m, double t, double h, int same MORE_OF_STEP)
{
    END_OF_STEP
    for (int k = 0; k < WIDTH / 2; k++)
        m->v[WIDTH / 2 + k] = WHOLE[k] ? m->v[k] == 0 : 0.5 * m->v[WIDTH / 2 + k] + m->v[k] + 1;
    return 0;
}
EXPORT void fmiVFreeInstance(void *m) { free(m); }
EXPORT int fmiVExitInitializationMode(void *m) { return 0; }
EXPORT int fmiVTerminate(void *m) { return 0; }
EXPORT int fmiVReset(void *m) { return 0; }
EXPORT int fmiVSetDebugLogging(void *m, int on, size_t n, const char **names) { return 0; }
EXPORT const char *fmiVGetVersion(void) { return "V.0"; }
"""
_C_OF = {
    2: """
EXPORT void *fmi2Instantiate(const char *name, int kind, const char *token, const char *where,
                             const void *given, int visible, int logging)
{ return calloc(1, sizeof(struct inst)); }
EXPORT int fmi2SetupExperiment(void *m, int a, double b, double c, int d, double e) { return 0; }
EXPORT int fmi2EnterInitializationMode(void *m) { return 0; }
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
""",
    3: """
EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *where,
    _Bool visible, _Bool logging, _Bool events, _Bool early, const uint32_t *vr, size_t n,
    void *environment, void *log, void *intermediate)
{ return calloc(1, sizeof(struct inst)); }
EXPORT int fmi3EnterInitializationMode(void *m, _Bool a, double b, double c, _Bool d, double e)
{ return 0; }
""",
}
_ACCESS = """
EXPORT int fmiVGetNAME(struct inst *m, const uint32_t *vr, size_t n, TYPE *out SIZE)
{ for (size_t k = 0; k < n; k++) out[k] = (TYPE)m->v[vr[k]]; return 0; }
EXPORT int fmiVSetNAME(struct inst *m, const uint32_t *vr, size_t n, const TYPE *in SIZE)
{ for (size_t k = 0; k < n; k++) m->v[vr[k]] = in[k]; return 0; }
"""
_UNUSED = {
    2: (
        *("GetString", "SetString", "SetRealInputDerivatives", "GetRealOutputDerivatives"),
        *("CancelStep", "GetStatus", "GetRealStatus", "GetIntegerStatus", "GetBooleanStatus"),
        *("GetStringStatus", "GetFMUstate", "SetFMUstate", "FreeFMUstate"),
        *("SerializedFMUstateSize", "SerializeFMUstate", "DeSerializeFMUstate"),
        "GetDirectionalDerivative",
    ),
    3: (
        *("InstantiateModelExchange", "InstantiateScheduledExecution", "GetInt8", "SetInt8"),
        *("GetInt16", "SetInt16", "GetUInt16", "SetUInt16", "GetUInt32", "SetUInt32"),
        *("GetUInt64", "SetUInt64", "GetString", "SetString", "GetBinary", "SetBinary"),
        *("GetClock", "SetClock", "EnterEventMode", "EnterStepMode", "UpdateDiscreteStates"),
        *("EnterConfigurationMode", "ExitConfigurationMode", "GetFMUState", "SetFMUState"),
        *("FreeFMUState", "SerializedFMUStateSize", "SerializeFMUState", "DeserializeFMUState"),
        *("GetIntervalDecimal", "GetIntervalFraction", "GetShiftDecimal", "GetShiftFraction"),
        *("SetIntervalDecimal", "SetIntervalFraction", "SetShiftDecimal", "SetShiftFraction"),
        *("EvaluateDiscreteStates", "EnterContinuousTimeMode", "CompletedIntegratorStep"),
        *("SetTime", "SetContinuousStates", "GetContinuousStateDerivatives"),
        *("GetEventIndicators", "GetContinuousStates", "GetNominalsOfContinuousStates"),
        *("GetNumberOfEventIndicators", "GetNumberOfContinuousStates", "GetDirectionalDerivative"),
        *("GetAdjointDerivative", "GetOutputDerivatives", "ActivateModelPartition"),
        *("GetNumberOfVariableDependencies", "GetVariableDependencies"),
        *("SetShiftFraction",),
    ),
}
"""Functions that other masters look for; here they are refused."""


def compiled(fmi: int, types: tuple[str, ...]) -> bytes:
    """A library whose first half of variables are inputs, the second outputs."""
    whole = ", ".join(str(int(t not in ("Real", "Float64", "Float32"))) for t in types)
    names = dict.fromkeys([*C_TYPES[fmi]])
    access = "".join(
        _ACCESS.replace("NAME", n).replace("TYPE", C_TYPES[fmi][n]) for n in names
    ).replace(" SIZE", ", size_t s" if fmi == 3 else "")
    unused = "".join(
        f"EXPORT int fmiV{n}(void *m) {{ return 3; }}\n" for n in dict.fromkeys(_UNUSED[fmi])
    )
    text = (_C + _C_OF[fmi] + access + unused).replace("fmiV", f"fmi{fmi}")
    text = text.replace('"V.0"', f'"{fmi}.0"').replace("WIDTH", str(2 * len(types)))
    text = text.replace("WHOLE", f"(const int[]){{{whole}}}")
    flags = ", _Bool *event, _Bool *end, _Bool *early, double *last"
    text = text.replace(" MORE_OF_STEP", flags if fmi == 3 else "")
    text = text.replace("END_OF_STEP", "*event = *end = *early = 0; *last = t + h;" * (fmi == 3))
    return build({"small.c": text}, ["small.c"], (None,))[host_platform()]


def make(target: Path, fmi: int, types: tuple[str, ...], library: bytes | None = None) -> Path:
    """Write an FMU of these inputs and as many outputs."""
    elements, n = [], len(types)
    for k, kind in enumerate((*types, *types)):
        side, name = ("input", f"u{k}") if k < n else ("output", f"y{k - n}")
        start = {True: "0", False: "false"}[kind != "Boolean"]
        start = f' start="{start}"' if k < n else ""
        plain = kind in ("Real", "Float64", "Float32")
        discrete = "" if plain else ' variability="discrete"'
        shared = f'name="{name}" valueReference="{k}" causality="{side}"{discrete}'
        elements.append(
            f"<ScalarVariable {shared}><{kind}{start}/></ScalarVariable>"
            if fmi == 2
            else f"<{kind} {shared}{start}/>"
        )
    if fmi == 3:
        shared = f'name="time" valueReference="{2 * n}" causality="independent"'
        elements.append(f'<Float64 {shared} variability="continuous"/>')
    unknowns = (
        "<Outputs>" + "".join(f'<Unknown index="{n + k + 1}"/>' for k in range(n)) + "</Outputs>"
        if fmi == 2
        else "".join(f'<Output valueReference="{n + k}"/>' for k in range(n))
    )
    token = 'guid="{1}"' if fmi == 2 else 'instantiationToken="{1}"'
    xml = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="{fmi}.0" '
        f'modelName="small" {token}><CoSimulation modelIdentifier="small" '
        'canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{''.join(elements)}</ModelVariables>"
        f"<ModelStructure>{unknowns}</ModelStructure></fmiModelDescription>"
    )
    host = host_platform()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
        content = compiled(fmi, types) if library is None else library
        archive.writestr(f"binaries/{host.folder(fmi)}/small{host.suffix}", content)
    return target


def best(
    action: Callable[[], object], repeats: int, clock: Callable[[], float] = time.process_time
) -> float:
    """Shortest time of several [s], of the processor: others may want it too."""
    times = []
    for _ in range(repeats):
        start = clock()
        action()
        times.append(clock() - start)
    return min(times)


# --------------------------------------------------------------------------------- masters


def chain(file: Path, n: int, width: int, **options: Any) -> System:
    """n FMUs, each fed by the one before."""
    system = System("chain")
    for k in range(n):
        system.add(Fmu(file=file, rate=Rate(str(STEP)), **options), f"c{k}")
        for i in range(width if k else 0):
            system.connect(f"c{k - 1}.y{i}", f"c{k}.u{i}")
    return system


def in_terrafix(
    file: Path,
    n: int,
    width: int,
    steps: int,
    repeats: int,
    *,
    recorded: bool = False,
    **options: Any,
) -> float:
    """Microseconds for a step of one component of a chain."""
    system = chain(file, n, width, **options)
    simulation = Simulation(system)
    if recorded:
        simulation.master.observe(Rate(str(STEP)), lambda _: None)
    simulation.initialize()
    ends = iter(range(steps, (repeats + 1) * steps, steps))
    clock = time.perf_counter if options.get("isolate") else time.process_time
    cost = best(lambda: simulation.run_until(str(round(next(ends) * STEP, 9))), repeats, clock)
    simulation.master.terminate()
    return cost / (steps * n) * 1e6


def in_ecos(file: Path, types: tuple[str, ...], n: int, steps: int, repeats: int) -> float | None:
    """The same in ecos."""
    if importlib.util.find_spec("ecospy") is None:
        return None
    try:
        from ecospy import EcosSimulation, EcosSimulationStructure
    except OSError:
        return None
    with EcosSimulationStructure() as structure:
        connect = {
            **dict.fromkeys(("Real", "Float64"), structure.make_real_connection),
            **dict.fromkeys(("Integer", "Int32"), structure.make_int_connection),
            "Boolean": structure.make_bool_connection,
        }
        for k in range(n):
            structure.add_model(f"c{k}", str(file))
            for i, kind in enumerate(types if k else ()):
                if kind in connect:
                    connect[kind](f"c{k - 1}::y{i}", f"c{k}::u{i}")
        with EcosSimulation(step_size=STEP, structure=structure) as simulation:
            simulation.init(0.0)
            return best(lambda: simulation.step(steps), repeats) / (steps * n) * 1e6


def in_fmpy(
    file: Path, fmi: int, types: tuple[str, ...], n: int, steps: int, repeats: int
) -> float:
    """The same by FMPy's functions of one instance, and a loop over a dictionary of values."""
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    folder, description = extract(str(file)), read_model_description(str(file))
    slaves: list[Any] = []
    for k in range(n):
        slave = (FMU2Slave if fmi == 2 else FMU3Slave)(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier="small",
            instanceName=f"c{k}",
        )
        slave.instantiate()
        if fmi == 2:
            slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        slaves.append(slave)
    kinds = list(dict.fromkeys(types))
    groups = [[i for i, kind in enumerate(types) if kind == each] for each in kinds]
    calls = [
        [
            (getattr(s, f"set{kind}"), getattr(s, f"get{kind}"), at, [len(types) + i for i in at])
            for kind, at in zip(kinds, groups, strict=True)
        ]
        for s in slaves
    ]
    held = [[get(there) for _, get, _, there in each] for each in calls]
    now = [0]

    def loop() -> None:
        for k in range(now[0], now[0] + steps):
            before = held[:]
            for c, (slave, each) in enumerate(zip(slaves, calls, strict=True)):
                if c:
                    for (set_, _, at, _), values in zip(each, before[c - 1], strict=True):
                        set_(at, values)
                slave.doStep(k * STEP, STEP)
                held[c] = [get(there) for _, get, _, there in each]
        now[0] += steps

    cost = best(loop, repeats) / (steps * n) * 1e6
    for slave in slaves:
        slave.terminate()
        slave.freeInstance()
    return cost


def table(*, quick: bool) -> None:
    """Print microseconds of a component step, and as parts of ecos'."""
    total, repeats = (2_000, 3) if quick else (40_000, 9)
    print("microseconds of a component step (and of ecos' time)")
    print(f"  {'':<22}{'n':>4} {'terrafix':>16} {'recorded':>16} {'ecos':>8} {'FMPy':>16}")
    with tempfile.TemporaryDirectory() as folder:
        for name, (fmi, types) in KINDS.items():
            file = make(Path(folder, f"{name.replace(' ', '_')}.fmu"), fmi, types)
            for n in (1, 10, 100):
                steps = max(total // n, 20)
                ecos = in_ecos(file, types, n, steps, repeats)
                own = in_terrafix(file, n, len(types), steps, repeats)
                seen = in_terrafix(file, n, len(types), steps, repeats, recorded=True)
                fmpy = in_fmpy(file, fmi, types, n, max(steps // 10, 2), repeats)
                _row(f"{name} (FMI {fmi})", n, own, seen, ecos, fmpy)
        fmi, types = KINDS["doubles"]
        file = make(Path(folder, "alone.fmu"), fmi, types)
        for n in (1, 10, 100):
            steps = max(total // (20 * n), 20)
            ecos = in_ecos(file, types, n, steps, repeats)
            own = in_terrafix(file, n, len(types), steps, 3, isolate=True)
            _row("doubles, isolated", n, own, None, ecos, None)


def _row(
    name: str, n: int, own: float, seen: float | None, ecos: float | None, fmpy: float | None
) -> None:
    def cell(cost: float | None) -> str:
        if cost is None:
            return f"{'':>16}"
        ratio = "" if ecos is None else f" ({cost / ecos:.3g})"
        return f"{cost:.3g}{ratio}".rjust(16)

    only = "" if ecos is None else f"{ecos:.3g}"
    print(f"  {name:<22}{n:>4} {cell(own)} {cell(seen)} {only:>8} {cell(fmpy)}", flush=True)


# --------------------------------------------------------------------------------- members


def resident() -> float:
    """Memory of this process and those that it started, shared pages in parts [MiB]."""
    import psutil

    here = psutil.Process()
    return sum(p.memory_full_info().pss for p in (here, *here.children(recursive=True))) / 2**20


def members(how: str, n: int) -> None:
    """Print load time, memory and time of a step of an ensemble; in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        fmi, types = KINDS["doubles"]
        file = make(Path(folder, "small.fmu"), fmi, types)
        if how == "FMPy":
            from fmpy import extract, read_model_description
            from fmpy.fmi2 import FMU2Slave

            place, description = extract(str(file)), read_model_description(str(file))
            before, begun, kept = resident(), time.perf_counter(), []
            for k in range(n):
                slave = FMU2Slave(
                    guid=description.guid,
                    unzipDirectory=place,
                    modelIdentifier="small",
                    instanceName=f"c{k}",
                )
                slave.instantiate()
                slave.setupExperiment(startTime=0.0)
                slave.enterInitializationMode()
                slave.exitInitializationMode()
                kept.append(slave)
            loaded = time.perf_counter() - begun
            print(f"  {how:<32} {loaded:6.2f} s {resident() - before:8.1f} MiB")
            return
        system = chain(file, 1, len(types), isolate=how == "isolated")
        before, begun = resident(), time.perf_counter()
        if how == "a process each":
            from terrafix.cosim.exchange.fmi.run import component, places

            def apart(_: Any, setup: Any, *arguments: Any, **__: Any) -> Any:
                n_members = len(arguments[0])
                return places.RemoteFleet(setup, n_members, 60.0, apart=True), ""

            component.make_fleet = apart  # type: ignore[attr-defined]
        simulation = Simulation(system, members=n)
        simulation.initialize()
        loaded, memory = time.perf_counter() - begun, resident() - before
        ends = iter(range(100, 1000, 100))
        clock = time.perf_counter
        cost = best(lambda: simulation.run_until(str(round(next(ends) * STEP, 9))), 5, clock)
        print(
            f"  {how:<32} {loaded:6.2f} s {memory:8.1f} MiB "
            f"{cost / (100 * n) * 1e6:8.3g} us a member's step"
        )
        simulation.master.terminate()


def all_members(n: int = 100) -> None:
    """Print what 100 members of one FMU cost."""
    print(f"{n} members of one FMU: load time, memory above that of the process without them")
    for how in ("one process", "isolated", "a process each", "FMPy"):
        subprocess.run([sys.executable, __file__, "members", "--how", how], check=True)


# --------------------------------------------------------------------------------- a million


FORMS = ("locals", "parameters", "arrays", "ports")


def million(n: int, form: str) -> None:
    """Print processor time and memory of an FMU with n variables, in a process of its own."""
    import resource

    from fmpy import read_model_description

    half = n // 2
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "million.fmu")
        _write_wide(file, half, form)

        def said(what: str, begun: float) -> float:
            used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            taken = time.process_time() - begun
            print(f"    {what:<30} {taken:8.2f} s, peak {used:7.0f} MiB", flush=True)
            return time.process_time()

        print(
            f"  {n} variables as {form}, archive of {file.stat().st_size / 2**20:.0f} MiB",
            flush=True,
        )
        begun = time.process_time()
        system = System("wide")
        system.add(Fmu(file=file, rate=Rate(str(STEP))), "part")
        begun = said("read, parameters and ports", begun)
        simulation = Simulation(system)
        begun = said("checked and built", begun)
        simulation.initialize()
        begun = said("initialized", begun)
        simulation.run_until("0.1")
        said("10 steps", begun)
        simulation.master.terminate()
        begun = time.process_time()
        if form == FORMS[0]:
            read_model_description(str(file), validate=False)
            said("FMPy alone reads the description", begun)


def _write_wide(file: Path, half: int, form: str) -> None:
    """Two halves: inputs and outputs as arrays or ports, or other variables beside one of each."""
    text = _C + _C_OF[2]
    text += _ACCESS.replace("NAME", "Real").replace("TYPE", "double").replace(" SIZE", "")
    text += "".join(f"EXPORT int fmiV{n}(void *m) {{ return 3; }}\n" for n in _UNUSED[2])
    text = text.replace("fmiV", "fmi2").replace('"V.0"', '"2.0"').replace("WIDTH", str(2 * half))
    text = text.replace("WHOLE[k]", "0").replace(" MORE_OF_STEP", "").replace("END_OF_STEP", "")
    library = build({"small.c": text}, ["small.c"], (None,))[host_platform()]
    name = "{}[{}]" if form == "arrays" else "{}{}"
    other = {"locals": "local", "parameters": "parameter"}.get(form)

    def variables() -> Iterator[str]:
        for k in range(2 * half):
            side = other if other and k not in (0, half) else ("input", "output")[k >= half]
            start = ' start="0"' * (side in ("input", "parameter"))
            fixed = ' variability="fixed"' * (side == "parameter")
            called = name.format("uy"[k >= half], k % half + 1)
            yield (
                f'<ScalarVariable name="{called}" valueReference="{k}" causality="{side}"{fixed}>'
                f"<Real{start}/></ScalarVariable>"
            )

    outputs = [half] if other else range(half, 2 * half)
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="2.0" '
        'modelName="small" guid="{1}"><CoSimulation modelIdentifier="small" '
        'canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{''.join(variables())}</ModelVariables><ModelStructure><Outputs>"
        + "".join(f'<Unknown index="{k + 1}"/>' for k in outputs)
        + "</Outputs></ModelStructure></fmiModelDescription>"
    )
    host = host_platform()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", xml)
        archive.writestr(f"binaries/{host.folder(2)}/small{host.suffix}", library)


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", default="steps", choices=("steps", "members", "million"))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--how", help=argparse.SUPPRESS)
    parser.add_argument("--variables", type=int, default=1_000_000)
    parser.add_argument("--form", choices=FORMS)
    options = parser.parse_args()
    if options.what == "steps":
        table(quick=options.quick)
    elif options.what == "million" and options.form:
        million(options.variables, options.form)
    elif options.what == "million":
        for form in FORMS:
            given = ("--form", form, "--variables", str(options.variables))
            subprocess.run([sys.executable, __file__, "million", *given], check=True)
    elif options.how:
        members(options.how, 100)
    else:
        all_members()


if __name__ == "__main__":
    main()
