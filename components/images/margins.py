"""What the images of a flight have to spare, told before it: echo, reference, autofocus, memory.

Of a satellite whose orbit is known at the start, over ground at height zero, for three sigma of
what is said then of the estimate's error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot

import numpy as np

from terrafix.components.images.reference import EarlierPass
from terrafix.components.sensors.echo import SceneEcho
from terrafix.components.shared import foreseen_side
from terrafix.components.truth.orbit import OrbitTruth
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.machine import require_memory
from terrafix.cosim.declare.component import Component, FedBy
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.maps.dem import flat_dem
from terrafix.models.motion.attitude import lvlh_quaternion_array
from terrafix.models.radar.boresight import Boresight, boresight_on_terrain
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.imaging import FARTHEST
from terrafix.models.radar.margins import (
    PEAK_OF_IMAGING,
    aperture_lines,
    focused_size,
    lines_needed,
    sigma_of,
)
from terrafix.models.sensors.effective_velocity import effective_velocity_array

SIGMAS = 3.0
_MIB = 2.0**20
_ALIGNED = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True)
class View:
    """A satellite's view at the start, and what its estimate is off by.

    Parameters
    ----------
    echo : SceneEcho
    radar : Radar
    r, v : ndarray, shape (3,)
        Earth-fixed [m], [m/s].
    beam : Boresight
        Of the aligned antenna.
    velocity, velocity_sigma : float
        Effective [m/s].
    misalignment_sigma : float
        [rad]
    doppler_sigma : float
        Of the centroid [Hz].
    """

    echo: SceneEcho
    radar: Radar
    r: FloatArray
    v: FloatArray
    beam: Boresight
    velocity: float
    velocity_sigma: float
    misalignment_sigma: float
    doppler_sigma: float


def view_of(former: Component, fed_by: FedBy) -> View | None:
    """The view of an image former's echo; None where what feeds it is not of the kinds known."""
    echo, predict = fed_by(former, "acquired"), fed_by(former, "prior")
    orbit = fed_by(echo, "r_e") if isinstance(echo, SceneEcho) else None
    start = fed_by(predict, "start") if predict is not None else None
    if not (
        isinstance(echo, SceneEcho)
        and isinstance(orbit, OrbitTruth)
        and predict is not None
        and "misalignment_sigma0" in predict.settings()
        and start is not None
        and {"position_sigma", "velocity_sigma"} <= set(start.settings())
    ):
        return None
    radar = Radar(*(float(echo.setting(name)) for name in Radar.__dataclass_fields__))
    angle, rate = (float(orbit.setting(name)) for name in ("earth_angle0", "rotation_rate"))
    r, v = earth_fixed_from_inertial_array(
        orbit.setting("r0_i"), orbit.setting("v0_i"), angle, rate
    )
    look, squint = (float(echo.setting(name)) for name in ("look", "squint"))
    try:
        beam = boresight_on_terrain(
            *(r, v, lvlh_quaternion_array(r, v), _ALIGNED, look, squint, flat_dem(0.0))
        )
    except ValueError:
        return None  # said by the echo, with the attitude and the ground as they are
    r_sigma, v_sigma = (start.setting(f"{name}_sigma") for name in ("position", "velocity"))

    def velocity(r: FloatArray, v: FloatArray) -> float:
        return float(effective_velocity_array(r, v, beam.point))

    mu = float(predict.setting("misalignment_sigma0"))
    along = (beam.point - r) / beam.slant_range
    closing = hypot(float(np.linalg.norm(along * v_sigma)), float(np.linalg.norm(v)) * mu)
    return View(
        *(echo, radar, r, v, beam, velocity(r, v)),
        sigma_of(velocity, r, v, r_sigma, v_sigma),
        mu,
        2 / radar.wavelength * closing,
    )


def foreseen_image(former: Component, fed_by: FedBy) -> Iterator[str]:
    """What an image former has to spare.

    Raises
    ------
    ConfigurationError
        If its image does not fit into the echo, or memory is short.
    """
    yield from foreseen_side(former, fed_by(former, "acquired"))
    view = view_of(former, fed_by)
    if view is None:
        return
    echo, radar = view.echo, view.radar
    lines, cells = echo.setting("n_lines"), echo.setting("n_cells")
    wanted = (
        former.setting("rows") * former.setting("azimuth_looks"),
        former.setting("columns") * former.setting("range_looks"),
    )
    distance = view.beam.slant_range
    focused = focused_size(radar, lines, cells, distance, view.velocity)
    spare = focused[0] - wanted[0], focused[1] - wanted[1]
    needed = (
        lines_needed(radar, wanted[0], cells, distance, view.velocity),
        cells - spare[1],
    )
    for n, name, size, other in (
        (spare[0], "n_lines", needed[0], "rows"),
        (spare[1], "n_cells", needed[1], "columns"),
    ):
        if n < 0:
            raise ConfigurationError(
                f"'{former.name}' wants an image of {wanted[0]} lines by {wanted[1]} cells, and of "
                f"{lines} by {cells} in '{echo.name}' {max(focused[0], 0.0):.0f} by "
                f"{max(focused[1], 0.0):.0f} are focused: the aperture is "
                f"{aperture_lines(radar, distance, view.velocity):.0f} lines, a pulse "
                f"{radar.n_pulse} cells\n  set {echo.name}.{name} to {int(np.ceil(size))} at "
                f"least, or {former.name}.{other} to less"
            )
    raw = 8.0 * lines * cells
    require_memory(
        former.name,
        (1 + PEAK_OF_IMAGING) * raw,
        f"an echo of {lines} lines of {cells} cells and its images",
        f"set {echo.name}.n_lines or {echo.name}.n_cells to less",
    )
    off = SIGMAS * view.velocity_sigma
    slower = view.velocity - off
    lost = focused[0] - focused_size(radar, lines, cells, distance, slower)[0]
    yield (
        f"'{echo.name}' has {spare[0]:.0f} lines and {spare[1]:.0f} cells to spare for the image "
        f"and its aperture; it takes {raw / _MIB:.0f} MiB, and forming images "
        f"{PEAK_OF_IMAGING * raw / _MIB:.0f} MiB more"
    )
    if lost > spare[0]:
        yield (
            f"{SIGMAS:g} sigma of the estimate, {off:.0f} m/s of effective velocity, make the "
            f"aperture {lost:.0f} lines longer, and {spare[0]:.0f} are to spare: members that are "
            f"so far off have no image where autofocus finds no velocity; set {echo.name}.n_lines "
            f"to {int(np.ceil(lines_needed(radar, wanted[0], cells, distance, slower)))}"
        )
    yield from _narrow_autofocus(view)


def _narrow_autofocus(view: View) -> Iterator[str]:
    off = SIGMAS * view.velocity_sigma
    if off > FARTHEST:
        yield (
            f"autofocus looks within {FARTHEST:g} m/s of the estimate's effective velocity, and "
            f"{SIGMAS:g} sigma of it are {off:.0f} m/s: members that are farther off get no fix of "
            "their velocity"
        )
    off = SIGMAS * view.doppler_sigma
    if off > view.radar.prf / 2:
        yield (
            f"{SIGMAS:g} sigma of the Doppler centroid, {off:.0f} Hz, are more than half of the "
            f"repetition frequency of {view.radar.prf:g} Hz: images are formed with several "
            "centroids, and the sharpest is kept"
        )


def foreseen_match(matcher: Component, fed_by: FedBy) -> Iterator[str]:
    """What the reference of an earlier pass has to spare for a misaligned antenna.

    The beam moves by R delta along the track, and by R delta tan(incidence) in slant range.

    Raises
    ------
    ConfigurationError
        If the image is larger than the reference.
    """
    former, reference = fed_by(matcher, "image"), fed_by(matcher, "amplitude")
    view = None if former is None else view_of(former, fed_by)
    if former is None or view is None or not isinstance(reference, EarlierPass):
        return
    radar, beam = view.radar, view.beam
    line = (beam.point - view.r) / beam.slant_range
    cosine = -float(line @ beam.point) / float(np.linalg.norm(beam.point))
    tangent = np.sqrt(1 - cosine**2) / cosine
    moved = SIGMAS * beam.slant_range * view.misalignment_sigma
    on_ground = view.velocity**2 / float(np.linalg.norm(view.v))  # speed of the beam
    for name, size, spacing, looks, reach, what in (
        ("rows", "n_lines", on_ground / radar.prf, "azimuth_looks", moved, "along the track"),
        ("columns", "n_cells", radar.range_spacing, "range_looks", moved * tangent, "in range"),
    ):
        wanted = former.setting(name) * former.setting(looks)
        spare = (reference.setting(size) - wanted) / 2 * spacing
        if spare < 0:
            raise ConfigurationError(
                f"an image of '{former.name}' has {wanted} {size[2:]}, and '{reference.name}' "
                f"{reference.setting(size)}: none lies within it\n"
                f"  set {reference.name}.{size} to {wanted + int(2 * reach / spacing)}, or "
                f"{former.name}.{name} to less"
            )
        if spare < reach:
            yield (
                f"{SIGMAS:g} sigma of misalignment move the image by {reach / 1e3:.1f} km {what}, "
                f"and '{reference.name}' reaches {spare / 1e3:.1f} km beyond it: members that are "
                f"farther off get no fix; set {reference.name}.{size} to "
                f"{wanted + int(2 * reach / spacing)}"
            )
