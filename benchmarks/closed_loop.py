"""What images are worth as fixes, and the closed loop against the open one with the same errors.

    python benchmarks/closed_loop.py [--sets 7] [--members 8] [--case TC-2] [--workers 2]

Every set has a place, a surface, speckle, noise and a misalignment of its own, and flies three
images with an ensemble of initial errors. Printed are the errors of the fixes over all images, also
over the sigma that they were reported with, the share of updates accepted, predicted and sample
sigma after each update, and NEES. The open loop draws the errors of each fix from the covariances
that the closed one reported for it.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
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
IMAGING = ("terrain", "echo", "reference", "former", "matcher")
TIMES = ("8.2", "16.4", "24.6")  # [s]
DURATION = "24.8"  # [s]
LOOK = float(np.radians(34.3))
SIGMA = {"TC-1": np.radians(0.1), "TC-2": np.radians(0.01)}
DEM = read_jacksboro().tiled()


class DrawnFix(Component):
    """The fix of the closed loop with errors drawn, from covariances of each, and not imaged."""

    default_rate = Rate(times=TIMES)

    D = Parameter(shape=(len(TIMES), 3, 3), doc="of each fix: covariance of its place [m^2]")
    R = Parameter(shape=(len(TIMES), 4, 4), doc="of each fix: covariance of its noise")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude")
    q_mu = Input((4,), unit="1", frame="s", doc="true misalignment")
    fix = MessageOutput(fields=FIX, doc="the fix")

    def _step_impl(self, t: float, dt: float) -> None:
        noise = self.normals("errors", 7)
        n, k = self.n_members, int(np.argmin(np.abs(np.array(TIMES, float) - t)))
        y, r_f = np.zeros((n, 4)), np.zeros((n, 3))
        D, R = self.D[:, k], self.R[:, k]
        for m in range(n):
            beam = boresight(self.r_e[m], self.v_e[m], self.q_be[m], self.q_mu[m])
            V = effective_velocity_array(self.r_e[m], self.v_e[m], beam.point)
            y[m] = np.array([0.0, 0.0, beam.slant_range, V]) + root(R[m]) @ noise[m, :4]
            r_f[m] = beam.point + root(D[m]) @ noise[m, 4:]
        self.fix.publish(t, y=y, r_f_e=r_f, R=R, D=D, present=np.ones((n, 4)))


def root(P: np.ndarray) -> np.ndarray:
    """A square root of a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(P)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def boresight(r: Any, v: Any, q_be: Any, q_mu: Any) -> Boresight:
    return boresight_on_terrain(r, v, q_be, q_mu, LOOK, 0.0, DEM)


def closed_loop(case: str, number: int) -> System:
    """One set: a place, a surface and a misalignment of its own."""
    system = read_system(SYSTEM, settings=[("case", case)])
    rng = np.random.default_rng([20081, number])
    parts = system.nodes
    system.dispersions.clear()
    parts["antenna"].misalignment = SIGMA[case] * rng.standard_normal(3)
    parts["orbit"].earth_angle0 = 0.37 * number + 0.001 * rng.random()
    parts["terrain"].surface_seed = 100 + number
    parts["former"].show_unfocused = False
    system.remove("album")
    system.record("pointing", [parts["attitude"]["q_be"], parts["antenna"]["q_mu"]], period="8.2")
    return system


def open_loop(case: str, number: int, D: np.ndarray, R: np.ndarray) -> System:
    """The same without images: errors of each fix are drawn from its covariances."""
    system = closed_loop(case, number)
    drawn = DrawnFix(D=D.tolist(), R=R.tolist())
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
    data = simulate(system, members=members, duration=DURATION, seed=5000 + number).dataset

    def at(name: str, t: float) -> np.ndarray:
        values = data[name]
        return values.sel({values.dims[0]: t}, method="nearest").to_numpy()

    names = ("fix", "velocity", "accepted", "reason", "error", "P", "D", "R", "axes")
    found: dict[str, Any] = {k: [] for k in names}
    for t in map(float, TIMES):
        r, v = at("orbit.r_e", t), at("orbit.v_e", t)
        q_be, q_mu = at("attitude.q_be", t), at("antenna.q_mu", t)
        beam = boresight(r[0], v[0], q_be[0], q_mu[0])
        axes = track_axes(beam.point, v[0])
        found["fix"].append((at("matcher.fix.r_f_e", t) - beam.point) @ axes.T)
        V = effective_velocity_array(r[0], v[0], beam.point)
        y, present = at("matcher.fix.y", t), at("matcher.fix.present", t)
        found["velocity"].append(np.where(present[:, 3] > 0, y[:, 3] - V, np.nan))
        found["axes"].append(axes)
        for name in ("D", "R"):
            found[name].append(at(f"matcher.fix.{name}", t))
        found["accepted"].append(at("correct.innovation.accepted", t) > 0)
        reason = at("matcher.reason", t) if "matcher.reason" in data else np.zeros(members)
        found["reason"].append(np.nan_to_num(reason))
        estimate = [at(f"correct.estimate.{k}", t) for k in ("r_e", "v_e", "q_mu")]
        found["error"].append(STATE.difference_of_arrays(*estimate, r, v, q_mu))
        found["P"].append(at("correct.estimate.P", t))
    return {k: np.array(x) for k, x in found.items()}


def reported(found: dict[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Covariances D (3, 3, 3) and R (3, 4, 4) that the fixes of a set came with, of most members.

    None if an update was left without any fix, or without its velocity.
    """
    whole = np.isfinite(found["velocity"]) & np.isfinite(found["fix"][..., 0])
    if not whole.any(axis=1).all():
        return None
    D, R = (
        np.array([np.median(own[m], axis=0) for own, m in zip(found[k], whole, strict=True)])
        for k in ("D", "R")
    )
    return D, R


def fixes(closed: list[dict[str, Any]]) -> None:
    """Errors of the fixes over all images, from the first member that has one of every set."""
    errors, sigmas, squares = [], [], []
    for s in closed:
        for k in range(len(TIMES)):
            have = np.flatnonzero(np.isfinite(s["fix"][k, :, 0]))
            if not len(have):
                continue
            axes, m = s["axes"][k], have[0]
            D = axes @ s["D"][k, m] @ axes.T
            errors.append(s["fix"][k, m])
            sigmas.append(np.sqrt(np.diagonal(D)))
            squares.append(errors[-1] @ np.linalg.pinv(D) @ errors[-1])
    e, sigma = np.array(errors), np.array(sigmas)
    n = len(e)
    print(f"fixes: {n} of {len(TIMES) * len(closed)} images recognized")
    mean, standard = e.mean(axis=0), e.std(axis=0, ddof=1) / np.sqrt(n)
    for i, axis in enumerate(("along", "across", "up")):
        print(
            f"  {axis:7s} mean {mean[i]:6.2f} m = {mean[i] / standard[i]:5.1f} standard errors; "
            f"rms {np.sqrt(np.mean(e[:, i] ** 2)):.2f} m, largest {np.abs(e[:, i]).max():.2f} m; "
            f"reported {np.sqrt(np.mean(sigma[:, i] ** 2)):.2f} m, error over sigma "
            f"{np.sqrt(np.mean((e[:, i] / sigma[:, i]) ** 2)):.2f} rms"
        )
    low, high = chi_square_interval(3.0, n)
    print(f"  normalized square {np.mean(squares):.2f} of 3, bounds {low:.2f} to {high:.2f}")
    print("  covariance [m^2]", np.round(np.cov(e.T), 2).tolist())
    starts = np.concatenate([s["velocity"].ravel() for s in closed])
    told = np.concatenate([np.sqrt(s["R"][..., 3, 3]).ravel() for s in closed])
    named = np.isfinite(starts)
    V, share = starts[named], 100 * np.mean(np.abs(starts) < 1.5)
    print(
        f"  autofocus: {len(starts)} starts, {share:.1f} % within "
        f"1.5 m/s, mean {V.mean():.3f}, rms {np.sqrt(np.mean(V**2)):.3f}, "
        f"largest {np.abs(V).max():.2f}; reported {np.sqrt(np.mean(told[named] ** 2)):.3f}, error "
        f"over sigma {np.sqrt(np.mean((V / told[named]) ** 2)):.2f} rms"
    )


def updates(closed: list[dict[str, Any]], opened: list[dict[str, Any]]) -> None:
    """Share of updates accepted; velocity sigma and NEES after each, beside the open loop's."""
    print(f"updates accepted: {100 * np.mean([s['accepted'] for s in closed]):.1f} %")
    for number, found in enumerate(closed):
        for k, m in np.argwhere(~found["accepted"]):
            why = MATCHED[int(found["reason"][k, m])]
            print(f"  set {number}, member {m}, update {k + 1}: {why}")
    low, high = chi_square_interval(9.0, len(closed))
    for k in range(len(TIMES)):
        rows = []
        for runs in (closed, opened):
            # who went without a fix knows less, and is told above
            whole = [s["accepted"][: k + 1].all(axis=0) for s in runs]
            e = np.concatenate([s["error"][k][m] for s, m in zip(runs, whole, strict=True)])
            P = np.concatenate([s["P"][k][m] for s, m in zip(runs, whole, strict=True)])
            predicted = np.sqrt(np.mean(np.diagonal(P, axis1=1, axis2=2), axis=0))
            rows.append((predicted, np.sqrt(np.mean(e**2, axis=0)), e, P))
        (p, s, e, P), (p0, s0, e0, P0) = rows
        own = [float(np.mean(normalized_square(x["error"][k], x["P"][k]))) for x in closed]
        print(f"update {k + 1}, root sum of squares, times the open loop's:")
        for what, part, unit in (
            ("position", slice(0, 3), "m"),
            ("velocity", slice(3, 6), "m/s"),
            ("misalignment", slice(6, 9), "rad"),
        ):
            a, a0, b, b0 = (float(np.linalg.norm(x[part])) for x in (p, p0, s, s0))
            print(
                f"  {what:12s} sigma predicted {a:.3g} {unit} = {a / a0:.3f}, "
                f"sample {b:.3g} {unit} = {b / b0:.3f}"
            )
        print(
            f"  NEES {normalized_square(e, P).mean():.2f} (open "
            f"{normalized_square(e0, P0).mean():.2f}), bounds for {len(closed)} sets {low:.2f} to "
            f"{high:.2f}; by set {np.round(own, 1)}"
        )


def one(case: str, number: int, members: int) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """A set in the closed loop, and in the open one with the covariances that were reported."""
    closed = outcome(closed_loop(case, number), number, members)
    covariances = reported(closed)
    if covariances is None:
        return closed, None
    return closed, outcome(open_loop(case, number, *covariances), number, max(members, 60))


def table(case: str, sets: int, members: int, workers: int) -> None:
    started = time.perf_counter()
    jobs = [(case, k, members) for k in range(sets)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(one, *zip(*jobs, strict=True)))
    print(f"closed loop, {case}: {sets} sets of {members}, {time.perf_counter() - started:.0f} s")
    closed = [c for c, _ in found]
    fixes(closed)
    whole = [(c, o) for c, o in found if o is not None]
    if len(whole) < sets:
        print(f"{sets - len(whole)} sets with an update that has no fix or no velocity: left out")
    updates([c for c, _ in whole], [o for _, o in whole])
    usage = [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    peak = max(u.ru_maxrss for u in usage) / 2**20
    processor = sum(u.ru_utime + u.ru_stime for u in usage)
    print(
        f"peak memory of a process {peak:.2f} GiB, {processor:.0f} s of processor in all, "
        f"{time.perf_counter() - started:.0f} s\n"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=7)
    parser.add_argument("--members", type=int, default=8)
    parser.add_argument("--case", choices=(*SIGMA, "both"), default="TC-2")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    for name in SIGMA if arguments.case == "both" else (arguments.case,):
        table(name, arguments.sets, arguments.members, arguments.workers)
