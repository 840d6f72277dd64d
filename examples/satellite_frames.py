"""Where is a satellite of which two-line elements are known, and what if their frame is mistaken?

Vanguard 1, six hours after its elements, by SGP4. Its state is in the frame TEME; the same numbers
taken for those of another frame are another place. Needs ``pip install 'terrafix[truth]'``.
"""

import argparse

import numpy as np

import terrafix as tf
from terrafix.models.geometry.geodesy import geodetic_from_ecef_array

EPOCH = "2000-06-28T00:50:19.733568 UTC"
ELEMENTS = """
1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753
2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667
"""
TEME = {
    "r0": "[-7154.03120202, -3783.17682504, -3536.19412294] km",
    "v0": "[4.741887409, -4.151817765, -2.093935425] km/s",
}


class Look(tf.Component):
    """Keeps where the satellite was said to be."""

    default_rate = tf.Rate(times=["0"])
    start = tf.MessageInput(fields=tf.components.orbit_start.start.fields, doc="its state")

    def _initialize_impl(self) -> None:
        self.r_e = self.start.r_e[0].copy()


def place(**known: str) -> np.ndarray:
    """Earth-fixed position (3,) [m] of a satellite of which something is known."""
    with tf.System("satellite", epoch=EPOCH, duration="1") as system:
        start = system.add(tf.components.orbit_start(**known), "start")
        look = system.add(Look(), "look")
        system.connect(start["start"], look["start"])
    tf.simulate(system)
    return look.r_e


def main() -> None:
    """Print where it is, and how far from there it is in other frames."""
    true = place(kind="tle", tle=ELEMENTS)
    latitude, longitude, height = (float(x) for x in geodetic_from_ecef_array(true))
    print(
        f"latitude {np.degrees(latitude):.4f} deg, longitude {np.degrees(longitude):.4f} deg, "
        f"height {height / 1e3:.3f} km at {EPOCH}"
    )
    for frame in ("teme", "tod", "j2000", "gcrf", "itrf"):
        off = np.linalg.norm(place(frame=frame, **TEME) - true)
        print(f"its state taken for {frame:5}: {off / 1e3:10.5f} km off")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
