"""Navigation evaluation: errors against truth, NEES and NIS of the spacecraft filter."""

from __future__ import annotations

from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.cosim.basics.clock import Rate
from terrafix.models.filters.spacecraft import STATE, sar_observation


class NavigationEvaluation(FilterEvaluation):
    """Errors (estimate minus truth), predicted sigma, NEES, and what became of each fix."""

    default_rate = Rate("8.2")
    error_state, observation = STATE, sar_observation()
    called = {"r_e": "position", "v_e": "velocity", "q_mu": "misalignment"}  # noqa: RUF012
