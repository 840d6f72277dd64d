"""Our satellite beside a real one, beside brahe, and what a field costs.

    python benchmarks/real_orbit.py [real] [brahe] [kepler] [filter] [speed] [fmu]

real: states of Sentinel-1A's orbit file (TERRAFIX_DATA), flown for 10 and 100 min at 70 x 70 with
Sun, Moon, tide and radiation pressure, against the later states of the file.
brahe: 24 hours of each force and of all, against brahe (installed with the tests).
kepler: two bodies for ten days at 100 Hz, against Kepler's equation.
filter: the open loop on five arcs of that file, with a field of degree 20 in the filter.
fmu: the 20 x 20 orbit exported, its co-simulation and model exchange against the native one, alone
and in `examples/satellite.toml`.
speed: kernels compiled, and 100 members of TC-1 under a true field of 20 x 20, against J2.

The surroundings are those of type `environment` (`terrafix[truth]`). Some ten minutes.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.components.truth.satellite_orbit import SatelliteOrbit
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run.component import CO_SIMULATION, MODEL_EXCHANGE, Fmu
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System
from terrafix.models.core.timescales import parse_epoch
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.motion.bodies import environment_at
from terrafix.models.motion.ephemeris import read_eof
from terrafix.models.motion.gravity_field import SHIPPED, shipped_field
from terrafix.models.motion.kepler import KeplerianElements, circular_orbit
from terrafix.models.motion.satellite import Forces, satellite_model

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT.parent / "shared" / "data"))
NAME = "S1A_OPER_AUX_RESORB_OPOD_20220918T093241_V20220918T053155_20220918T084925.EOF"
EXAMPLE = ROOT / "examples" / "satellite.toml"
ORBIT = DATA / "sentinel1" / NAME
STARTS = (0, 600, 1200, 1800, 2400, 3000, 3600, 4200, 4800, 5400)
"""Of the flights, after the first state of the file [s]."""
NOISE = "3e-9 m^2/s^3"
"""Of the filter: that of the paper times 86."""
ARCS = (1000, 3500, 6000, 8246, 10000)
"""Starts of the filter's arcs [s]."""
SENTINEL = 1.3 * 25.0 / 2157.0
"""Coefficient of radiation pressure times area over mass of Sentinel-1A, roughly [m^2/kg]."""
PERIOD = 10.0
"""Of the surroundings [s]."""
ARC_SECOND = np.radians(1 / 3600)
Sky = Callable[[float], dict[str, Any]]


def surroundings(utc: np.datetime64) -> Sky:
    """What surrounds a satellite, as a function of the seconds since an epoch."""
    start = parse_epoch(f"{utc} UTC")

    @cache
    def at(t: float) -> dict[str, Any]:
        return {"time": np.array(t), **environment_at(start.plus(t))}

    return at


def fly(
    forces: Forces,
    r_e: Any,
    v_e: Any,
    at: Sky,
    start: float,
    marks: tuple[float, ...],
    step: float,
    **given: float,
) -> dict[float, tuple[Any, Any]]:
    """States (r_e, v_e) at marks [s] after the start, by steps of the model itself."""
    model = satellite_model(forces, surrounded=True, told=True)
    function = model.step_function()
    names = [*model.inputs, *model.states, *model.parameters]
    states = {"r_e": r_e, "v_e": v_e, "omega_e": at(start)["omega_e"], "felt_v_e": np.zeros(3)}
    found = {}
    for k in range(1, round(max(marks) / step) + 1):
        t = start + k * step
        now = float(np.floor(t / PERIOD + 1e-9) * PERIOD)
        known = {f"surroundings.{n}": x for n, x in at(now).items()} | states | given
        results = function.call([known.get(n, np.zeros(3)) for n in names] + [step, t])
        values = [np.asarray(x.full()).ravel() for x in results[len(model.outputs) :]]
        states = dict(zip(model.states, values, strict=True))
        if any(abs(k * step - mark) < 1e-6 for mark in marks):
            found[k * step] = states["r_e"], states["v_e"]
    return found


def real() -> None:
    orbit = read_eof(ORBIT)
    at = surroundings(orbit.tags[0])
    forces = Forces(shipped_field(), sun=True, moon=True, tide=True, radiation=True)
    print(f"Sentinel-1A from {orbit.tags[0]} UTC, {shipped_field()}, Sun, Moon, tide, radiation")
    print("distance to the file's later states [m]; brahe's with the same forces, and with step 2")
    print("of the tide, the pole tide, relativity and drag (Harris-Priester, 6 m^2) besides")
    columns = ("start [s]", "10 min", "100 min", "brahe 10 min", "100 min", "more 100 min")
    print(" ".join(f"{name:>12}" for name in columns))
    for start in STARTS:
        k, marks = start // 10, (600.0, 6000.0)
        state = orbit.r_e[k], orbit.v_e[k]
        flown = fly(
            forces, *state, at, float(orbit.t[k]), marks, 5.0, radiation_coefficient=SENTINEL
        )
        wanted = [orbit.r_e[k + int(mark) // 10] for mark in marks]
        apart = [np.linalg.norm(flown[m][0] - r) for m, r in zip(marks, wanted, strict=True)]
        for more in (False, True):
            theirs = _by_brahe(np.concatenate(state), orbit.tags[k], marks, more)
            apart += [np.linalg.norm(x - r) for x, r in zip(theirs, wanted, strict=True)]
        shown = [apart[i] for i in (0, 1, 2, 3, 5)]
        print(f"{start:12d} " + " ".join(f"{x:12.3f}" for x in shown), flush=True)


def _by_brahe(state: Any, utc: np.datetime64, marks: tuple[float, ...], more: bool) -> list[Any]:
    """Positions at marks [s] by brahe, Earth-fixed, from such a state."""
    import brahe

    _tables_of_brahe(brahe)
    value = brahe.ParameterSource.value
    low = brahe.EphemerisSource.LowPrecision
    forces = brahe.ForceModelConfig(
        gravity=brahe.GravityConfiguration(
            degree=70, order=70, model_type=brahe.GravityModelType.from_file(str(SHIPPED))
        ),
        third_body=[
            brahe.ThirdBodyConfiguration(body, low)
            for body in (brahe.ThirdBody.SUN, brahe.ThirdBody.MOON)
        ],
        srp=brahe.SolarRadiationPressureConfiguration(
            area=value(25.0), cr=value(1.3), eclipse_model=brahe.EclipseModel.CONICAL
        ),
        drag=brahe.DragConfiguration(
            model=brahe.AtmosphericModel.HARRIS_PRIESTER, area=value(6.0), cd=value(2.2)
        )
        if more
        else None,
        mass=value(2157.0),
        relativity=more,
    )
    forces.tides = brahe.TidesConfiguration(
        permanent=brahe.PermanentTideConfig.AUTO,
        solid=brahe.SolidTideConfig(frequency_dependent=more, pole_tide=more),
    )
    midnight = brahe.Epoch.from_datetime(2022, 9, 18, 0, 0, 0.0, 0.0, brahe.TimeSystem.UTC)
    since = (utc - np.datetime64("2022-09-18T00:00:00", "ns")) / np.timedelta64(1, "s")
    start = midnight + float(since)
    propagator = brahe.NumericalOrbitPropagator(
        start,
        brahe.state_itrf_to_gcrf(start, state),
        brahe.NumericalPropagationConfig.high_precision(),
        forces,
        np.array([2157.0]),
    )
    found = []
    for mark in marks:
        propagator.propagate_to(start + mark)
        inertial = np.asarray(propagator.current_state())[:6]
        found.append(brahe.state_gcrf_to_itrf(start + mark, inertial)[:3])
    return found


def _tables_of_brahe(brahe: Any) -> None:
    """The day's Earth orientation; brahe 1.8.0 takes three of them under each other's names."""
    x, y = 0.293584 * ARC_SECOND, 0.287785 * ARC_SECOND
    dx, dy = 4.06e-4 * ARC_SECOND, -1.24e-4 * ARC_SECOND
    provider = brahe.StaticEOPProvider.from_values(
        pm_x=y, pm_y=-0.0092607, ut1_utc=x, dx=dx, dy=dy, lod=0.0
    )
    brahe.set_global_eop_provider_from_static_provider(provider)
    assert brahe.get_global_pm(59840.0) == (x, y)


def beside_brahe() -> None:
    sys.path.insert(0, str(ROOT / "tests" / "models" / "motion"))
    import brahe
    import brahe_reference as reference

    reference.use_tables()
    r_i, v_i = circular_orbit(7.07e6, 3.986004415e14, np.radians(98.0))
    bodies = {"sun": brahe.ThirdBody.SUN, "moon": brahe.ThirdBody.MOON}
    everything = dict.fromkeys(("sun", "moon", "tide", "radiation"), True)
    print("against brahe, same coefficients, tables, Sun and Moon: distance [m]")
    print(f"{'forces':>24} {'10 min':>9} {'24 h':>9}")
    cases: list[tuple[int, dict[str, bool]]] = [(20, {})]
    cases += [(20, {name: True}) for name in everything]
    cases += [(20, everything), (70, {}), (70, everything)]
    for degree, chosen in cases:
        forces = Forces(shipped_field().cut(degree), **chosen)
        theirs = reference.propagated(
            r_i,
            v_i,
            [600.0, 86400.0],
            degree=degree,
            field=SHIPPED,
            bodies=[bodies[name] for name in chosen if name in bodies],
            tide="tide" in chosen,
            srp="radiation" in chosen,
        )
        apart = []
        for until, expected in zip((600.0, 86400.0), theirs, strict=True):
            step = 1.0 if until == 600.0 else 2.0
            ours = reference.flown(
                forces,
                r_i,
                v_i,
                until,
                step,
                radiation_coefficient=1.3 * reference.COEFFICIENT,
            )
            apart.append(np.linalg.norm(ours[:3] - expected[:3]))
        name = f"{degree} x {degree} {' '.join(chosen)}"
        print(f"{name:>24} {apart[0]:9.1e} {apart[1]:9.1e}", flush=True)


def kepler() -> None:
    elements = KeplerianElements(7.07e6, 1e-3, np.radians(98.0), 0.3, 0.4, 0.5)
    r_i, v_i = elements.state(EARTH.mu)
    r_e, v_e = earth_fixed_from_inertial_array(r_i, v_i, 0.0, EARTH.rotation_rate)
    days = 10
    system = System("kepler", duration=f"{days * 86400} s")
    begin = {"start_from": "parameters", "r0_e": r_e, "v0_e": v_e, "gravity": "two-body"}
    system.add(SatelliteOrbit(rate=Rate(hz=100), **begin), "orbit")
    system.record("all", ["orbit.r_i"], period="86400 s")
    result = simulate(system, members=1).dataset["orbit.r_i"]
    times = result[str(result.dims[0])].values
    print(f"two bodies at 100 Hz: last time {times[-1]!r} s")
    for day in range(days + 1):
        rate = np.sqrt(EARTH.mu / 7.07e6**3)
        eccentric = _eccentric(elements, rate * times[day])
        expected = elements_at(elements, eccentric)
        print(f"  day {day}: {np.linalg.norm(result.values[day, 0] - expected):.2e} m from Kepler")


def _eccentric(elements: KeplerianElements, mean: float) -> float:
    e = elements.eccentricity
    start = 2 * np.arctan2(
        np.sqrt(1 - e) * np.sin(elements.true_anomaly / 2),
        np.sqrt(1 + e) * np.cos(elements.true_anomaly / 2),
    )
    wanted = start - e * np.sin(start) + mean
    E = wanted
    for _ in range(20):
        E -= (E - e * np.sin(E) - wanted) / (1 - e * np.cos(E))
    return float(E)


def elements_at(elements: KeplerianElements, eccentric: float) -> Any:
    from dataclasses import replace

    e = elements.eccentricity
    anomaly = 2 * np.arctan2(
        np.sqrt(1 + e) * np.sin(eccentric / 2), np.sqrt(1 - e) * np.cos(eccentric / 2)
    )
    return replace(elements, true_anomaly=float(anomaly)).state(EARTH.mu)[0]


def filtered() -> None:
    system = ROOT / "examples" / "spacecraft_sar_recorded_orbit.toml"
    print(f"open loop on Sentinel-1A, TC-2, 100 members, filter of degree 20, noise {NOISE}")
    print(f"{'start [s]':>10} {'NEES (9)':>9} {'inside':>7} {'NIS (4)':>8}")
    for start in ARCS:
        settings = [("field", "20"), ("predict.accel_psd", NOISE), ("orbit.start", f"{start} s")]
        e = simulate(read_system(system, settings), members=100, seed=7).evaluation
        print(
            f"{start:10d} {e['nees']['mean']:9.2f} {e['nees']['fraction_inside']:7.0%} "
            f"{e['nis']['mean']:8.2f}",
            flush=True,
        )


def speed() -> None:
    for degree in (20, 36):
        with tempfile.TemporaryDirectory() as cache:
            os.environ["TERRAFIX_CACHE"] = cache
            seconds = [_seconds(partial(_compiled, degree)) for _ in range(2)]
            del os.environ["TERRAFIX_CACHE"]
        print(f"{degree} x {degree}: ready after {seconds[0]:.1f} s, then {seconds[1]:.1f} s")
    times = {}
    for name in ("orbit, J2", "satellite, 20 x 20"):
        _open_loop(name, "10")
        times[name] = min(_seconds(partial(_open_loop, name, "590.4")) for _ in range(3))
        print(f"TC-1, 100 members, {name}: {times[name]:.2f} s")
    print(f"ratio {times['satellite, 20 x 20'] / times['orbit, J2']:.2f} (bar: 3)")


def fmus() -> None:
    r_e, v_e = np.array([-1104646.3, -6096830.4, 3395727.4]), np.array([-1004.7, 3648.9, 6498.0])
    begin = {"start_from": "parameters", "r0_e": r_e, "v0_e": v_e}

    def flown(component: Any) -> dict[str, Any]:
        system = System("flown")
        system.add(component, "orbit")
        simulation = Simulation(system)
        simulation.run_until("600")
        slots = simulation.master.wiring.slots
        found = {name: slots[f"orbit.{name}"].data[0].copy() for name in ("r_e", "v_e", "r_i")}
        simulation.master.terminate()
        return found

    expected = flown(SatelliteOrbit(rate=Rate(hz=10), **begin))
    for fmi in (2, 3):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "orbit.fmu")
            source = System("source")
            source.add(SatelliteOrbit(rate=Rate(hz=10), **begin), "orbit")
            made = _seconds(partial(export_fmu, source, file, component="orbit", fmi=fmi))
            stepped = flown(Fmu(file=file, kind=CO_SIMULATION, rate=Rate(hz=10)))
            settings: dict[str, Any] = {"kind": MODEL_EXCHANGE, "tolerance": 1e-13}
            integrated = flown(Fmu(file=file, rate=Rate(hz=10), **settings))
        same = all(stepped[n].tobytes() == expected[n].tobytes() for n in expected)
        apart = np.linalg.norm(integrated["r_e"] - expected["r_e"])
        print(
            f"FMI {fmi}, 20 x 20, made in {made:.1f} s: co-simulation over 600 s "
            f"{'has the same bits' if same else 'DIFFERS'}; model exchange is {apart:.1e} m off"
        )
        _in_its_world(fmi)


def _in_its_world(fmi: int) -> None:
    """The example with an FMU in place of its satellite: its start, environment and air given."""
    native, foreign = read_system(EXAMPLE), read_system(EXAMPLE)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "satellite.fmu")
        export_fmu(native, file, component="satellite", fmi=fmi)
        foreign.replace("satellite", Fmu(file=file, kind=CO_SIMULATION, rate=Rate("1")))
        flown = [simulate(system, members=1).dataset for system in (native, foreign)]
    same = all(x.values.tobytes() == flown[1][n].values.tobytes() for n, x in flown[0].items())
    print(f"  {EXAMPLE.stem}.toml with it: {'the same bits' if same else 'DIFFERS'}")


def _compiled(degree: int) -> None:
    r_e, v_e = np.array([-1104646.3, -6096830.4, 3395727.4]), np.array([-1004.7, 3648.9, 6498.0])
    system = System("compiled", duration="1 s")
    begin = {"start_from": "parameters", "r0_e": r_e, "v0_e": v_e}
    system.add(SatelliteOrbit(degree=degree, **begin), "orbit")
    simulate(system, members=100)


def _open_loop(name: str, duration: str) -> None:
    system = read_system(ROOT / "examples" / "spacecraft_sar_open_loop.toml", [("case", "TC-1")])
    orbit = system.find("orbit")
    if name != "orbit, J2":
        r_i, v_i = orbit.setting("r0_i"), orbit.setting("v0_i")
        r_e, v_e = earth_fixed_from_inertial_array(r_i, v_i, 0.0, EARTH.rotation_rate)
        begin = {"start_from": "parameters", "r0_e": r_e, "v0_e": v_e}
        system.replace("orbit", SatelliteOrbit(rate=orbit.rate, degree=20, **begin))
    simulate(system, members=100, duration=duration)


def _seconds(action: Callable[[], object]) -> float:
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


PARTS = {
    "real": real,
    "brahe": beside_brahe,
    "kepler": kepler,
    "filter": filtered,
    "speed": speed,
    "fmu": fmus,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], metavar="part")
    for name in parser.parse_args().parts or PARTS:
        PARTS[name]()


if __name__ == "__main__":
    main()
