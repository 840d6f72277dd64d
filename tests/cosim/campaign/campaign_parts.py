"""A small system with a filter that can be made wrong, for the tests of campaigns."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

import casadi as ca
import numpy as np

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.evaluation import Evaluation, Quantity
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, Output, SharedOutput
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.system.system import System
from terrafix.models.core.model import Model


class Filter(SymbolicComponent):
    """A scalar random walk, measured with noise, and the Kalman filter of it, in one component."""

    default_rate = Rate("1")
    x0 = Parameter(0.0, unit="m", doc="mean at the start")
    sigma0 = Parameter(2.0, unit="m", doc="of the truth about x0")
    walk = Parameter(0.5, unit="m/s^0.5")
    noise_sigma = Parameter(1.0, unit="m")
    bias = Parameter(0.0, unit="m", doc="of the measurement, unknown to the filter")
    tuning = Parameter(1.0, doc="measurement variance of the filter over the true one")
    wall = Parameter(1e9, unit="m", doc="a truth beyond it makes the member fail")

    truth = Output(unit="m")
    estimate = Output(unit="m")
    variance = Output(unit="m^2")
    innovation = Output(unit="m")
    innovation_variance = Output(unit="m^2")

    def build_model(self):
        """Build the model."""
        names = ("x0", "sigma0", "walk", "noise_sigma", "bias", "tuning", "wall")
        p = {n: ca.SX.sym(n) for n in names}
        states = {n: ca.SX.sym(n) for n in ("x", "m", "P", "nu", "S")}
        x, m, P = states["x"], states["m"], states["P"]
        w, v, dt = ca.SX.sym("w"), ca.SX.sym("v"), ca.SX.sym("dt")
        truth = x + p["walk"] * ca.sqrt(dt) * w
        prior = P + p["walk"] ** 2 * dt
        R = p["tuning"] * p["noise_sigma"] ** 2
        S = prior + R
        nu = truth + p["bias"] + p["noise_sigma"] * v - m
        K = prior / S
        return Model(
            "scalar_filter",
            states=states,
            parameters=p,
            noise={"w": w, "v": v},
            next={"x": truth, "m": m + K * nu, "P": (1 - K) * prior, "nu": nu, "S": S},
            initial={"x": p["x0"] + p["sigma0"] * w, "m": p["x0"], "P": p["sigma0"] ** 2, "S": 1.0},
            outputs={
                "truth": x + 1e-30 * ca.sqrt(p["wall"] - x),  # NaN beyond the wall
                "estimate": m,
                "variance": P,
                "innovation": states["nu"],
                "innovation_variance": states["S"],
            },
            step=dt,
        )


class Judge(Evaluation):
    """Error, NEES, NIS and innovations of the scalar filter."""

    default_rate = Rate("1")
    quantities = (Quantity("x", "m", ("",)),)
    truth = Input(unit="m")
    estimate = Input(unit="m")
    variance = Input(unit="m^2")
    innovation = Input(unit="m")
    innovation_variance = Input(unit="m^2")
    x_error = Output((1,), unit="m")
    x_sigma = Output((1,), unit="m")
    covariance = Output((1, 1))
    nees = Output()
    nis = Output()
    nis_dof = Output()
    normalized_innovation = Output((1,))

    def _publish(self, *, measured):
        error = self.estimate - self.truth
        self.x_error = error[:, None]
        self.x_sigma = np.sqrt(self.variance)[:, None]
        self.covariance = self.variance[:, None, None]
        self.nees = error**2 / self.variance
        z = self.innovation / np.sqrt(self.innovation_variance)
        self.nis = z**2 if measured else np.nan
        self.nis_dof = 1.0 if measured else np.nan
        self.normalized_innovation = z[:, None] if measured else np.nan

    def _initialize_impl(self):
        self._publish(measured=False)

    def _step_impl(self, t, dt):
        self._publish(measured=True)

    def error_model(self):
        """Estimate minus truth."""
        truth, estimate = ca.SX.sym("truth"), ca.SX.sym("estimate")
        return Model(
            "x_error",
            inputs={"truth": truth, "estimate": estimate},
            outputs={"error": estimate - truth},
        )


class Tripwire(Component):
    """A component in Python that raises for one member, whoever flies with it."""

    default_rate = Rate("1")
    victim = Parameter(-1.0)
    u = Input(unit="m")
    y = Output(unit="m")

    def _initialize_impl(self):
        self.y = self.u

    def _step_impl(self, t, dt):
        if t == 7 and (self.environment.members == self.victim).any():
            raise ValueError("the wire was touched")
        self.y = self.u


class Lonely(Component):
    """Shares the truth of one member."""

    default_rate = Rate("1")
    truth = Input(unit="m")
    shared = SharedOutput((1,), unit="m")

    def alone(self):
        """Whether what it shares is of one member."""
        return True

    def _step_impl(self, t, dt):
        assert self.n_members == 1
        self.shared = self.truth.copy()


class Hold(Component):
    """Waits at t = 7 while the folder ``HOLD`` is there, with members from ``HOLD_FROM`` on.

    A file in that folder says which members wait, by the first one, and in which process.
    """

    default_rate = Rate("1")

    def _step_impl(self, t, dt):
        folder = os.environ.get("HOLD")
        first = int(self.environment.members[0])
        if folder is None or t != 7 or first < int(os.environ["HOLD_FROM"]):
            return
        file = Path(folder, f"{first}")
        with suppress(FileNotFoundError):
            file.with_suffix(".new").write_text(f"{os.getpid()}")
            file.with_suffix(".new").replace(file)
        while Path(folder).exists():
            time.sleep(0.01)


def scalar_system(duration=20, tripwire=None, **settings):
    """Build the system; settings are the filter's."""
    system = System("scalar", duration=duration, seed=5)
    part = system.add(Filter(**settings), "filter")
    judge = system.add(Judge(), "judge")
    for port in ("truth", "estimate", "variance", "innovation", "innovation_variance"):
        system.connect(part[port], judge[port])
    if tripwire is not None:
        wire = system.add(Tripwire(victim=tripwire), "wire")
        system.connect(part["truth"], wire["u"])
    return system
