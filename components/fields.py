"""What passes between components, declared once: fields of messages, shapes of shared arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.cosim.memory.fields import Field

STATE_AXES = (
    *("r_x", "r_y", "r_z"),
    *("v_x", "v_y", "v_z"),
    *("mu_x", "mu_y", "mu_z"),
)
MEASURED = ("tan_azimuth", "tan_elevation", "slant_range", "in_track_velocity")
MEASURED_UNITS = ("1", "1", "m", "m/s")
XYZ = ("x", "y", "z")

KNOWN_STATE = {
    "r_e": Field((3,), "m", "e", labels=XYZ, doc="position"),
    "v_e": Field((3,), "m/s", "e", labels=XYZ, doc="velocity relative to the Earth"),
    "P": Field((6, 6), "1", doc="covariance of position [m] and velocity [m/s]"),
}
"""A position and velocity known with a covariance."""

AIR = {
    "r_e": Field((3,), "m", "e", labels=XYZ, doc="where it holds"),
    "log_density": Field((), "1", doc="natural logarithm of the density in kg/m^3"),
    "gradient": Field((3,), "1/m", "e", labels=XYZ, doc="of that logarithm"),
}
"""Density of the air about a place."""

ESTIMATE = {
    "r_e": Field((3,), "m", "e", labels=XYZ, doc="position"),
    "v_e": Field((3,), "m/s", "e", labels=XYZ, doc="velocity relative to the Earth"),
    "q_mu": Field((4,), "1", "s", doc="antenna misalignment, nominal to true antenna frame"),
    "P": Field(
        (9, 9), "1", doc="covariance of position [m], velocity [m/s] and misalignment [rad] error"
    ),
}
"""What the spacecraft filter knows."""

FIX = {
    "y": Field((4,), MEASURED_UNITS, labels=MEASURED, doc="measured elements"),
    "r_f_e": Field((3,), "m", "e", labels=XYZ, doc="geocoded center pixel"),
    "R": Field((4, 4), "1", doc="covariance of the noise of y, in its units"),
    "D": Field((3, 3), "m^2", "e", doc="covariance of the geocoding error of r_f_e"),
    "present": Field((4,), "1", labels=MEASURED, doc="1 where an element was measured, else 0"),
}
"""A fix from one SAR image: up to four elements and the ground point they refer to."""

INNOVATION = {
    "residual": Field((4,), MEASURED_UNITS, labels=MEASURED, doc="measured minus predicted"),
    "sigma": Field((4,), MEASURED_UNITS, labels=MEASURED, doc="predicted, not underweighted"),
    "nis": Field((), "1", doc="normalized innovation squared, not underweighted"),
    "dof": Field((), "1", doc="number of elements used"),
    "accepted": Field((), "1", doc="1 if the fix corrected the estimate, else 0"),
    "reason": Field((), "1", doc="index into terrafix.models.filters.measurement.REASONS"),
}
"""What a correction says about the fix it was given."""

ACQUISITION = {
    "first_time": Field((), "s", doc="of the first line, after the time of validity"),
    "near_range": Field((), "m", doc="slant range of the first cell"),
    "beam_range": Field((), "m", doc="slant range to where the beam's center meets the ground"),
    "beam_doppler": Field((), "Hz", doc="absolute Doppler frequency of the beam's center"),
    "time_sigma": Field((), "s", doc="standard error of the times of its lines"),
    "side": Field((), "1", doc="1: to the right of the track, -1: to the left"),
}
"""When and where an echo was received; valid at the time its middle line was."""

IMAGE = {
    "index": Field((), "1", doc="which of the shared images is this member's"),
    "row": Field((), "1", doc="row of the beam's center on it, fractional"),
    "column": Field((), "1", doc="column of the beam's center on it, fractional"),
    "slant_range": Field((), "m", doc="measured, to the beam's center"),
    "sine": Field((), "1", doc="of the angle of the beam's center ahead of broadside"),
    "velocity": Field((), "m/s", doc="effective velocity that focuses it"),
    "velocity_sigma": Field((), "m/s", doc="standard error of that velocity"),
    "focused": Field((), "1", doc="1 where autofocus named that velocity, 0 where it refused"),
    "row_time": Field((), "s", doc="from row to row, when the beam's center passes"),
    "column_range": Field((), "m", doc="slant range from column to column"),
    "time_sigma": Field((), "s", doc="standard error of the times of its rows"),
    "side": Field((), "1", doc="1: to the right of the track, -1: to the left"),
}
"""An image formed with a member's own estimate."""

RADAR: dict[str, Any] = {
    "shape": (6,),
    "unit": ("Hz", "Hz", "Hz", "Hz/s", "s", "Hz"),
    "labels": (
        *("carrier", "prf", "sample_rate"),
        *("chirp_rate", "pulse_length", "doppler_bandwidth"),
    ),
}
"""What a radar sends, and how its echo is sampled."""

ECHO: dict[str, Any] = {"shape": (None, None), "dtype": np.complex64}
"""Raw echo: lines, range cells."""

HEIGHT: dict[str, Any] = {"shape": (None, None), "unit": "m", "dtype": np.float32}
"""Heights of a terrain: latitudes, longitudes."""

GRID: dict[str, Any] = {
    "shape": (5,),
    "unit": ("rad", "rad", "rad", "rad", "1"),
    "labels": ("latitude0", "longitude0", "latitude_step", "longitude_step", "mirrored"),
}
"""Where the heights of a terrain lie: its first point, its spacing, and 1 where it is mirrored."""

SURFACE: dict[str, Any] = {"shape": (8,)}
"""What a terrain looks like to a radar: seed, strengths of its texture, bright points, detail, and
its cover, an index into terrafix.models.radar.cover.COVERS."""

AMPLITUDE: dict[str, Any] = {"shape": (None, None), "dtype": np.float32}
"""Amplitude of a geocoded reference: rows, columns."""

TIES: dict[str, Any] = {"shape": (None,)}
"""Rows, or columns, of a reference's tie points."""

PLACES: dict[str, Any] = {"shape": (None, None, 3), "unit": ("rad", "rad", "m")}
"""Latitude, longitude and height of a reference's tie points: their rows, their columns."""

MOST_VERTICES = 2048
"""Of an outline in an image."""

CONTOUR: dict[str, Any] = {"shape": (MOST_VERTICES, 2), "unit": "px", "ragged": True}
"""Vertices of the outline of a lake in an image, not closed: the shore, then islands, between which
a row is not a number."""

FRAME: dict[str, Any] = {"shape": (256, 320)}
"""An image of the camera that looks for lakes: rows, columns."""

LOOK = {
    "lake": Field((), "1", doc="number of the lake in its catalog"),
    "sigma": Field((), "px", doc="of the noise of each coordinate of each vertex"),
    "whole": Field((), "1", doc="1 where all of the outline is in the frame, else 0"),
    "share": Field((), "1", doc="of its vertices, that are in the frame"),
}
"""What lake an outline is of, and how well it is known."""

LAKE_MOMENTS = ("area", "center_u", "center_v", "moment_uu", "moment_vv", "moment_uv")
LAKE_UNITS = ("px^2", "px", "px", "px^2", "px^2", "px^2")

LAKE_FIX = {
    "y": Field((6,), LAKE_UNITS, labels=LAKE_MOMENTS, doc="measured moments of an outline"),
    "lake": Field((1,), "1", doc="number of the lake in its catalog"),
    "R": Field((6, 6), "1", doc="covariance of the noise of y, in its units"),
    "present": Field((6,), "1", labels=LAKE_MOMENTS, doc="1 where an element was measured, else 0"),
}
"""A fix from one look at a lake."""

ORBIT_ESTIMATE = {
    "r": Field((3,), "m", "i", labels=XYZ, doc="position"),
    "v": Field((3,), "m/s", "i", labels=XYZ, doc="velocity"),
    "age": Field((1,), "s", doc="since its correction"),
    "P": Field((6, 6), "1", doc="covariance of position [m] and velocity [m/s] error"),
}
"""What a filter of an orbit knows."""

SHORE_VERTICES = 256
"""Of an outline that shores are matched to."""

SHORE_FIX = {
    "y": Field((6,), "1", doc="weighted sums of the pixels of a shore, in sigmas of their noise"),
    "lake": Field((1,), "1", doc="number of the lake in its catalog"),
    "weights": Field((6 * SHORE_VERTICES * 2,), "1/px", doc="sum, vertex of its outline, axis"),
    "R": Field((6, 6), "1", doc="covariance of the noise of y"),
    "present": Field((6,), "1", doc="1 where the shore tells a sum, else 0"),
}
"""A fix from what is seen of a lake's shore."""

CORNERS: dict[str, Any] = {"shape": (None, 3), "unit": "m", "frame": "e"}
"""Vertices of the rings of all lakes, one ring after the other, not closed."""

STARTS: dict[str, Any] = {"shape": (None,), "dtype": np.int64}
"""Where rings start in their vertices, and where the last one ends: rings + 1 numbers.

The first rings are the shores of the lakes, in their order and counterclockwise seen from above;
those after them are islands, clockwise.
"""

OWNER: dict[str, Any] = {"shape": (None,), "dtype": np.int64}
"""Which lake each ring belongs to: k of the shore of lake k."""

CENTERS: dict[str, Any] = {"shape": (None, 3), "unit": "m", "frame": "e"}
"""Center of each lake, at its surface."""

RADII: dict[str, Any] = {"shape": (None,), "unit": "m"}
"""From the center of each lake to its farthest vertex."""

AREAS: dict[str, Any] = {"shape": (None,), "unit": "m^2"}
"""Area of each lake on the ellipsoid, of the rings that are there: its islands less."""

SCENE: dict[str, Any] = {"shape": (None, None), "dtype": np.float32}
"""An image of the ground: rows, columns."""

SCENE_PLACE: dict[str, Any] = {"shape": (2,), "labels": ("column", "row")}
"""Column and row of the target in a scene."""

SCENE_GRID: dict[str, Any] = {"shape": (2, 2), "unit": "px/m"}
"""Columns and rows of a scene by meters north and east."""

WINDOW = 48
"""Rows and columns that are read out about the middle of a frame."""

FIELD = 192
"""Rows and columns of the first frame, in which the others are sought."""

WINDOW_IMAGE: dict[str, Any] = {"shape": (WINDOW, WINDOW), "dtype": np.float32}
FIELD_IMAGE: dict[str, Any] = {"shape": (FIELD, FIELD), "dtype": np.float32}

VIEW: dict[str, Any] = {"shape": (2, 2), "unit": "px/m"}
"""Pixels north and east in a frame by meters north and east on the ground."""

NORTH_EAST = ("north", "east")

PRINTED_TRACK = {
    "r": Field((3,), "m", "i", labels=XYZ, doc="position"),
    "v": Field((3,), "m/s", "i", labels=XYZ, doc="velocity"),
    "pitch": Field((1,), "rad", doc="error of pointing to the north of the frame"),
    "roll": Field((1,), "rad", doc="error of pointing to its east"),
    "target": Field((2,), "px", labels=NORTH_EAST, doc="place of the target in the frame"),
    "P": Field((10, 10), "1", doc="covariance of the error, in units of its elements"),
}
"""What the ten states of the geolocation filter are."""

TRACK = PRINTED_TRACK | {
    "bias": Field((2,), "px", labels=NORTH_EAST, doc="what the first frame does not tell"),
    "mismatch": Field((2,), "px", labels=NORTH_EAST, doc="error of matches that lasts"),
    "P": Field((14, 14), "1", doc="covariance of the error, in units of its elements"),
}
"""The same, with what matches to the first frame leave."""

TARGET_FIX = {
    "y": Field((2,), "px", labels=NORTH_EAST, doc="measured place of the target in the frame"),
    "from_first": Field((4,), "1", doc="pixels of this frame by pixels of the first one"),
    "R": Field((2, 2), "1", doc="covariance of the noise of y, in its units"),
    "present": Field((2,), "1", labels=NORTH_EAST, doc="1 where an element was measured, else 0"),
}
"""A fix from one frame."""
HEIGHT_FIX = {
    "y": Field((1,), "m", labels=("height",), doc="measured"),
    "R": Field((1, 1), "1", doc="covariance of the noise of y, in its units"),
    "present": Field((1,), "1", labels=("height",), doc="1 where an element was measured, else 0"),
}
"""What an altimeter measures."""

STAR_FIX = {
    "q_bi": Field((4,), "1", "b", doc="measured attitude, inertial to body"),
    "R": Field((3, 3), "rad^2", "b", doc="covariance of its rotation error, in body axes"),
    "taken": Field((), "s", doc="when the stars were seen"),
}
"""What a star tracker measures."""

DIRECTION_FIX = {
    "y": Field((3,), "1", "b", labels=XYZ, doc="measured direction, of unit length"),
    "R": Field((3, 3), "1", "b", doc="its covariance, of rank two"),
}
"""What a sensor of a direction measures."""

GNSS_LABELS = tuple(f"{what}_{axis}" for what in "rv" for axis in XYZ)
GNSS_FIX = {
    "y": Field((6,), ("m",) * 3 + ("m/s",) * 3, labels=GNSS_LABELS, doc="measured, Earth-fixed"),
    "R": Field((6, 6), "1", doc="covariance of the error of y, in its units"),
    "present": Field((6,), "1", labels=GNSS_LABELS, doc="1 where an element was measured, else 0"),
}
"""Position and velocity that a receiver measures."""

CLEARANCE_FIX = {
    "y": Field((1,), "m", labels=("clearance",), doc="measured"),
    "R": HEIGHT_FIX["R"],
    "present": Field(
        (1,), "1", labels=("clearance",), doc="1 where an element was measured, else 0"
    ),
}
"""What a radar altimeter measures."""

PLACE_FIX = {
    "y": Field((2,), "m", labels=("north", "east"), doc="measured"),
    "p_e": Field((3,), "m", "e", labels=XYZ, doc="place that they count from"),
    "R": Field((2, 2), "1", doc="covariance of the noise of y, in its units"),
    "present": Field(
        (2,), "1", labels=("north", "east"), doc="1 where an element was measured, else 0"
    ),
}
"""What a matched profile measures."""

SHIFT = ("range", "cross_range", "map_drift")
SHIFT_FIX = {
    "y": Field((3,), ("m", "m", "m/s"), labels=SHIFT, doc="measured"),
    "p_t_e": Field((3,), "m", "e", labels=XYZ, doc="ground point that it is of"),
    "speed": Field((1,), "m/s", doc="that the image was formed with"),
    "f_b": Field((3,), "m/s^2", "b", labels=XYZ, doc="mean specific force, in axes of its end"),
    "t_center": Field((1,), "s", doc="of the aperture"),
    "R": Field((3, 3), "1", doc="covariance of the noise of y, in its units"),
    "F": Field((3, 3), "m/s^2^2", "b", doc="covariance of the error of f_b"),
    "present": Field((3,), "1", labels=SHIFT, doc="1 where an element was measured, else 0"),
}
"""What the image of an aperture measures."""

MOTION = {
    "r_e": Field((3,), "m", "e", labels=XYZ, doc="position"),
    "v_e": Field((3,), "m/s", "e", labels=XYZ, doc="velocity relative to the Earth"),
    "q_be": Field((4,), "1", "b", doc="attitude, e to body"),
    "accel_bias_b": Field((3,), "m/s^2", "b", labels=XYZ),
    "gyro_bias_b": Field((3,), "rad/s", "b", labels=XYZ),
    "altimeter_bias": Field((1,), "m"),
    "range_bias": Field((1,), "m"),
    "cross_range_bias": Field((1,), "m"),
    "r_e_at_aperture": Field((3,), "m", "e", labels=XYZ, doc="at the aperture's center"),
    "v_e_at_aperture": Field((3,), "m/s", "e", labels=XYZ, doc="at the aperture's center"),
    "t_aperture": Field((1,), "s", doc="of that center"),
    "P": Field((24, 24), "1", doc="covariance of the error, in units of its elements"),
}
"""What the navigator of an aircraft with a radar knows."""

PULSES = {
    "index": Field((), "1", doc="which of the shared echoes is this member's"),
    "near_range": Field((), "m", doc="slant range of the first cell"),
    "side": Field((), "1", doc="1: to the right of the track, -1: to the left"),
    "axis_b": Field((3,), "1", "b", labels=XYZ, doc="along the antenna's long side"),
    "length": Field((), "s", doc="of the aperture"),
}
"""How an aperture was received, from a track; valid at its center."""

APERTURE_IMAGE = {
    "index": Field((), "1", doc="which of the shared images is this member's"),
    "rows": Field((), "1", doc="of it"),
    "columns": Field((), "1", doc="of it"),
    "first_time": Field((), "s", doc="of zero Doppler of row 0, after the center"),
    "row_time": Field((), "s", doc="between rows"),
    "near_range": Field((), "m", doc="closest range of column 0"),
    "spacing": Field((), "m", doc="closest range between columns"),
    "velocity": Field((), "m/s", doc="that it was focused with"),
    "r_e": Field((3,), "m", "e", labels=XYZ, doc="of the line's middle, as estimated"),
    "v_e": Field((3,), "m/s", "e", labels=XYZ, doc="of the line, as estimated"),
    "side": Field((), "1", doc="1: to the right of the track, -1: to the left"),
    "drift": Field((), "m/s", doc="what map drift found, less the speed of the line"),
    "drift_sigma": Field((), "m/s", doc="its standard error"),
    "focused": Field((), "1", doc="1 where map drift found it, 0 where it refused"),
}
"""An image of an aperture, formed with a member's own track; valid at the aperture's center."""

PHASE: dict[str, Any] = {"shape": (None, None), "dtype": np.complex64}
"""Phase history of a spotlight radar: pulses, frequencies."""

TRACK_ERROR = {
    "position": Field((3,), "m", "scene", labels=XYZ, doc="believed less true, in the middle"),
    "velocity": Field((3,), "m/s", "scene", labels=XYZ, doc="believed less true"),
}
"""What a believed track is off by."""

SPOTLIGHT_FIX = {
    "range": Field((), "m", doc="from the middle of the track to the middle of the scene"),
    "ahead": Field((), "m", doc="distance of the middle of the scene ahead of it, by Doppler"),
    "speed": Field((), "m/s", doc="believed, by which Doppler frequencies are meters"),
    "velocity": Field((), "m/s", doc="that focuses the image"),
    "focused": Field((), "1", doc="1 where map drift found it, 0 where it refused"),
    "accepted": Field((), "1", doc="1 where the image was recognized, else 0"),
}
"""What a spotlight image says about its track."""

START = {
    "r_e": Field((3,), "m", "e", labels=XYZ, doc="position"),
    "v_e": Field((3,), "m/s", "e", labels=XYZ, doc="velocity relative to the Earth"),
}
"""Where a satellite is at t = 0."""

ENVIRONMENT = {
    "time": Field((), "s", doc="that the rest holds for"),
    "omega_e": Field((3,), "rad/s", "e", labels=XYZ, doc="rotation of the Earth-fixed axes"),
    "q_ei": Field((4,), "1", "e", doc="inertial (GCRF) to Earth-fixed (ITRF)"),
    "sun_e": Field((3,), "m", "e", labels=XYZ, doc="Sun, from the Earth's center"),
    "sun_rate_e": Field((3,), "m/s", "e", labels=XYZ, doc="its inertial velocity"),
    "moon_e": Field((3,), "m", "e", labels=XYZ, doc="Moon, from the Earth's center"),
    "moon_rate_e": Field((3,), "m/s", "e", labels=XYZ, doc="its inertial velocity"),
}
"""What surrounds a satellite, at the time of publication; turned inside models until the next."""
