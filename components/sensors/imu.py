"""Strapdown inertial sensor."""

from __future__ import annotations

from terrafix.components.fields import XYZ
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.models.core.model import Model
from terrafix.models.sensors.imu import BIASES, imu_model


class Imu(NoisyComponent):
    """Velocity and angle increments with scale factor, wandering bias and white noise."""

    default_rate = Rate(hz=100)

    bias = Choice(BIASES, "walk", doc="process of the biases")
    velocity_random_walk = Parameter(0.0, unit="m/s/s^0.5", minimum=0.0, doc="white noise")
    accel_bias_sigma0 = Parameter(0.0, unit="m/s^2", minimum=0.0, doc="bias drawn at the start")
    accel_bias_walk = Parameter(
        0.0, unit="m/s^2/s^0.5", minimum=0.0, doc="drive of the bias (gauss-markov: 0 keeps sigma0)"
    )
    accel_scale_factor = Parameter(0.0, doc="scale factor error")
    accel_bias_time = Parameter(3600.0, unit="s", positive=True, doc="correlation (gauss-markov)")
    angle_random_walk = Parameter(0.0, unit="rad/s^0.5", minimum=0.0, doc="white noise")
    gyro_bias_sigma0 = Parameter(0.0, unit="rad/s", minimum=0.0, doc="bias drawn at the start")
    gyro_bias_walk = Parameter(
        0.0, unit="rad/s/s^0.5", minimum=0.0, doc="drive of the bias (gauss-markov: 0 keeps sigma0)"
    )
    gyro_scale_factor = Parameter(0.0, doc="scale factor error")
    gyro_bias_time = Parameter(3600.0, unit="s", positive=True, doc="correlation (gauss-markov)")

    delta_v_b_true = Input((3,), unit="m/s", frame="b", doc="true velocity increment")
    delta_theta_b_true = Input((3,), unit="rad", frame="b", doc="true rotation increment")
    delta_v_b = Output((3,), unit="m/s", frame="b", labels=XYZ, doc="measured increment")
    delta_theta_b = Output((3,), unit="rad", frame="b", labels=XYZ, doc="measured increment")
    accel_bias_b = Output((3,), unit="m/s^2", frame="b", labels=XYZ, doc="true bias")
    gyro_bias_b = Output((3,), unit="rad/s", frame="b", labels=XYZ, doc="true bias")

    def build_model(self) -> Model:
        """Build the model for the chosen bias process."""
        return imu_model(self.bias)
