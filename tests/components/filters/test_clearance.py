"""Correction by clearances: a slope tells where it is, a plain tells the height alone."""

import numpy as np
import pytest

import terrafix as tf
from terrafix.components.filters.family import estimate_fields, fix_fields
from terrafix.components.filters.navigator import ClearanceCorrect
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import BundleOutput, MessageOutput, SharedOutput
from terrafix.models.filters.contours import clearance_observation
from terrafix.models.filters.navigator import DRIFTING

STEP = np.radians(3 / 3600)


class Given(Component):
    """A prior 100 m and 10 m wide, a map with a slope to the east, a clearance of 900 m."""

    default_rate = tf.Rate("1", offset="1")
    height = SharedOutput((None, None), unit="m", dtype=np.float32)
    grid = SharedOutput((5,), unit=("rad", "rad", "rad", "rad", "1"))
    prior = BundleOutput(estimate_fields(DRIFTING))
    fix = MessageOutput(fields=fix_fields(clearance_observation(DRIFTING, "flat")))
    slope = tf.Parameter(0.0, doc="rise to the east")
    east = tf.Parameter(0.0, unit="m", doc="of the prior")

    def _initialize_impl(self):
        j = np.arange(-20, 21) * 111319.49 / 3600 * 3  # m along the equator
        self.height = np.tile(100 + self.slope[0] * j, (41, 1)).astype(np.float32)
        self.grid = np.array([-20 * STEP, -20 * STEP, STEP, STEP, 0.0])
        for block in DRIFTING:
            getattr(self.prior, block.name)[...] = 0.0
        self.prior.r_e[:, 1], self.prior.r_e[:, 2] = self.east, -1000.0
        self.prior.q_be[...] = [0, 0, 0, 1]
        variance = np.append([1e4, 1e4, 100.0], np.ones(DRIFTING.size - 3))
        self.prior.P[...] = np.diag(variance)

    def _step_impl(self, t, dt):
        self.fix.publish(t, y=[[880.0]], R=[[[1.0]]], present=[[1.0]])


def corrected(**settings):
    with tf.System("s", duration="1") as system:
        given = system.add(Given(**settings), "given")
        correct = system.add(ClearanceCorrect(earth="flat"), "correct")
        for name in ("height", "grid", "prior", "fix"):
            system.connect(given[name], correct[name])
        system.record("estimate", [correct["estimate"], correct["innovation"]])
    return tf.simulate(system, members=1).dataset


def test_over_a_plain_only_height_is_corrected():
    """Gain P / (P + R) = 100 / 101 of a residual of -20 m."""
    r = corrected()["correct.estimate.r_e"].values[-1, 0]
    assert r == pytest.approx([0.0, 0.0, -1000.0 + 20 * 100 / 101], abs=1e-6)


def test_over_a_slope_the_place_is_corrected():
    """Of 50 %: S = 0.25 * 1e4 + 100 + 1; east by +20 * 0.5 * 1e4 / S, up by -20 * 100 / S."""
    S = 0.25 * 1e4 + 101
    r = corrected(slope=0.5)["correct.estimate.r_e"].values[-1, 0]
    assert r == pytest.approx([0.0, 20 * 5e3 / S, -1000.0 + 20 * 100 / S], abs=2e-3)


def test_an_estimate_that_has_left_the_map_fails():
    with pytest.raises(tf.RunError, match="not finite"):
        corrected(east=5000.0)
