"""What images are worth as fixes, and the closed loop against the open one with the same errors.

    python benchmarks/closed_loop.py [--sets 7] [--members 8] [--case TC-2]

Every set has a place, a surface, speckle, noise and a misalignment of its own, and flies three
images with an ensemble of initial errors. Printed are the errors of the fixes over all images, the
share of updates accepted, predicted and sample velocity sigma after each update, and NEES.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.components.fields import FIX
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System
from terrafix.models.filters.consistency import normalized_square
from terrafix.models.filters.spacecraft import STATE
from terrafix.models.geometry.geolocation import track_axes
from terrafix.models.images.matching import REASONS as MATCHED
from terrafix.models.maps.dem import read_jacksboro
from terrafix.models.radar.boresight import Boresight, boresight_on_terrain
from terrafix.models.sensors.effective_velocity import effective_velocity_array

SYSTEM = Path(__file__).parents[1] / "examples" / "spacecraft_sar_closed_loop.toml"
IMAGING = ("terrain", "echo", "reference", "former", "matcher", "album")
TIMES = ("8.2", "16.4", "24.6")  # [s]
LOOK = float(np.radians(34.3))
SIGMA = {"TC-1": np.radians(0.1), "TC-2": np.radians(0.01)}
DEM = read_jacksboro().tiled()


class DrawnFix(Component):
    """The fix of the closed loop with errors drawn instead of imaged."""

    default_rate = Rate(times=TIMES)

    geolocation_sigma = Parameter(shape=(3,), unit="m", doc="along the track, across, up")
    velocity_sigma = Parameter(unit="m/s", doc="of the effective velocity")
    range_sigma = Parameter(1.0, unit="m", doc="of the slant range")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude")
    q_mu = Input((4,), unit="1", frame="s", doc="true misalignment")
    fix = MessageOutput(fields=FIX, doc="the fix")

    def _step_impl(self, t: float, dt: float) -> None:
        noise = self.normals("errors", 5)
        n = self.n_members
        y, r_f = np.zeros((n, 4)), np.zeros((n, 3))
        R, D = np.zeros((n, 4, 4)), np.zeros((n, 3, 3))
        for m in range(n):
            beam = boresight(self.r_e[m], self.v_e[m], self.q_be[m], self.q_mu[m])
            axes = track_axes(beam.point, self.v_e[m])
            sigma = self.geolocation_sigma[m]
            V = effective_velocity_array(self.r_e[m], self.v_e[m], beam.point)
            y[m, 2] = beam.slant_range + self.range_sigma[m] * noise[m, 3]
            y[m, 3] = V + self.velocity_sigma[m] * noise[m, 4]
            r_f[m] = beam.point + (sigma * noise[m, :3]) @ axes
            D[m] = axes.T @ np.diag(sigma**2) @ axes
            R[m] = np.diag([0.0, 0.0, self.range_sigma[m] ** 2, self.velocity_sigma[m] ** 2])
        self.fix.publish(t, y=y, r_f_e=r_f, R=R, D=D, present=np.ones((n, 4)))


def boresight(r: Any, v: Any, q_be: Any, q_mu: Any) -> Boresight:
    return boresight_on_terrain(r, v, q_be, q_mu, LOOK, 0.0, DEM)


def closed_loop(case: str, number: int) -> System:
    """One set: a place, a surface and a misalignment of its own."""
    system = read_system(SYSTEM, settings=[("case", case)])
    rng = np.random.default_rng([20081, number])
    parts = system.nodes
    parts["antenna"].misalignment = SIGMA[case] * rng.standard_normal(3)
    parts["orbit"].earth_angle0 = 0.37 * number + 0.001 * rng.random()
    parts["terrain"].surface_seed = 100 + number
    system.record("pointing", [parts["attitude"]["q_be"], parts["antenna"]["q_mu"]], period="8.2")
    return system


def open_loop(case: str, number: int, sigma: np.ndarray) -> System:
    """The same without images: errors of the fix are drawn with standard errors (3,) [m]."""
    system = closed_loop(case, number)
    former = system.nodes["former"]
    drawn = DrawnFix(
        geolocation_sigma=sigma,
        velocity_sigma=former.setting("velocity_sigma"),
        range_sigma=former.setting("range_sigma"),
    )
    system.records = [r for r in system.records if r.name != "fixes"]
    for name in IMAGING:
        system.remove(name)
    parts = system.nodes
    fix = system.add(drawn, "matcher")
    truth = (("orbit", "r_e"), ("orbit", "v_e"), ("attitude", "q_be"), ("antenna", "q_mu"))
    for source, port in truth:
        system.connect(parts[source][port], fix[port])
    system.connect(fix["fix"], parts["correct"]["fix"])
    system.record("fixes", [fix["fix"]], period="8.2")
    return system


def outcome(system: System, number: int, members: int) -> dict[str, Any]:
    """Errors of fixes and estimates at the three updates of one set."""
    data = simulate(system, members=members, seed=5000 + number).dataset

    def at(name: str, t: float) -> np.ndarray:
        values = data[name]
        return values.sel({values.dims[0]: t}, method="nearest").to_numpy()

    found: dict[str, Any] = {
        k: [] for k in ("fix", "D", "velocity", "accepted", "reason", "error", "P")
    }
    for t in map(float, TIMES):
        r, v = at("orbit.r_e", t), at("orbit.v_e", t)
        q_be, q_mu = at("attitude.q_be", t), at("antenna.q_mu", t)
        beam = boresight(r[0], v[0], q_be[0], q_mu[0])
        axes = track_axes(beam.point, v[0])
        found["fix"].append((at("matcher.fix.r_f_e", t) - beam.point) @ axes.T)
        found["D"].append(axes @ at("matcher.fix.D", t) @ axes.T)
        V = effective_velocity_array(r[0], v[0], beam.point)
        y, present = at("matcher.fix.y", t), at("matcher.fix.present", t)
        found["velocity"].append(np.where(present[:, 3] > 0, y[:, 3] - V, np.nan))
        found["accepted"].append(at("correct.innovation.accepted", t) > 0)
        reason = at("matcher.reason", t) if "matcher.reason" in data else np.zeros(members)
        found["reason"].append(np.nan_to_num(reason))
        estimate = [at(f"correct.estimate.{k}", t) for k in ("r_e", "v_e", "q_mu")]
        found["error"].append(STATE.difference_of_arrays(*estimate, r, v, q_mu))
        found["P"].append(at("correct.estimate.P", t))
    return {k: np.array(x) for k, x in found.items()}


def fixes(closed: list[dict[str, Any]]) -> None:
    """Errors of the fixes over all images, from the first member of every set."""
    first = np.array([s["fix"][k, 0] for s in closed for k in range(3)])
    errors = first[np.isfinite(first[:, 0])]
    n = len(errors)
    print(f"fixes: {n} of {len(first)} images recognized")
    mean, standard = errors.mean(axis=0), errors.std(axis=0, ddof=1) / np.sqrt(n)
    for axis, m, s, e in zip(("along", "across", "up"), mean, standard, errors.T, strict=True):
        print(
            f"  {axis:7s} mean {m:6.2f} m = {m / s:5.1f} standard errors; rms "
            f"{np.sqrt(np.mean(e**2)):.2f} m, largest {np.abs(e).max():.2f} m"
        )
    D = np.array([s["D"][k, 0] for s in closed for k in range(3)])[np.isfinite(first[:, 0])]
    ratios = errors / np.sqrt(np.diagonal(D, axis1=1, axis2=2))
    square = np.mean([e @ np.linalg.solve(d, e) for e, d in zip(errors, D, strict=True)]) / 3
    print(
        f"  error over sigma, rms {np.round(np.sqrt(np.mean(ratios**2, axis=0)), 2)}, largest "
        f"{np.abs(ratios).max():.1f}; normalized square {square:.2f}"
    )
    print("  covariance [m^2]", np.round(np.cov(errors.T), 2).tolist())
    starts = np.concatenate([s["velocity"].ravel() for s in closed])
    V, share = starts[np.isfinite(starts)], 100 * np.mean(np.abs(starts) < 1.5)
    print(
        f"  autofocus: {len(starts)} starts, {share:.1f} % within "
        f"1.5 m/s, mean {V.mean():.3f}, rms {np.sqrt(np.mean(V**2)):.3f}, "
        f"largest {np.abs(V).max():.2f}"
    )


def updates(closed: list[dict[str, Any]], opened: list[dict[str, Any]]) -> None:
    """Share of updates accepted; velocity sigma and NEES after each, beside the open loop's."""
    print(f"updates accepted: {100 * np.mean([s['accepted'] for s in closed]):.1f} %")
    for number, found in enumerate(closed):
        for k, m in np.argwhere(~found["accepted"]):
            why = MATCHED[int(found["reason"][k, m])]
            print(f"  set {number}, member {m}, update {k + 1}: {why}")
    low, high = chi_square_interval(9.0, len(closed))
    for k in range(3):
        rows = []
        for runs in (closed, opened):
            e = np.concatenate([s["error"][k] for s in runs])
            P = np.concatenate([s["P"][k] for s in runs])
            predicted = np.sqrt(np.mean(np.diagonal(P, axis1=1, axis2=2), axis=0))
            rows.append((predicted[3:6], np.sqrt(np.mean(e[:, 3:6] ** 2, axis=0)), e, P))
        (p, s, e, P), (p0, s0, e0, P0) = rows
        own = [float(np.mean(normalized_square(x["error"][k], x["P"][k]))) for x in closed]
        print(
            f"update {k + 1}: velocity sigma predicted {np.round(p, 3)} (open {np.round(p0, 3)}), "
            f"sample {np.round(s, 3)} (open {np.round(s0, 3)})"
        )
        print(
            f"  ratio to the open loop, root sum of squares: predicted "
            f"{np.linalg.norm(p) / np.linalg.norm(p0):.3f}, sample "
            f"{np.linalg.norm(s) / np.linalg.norm(s0):.3f}"
        )
        print(
            f"  NEES {normalized_square(e, P).mean():.2f} (open "
            f"{normalized_square(e0, P0).mean():.2f}), bounds for {len(closed)} sets {low:.2f} to "
            f"{high:.2f}; by set {np.round(own, 1)}"
        )


def table(case: str, sets: int, members: int) -> None:
    started = time.perf_counter()
    closed = [outcome(closed_loop(case, k), k, members) for k in range(sets)]
    print(f"closed loop, {case}: {sets} sets of {members}, {time.perf_counter() - started:.0f} s")
    fixes(closed)
    D = np.concatenate([s["D"].reshape(-1, 3, 3) for s in closed])
    sigma = np.sqrt(np.nanmean(np.diagonal(D, axis1=1, axis2=2), axis=0))
    opened = [outcome(open_loop(case, k, sigma), k, max(members, 60)) for k in range(sets)]
    updates(closed, opened)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak:.2f} GiB, {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=7)
    parser.add_argument("--members", type=int, default=8)
    parser.add_argument("--case", choices=SIGMA, default="TC-2")
    arguments = parser.parse_args()
    table(arguments.case, arguments.sets, arguments.members)
