"""Skeleton of system C, lake coastline: two filters on the same frames of a 30 Hz camera.

Real: 30 Hz (1/30 s is no decimal number), 7 s, a 320 x 256 frame, contours of up to 256 vertices
clipped to the frame and then out of it, absent messages, the outline by reference, one dispersion
for both filters, first frame at t = 0. Stub: a camera that drifts over a plane, a mean of vertices
in the place of moments and their Jacobians. The real system replaces the mathematics.
"""

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.evaluation import Evaluation, Quantity
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import (
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
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System

FRAME = np.array([320.0, 256.0])  # [px]
CAPACITY = 256
VELOCITY = np.array([40.0, 0.0])  # of the lake in the frame [px/s]
CAMERA = Rate("1/30")


class Lake(Component):
    """The outline, published once: a component that is initialized and never steps."""

    default_rate = Rate(times=[0])
    outline = SharedOutput((None, 2))

    def _initialize_impl(self):
        angle = 2 * np.pi * np.arange(195) / 195
        self.vertices = np.stack([80 * np.cos(angle), 15 * np.sin(angle)], axis=1)
        self.outline = self.vertices


class Truth(Component):
    default_rate = CAMERA
    start = Parameter([100.0, 128.0], shape=(2,), unit="px")
    center = Output((2,), unit="px")

    def _initialize_impl(self):
        self.center = self.start

    def _step_impl(self, t, dt):
        self.center = self.start + VELOCITY * t


class Camera(Component):
    """The visible part of the outline, with noise on every vertex; no message without a vertex."""

    default_rate = CAMERA
    outline = SharedInput((None, 2))
    center = Input((2,), unit="px")
    contour = MessageOutput((CAPACITY, 2), unit="px", ragged=True)

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t, dt):
        n = len(self.outline)
        noise = 0.25 * self.normals("vertices", 2 * n).reshape(self.n_members, n, 2)
        vertices = self.center[:, None, :] + self.outline + noise
        visible = ((vertices >= 0) & (vertices < FRAME)).all(axis=2)
        count = visible.sum(axis=1)
        clipped = np.full((self.n_members, CAPACITY, 2), np.nan)
        for m in range(self.n_members):
            clipped[m, : count[m]] = vertices[m, visible[m]]
        self.contour.publish(t, clipped, count=count, valid=count > 0)


class Filter(Component):
    """A fixed-gain filter of the center; whole contours only."""

    default_rate = CAMERA
    kind = Choice(["ekf", "ukf"])
    r0 = Parameter([100.0, 128.0], shape=(2,), unit="px")
    contour = MessageInput((CAPACITY, 2), unit="px", ragged=True)
    estimate = Output((2,), unit="px")
    used = Output(dtype=np.int64)
    x = State((2,), unit="px")

    def __init__(self, **options):
        super().__init__(**options)
        self.fresh = []

    def _initialize_impl(self):
        self.x = self.r0
        self._update(0.0)

    def _step_impl(self, t, dt):
        self.x += dt * VELOCITY
        self._update(t)

    def _update(self, t):
        self.fresh.append((t, self.contour.fresh.copy(), self.contour.count.copy()))
        gain = 0.2 if self.kind == "ekf" else 0.3
        for m in np.flatnonzero(self.contour.fresh & (self.contour.count == 195)):
            seen = self.contour.value[m, : self.contour.count[m]]
            assert np.isfinite(seen).all()
            self.x[m] += gain * (seen.mean(axis=0) - self.x[m])
        self.used = np.where(self.contour.fresh, self.contour.count, 0)
        self.estimate = self.x


class Error(Evaluation):
    default_rate = CAMERA
    truth = Input((2,), unit="px")
    estimate = Input((2,), unit="px")
    center_error = Output((2,), unit="px")
    center_sigma = Output((2,), unit="px")
    quantities = (Quantity("center", "px", ("u", "v")),)

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t, dt):
        self.center_error = self.estimate - self.truth
        self.center_sigma = 1.0


def build(kinds=("ekf", "ukf"), duration=7):
    with System("lake", duration=duration) as system:
        for name, part in {"lake": Lake(), "truth": Truth(), "camera": Camera()}.items():
            system.add(part, name)
        system.connect("lake.outline", "camera.outline")
        system.connect("truth.center", "camera.center")
        for name, kind in zip(("ekf", "ukf"), kinds, strict=True):
            system.add(Filter(kind=kind), name)
            system.add(Error(), f"{name}_error")
            system.connect("camera.contour", f"{name}.contour")
            system.connect("truth.center", f"{name}_error.truth")
            system.connect(f"{name}.estimate", f"{name}_error.estimate")
        system.record("frames", ["camera.contour", "ekf.estimate", "ukf.estimate", "ekf.used"])
        system.disperse(Dispersion("initial_position", ("ekf.r0", "ukf.r0"), 15.0))
        system.disperse(Dispersion("pass", ("truth.start",), [20.0, 5.0]))
    return system


def test_frames_come_at_exact_thirtieths_of_a_second():
    data = simulate(build(), members=2).dataset
    np.testing.assert_array_equal(data["time"].values, np.arange(211) / 30)


def test_contours_are_ragged_and_then_absent():
    """Whole, then clipped at the edge of the frame, then out of it: no message, and none stale."""
    system = build()
    data = simulate(system, members=20).dataset
    count = data["camera.contour.count"].values
    whole, clipped, absent = count == 195, (count > 0) & (count < 195), count == 0
    assert whole.any(axis=0).all()
    assert clipped.any(axis=0).all()
    assert absent[-1].any()
    assert len(np.unique(count[150])) > 5  # every member its own
    np.testing.assert_array_equal(data["camera.contour.t"].values > -1, ~absent)
    used = np.where(np.isfinite(np.sum(data["camera.contour"].values, axis=3)), 1, 0).sum(axis=2)
    np.testing.assert_array_equal(used, count)
    np.testing.assert_array_equal(data["ekf.used"].values, count)
    for (t, fresh, n), seen in zip(system.nodes["ukf"].fresh, count, strict=True):
        np.testing.assert_array_equal(fresh, seen > 0, err_msg=str(t))
        np.testing.assert_array_equal(n[fresh], seen[fresh])


def test_the_first_frame_is_used_at_t_zero():
    system = build()
    simulation = Simulation(system, members=5)
    simulation.initialize()
    ((t, fresh, _),) = system.nodes["ekf"].fresh
    assert t == 0
    assert fresh.all()
    assert (np.abs(system.nodes["ekf"].x - system.nodes["ekf"].r0).max(axis=1) > 0).any()


def test_both_filters_see_the_same_draws(skeleton):
    """One dispersion, one camera: filters of one kind are one filter, to the last bit."""
    data = simulate(build(kinds=("ekf", "ekf")), members=10).dataset
    assert data["ekf.estimate"].values.tobytes() == data["ukf.estimate"].values.tobytes()
    mixed = simulate(build(), members=10).dataset
    assert mixed["ekf.estimate"].values.tobytes() == data["ekf.estimate"].values.tobytes()
    assert mixed["ukf.estimate"].values.tobytes() != data["ukf.estimate"].values.tobytes()
    draws = (mixed[f"parameter:{k}.r0"].values for k in ("ekf", "ukf"))
    assert len({d.tobytes() for d in draws}) == 1
    system = build()
    simulation = Simulation(system, members=2)
    simulation.initialize()
    views = [system.nodes[k].contour.value for k in ("ekf", "ukf")]
    assert np.shares_memory(*views)  # one contour, not two copies


def test_the_outline_is_one_array_for_all():
    system = build()
    simulation = Simulation(system, members=100)
    simulation.run_until(1)
    assert system.nodes["camera"].outline.base is system.nodes["lake"].vertices


def test_evaluations_of_both_filters_are_reported():
    found = simulate(build(), members=30).evaluation
    assert set(found) == {"ekf_error", "ukf_error"}
    for quantity in found.values():
        # 0.25 px over 195 vertices is 0.018 px a frame; 0.8**60 of the start is left at most
        assert max(quantity["center"]["sigma_sample"]) < 0.05


def build_short():
    return build(duration=2)


@pytest.mark.parametrize("n", [1, 7, 100])
def test_members_alone_and_together(skeleton, n):
    skeleton.check_determinism(build_short, members=n, alone=[n // 2])


def test_checkpoint_and_resume(skeleton, tmp_path):
    """While some members see the lake, some a part of it, some nothing."""
    skeleton.check_resume(build, tmp_path, every="5.05", blow_at=6, rate=CAMERA, members=8)
