"""What does the camera see of the lake, what did two filters expect, and how near do they come?

An extended filter that iterates and an unscented one fly side by side over the lake, on the same
draws; cameras at the places of their estimates show what was expected of the first frame.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import terrafix as tf

SYSTEM = Path(__file__).parent / "leo_lake.toml"
STATE = {
    "r": tf.Field((3,), "m", "i", labels=("x", "y", "z")),
    "v": tf.Field((3,), "m/s", "i", labels=("x", "y", "z")),
    "age": tf.Field((1,), "s"),
    "P": tf.Field((6, 6)),
}
FILTERS = {"": ("extended, iterated", "#0072B2", "-"), "ukf_": ("unscented", "#D55E00", "--")}
VIEWS = {"before": "predict.prior", "after": "correct.estimate"}
WIDTH, HEIGHT, PIXEL_KM = 320, 256, 0.301


class Place(tf.Component):
    """Position and velocity of an estimate, each on a port of its own."""

    default_rate = tf.Rate("0.1")

    estimate = tf.BundleInput(STATE, doc="of a filter")
    r_i = tf.Output((3,), unit="m", frame="i", doc="position")
    v_i = tf.Output((3,), unit="m/s", frame="i", doc="velocity")

    def _initialize_impl(self) -> None:
        self._tell()

    def _step_impl(self, t: float, dt: float) -> None:
        self._tell()

    def _tell(self) -> None:
        self.r_i, self.v_i = self.estimate.r, self.estimate.v


def two_filters(case: str) -> tf.System:
    """The system of the example at 10 Hz, with a second filter and two more cameras."""
    parts = ("predict", "correct", "evaluation")
    rates = [(f"{name}.period", "0.1 s") for name in ("orbit", "camera", "moments", *parts)]
    system = tf.read_system(SYSTEM, [("case", case), *rates])
    rate, make = tf.Rate("0.1"), tf.components
    camera = {"focal": "1828.81 px", "earth_angle0": "30 deg"}
    system.add(make.orbit_predict(rate=rate), "ukf_predict")
    system.add(make.lake_correct(rate=rate, update="unscented", **camera), "ukf_correct")
    system.add(make.orbit_evaluation(rate=rate), "ukf_evaluation")
    wires = [(wire.source, wire.target) for wire in system.connections]
    for source, target in wires:  # every wire of the first filter's, of the second's
        ends = [f"ukf_{end}" if end.split(".")[0] in parts else end for end in (source, target)]
        if ends[1] != target:
            system.connect(*ends)
    catalog = [f"lakes.{name}" for name in ("vertices", "starts", "center", "radius")]
    for view, estimate in VIEWS.items():
        system.add(Place(), f"place_{view}")
        kind = make.lake_camera(rate=rate, vertex_sigma="0 px", clipping="none", **camera)
        system.add(kind, view)
        system.connect(estimate, f"place_{view}.estimate")
        for source in (f"place_{view}.r_i", f"place_{view}.v_i", *catalog):
            system.connect(source, f"{view}.{source.split('.')[1]}")
    seen = [system.find(name)["contour"] for name in ("camera", *VIEWS)]
    system.record("contours", seen, period="0.1")
    return system


def outline(data, name: str, frame: int) -> np.ndarray:
    """Vertices (K, 2) of the first member's contour in a frame [px], closed."""
    vertices = data[f"{name}.contour"].values[frame, 0]
    vertices = vertices[np.isfinite(vertices).all(axis=1)]
    return np.concatenate([vertices, vertices[:1]])


def draw_frame(axes, data) -> None:
    """The first frame: what is seen, and what was expected before and after it."""
    seen, before, after = (outline(data, name, 1) for name in ("camera", *VIEWS))
    axes.fill(*seen.T, color="#56B4E9", lw=0, label="seen")
    axes.plot(*before.T, color="#D55E00", lw=1.5, ls=(0, (3, 1.2)), label="expected before")
    axes.plot(*after.T, color="black", lw=1.0, label="expected after")
    axes.set(xlim=(-0.5, WIDTH - 0.5), ylim=(HEIGHT - 0.5, -0.5), aspect="equal")
    axes.set(xlabel="u [px]", ylabel="v [px]", title="Seneca Lake in the first frame")
    axes.plot([20, 20 + 20 / PIXEL_KM], [HEIGHT - 16] * 2, color="black", lw=2.5)
    axes.text(20 + 10 / PIXEL_KM, HEIGHT - 21, "20 km", ha="center", va="bottom")
    axes.annotate("flight", (302, 205), (302, 240), ha="center", arrowprops={"arrowstyle": "->"})
    axes.legend(loc="upper left", frameon=False)

    middle = seen[np.argmin(seen[:, 1])]  # the end of the lake that is ahead
    zoom = axes.inset_axes((0.37, 0.06, 0.44, 0.48))
    zoom.fill(*seen.T, color="#56B4E9", lw=0)
    zoom.plot(*seen.T, ".", color="#0072B2", ms=4)
    zoom.plot(*after.T, color="black", lw=1.0)
    zoom.set(xlim=middle[0] + np.array([-9, 9]), ylim=middle[1] + np.array([16, -3]))
    zoom.set(xticks=[], yticks=[], aspect="equal")
    axes.indicate_inset_zoom(zoom, edgecolor="0.4")


def draw_errors(axes, data) -> None:
    """Errors of the position of all members, the first one's in bold, and three sigma."""
    for name, (label, color, style) in FILTERS.items():
        error = np.linalg.norm(data[f"{name}evaluation.position_error"].values, axis=2) / 1e3
        sigma = np.linalg.norm(data[f"{name}evaluation.position_sigma"].values, axis=2) / 1e3
        time = data["time"].values
        axes.plot(time, error[:, 1:], color=color, lw=0.5, alpha=0.2)
        axes.plot(time, error[:, 0], color=color, lw=2.0, ls=style, label=f"{label}: error")
        axes.plot(
            time, 3 * sigma[:, 0], color=color, lw=2.5, ls=style, alpha=0.5, label="three sigma"
        )
    axes.set(yscale="log", xlabel="time [s]", ylabel="position error [km]", xlim=(0, time[-1]))
    axes.set(title=f"The first of {error.shape[1]} members, the others faint", ylim=(3e-3, 200))
    axes.grid(which="major", color="0.9")
    axes.legend(frameon=False, ncols=2, loc="upper right")


def main(*, members: int = 20, case: str = "T2", out: str | None = None) -> tf.Result:
    """Fly, and draw the first member's first frame and the errors of both filters."""
    result = tf.simulate(two_filters(case), members=members)
    print(result)
    if out is not None:
        figure, (frame, errors) = plt.subplots(
            1, 2, figsize=(12, 4.9), width_ratios=(1.2, 1), layout="constrained"
        )
        draw_frame(frame, result.dataset)
        draw_errors(errors, result.dataset)
        figure.savefig(out, dpi=120)
        plt.close(figure)
        print(f"wrote {out}")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", help="write the picture there (.png)")
    parser.add_argument("--members", type=int, default=20)
    given = parser.parse_args()
    main(members=given.members, out=given.out)
