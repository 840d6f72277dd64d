"""How well a satellite knows itself by a lake: errors, consistency, time, and what a contour tells.

    python benchmarks/lake.py [--members 200] [--few 50] [--orbit]

Errors of the position after seven seconds, by case and by what is changed, beside the filter's own
sigma and NEES; and the bound of Cramer and Rao: what all vertices would tell of position and
velocity if each were known by its number, over the same frames and from the same prior. Needs the
outline of Seneca Lake (TERRAFIX_DATA).

With --orbit, only a whole orbit over the world's lakes (`terrafix[world]`): what is known before
the longest way without a lake, at its end and after the next lake, with errors that are carried
along the orbit, and with errors that add up in Cartesian axes.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import terrafix as tf
from terrafix.components.filters.lake import LakeCorrect, OrbitPredict
from terrafix.components.judges.evaluation import OrbitEvaluation
from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.lake import ORBIT, lake_observation
from terrafix.models.sensors.camera import CAMERA, Seen

EXAMPLES = Path(__file__).parents[1] / "examples"
TEN_HZ = tuple(
    (f"{name}.period", "0.1 s")
    for name in ("orbit", "camera", "moments", "predict", "correct", "evaluation")
)
CENTERED = (("pass", "over"),)
"""The orbit of leo_lake."""
STRAIGHT = ErrorState(*ORBIT)
"""Position and velocity, whose errors add up."""
CASES = {"T1": (15e3, 1.0), "T2": (15e3, 100.0), "T3": (70e3, 100.0)}
VARIANTS: dict[str, tuple[str, tuple[tuple[str, str], ...]]] = {
    "10 Hz": ("T3", TEN_HZ),
    "0.5 px": ("T2", (("camera.vertex_sigma", "0.5 px"),)),
    "0.5 px, biased": (
        "T2",
        (("camera.vertex_sigma", "0.5 px"), ("moments.unbiased", "false")),
    ),
    "three moments": ("T3", (("moments.elements", "three"),)),
    "not iterated": ("T3", (("correct.update", "ekf"),)),
    "Earth stands still": ("T3", (("correct.rotation_rate", "0 rad/s"),)),
    "attitude 0.02 deg": ("T3", (("camera.attitude_sigma", "0.02 deg"),)),
    "catalog 100 m": ("T3", (("camera.catalog_sigma", "100 m"),)),
}


def fly(
    file: str, case: str, members: int, settings: Any = (), names: Any = ("evaluation",)
) -> None:
    """Fly a system, and print a line for each of its filters."""
    system = tf.read_system(EXAMPLES / file, [("case", case), *settings])
    began = time.process_time()
    data = tf.simulate(system, members=members).dataset
    took = (time.process_time() - began) / members
    for name in names:
        error = np.linalg.norm(data[f"{name}.position_error"].values[-1], axis=1) / 1e3
        sigma = np.linalg.norm(data[f"{name}.position_sigma"].values[-1], axis=1).mean() / 1e3
        nees = np.nanmean(data[f"{name}.nees"].values[-1])
        print(
            f"  median {np.nanmedian(error):8.3f}  90 % {np.nanpercentile(error, 90):8.3f} km"
            f"  sigma {sigma:6.3f}  NEES {nees:9.3g}  {took:6.3f} s CPU/member  {name}"
        )


class StraightPredict(OrbitPredict):
    """An orbit whose errors add up in Cartesian axes."""

    error_state = STRAIGHT


class StraightCorrect(LakeCorrect):
    """Its correction."""

    error_state, observation = STRAIGHT, lake_observation(STRAIGHT)


class StraightEvaluation(OrbitEvaluation):
    """Its judge."""

    error_state, observation = STRAIGHT, lake_observation(STRAIGHT)


def orbit(case: str, track: str, members: int, *, straight: bool = False) -> None:
    """Fly an orbit, and print a line for each instant of its longest way without a lake."""
    with tempfile.TemporaryDirectory() as folder:
        text = (EXAMPLES / "leo_lakes_orbit.toml").read_text()
        for kind in ("predict", "correct", "evaluation") if straight else ():
            name = "lake_correct" if kind == "correct" else f"orbit_{kind}"
            text = text.replace(f'"{name}"', f'"lake:Straight{kind.title()}"')
        file = Path(folder) / "leo_lakes_orbit.toml"
        file.write_text(text)
        system = tf.read_system(file, [("case", case), ("track", track)])
        looks = system.find("camera")["look"]
        system.record("looks", [looks], period="1/2")
        began = time.process_time()
        data = tf.simulate(system, members=members).dataset
        took = time.process_time() - began
    fixed = np.isfinite(data["evaluation.accepted"].values).any(axis=1)
    whole = data["camera.look.whole"].values > 0.5
    lakes = len(np.unique(data["camera.look.lake"].values[whole]))
    at = np.flatnonzero(fixed)
    last = int(np.diff(at).argmax())  # of the fixes before the longest way
    later = at[last + 1 :]
    first = later[: np.flatnonzero(np.diff(later, append=10**9) > _PASS)[0] + 1]
    gap = (at[last + 1] - at[last]) / 2
    nees = data["evaluation.nees"].values
    print(f"  {lakes} lakes, {100 * fixed.mean():.2f} % of the time in view, {gap:.0f} s without")
    for when, k in (
        ("before", at[last]),
        ("end of gap", first[0] - 1),
        ("after", first[-1]),
        ("end", len(nees) - 1),
    ):
        error = np.linalg.norm(data["evaluation.position_error"].values[k], axis=1) / 1e3
        sigma = np.linalg.norm(data["evaluation.position_sigma"].values[k], axis=1) / 1e3
        speed = np.linalg.norm(data["evaluation.velocity_sigma"].values[k], axis=1)
        print(
            f"    {when:10s} t {k / 2:6.1f} s  median {np.nanmedian(error):8.3f}  90 % "
            f"{np.nanpercentile(error, 90):8.3f} km  sigma {np.nanmedian(sigma):8.3f} km "
            f"{np.nanmedian(speed):7.3f} m/s  NEES {np.nanmean(nees[k]):9.3g}"
        )
    lost = ~(nees[-1] < _LOST)
    print(f"    lost at the end: {lost.sum()} of {members}; {took / members:.2f} s CPU/member")


_PASS = 20
"""Ticks without a fix that end a pass over lakes."""
_LOST = 30.0
"""NEES (3) that one in 700,000 exceeds by chance."""


def bound(case: str, sigma: float = 0.25) -> float:
    """Root of the trace of the smallest covariance of the position at the end [km]."""
    system = tf.read_system(EXAMPLES / "leo_lake.toml", [("case", case)])
    orbit, camera = system.find("orbit"), system.find("camera")
    system.record("truth", [orbit["r_i"], orbit["v_i"]], period="1/30")
    data = tf.simulate(system, members=1)
    r, v = (data.dataset[f"orbit.{n}"].values[:, 0] for n in ("r_i", "v_i"))
    lakes = tf.Simulation(system, members=1)
    lakes.initialize()
    points = np.asarray(system.find("lakes").vertices)
    given = {n: np.reshape(camera.setting(n), (1, -1)) for n in CAMERA}
    at, step = CASES[case], 1 / 30
    information = np.diag(np.repeat([at[0] ** -2.0, at[1] ** -2.0], 3))
    for k in range(1, len(r)):
        n = np.linalg.norm(r[k])
        pull = -3.986004418e14 / n**3 * (np.eye(3) - 3 * np.outer(r[k], r[k]) / n**2)
        A = np.block([[np.zeros((3, 3)), np.eye(3)], [pull, np.zeros((3, 3))]])
        back = np.linalg.inv(np.eye(6) + step * A + step**2 / 2 * A @ A)
        information = back.T @ information @ back
        told = given | {"t": np.array([[k * step]])}
        seen = Seen({"r": r[k : k + 1], "v": v[k : k + 1]}, told, points, points.mean(axis=0))
        every = np.eye(2 * len(points)).reshape(1, 2 * len(points), len(points), 2)
        H = seen.derivative(every)[0, :, :6] / sigma
        information = information + H.T @ H
    return float(np.sqrt(np.trace(np.linalg.inv(information)[:3, :3]))) / 1e3


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--members", type=int, default=200)
    parser.add_argument("--few", type=int, default=50)
    parser.add_argument("--orbit", action="store_true")
    options = parser.parse_args()
    if options.orbit:
        for track, case, straight in itertools.product(
            ("north", "east"), ("T1", "T3"), (False, True)
        ):
            print(f"leo_lakes_orbit, {track}, {case}, {'straight' if straight else 'carried'}")
            orbit(case, track, options.few, straight=straight)
        return
    for case in CASES:
        print(f"leo_lake, {case}: all vertices could tell {bound(case):.4f} km")
        fly("leo_lake.toml", case, options.members)
    for case in CASES:
        print(f"leo_lake_shore, {case}: part of the lake; then the pass of leo_lake, all of it")
        fly("leo_lake_shore.toml", case, options.few)
        fly("leo_lake_shore.toml", case, options.few, CENTERED)
    print("leo_lake_shore, T2, 0.5 px")
    fly("leo_lake_shore.toml", "T2", options.few, (*CENTERED, ("camera.vertex_sigma", "0.5 px")))
    for name, (case, settings) in VARIANTS.items():
        print(f"leo_lake, {case}, {name}")
        fly("leo_lake.toml", case, options.few, settings)
    for case in CASES:
        print(f"leo_lake_printed, {case}")
        names = ("ekf_evaluation", "ukf_evaluation")
        fly("leo_lake_printed.toml", case, options.few, names=names)
    print("leo_lake_image, T3")
    fly("leo_lake_image.toml", "T3", 10)


if __name__ == "__main__":
    main()
