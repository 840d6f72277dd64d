"""Matching of profiles as a component: finds, lets pass, begins anew after a refusal."""

import numpy as np
import pytest

import terrafix as tf
from terrafix.components.images.profile import ProfileMatcher
from terrafix.components.sensors.altimeter import RadarAltimeter
from terrafix.components.truth.flight import Flight
from terrafix.components.truth.terrain import Terrain
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output
from terrafix.models.maps.contours import REASONS


class Off(Component):
    """An estimate that is off to the east, nearly (x of e at 84 deg west), by member."""

    default_rate = tf.Rate("1")
    r_true_e = Input((3,), unit="m", frame="e")
    r_e = Output((3,), unit="m", frame="e")
    size = tf.Parameter(300.0, unit="m", doc="sigma")

    def _initialize_impl(self):
        self.shift = self.size[:, None] * self.normals("shift", 3) * [1.0, 0.0, 0.0]
        self.r_e = self.r_true_e + self.shift

    def _step_impl(self, t, dt):
        self.r_e = self.r_true_e + self.shift


def build(duration="70", size=300.0):
    start = {"latitude": np.radians(36.22), "longitude": np.radians(-84.25)}
    with tf.System("s", duration=duration, seed=3) as system:
        truth = system.add(Flight(height=1500.0, **start), "flight")
        ground = system.add(Terrain(source="jacksboro"), "terrain")
        sensor = system.add(RadarAltimeter(), "radar_altimeter")
        estimate = system.add(Off(size=size), "estimate")
        matcher = system.add(ProfileMatcher(), "matcher")
        system.connect(truth["r_e"], sensor["r_e"])
        system.connect(truth["r_e"], estimate["r_true_e"])
        system.connect(estimate["r_e"], matcher["r_e"])
        system.connect(sensor["fix"], matcher["fix"])
        for name in ("height", "grid"):
            system.connect(ground[name], sensor[name])
            system.connect(ground[name], matcher[name])
        system.record("matcher", [matcher[n] for n in ("place", "clearance", "reason")])
        system.record("estimate", [estimate["r_e"]], period="1")
        system.record("truth", [truth["r_e"]], period="1")
    return system


def test_members_are_found_after_a_profile_and_their_clearances_pass_from_then_on():
    data = tf.simulate(build(), members=12).dataset
    y = data["matcher.place.y"].values
    given = np.isfinite(y[..., 0])
    assert given.sum(axis=0).tolist() == [1] * 12
    (k,) = np.flatnonzero(given.any(axis=1))
    passed = np.isfinite(data["matcher.clearance.y"].values[..., 0])
    assert not passed[: k + 1].any()
    assert passed[k + 1 :].all()
    off = np.linalg.norm(y[k], axis=1)
    true = np.linalg.norm(data["estimate.r_e"].values[-1] - data["flight.r_e"].values[-1], axis=1)
    assert np.abs(off - true).max() < 60.0
    assert true.max() > 300.0


def test_a_member_that_is_too_far_off_is_not_found():
    """Kilometers, with a search of one: refused after 60 s and again after 120 s."""
    data = tf.simulate(build("130", size=20_000.0), members=2).dataset
    assert not np.isfinite(data["matcher.place.y"].values).any()
    told = data["matcher.reason"].values
    assert {REASONS[int(r)] for r in told[-1]} <= set(REASONS[1:])


def test_a_member_alone_and_a_run_again_are_the_same(skeleton_free):
    skeleton_free(build)


@pytest.fixture
def skeleton_free():
    def check(make):
        first = tf.simulate(make("65"), members=4).dataset
        alone = tf.simulate(make("65"), members=[2]).dataset
        for name in first.data_vars:
            if "member" in first[name].dims:
                one, other = first[name].sel(member=2).values, alone[name].sel(member=2).values
                assert one.tobytes() == other.tobytes(), name

    return check
