"""The last known state: what a spacecraft still knows when GPS is lost."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import KNOWN_STATE
from terrafix.cosim.clock import Rate
from terrafix.cosim.component import Component
from terrafix.cosim.parameters import Parameter
from terrafix.cosim.ports import Input, MessageOutput


class LastKnownState(Component):
    """Position and velocity as last known, with errors of given sigma, told once at t = 0."""

    default_rate = Rate(times=["0"])

    position_sigma = Parameter(1000.0, shape=(3,), unit="m", positive=True, doc="per axis")
    velocity_sigma = Parameter(10.0, shape=(3,), unit="m/s", positive=True, doc="per axis")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    state = MessageOutput(fields=KNOWN_STATE, doc="state and covariance at t = 0")

    def _initialize_impl(self) -> None:
        sigma = np.concatenate([self.position_sigma, self.velocity_sigma], axis=1)
        error = sigma * self.normals("error", 6)
        P = np.zeros((self.n_members, 6, 6))
        P[:, range(6), range(6)] = sigma**2
        self.state.publish(0.0, r_e=self.r_e + error[:, :3], v_e=self.v_e + error[:, 3:], P=P)

    def _step_impl(self, t: float, dt: float) -> None:
        """Say nothing more: GPS stays lost."""
