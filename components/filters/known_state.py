"""The last known state: what is still known when GPS is lost."""

from __future__ import annotations

from terrafix.components.fields import KNOWN_STATE
from terrafix.components.filters.family import start_fields
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.filters.lake import ORBIT
from terrafix.models.filters.navigator import DRIFTING
from terrafix.models.motion.known_state import known_flight_model, known_state_model
from terrafix.models.motion.strapdown import EARTHS


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


class LastKnownFlight(SymbolicComponent):
    """Position, velocity and attitude of an aircraft as last known, told at t = 0.

    Sigmas are of north, east and down; the attitude's are angles about these axes.
    """

    default_rate = Rate(times=["0"])

    earth = Choice(EARTHS, "wgs84", doc="that of the motion")
    position_sigma = Parameter(
        [3.0, 1.0, 3.0], shape=(3,), unit="m", positive=True, frame="n", doc="north, east, down"
    )
    velocity_sigma = Parameter(
        [0.1] * 3, shape=(3,), unit="m/s", positive=True, frame="n", doc="north, east, down"
    )
    attitude_sigma = Parameter(
        [5e-4, 5e-4, 2e-3], shape=(3,), unit="rad", positive=True, frame="n", doc="tilts, heading"
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, e to body")
    state = MessageOutput(
        fields=start_fields(DRIFTING, ("r_e", "v_e", "q_be")), doc="state and covariance at t = 0"
    )

    def build_model(self) -> Model:
        """Build the model for the chosen Earth."""
        return known_flight_model(self.setting("earth"))
