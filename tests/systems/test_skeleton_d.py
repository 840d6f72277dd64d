"""Skeleton of system D, image and inertial geolocation: three profiles of one filter.

Real: 1 Hz for 20 minutes, the first frame georeferenced at t = 0, image matches of a pixel offset
and a peak, matches that fail, three profiles (not updated, image-matched, image-corrected) on the
same draws. Stub: a random walk in the place of orbit and attitude, a scalar gain in the place of
the filter's. The real system replaces the mathematics.
"""

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, MessageInput, MessageOutput, Output, State
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System

MATCH = {"offset": Field((2,), "px", labels=("u", "v")), "peak": Field()}
FRAME = Rate(1)
PROFILES = ("none", "matched", "corrected")


class Truth(Component):
    """The offset between the frame expected and the frame seen: a start and a walk."""

    default_rate = FRAME
    start = Parameter([0.0, 0.0], shape=(2,), unit="px")
    offset = Output((2,), unit="px")
    walk = State((2,), unit="px")

    def _initialize_impl(self):
        self.offset = self.start

    def _step_impl(self, t, dt):
        self.walk += 0.4 * np.sqrt(dt) * self.normals("walk", 2)
        self.offset = self.start + self.walk


class Georeference(Component):
    """Matches the first frame against the map, once."""

    default_rate = Rate(times=[0])
    offset = Input((2,), unit="px")
    reference = MessageOutput(fields=MATCH)

    def _initialize_impl(self):
        noise = 0.1 * self.normals("match", 2)
        found = self.environment.members != 3
        self.reference.publish(0.0, valid=found, offset=self.offset + noise, peak=0.9)


class Matcher(Component):
    """Matches every frame against the first one: the change of offset since then."""

    default_rate = FRAME
    offset = Input((2,), unit="px")
    match = MessageOutput(fields=MATCH)
    first = State((2,), unit="px")

    def _initialize_impl(self):
        self.first = self.offset

    def _step_impl(self, t, dt):
        noise = 0.1 * self.normals("match", 2)
        peak = self.uniform_peak()
        self.match.publish(t, valid=peak > 0.3, offset=self.offset - self.first + noise, peak=peak)

    def uniform_peak(self):
        return np.exp(-0.5 * np.abs(self.normals("peak", 1)[:, 0]))


class Profile(Component):
    default_rate = FRAME
    profile = Choice(PROFILES)
    reference = MessageInput(fields=MATCH)
    match = MessageInput(fields=MATCH)
    estimate = Output((2,), unit="px")
    bias = State((2,), unit="px")
    x = State((2,), unit="px")

    def __init__(self, **options):
        super().__init__(**options)
        self.referenced = []
        self.matches = 0

    def _initialize_impl(self):
        self._georeference(0.0)

    def _georeference(self, t):
        fresh = self.reference.fresh[:, None]
        if fresh.any():
            self.referenced.append((t, fresh[:, 0].copy(), self.reference.t.copy()))
            if self.profile == "corrected":
                self.bias = np.where(fresh, self.reference.offset, self.bias)
                self.x = self.bias
        self.estimate = self.x

    def _step_impl(self, t, dt):
        self._georeference(t)
        self.matches += int(self.match.fresh.sum())
        if self.profile != "none":
            fresh = self.match.fresh[:, None]
            residual = self.match.offset + self.bias - self.x
            self.x += np.where(fresh, 0.9 * residual, 0.0)
        self.estimate = self.x

    def _extra_state(self):
        return {"matches": self.matches}

    def _set_extra_state(self, saved):
        self.matches = int(saved["matches"])


def build(duration="20 min"):
    with System("geolocation", duration=duration) as system:
        for name, part in (
            ("truth", Truth()),
            ("georeference", Georeference()),
            ("matcher", Matcher()),
        ):
            system.add(part, name)
        system.connect("truth.offset", "georeference.offset")
        system.connect("truth.offset", "matcher.offset")
        for name in PROFILES:
            system.add(Profile(profile=name), name)
            system.connect("georeference.reference", f"{name}.reference")
            system.connect("matcher.match", f"{name}.match")
        system.record("frames", ["truth.offset", *(f"{p}.estimate" for p in PROFILES)])
        system.record("matches", ["matcher.match"])
        system.disperse(Dispersion("initial_offset", ("truth.start",), 5.47))
    return system


def build_short():
    return build("60 s")


def test_the_first_frame_is_georeferenced_at_t_zero_and_once():
    """Published at initialization, fresh at the initialization of who reads it, and never again."""
    system = build_short()
    simulation = Simulation(system, members=5)
    simulation.initialize()
    for name in PROFILES:
        ((t, fresh, validity),) = system.nodes[name].referenced
        assert t == 0
        assert fresh.tolist() == [True, True, True, False, True]
        assert validity[fresh].tolist() == [0, 0, 0, 0]
    corrected = system.nodes["corrected"]
    error = corrected.estimate - system.nodes["truth"].offset
    assert np.abs(error[corrected.referenced[0][1]]).max() < 0.5  # 0.1 px, 4 sigma and more
    simulation.run_until(60)
    assert all(len(system.nodes[name].referenced) == 1 for name in PROFILES)
    assert simulation.master.wiring.readers["none.reference"].overruns == 0


def test_twenty_minutes_at_one_hertz():
    system = build()
    result = simulate(system, members=5)
    assert result.ticks == 1200
    # truth, matcher and three profiles each step 1200 times; the georeference only starts
    assert result.component_steps == 5 * 1200
    assert result.dataset.sizes["time"] == 1201
    present = int(np.isfinite(result.dataset["matcher.match.t"].values).sum())
    assert 0 < present < 5 * 1200
    assert {system.nodes[p].matches for p in PROFILES} == {present}


def test_three_profiles_of_one_filter_on_the_same_draws():
    """Not updated drifts, matched keeps the first offset, corrected keeps the match error."""
    data = simulate(build(), members=20).dataset
    error = {p: data[f"{p}.estimate"].values - data["truth.offset"].values for p in PROFILES}
    good = np.arange(20) != 3  # was not georeferenced
    rms = {p: np.sqrt((e[600:, good] ** 2).mean()) for p, e in error.items()}
    start = data["truth.offset"].values[0]
    np.testing.assert_allclose(rms["matched"], np.sqrt((start[good] ** 2).mean()), rtol=0.05)
    assert rms["corrected"] < 1.0 < rms["matched"] < rms["none"]
    np.testing.assert_allclose(error["corrected"][:, 3], error["matched"][:, 3], atol=1e-12)


def test_a_profile_alone_sees_what_it_saw_in_company(skeleton):
    """Filters draw nothing, so the number of them changes nobody's draws."""
    alone = build_short()
    for name in ("none", "matched"):
        alone.remove(name)
    alone.records.pop(0)
    alone.record("frames", ["truth.offset", "corrected.estimate"])
    one, three = simulate(alone, members=4).dataset, simulate(build_short(), members=4).dataset
    for name in ("truth.offset", "corrected.estimate"):
        assert one[name].values.tobytes() == three[name].values.tobytes()


def test_fields_of_the_match_are_labeled():
    data = simulate(build_short(), members=2).dataset
    assert data["matcher.match.offset"].dims == ("time", "member", "axis_u_v")
    assert data["matcher.match.offset"].attrs["units"] == "px"
    assert data["matcher.match.peak"].dims == ("time", "member")


@pytest.mark.parametrize("n", [1, 7, 100])
def test_members_alone_and_together(skeleton, n):
    skeleton.check_determinism(build_short, members=n, alone=[n // 2])


def test_checkpoint_and_resume(skeleton, tmp_path):
    """A message of t = 0 is not fresh again after resuming."""
    skeleton.check_resume(build_short, tmp_path, every=25, blow_at=55, rate=FRAME, members=4)
