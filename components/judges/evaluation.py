"""Navigation evaluation: errors against truth, NEES and NIS of the spacecraft filter."""

from __future__ import annotations

from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.ports import Input
from terrafix.models.filters.lake import CONSIDERED, ORBIT, lake_observation
from terrafix.models.filters.shore import shore_observation
from terrafix.models.filters.spacecraft import STATE, sar_observation


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
