"""What contours of whole pixels do to a satellite that knows itself by a lake.

    python benchmarks/integer_contours.py [--members 50]

OpenCV's contours are whole pixels. Here vertices are rounded in what is measured, which the filter
is told as noise of 1 / sqrt(12) px; and in what is predicted, too, with a derivative by forward
differences of 0.1 km and 0.1 km/s, as the paper has them. Ten frames a second; error of the
position after seven seconds. Needs the outline of Seneca Lake (TERRAFIX_DATA).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import terrafix as tf
from terrafix.components.filters.lake import LakeCorrect
from terrafix.components.sensors.camera import LakeCamera
from terrafix.models.filters.ensembles import EnsembleObservation
from terrafix.models.filters.error_state import vector
from terrafix.models.filters.lake import CATALOG, MOMENTS, ORBIT
from terrafix.models.images.polygons import moments
from terrafix.models.sensors.camera import CAMERA, Seen

EXAMPLES = Path(__file__).parents[1] / "examples"
ROUNDING = f"{12**-0.5!r} px"
STEPS = {"r": 100.0, "v": 100.0}  # [m], [m/s]


class IntegerCamera(LakeCamera):
    """A camera whose vertices are whole pixels, and have no other noise."""

    def normals(self, stream: str, n: int) -> Any:
        draws = super().normals(stream, n)
        return 0.0 * draws if stream == "vertices" else draws

    def _outline(self, lake: int, rows: Any, t: float) -> Any:
        pixels, inside = super()._outline(lake, rows, t)
        return np.rint(pixels), inside


def predict(values: Any, given: Any) -> Any:
    """Moments of the predicted outline in whole pixels, of the one lake there is."""
    return moments(np.rint(Seen(values, given, given["vertices"], given["center"][0]).pixels))[0]


def derivative(values: Any, given: Any) -> Any:
    """By forward differences."""
    here, columns = predict(values, given), []
    for name, step in STEPS.items():
        for i in range(3):
            moved = {n: np.array(v) for n, v in values.items()}
            moved[name][:, i] += step
            columns.append((predict(moved, given) - here) / step)
    return np.stack(columns, axis=2)


class IntegerCorrect(LakeCorrect):
    """A filter that predicts whole pixels."""

    error_state = ORBIT
    observation = EnsembleObservation(
        predict,
        MOMENTS,
        derivative=derivative,
        fields=[vector("lake", 1)],
        parameters=CAMERA,
        shared=CATALOG,
    )


def whole_pixels(
    file: str, case: str, filters: Sequence[str] = ("",), *, both: bool, settings: Any = ()
) -> tf.System:
    """A system whose camera, or camera and filters, know whole pixels alone; at 10 Hz."""
    parts = [f"{f}{p}" for f in filters for p in ("predict", "correct", "evaluation")]
    rates = [(f"{n}.period", "0.1 s") for n in ("orbit", "camera", "moments", *parts)]
    system = tf.read_system(EXAMPLES / file, [("case", case), *rates, *settings])
    kinds = [("camera", IntegerCamera)]
    kinds += [(f"{f}correct", IntegerCorrect) for f in filters] if both else []
    for name, kind in kinds:
        old = system.find(name)
        own = {n: old.setting(n) for n in old.settings() if not old.is_default(n)}
        system.replace(name, kind(rate=old.rate, **own))
    if file == "leo_lake.toml":
        system.find("camera").vertex_sigma = ROUNDING
    return system


def report(what: str, system: tf.System, members: int, names: Sequence[str]) -> None:
    """Fly it, and print a line for each filter."""
    result = tf.simulate(system, members=members)
    for name in names:
        error = np.linalg.norm(result.dataset[f"{name}.position_error"].values[-1], axis=1) / 1e3
        nees = np.nanmean(result.dataset[f"{name}.nees"].values[-1])
        lost = int((~np.isfinite(error)).sum())
        print(
            f"{what:42s} {name:15s} median {np.nanmedian(error):9.3f}"
            f"  90 % {np.nanpercentile(error, 90):9.3f} km  NEES {nees:8.3g}  lost {lost}"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--members", type=int, default=50)
    members = parser.parse_args().members
    for case in ("T1", "T2", "T3"):
        for both in (False, True):
            what = f"leo_lake, {case}, {'both sides' if both else 'measured'}"
            system = whole_pixels("leo_lake.toml", case, both=both)
            report(what, system, members, ["evaluation"])
    for case in ("T1", "T2", "T3"):
        filters = ("ekf_", "ukf_")
        system = whole_pixels("leo_lake_printed.toml", case, filters, both=True)
        names = [f"{f}evaluation" for f in filters]
        report(f"leo_lake_printed, {case}, both sides", system, members, names)


if __name__ == "__main__":
    main()
