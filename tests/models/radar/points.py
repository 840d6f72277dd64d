"""Echo of point targets from exact geometry, and where a focused image shows them."""

import numpy as np

from terrafix.models.radar.chirp import SPEED_OF_LIGHT, Radar

PALSAR = Radar(
    carrier=SPEED_OF_LIGHT / 0.2361,
    prf=2160.0,
    sample_rate=16e6,
    chirp_rate=-14e6 / 27e-6,
    pulse_length=27e-6,
    doppler_bandwidth=1513.0,
)
"""L band, dual polarization mode."""

RADARSAT = Radar(
    carrier=5.3e9,
    prf=1256.98,
    sample_rate=32.317e6,
    chirp_rate=-0.72135e12,
    pulse_length=41.75e-6,
    doppler_bandwidth=0.75 * 1256.98,
)
"""C band, fine beam."""


def point_echo(radar, near_range, velocity, centroid, shape, targets):
    """Raw echo of targets (closest range [m], time of closest approach [s]), exact hyperbolas.

    A target is seen while its Doppler frequency is within half of 0.98 times the repetition
    frequency of the centroid.
    """
    n_lines, n_cells = shape
    t = np.arange(n_lines) / radar.prf
    delay = 2 * near_range / SPEED_OF_LIGHT + np.arange(n_cells) / radar.sample_rate
    echo = np.zeros(shape, np.complex64)
    for closest, passed in targets:
        distance = np.sqrt(closest**2 + (velocity * (t - passed)) ** 2)
        doppler = -2 * velocity**2 * (t - passed) / (radar.wavelength * distance)
        for i in np.flatnonzero(np.abs(doppler - centroid) <= 0.49 * radar.prf):
            u = delay - 2 * distance[i] / SPEED_OF_LIGHT
            inside = (u >= 0) & (u < radar.pulse_length)
            u = u[inside] - radar.pulse_length / 2
            cycles = 0.5 * radar.chirp_rate * u**2 - 2 * distance[i] / radar.wavelength
            echo[i, inside] += np.exp(2j * np.pi * cycles)
    return echo


class Peak:
    """The strongest point of an image: position and -3 dB widths in pixels, and height."""

    def __init__(self, image, up=32, half=8):
        row, column = np.unravel_index(np.abs(image).argmax(), image.shape)
        chip = image[row - half : row + half, column - half : column + half]
        spectrum = np.fft.fft2(chip)
        for axis in (0, 1):  # begin the spectrum where it is empty, so that padding splits nothing
            power = np.abs(spectrum).sum(axis=1 - axis)
            spectrum = np.roll(spectrum, -int(power.argmin()), axis)
        fine = np.zeros((2 * half * up,) * 2, complex)
        fine[: 2 * half, : 2 * half] = spectrum
        fine = np.abs(np.fft.ifft2(fine)) * up**2
        i, j = np.unravel_index(fine.argmax(), fine.shape)
        self.row, self.column = row - half + i / up, column - half + j / up
        self.height = fine[i, j]
        self.width_azimuth, self.width_range = _width(fine[:, j], i) / up, _width(fine[i], j) / up


def _width(cut, top):
    level = cut[top] / np.sqrt(2)
    a = b = top
    while cut[a] > level:
        a -= 1
    while cut[b] > level:
        b += 1
    left = a + (level - cut[a]) / (cut[a + 1] - cut[a])
    return b - (level - cut[b]) / (cut[b - 1] - cut[b]) - left
