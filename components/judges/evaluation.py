"""Navigation evaluation: errors against truth, NEES and NIS of each system's filter."""

from __future__ import annotations

from typing import Any

from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.components.shared import require_earth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice
from terrafix.cosim.declare.ports import Input
from terrafix.models.filters.contours import clearance_observation, place_observation
from terrafix.models.filters.error_state import Values
from terrafix.models.filters.lake import CONSIDERED, ORBIT, lake_observation
from terrafix.models.filters.navigator import (
    DRIFTING,
    LOCATED,
    NAVIGATOR,
    altimeter_observation,
    gnss_observation,
    shift_observation,
)
from terrafix.models.filters.shore import shore_observation
from terrafix.models.filters.spacecraft import STATE, sar_observation
from terrafix.models.motion.strapdown import EARTHS, level_axes


class NavigationEvaluation(FilterEvaluation):
    """Errors (estimate minus truth), predicted sigma, NEES, and what became of each fix."""

    default_rate = Rate("8.2")
    error_state, observation = STATE, sar_observation()
    called = {"r_e": "position", "v_e": "velocity", "q_mu": "misalignment"}  # noqa: RUF012


class OrbitEvaluation(FilterEvaluation):
    """Errors of an inertial orbit, NEES of the position, and what became of each look at a lake."""

    default_rate = Rate("1/30")
    error_state, observation, judged = ORBIT, lake_observation(ORBIT), ("r",)
    called = {"r": "position", "v": "velocity"}  # noqa: RUF012


class ShoreOrbitEvaluation(OrbitEvaluation):
    """The same of a filter that is corrected by shores seen in part."""

    error_state, observation = ORBIT, shore_observation(ORBIT)


class ConsideredOrbitEvaluation(OrbitEvaluation):
    """The same of a filter that considers errors of camera and catalog, zero if not told."""

    error_state, observation = CONSIDERED, lake_observation(CONSIDERED)

    attitude = Input((3,), unit="rad", frame="c", optional=True, doc="truth: misalignment")
    scale = Input((1,), optional=True, doc="truth: what the catalog's outlines are too small by")
    outline = Input((6,), unit="m", optional=True, doc="truth: of errors of vertices; not known")


_INERTIAL = {
    "r_e": "position",
    "v_e": "velocity",
    "q_be": "attitude",
    "accel_bias_b": "accel_bias",
    "gyro_bias_b": "gyro_bias",
}


class InertialEvaluation(FilterEvaluation):
    """Errors of an aircraft's navigator in north, east and down, NEES, the altimeter's fixes."""

    default_rate = Rate("1")
    error_state = DRIFTING
    observations = {"altimeter": altimeter_observation("wgs84")}  # noqa: RUF012
    called = _INERTIAL
    turned = dict.fromkeys(("r_e", "v_e", "q_be"), ("n", "north", "east", "down"))

    earth = Choice(EARTHS, "wgs84", doc="that of the motion")

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.port_views["r_e"])
        super()._initialize_impl()

    def rotation(self, truth: Values) -> Any:
        """Transformation (3, 3) from e to north, east, down at the true position."""
        return level_axes(truth["r_e"], self.setting("earth"))


class ContourEvaluation(InertialEvaluation):
    """The same where contours of the terrain are matched, too."""

    observations = {  # noqa: RUF012
        **InertialEvaluation.observations,
        "profile": place_observation("wgs84"),
        "contour": clearance_observation(DRIFTING, "wgs84"),
    }


class LocatedEvaluation(InertialEvaluation):
    """The same of a navigator with a GNSS receiver, and where contours are matched, too."""

    error_state = LOCATED
    observations = {  # noqa: RUF012
        **InertialEvaluation.observations,
        "gnss": gnss_observation(),
        "contour": clearance_observation(LOCATED, "wgs84"),
    }


class RadarInertialEvaluation(InertialEvaluation):
    """The same of a navigator with a radar."""

    error_state = NAVIGATOR
    observations = {  # noqa: RUF012
        **InertialEvaluation.observations,
        "radar": shift_observation("wgs84"),
    }


class ImageInertialEvaluation(RadarInertialEvaluation):
    """The same where images are formed: what they are biased by has no truth, and is not judged."""

    judged = (*_INERTIAL, "altimeter_bias")

    range_bias = Input((1,), unit="m", optional=True, doc="truth: none is known")
    cross_range_bias = Input((1,), unit="m", optional=True, doc="truth: none is known")


class RadarContourEvaluation(RadarInertialEvaluation):
    """The same of a navigator with a radar that matches contours of the terrain, too."""

    observations = {  # noqa: RUF012
        **RadarInertialEvaluation.observations,
        "profile": place_observation("wgs84"),
        "contour": clearance_observation(NAVIGATOR, "wgs84"),
    }
