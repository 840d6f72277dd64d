"""How far off is a target that a satellite tracks in its images, and without them?

The printed system of geolocation, half a minute of it: without images, with frames that are matched
to the first one, and with the first one matched to a map besides. Prints the errors at the end;
draws the first frame on the map, and the errors in time.
"""

import argparse
from pathlib import Path

import numpy as np

import terrafix as tf

SYSTEM = Path(__file__).parent / "geolocation_printed.toml"
PROFILES = ("non_updated", "image_matched", "image_corrected")


def main(
    *,
    members: int = 4,
    duration: str = "30",
    plot: str | None = None,
    system: Path = SYSTEM,
    orbit: str = "LEO",
) -> tf.Result:
    """Fly the three profiles; print the root mean square of the target's error of each."""
    flown = tf.read_system(system, [("orbit", orbit)])
    flown.record("frames", ["camera.first", "matcher.located"], period=duration)
    result = tf.simulate(flown, members=members, duration=duration)
    errors = {name: rms(result.dataset[f"{name}.target_error"].values) for name in PROFILES}
    for name, error in errors.items():
        print(f"{name}: {error[-1]:.3f} px after {duration} s")
    if plot is not None:
        draw(result, errors, plot)
    return result


def rms(error: np.ndarray) -> np.ndarray:
    """Root mean square over members of the length of an error (epochs, members, 2)."""
    return np.asarray(np.sqrt((error**2).sum(axis=-1).mean(axis=-1)))


def draw(result: tf.Result, errors: dict[str, np.ndarray], plot: str) -> None:
    """The first frame of the first member, its place as believed and as found, and all errors."""
    from matplotlib.figure import Figure

    data = result.dataset
    frame = data["camera.first"].values[0, 0]
    found = data["matcher.located.y"].values[0, 0]
    middle = (frame.shape[0] - 1) / 2
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    image, axes = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
    image.imshow(frame, cmap="gray")
    image.plot(middle, middle, "+", color="tab:orange", ms=14, label="where it is believed")
    image.plot(
        middle + found[1],
        middle - found[0],
        "x",
        color="tab:green",
        ms=10,
        label="found by the map",
    )
    image.set(title="the first frame, and the target in it", xticks=[], yticks=[])
    image.legend(loc="lower left", fontsize="small")
    for name, error in errors.items():
        axes.semilogy(np.arange(len(error)) / 60.0, error, label=name)  # of every second
    axes.set(xlabel="time [min]", ylabel="error of the target, rms [px]")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    figure.savefig(plot, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", help="picture of the first frame and the errors (.png, .svg)")
    parser.add_argument("--members", type=int, default=4)
    parser.add_argument("--duration", default="30", help="[s]")
    parser.add_argument("--orbit", default="LEO")
    parser.add_argument("--system", type=Path, default=SYSTEM, help="another with the profiles")
    main(**vars(parser.parse_args()))
