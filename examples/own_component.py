"""How do I write a component of my own and fly it beside the others?

A radar altimeter: declared ports and parameters, noise from `normals`, and one step. It is wired
to the orbit of the library like any other component.
"""

import argparse

import numpy as np

from terrafix.components.truth.orbit import OrbitTruth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.run import Result, simulate
from terrafix.cosim.system.system import System
from terrafix.models.geometry.geodesy import geodetic_from_ecef_array


class Altimeter(Component):
    """Height above the ellipsoid with white noise."""

    default_rate = Rate(hz=1)

    sigma = Parameter(10.0, unit="m", minimum=0.0, doc="white noise per sample")
    r_e = Input((3,), unit="m", frame="e", doc="true position")
    height = Output(unit="m", doc="measured height above the ellipsoid")

    def _initialize_impl(self) -> None:
        self._measure()

    def _step_impl(self, t: float, dt: float) -> None:
        self._measure()

    def _measure(self) -> None:
        _, _, height = geodetic_from_ecef_array(self.r_e)
        self.height = height + self.sigma * self.normals("noise", 1)[:, 0]


def main(*, members: int = 50, plot: str | None = None) -> Result:
    """Fly the altimeter for ten minutes; print the spread of its last reading."""
    with System("altimeter", duration="600") as system:
        orbit = system.add(
            OrbitTruth(r0_i="[7070, 0, 0] km", v0_i="[0, 0, 7.51] km/s", rate=Rate(hz=10)), "orbit"
        )
        altimeter = system.add(Altimeter(sigma="25 m"), "altimeter")
        system.connect(orbit["r_e"], altimeter["r_e"])
        system.record("height", [altimeter["height"]])

    result = simulate(system, members=members, seed=1)
    last = result.dataset["altimeter.height"][-1].to_numpy()
    print(f"height {np.mean(last) / 1e3:.3f} km, spread of readings {np.std(last, ddof=1):.1f} m")
    if plot is not None:
        from terrafix.cosim.show.plots import plot_result

        plot_result(result.dataset, plot)
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", help="picture of the heights (.png, .svg)")
    main(plot=parser.parse_args().plot)
