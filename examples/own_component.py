"""How do I write a component of my own, look at it alone, and fly it beside the others?

A radar altimeter: declared ports and parameters, noise from `normals`, and one step. It is driven
alone first, as a test would, then wired to the orbit of the library like any other component.
"""

import argparse

import terrafix as tf
from terrafix.models.geometry.geodesy import geodetic_from_ecef_array


class Altimeter(tf.Component):
    """Height above the ellipsoid with white noise."""

    default_rate = tf.Rate(hz=1)

    sigma = tf.Parameter(10.0, unit="m", minimum=0.0, doc="white noise per sample")
    r_e = tf.Input((3,), unit="m", frame="e", doc="true position")
    height = tf.Output(unit="m", doc="measured height above the ellipsoid")

    def _initialize_impl(self) -> None:
        self._measure()

    def _step_impl(self, t: float, dt: float) -> None:
        self._measure()

    def _measure(self) -> None:
        _, _, height = geodetic_from_ecef_array(self.r_e)
        self.height = height + self.sigma * self.normals("noise", 1)[:, 0]


def alone() -> float:
    """Drive the altimeter over the equator: its mean error, some 25 m / sqrt(2,020) [m]."""
    altimeter = Altimeter(sigma="25 m")
    driven = tf.testing.drive(altimeter, {"r_e": [7_070e3, 0.0, 0.0]}, steps=100, members=20)
    return float(driven["height"].mean() - (7_070e3 - 6_378_137.0))


def main(*, members: int = 50, plot: str | None = None) -> tf.Result:
    """Fly the altimeter for ten minutes; print the spread of its last reading."""
    with tf.System("altimeter", duration="600") as system:
        orbit = system.add(
            tf.components.orbit(
                r0_i="[7070, 0, 0] km", v0_i="[0, 0, 7.51] km/s", rate=tf.Rate(hz=10)
            ),
            "orbit",
        )
        altimeter = system.add(Altimeter(sigma="25 m"), "altimeter")
        system.connect(orbit["r_e"], altimeter["r_e"])
        system.record("height", [altimeter["height"]])

    result = tf.simulate(system, members=members, seed=1)
    last = result.dataset["altimeter.height"][-1]
    mean, spread = float(last.mean()) / 1e3, float(last.std(ddof=1))
    print(f"height {mean:.3f} km, spread of readings {spread:.1f} m; alone {alone():+.2f} m")
    if plot is not None:
        result.plot(plot)
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", help="picture of the heights (.png, .svg)")
    main(plot=parser.parse_args().plot)
