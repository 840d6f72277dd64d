"""Frames matched to the first one, or to a map, in the gate that a filter's covariance gives."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from terrafix.components.fields import (
    FIELD,
    FIELD_IMAGE,
    PRINTED_TRACK,
    SCENE,
    SCENE_GRID,
    SCENE_PLACE,
    TARGET_FIX,
    TRACK,
    VIEW,
    WINDOW,
    WINDOW_IMAGE,
)
from terrafix.components.shared import require_common
from terrafix.cosim.basics.arrays import FloatArray, Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Count, Flag, Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    Input,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    State,
)
from terrafix.models.core.arrays import Single
from terrafix.models.core.parallel import batches, over
from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.geolocation import FIRST_FRAME, PRINTED, TRACKING
from terrafix.models.images.frame_matching import (
    ALIKE,
    METHODS,
    REASONS,
    FrameMatch,
    least_squares_shift,
    match_frame,
)
from terrafix.models.images.frames import (
    blurred,
    frame_to_scene,
    inside,
    sampled,
    shifted,
    turned_back,
)

_LOOKS, _STILL, _EDGE = 4, 1e-3, 4
"""Times that a frame is shown anew, or until it has not moved so far [px]; what of it is not told
from all sides then."""
_SIGMAS, _MARGIN = 4.0, 2
"""The gate: so many predicted sigmas, and so many pixels besides."""
_SAME = 1e-6
"""Where two views are the same."""


class _Matching(Component):
    """What matching to the first frame and to a map have in common."""

    default_rate = Rate("1")
    error_state: ClassVar[ErrorState]

    method = Choice(METHODS, "ssd", doc="what is compared; ssd is thrown by a change of light")
    subpixel = Flag(True, doc="go on between whole pixels, by parabolas")
    again = Flag(
        True,
        doc="go on by least squares, shown anew where it was found: parabolas are right near whole "
        "shifts alone",
    )
    template = Count(WINDOW, minimum=8, doc="rows and columns of a frame that are sought")
    reach = Count(24, minimum=2, maximum=64, doc="largest shift that is looked for [px]")
    noise = Parameter(4.0, minimum=0.0, doc="of a frame's codes: twice that is no texture")
    least = Parameter(0.5, minimum=-1.0, maximum=1.0, doc="correlation of an accepted match")
    match_sigma = Parameter(0.3, unit="px", positive=True, doc="of the match, white")
    texture = Flag(
        False, doc="add to it what the noise of frames makes of a match in their texture"
    )

    frame = MessageInput(**WINDOW_IMAGE, doc="the middle of a frame")
    nominal_view = Input(**VIEW, doc="scale and turn of a frame, from the nominal position")
    prior: Any

    correlation = Output(doc="of the last frame with what it was matched to")
    reason = Output(
        doc="of the last match: index into terrafix.models.images.frame_matching.REASONS"
    )

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect."""
        return name != "again" or self.subpixel

    def validate(self) -> None:
        """Look whether the template fits, and lies in the middle."""
        template = self.setting("template")
        if template % 2:
            raise ConfigurationError(
                f"'{self.name}.template' is {template} pixels, and a frame has {WINDOW}: an odd "
                "number has no place in its middle\n  make it even"
            )
        if template > WINDOW:
            raise ConfigurationError(
                f"'{self.name}.template' is {template} pixels, larger than the image that it is "
                f"cut from, {WINDOW} x {WINDOW}\n  make it {WINDOW} or less"
            )

    def _initialize_impl(self) -> None:
        self.correlation = self.reason = np.nan
        self._match(0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self._match(t)

    def _match(self, t: float) -> None:
        raise NotImplementedError(f"{type(self).__name__} must provide _match(t)")

    def _gate(self, sigma: FloatArray) -> np.ndarray:
        """Half widths of the gate, north and east, whole pixels (n, 2)."""
        wanted = np.ceil(_SIGMAS * sigma) + _MARGIN
        return np.asarray(np.minimum(wanted, self.reach), np.int64)

    def _sought(self, template: Single, image: Single, m: int) -> FrameMatch:
        return match_frame(
            template,
            image,
            method=self.method,
            subpixel=self.subpixel,
            noise=float(self.noise[m]),
            least=float(self.least[m]),
        )

    def _settled(self, template: Single, image: Single, m: int) -> FrameMatch:
        return least_squares_shift(
            template,
            image,
            noise=float(self.noise[m]),
            least=float(self.least[m]),
            light=self.method != "ssd",
        )

    def _covariance(self) -> FloatArray:
        """R of matches (n, 2, 2)."""
        return (self.match_sigma[:, None] ** 2 + self._variance)[:, None] * np.eye(2)

    def _tell(
        self, port: Any, t: float, y: FloatArray, R: FloatArray, from_first: FloatArray, told: Mask
    ) -> None:
        n = self.n_members
        port.publish(
            t,
            valid=told,
            y=np.where(told[:, None], y, 0.0),
            from_first=from_first.reshape(n, 4),
            R=R,
            present=np.ones((n, 2)),
        )

    def _say(self, seen: Mask) -> None:
        """What became of frames: of the last ones, where there was none now."""
        self.reason = np.where(seen, self._reasons, self.reason)
        self.correlation = np.where(seen, self._alike, self.correlation)

    def _forget(self) -> None:
        self._reasons = np.full(self.n_members, np.nan)
        self._alike = np.full(self.n_members, np.nan)
        self._variance = np.zeros((self.n_members, 2))

    def _keep(self, m: int, match: FrameMatch) -> None:
        self._reasons[m], self._alike[m] = match.reason, match.correlation
        if self.texture:
            self._variance[m] = match.sigma_row**2, match.sigma_column**2


def _cut(image: Single, size: int) -> Single:
    """The middle of an image."""
    edge = (image.shape[0] - size) // 2
    return image[edge : edge + size, edge : edge + size]


class _FrameMatcher(_Matching):
    """Each frame sought in the first one: how far the target has moved in the frame since.

    Told twice: as it is, and with where the target lies in the first frame, if that is told.
    """

    first_frame = Choice(
        FIRST_FRAME,
        "unknown",
        doc="whether the prior is of a filter that takes `fix` (unknown), or `located`",
    )

    first = MessageInput(**FIELD_IMAGE, doc="the whole first frame")
    reference = MessageInput(
        fields=TARGET_FIX, optional=True, doc="where the target lies in the first frame"
    )
    fix = MessageOutput(fields=TARGET_FIX, doc="how far the target has moved in the frame")
    located = MessageOutput(fields=TARGET_FIX, doc="where it lies in the frame, by the reference")

    field = State((FIELD, FIELD), dtype=np.float32, doc="the first frame")
    first_view = State((2, 2), unit="px/m", doc="its scale and turn")
    begun = State(doc="1 where there is a first frame")
    at_first = State((2,), unit="px", doc="where the target lies in it")
    referenced = State(doc="1 where that was told")

    def _begin(self) -> None:
        fresh = self.first.fresh
        if fresh.any():
            self.field[fresh] = self.first.value[fresh]
            self.first_view[fresh] = self.nominal_view[fresh]
            self.begun[fresh] = 1.0
        told = self.reference.fresh
        if told.any():
            self.at_first[told] = self.reference.y[told]
            self.referenced[told] = 1.0

    def _match(self, t: float) -> None:
        self._begin()
        seen = self.frame.fresh & (self.begun > 0.5) & self.environment.active
        there = np.where(seen[:, None, None], self.first_view, np.eye(2))
        now = np.where(seen[:, None, None], self.nominal_view, np.eye(2))
        from_first = now @ np.linalg.inv(there)
        turned = np.abs(from_first - np.eye(2)).max(axis=(1, 2)) > _SAME
        expected, sigma = self._expected(from_first)
        at = np.einsum("nij,nj->ni", from_first, self.at_first)
        if self.first_frame == "georeferenced":
            expected = expected - at
        # where the middle of this frame lies in the first one: the target went the other way
        place = -np.linalg.solve(from_first, expected[..., None])[..., 0]
        whole = np.rint(place).astype(np.int64)
        size, corner, y = self.template, (FIELD - self.template) // 2, np.zeros_like(place)
        boxes = np.column_stack([corner - whole[:, 0], corner + whole[:, 1]])
        gates = self._gate(sigma)
        self._forget()
        rows = np.flatnonzero(seen)

        def seek(part: slice) -> None:
            for m in rows[part]:
                (top, left), (up, side) = boxes[m].tolist(), gates[m].tolist()
                bottom, right = top + size + up, left + size + side
                top, left = top - up, left - side
                if min(top, left) < 0 or max(bottom, right) > FIELD:
                    self._reasons[m] = REASONS.index("beyond the edge of the image")
                    continue
                frame = self.frame.value[m]
                if turned[m]:
                    frame = turned_back(frame, from_first[m])
                match = self._sought(_cut(frame, size), self.field[m, top:bottom, left:right], m)
                self._keep(m, match)
                row, column = match.row, match.column
                if (
                    self.subpixel
                    and self.again
                    and match.reason == 0
                    and match.correlation >= ALIKE
                ):
                    row, column = self._shown_anew(m, frame, top + up + row, left + side + column)
                    row, column = row - top - up, column - left - side
                y[m] = whole[m, 0] - row, whole[m, 1] + column

        over(batches(len(rows)), seek)
        moved = -np.einsum("nij,nj->ni", from_first, y)
        told = seen & (self._reasons == 0)
        R = self._covariance()
        self._tell(self.fix, t, moved, R, from_first, told)
        # the first frame lies in itself without an error, and on the map with that of its reference
        R = np.where(self.reference.fresh[:, None, None], self.reference.R, R)
        self._tell(self.located, t, moved + at, R, from_first, told & (self.referenced > 0.5))
        self._say(seen)

    def _expected(self, from_first: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What a match to the first frame would give, by the filter, and its sigma: (n, 2) each."""
        prior, places = self.prior, self.error_state.places
        H = np.zeros((self.n_members, 2, self.error_state.size))
        H[:, :, places["target"]] = np.eye(2)
        y = prior.target.copy()
        if "bias" in places:
            y += np.einsum("nij,nj->ni", from_first, prior.bias) + prior.mismatch
            H[:, :, places["bias"]], H[:, :, places["mismatch"]] = from_first, np.eye(2)
        variance = np.einsum("nij,njk,nik->ni", H, prior.P, H) + self.match_sigma[:, None] ** 2
        return y, np.sqrt(np.maximum(variance, 0.0))

    def _shown_anew(self, m: int, frame: Single, row: float, column: float) -> tuple[float, float]:
        """Corner of a template in the first frame [px], from where it was found."""
        size = min(self.template, WINDOW - 2 * _EDGE)
        edge = (self.template - size) // 2
        for _ in range(_LOOKS):
            i, j = round(row), round(column)
            template = _cut(shifted(frame, row - i, column - j), size)
            top, left = i + edge - _MARGIN, j + edge - _MARGIN
            room = size + 2 * _MARGIN
            image = self.field[m, top : top + room, left : left + room]
            match = self._settled(template, image, m)
            self._keep(m, match)
            row, column = row + match.row, column + match.column
            if match.reason or max(abs(match.row), abs(match.column)) < _STILL:
                break
        return row, column


class _Georeference(_Matching):
    """Frames sought in a map: where the target lies in them. It reads no truth."""

    default_rate = Rate(times=["0"])

    blur = Parameter(0.5, unit="px", minimum=0.0, doc="the camera's point spread, as calibrated")

    fix = MessageOutput(fields=TARGET_FIX, doc="where the target lies in the frame")
    scene = SharedInput(**SCENE, doc="the map")
    place = SharedInput(**SCENE_PLACE, doc="of the target in it")
    grid = SharedInput(**SCENE_GRID, doc="how it lies")

    def _initialize_impl(self) -> None:
        require_common(self, "blur")
        onto = self.grid @ np.linalg.inv(self.nominal_view[0])
        scale = float(np.sqrt(np.abs(np.linalg.det(onto))))
        room = self.template + 2 * (_MARGIN + 2)
        if min(self.scene.shape) < room * scale:
            rows, columns = (n / scale for n in self.scene.shape)
            raise ConfigurationError(
                f"the map of '{self.name}' is smaller than the gate: {rows:.0f} x {columns:.0f} "
                f"pixels of the camera, and a template of {self.template} with its gate takes "
                f"{room}\n  use a larger map, or a smaller {self.name}.template"
            )
        self._map: Single = blurred(self.scene, float(self.blur[0]) * scale)
        super()._initialize_impl()

    def _match(self, t: float) -> None:
        seen = self.frame.fresh & self.environment.active
        target = self.prior.target
        place = self.error_state.places["target"]
        P = self.prior.P[:, place, place]
        sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
        gate = self._gate(np.hypot(sigma, self.match_sigma[:, None])).max(axis=1)
        y = np.zeros((self.n_members, 2))
        self._forget()
        rows = np.flatnonzero(seen)

        def seek(part: slice) -> None:
            for m in rows[part]:
                y[m], _ = self._found(m, target[m], int(gate[m]))
                for _ in range(_LOOKS if self.subpixel and self.again else 0):
                    # of images that are less alike parabolas tell more
                    if self._reasons[m] != 0 or self._alike[m] < ALIKE:
                        break
                    y[m], moved = self._found(m, y[m])
                    if moved < _STILL:
                        break

        over(batches(len(rows)), seek)
        told = seen & (self._reasons == 0)
        same = np.broadcast_to(np.eye(2), (self.n_members, 2, 2))
        self._tell(self.fix, t, y, self._covariance(), same, told)
        self._say(seen)

    def _found(self, m: int, target: FloatArray, gate: int = 0) -> tuple[FloatArray, float]:
        """Where the target lies in a member's frame, from where it is thought to be, and how far.

        Sought in a gate, or without one by least squares.
        """
        size = self.template + 2 * (gate or _MARGIN)
        transform = frame_to_scene(
            target[None], self.nominal_view[m : m + 1], self.place, self.grid, size
        )
        if not inside(transform, size, self._map.shape)[0]:
            self._reasons[m] = REASONS.index("beyond the edge of the image")
            return target, 0.0
        image = sampled(self._map, transform[0], size)
        seek = self._sought if gate else self._settled
        match = seek(_cut(self.frame.value[m], self.template), image, m)
        self._keep(m, match)
        off = np.array([match.row, -match.column])
        return np.asarray(target + off), float(np.abs(off).max())


class FrameMatcher(_FrameMatcher):
    """Each frame sought in the first one, where the filter expects it."""

    error_state = TRACKING
    prior = BundleInput(TRACK, doc="estimate before the fix of this instant")


class PrintedFrameMatcher(_FrameMatcher):
    """The same about an estimate of the ten printed states."""

    error_state = PRINTED
    prior = BundleInput(PRINTED_TRACK, doc="estimate before the fix of this instant")


class FrameGeoreference(_Georeference):
    """Frames sought in a map, where the filter expects them; the first one alone, or all."""

    error_state = TRACKING
    prior = BundleInput(TRACK, doc="estimate before the fix of this instant")


class PrintedFrameGeoreference(_Georeference):
    """The same about an estimate of the ten printed states."""

    error_state = PRINTED
    prior = BundleInput(PRINTED_TRACK, doc="estimate before the fix of this instant")
