"""A picture of the closed loop: what was seen, where it was recognized, and what came of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from terrafix.components.fields import AMPLITUDE, IMAGE, XYZ
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Count, OptionalFilePath
from terrafix.cosim.declare.ports import Input, MessageInput, SharedInput

_FIGURES = (".png", ".svg", ".pdf")
_SHOWN = 900
"""Rows and columns of a reference that are drawn, about."""


class ImageAlbum(Component):
    """Draws the first image before and after autofocus, its match, and the errors of a member.

    The first member's. Nothing is drawn unless `picture` names a file; it is written at the end.
    """

    default_rate = Rate("0.2")

    picture = OptionalFilePath(doc="file to draw to (.png, .svg or .pdf); none if not set")

    detail = Count(4, minimum=1, doc="part of its rows and columns in which blur is shown; 1: all")

    images = SharedInput((None, None, None), dtype=np.float32, doc="amplitudes of the images")
    unfocused = SharedInput((None, None), dtype=np.float32, doc="the first one before autofocus")
    image = MessageInput(fields=IMAGE, doc="which image is a member's, and what it measures")
    amplitude = SharedInput(**AMPLITUDE, doc="of the reference")
    inliers = SharedInput(
        (None, 4), doc="middles of its parts that agree, on it and on the reference"
    )
    outline = SharedInput((4, 2), doc="corners of the first image on the reference")
    position_error = Input((3,), unit="m", frame="e", doc="estimate minus truth")
    position_sigma = Input((3,), unit="m", frame="e", doc="predicted")
    velocity_error = Input((3,), unit="m/s", frame="e", doc="estimate minus truth")
    velocity_sigma = Input((3,), unit="m/s", frame="e", doc="predicted")

    def validate(self) -> None:
        """Look at the name of the file."""
        path: Path | None = self.setting("picture")
        if path is None:
            return
        if path.suffix.lower() not in _FIGURES:
            raise ConfigurationError(
                f"'{self.name}.picture' is '{path}'; it takes a file that ends in "
                f"{', '.join(_FIGURES)}"
            )
        if not path.parent.is_dir():
            raise ConfigurationError(
                f"'{self.name}.picture' is '{path}', but there is no folder '{path.parent}'"
            )

    def _initialize_impl(self) -> None:
        self._history: list[FloatArray] = []
        self._page: dict[str, Any] = {}
        self._note(0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self._note(t)
        if not self._page and self.image.fresh[0]:
            reference = np.asarray(self.amplitude)
            step = max(1, max(reference.shape) // _SHOWN)
            self._page = {
                "t": t,
                "focused": np.array(self.images[int(self.image.index[0])]),
                "unfocused": np.array(self.unfocused),
                "reference": np.array(reference[::step, ::step]),
                "step": step,
                "inliers": np.array(self.inliers),
                "outline": np.array(self.outline),
            }

    def _note(self, t: float) -> None:
        row = [self.position_error, self.position_sigma, self.velocity_error, self.velocity_sigma]
        self._history.append(np.concatenate([[t], *(np.array(a[0]) for a in row)]))

    def terminate(self) -> None:
        """Draw."""
        if self.picture is not None and self._page:
            self._draw(self.picture)

    def _draw(self, path: Path) -> None:
        import matplotlib.style
        from matplotlib.figure import Figure

        with matplotlib.style.context("default", after_reset=True):
            figure = Figure(figsize=(12.5, 11.0), layout="constrained")
            grid = figure.subplots(3, 3, height_ratios=[1.5, 1, 1])
            self._draw_images(grid[0])
            history = np.array(self._history)
            for row, (what, unit, first) in enumerate(
                (("position", "m", 1), ("velocity", "m/s", 7))
            ):
                for axis in range(3):
                    panel = grid[row + 1, axis]
                    error, sigma = history[:, first + axis], history[:, first + 3 + axis]
                    panel.plot(history[:, 0], error, color="0.25", label="error")
                    for sign in (1, -1):
                        label = "predicted 3 sigma" if sign > 0 else None
                        panel.plot(history[:, 0], 3 * sign * sigma, color="#d62728", label=label)
                    # linear about zero, and logarithmic beyond what is reached at the end
                    reached = np.log10(max(3 * float(sigma[-1]), 1e-9))
                    panel.set_yscale("symlog", linthresh=10.0 ** np.floor(reached))
                    panel.set_title(f"{what} {XYZ[axis]} [{unit}]", fontsize=10)
                    panel.grid(alpha=0.3)
                    if row:
                        panel.set_xlabel("time [s]")
            grid[1, 0].legend(fontsize=8, loc="lower right")
            try:
                figure.savefig(path, dpi=110)
            except OSError as error:
                raise ConfigurationError(f"cannot write '{path}': {error.strerror}") from error

    def _draw_images(self, panels: Any) -> None:
        page = self._page
        titles = (
            f"{'a detail' if self.detail > 1 else 'the image'} at {page['t']:g} s, as estimated",
            "the same, autofocused",
            f"recognized on the reference: {len(page['inliers'])} parts agree",
        )
        detail = _about_the_brightest(page["focused"], self.detail)
        shown = (page["unfocused"][detail], page["focused"][detail], page["reference"])
        limits = np.percentile(_decibels(page["focused"]), [3, 99.7])
        for panel, image, title in zip(panels, shown, titles, strict=True):
            own = (
                limits
                if image is not page["reference"]
                else np.percentile(_decibels(image), [3, 99.7])
            )
            panel.imshow(
                _decibels(image),
                cmap="gray",
                vmin=own[0],
                vmax=own[1],
                aspect="auto",
                origin="lower",
            )
            panel.set_title(title, fontsize=10)
            panel.set_xlabel("range [pixels]")
        panels[0].set_ylabel("azimuth [pixels]")
        step, corners = page["step"], page["outline"]
        places = page["inliers"][:, 2:] / step
        panels[2].plot(places[:, 1], places[:, 0], ".", color="#2ca02c", markersize=4)
        if np.isfinite(corners).all():
            closed = np.vstack([corners, corners[:1]]) / step
            panels[2].plot(closed[:, 1], closed[:, 0], color="#d62728")
        if step > 1:
            panels[2].set_xlabel(f"range [{step} pixels]")

    def _extra_state(self) -> dict[str, Any]:
        page = {f"page.{k}": v for k, v in self._page.items()}
        return {"history": np.array(self._history), **page}

    def _set_extra_state(self, saved: dict[str, Any]) -> None:
        self._history = list(np.asarray(saved["history"]))
        self._page = {k.removeprefix("page."): v for k, v in saved.items() if k.startswith("page.")}


def _about_the_brightest(image: FloatArray, part: int) -> tuple[slice, slice]:
    """A part of the rows and columns, about the brightest pixel: there blur is seen."""
    found = np.unravel_index(int(np.argmax(image)), image.shape)
    slices = []
    for middle, n in zip(found, image.shape, strict=True):
        size = max(n // part, 1)
        start = int(np.clip(int(middle) - size // 2, 0, n - size))
        slices.append(slice(start, start + size))
    return slices[0], slices[1]


def _decibels(amplitude: FloatArray) -> FloatArray:
    return 20 * np.log10(np.maximum(amplitude, 1e-6 * max(float(np.max(amplitude)), 1e-30)))
