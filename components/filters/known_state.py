"""The last known state: what a spacecraft still knows when GPS is lost."""

from __future__ import annotations

from terrafix.components.fields import KNOWN_STATE
from terrafix.components.filters.family import start_fields
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.filters.lake import ORBIT
from terrafix.models.motion.known_state import known_state_model


class LastKnownState(SymbolicComponent):
    """Position and velocity as last known, with errors of given sigma, told once at t = 0."""

    default_rate = Rate(times=["0"])

    position_sigma = Parameter(1000.0, shape=(3,), unit="m", positive=True, doc="per axis")
    velocity_sigma = Parameter(10.0, shape=(3,), unit="m/s", positive=True, doc="per axis")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    state = MessageOutput(fields=KNOWN_STATE, doc="state and covariance at t = 0")

    def build_model(self) -> Model:
        """Build the model."""
        return known_state_model()


class LastKnownOrbit(SymbolicComponent):
    """Inertial position and velocity as last known, with errors of given sigma, told at t = 0."""

    default_rate = Rate(times=["0"])

    position_sigma = Parameter(1000.0, shape=(3,), unit="m", positive=True, doc="per axis")
    velocity_sigma = Parameter(10.0, shape=(3,), unit="m/s", positive=True, doc="per axis")

    r_i = Input((3,), unit="m", frame="i", doc="true position")
    v_i = Input((3,), unit="m/s", frame="i", doc="true velocity")
    state = MessageOutput(
        fields=start_fields(ORBIT, ("r", "v")), doc="state and covariance at t = 0"
    )

    def build_model(self) -> Model:
        """Build the model."""
        return known_state_model("r_i", "v_i", ("r", "v"))
