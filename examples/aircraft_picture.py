"""What does an aircraft's radar see, where is it recognized, and what does that do for navigation?

The first aperture of a flight whose navigator is off by more than it need be, so that it shows:
the image as its estimate forms it, the same focused by map drift, and both places of it on the
reference of an earlier flight, expected and found. Then the errors of that flight, with and
without radar.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Polygon

import terrafix as tf
from terrafix.components.fields import APERTURE_IMAGE, GRID, HEIGHT, PLACES, TIES
from terrafix.components.images.aperture_matcher import pixel_grid
from terrafix.components.images.reference import reference_from
from terrafix.models.geometry.ground import FlatGround
from terrafix.models.maps.dem import dem_from

SYSTEM = Path(__file__).parent / "aircraft_sar.toml"
LOST = [
    ("last_known.position_sigma", "[10, 5, 5] m"),
    ("last_known.velocity_sigma", "[1.5, 0.3, 0.3] m/s"),
    ("seed", "12"),
]
"""What is known at the start: less than in the example, so that it shows in the first image."""
AXES = ("north", "east", "down")
FOUND, EXPECTED = "#009E73", "#D55E00"


class Page(tf.Component):
    """Keeps the first image of the first member, and what it was matched to."""

    default_rate = tf.Rate("1", offset="1")

    images = tf.SharedInput((None, None, None), dtype=np.float32, doc="amplitudes")
    unfocused = tf.SharedInput((None, None), dtype=np.float32, doc="before map drift")
    image = tf.MessageInput(fields=APERTURE_IMAGE, doc="where it lies")
    offset = tf.Input((3,), unit="m", frame="e", doc="of the track, as the image has it")
    amplitude = tf.SharedInput((None, None), dtype=np.float32, doc="of the reference")
    tie_rows = tf.SharedInput(**TIES, doc="of the reference")
    tie_columns = tf.SharedInput(**TIES, doc="of the reference")
    places = tf.SharedInput(**PLACES, doc="of the reference")
    height = tf.SharedInput(**HEIGHT, doc="of the terrain")
    grid = tf.SharedInput(**GRID, doc="of the terrain")

    seen = None

    def _step_impl(self, t: float, dt: float) -> None:
        if self.seen is None and self.image.fresh[0]:
            ports = (self.amplitude, self.tie_rows, self.tie_columns, self.places)
            self.seen = {
                "pixels": pixel_grid(self.image, 0, FlatGround()),
                "focused": np.array(self.images[int(self.image.index[0])]),
                "unfocused": np.array(self.unfocused),
                "reference": reference_from(*map(np.array, ports)),
                "offset": np.array(self.offset[0]),
                "drift": float(self.image.drift[0]),
                "dem": dem_from(np.array(self.height), np.array(self.grid)),
            }


def with_page(settings) -> tf.System:
    """The system of the example, and a page of its first image."""
    shown = ("former.show_unfocused", "true")
    system = tf.read_system(SYSTEM, [*LOST, shown, *settings])
    system.add(Page(), "page")
    for source in ("former.images", "former.unfocused", "former.image", "matcher.offset"):
        system.connect(source, f"page.{source.split('.')[1]}")
    for name in ("amplitude", "tie_rows", "tie_columns", "places"):
        system.connect(f"reference.{name}", f"page.{name}")
    for name in ("height", "grid"):
        system.connect(f"map.{name}", f"page.{name}")
    return system


def outline(seen, offset) -> np.ndarray:
    """Corners (4, 2) of the image on the reference: columns and rows."""
    rows, columns = seen["focused"].shape
    row, column = np.array([0, 0, rows - 1, rows - 1]), np.array([0, columns - 1, columns - 1, 0])
    pixels = seen["pixels"]
    p = pixels.places(row, column, seen["dem"].at, offset)
    latitude, longitude, _ = pixels.ground.geodetic(p)
    i, j, _ = seen["reference"].pixel(latitude, longitude)
    return np.stack([j, i], axis=1)


def show(panel, amplitude, like=None) -> None:
    """An image in decibels, up along the track, range to the right."""
    db = 20 * np.log10(np.maximum(amplitude, 1e-6 * amplitude.max()))
    scale = db if like is None else 20 * np.log10(np.maximum(like, 1e-6 * like.max()))
    low, high = np.percentile(scale, [5, 99.8])
    panel.imshow(db, cmap="gray", vmin=low, vmax=high, origin="lower", aspect="auto")
    panel.set(xticks=[], yticks=[])


def about(image, part: int = 3) -> tuple[slice, slice]:
    """A part of rows and columns about the brightest pixel, where blur is seen."""
    found = np.unravel_index(int(np.argmax(image)), image.shape)
    sizes = [n // part for n in image.shape]
    starts = [
        int(np.clip(m - s // 2, 0, n - s))
        for m, s, n in zip(found, sizes, image.shape, strict=True)
    ]
    return tuple(slice(a, a + s) for a, s in zip(starts, sizes, strict=True))


def draw_images(panels, seen) -> None:
    """Reference with both places of the image; a detail of it blurred and focused."""
    show(panels[0], seen["reference"].amplitude)
    for offset, color, style, label in (
        (np.zeros(3), EXPECTED, "--", "where the estimate expects the image"),
        (seen["offset"], FOUND, "-", "where it is"),
    ):
        corners = outline(seen, offset)
        panels[0].add_patch(Polygon(corners, fill=False, ec=color, ls=style, lw=1.8, label=label))
    panels[0].legend(loc="upper left", fontsize=8)
    away = np.linalg.norm(seen["offset"])
    panels[0].set_title(f"On the image of an earlier flight: {away:.1f} m off", fontsize=10)
    panels[0].set(ylabel="along the track", xlabel="range")
    detail = about(seen["focused"])
    show(panels[1], seen["unfocused"][detail], seen["focused"])
    panels[1].set_title("A detail of the image, as the estimate forms it", fontsize=10)
    show(panels[2], seen["focused"][detail], seen["focused"])
    panels[2].set_title(f"the same, focused by map drift: {seen['drift']:+.2f} m/s", fontsize=10)


def draw_errors(panels, flown) -> None:
    """Errors of position and three sigma, with and without radar."""
    for k, (panel, axis) in enumerate(zip(panels, AXES, strict=True)):
        for label, color, data in flown:
            t = data["time"].values
            error = data["evaluation.position_error"].values[:, 0, k]
            sigma = data["evaluation.position_sigma"].values[:, 0, k]
            panel.fill_between(t, -3 * sigma, 3 * sigma, color=color, alpha=0.2, lw=0)
            panel.plot(t, error, color=color, label=label)
        panel.set_yscale("symlog", linthresh=1.0)
        panel.set_ylim(-100, 100)
        panel.set(title=f"position {axis} [m]", xlabel="time [s]", xlim=(0, t[-1]))
        panel.set_yticks([-100, -10, -1, 0, 1, 10, 100])
        panel.grid(color="0.9")
    panels[0].legend(frameon=False, fontsize=8, loc="upper left")


def main(*, duration: float = 30.0, out: str | None = None, settings=()) -> tf.Result:
    """Fly with and without radar, and draw."""
    system = with_page(settings)
    result = tf.simulate(system, members=1, duration=str(duration))
    print(result)
    if out is not None:
        blind = tf.read_system(SYSTEM, [*LOST, *settings, ("radar.on", "false")])
        without = tf.simulate(blind, members=1, duration=str(duration)).dataset
        figure, panels = plt.subplots(
            2, 3, figsize=(12.5, 7.2), height_ratios=(1.35, 1), layout="constrained"
        )
        draw_images(panels[0], system.find("page").seen)
        flown = [
            ("without radar, 3 sigma", EXPECTED, without),
            ("with radar images, 3 sigma", FOUND, result.dataset),
        ]
        draw_errors(panels[1], flown)
        figure.savefig(out, dpi=110)
        plt.close(figure)
        print(f"wrote {out}")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", help="write the picture there (.png)")
    parser.add_argument("--duration", type=float, default=30.0, help="of the flight [s]")
    given = parser.parse_args()
    main(duration=given.duration, out=given.out)
