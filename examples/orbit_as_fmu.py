"""Can the orbit of the spacecraft system come from an FMU, ours or somebody else's?

The open loop flies twice over two minutes: as it is, and with its orbit replaced by an FMU and
nothing else changed. The FMU is exported by terrafix, or by CasADi's own exporter.

    python examples/orbit_as_fmu.py [--exporter terrafix|casadi] [--plot distance.png]
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import zipfile
from pathlib import Path

import casadi as ca
import fmpy
import numpy as np

import terrafix as tf
from terrafix.models.geometry import earth, frames
from terrafix.models.motion import gravity

EARTH = earth.EARTH
SYSTEM = Path(__file__).with_name("spacecraft_sar_open_loop.toml")
DURATION = "120"


def terrafix_orbit(system: tf.System, folder: Path) -> tf.Component:
    """Export the system's own orbit; co-simulation, bit for bit the native component."""
    file = folder / "orbit.fmu"
    tf.export_fmu(system, file, component="orbit")
    return tf.components.fmu(file=file, rate=system.find("orbit").rate)


def casadi_orbit(system: tf.System, folder: Path) -> tf.Component:
    """Have CasADi export the same equations: model exchange, integrated here by CVode."""
    dae = ca.DaeBuilder("orbit")
    t = dae.add("time", "independent", {})

    def vector(name: str, *kind: str) -> list[ca.MX]:
        return [dae.add(f"{name}[{k + 1}]", *kind, {}) for k in range(3)]

    r, v, p = vector("r_i"), vector("v_i"), ca.SX.sym("p", 3)
    a_p = gravity.j2_acceleration(p, EARTH.mu, EARTH.radius, EARTH.j2)
    acceleration = ca.vertsplit(ca.Function("gravity", [p], [a_p])(ca.vertcat(*r)))
    for state, rate in zip([*r, *v], [*v, *acceleration], strict=True):
        dae.eq(dae.der(state), rate)
    arguments = [ca.SX.sym("r", 3), ca.SX.sym("v", 3), ca.SX.sym("t")]
    angle = EARTH.rotation_rate * arguments[2]
    turn = ca.Function(
        "turn",
        arguments,
        frames.earth_fixed_from_inertial(*arguments[:2], angle, EARTH.rotation_rate),
    )
    r_e, v_e = (ca.vertsplit(each) for each in turn(ca.vertcat(*r), ca.vertcat(*v), t))
    for name, values in (("r_e", r_e), ("v_e", v_e), ("delta_v_e", [ca.MX(0.0)] * 3)):
        for output, value in zip(vector(name, "output"), values, strict=True):
            dae.eq(output, value)
    orbit = system.find("orbit")
    starts = {"r_i": orbit.setting("r0_i"), "v_i": orbit.setting("v0_i")}
    for name, values in starts.items():
        for k, value in enumerate(values):
            dae.set_start(f"{name}[{k + 1}]", float(value))
    with contextlib.chdir(folder):
        files = dae.export_fmu({"no_warning": True})
        headers = str(Path(fmpy.__file__).parent / "c-code")
        files = dae.compile_fmu(files, {"include_dirs": [headers]})
        with zipfile.ZipFile("orbit.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
            for here, inside in files.items():
                archive.write(here, inside)
    ports = ("r_e", "v_e", "delta_v_e")
    return tf.components.fmu(
        file=folder / "orbit.fmu",
        rate=orbit.rate,
        units={"r_e": "m", "v_e": "m/s", "delta_v_e": "m/s"},
        frames=dict.fromkeys(ports, "e"),
    )


EXPORTERS = {"terrafix": terrafix_orbit, "casadi": casadi_orbit}


def main(arguments: list[str] | None = None) -> float:
    """Fly both and return the largest distance between the two true positions [m]."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exporter", choices=EXPORTERS, default="terrafix")
    parser.add_argument("--plot", metavar="FILE.png")
    options = parser.parse_args(arguments)
    native = tf.simulate(tf.read_system(SYSTEM), members=1, duration=DURATION).dataset
    with tempfile.TemporaryDirectory() as folder:
        system = tf.read_system(SYSTEM)
        system.replace("orbit", EXPORTERS[options.exporter](system, Path(folder)))
        flown = tf.simulate(system, members=1, duration=DURATION).dataset
    apart = np.linalg.norm(flown["orbit.r_e"].values - native["orbit.r_e"].values, axis=-1)
    fix = flown["correct.innovation.accepted"].values
    print(f"{options.exporter}: the orbits are up to {apart.max():.3g} m apart over {DURATION} s")
    print(f"{int(np.nansum(fix))} fixes accepted")
    if options.plot:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7, 3))
        axes = figure.add_subplot(xlabel="time [s]", ylabel="distance [m]")
        axes.plot(native["orbit.r_e"][native["orbit.r_e"].dims[1]], apart[0])
        figure.savefig(options.plot)
    return float(apart.max())


if __name__ == "__main__":
    main()
