"""Tracks through samples: derivatives of a closed form, and what is no track."""

import numpy as np
import pytest

from terrafix.models.motion.arc import seen_at
from terrafix.models.motion.sampled import SampledArc


def test_a_track_of_a_closed_form_and_its_derivatives():
    """At 100 Hz, 1 m at 2 Hz: a quintic spline errs by the sixth power of the step, 4e-8 m."""
    t = np.arange(0, 3, 0.01)
    w = 2 * np.pi * 2.0
    arc = SampledArc(t, np.stack([70 * t, np.sin(w * t), 0 * t], axis=1))
    s = np.linspace(0.5, 2.5, 77)
    np.testing.assert_allclose(arc.position(s)[:, 1], np.sin(w * s), rtol=0, atol=1e-7)
    np.testing.assert_allclose(arc.velocity(s)[:, 1], w * np.cos(w * s), rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        arc.derivative(s, 2)[:, 1], -w * w * np.sin(w * s), rtol=0, atol=1e-3
    )


def test_a_point_is_seen_from_a_track_as_from_an_orbit():
    t = np.arange(0, 4, 0.05)
    arc = SampledArc(t, np.stack([70 * t, 0 * t, 0 * t - 1000.0], axis=1))
    time, R = seen_at(arc, np.array([140.0, 1200.0, 0.0]), 0.0, 0.0312)
    assert time == pytest.approx(2.0)
    assert pytest.approx(np.hypot(1000.0, 1200.0)) == R


def test_far_from_the_origin_a_point_is_seen_at_the_same_time():
    """6,378 km away, as Earth-fixed places are: to 1e-9 s, 0.1 um of the track."""
    t = np.arange(-2, 2, 0.02)
    r = np.outer(t, [0.0, 0.0, 70.0])
    p, away = np.array([-1000.0, 1200.0, 35.0]), np.array([6378137.0, 0.0, 0.0])
    near, far = (seen_at(SampledArc(t, r + d), p + d, 0.0, 0.03)[0] for d in (0.0 * away, away))
    assert near == pytest.approx(0.5, abs=1e-12)
    assert far == pytest.approx(0.5, abs=1e-9)


def test_what_is_no_track_is_refused():
    t = np.arange(10.0)
    r = np.zeros((10, 3))
    with pytest.raises(ValueError, match=r"times of a track run backward: 3\.000000 s comes"):
        SampledArc(np.array([0, 1, 2, 4, 5, 3, 6, 7, 8, 9.0]), r)
    with pytest.raises(ValueError, match="6 times at least"):
        SampledArc(t[:4], r[:4])
    with pytest.raises(ValueError, match="is not finite"):
        SampledArc(t, r + np.inf)
    with pytest.raises(ValueError, match=r"covers 0\.000 to 9\.000 s, asked for 9\.500"):
        SampledArc(t, r).position(9.5)
