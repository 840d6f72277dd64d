"""Small symbolic components that the tests export."""

from __future__ import annotations

import casadi as ca
import numpy as np

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model


class EulerIntegrator(SymbolicComponent):
    """x' = u + drive by the explicit Euler method, y = x + shift."""

    default_rate = Rate("0.01")

    shift = Parameter(1.0, doc="of the output")
    drive = Parameter(0.0, doc="added to the input")

    u = Input((), unit="1", at="start", default=0.0, doc="derivative")
    y = Output((), unit="1", doc="state plus shift")

    def build_model(self):
        x, u, dt = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("dt")
        shift, drive = ca.SX.sym("shift"), ca.SX.sym("drive")
        return Model(
            "integrator",
            inputs={"u": u},
            states={"x": x},
            parameters={"shift": shift, "drive": drive},
            next={"x": x + dt * (u + drive)},
            outputs={"y": x + shift},
            step=dt,
        )


class Follower(SymbolicComponent):
    """A state that starts from three times its input, and then moves by it, in steps."""

    default_rate = Rate("0.1")
    u = Input((2,), unit="1", at="start", default=2.0, doc="followed")
    y = Output((2,), unit="1", doc="state")

    def build_model(self):
        x, u, dt = ca.SX.sym("x", 2), ca.SX.sym("u", 2), ca.SX.sym("dt")
        return Model(
            "follower",
            inputs={"u": u},
            states={"x": x},
            initial={"x": 3 * u},
            next={"x": x + dt * u},
            outputs={"y": x},
            step=dt,
        )


class Pushed(SymbolicComponent):
    """x' = u, which is read at the start of a step; x starts from 3 u."""

    default_rate = Rate("0.1")
    u = Input((), unit="1", at="start", default=2.0, doc="derivative")
    x = Output((), unit="1", doc="state")
    sum = Output((), unit="1", doc="state plus derivative")

    def build_model(self):
        x, u = ca.SX.sym("x"), ca.SX.sym("u")
        return Model(
            "pushed",
            inputs={"u": u},
            states={"x": x},
            initial={"x": 3 * u},
            derivatives={"x": u},
            outputs={"x": x, "sum": x + u},
            step=ca.SX.sym("dt"),
        )


class Own(SymbolicComponent):
    """x' = u from 1 on."""

    default_rate = Rate("0.1")
    u = Input((), unit="1", at="start", doc="derivative")
    x = Output((), unit="1", doc="state")

    def build_model(self):
        x, u = ca.SX.sym("x"), ca.SX.sym("u")
        return Model(
            "own",
            inputs={"u": u},
            states={"x": x},
            initial={"x": ca.SX(1)},
            derivatives={"x": u},
            outputs={"x": x},
            step=ca.SX.sym("dt"),
        )


class Turning(SymbolicComponent):
    """x' = cos t: a derivative that depends on time alone."""

    default_rate = Rate("0.1")
    x = Output((), unit="1", doc="sin t")

    def build_model(self):
        x, t = ca.SX.sym("x"), ca.SX.sym("t")
        return Model(
            "turning",
            states={"x": x},
            derivatives={"x": ca.cos(t)},
            outputs={"x": x},
            step=ca.SX.sym("dt"),
            time=t,
        )


class Share(SymbolicComponent):
    """u as a part of a whole, which may be infinite."""

    default_rate = Rate("0.1")

    whole = Parameter(np.inf, infinite=True, doc="what 1 is divided by")
    u = Input((), unit="1", default=1.0, doc="part")
    y = Output((), unit="1", doc="share")

    def build_model(self):
        u, whole = ca.SX.sym("u"), ca.SX.sym("whole")
        return Model(
            "share", inputs={"u": u}, parameters={"whole": whole}, outputs={"y": u / whole}
        )


class Spring(SymbolicComponent):
    """A mass on a spring, forced: continuous states, an input, feedthrough."""

    default_rate = Rate("0.01")

    stiffness = Parameter(4.0, unit="N/m", positive=True, doc="of the spring")
    mass = Parameter(1.5, unit="kg", positive=True, doc="of the body")
    x0 = Parameter(0.3, unit="m", doc="position at t = 0")
    force = Input((), unit="N", default=0.25, doc="on the body")
    x = Output((), unit="m", doc="position")
    acceleration = Output((), unit="m/s^2", doc="of the body")

    def build_model(self):
        x, v, force = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("force")
        k, m, x0 = ca.SX.sym("k"), ca.SX.sym("m"), ca.SX.sym("x0")
        a = (force - k * x) / m
        return Model(
            "spring",
            inputs={"force": force},
            states={"x": x, "v": v},
            parameters={"stiffness": k, "mass": m, "x0": x0},
            derivatives={"x": v, "v": a},
            initial={"x": x0},
            outputs={"x": x, "acceleration": a},
            step=ca.SX.sym("dt"),
        )


class Doubling(SymbolicComponent):
    """Each of three numbers, times two."""

    default_rate = Rate("0.1")

    u = Input((3,), unit="1", default=[0.0, 0.0, 0.0], doc="numbers")
    y = Output((3,), unit="1", doc="times two")

    def build_model(self):
        u = ca.SX.sym("u", 3)
        return Model("doubling", inputs={"u": u}, outputs={"y": 2 * u})
