"""Skeleton of system A, spacecraft SAR: the estimate forms the image that corrects it.

Real: 100 Hz truth, attitude, IMU and prediction; images, fixes and corrections every 8.2 s from
8.2 s on; the split of the filter in `predict` and `correct`; echo by reference; fixes that fail to
appear; recorded orbit and echo on the same ports; a member that fails. Stub: a mass on a line in
the place of the orbit, a fixed gain in the place of the filter's, a patch of numbers in the place
of the image. The real system replaces the mathematics and touches no link.
"""

import casadi as ca
import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    BundleOutput,
    Input,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    SharedOutput,
    State,
)
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.system.check import check
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.models.core.model import Model

FAST, SLOW = Rate(hz=100), Rate("8.2", offset="8.2")
PRIOR = {"r": Field((3,), "m", "e"), "v": Field((3,), "m/s", "e"), "t": Field((), "s")}
FIX = {"y": Field((3,), "m", "e"), "sharpness": Field()}
GAIN = 0.5
ACCELERATION = np.array([1.0, -2.0, 0.5])


def orbit_model():
    r, v, r0, v0 = (ca.SX.sym(n, 3) for n in ("r", "v", "r0", "v0"))
    dt = ca.SX.sym("dt")
    a = ca.DM(ACCELERATION)
    return Model(
        "orbit",
        states={"r": r, "v": v},
        parameters={"r0": r0, "v0": v0},
        step=dt,
        initial={"r": r0, "v": v0},
        derivatives={"r": v, "v": a},
        outputs={"r_e": r, "delta_v": a * dt},
    )


class Orbit(SymbolicComponent):
    default_rate = FAST
    r0 = Parameter([7e6, 0, 0], shape=(3,), unit="m")
    v0 = Parameter([0, 7500.0, 0], shape=(3,), unit="m/s")
    r_e = Output((3,), unit="m", frame="e")
    delta_v = Output((3,), unit="m/s", frame="e")

    def build_model(self):
        return orbit_model()


class RecordedOrbit(Component):
    """A table of positions in the place of the simulated truth, on the same ports."""

    default_rate = FAST
    r_e = Output((3,), unit="m", frame="e")
    delta_v = Output((3,), unit="m/s", frame="e")

    def _publish(self, t):
        self.r_e = [7e6, 0, 0] + np.array([0, 7500.0, 0]) * t + 0.5 * ACCELERATION * t**2

    def _initialize_impl(self):
        self._publish(0.0)
        self.delta_v = 0.0

    def _step_impl(self, t, dt):
        self._publish(t)
        self.delta_v = ACCELERATION * dt


class Attitude(Component):
    default_rate = FAST
    r_e = Input((3,), unit="m", frame="e")
    q_be = Output((4,))

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t, dt):
        self.q_be[:, :3] = 0.0
        self.q_be[:, 3] = np.linalg.norm(self.r_e, axis=1) > 0


def imu_model():
    dv, n, bias, walk = (ca.SX.sym(s, 3) for s in ("dv", "n", "bias", "walk"))
    sigma, dt = ca.SX.sym("sigma"), ca.SX.sym("dt")
    return Model(
        "imu",
        inputs={"delta_v_true": dv},
        states={"bias": bias},
        noise={"n": n, "walk": walk},
        parameters={"sigma": sigma},
        step=dt,
        next={"bias": bias + 1e-4 * ca.sqrt(dt) * walk},
        outputs={"delta_v": dv + bias * dt + sigma * ca.sqrt(dt) * n},
    )


class Imu(SymbolicComponent):
    default_rate = FAST
    sigma = Parameter(1e-3, unit="m/s^1.5")
    delta_v_true = Input((3,), unit="m/s", frame="e")
    delta_v = Output((3,), unit="m/s", frame="e")

    def build_model(self):
        return imu_model()


class Predict(Component):
    default_rate = FAST
    r0 = Parameter([7e6, 0, 0], shape=(3,), unit="m")
    v0 = Parameter([0, 7500.0, 0], shape=(3,), unit="m/s")
    posterior = MessageInput(fields={"r": PRIOR["r"], "v": PRIOR["v"]}, at="start")
    delta_v = Input((3,), unit="m/s", frame="e")
    prior = BundleOutput(PRIOR)
    r = State((3,), unit="m", frame="e")
    v = State((3,), unit="m/s", frame="e")

    def __init__(self, **options):
        super().__init__(**options)
        self.corrected = []

    def _initialize_impl(self):
        self.r, self.v = self.r0, self.v0
        self._publish(0.0)

    def _step_impl(self, t, dt):
        fresh = self.posterior.fresh[:, None]
        if fresh.any():
            self.corrected.append((t, self.posterior.t.copy(), fresh[:, 0].copy()))
        self.r = np.where(fresh, self.posterior.r, self.r)
        self.v = np.where(fresh, self.posterior.v, self.v)
        self.r += dt * self.v + 0.5 * dt * self.delta_v
        self.v += self.delta_v
        self._publish(t)

    def _publish(self, t):
        self.prior.r, self.prior.v, self.prior.t = self.r, self.v, t


class Echo(Component):
    """The simulated echo: one block for all members, of the truth of member zero."""

    default_rate = SLOW
    r_e = Input((3,), unit="m", frame="e")
    echo = SharedOutput((None, 4), dtype=np.complex64)

    def _step_impl(self, t, dt):
        self.echo = np.full((round(t * 10), 4), t + 1j * 2, dtype=np.complex64)


class RecordedEcho(Component):
    """The same block read from a file (here: a list), on the same ports."""

    default_rate = SLOW
    r_e = Input((3,), unit="m", frame="e")
    echo = SharedOutput((None, 4), dtype=np.complex64)

    def _step_impl(self, t, dt):
        lines, stamp = ((82, 8.2), (164, 16.4))[self.step_index - 1]
        self.echo = np.full((lines, 4), stamp + 2j, dtype=np.complex64)


class ImageFormer(Component):
    """Focuses the echo with the estimate of its own instant, one image per member."""

    default_rate = SLOW
    echo = SharedInput((None, 4), dtype=np.complex64)
    prior = BundleInput(PRIOR)
    q_be = Input((4,))
    image = MessageOutput(fields={"pixels": Field((8, 8)), "r_used": Field((3,), "m", "e")})

    def __init__(self, **options):
        super().__init__(**options)
        self.seen = []

    def _step_impl(self, t, dt):
        self.seen.append((t, float(self.prior.t[0]), self.prior.r.copy(), self.echo))
        level = np.abs(self.echo).sum() * self.q_be[:, 3]
        pixels = level[:, None, None] * np.eye(8) + self.normals("speckle", 64).reshape(-1, 8, 8)
        self.image.publish(t, pixels=pixels, r_used=self.prior.r)


class Matcher(Component):
    """Finds a fix in the image; every fourth time it does not, and once it cannot go on."""

    default_rate = SLOW
    image = MessageInput(fields={"pixels": Field((8, 8)), "r_used": Field((3,), "m", "e")})
    r_e = Input((3,), unit="m", frame="e")
    fix = MessageOutput(fields=FIX)

    def _step_impl(self, t, dt):
        assert self.image.fresh.all()
        assert (self.image.t == t).all()
        y = self.r_e + 5.0 * self.normals("match", 3)
        found = (self.environment.members + self.step_index) % 4 != 0
        self.fix.publish(t, valid=found, y=y, sharpness=self.image.pixels.max(axis=(1, 2)))
        if self.step_index == 2:
            self.fail(self.environment.members == 2, "singular")


class Correct(Component):
    default_rate = SLOW
    prior = BundleInput(PRIOR)
    fix = MessageInput(fields=FIX)
    posterior = MessageOutput(fields={"r": PRIOR["r"], "v": PRIOR["v"]})
    innovation = MessageOutput((3,), unit="m", frame="e")

    def _step_impl(self, t, dt):
        fresh = self.fix.fresh
        residual = self.fix.y - self.prior.r
        self.innovation.publish(t, residual, valid=fresh)
        self.posterior.publish(t, valid=fresh, r=self.prior.r + GAIN * residual, v=self.prior.v)


def build(orbit=Orbit, echo=Echo):
    with System("spacecraft", duration=18) as system:
        parts = {
            "orbit": orbit(),
            "attitude": Attitude(),
            "imu": Imu(),
            "predict": Predict(),
            "echo": echo(),
            "image": ImageFormer(),
            "matcher": Matcher(),
            "correct": Correct(),
        }
        for name, part in parts.items():
            system.add(part, name)
        for link in (
            "orbit.r_e -> attitude.r_e",
            "orbit.delta_v -> imu.delta_v_true",
            "imu.delta_v -> predict.delta_v",
            "correct.posterior -> predict.posterior",
            "orbit.r_e -> echo.r_e",
            "echo.echo -> image.echo",
            "predict.prior -> image.prior",
            "attitude.q_be -> image.q_be",
            "image.image -> matcher.image",
            "orbit.r_e -> matcher.r_e",
            "matcher.fix -> correct.fix",
            "predict.prior -> correct.prior",
        ):
            source, target = link.split(" -> ")
            system.connect(source, target)
        system.record("fast", ["orbit.r_e", "imu.delta_v", "predict.prior"])
        system.record(
            "slow", ["matcher.fix", "correct.posterior", "correct.innovation", "image.image"]
        )
        system.disperse(Dispersion("initial_position", ("predict.r0",), 1000.0))
    return system


def test_the_loop_from_estimate_to_image_to_fix_is_none_within_a_tick():
    order = check(build()).order
    chain = ["orbit", "imu", "predict", "image", "matcher", "correct"]
    assert sorted(chain, key=order.index) == chain


def test_the_image_is_formed_with_the_estimate_of_its_own_instant():
    """Before the fix, at the tick of the fix: an estimate 8.2 s old would be 60 km away."""
    system = build()
    result = simulate(system, members=3)
    image = system.nodes["image"]
    assert [(t, seen) for t, seen, *_ in image.seen] == [(8.2, 8.2), (16.4, 16.4)]
    prior = result.dataset["predict.prior.r"].sel(time_fast=[8.2, 16.4]).values
    for (t, _, r, echo), recorded in zip(image.seen, prior, strict=True):
        np.testing.assert_array_equal(r[:2], recorded[:2])
        assert echo.shape == (round(t * 10), 4)


def test_a_fix_acts_on_the_next_step_and_where_it_came():
    system = build()
    simulate(system, members=3)
    (t1, validity1, fresh1), (t2, validity2, fresh2) = system.nodes["predict"].corrected
    assert (t1, t2) == (8.21, 16.41)
    assert fresh1.tolist() == [True, True, True]
    assert fresh2.tolist() == [True, True, False]  # 2 + 2 is the fourth, and it failed there
    assert validity1.tolist() == [8.2] * 3
    assert validity2.tolist() == [16.4, 16.4, 8.2]


def test_predictions_are_those_of_an_independent_loop_over_the_recorded_data():
    """Straight-line code over recorded increments and posteriors gives the recorded priors."""
    system = build()
    data = simulate(system, members=[0, 3]).dataset
    increments = data["imu.delta_v"].values
    prior_r = data["predict.prior.r"].values
    posterior = {round(t * 100): k for k, t in enumerate(data["time_slow"].values)}
    r, v = prior_r[0].copy(), np.broadcast_to([0, 7500.0, 0], (2, 3)).copy()
    for tick in range(1, len(prior_r)):
        k = posterior.get(tick - 1)
        if k is not None:
            for name, x in (("r", r), ("v", v)):
                value = data[f"correct.posterior.{name}"].values[k]
                x[...] = np.where(np.isnan(value), x, value)
        r += 0.01 * v + 0.5 * 0.01 * increments[tick]
        v += increments[tick]
        assert r.tobytes() == prior_r[tick].tobytes()
    fixes = data["matcher.fix.t"].values
    assert np.isnan(fixes).tolist() == [[False, True], [False, False]]  # 3 + 1 is the fourth
    innovation = np.linalg.norm(data["correct.innovation"].values, axis=2)
    assert innovation[1, 0] < 0.7 * innovation[0, 0]  # half of it was corrected


def test_a_recorded_echo_takes_the_place_of_the_simulated_one(skeleton):
    one, other = (simulate(build(echo=e), members=4).dataset for e in (Echo, RecordedEcho))
    assert skeleton.payload(one) == skeleton.payload(other)


def test_a_recorded_orbit_takes_the_place_of_the_simulated_one():
    """The same path to rounding; everything that draws noise draws the same."""
    one, other = (simulate(build(orbit=o), members=4).dataset for o in (Orbit, RecordedOrbit))
    # 1800 roundings of 1e-9 m, the spacing of floats at 7e6 m
    np.testing.assert_allclose(one["orbit.r_e"].values, other["orbit.r_e"].values, atol=2e-6)
    np.testing.assert_allclose(
        one["matcher.fix.y"].values, other["matcher.fix.y"].values, atol=2e-6
    )


def test_a_failing_member_leaves_the_others_alone(skeleton):
    result = simulate(build(), members=4)
    assert result.excluded == [
        {"member": 2, "component": "matcher", "t_s": 16.4, "reason": "singular"}
    ]
    without = simulate(build(), members=[0, 1, 3]).dataset
    for member in (0, 1, 3):
        assert skeleton.columns(without, member) == skeleton.columns(result.dataset, member)
    assert np.isnan(result.dataset["predict.prior.r"].sel(member=2).values[1640:]).all()


@pytest.mark.parametrize("n", [1, 7, 100])
def test_members_alone_and_together(skeleton, n):
    skeleton.check_determinism(build, members=n, alone=[n // 2])


def test_checkpoint_and_resume(skeleton, tmp_path):
    """Between two fixes, after a member failed."""
    skeleton.check_resume(build, tmp_path, every="4.7", blow_at=17, rate=FAST, members=4)


def test_nobody_sees_a_fix_before_the_first():
    simulation = Simulation(build(), members=2)
    simulation.run_until("8.19")
    assert np.isnan(simulation.system.nodes["correct"].fix.y).all()
    assert simulation.system.nodes["predict"].corrected == []
