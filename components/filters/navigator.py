"""The navigator of an aircraft: strapdown mechanization, corrected by altimeter and radar."""

from __future__ import annotations

from terrafix.components.filters.family import FilterCorrect, FilterPredict
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.navigator import (
    DECAYS,
    NAVIGATOR,
    altimeter_observation,
    navigator_process,
    shift_observation,
)
from terrafix.models.filters.process import Process
from terrafix.models.motion.strapdown import EARTHS

TOLD = ("r_e", "v_e", "q_be")
"""Blocks that are known when navigation begins."""


def _sigma(default: float, unit: str) -> Parameter:
    return Parameter(default, unit=unit, minimum=0.0, doc="of the bias, as the filter knows it")


def _time(default: float) -> Parameter:
    return Parameter(default, unit="s", positive=True, doc="correlation of the bias")


class InertialPredict(FilterPredict):
    """Strapdown mechanization between fixes, and the covariance of its error.

    Earth-fixed; `level_view` shows it in local level terms.
    """

    default_rate = Rate(hz=100)
    error_state, process, told = NAVIGATOR, navigator_process("wgs84"), TOLD
    sigmas = {block: sigma for block, (_, sigma) in DECAYS.items()}  # noqa: RUF012

    earth = Choice(EARTHS, "wgs84", doc="the real one, or flat and at rest")
    velocity_random_walk = Parameter(
        unit="m/s/s^0.5", minimum=0.0, doc="white noise of the accelerometers"
    )
    angle_random_walk = Parameter(
        unit="rad/s^0.5", minimum=0.0, doc="white noise of the gyroscopes"
    )
    accel_bias_sigma = Parameter(unit="m/s^2", minimum=0.0, doc="as the filter knows it")
    accel_bias_time = _time(3600.0)
    gyro_bias_sigma = Parameter(unit="rad/s", minimum=0.0, doc="as the filter knows it")
    gyro_bias_time = _time(3600.0)
    altimeter_bias_sigma = _sigma(0.8, "m")
    altimeter_bias_time = _time(100.0)
    range_bias_sigma = _sigma(0.3, "m")
    range_bias_time = _time(100.0)
    cross_range_bias_sigma = _sigma(0.3, "m")
    cross_range_bias_time = _time(100.0)

    delta_v_b = Input((3,), unit="m/s", frame="b", doc="measured increment, in turning axes")
    delta_theta_b = Input((3,), unit="rad", frame="b", doc="measured increment, in turning axes")

    def chosen_process(self) -> Process:
        """The process on the chosen Earth."""
        return navigator_process(self.setting("earth"))


class AltimeterCorrect(FilterCorrect):
    """Correction by the height that an altimeter measures."""

    default_rate = Rate(hz=10, offset="0.1")
    error_state, observation = NAVIGATOR, altimeter_observation("wgs84")

    earth = Choice(EARTHS, "wgs84", doc="that of the filter")

    def chosen_observation(self) -> Observation:
        """What is observed on the chosen Earth."""
        return altimeter_observation(self.setting("earth"))


class ShiftCorrect(FilterCorrect):
    """Correction by the image of an aperture: range, cross-range, and what map drift reads."""

    default_rate = Rate(hz=10, offset="0.1")
    error_state, observation = NAVIGATOR, shift_observation("wgs84")

    earth = Choice(EARTHS, "wgs84", doc="that of the filter")

    def chosen_observation(self) -> Observation:
        """What is observed on the chosen Earth."""
        return shift_observation(self.setting("earth"))
