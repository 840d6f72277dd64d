"""Strapdown inertial sensor."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.components.fields import XYZ
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.models.core.model import Model
from terrafix.models.sensors.grades import GRADES
from terrafix.models.sensors.imu import BIASES, imu_model
from terrafix.models.sensors.imu_full import full_imu_model

SIMPLE, CUSTOM = "simple", "custom"
_MOST_SKEWED = 1e6
"""Condition number of scale and axes from which they count as singular."""


def _sigma(unit: str, doc: str, shape: tuple[int, ...] = (3,)) -> Parameter:
    """Declare a number of each axis, or one for all of them, from zero on."""
    return Parameter(np.zeros(shape).tolist(), shape=shape, unit=unit, minimum=0.0, doc=doc)


def _time(default: float, doc: str) -> Parameter:
    return Parameter(default, unit="s", positive=True, doc=doc)


class Imu(NoisyComponent):
    """Velocity and angle increments with scale factor, wandering bias and white noise.

    With a grade, every error that a data sheet names: bias instability, errors of scale and axes
    drawn once for each member, nonlinearity, g-sensitivity, full range, quantization, time and
    lever arm. A named grade gives what its sheet says; what is set by hand stands before it.
    A zero leaves its term out, and costs nothing.
    """

    default_rate = Rate(hz=100)

    bias = Choice(BIASES, "walk", doc="process of the biases")
    velocity_random_walk = _sigma("m/s/s^0.5", "white noise")
    accel_bias_sigma0 = _sigma("m/s^2", "bias drawn at the start (repeatability)")
    accel_bias_walk = _sigma("m/s^2/s^0.5", "drive of the bias (gauss-markov: 0 keeps sigma0)")
    accel_bias_sigma = _sigma("m/s^2", "of the correlated part (both)")
    accel_bias_time = _time(3600.0, "correlation (gauss-markov, both)")
    accel_bias_instability = _sigma("m/s^2", "floor of the Allan deviation (0.664 B)")
    accel_bias_instability_time = _time(100.0, "around twice of it the floor is flat")
    accel_scale_factor = Parameter([0.0] * 3, shape=(3,), doc="scale factor error, fixed")
    accel_scale_factor_sigma = _sigma("1", "scale factor error drawn at the start")
    accel_nonlinearity = Parameter([0.0] * 3, shape=(3,), doc="scale factor error at full range")
    accel_quadratic = Parameter([0.0] * 3, shape=(3,), unit="s^2/m", doc="K2, per m/s^2")
    accel_misalignment = Parameter(
        [[0.0] * 3] * 3, shape=(3, 3), unit="rad", doc="lean of each sensor (row) to each axis"
    )
    accel_misalignment_sigma = _sigma("rad", "of each lean, drawn at the start", ())
    accel_range = _sigma("m/s^2", "full range; 0: without end")
    accel_quantum = _sigma("m/s", "of the increments; 0: none")
    angle_random_walk = _sigma("rad/s^0.5", "white noise")
    gyro_bias_sigma0 = _sigma("rad/s", "bias drawn at the start (repeatability)")
    gyro_bias_walk = _sigma("rad/s/s^0.5", "drive of the bias (gauss-markov: 0 keeps sigma0)")
    gyro_bias_sigma = _sigma("rad/s", "of the correlated part (both)")
    gyro_bias_time = _time(3600.0, "correlation (gauss-markov, both)")
    gyro_bias_instability = _sigma("rad/s", "floor of the Allan deviation (0.664 B)")
    gyro_bias_instability_time = _time(100.0, "around twice of it the floor is flat")
    gyro_scale_factor = Parameter([0.0] * 3, shape=(3,), doc="scale factor error, fixed")
    gyro_scale_factor_sigma = _sigma("1", "scale factor error drawn at the start")
    gyro_nonlinearity = Parameter([0.0] * 3, shape=(3,), doc="scale factor error at full range")
    gyro_misalignment = Parameter(
        [[0.0] * 3] * 3, shape=(3, 3), unit="rad", doc="lean of each sensor (row) to each axis"
    )
    gyro_misalignment_sigma = _sigma("rad", "of each lean, drawn at the start", ())
    gyro_g_sensitivity = Parameter(
        [[0.0] * 3] * 3, shape=(3, 3), unit="rad*s/m", doc="rate (row) by specific force"
    )
    gyro_g_sensitivity_sigma = _sigma("rad*s/m", "of each element, drawn at the start", ())
    gyro_range = _sigma("rad/s", "full range; 0: without end")
    gyro_quantum = _sigma("rad", "of the increments; 0: none")
    time_jitter = _sigma("s", "of the end of each interval", ())
    latency = _sigma("s", "of the interval, not told by a time tag", ())
    lever_arm_b = Parameter(
        [0.0] * 3, shape=(3,), unit="m", frame="b", doc="from the point flown to the sensor"
    )
    # the last to be read: it fills what stands at its default
    grade = Choice(
        (SIMPLE, CUSTOM, *GRADES),
        SIMPLE,
        doc="simple: white noise, bias and scale factor; custom: every error; or a data sheet's",
    )

    delta_v_b_true = Input((3,), unit="m/s", frame="b", doc="true velocity increment")
    delta_theta_b_true = Input((3,), unit="rad", frame="b", doc="true rotation increment")
    delta_v_b = Output((3,), unit="m/s", frame="b", labels=XYZ, doc="measured increment")
    delta_theta_b = Output((3,), unit="rad", frame="b", labels=XYZ, doc="measured increment")
    accel_bias_b = Output((3,), unit="m/s^2", frame="b", labels=XYZ, doc="true bias")
    gyro_bias_b = Output((3,), unit="rad/s", frame="b", labels=XYZ, doc="true bias")
    saturated = Output(
        (6,),
        unit="1",
        labels=tuple(f"{kind}_{axis}" for kind in ("accel", "gyro") for axis in XYZ),
        doc="1 where an axis is at its full range",
    )

    def build_model(self) -> Model:
        """Build the model for the chosen bias process, simple or with every error."""
        return imu_model(self.bias) if self.grade == SIMPLE else full_imu_model(self.bias)

    # ------------------------------------------------------------------ grades

    def set_parameter(self, name: str, value: object, *, bare: bool = True) -> None:
        """Set a parameter; a grade sets what was not set by hand."""
        super().set_parameter(name, value, bare=bare)
        if name != "grade":
            self._by_hand = self._by_hand | {name}
            return
        for other, setting in self.settings().items():
            if other != "grade" and other not in self._by_hand:
                given = setting.read(self._standard(other), where=f"{self.grade} '{other}'")
                self.parameter_values[other] = self.given_parameters[other] = given

    _by_hand: frozenset[str] = frozenset()

    def _standard(self, name: str) -> object:
        """What a setting is where it is not set by hand: its grade's, or its default."""
        grade = GRADES.get(self.given_parameters.get("grade", SIMPLE))
        default = self.settings()[name].default
        return default if grade is None else grade.values.get(name, default)

    def is_default(self, name: str) -> bool:
        """Whether a parameter stands as its declaration, or its grade, has it."""
        if name == "grade" or name not in self.given_parameters:
            return super().is_default(name)
        standard = self.settings()[name].read(self._standard(name), where=f"default of '{name}'")
        return bool(np.all(np.asarray(self.given_parameters[name] == standard)))

    # ------------------------------------------------------------------ model and checks

    @property
    def model(self) -> Any:
        """The model, without what is zero for every member.

        In a linear analysis without quantization: it has no derivative, and an error within half a
        quantum that does not grow.
        """
        if self.lent is None or not self.lent.quiet or self.grade == SIMPLE:
            return super().model
        return self.model_without(("accel_quantum", "gyro_quantum"))

    def vanishes(self, parameter: Parameter) -> bool:
        """Whether a parameter leaves the model where it is zero for every member: all do."""
        return not parameter.positive

    def validate(self) -> None:
        """Check axes, full ranges, and times against the step."""
        super().validate()
        if self.setting("grade") == SIMPLE:
            return
        for kind in ("accel", "gyro"):
            self._check_axes(kind)
            curved = self.setting(f"{kind}_nonlinearity") != 0.0
            if np.any(curved & (self.setting(f"{kind}_range") == 0.0)):
                raise ConfigurationError(
                    f"'{self.name}' has a {kind}_nonlinearity, which is the error of scale at full "
                    f"range, but no {kind}_range\n  set {kind}_range"
                )
        period = self.rate.period if self.rate is not None else None
        for name in ("latency", "time_jitter"):
            if period is not None and self.setting(name) > float(period):
                raise ConfigurationError(
                    f"'{self.name}.{name}' is {float(self.setting(name)):g} s, more than a step of "
                    f"{float(period):g} s\n  delay its connections by whole steps, and set the rest"
                )

    def _check_axes(self, kind: str) -> None:
        lean, scale = self.setting(f"{kind}_misalignment"), self.setting(f"{kind}_scale_factor")
        if np.diagonal(lean).any():
            raise ConfigurationError(
                f"'{self.name}.{kind}_misalignment' has {np.diagonal(lean).tolist()} on its "
                f"diagonal\n  it holds angles between axes; scale belongs to {kind}_scale_factor"
            )
        axes = np.eye(3) + lean + np.diag(scale)
        if np.linalg.cond(axes) > _MOST_SKEWED:
            raise ConfigurationError(
                f"'{self.name}' cannot tell its axes apart: 1 + {kind}_scale_factor + "
                f"{kind}_misalignment is {axes.tolist()}, singular\n"
                "  angles are small, in rad; write 1 mrad as 0.001"
            )
