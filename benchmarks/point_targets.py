"""Point targets: the processor at squints to 5 degrees, and simulated echo against brute force.

    python benchmarks/point_targets.py [--targets 3]

The first table is of exact hyperbolas through the range-Doppler processor: greatest errors of
place, widths and phase over targets all over the swath. The second compares the echo that is made
in the frequency domain with every pulse of every target summed one by one, both with the same
band-limited pulse: once with an antenna whose first null is the edge of the illuminated band, which
leaves the error inside the band, and once with the usual one, cut there: what is added is its edge.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy import fft

from terrafix.components.sensors.compiled import row_operations
from terrafix.models.core.arrays import ComplexArray, FloatArray
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, Radar, chirp_replica, unit_phasor
from terrafix.models.radar.echo import Acquisition, add_points, illuminated_footprint, received
from terrafix.models.radar.focusing import Image, azimuth_compressed, range_doppler

RADARSAT = Radar(5.3e9, 1256.98, 32.317e6, -0.72135e12, 41.75e-6, 0.75 * 1256.98)
PALSAR = Radar(1269.768992e6, 2160.0, 16e6, -14e6 / 27e-6, 27e-6, 1513.0)
R_E = np.array([-1113450.2, -6065237.3, 3448880.5])  # [m]
V_E = np.array([-989.47248, 3867.50637, 6466.14686])  # [m/s]
SQUINTS = (0.0, 2.0, 5.0)  # [deg]
VELOCITY, MIDDLE = 7062.0, 993000.0
HALF, UP = 16, 64


def hyperbolas(
    radar: Radar, near: float, centroid: float, shape: tuple[int, int], closest: float, at: float
) -> ComplexArray:
    """Every pulse of a target, at the exact range of every line."""
    t = np.arange(shape[0]) / radar.prf
    R = np.hypot(closest, VELOCITY * (t - at))
    doppler = -2 * VELOCITY**2 * (t - at) / (radar.wavelength * R)
    delay = 2 * near / SPEED_OF_LIGHT + np.arange(shape[1]) / radar.sample_rate
    u = delay - 2 * R[:, None] / SPEED_OF_LIGHT
    seen = (u >= 0) & (u < radar.pulse_length)
    seen &= (np.abs(doppler - centroid) <= 0.49 * radar.prf)[:, None]
    u -= radar.pulse_length / 2
    cycles = 0.5 * radar.chirp_rate * u**2 - 2 * R[:, None] / radar.wavelength
    return (seen * unit_phasor(cycles)).astype(np.complex64)


def fine(image: Image, row: float, column: float) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """A neighborhood at baseband, resampled `UP` times about a place [pixels from it]."""
    i, j = round(row), round(column)
    chip = image.data[i - HALF : i + HALF, j - HALF : j + HALF].astype(complex)
    y, x = np.arange(i - HALF, i + HALF) - row, np.arange(j - HALF, j + HALF) - column
    sine = image.radar.wavelength * image.centroid / (2 * image.velocity)
    across = 2 / image.radar.wavelength * (np.sqrt(1 - sine**2) - 1) * np.diff(image.slant_range)[0]
    chip *= unit_phasor(-image.centroid / image.radar.prf * y)[:, None] * unit_phasor(-across * x)
    steps = np.arange(-3 * UP, 3 * UP + 1) / UP

    def kernel(places: FloatArray) -> FloatArray:
        away = steps[:, None] - places
        window = np.i0(4 * np.sqrt(np.maximum(0, 1 - (away / (HALF + 1)) ** 2))) / np.i0(4)
        return np.asarray(np.sinc(away) * window)

    return kernel(y) @ chip @ kernel(x).T, steps, steps


def width(cut: FloatArray) -> float:
    """Of the half power points [pixels]."""
    top = int(cut.argmax())
    level = cut[top] / np.sqrt(2)
    left = top - int(np.argmax(cut[top::-1] < level))
    right = top + int(np.argmax(cut[top:] < level))
    a = left + (level - cut[left]) / (cut[left + 1] - cut[left])
    b = right - (level - cut[right]) / (cut[right - 1] - cut[right])
    return float(b - a) / UP


def processor(name: str, radar: Radar, shape: tuple[int, int], targets: int) -> None:
    bandwidth = abs(radar.chirp_rate) * radar.pulse_length
    ideal = 0.886 * np.array([radar.prf / radar.doppler_bandwidth, radar.sample_rate / bandwidth])
    for squint in SQUINTS:
        sine, tan = np.sin(np.radians(squint)), np.tan(np.radians(squint))
        centroid = 2 * VELOCITY * sine / radar.wavelength
        near = MIDDLE / np.sqrt(1 - sine**2) - shape[1] * 0.3 * radar.range_spacing
        swath = (shape[1] - radar.n_pulse) * radar.range_spacing
        found = []
        for k, beyond in enumerate(np.linspace(-0.15, 0.3, targets) * swath):
            closest = MIDDLE + beyond + 0.37 * k
            passed = shape[0] / 2 / radar.prf + (0.31 * k) / radar.prf + tan * closest / VELOCITY
            echo = hyperbolas(radar, near, centroid, shape, closest, passed)
            domain = range_doppler(
                echo, radar, near_range=near, centroid=centroid, velocity=VELOCITY
            )
            image = azimuth_compressed(domain, VELOCITY)
            row = (passed - image.t[0]) * radar.prf
            column = (closest - image.slant_range[0]) / np.diff(image.slant_range[:2])[0]
            near_it, steps, _ = fine(image, row, column)
            i, j = np.unravel_index(np.abs(near_it).argmax(), near_it.shape)
            widths = width(np.abs(near_it[:, j])), width(np.abs(near_it[i]))
            middle = len(steps) // 2
            cycles = np.angle(near_it[middle, middle]) / (2 * np.pi)
            cycles += 2 * closest / radar.wavelength + 0.125
            found.append(
                [steps[i], steps[j], *(np.array(widths) / ideal - 1), cycles - round(cycles)]
            )
        place = np.abs(np.array(found)[:, :2]).max(axis=0)
        wide = 100 * np.abs(np.array(found)[:, 2:4]).max(axis=0)
        phase = 360 * np.array(found)[:, 4]
        print(
            f"{name}, squint {squint:.0f} deg, {targets} targets: place within {place[0]:.3f} line "
            f"and {place[1]:.3f} cell, widths within {wide[0]:.1f} and {wide[1]:.1f} %, phase "
            f"{phase.min():.2f} to {phase.max():.2f} deg"
        )


def brute_force(arc: OrbitArc, a: Acquisition, p: FloatArray, taps: int) -> ComplexArray:
    """Every pulse of every target, delayed exactly in the frequency of its band-limited replica."""
    radar = a.radar
    n = int(fft.next_fast_len(a.n_cells + 2 * taps))
    f_r = fft.fftfreq(n, 1 / radar.sample_rate)
    pulse = fft.fft(chirp_replica(radar), n)
    t = a.first_time + np.arange(a.n_lines) / radar.prf
    speed = np.linalg.norm(arc.velocity((t[0] + t[-1]) / 2))
    spectrum = np.zeros((a.n_lines, n), complex)
    for q in p:
        line = q - arc.position(t)
        R = np.linalg.norm(line, axis=1)
        doppler = 2 * np.sum(arc.velocity(t) * line, axis=1) / R / radar.wavelength - a.centroid
        beam = np.sinc(a.antenna_length * doppler / (2 * speed)) ** 2
        beam *= np.abs(doppler) <= a.illuminated / 2
        late = 2 * (R - a.near_range) / SPEED_OF_LIGHT
        own = unit_phasor(-np.outer(late, f_r) - (2 * R / radar.wavelength)[:, None])
        spectrum += beam[:, None] * own
    return np.asarray(fft.ifft(spectrum * pulse, axis=1)[:, : a.n_cells])


def echo_errors(squint: float, at_null: bool) -> tuple[float, float]:
    """Relative rms error of the echo, all in all and in the inner half of both bands."""
    arc = OrbitArc(R_E, V_E, 0.0, 12.0, 12.0)
    radar, n_lines, n_cells, R = PALSAR, 7800, 900, 861013.0
    speed = float(np.linalg.norm(arc.velocity(0.0)))
    centroid = 2 * speed * np.sin(np.radians(squint)) / radar.wavelength
    near = R - 0.5 * (n_cells - radar.n_pulse) * radar.range_spacing
    lit = 1.15 * radar.doppler_bandwidth
    length = 4 * speed / lit if at_null else 8.9
    first = -n_lines / 2 / radar.prf
    a = Acquisition(radar, first, n_lines, n_cells, near, centroid, length, lit)
    grid, line = illuminated_footprint(arc, a)
    height = np.array([320.0, 180.0])
    p = grid.points(np.array([0.02, -0.05]), R + np.array([310.0, -705.0]), height)
    layers = [np.zeros((grid.n_lines, grid.n_cells), np.complex64) for _ in range(2)]
    heights = 100.0, 400.0
    add_points(layers, grid, p, height, np.ones(len(p), complex), heights)
    made = received(layers, heights, grid, a, line, row_operations())
    direct = brute_force(arc, a, p, radar.n_pulse)
    whole = float(np.linalg.norm(made - direct) / np.linalg.norm(direct))
    spectra = [fft.fft2(x) for x in (made, direct)]
    f = fft.fftfreq(n_lines, 1 / radar.prf)
    f = np.abs(f + radar.prf * np.rint((centroid - f) / radar.prf) - centroid)
    f_r = np.abs(fft.fftfreq(n_cells, 1 / radar.sample_rate))
    inside = np.ix_(f < lit / 4, f_r < radar.bandwidth / 4)
    made, direct = (s[inside] for s in spectra)
    return whole, float(np.linalg.norm(made - direct) / np.linalg.norm(direct))


def echo() -> None:
    for squint in SQUINTS:
        found = [echo_errors(squint, at_null) for at_null in (True, False)]
        (inner, inner_half), (cut, cut_half) = found
        print(
            f"echo against brute force, squint {squint:.0f} deg: {inner:.1e} with the null at the "
            f"edge of the band ({inner_half:.1e} in its inner half), {cut:.1e} where it is cut "
            f"({cut_half:.1e})"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--targets", type=int, default=3)
    targets = parser.parse_args().targets
    started = time.process_time()
    echo()
    processor("RADARSAT-1", RADARSAT, (1536, 3400), targets)
    processor("PALSAR", PALSAR, (8700, 1100), targets)
    print(f"{time.process_time() - started:.0f} s of processor")
