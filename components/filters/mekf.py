"""The spacecraft's multiplicative extended Kalman filter, as two components.

`MekfPredict` reads the posterior at the start of its step and the inertial data at the end, and
publishes the prior. `MekfCorrect` reads the prior and the fix at the end and publishes the
posterior. Who needs the estimate of an instant before its fix (an image former, a matcher) reads
the prior at the end of the step: no loop, no hidden delay.
"""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import ENVIRONMENT, ESTIMATE, FIX, INNOVATION, KNOWN_STATE
from terrafix.components.filters.family import check_start, transition_ports
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Count, Flag, OptionalFilePath, Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    BundleOutput,
    Input,
    MessageInput,
    MessageOutput,
)
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.filters.spacecraft import (
    JACOBIANS,
    STATE,
    TRANSITIONS,
    mekf_correct_model,
    mekf_predict_model,
)
from terrafix.models.filters.updates import UPDATES
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.gravity import GRAVITY_MODELS
from terrafix.models.motion.gravity_field import chosen_field
from terrafix.models.motion.satellite import Forces
from terrafix.models.sensors.sar import IN_TRACK


class MekfPredict(SymbolicComponent):
    """Dead reckoning between fixes, and the covariance of its error."""

    default_rate = Rate(hz=100)

    gravity = Choice(
        (*GRAVITY_MODELS, "harmonics"), "j2", doc="gravity field of the filter: harmonics of a file"
    )
    degree = Count(20, minimum=2, doc="and order of the harmonics")
    gravity_file = OptionalFilePath(doc="field (.gfc) in place of EGM2008 to degree 70")
    transition = Choice(
        TRANSITIONS, "exact", doc="printed: the paper's, without Coriolis (negative control)"
    )
    mu = Parameter(EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial radius")
    j2 = Parameter(EARTH.j2, doc="second zonal coefficient")
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation")
    pole = Parameter(0.0, shape=(2,), unit="rad", doc="polar motion x, y (harmonics)")
    accel_psd = Parameter(0.0, unit="m^2/s^3", minimum=0.0, doc="process noise of velocity")
    misalignment_psd = Parameter(
        0.0, unit="rad^2/s", minimum=0.0, doc="process noise of the misalignment"
    )
    misalignment_sigma0 = Parameter(unit="rad", positive=True, doc="at t = 0, per axis")

    start = MessageInput(fields=KNOWN_STATE, needed_at_start=True, doc="last known state, at t = 0")
    posterior = MessageInput(fields=ESTIMATE, at="start", doc="corrected estimate")
    delta_v_b = Input((3,), unit="m/s", frame="b", doc="measured velocity increment")
    q_be = Input((4,), unit="1", frame="b", doc="measured attitude, Earth-fixed to body")
    prior = BundleOutput(ESTIMATE, doc="estimate before any fix of this instant")

    def takes(self, name: str) -> bool:
        """Whether a parameter has any effect, as the choices are now."""
        if name in ("degree", "gravity_file"):
            return bool(self.setting("gravity") == "harmonics")
        return super().takes(name)

    def _initialize_impl(self) -> None:
        super()._initialize_impl()
        check_start(self)

    def build_model(self) -> Model:
        """Build the model for the chosen gravity and transition."""
        return mekf_predict_model(self._field(), self.transition)

    def _field(self) -> str | Forces:
        if self.gravity != "harmonics":
            return str(self.gravity)
        return Forces(chosen_field(self.gravity_file, self.degree))


class SmoothedMekfPredict(MekfPredict):
    """Dead reckoning between fixes that puts out what a smoother of the recorded run needs."""

    error_transition, transition_since = transition_ports(STATE)

    def build_model(self) -> Model:
        """Build the model for the chosen gravity and transition."""
        return mekf_predict_model(self._field(), self.transition, smoothed=True)


class SurroundedMekfPredict(MekfPredict):
    """Dead reckoning with harmonics, Sun, Moon and tide, about the axis that surroundings tell."""

    gravity = Choice(("harmonics",), "harmonics", doc="gravity field of the filter")
    tide = Flag(True, doc="tide of the solid Earth besides Sun and Moon")

    surroundings = BundleInput(ENVIRONMENT, doc="rotation, Sun and Moon of an environment")

    def _field(self) -> Forces:
        field = chosen_field(self.gravity_file, self.degree)
        return Forces(field, sun=True, moon=True, tide=self.tide)


class MekfCorrect(SymbolicComponent):
    """Correction of the prior by a fix, where there is one that passes the gate."""

    default_rate = Rate("8.2", offset="8.2")

    update = Choice(UPDATES, "ekf", doc="how the measurement is weighed")
    in_track = Choice(
        IN_TRACK,
        "speed",
        doc="what the fix's fourth element is: the speed, or the velocity that focused an image",
    )
    jacobian = Choice(
        JACOBIANS, "exact", doc="wrong-sign: of the misalignment's part (negative control)"
    )
    look = Parameter(
        unit="rad", doc="off-nadir angle of the nominal boresight, positive to the right"
    )
    squint = Parameter(0.0, unit="rad", doc="forward angle of the nominal boresight")
    underweighting = Parameter(0.2, minimum=0.0, doc="Lear's factor on H P H'")
    underweighted_updates = Parameter(0.0, minimum=0.0, doc="how many fixes it applies to")
    gate = Parameter(
        np.inf,
        shape=(4,),
        infinite=True,
        positive=True,
        doc="largest NIS accepted with 1 to 4 elements; infinity accepts all",
    )

    prior = BundleInput(ESTIMATE, doc="estimate before the fix")
    fix = MessageInput(fields=FIX, doc="the fix")
    q_be = Input((4,), unit="1", frame="b", doc="measured attitude, Earth-fixed to body")
    estimate = BundleOutput(ESTIMATE, doc="the posterior where there is one, else the prior")
    posterior = MessageOutput(fields=ESTIMATE, doc="the estimate, only where it was corrected")
    innovation = MessageOutput(fields=INNOVATION, doc="what became of the fix")

    def build_model(self) -> Model:
        """Build the model for the chosen update and measurement."""
        return mekf_correct_model(self.update, self.in_track, self.jacobian)
