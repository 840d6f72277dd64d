"""Autofocus on simulated scenes whose velocity is known: its error over its standard error.

    python benchmarks/autofocus.py [--images 40] [--relief 12]

Kinds of scenes are put into the range-Doppler domain; on relief, whole echo is simulated and what
is measured is the velocity at the beam's center, whose height is that of the terrain there.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter

from terrafix.components.sensors.compiled import row_operations
from terrafix.models.geometry.geodesy import geodetic
from terrafix.models.geometry.geolocation import ground_point
from terrafix.models.maps.dem import Dem, read_jacksboro
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.autofocus import SharpnessCurve, autofocus
from terrafix.models.radar.chirp import Radar, unit_phasor
from terrafix.models.radar.echo import Acquisition, simulated_echo
from terrafix.models.radar.focusing import RangeDoppler, migration_factor
from terrafix.models.radar.imaging import Imager
from terrafix.models.radar.scene import Scene
from terrafix.models.sensors.effective_velocity import effective_velocity_array, velocity_field

PALSAR = Radar(1269.768992e6, 2160.0, 16e6, -5.185185185185185e11, 27e-6, 1513.0)
SHORT = Radar(1269.768992e6, 2160.0, 16e6, -14e6 / 4e-6, 4e-6, 1513.0)  # few cells are a pulse
VELOCITY, RANGE = 7188.5, 861013.0  # [m/s], [m]
SHAPE = (2048, 256)
SNR = 10.0  # [dB]
RESTLESS = 0.25  # velocities of targets: Student's distribution of 2 degrees of freedom [m/s]
START = 10.0  # standard deviation of starts [m/s]
EARTH_RATE = 7.2921151467e-5
R0 = np.array([-1104646.3356338572, -6096830.387203118, 3395727.381187697])
V0 = np.array([-560.0980743545368, 3729.5871618791953, 6497.9362610432145])  # inertial

Kind = Callable[[np.random.Generator], tuple[np.ndarray, list[tuple[int, int, complex, float]]]]


def speckle(rng: np.random.Generator) -> np.ndarray:
    pairs = rng.standard_normal((*SHAPE, 2), np.float32).view(np.complex64)
    return pairs[..., 0] * np.float32(np.sqrt(0.5))


def texture(rng: np.random.Generator, db: float, width: float) -> np.ndarray:
    """Speckle whose power varies by some decibels, smoothly over some pixels."""
    smooth = gaussian_filter(rng.standard_normal(SHAPE), width, mode="wrap")
    return speckle(rng) * np.exp(smooth / smooth.std() * db * np.log(10) / 20).astype(np.float32)


def points(
    rng: np.random.Generator, n: int, db: float, off: Callable[[], float] = lambda: 0.0
) -> list[tuple[int, int, complex, float]]:
    """Row, column, amplitude and velocity of bright points."""
    return [
        (
            int(rng.integers(SHAPE[0])),
            int(rng.integers(SHAPE[1])),
            10 ** ((db + 4 * rng.standard_normal()) / 20) * np.exp(2j * np.pi * rng.random()),
            off(),
        )
        for _ in range(n)
    ]


def restless(rng: np.random.Generator) -> Callable[[], float]:
    return lambda: RESTLESS * float(rng.standard_t(2))


KINDS: dict[str, Kind] = {
    "featureless": lambda rng: (speckle(rng), []),
    "texture": lambda rng: (texture(rng, 4.0, 2.0), []),
    "parcels": lambda rng: (texture(rng, 2.5, 8.0), points(rng, 72, 25.0)),
    "urban": lambda rng: (texture(rng, 2.5, 8.0), points(rng, 2000, 20.0)),
    "sea, 20 buoys": lambda rng: (speckle(rng), points(rng, 20, 25.0)),
    "targets": lambda rng: (texture(rng, 2.5, 8.0), points(rng, 150, 25.0, restless(rng))),
    "12 targets": lambda rng: (speckle(rng), points(rng, 12, 28.0, restless(rng))),
    "ships": lambda rng: (
        speckle(rng),
        points(rng, 40, 22.0) + points(rng, 12, 32.0, lambda: rng.uniform(-6, 6)),
    ),
}


def seen(scene: np.ndarray, targets: list[tuple[int, int, complex, float]]) -> np.ndarray:
    """Spectrum of a scene at rest and of targets of velocities of their own."""
    n, m = SHAPE
    f = fft.fftfreq(n, 1 / PALSAR.prf)
    R = RANGE + PALSAR.range_spacing * np.arange(m)
    scale = 2 / PALSAR.wavelength
    d = migration_factor(f, VELOCITY, PALSAR.wavelength)
    found = fft.fft(scene, axis=0) * unit_phasor(scale * np.outer(1 - d, R))
    for row, column, amplitude, off in targets:
        d = migration_factor(f, VELOCITY + off, PALSAR.wavelength)
        cycles = scale * (1 - d) * R[column] - f * row / PALSAR.prf
        found[:, column] += amplitude * unit_phasor(cycles)
    return np.asarray(found)


def domain_of(kind: Kind, rng: np.random.Generator) -> RangeDoppler:
    n, m = SHAPE
    f = fft.fftfreq(n, 1 / PALSAR.prf)
    spectrum = seen(*kind(rng))
    spectrum += speckle(rng) * np.float32(np.sqrt(n * 10 ** (-SNR / 10)))
    spectrum[np.abs(f) > PALSAR.doppler_bandwidth / 2] = 0
    inside = np.abs(fft.fftfreq(m, 1 / PALSAR.sample_rate)) <= PALSAR.bandwidth / 2
    spectrum = fft.ifft(fft.fft(spectrum, axis=1) * inside, axis=1).astype(np.complex64)
    R = RANGE + PALSAR.range_spacing * np.arange(m)
    return RangeDoppler(
        *(spectrum, f, R, 0.0, n, 0.0, VELOCITY, slice(0, m), PALSAR),
        operations=row_operations(),
    )


def summary(errors: np.ndarray, sigma: np.ndarray) -> str:
    def rms(x: np.ndarray) -> float:
        return float(np.sqrt(np.mean(x**2)))

    return (
        f"mean {errors.mean():7.4f}, rms {rms(errors):6.4f} m/s, sigma {rms(sigma):6.4f}, error "
        f"over sigma {rms(errors / sigma):4.2f} +- "
        f"{rms(errors / sigma) / np.sqrt(2 * len(sigma)):4.2f}"
    )


def kinds(images: int) -> None:
    print(f"{images} images of {SHAPE[0]} x {SHAPE[1]} of each kind, starts within {START} m/s")
    for number, (name, kind) in enumerate(KINDS.items()):
        found = []
        for k in range(images):
            rng = np.random.default_rng([31, number, k])
            curve = SharpnessCurve(
                domain_of(kind, rng), 1.0, slice(0, SHAPE[0]), slice(0, SHAPE[1])
            )
            found.append(autofocus(curve, VELOCITY + rng.normal(0, START), max_change=60.0))
        good = [(f.velocity - VELOCITY, f.sigma) for f in found if f.accepted]
        reasons = Counter(f.reason for f in found if not f.accepted)
        what = summary(*np.array(good).T) if good else ""
        print(f"  {name:14s} {len(good):3d} accepted; {what} {dict(reasons) or ''}")


def start(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Earth-fixed position and velocity over another place each time."""
    angle = 0.37 * number
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    r = turned @ R0
    return r, turned @ V0 - np.cross([0, 0, EARTH_RATE], r)


def relief(images: int) -> None:
    dem = read_jacksboro().tiled()
    off, sigma, heights, grown = [], [], [], []
    for k in range(images):
        r, v = start(k)
        rng = np.random.default_rng([32, k])
        R = RANGE
        arc = OrbitArc(r, v, 0.0, 12.0, 12.0)
        n_lines, n_cells = 7452, 420
        first, near = -n_lines / 2 / SHORT.prf, R - n_cells / 2 * SHORT.range_spacing
        scene = Scene(dem, seed=k)
        acquisition = Acquisition(SHORT, first, n_lines, n_cells, near)
        echo = simulated_echo(scene, arc, acquisition, rng, operations=row_operations())
        field = velocity_field(r, v, R, 0.0)
        imager = Imager(echo, SHORT, near, first, operations=row_operations())
        processing, focus = imager.focus(
            [imager.processing(0.0, field.velocity, field.by_range)],
            field.velocity + rng.normal(0, START),
            velocity_rate=field.by_time,
        )
        image = imager.image(processing, focus.velocity)
        row, column = (float(x) for x in image.pixel(0.0, R, 0.0))
        found = imager.velocity_at(processing, focus.velocity, field.by_time, (row, column))
        height = height_seen(dem, r, v, R)
        around = np.mean(
            [
                height_seen(dem, arc.position(t), arc.velocity(t), R + x)
                for t in image.t[image.rows][::100]
                for x in image.slant_range[image.columns][::30] - R
            ]
        )
        true = float(effective_velocity_array(r, v, ground_point(r, v, R, 0.0, height)))
        print(f"  {k}: {focus.reason}, {found - true:.3f} +- {focus.sigma:.3f} m/s", flush=True)
        if focus.accepted:
            off.append(found - true)
            sigma.append(focus.sigma)
            heights.append(around - height)
            grown.append(field.by_height * (around - height))
    errors, own = np.array(off), np.array(sigma)
    print(f"relief, {len(off)} of {images} accepted: {summary(errors, own)}")
    print(f"  less what the mean height of the image does: {summary(errors - grown, own)}")
    print(
        f"  that height, from the beam's center: {np.sqrt(np.mean(np.square(heights))):.0f} m rms; "
        f"the elevation model's: {dem.height.std():.0f} m"
    )


def height_seen(dem: Dem, r: np.ndarray, v: np.ndarray, R: float) -> float:
    """Height of the terrain that is seen at a range [m]."""
    height = 0.0
    for _ in range(20):
        latitude, longitude, _ = geodetic(ground_point(r, v, R, 0.0, height))
        height += 0.5 * (float(dem.at(latitude, longitude)) - height)
    return height


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--relief", type=int, default=12)
    arguments = parser.parse_args()
    if arguments.images:
        kinds(arguments.images)
    if arguments.relief:
        relief(arguments.relief)
