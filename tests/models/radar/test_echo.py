"""Simulated echo: against the time domain, on slopes, speckle and noise, and its scene."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.components.sensors.compiled import row_operations
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.maps.dem import Dem, flat_dem
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.autofocus import SharpnessCurve, autofocus
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, chirp_replica
from terrafix.models.radar.echo import (
    Acquisition,
    _alike,
    add_points,
    ideal_image,
    illuminated_footprint,
    received,
    simulated_echo,
)
from terrafix.models.radar.focusing import azimuth_compressed, range_doppler
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.scene import CELL, Scene, brightness
from terrafix.models.radar.speckle import scattered
from terrafix.models.sensors.effective_velocity import effective_velocity_array

RANGE = 861013.0  # [m], to the place that the boresight meets
PLAIN = {"parcels_db": 0.0, "smooth_db": 0.0, "fine_db": 0.0, "points_per_km2": 0.0}


@pytest.fixture(scope="module")
def arc(start_e):
    return OrbitArc(start_e[0], start_e[1], 0.0, 8.0, 8.0)


def slope(rise=0.15):
    """A plain of Texas tilted toward the radar: up to the east, away from it."""
    j = np.arange(600)
    height = np.broadcast_to(200 + rise * 90.0 * j, (600, 600)).astype(np.float32)
    return Dem(height, np.radians(29.5), np.radians(-95.65), np.radians(1e-3), np.radians(1e-3))


def acquisition(points, n_lines=7400, n_cells=1000, centroid=0.0, **settings):
    near = RANGE - n_cells / 2 * points.PALSAR.range_spacing
    return Acquisition(
        points.PALSAR,
        -n_lines / 2 / points.PALSAR.prf,
        n_lines,
        n_cells,
        near,
        centroid,
        **settings,
    )


def grid_of(arc, points, a):
    return Footprint(
        arc, points.PALSAR, a.first_time, a.n_lines, a.near_range, a.n_cells, a.centroid
    )


def echo_of_points(arc, a, p, height):
    footprint, first = illuminated_footprint(arc, a)
    layers = [np.zeros((footprint.n_lines, footprint.n_cells), np.complex64) for _ in range(2)]
    heights = float(height.min()) - 50.0, float(height.max()) + 50.0
    add_points(layers, footprint, p, height, np.ones(len(p), complex), heights)
    return received(layers, heights, footprint, a, first)


def in_the_time_domain(arc, a, p):
    """Every pulse of every point, one by one."""
    radar = a.radar
    t = a.first_time + np.arange(a.n_lines) / radar.prf
    delay = 2 * a.near_range / SPEED_OF_LIGHT + np.arange(a.n_cells) / radar.sample_rate
    speed = np.linalg.norm(arc.velocity(0.0))
    echo = np.zeros((a.n_lines, a.n_cells), np.complex64)
    for q in p:
        line = q - arc.position(t)
        R = np.linalg.norm(line, axis=1)
        doppler = 2 * np.sum(arc.velocity(t) * line, axis=1) / R / radar.wavelength - a.centroid
        beam = np.sinc(a.antenna_length * doppler / (2 * speed)) ** 2
        beam *= np.abs(doppler) <= a.illuminated / 2
        u = delay - 2 * R[:, None] / SPEED_OF_LIGHT
        inside = (u >= 0) & (u < radar.pulse_length)
        u = u - radar.pulse_length / 2
        cycles = 0.5 * radar.chirp_rate * u**2 - 2 * R[:, None] / radar.wavelength
        echo += (inside * beam[:, None] * np.exp(2j * np.pi * cycles)).astype(np.complex64)
    return echo


@pytest.mark.parametrize("centroid", [0.0, 150.0])
def test_points_on_a_slope_echo_as_in_the_time_domain(arc, points, centroid):
    """Phase and amplitude; what is left is the pulse's edges between samples (-21 dB)."""
    a = acquisition(points, centroid=centroid)
    grid = grid_of(arc, points, a)
    t, R = a.first_time + np.array([3700.3, 3500.7]) / 2160, RANGE + np.array([-900.0, 700.0])
    height = np.array([100.0, 700.0])
    p = grid.points(t, R, height)
    echo, direct = echo_of_points(arc, a, p, height), in_the_time_domain(arc, a, p)
    product = np.vdot(direct, echo) / np.linalg.norm(direct) ** 2
    assert abs(product) == pytest.approx(1.0, abs=0.01)
    assert np.angle(product) == pytest.approx(0.0, abs=0.01)
    coherence = abs(np.vdot(direct, echo)) / np.linalg.norm(direct) / np.linalg.norm(echo)
    assert coherence > 0.995


def inside_the_band(echo, a):
    """Spectrum (n, m) of the inner half of both bands."""
    radar = a.radar
    f = np.fft.fftfreq(a.n_lines, 1 / radar.prf)
    f = np.abs(f + radar.prf * np.rint((a.centroid - f) / radar.prf) - a.centroid)
    f_r = np.abs(np.fft.fftfreq(a.n_cells, 1 / radar.sample_rate))
    return np.fft.fft2(echo)[np.ix_(f < a.illuminated / 4, f_r < radar.bandwidth / 4)]


@pytest.mark.parametrize("squint", [0.0, 5.0])
def test_an_echo_is_exact_inside_its_band(points, squint, arc):
    """Against every pulse, delayed in frequency: 1.3e-3 in the inner half of both bands.

    (Below 1e-3 with a longer pulse: benchmarks/point_targets.py.) What is left is the interpolation
    of points between pixels (4e-4), of the migration between cells, and what stationary phase
    leaves out (3e-4 rad). The first null of the antenna is where the band is cut: no edge.
    """
    radar = replace(points.PALSAR, pulse_length=5e-6, chirp_rate=-14e6 / 5e-6)
    speed, lit = np.linalg.norm(arc.velocity(0.0)), 1.15 * radar.doppler_bandwidth
    centroid = 2 * speed * np.sin(np.radians(squint)) / radar.wavelength
    walk = round(0.1 + 25 * squint)  # cells, either way: a squinted beam sees ranges shrink
    shape = (7800, 160 + 2 * walk)
    near = RANGE - (40 + walk) * radar.range_spacing
    a = Acquisition(
        *(radar, -shape[0] / 2 / radar.prf, *shape, near, centroid), 4 * speed / lit, lit
    )
    footprint, first = illuminated_footprint(arc, a)
    p = footprint.points(np.array([0.0]), np.array([RANGE + 67.3]), np.array([170.0]))
    layers = [np.zeros((footprint.n_lines, footprint.n_cells), np.complex64) for _ in range(2)]
    add_points(layers, footprint, p, np.array([170.0]), np.ones(1, complex), (100.0, 400.0))
    made = received(layers, (100.0, 400.0), footprint, a, first, row_operations())
    t = a.first_time + np.arange(shape[0]) / radar.prf
    line = p[0] - arc.position(t)
    R = np.linalg.norm(line, axis=1)
    doppler = 2 * np.sum(arc.velocity(t) * line, axis=1) / R / radar.wavelength - centroid
    beam = np.sinc(a.antenna_length * doppler / (2 * speed)) ** 2 * (np.abs(doppler) < lit / 2)
    f_r = np.fft.fftfreq(n := 600, 1 / radar.sample_rate)
    late = 2 * (R - near) / SPEED_OF_LIGHT
    cycles = np.outer(late, f_r) + (2 * R / radar.wavelength)[:, None]
    pulse = np.fft.fft(chirp_replica(radar), n)
    direct = np.fft.ifft(beam[:, None] * np.exp(-2j * np.pi * cycles) * pulse, axis=1)
    direct = direct[:, : shape[1]]
    own, exact = (inside_the_band(x, a) for x in (made, direct))
    assert np.linalg.norm(own - exact) < 1.3e-3 * np.linalg.norm(exact)
    assert np.linalg.norm(made - direct) < 0.04 * np.linalg.norm(direct)


def test_points_of_a_tilted_terrain_focus_where_geometry_puts_them(arc, points):
    """Peak within 0.1 pixel, width within 10 %, and at +10 m/s the peak falls to 0.34 +- 0.05."""
    dem, a = slope(), acquisition(points)
    latitude = np.radians([29.760, 29.762, 29.757])
    longitude = np.radians([-95.372, -95.358, -95.383])
    height = dem.at(latitude, longitude)
    p = ecef(latitude, longitude, height)
    line, cell = grid_of(arc, points, a).place(p)
    echo = echo_of_points(arc, a, p, height)
    rate = 2 * 7189.0**2 / (points.PALSAR.wavelength * RANGE)
    width = 0.886 * points.PALSAR.prf / points.PALSAR.doppler_bandwidth
    for k in range(3):
        t = a.first_time + line[k] / points.PALSAR.prf
        V = float(effective_velocity_array(arc.position(t), arc.velocity(t), p[k]))
        domain = range_doppler(
            echo,
            points.PALSAR,
            near_range=a.near_range,
            centroid=0.0,
            velocity=V,
            first_time=a.first_time,
        )
        i, j = round(line[k]) - 60, round(cell[k]) - 30
        peak = points.Peak(azimuth_compressed(domain, V).data[i : i + 120, j : j + 60])
        assert i + peak.row == pytest.approx(line[k], abs=0.1)
        assert j + peak.column == pytest.approx(cell[k], abs=0.1)
        # the beam's own taper widens a point by 6 % beyond a flat band
        assert peak.width_azimuth == pytest.approx(width * 1.07, rel=0.1)
        assert peak.width_range == pytest.approx(0.886 * 16 / 14, rel=0.1)
        blurred = points.Peak(azimuth_compressed(domain, V + 10).data[i : i + 120, j : j + 60])
        assert blurred.height / peak.height == pytest.approx(0.34, abs=0.05)
    assert rate == pytest.approx(508.4, rel=1e-3)


def test_the_terrain_under_a_footprint_lies_where_it_is_seen(arc, points):
    dem = slope()
    grid = Footprint(arc, points.PALSAR, -0.5, 2160, RANGE - 3000.0, 640, 0.0)
    terrain = TerrainGrid(grid, Scene(dem, **PLAIN))
    p = ecef(terrain.latitude, terrain.longitude, terrain.height)
    line, cell = grid.place(p.reshape(-1, 3))
    rows, columns = terrain.ties
    assert line.reshape(p.shape[:2]) == pytest.approx(
        np.broadcast_to(rows[:, None], p.shape[:2]), abs=0.02
    )
    assert cell.reshape(p.shape[:2]) == pytest.approx(
        np.broadcast_to(columns, p.shape[:2]), abs=0.01
    )
    assert terrain.height == pytest.approx(dem.at(terrain.latitude, terrain.longitude), abs=0.06)


def test_brightness_follows_the_angle_of_incidence():
    level = np.cos(np.radians(38.7))
    assert brightness(np.array(level)) == pytest.approx(1.0)
    angles = np.cos(np.radians([80.0, 60.0, 38.7, 20.0, 8.0]))
    assert (np.diff(brightness(angles)) > 0).all()
    assert brightness(np.array([-0.3, 0.0])) == pytest.approx([0.0, 0.0])  # shadow


def test_a_slope_that_faces_the_radar_is_brighter(arc, points):
    grid = Footprint(arc, points.PALSAR, -0.1, 400, RANGE - 500.0, 100, 0.0)
    level, facing, averted = (
        TerrainGrid(grid, Scene(dem, **PLAIN)).power_db.mean()
        for dem in (flat_dem(300.0), slope(0.15), slope(-0.01))
    )
    assert level == pytest.approx(0.0, abs=0.1)
    assert facing > level + 1.0
    assert averted < level


def test_the_same_place_looks_the_same_from_wherever_it_is_asked():
    scene = Scene(flat_dem(), seed=3)
    rows, columns = range(9000, 9300), range(-31000, -30600)
    whole = scene.texture(rows, columns)
    part = scene.texture(range(9100, 9200), range(-30900, -30700))
    # interpolation in parts of 1/32 of a coarse cell is the same; rounding is not
    assert np.mean(np.abs(whole[100:200, 100:300] - part) > 1e-3) < 1e-3
    assert np.abs(Scene(flat_dem(), seed=4).texture(rows, columns) - whole).mean() > 1.0
    inside = scene.points(range(9100, 9200), range(-30900, -30700))
    everywhere = scene.points(rows, columns)
    assert set(inside[0]) < set(everywhere[0])
    assert (inside[0] / CELL >= 9100).all()


def test_texture_has_the_strength_asked_for():
    """The mean within four standard errors of a Gaussian's width of independent cells."""
    rows, columns = range(3000), range(3000)
    for name, width in (("parcels_db", 32), ("smooth_db", 96), ("fine_db", 1)):
        texture = Scene(flat_dem(), **PLAIN | {name: 2.0}).texture(rows, columns)
        assert texture.std() == pytest.approx(2.0, rel=0.12)  # smooth: some hundred cells
        error = 2.0 * np.sqrt(4 * np.pi) * width / 3000
        assert texture.mean() == pytest.approx(0.0, abs=4 * error + 1e-3)


def test_points_have_the_density_asked_for():
    scene = Scene(flat_dem(), points_per_km2=5.0)
    latitude, *_ = scene.points(range(-1000, 1000), range(2000))
    area = (2000 * CELL * 6371.0) ** 2
    assert len(latitude) == pytest.approx(5 * area, abs=4 * np.sqrt(5 * area))


def test_speckle_of_an_ideal_image_is_fully_developed(arc, points):
    """Intensity of mean one and normalized variance one, both with their sampling errors."""
    grid = Footprint(arc, points.PALSAR, -0.25, 1080, RANGE - 1500.0, 320, 0.0)
    terrain = TerrainGrid(grid, Scene(flat_dem(), **PLAIN))
    image = ideal_image(Scene(flat_dem(), **PLAIN), terrain, np.random.default_rng(0), snr_db=200.0)
    intensity = np.abs(image) ** 2
    kept = 1513 / 2160 * 14 / 16
    assert intensity.mean() == pytest.approx(kept, rel=0.01)
    assert intensity.var() / intensity.mean() ** 2 == pytest.approx(1.0, abs=0.03)


def test_noise_is_as_strong_as_asked_for(arc, points):
    grid = Footprint(arc, points.PALSAR, -0.25, 1080, RANGE - 1500.0, 320, 0.0)
    scene = Scene(flat_dem(), **PLAIN)
    terrain = TerrainGrid(grid, scene)
    quiet, loud = (
        np.mean(np.abs(ideal_image(scene, terrain, np.random.default_rng(0), snr_db=s)) ** 2)
        for s in (200.0, 0.0)
    )
    assert loud / quiet == pytest.approx(2.0, rel=0.02)


def test_a_simulated_scene_is_autofocused_at_its_own_velocity(arc, points):
    """End to end: texture, points, speckle and noise over a real terrain's kind of relief."""
    dem = slope(0.03)
    a = acquisition(points, n_lines=7452, n_cells=900)
    echo = simulated_echo(Scene(dem, seed=5), arc, a, np.random.default_rng(1))
    assert echo.dtype == np.complex64
    p = grid_of(arc, points, a).points(np.array(0.0), np.array(RANGE - 2000.0), np.array(800.0))
    V = float(effective_velocity_array(arc.position(0.0), arc.velocity(0.0), p))
    domain = range_doppler(
        echo,
        points.PALSAR,
        near_range=a.near_range,
        centroid=0.0,
        velocity=7200.0,
        first_time=a.first_time,
        velocity_slope=6.7e-5,
    ).cropped()
    middle = domain.slant_range.mean()
    height = 200 + 0.03 * 90 * 280
    p = grid_of(arc, points, a).points(np.array(0.0), np.array(middle), np.array(height))
    V = float(effective_velocity_array(arc.position(0.0), arc.velocity(0.0), p))
    focus = autofocus(SharpnessCurve(domain, 1.0), V - 12.0)
    assert focus.accepted
    assert focus.velocity == pytest.approx(V, abs=0.6)
    assert geodetic(p)[2] == pytest.approx(height, abs=1e-3)


def test_one_layer_stands_for_low_relief_alone(arc, points):
    """Half of 100 m of relief turns the edge of the band by 0.031 rad, half of 300 m by 0.093."""
    a = acquisition(points, n_lines=300, n_cells=500)
    footprint, first = illuminated_footprint(arc, a)
    assert _alike(footprint, (0.0, 100.0), a)
    assert not _alike(footprint, (0.0, 300.0), a)
    a = acquisition(points, n_lines=300, n_cells=500, illuminated=300.0)
    footprint, first = illuminated_footprint(arc, a)
    layers = scattered(
        TerrainGrid(footprint, Scene(flat_dem(50.0), **PLAIN)),
        (0.0, 100.0),
        np.random.default_rng(1),
    )
    both = layers[0] + layers[1]
    two = received(layers, (0.0, 100.0), footprint, a, first)
    one = received([both], (0.0, 100.0), footprint, a, first)
    assert np.linalg.norm(one - two) < 1e-3 * np.linalg.norm(two)


def test_echo_depends_on_the_generator_alone(arc, points):
    a = acquisition(points, n_lines=300, n_cells=500, illuminated=300.0)
    scene = Scene(flat_dem(), seed=5)
    one, again, other = (
        simulated_echo(scene, arc, a, np.random.default_rng(k)).tobytes() for k in (1, 1, 2)
    )
    assert one == again != other


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_cells": 400}, "smaller than two lines of one pulse, 432 cells"),
        ({"illuminated": 3000.0}, "an illuminated band of 3000 Hz is not within the repetition"),
    ],
)
def test_impossible_acquisitions_are_refused(points, change, message):
    settings = {"n_lines": 1000, "n_cells": 600, "near_range": RANGE} | change
    with pytest.raises(ValueError, match=message):
        Acquisition(points.PALSAR, 0.0, **settings)


def test_impossible_scenes_are_refused():
    with pytest.raises(ValueError, match="fine_db of a scene cannot be -1"):
        Scene(flat_dem(), fine_db=-1.0)
