"""Attitude: the true one, level along the orbit, and what an attitude determination system says."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.components.fields import XYZ
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.attitude import (
    VELOCITIES,
    attitude_sensor_model,
    level_is_defined,
    lvlh_attitude_model,
)


class LvlhAttitude(SymbolicComponent):
    """Level attitude along the velocity, and what an ideal inertial sensor would measure.

    Body axes: x forward, y right, z to the center of the Earth. Following the Earth-fixed
    velocity steers the body in yaw so that a side-looking radar sees no squint.
    """

    default_rate = Rate(hz=100)

    velocity = Choice(VELOCITIES, "earth-fixed", doc="velocity that the x axis follows")
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation")

    r_e = Input((3,), unit="m", frame="e", doc="position")
    v_e = Input((3,), unit="m/s", frame="e", doc="velocity relative to the Earth")
    delta_v_e = Input(
        (3,), unit="m/s", frame="e", default=0.0, doc="non-gravitational velocity increment"
    )
    q_be = Output((4,), unit="1", frame="b", doc="attitude, Earth-fixed to body")
    delta_v_b = Output((3,), unit="m/s", frame="b", labels=XYZ, doc="velocity increment sensed")
    delta_theta_b = Output(
        (3,), unit="rad", frame="b", labels=XYZ, doc="rotation increment relative to inertial space"
    )

    def fail(self, mask: ArrayLike, reason: str) -> None:
        """Exclude members, with what the geometry says is the reason."""
        mask = np.asarray(mask, np.bool_)
        r, u = self.r_e, self.v_e
        known = mask & np.isfinite(r).all(axis=1) & np.isfinite(u).all(axis=1)
        if self.velocity == "inertial":
            u = u + np.cross([0.0, 0.0, 1.0], r) * self.rotation_rate[:, None]
        level = level_is_defined(r, u)
        turned = known & level & (self.step_index > 0)
        super().fail(known & ~level, "level axes are undefined: the velocity is zero or vertical")
        super().fail(turned, "it turned by half a turn in a step: its sign and rate are undefined")
        super().fail(mask & ~(known & ~level) & ~turned, reason)

    def build_model(self) -> Model:
        """Build the model for the chosen velocity."""
        return lvlh_attitude_model(self.velocity)


class AttitudeSensor(NoisyComponent):
    """Attitude determination system: the true attitude with white noise and a constant bias."""

    default_rate = Rate(hz=100)

    noise_sigma = Parameter(0.0, unit="rad", minimum=0.0, doc="white noise per sample and axis")
    bias_sigma = Parameter(0.0, unit="rad", minimum=0.0, doc="constant bias per axis, one sigma")

    q_be_true = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")
    q_be = Output((4,), unit="1", frame="b", doc="measured attitude, Earth-fixed to body")

    def build_model(self) -> Model:
        """Build the model."""
        return attitude_sensor_model()
