"""Skeleton of system B, aircraft SAR: apertures full of pulses between two images.

Real: IMU at 100 Hz, 1200 pulses a second, images of 1 s apertures, an altimeter of its own rate, a
measurement that refers to the closest approach half a second before it is made, the map-drift
iteration inside the image former, an aperture without an image. Stub: straight flight, ranges in
the place of pulses, fixed gains. The real system replaces the mathematics; windows, times of
validity, the history of the estimate and the queue of altitudes stay.
"""

from fractions import Fraction

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import (
    Input,
    MessageInput,
    MessageOutput,
    Output,
    State,
    WindowInput,
)
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System

IMU, PRF, APERTURE = Rate(hz=100), Rate(hz=1200), Rate(1)
SPEED, RANGE = 70.0, 1562.0  # [m/s], [m]
SHIFT = {"along": Field((), "m"), "speed": Field((), "m/s")}


class Aircraft(Component):
    """Along-track position; every member flies a little faster than the other."""

    default_rate = IMU
    speed = Parameter(SPEED, unit="m/s")
    position = Output(unit="m")
    delta_v = Output(unit="m/s")

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t, dt):
        self.position = self.speed * t
        self.delta_v = 0.0


class Imu(Component):
    default_rate = IMU
    delta_v_true = Input(unit="m/s")
    delta_v = Output(unit="m/s")

    def _step_impl(self, t, dt):
        self.delta_v = self.delta_v_true + 1e-3 * np.sqrt(dt) * self.normals("white", 1)[:, 0]


class Predict(Component):
    default_rate = IMU
    correction = MessageInput(fields=SHIFT, at="start")
    delta_v = Input(unit="m/s")
    prior = Output((2,), unit=("m", "m/s"))
    x = State((2,))

    def _initialize_impl(self):
        self.x = [0.0, SPEED]
        self.prior = self.x

    def _step_impl(self, t, dt):
        fresh = self.correction.fresh
        self.x[:, 0] += np.where(fresh, self.correction.along, 0.0)
        self.x[:, 1] += np.where(fresh, self.correction.speed, 0.0)
        self.x[:, 1] += self.delta_v
        self.x[:, 0] += dt * self.x[:, 1]
        self.prior = self.x


class Radar(Component):
    """One range a pulse to a point that is passed in the middle of each aperture."""

    default_rate = PRF
    position = Input(unit="m")
    speed = Parameter(SPEED, unit="m/s")
    pulse = Output((2,), unit=("s", "m"))

    def _step_impl(self, t, dt):
        middle = np.ceil(t - 1e-9) - 0.5
        along = self.speed * (t - middle)
        self.pulse[:, 0] = t
        self.pulse[:, 1] = np.sqrt(RANGE**2 + along**2)


class ImageFormer(Component):
    """Focuses an aperture: a map-drift iteration finds the speed that explains its curvature."""

    default_rate = APERTURE
    pulses = WindowInput((2,), unit=("s", "m"))
    prior = Input((2,), unit=("m", "m/s"))
    position = Input(unit="m")
    measurement = MessageOutput(fields=SHIFT)

    def __init__(self, **options):
        super().__init__(**options)
        self.apertures = []

    def _step_impl(self, t, dt):
        times, pulses = self.pulses.times, self.pulses.samples
        self.apertures.append((t, len(times), times[0], times[-1]))
        middle = t - 0.5
        speed = self.prior[:, 1].copy()
        for _ in range(3):
            along2 = (pulses[:, :, 0] - middle) ** 2
            excess = pulses[:, :, 1] ** 2 - RANGE**2 - speed[:, None] ** 2 * along2
            speed += (excess * along2).sum(axis=1) / (2 * speed * (along2**2).sum(axis=1))
        noise = self.normals("image", 1)[:, 0]
        along = self.position - speed * 0.5 + 0.01 * noise
        found = (self.environment.members + self.step_index) % 3 != 0
        self.measurement.publish(middle, valid=found, along=along, speed=speed)


class Altimeter(Component):
    default_rate = Rate("0.3")
    altitude = MessageOutput(unit="m")

    def _step_impl(self, t, dt):
        self.altitude.publish(t, 1000.0 + self.normals("noise", 1)[:, 0])


class Correct(Component):
    """Compares the measurement with the estimate that was logged at its time of validity."""

    default_rate = APERTURE
    prior = WindowInput((2,), unit=("m", "m/s"))
    measurement = MessageInput(fields=SHIFT)
    altitude = MessageInput(unit="m", queue=5)
    correction = MessageOutput(fields=SHIFT)
    height = Output(unit="m")

    def __init__(self, **options):
        super().__init__(**options)
        self.used = []

    def _initialize_impl(self):
        self.height = 0.0

    def _step_impl(self, t, dt):
        heights = [record["value"] for record in self.altitude.queued]
        self.height = np.mean(heights, axis=0)
        fresh, validity = self.measurement.fresh, self.measurement.t
        logged = self.prior.times
        index = np.argmin(np.abs(logged - validity[:, None]), axis=1)
        self.used.append((t, logged[index[fresh]].tolist(), len(logged), len(heights)))
        then = self.prior.samples[np.arange(self.n_members), index]
        residual = self.measurement.along - then[:, 0]
        speed = self.measurement.speed - then[:, 1]
        self.correction.publish(validity, valid=fresh, along=residual + 0.5 * speed, speed=speed)


def build():
    with System("aircraft", duration=3) as system:
        parts = {
            "aircraft": Aircraft(),
            "imu": Imu(),
            "predict": Predict(),
            "radar": Radar(),
            "image": ImageFormer(),
            "altimeter": Altimeter(),
            "correct": Correct(),
        }
        for name, part in parts.items():
            system.add(part, name)
        for link in (
            "aircraft.delta_v -> imu.delta_v_true",
            "imu.delta_v -> predict.delta_v",
            "aircraft.position -> radar.position",
            "radar.pulse -> image.pulses",
            "predict.prior -> image.prior",
            "aircraft.position -> image.position",
            "image.measurement -> correct.measurement",
            "predict.prior -> correct.prior",
            "altimeter.altitude -> correct.altitude",
            "correct.correction -> predict.correction",
        ):
            source, target = link.split(" -> ")
            system.connect(source, target)
        system.record("fast", ["predict.prior", "aircraft.position"])
        system.record("slow", ["image.measurement", "correct.correction", "correct.height"])
        system.disperse(Dispersion("speed", ("aircraft.speed", "radar.speed"), 0.5))
    return system


def test_an_aperture_is_the_second_of_pulses_before_the_image():
    system = build()
    simulation = Simulation(system, members=2)
    simulation.run_until(3)
    assert simulation.plan.base == Fraction(1, 1200)
    assert [(t, n) for t, n, *_ in system.nodes["image"].apertures] == [
        (1, 1200),
        (2, 1200),
        (3, 1200),
    ]
    for t, _, first, last in system.nodes["image"].apertures:
        assert (first, last) == ((1200 * (t - 1) + 1) / 1200, t)


def test_the_measurement_is_compared_with_the_estimate_of_the_closest_approach():
    """Half a second before the image: tick-exact, from a history of the second."""
    system = build()
    result = simulate(system, members=2)
    assert system.nodes["correct"].used == [
        (1, [0.5, 0.5], 100, 3),
        (2, [1.5], 100, 3),
        (3, [2.5], 100, 4),
    ]
    validity = result.dataset["image.measurement.t"].values[1:]
    np.testing.assert_array_equal(validity, [[0.5, 0.5], [1.5, np.nan], [np.nan, 2.5]])


def test_map_drift_finds_the_speed_and_the_loop_closes():
    """The iteration is quadratic in the error: 1 % of speed is nothing after three rounds."""
    data = simulate(build(), members=20).dataset
    truth = data["parameter:aircraft.speed"].values
    speed = data["image.measurement.speed"].values
    found = np.isfinite(speed)
    np.testing.assert_allclose(speed[found], np.broadcast_to(truth, speed.shape)[found], rtol=1e-10)
    error = np.abs(data["predict.prior"].values[:, :, 0] - data["aircraft.position"].values)
    corrected = found[1]
    assert error[99][corrected].max() > 0.3  # 0.5 m/s for a second
    assert error[199][corrected].max() < 0.05  # 0.01 m of image noise, 4 sigma, and the IMU
    assert error[199][~corrected].max() > 0.3


def test_the_altitudes_between_two_corrections_are_all_used():
    """0.3 s does not divide 1 s: three or four in each aperture, none lost, none twice."""
    system = build()
    result = simulate(system, members=3)
    assert result.overruns == {}
    assert sum(n for *_, n in system.nodes["correct"].used) == 10
    assert np.abs(result.dataset["correct.height"].values[1:] - 1000).max() < 4


@pytest.mark.parametrize("n", [1, 7, 100])
def test_members_alone_and_together(skeleton, n):
    skeleton.check_determinism(build, members=n, alone=[n // 2])


@pytest.mark.parametrize("every", ["1.55", "0.6475"])
def test_checkpoint_in_the_middle_of_an_aperture(skeleton, tmp_path, every):
    """Pulses, priors and altitudes collected so far are part of the checkpoint."""
    skeleton.check_resume(build, tmp_path, every=every, blow_at=2.6, rate=IMU, members=3)
