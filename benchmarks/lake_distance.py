"""The printed system with its fourth measurement, the mean distance of contours.

    python benchmarks/lake_distance.py [--members 20]

The paper measures, besides area and centroid of a lake in the frame, the mean distance of the
observed contour to the predicted one, and says that it is Gaussian about zero with a variance of
4 px^2. It is not: it has no sign and no derivative at the solution. Shown is what that does to an
extended and to an unscented filter, on the same draws (docs/lake.md).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import terrafix as tf
from terrafix.components.fields import CONTOUR, LOOK
from terrafix.components.filters.lake import LakeCorrect
from terrafix.components.judges.evaluation import OrbitEvaluation
from terrafix.cosim.memory.fields import Field
from terrafix.models.filters.ensembles import EnsembleObservation
from terrafix.models.filters.error_state import vector
from terrafix.models.filters.lake import CATALOG, ORBIT, outlines_seen, state_columns
from terrafix.models.images.polygons import distances, moments
from terrafix.models.sensors.camera import CAMERA

EXAMPLES = Path(__file__).parents[1] / "examples"
ELEMENTS = {"area": "px^2", "center_u": "px", "center_v": "px", "distance": "px"}
VARIANCE = (2500.0, 50.0, 50.0, 4.0)  # as printed
MOST = 256


def _both(values: Mapping[str, Any], given: Mapping[str, Any]) -> tuple[Any, Any]:
    k = len(values["r"])
    y, H = np.empty((k, 4)), np.empty((k, 4, 6))
    for rows, seen, _ in outlines_seen(values, given):
        m, J = moments(seen.pixels)
        n = seen.pixels.shape[1]
        by = np.zeros((len(rows), 4, n, 2))
        by[:, :3] = J[:, :3]
        y[rows, :3] = m[:, :3]
        for i, row in enumerate(rows):
            count = int(given["held"][row, 0])
            contour = given["contour"][row].reshape(MOST, 2)[:count]
            near = distances(contour, seen.pixels[i])
            y[row, 3] = near.distance.mean()
            away = (near.foot - contour) / np.maximum(near.distance, 1e-12)[:, None] / count
            np.add.at(by[i, 3], near.segment, (1 - near.parameter)[:, None] * away)
            np.add.at(by[i, 3], (near.segment + 1) % n, near.parameter[:, None] * away)
        H[rows] = seen.derivative(by)[..., state_columns(ORBIT)]
    return y, H


OBSERVATION = EnsembleObservation(
    lambda values, given: _both(values, given)[0],
    ELEMENTS,
    derivative=lambda values, given: _both(values, given)[1],
    fields=[vector("lake", 1), vector("held", 1), vector("contour", 2 * MOST)],
    parameters=CAMERA,
    shared=CATALOG,
)


class DistanceFix(tf.Component):
    """Area, centroid, and the contour; its mean distance is said to be zero."""

    default_rate = tf.Rate("1/30")

    contour = tf.MessageInput(**CONTOUR)
    look = tf.MessageInput(fields=LOOK)
    fix = tf.MessageOutput(
        fields={
            "y": Field((4,), tuple(ELEMENTS.values())),
            "lake": Field((1,)),
            "held": Field((1,)),
            "contour": Field((2 * MOST,)),
            "R": Field((4, 4)),
            "present": Field((4,)),
        }
    )

    def _step_impl(self, t: float, dt: float) -> None:
        n = self.n_members
        y, flat = np.zeros((n, 4)), np.zeros((n, MOST, 2))
        good = self.contour.fresh & self.look.fresh
        for m in np.flatnonzero(good):
            count = self.contour.count[m]
            flat[m, :count] = self.contour.value[m, :count]
            y[m, :3] = moments(flat[m, :count])[0][:3]
        self.fix.publish(
            self.look.t,
            valid=good,
            y=y,
            lake=self.look.lake[:, None],
            held=self.contour.count[:, None].astype(np.float64),
            contour=flat.reshape(n, -1),
            R=np.tile(np.diag(VARIANCE), (n, 1, 1)),
            present=np.ones((n, 4)),
        )


class DistanceCorrect(LakeCorrect):
    """Correction by area, centroid and distance."""

    error_state, observation = ORBIT, OBSERVATION


class DistanceEvaluation(OrbitEvaluation):
    """Evaluation of it."""

    error_state, observation = ORBIT, OBSERVATION


def system(case: str) -> Any:
    """The printed system with the fourth measurement."""
    text = (EXAMPLES / "leo_lake_printed.toml").read_text()
    own = Path(__file__).stem
    moment = text[text.index("[component.moments]") : text.index("[component.ekf_predict]")]
    text = text.replace(moment, f'[component.moments]\ntype = "{own}:DistanceFix"\n\n')
    text = text.replace('"lake_correct"', f'"{own}:DistanceCorrect"')
    text = text.replace('"orbit_evaluation"', f'"{own}:DistanceEvaluation"')
    file = Path(__file__).with_name("lake_distance.toml")
    file.write_text(text.replace("../../shared", str(EXAMPLES.parents[1] / "shared")))
    try:
        return tf.read_system(file, [("case", case)])
    finally:
        file.unlink()


def main() -> None:
    """Print a line for each case and filter."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--members", type=int, default=20)
    options = parser.parse_args()
    for case in ("T1", "T2", "T3"):
        data = tf.simulate(system(case), members=options.members).dataset
        for name in ("ekf_evaluation", "ukf_evaluation"):
            error = np.linalg.norm(data[f"{name}.position_error"].values[-1], axis=1) / 1e3
            nees = data[f"{name}.nees"].values[-1]
            print(
                f"{case}  {name:15} median {np.nanmedian(error):7.3f}  90 % "
                f"{np.nanpercentile(error, 90):7.3f}  largest {np.nanmax(error):7.3f} km  "
                f"NEES, median {np.nanmedian(nees):8.3g}, mean {np.nanmean(nees):8.3g}"
            )


if __name__ == "__main__":
    main()
