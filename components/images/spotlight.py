"""Spotlight images of a recording, formed with a wrong track, found on those of another aspect."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import PHASE, SPOTLIGHT_FIX, TRACK_ERROR
from terrafix.components.sensors.compiled import pulse_sums
from terrafix.components.shared import require_common
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Count, Parameter
from terrafix.cosim.declare.ports import MessageInput, MessageOutput, SharedInput
from terrafix.models.core.arrays import Single
from terrafix.models.images.aperture_matching import recognized
from terrafix.models.radar.compensation import straight_line
from terrafix.models.radar.correlation import contrast, shift_between
from terrafix.models.radar.phase_history import (
    GroundGrid,
    PhaseHistory,
    compressed_pulses,
    ground_grid,
    moved,
    projected,
    projected_drift,
)
from terrafix.models.radar.pulses import Profiles

_HISTORY = ("phase", "frequency", "r", "reference")


class SpotlightMatcher(Component):
    """Images pulses with a wrong track, focuses them, and finds them on another aspect's image.

    The other aspect is imaged with its recorded track: its speckle is its own, its scene the same.
    """

    default_rate = Rate("1", offset="1")

    spacing = Parameter(0.25, unit="m", positive=True, doc="of pixels on the ground")
    size = Count(440, minimum=128, doc="pixels along each side")
    reach = Parameter([36.0, 18.0], shape=(2,), unit="m", positive=True, doc="along, and away")

    phase = SharedInput(**PHASE, doc="pulses, frequencies")
    frequency = SharedInput((None,), unit="Hz", doc="of its columns")
    r = SharedInput((None, 3), unit="m", frame="scene", doc="true places, of which it errs")
    reference = SharedInput((None,), unit="m", doc="ranges to which pulses were compensated")
    times = SharedInput((None,), unit="s", doc="of its pulses")
    other_phase = SharedInput(**PHASE, doc="of the other aspect")
    other_frequency = SharedInput((None,), unit="Hz", doc="of its columns")
    other_r = SharedInput((None, 3), unit="m", frame="scene", doc="its places")
    other_reference = SharedInput((None,), unit="m", doc="its ranges")
    error = MessageInput(fields=TRACK_ERROR, doc="what the believed track is off by")

    fix = MessageOutput(fields=SPOTLIGHT_FIX, doc="what the image says of its track")

    def _initialize_impl(self) -> None:
        require_common(self)

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.error.fresh & self.environment.active
        if not fresh.any():
            return
        spacing, sums = float(self.spacing[0]), pulse_sums()
        rows, columns = (int(np.ceil(m / spacing)) for m in self.reach[0])
        grid = ground_grid(self.r, spacing, self.size, self.size)
        own, other = (
            PhaseHistory(*(getattr(self, aspect + name) for name in _HISTORY))
            for aspect in ("", "other_")
        )
        pulses = compressed_pulses(own)
        wide = contrast(projected(compressed_pulses(other), grid.grown(rows, columns), sums))
        values = {name: np.zeros(self.n_members) for name in SPOTLIGHT_FIX}
        for m in map(int, np.flatnonzero(fresh)):
            for name, value in self._measured(m, pulses, grid, wide, (rows, columns)).items():
                values[name][m] = value
        self.fix.publish(t, valid=fresh, **values)

    def _measured(
        self, m: int, pulses: Profiles, grid: GroundGrid, wide: Single, reach: tuple[int, int]
    ) -> dict[str, float]:
        t, sums = np.asarray(self.times), pulse_sums()
        believed = pulses.r + self.error.position[m] + np.outer(t, self.error.velocity[m])
        drift, focused = projected_drift(moved(pulses, believed), t, grid, sums)
        shift = shift_between(contrast(projected(focused, grid, sums)), wide, reach)
        at = grid.spacing * (shift.pixels[0] * grid.along + shift.pixels[1] * grid.out)
        now, speed = straight_line(t, focused.r), straight_line(t, believed).speed
        return {
            "range": float(np.linalg.norm(at - now.r)),
            "ahead": float(now.v @ (at - now.r)) / speed,
            "speed": speed,
            "velocity": drift.velocity,
            "focused": float(drift.accepted),
            "accepted": float(recognized(shift)),
        }
