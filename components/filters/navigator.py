"""The navigator of an aircraft: strapdown mechanization, corrected by altimeter and radar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrafix.components.fields import GRID, HEIGHT, XYZ
from terrafix.components.filters.ensembles import EnsembleCorrect
from terrafix.components.filters.family import FilterCorrect, FilterPredict
from terrafix.components.shared import require_earth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, Output, SharedInput
from terrafix.models.core.model import Model
from terrafix.models.filters.contours import clearance_observation, place_observation
from terrafix.models.filters.ensembles import EnsembleObservation
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.navigator import (
    DECAYS,
    DRIFTING,
    LOCATED,
    NAVIGATOR,
    altimeter_observation,
    gnss_observation,
    navigator_process,
    shift_observation,
)
from terrafix.models.filters.process import Process
from terrafix.models.maps.charts import ORIGIN
from terrafix.models.motion.strapdown import EARTHS

_POLE = np.pi / 2
TOLD = ("r_e", "v_e", "q_be")
"""Blocks that are known when navigation begins."""


_SIGMAS = {block: sigma for block, (_, sigma) in DECAYS.items()}


def _sigma(default: float) -> Parameter:
    return Parameter(default, unit="m", minimum=0.0, doc="of the bias, as the filter knows it")


def _time(default: float) -> Parameter:
    return Parameter(default, unit="s", positive=True, doc="correlation of the bias")


class InertialPredict(FilterPredict):
    """Strapdown mechanization between fixes, and the covariance of its error; without a radar.

    Earth-fixed; a `level_view` of its motion shows it in local level terms.
    """

    default_rate = Rate(hz=100)
    error_state, process, told = DRIFTING, navigator_process(DRIFTING, "wgs84"), TOLD
    sigmas = {n: s for n, s in _SIGMAS.items() if n in DRIFTING.places}  # noqa: RUF012

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
    altimeter_bias_sigma = _sigma(0.8)
    altimeter_bias_time = _time(100.0)

    delta_v_b = Input((3,), unit="m/s", frame="b", doc="measured increment, in turning axes")
    delta_theta_b = Input((3,), unit="rad", frame="b", doc="measured increment, in turning axes")
    r_e = Output((3,), unit="m", frame="e", labels=XYZ, doc="position of the prior")
    v_e = Output((3,), unit="m/s", frame="e", labels=XYZ, doc="velocity of the prior")
    q_be = Output((4,), unit="1", frame="b", doc="attitude of the prior, e to body")

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.port_views["start"].r_e)
        super()._initialize_impl()

    def chosen_process(self) -> Process:
        """The process on the chosen Earth."""
        return navigator_process(self.error_state, self.setting("earth"))

    def build_model(self) -> Model:
        """Build the model of the process; the motion of the prior also stands alone."""
        model = super().build_model()
        motion = {name: model.outputs[f"prior.{name}"] for name in TOLD}
        return replace(model, outputs={**model.outputs, **motion})


class RadarInertialPredict(InertialPredict):
    """The same with the biases of a radar, and position and velocity at an aperture's center."""

    error_state, process = NAVIGATOR, navigator_process(NAVIGATOR, "wgs84")
    sigmas = {n: s for n, s in _SIGMAS.items() if n in NAVIGATOR.places}  # noqa: RUF012

    range_bias_sigma = _sigma(0.3)
    range_bias_time = _time(100.0)
    cross_range_bias_sigma = _sigma(0.3)
    cross_range_bias_time = _time(100.0)


class LocatedInertialPredict(InertialPredict):
    """The same with what lasts of the error of a GNSS receiver's positions; without a radar."""

    error_state, process = LOCATED, navigator_process(LOCATED, "wgs84")
    sigmas = {n: s for n, s in _SIGMAS.items() if n in LOCATED.places}  # noqa: RUF012

    gnss_bias_sigma = _sigma(1.5)
    gnss_bias_time = _time(300.0)


class _OnEarth(FilterCorrect):
    """Correction on an Earth that is chosen: base."""

    default_rate = Rate("1", offset="1")

    earth = Choice(EARTHS, "wgs84", doc="that of the filter")

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.port_views["prior"].r_e)
        super()._initialize_impl()


class AltimeterCorrect(_OnEarth):
    """Correction by the height that an altimeter measures; without a radar."""

    error_state, observation = DRIFTING, altimeter_observation("wgs84")

    def chosen_observation(self) -> Observation:
        """What is observed on the chosen Earth."""
        return altimeter_observation(self.setting("earth"))


class RadarAltimeterCorrect(AltimeterCorrect):
    """The same of a navigator with a radar."""

    error_state = NAVIGATOR


class LocatedAltimeterCorrect(AltimeterCorrect):
    """The same of a navigator with a GNSS receiver."""

    error_state = LOCATED


class GnssCorrect(FilterCorrect):
    """Correction by the position and velocity of a GNSS receiver.

    What lasts of its error is a state: the receiver tells the covariance of its white noise
    (`told = "white"`).
    """

    default_rate = Rate("1", offset="1")
    error_state, observation = LOCATED, gnss_observation()


class ShiftCorrect(_OnEarth):
    """Correction by the image of an aperture: range, cross-range, and what map drift reads."""

    error_state, observation = NAVIGATOR, shift_observation("wgs84")

    def chosen_observation(self) -> Observation:
        """What is observed on the chosen Earth."""
        return shift_observation(self.setting("earth"))


class ClearanceCorrect(_OnEarth, EnsembleCorrect):
    """Correction by the clearance over an elevation model: terrain contour matching, in a filter.

    A member whose estimate has left the model, where no ground is known, fails.
    """

    error_state, observation = DRIFTING, clearance_observation(DRIFTING, "wgs84")

    latitude0 = Parameter(0.0, unit="rad", minimum=-_POLE, maximum=_POLE, doc="origin (flat)")
    longitude0 = Parameter(
        0.0, unit="rad", minimum=-2 * np.pi, maximum=2 * np.pi, doc="origin (flat)"
    )
    height = SharedInput(**HEIGHT, doc="heights of the ground")
    grid = SharedInput(**GRID, doc="where they lie")

    def chosen_observation(self) -> EnsembleObservation:
        """What is observed on the chosen Earth."""
        return clearance_observation(self.error_state, self.setting("earth"))

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: an origin has on a flat Earth alone."""
        return super().takes(name) and (name not in ORIGIN or self.setting("earth") == "flat")


class RadarClearanceCorrect(ClearanceCorrect):
    """The same of a navigator with a radar."""

    error_state, observation = NAVIGATOR, clearance_observation(NAVIGATOR, "wgs84")


class LocatedClearanceCorrect(ClearanceCorrect):
    """The same of a navigator with a GNSS receiver."""

    error_state, observation = LOCATED, clearance_observation(LOCATED, "wgs84")


class PlaceCorrect(_OnEarth):
    """Correction by a profile that was matched with an elevation model; without a radar."""

    error_state, observation = DRIFTING, place_observation("wgs84")

    def chosen_observation(self) -> Observation:
        """What is observed on the chosen Earth."""
        return place_observation(self.setting("earth"))


class RadarPlaceCorrect(PlaceCorrect):
    """The same of a navigator with a radar."""

    error_state = NAVIGATOR
