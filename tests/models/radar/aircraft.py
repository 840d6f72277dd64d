"""A light aircraft with an X-band radar over relief: its tracks, what it sees, an earlier pass."""

import warnings
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from terrafix.components.sensors.compiled import pulse_sums
from terrafix.models.geometry.geodesy import chart_scales
from terrafix.models.geometry.ground import FlatGround
from terrafix.models.images.reference import earlier_pass
from terrafix.models.maps.dem import Dem, flat_dem
from terrafix.models.motion.sampled import SampledArc
from terrafix.models.radar.aperture import Aperture
from terrafix.models.radar.aperture_image import aperture_echo
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.footprint import Footprint
from terrafix.models.radar.lit_ground import LitGround, scatterers_at
from terrafix.models.radar.pulse_echo import pulse_echo
from terrafix.models.radar.scene import Scene

RADAR = Radar(9.6e9, 600.0, 240e6, 100e12, 2e-6, 400.0)
GROUND = FlatGround(0.65, 0.2)
SPEED, HEIGHT, RANGE = (
    70.0,
    1000.0,
    1562.0,
)  # [m/s], [m], slant range of the middle of the swath [m]
N_CELLS = 320
NEAR = RANGE - N_CELLS / 2 * RADAR.range_spacing
BEAM = np.radians(5.0)

with warnings.catch_warnings():  # without a compiler NumPy does, and says so
    warnings.simplefilter("ignore")
    SUMS = pulse_sums()


def relief(rms=10.0, n=300, step=10.0, length=150.0, seed=3):
    """Smooth random heights about the origin of GROUND [m]."""
    z = gaussian_filter(
        np.random.default_rng(seed).standard_normal((n, n)), length / step / 2, mode="wrap"
    )
    north, east = (step / scale for scale in chart_scales(GROUND.latitude))
    return Dem(
        (z * rms / z.std()).astype(np.float32),
        GROUND.latitude - n / 2 * north,
        GROUND.longitude - n / 2 * east,
        north,
        east,
    )


HILLS = relief().tiled()
FIELD = Scene(flat_dem(0.0), points_per_km2=0.0, parcels_db=0.0, smooth_db=0.0, fine_db=0.0)
"""Nothing to see: no relief, no texture, no points."""
LAND = Scene(HILLS, seed=2, points_per_km2=300.0, detail=10)


def track(r=(0.0, -1200.0, -HEIGHT), heading=0.0, crab=0.0, acceleration=(0.0, 0.0, 0.0), n=600):
    """Times, places and antenna axes of an aperture, centered at t = 0."""
    t = (np.arange(n) - (n - 1) / 2) / RADAR.prf
    v = SPEED * np.array([np.cos(heading), np.sin(heading), 0.0])
    places = np.asarray(r) + np.outer(t, v) + 0.5 * np.outer(t * t, acceleration)
    axis = np.array([np.cos(heading + crab), np.sin(heading + crab), 0.0])
    return t, places, np.tile(axis, (n, 1))


def aperture(t, r, axis, side=1, n_cells=N_CELLS):
    return Aperture(RADAR, t, r, axis, BEAM, NEAR, n_cells, side)


def echo_of(scene, own, seed, *, points=True, per_cell=8.0):
    rng = np.random.default_rng(seed)
    lit = LitGround(scene, GROUND, own)
    parts = [lit.clutter(rng, per_cell)] + ([lit.points()] if points else [])
    return pulse_echo(parts, own, SUMS, rng)


def point_echo(p, own, snr_db=None, strength=1.0):
    rng = np.random.default_rng(1)
    reflection = strength * np.exp(2j * np.pi * rng.random(len(p)))
    return pulse_echo([scatterers_at(p, reflection)], own, SUMS, rng, snr_db=snr_db)


def seen_by(echo, t, r, axis, height=0.0, **options):
    """Echo as a navigator prepares it who believes in a track."""
    return aperture_echo(echo, RADAR, NEAR, t, r, axis, GROUND, height, **options)


def reference(scene, center, seed, *, length=200.0, displaced=(0.0, 30.0, -20.0), side=1):
    """An earlier pass over the same scene: displaced, with speckle of its own, 0.35 m."""
    s = np.arange(-length / SPEED, length / SPEED, 0.02)
    arc = SampledArc(s, np.asarray(center) + displaced + np.outer(s, [SPEED, 0.0, 0.0]))
    n = int(length / SPEED * RADAR.prf)
    radar = replace(RADAR, doppler_bandwidth=200.0)
    first = -(n - 1) / 2 / radar.prf
    footprint = Footprint(arc, radar, first, n, NEAR - 60, N_CELLS + 200, 0.0, GROUND, side)
    return earlier_pass(scene, footprint, (3, 1), np.random.default_rng(seed))
