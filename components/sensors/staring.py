"""A camera that stares at a target: frames of the scene about it."""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray

from terrafix.components.fields import (
    FIELD,
    FIELD_IMAGE,
    SCENE,
    SCENE_GRID,
    SCENE_PLACE,
    VIEW,
    WINDOW,
    WINDOW_IMAGE,
)
from terrafix.components.shared import require_common
from terrafix.cosim.basics.arrays import FloatArray, Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Count, Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput, SharedInput
from terrafix.models.core.arrays import Single
from terrafix.models.core.parallel import batches, over
from terrafix.models.images.frames import (
    blurred,
    coded,
    frame_to_scene,
    hidden_square,
    inside,
    sampled,
)


class StaringCamera(Component):
    """Frames of a scene: the whole of the first one, and of all others the middle.

    A frame is the scene behind a point spread and the motion during its exposure, with noise, as
    whole codes. What blurs is taken alike for all frames, at the scale of the first one. While the
    target is too far off the nadir, or the camera is turned to other targets, there is none.
    """

    default_rate = Rate("1")

    blur = Parameter(0.5, unit="px", minimum=0.0, doc="standard deviation of the point spread")
    smear = Parameter(
        [0.0, 0.0], shape=(2,), unit="px", doc="motion north and east during an exposure"
    )
    noise = Parameter(4.0, minimum=0.0, doc="standard deviation [codes]")
    bits = Count(8, maximum=16, doc="of the codes; 0: not rounded, not cut off")
    light_rate = Parameter(0.0, unit="1/s", doc="by which the scene gets lighter, of itself")
    turn_rate = Parameter(0.0, unit="rad/s", doc="of the frame about its middle, known to nobody")
    stretch_rate = Parameter(0.0, unit="1/s", doc="of the frame about its middle, known to nobody")
    hidden = Parameter(
        0.0, minimum=0.0, maximum=0.9, doc="share of the middle of a frame that a cloud can hide"
    )
    widest = Parameter(pi / 2, unit="rad", positive=True, doc="largest angle off the nadir")
    stare = Parameter(1.0, unit="s", positive=True, doc="how long it looks, of each cycle")
    cycle = Parameter(0.0, unit="s", minimum=0.0, doc="after which it looks again; 0: always")

    target = Input((2,), unit="px", doc="true place of the target in the frame")
    view = Input(**VIEW, doc="true scale and turn of the frame")
    nominal_view = Input(**VIEW, doc="scale at which the scene is blurred")
    off_nadir = Input(unit="rad", doc="of the line of sight")
    scene = SharedInput(**SCENE, doc="what is on the ground")
    place = SharedInput(**SCENE_PLACE, doc="of the target in it")
    grid = SharedInput(**SCENE_GRID, doc="how it lies")

    frame = MessageOutput(**WINDOW_IMAGE, doc="the middle of a frame, codes")
    first = MessageOutput(**FIELD_IMAGE, doc="the whole first frame, codes")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect."""
        return name != "stare" or bool(np.any(np.asarray(self.setting("cycle")) > 0.0))

    def _initialize_impl(self) -> None:
        require_common(self, "blur", "smear")
        view = self.nominal_view[0]
        onto = self.grid @ np.linalg.inv(view)
        scale = float(np.sqrt(np.abs(np.linalg.det(onto))))
        column, row = (float(x) for x in onto @ self.smear[0])
        self._scene: Single = blurred(self.scene, float(self.blur[0]) * scale, (row, column))
        self._require_view()
        self._look(0.0)

    def _require_view(self) -> None:
        """Fail members that do not see the target at first; raise where none does."""
        blind = self.environment.active & (self.off_nadir > self.widest)
        if blind.any() and blind[self.environment.active].all():
            angle, widest = np.degrees([self.off_nadir[blind][0], self.widest[blind][0]])
            where = "below the horizon" if angle > 179.0 else f"{angle:.2f} deg off the nadir"
            raise ConfigurationError(
                f"the target is not in view of '{self.name}' at t = 0: it is {where}, and the "
                f"camera sees up to {widest:.2f} deg\n"
                "  the first frame is what all others are matched to: begin nearer to the target"
            )
        self.fail(blind, "the target is not in view at t = 0")

    def _step_impl(self, t: float, dt: float) -> None:
        self._look(t)

    def _seen(self, t: float) -> Mask:
        seen = self.environment.active & (self.off_nadir <= self.widest)
        cycle = np.where(self.cycle > 0.0, self.cycle, 1.0)
        return np.asarray(seen & ((self.cycle == 0.0) | (t % cycle < self.stare)))

    def _look(self, t: float) -> None:
        first = self.step_index == 0
        size = FIELD if first else WINDOW
        transform = frame_to_scene(self.target, self._view(t), self.place, self.grid, size)
        seen = self._seen(t)
        off = seen & ~inside(transform, size, self._scene.shape)
        self.fail(off, "the frame reaches beyond the scene")
        seen &= ~off
        images = np.zeros((self.n_members, size, size), np.float32)
        draws, rows = self.normals("noise", 1), np.flatnonzero(seen)

        def render(part: slice) -> None:
            for m in rows[part]:
                rng = np.random.default_rng(draws[m].view(np.uint64))
                frame = sampled(self._scene, transform[m], size)
                frame *= np.float32(1.0 + self.light_rate[m] * t)
                if self.hidden[m] > 0.0:
                    hidden_square(frame, round(WINDOW * self.hidden[m] ** 0.5), rng)
                images[m] = coded(frame, float(self.noise[m]), self.bits, rng)

        over(batches(len(rows)), render)
        if first:
            edge = (FIELD - WINDOW) // 2
            self.first.publish(t, images, valid=seen)
            images = images[:, edge : edge + WINDOW, edge : edge + WINDOW]
        self.frame.publish(t, images, valid=seen)

    def _view(self, t: float) -> FloatArray:
        """Scale and turn of each member's frame (n, 2, 2), with what nobody knows of."""
        if not (self.turn_rate.any() or self.stretch_rate.any()):
            return self.view
        angle, growth = self.turn_rate * t, 1.0 + self.stretch_rate * t
        c, s = np.cos(angle) * growth, np.sin(angle) * growth
        turn: NDArray[np.float64] = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
        return turn @ self.view
