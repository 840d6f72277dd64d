"""What a filter of n states costs: its kernels, and beside them the same filter in NumPy.

    python benchmarks/filters.py [--members 100] [--only N]...

Position and velocity driven by white acceleration, a Gauss-Markov acceleration from nine states on,
Gauss-Markov biases of the measured position in the rest; three elements measured in every tick. All
of it is linear, so that the three updates, NumPy and filterpy have the same covariance: the run
ends if they do not. A first table has the kernels, one by one and compiled from nothing; a second
one the simulation (master and sensor included) beside the references, in the same run.
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

import terrafix as tf
from terrafix.components.filters.family import FilterCorrect, FilterPredict, fix_fields
from terrafix.cosim.basics.machine import cpu_name
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.kernels.build import build_kernels
from terrafix.cosim.records.results import versions
from terrafix.models.core.model import Model
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process, propagate
from terrafix.models.filters.updates import UPDATES

SIZES = (6, 9, 18, 24)
STEP = 0.1  # [s]
NUMBERS = {"psd": 0.01, "tau": 100.0, "sigma": 1.0}
SIGMA0, NOISE = 10.0, 2.0
TICKS = 20  # before covariances are compared, and times taken
BLOCKS = 7  # of which each time is the least: what others do on a machine only adds


def parts_of(n: int) -> tuple[ErrorState, Process, Observation]:
    """Error state, process and observation of n states."""
    driven = ["a", *(f"b{k}" for k in range(1, (n - 6) // 3))] if n > 6 else []
    state = ErrorState(vector("p", unit="m"), vector("v", unit="m/s"), *map(vector, driven))

    def rates(x: Any, _: Any, noise: Any, __: Any) -> dict[str, Any]:
        return {"p": x["v"], "v": noise["push"] + (x["a"] if driven else 0)}

    process = Process(
        rates=rates,
        noise={"push": ("psd", 3)},
        decays=dict.fromkeys(driven, ("tau", "sigma")),
    )
    labels = dict.fromkeys(("east", "north", "up"), "m")
    return state, process, Observation(lambda x, _: sum((x[b] for b in driven[1:]), x["p"]), labels)


def filter_of(n: int, update: str) -> tf.System:
    """A filter of n states, corrected in every tick by noise."""
    state, moves, observed = parts_of(n)
    others = [block.name for block in state if block.name not in ("p", "v")]
    settings = {
        name: tf.Parameter(value) for name, value in NUMBERS.items() if others or name == "psd"
    }

    def initial(name: str) -> str:
        return "start" if name in ("p", "v") else "sigma"

    predict = type(
        f"Predict{n}",
        (FilterPredict,),
        {
            "__module__": __name__,
            "default_rate": tf.Rate(str(STEP)),
            "error_state": state,
            "process": moves,
            "sigmas": {block.name: initial(block.name) for block in state},
            "start": tf.Parameter(SIGMA0),
            **settings,
        },
    )
    correct = type(
        f"Correct{n}",
        (FilterCorrect,),
        {
            "__module__": __name__,
            "default_rate": tf.Rate(str(STEP), offset=str(STEP)),
            "error_state": state,
            "observation": observed,
        },
    )

    class Sensor(tf.SymbolicComponent):
        """Measures nothing but noise."""

        default_rate = tf.Rate(str(STEP), offset=str(STEP))
        fix = tf.MessageOutput(fields=fix_fields(observed))

        def build_model(self) -> Model:
            noise = ca.SX.sym("noise", 3)
            return Model(
                "sensor",
                noise={"noise": noise},
                outputs={
                    "fix.y": NOISE * noise,
                    "fix.R": NOISE**2 * ca.SX.eye(3),
                    "fix.present": ca.SX.ones(3),
                    "fix.valid": ca.SX(1),
                },
            )

    with tf.System("filter", duration=1_000_000) as system:
        sensor = system.add(Sensor(), "sensor")
        system.add(predict(), "predict")
        system.add(correct(update=update), "correct")
        system.connect(sensor["fix"], "correct.fix")
        system.connect("predict.prior", "correct.prior")
        system.connect("correct.posterior", "predict.posterior")
    return system


def matrices(n: int) -> tuple[np.ndarray, ...]:
    """Transition, its noise, what is measured, its noise, covariance at the start."""
    state, process, observation = parts_of(n)
    values = {block.name: ca.SX.sym(block.name, block.size) for block in state}
    given = {name: ca.SX(NUMBERS[name]) for name in process.named()}
    moved = propagate(state, process, values, given, ca.SX(STEP), ca.SX(0))
    x = ca.vertcat(*values.values())
    H = ca.jacobian(observation.predict(values, {}), x)
    F, Q, H = (np.array(ca.evalf(m)) for m in (moved.transition, moved.spread, H))
    P = np.diag([SIGMA0**2] * 6 + [NUMBERS["sigma"] ** 2] * (n - 6))
    return F, Q, H, NOISE**2 * np.eye(3), P


def seconds(action: Callable[[], object]) -> float:
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def per_call(action: Callable[[], object], at_least: float = 0.05) -> float:
    """Time of a call, the least of blocks that take as long as that [s]."""
    action()
    count = max(1, int(at_least / max(seconds(action), 1e-7)))

    def block() -> None:
        for _ in range(count):
            action()

    return min(seconds(block) for _ in range(BLOCKS)) / count


class NumpyFilter:
    """The same filter of all members at once: what a good NumPy program does in a tick."""

    def __init__(self, n: int, n_members: int) -> None:
        self.F, self.Q, self.H, self.R, P = matrices(n)
        self.x = np.zeros((n_members, n))
        self.P = np.tile(P, (n_members, 1, 1))
        self.y = np.random.default_rng(0).normal(size=(n_members, 3)) * NOISE

    def tick(self) -> None:
        """Predict and correct, the covariance by Joseph's form, with the NIS."""
        F, Q, H, R = self.F, self.Q, self.H, self.R
        x, P = self.x @ F.T, F @ self.P @ F.T + Q
        HP = H @ P
        S = HP @ H.T + R
        nu = self.y - x @ H.T
        solved = np.linalg.solve(S, np.concatenate([HP, nu[:, :, None]], axis=2))
        K = np.swapaxes(solved[:, :, :-1], 1, 2)
        self.nis = np.einsum("ij,ij->i", nu, solved[:, :, -1])
        left = np.eye(len(F)) - K @ H
        self.x = x + np.einsum("ijk,ik->ij", K, nu)
        P = left @ P @ np.swapaxes(left, 1, 2) + K @ R @ np.swapaxes(K, 1, 2)
        self.P = (P + np.swapaxes(P, 1, 2)) / 2


class FilterpyFilter:
    """The same filter of one member, by filterpy."""

    def __init__(self, n: int) -> None:
        from filterpy.kalman import KalmanFilter

        self.filter = KalmanFilter(dim_x=n, dim_z=3)
        self.filter.F, self.filter.Q, self.filter.H, self.filter.R, self.filter.P = matrices(n)
        self.y = np.random.default_rng(0).normal(size=3) * NOISE

    def tick(self) -> None:
        """Predict and correct."""
        self.filter.predict()
        self.filter.update(self.y)


def filterpy_filter(n: int) -> FilterpyFilter | None:
    """None where it is not installed."""
    try:
        return FilterpyFilter(n)
    except ImportError:
        return None


def kernels(n: int, update: str, which: str) -> tuple[Any, ...]:
    """Instructions of a kernel, and what building and compiling it takes [s]; its kind."""
    component = filter_of(n, update).nodes[which]
    found: list[Any] = []
    built = seconds(lambda: found.append(component.kernel_request()))
    (request,) = found
    made: list[Any] = []
    compiled = seconds(lambda: made.extend(build_kernels([request])))
    return request.function.n_instructions(), built, compiled, made[0].kind


def simulated(n: int, update: str, n_members: int) -> tuple[float, float, float, np.ndarray]:
    """Times per tick of all members: predict, correct, the simulation [s]; P after some ticks."""
    system = filter_of(n, update)
    simulation = Simulation(system, members=n_members)
    simulation.initialize()
    ticks = TICKS
    simulation.master.run_until(ticks)
    P = system.nodes["correct"].port_views["estimate"].P[0].copy()

    def go_on() -> None:
        nonlocal ticks
        ticks += 100
        simulation.master.run_until(ticks)

    whole = per_call(go_on) / 100
    each = [per_call(lambda c=system.nodes[name]: c.call(0)) for name in ("predict", "correct")]
    simulation.master.terminate()
    return each[0], each[1], whole, P


def printed(rows: list[tuple[str, ...]]) -> None:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        print(
            "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)),
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--members", type=int, default=100)
    parser.add_argument("--only", type=int, action="append", choices=SIZES, default=[])
    arguments = parser.parse_args()
    members = arguments.members
    print(
        f"{cpu_name()}, {os.cpu_count()} cores, {platform.system()}, "
        + ", ".join(f"{k} {v}" for k, v in versions().items())
    )
    kernel_rows = [("n", "kernel", "instructions", "build s", "compile s", "ns", "kind")]
    rows = [("n", *UPDATES, "NumPy", "filterpy", f"NumPy / {UPDATES[0]}")]
    with tempfile.TemporaryDirectory() as cache:
        os.environ["TERRAFIX_CACHE"] = cache
        for n in arguments.only or SIZES:
            made = {"predict": kernels(n, UPDATES[0], "predict")}
            made |= {update: kernels(n, update, "correct") for update in UPDATES}
            times, whole = {}, {}
            reference, one = NumpyFilter(n, members), filterpy_filter(n)
            for _ in range(TICKS):
                reference.tick()
            expected = reference.P[0].copy()
            for update in UPDATES:
                times["predict"], times[update], whole[update], P = simulated(n, update, members)
                np.testing.assert_allclose(P, expected, rtol=1e-9, atol=1e-9)
            of_numpy, of_filterpy = per_call(reference.tick), "not installed"
            if one is not None:
                for _ in range(TICKS):
                    one.tick()
                np.testing.assert_allclose(one.filter.P, expected, rtol=1e-9, atol=1e-9)
                of_filterpy = f"{per_call(one.tick) * 1e9:.0f}"
            for name, (instructions, built, compiled, kind) in made.items():
                ns = f"{times[name] / members * 1e9:.0f}"
                numbers = (str(instructions), f"{built:.2f}", f"{compiled:.1f}", ns, kind)
                kernel_rows.append((str(n), name, *numbers))
            each = [f"{t / members * 1e9:.0f}" for t in (*whole.values(), of_numpy)]
            rows.append((str(n), *each, of_filterpy, f"{of_numpy / whole[UPDATES[0]]:.1f}"))
    print(f"\nkernels; ns per member and call, {members} members")
    printed(kernel_rows)
    print(f"\nsimulation and references; ns per member and tick, {members} members (filterpy: one)")
    printed(rows)
    if filterpy_filter(6) is None:
        print("filterpy: not installed")


if __name__ == "__main__":
    main()
