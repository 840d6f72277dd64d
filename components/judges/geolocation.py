"""Errors of a tracked target, and of the satellite that tracks it."""

from __future__ import annotations

from terrafix.components.filters.family import estimate_fields
from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.ports import BundleInput
from terrafix.models.filters.geolocation import EVALUATED, MATCHED, OFFSET, PRINTED, TRACKING


class PrintedTargetEvaluation(FilterEvaluation):
    """Errors of ten states, NEES of the target's place in the frame, what became of each frame."""

    default_rate = Rate("1")
    error_state, observation, judged = PRINTED, OFFSET, ("target",)
    called = {"r": "position", "v": "velocity"}  # noqa: RUF012


class TargetEvaluation(FilterEvaluation):
    """Errors of a filter that has position, velocity and target first; NEES of the target."""

    default_rate = Rate("1")
    error_state, observation, judged = EVALUATED, MATCHED, ("target",)
    called = {"r": "position", "v": "velocity"}  # noqa: RUF012

    estimate = BundleInput(estimate_fields(TRACKING), doc="to be evaluated")
