"""The image former: images of one echo, each formed with a member's own estimate.

It reads the prior of its own instant, so that the image that corrects an estimate was formed with
that estimate. Members whose estimates lead to the same focus share the image.

A member whose estimate leads to no image goes without one this time, and `reason` says why: the
next echo may show what this one does not. A member is failed only where its settings and the echo's
size are at fault, as they will be the next time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafix.components.fields import ACQUISITION, ECHO, ESTIMATE, IMAGE, RADAR
from terrafix.components.images.margins import foreseen_image
from terrafix.components.sensors.compiled import row_operations
from terrafix.components.shared import require_common
from terrafix.cosim.basics.arrays import FloatArray, Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component, FedBy
from terrafix.cosim.declare.parameters import Count, Flag, Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    Input,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    SharedOutput,
)
from terrafix.models.core.arrays import Single
from terrafix.models.geometry.antenna import boresight_direction_array, nominal_antenna_array
from terrafix.models.radar.autofocus import Focus
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.doppler import centroid_candidates
from terrafix.models.radar.focusing import Image
from terrafix.models.radar.imaging import (
    BLIND,
    FARTHEST,
    OPEN,
    REASONS,
    ZERO,
    Imager,
    NoImageError,
    Processing,
    chip_slices,
)
from terrafix.models.radar.multilook import detected, multilook_index
from terrafix.models.sensors.effective_velocity import VelocityField, velocity_field

_SIGMAS = 5.0
"""How far from the estimate the velocity is looked for, in standard deviations."""
_MOST_CENTROIDS = 12
"""That an estimate may leave open: an echo is focused with each."""


@dataclass(frozen=True)
class _Formed:
    """An image as a member's estimate and autofocus form it."""

    image: Image
    processing: Processing
    focus: Focus
    velocity: float
    sigma: float
    own: float


class ImageFormer(Component):
    """Forms, autofocuses and detects an image about the beam's center.

    Where autofocus refuses, the image is formed with the velocity that the estimate implies, and
    comes without a measured one.
    """

    default_rate = Rate("8.2", offset="8.2")

    look = Parameter(
        unit="rad", doc="off-nadir angle of the nominal boresight, positive to the right"
    )
    squint = Parameter(0.0, unit="rad", doc="forward angle of the nominal boresight")
    velocity_step = Parameter(1.0, unit="m/s", positive=True, doc="grid of autofocus")
    migration_step = Parameter(
        50.0, unit="m/s", positive=True, doc="grid of velocities with which migration is removed"
    )
    band = Parameter(
        [0.0, 1.0], shape=(2,), minimum=0.0, maximum=1.0, doc="part of the Doppler band shown"
    )
    exposure = Parameter(
        1.0, positive=True, maximum=1.0, doc="share of a pulse received where columns are used"
    )
    azimuth_looks = Count(2, minimum=1, doc="lines averaged in a pixel")
    range_looks = Count(1, minimum=1, doc="cells averaged in a pixel")
    rows = Count(500, minimum=96, doc="of the detected image")
    columns = Count(500, minimum=96, doc="of the detected image")
    range_sigma = Parameter(1.0, unit="m", minimum=0.0, doc="noise of the slant range")
    height_sigma = Parameter(
        100.0,
        unit="m",
        minimum=0.0,
        doc="of heights of the terrain, from that of the beam's center: what focuses has another "
        "effective velocity there",
    )
    show_unfocused = Flag(False, doc="publish the first member's image before autofocus, too")

    radar = SharedInput(**RADAR, doc="what the radar sends and how its echo is sampled")
    echo = SharedInput(**ECHO, doc="raw echo, lines first")
    acquired = MessageInput(fields=ACQUISITION, doc="when and where the echo was received")
    prior = BundleInput(ESTIMATE, doc="estimate before the fix of this instant")
    q_be = Input((4,), unit="1", frame="b", doc="measured attitude, Earth-fixed to body")

    images = SharedOutput(
        (None, None, None), dtype=np.float32, doc="amplitudes of the distinct images"
    )
    unfocused = SharedOutput(
        (None, None), dtype=np.float32, doc="the first member's, as its estimate alone forms it"
    )
    image = MessageOutput(fields=IMAGE, doc="which image is a member's, and what it measures")
    reason = Output(doc="of the last echo: index into terrafix.models.radar.imaging.REASONS")

    def foreseen(self, fed_by: FedBy) -> Iterator[str]:
        """Tell what echo and autofocus have to spare for the image."""
        return foreseen_image(self, fed_by)

    def initialize(self) -> None:
        """Look whether what forms images is common to all members."""
        require_common(self, "velocity_step", "migration_step", "band", "exposure")
        super().initialize()
        self.reason = np.nan

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.acquired.fresh & self.environment.active
        if not fresh.any():
            return
        k = int(np.argmax(fresh))
        for name in ("near_range", "first_time", "side"):
            if np.any(getattr(self.acquired, name)[fresh] != getattr(self.acquired, name)[k]):
                raise ConfigurationError(
                    f"'{self.name}.acquired.{name}' differs between members, but one echo is "
                    "shared by all of them\n  fly one member at a time"
                )
        if not np.any(self.echo):
            self.reason = np.where(fresh, REASONS.index(ZERO), self.reason)
            return
        self._require_side(fresh)
        self._form(t, self._imager(k), fresh)

    def _imager(self, k: int) -> Imager:
        try:
            return Imager(
                self.echo,
                Radar(*map(float, self.radar)),
                float(self.acquired.near_range[k]),
                float(self.acquired.first_time[k]),
                step=float(self.velocity_step[k]),
                migration_step=float(self.migration_step[k]),
                band=(float(self.band[k, 0]), float(self.band[k, 1])),
                exposure=float(self.exposure[k]),
                operations=row_operations(),
            )
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' cannot form an image of {self.echo.shape[0]} lines of "
                f"{self.echo.shape[1]} cells: {error}"
            ) from error

    def _form(self, t: float, imager: Imager, fresh: Mask) -> None:
        wavelength = imager.radar.wavelength
        centroid, sigma = self._expected_centroid(wavelength)
        chips: list[Single] = []
        known: dict[tuple[Processing, float], int] = {}
        values = {name: np.zeros(self.n_members) for name in IMAGE}
        formed = np.zeros(self.n_members, np.bool_)
        for m in map(int, np.flatnonzero(fresh)):
            try:
                found = self._focused(m, imager, float(centroid[m]), float(sigma[m]))
                rows, columns, center = self._place(found.image, *self._beam(m))
            except NoImageError as error:
                self.reason[m] = REASONS.index(error.reason)
                continue
            except ValueError as error:
                self._refuse(m, error)
                continue
            key = found.processing, found.image.velocity
            if key not in known:
                known[key] = len(chips)
                chips.append(detected(found.image.data[rows, columns], self._looks))
            if self.show_unfocused and not formed.any():
                blurred = imager.image(found.processing, found.own)
                rows, columns, _ = self._place(blurred, *self._beam(m))
                self.unfocused = detected(blurred.data[rows, columns], self._looks)
            formed[m] = True
            self.reason[m] = REASONS.index(found.focus.reason)
            values["index"][m] = known[key]
            values["row"][m], values["column"][m] = center
            values["column_range"][m] = self.range_looks * self._spacing(found.image, m)
            values["focused"][m] = found.focus.accepted
            values["velocity"][m], values["velocity_sigma"][m] = found.velocity, found.sigma
        if not formed.any():
            return
        noise = self.normals("slant_range", 1)[:, 0]
        values["slant_range"] = self.acquired.beam_range + self.range_sigma * noise
        speed = np.linalg.norm(self.prior.v_e, axis=1)
        values["sine"] = wavelength * self.acquired.beam_doppler / (2 * speed)
        values["row_time"][:] = self.azimuth_looks / imager.radar.prf
        values["time_sigma"] = self.acquired.time_sigma
        values["side"] = self.acquired.side
        self.images = np.stack(chips)
        self.image.publish(t, valid=formed, **values)

    def _focused(self, m: int, imager: Imager, centroid: float, sigma: float) -> _Formed:
        """Image of a member, and the velocity that focuses the beam's center.

        Raises
        ------
        NoImageError
            If the estimate leads to none.
        ValueError
            If the echo is too small.
        """
        field, velocity_sigma = self._expected_velocity(m, imager.radar.wavelength)
        reach = _SIGMAS * velocity_sigma / imager.migration_step
        centroids = self._centroids(imager, centroid, sigma)
        processing, focus = imager.focus(
            [imager.processing(f, field.velocity, field.by_range) for f in centroids],
            field.velocity,
            reach=min(np.ceil(reach) * imager.migration_step, FARTHEST),
            velocity_rate=field.by_time,
        )
        if not focus.accepted:
            image = imager.image(processing, field.velocity)
            own = field.velocity, velocity_sigma
            return _Formed(image, processing, focus, *own, field.velocity)
        image = imager.image(processing, focus.velocity)
        row, column = (float(x) for x in image.pixel(0.0, *self._beam(m)))
        velocity = imager.velocity_at(processing, focus.velocity, field.by_time, (row, column))
        relief = abs(field.by_height) * float(self.height_sigma[m])
        return _Formed(
            image, processing, focus, velocity, float(np.hypot(focus.sigma, relief)), field.velocity
        )

    def _centroids(self, imager: Imager, expected: float, sigma: float) -> list[float]:
        if 7 * sigma > _MOST_CENTROIDS * imager.radar.prf:
            raise NoImageError(OPEN, f"the centroid is known to {sigma:.0f} Hz only")
        return centroid_candidates(imager.fraction, imager.radar.prf, expected, sigma)

    def _beam(self, m: int) -> tuple[float, float]:
        """Slant range and Doppler frequency of the beam's center."""
        return float(self.acquired.beam_range[m]), float(self.acquired.beam_doppler[m])

    def _spacing(self, image: Image, m: int) -> float:
        """Slant range of the beam from column to column, which are of closest range [m]."""
        _, doppler = self._beam(m)
        near, far = image.seen_at(0.0, np.array([0.0, 1.0]), doppler)[1]
        return float(far - near)

    def _refuse(self, m: int, error: ValueError) -> None:
        """Fail a member for which echo of this size holds no image of the size that is wanted."""
        lines, cells = self.echo.shape
        self.fail(
            np.arange(self.n_members) == m,
            f"cannot form an image of {lines} lines of {cells} cells: {error}; receive more lines "
            f"or cells, or set {self.name}.rows and {self.name}.columns",
        )

    @property
    def _looks(self) -> tuple[int, int]:
        return self.azimuth_looks, self.range_looks

    def _place(
        self, image: Image, beam_range: float, beam_doppler: float
    ) -> tuple[slice, slice, tuple[float, float]]:
        """Lines and cells of the detected image, and where on it the beam's center lies."""
        center = [float(x) for x in image.pixel(0.0, beam_range, beam_doppler)]
        size = self.rows * self.azimuth_looks, self.columns * self.range_looks
        rows, columns = chip_slices((center[0], center[1]), size, (image.rows, image.columns))
        row = multilook_index(center[0] - rows.start, self.azimuth_looks)
        column = multilook_index(center[1] - columns.start, self.range_looks)
        return rows, columns, (float(row), float(column))

    def _expected_velocity(self, m: int, wavelength: float) -> tuple[VelocityField, float]:
        """Effective velocity that a member's estimate implies, and its standard deviation."""
        r, v = self.prior.r_e[m], self.prior.v_e[m]
        speed = float(np.linalg.norm(v))
        beam_range, beam_doppler = self._beam(m)
        sine = wavelength * beam_doppler / (2 * speed)
        try:
            field = velocity_field(r, v, beam_range, sine, self._side(m))
        except ValueError as error:
            raise NoImageError(BLIND, str(error)) from error
        variance = v @ self.prior.P[m, 3:6, 3:6] @ v / field.velocity**2
        return field, float(np.sqrt(variance))

    def _require_side(self, fresh: Mask) -> None:
        """Raise where all who look at an echo look to the other side than it came from."""
        r, v = self.prior.r_e[fresh], self.prior.v_e[fresh]
        q_sb = nominal_antenna_array(self.look, self.squint)
        u = boresight_direction_array(self.q_be, q_sb, self.prior.q_mu)[fresh]
        across = np.sum(u * np.cross(v, r), axis=1)
        if not (across * self.acquired.side[fresh] < 0).all():
            return
        own, other = ("right", "left") if across[0] > 0 else ("left", "right")
        look = np.degrees(self.look[fresh][0])
        raise ConfigurationError(
            f"'{self.name}' looks to the {own} of the track, but its echo came from the {other}\n"
            f"  its look is {look:.4g} deg, positive to the right: set {self.name}.look to that of "
            "what received the echo, here and wherever the chain declares it"
        )

    def _side(self, m: int) -> int:
        return 1 if self.acquired.side[m] > 0 else -1

    def _expected_centroid(self, wavelength: float) -> tuple[FloatArray, FloatArray]:
        """Doppler centroid that each estimate implies, and its standard deviation."""
        v, P = self.prior.v_e, self.prior.P
        q_sb = nominal_antenna_array(self.look, self.squint)
        u = boresight_direction_array(self.q_be, q_sb, self.prior.q_mu)
        speed2 = np.sum(v * v, axis=1)
        variance = np.einsum("ni,nij,nj->n", u, P[:, 3:6, 3:6], u)
        variance += speed2 * np.max(np.diagonal(P[:, 6:, 6:], axis1=1, axis2=2), axis=1)
        return 2 / wavelength * np.sum(v * u, axis=1), 2 / wavelength * np.sqrt(variance)
