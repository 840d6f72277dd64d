"""The filters of a satellite that tracks a target in its images: as printed, and right."""

from __future__ import annotations

from terrafix.components.filters.family import (
    FilterCorrect,
    FilterPredict,
    estimate_fields,
    fix_fields,
    start_fields,
    starting_sigmas,
)
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, MessageInput, MessageOutput
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.filters.geolocation import (
    ATTITUDES,
    FIRST_FRAME,
    LOCATED,
    MATCHED,
    MISPRINTED,
    OFFSET,
    POINTING,
    PRINTED,
    TRACKING,
    known_pointing_model,
    pointing_fix_model,
    printed_process,
    tracking_process,
)
from terrafix.models.filters.models import predict_model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.sensors.staring import GEOMETRIES

_PRINTED = ("r", "v", "pitch", "roll", "target")
_TOLD = (*_PRINTED, "bias", "mismatch")


class _KnownPointing(SymbolicComponent):
    """What is known at t = 0: the nominal orbit, and that the target is in the middle."""

    default_rate = Rate(times=["0"])

    geometry = Choice(GEOMETRIES, "wgs84", doc="as of the satellite")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="of the sphere")
    pixel = Parameter(100.0, unit="m", positive=True, doc="its size on the ground (nadir)")
    pixel_angle = Parameter(1e-4, unit="rad", positive=True, doc="that a pixel sees (stars)")
    position_sigma = Parameter(shape=(3,), unit="m", positive=True, doc="per axis")
    velocity_sigma = Parameter(shape=(3,), unit="m/s", positive=True, doc="per axis")
    attitude_sigma = Parameter(unit="rad", positive=True, doc="of pitch and of roll")

    r_nominal = Input((3,), unit="m", frame="i", doc="position that it should have")
    v_nominal = Input((3,), unit="m/s", frame="i", doc="velocity, likewise")
    aim = Input((3,), unit="m", frame="i", doc="point that the camera is aimed at")


class KnownPointing(_KnownPointing):
    """The nominal orbit, told at t = 0 with the covariance of what follows from it."""

    first_frame = Choice(
        FIRST_FRAME, "unknown", doc="where the target lies in it: as the filter has it, or measured"
    )
    georeference_sigma = Parameter(
        0.1,
        unit="px",
        positive=True,
        doc="of the place in the first frame: what lasts of its error (georeferenced)",
    )
    mismatch_sigma = Parameter(
        0.0,
        unit="px",
        minimum=0.0,
        doc="of the error of matches that lasts, at the start: none in the first frame itself, "
        "but on a map",
    )

    start = MessageOutput(fields=start_fields(TRACKING, _TOLD), doc="estimate at t = 0")

    def build_model(self) -> Model:
        """Build the model for the chosen geometry and first frame."""
        return known_pointing_model(TRACKING, self.geometry, self.first_frame)


class PrintedKnownPointing(_KnownPointing):
    """The same of the ten printed states."""

    start = MessageOutput(fields=start_fields(PRINTED, _PRINTED), doc="estimate at t = 0")

    def build_model(self) -> Model:
        """Build the model for the chosen geometry."""
        return known_pointing_model(PRINTED, self.geometry)


class TargetPredict(FilterPredict):
    """A satellite near its nominal orbit between frames, and where its target lies in them."""

    default_rate = Rate("1")
    error_state, process, told = TRACKING, tracking_process("wgs84"), _TOLD

    posterior = MessageInput(
        fields=estimate_fields(TRACKING),
        at="start",
        optional=True,
        doc="corrected estimate; a profile without images has none",
    )

    geometry = Choice(GEOMETRIES, "wgs84", doc="as of the satellite")
    attitude = Choice(ATTITUDES, "wander", doc="what pitch and roll follow: a process, or a gyro")
    mu = Parameter(EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial, or of the sphere")
    j2 = Parameter(EARTH.j2, doc="second zonal coefficient; 0: two bodies")
    accel_psd = Parameter(unit="m^2/s^3", minimum=0.0, doc="of white acceleration")
    attitude_sigma = Parameter(5e-4, unit="rad", positive=True, doc="of pitch and of roll (wander)")
    attitude_time = Parameter(600.0, unit="s", positive=True, doc="that they are correlated over")
    pixel = Parameter(100.0, unit="m", positive=True, doc="its size on the ground (nadir)")
    pixel_angle = Parameter(1e-4, unit="rad", positive=True, doc="that a pixel sees (stars)")
    angle_random_walk = Parameter(0.0, unit="rad/s^0.5", minimum=0.0, doc="of the gyro (gyro)")
    mismatch_sigma = Parameter(
        0.1, unit="px", positive=True, doc="of the error of matches that lasts"
    )
    mismatch_time = Parameter(5.0, unit="s", positive=True, doc="that it lasts")

    aim = Input((3,), unit="m", frame="i", doc="point that the camera is aimed at")
    r_nominal = Input((3,), unit="m", frame="i", doc="position that it should have")
    delta_theta_b = Input(
        (3,), unit="rad", frame="b", default=0.0, doc="of pitch and roll, by a gyro (gyro)"
    )

    def build_model(self) -> Model:
        """Build the model of the process for the chosen geometry."""
        return predict_model(
            "target_predict",
            self.error_state,
            tracking_process(self.geometry, self.attitude),
            told=self.told,
            sigmas=starting_sigmas(self.error_state, self.told, self.sigmas),
            restarts=True,
        )


class TargetCorrect(FilterCorrect):
    """By frames that were matched to the first one."""

    default_rate = Rate("1")
    error_state, observation = TRACKING, MATCHED


class PointingCorrect(FilterCorrect):
    """By pitch and roll, as a star tracker tells them."""

    default_rate = Rate("1")
    error_state, observation = TRACKING, POINTING


class PointingFix(SymbolicComponent):
    """Pitch and roll from what an attitude sensor measures."""

    default_rate = Rate("1")

    noise_sigma = Parameter(unit="rad", positive=True, doc="of the sensor, per sample and axis")

    q_be = Input((4,), frame="b", doc="measured turn off the commanded attitude")
    fix = MessageOutput(fields=fix_fields(POINTING), doc="pitch and roll")

    def build_model(self) -> Model:
        """Build the model."""
        return pointing_fix_model()


class LocatedTargetCorrect(FilterCorrect):
    """By frames that were matched to a map."""

    default_rate = Rate("1")
    error_state, observation = TRACKING, LOCATED


class PrintedTargetPredict(FilterPredict):
    """Ten states: the target in the frame is a random walk."""

    default_rate = Rate("1")
    error_state, process, told = PRINTED, printed_process(), _PRINTED

    posterior = MessageInput(
        fields=estimate_fields(PRINTED),
        at="start",
        optional=True,
        doc="corrected estimate; a profile without images has none",
    )

    mu = Parameter(EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial")
    j2 = Parameter(EARTH.j2, doc="second zonal coefficient; 0: two bodies")
    accel_psd = Parameter(unit="m^2/s^3", minimum=0.0, doc="of white acceleration")
    attitude_sigma = Parameter(unit="rad", positive=True, doc="of pitch and of roll")
    attitude_time = Parameter(600.0, unit="s", positive=True, doc="that they are correlated over")
    target_psd = Parameter(unit="px^2/s", minimum=0.0, doc="of the target's walk in the frame")


class PrintedTargetCorrect(FilterCorrect):
    """Ten states, by the whole offset of the target."""

    default_rate = Rate("1")
    error_state, observation = PRINTED, OFFSET


class MisprintedTargetCorrect(FilterCorrect):
    """Ten states, by an offset less the attitude's part, which no image can tell: as printed."""

    default_rate = Rate("1")
    error_state, observation = PRINTED, MISPRINTED

    pixel = Parameter(100.0, unit="m", positive=True, doc="its size on the ground")
    aim = Input((3,), unit="m", frame="i", doc="point that the camera is aimed at")
