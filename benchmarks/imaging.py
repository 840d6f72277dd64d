"""Speed of the imaging chain, and autofocus and matching on recorded echo.

    python benchmarks/imaging.py [--places 100] [--trials 3000] [--only matching]

Autofocus and matching need the recording (TERRAFIX_DATA); without it they are left out.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy import fft

from terrafix.components.sensors.compiled import row_operations
from terrafix.models.core.parallel import batches
from terrafix.models.images.matching import Prediction, Searchable, matched
from terrafix.models.radar.autofocus import SharpnessCurve, autofocus
from terrafix.models.radar.chirp import Radar, padded_length
from terrafix.models.radar.doppler import fractional_centroid, unwrapped_centroid
from terrafix.models.radar.focusing import (
    RangeDoppler,
    azimuth_compressed,
    azimuth_looks,
    range_doppler,
)
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.spectra import ARRAY_ROWS, Rows

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
RADARSAT = Radar(5.3e9, 1256.98, 32.317e6, -0.72135e12, 41.75e-6, 0.75 * 1256.98)
CHUNKS = ("airport", "stanley_park", "ubc", "english_bay_1", "english_bay_2")
SIZE = 256  # [pixels] of a chip
PRIOR = 60.0  # [pixels] sigma of the predicted place, along each axis


def seconds(action: Callable[[], object], repeat: int = 5) -> float:
    found = []
    for _ in range(repeat):
        started = time.process_time()
        action()
        found.append(time.process_time() - started)
    return min(found)


def speckle(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    pairs = np.random.default_rng(seed).standard_normal((*shape, 2), np.float32)
    return pairs.view(np.complex64)[..., 0]


def speed() -> None:
    """Processor time, against that of the transforms that a processor in frequency needs."""
    echo, n_fft = speckle((1536, 2048)), padded_length(RADARSAT, 2048)

    def transforms() -> None:
        lines = fft.fft(echo, axis=0, workers=-1)
        for rows in batches(len(lines), 128):
            there = fft.fft(lines[rows], n_fft, axis=1)
            fft.ifft(there, axis=1, overwrite_x=True)
        fft.ifft(lines, axis=0, overwrite_x=True, workers=-1)

    floor = seconds(transforms)
    for name, operations in (("compiled", row_operations()), ("arrays", ARRAY_ROWS)):

        def processed(operations: Rows = operations) -> None:
            domain = range_doppler(
                *(echo, RADARSAT),
                near_range=988647.0,
                centroid=-7000.0,
                velocity=7062.0,
                operations=operations,
            )
            azimuth_compressed(domain, 7062.0)

        whole = seconds(processed)
        print(
            f"range-Doppler processor, 1536 x 2048, {name}: {whole:.2f} s of processor, "
            f"{whole / floor:.1f} x its FFTs (2)"
        )
    small = Radar(5.3e9, 1256.98, 32.317e6, -0.72135e12, 1e-6, 0.75 * 1256.98)
    domain = range_doppler(
        *(speckle((1024, 1024)), small),
        near_range=988647.0,
        centroid=0.0,
        velocity=7062.0,
        operations=row_operations(),
    )
    curve = SharpnessCurve(domain, 1.0)
    offsets = iter(range(1000))
    one = seconds(lambda: curve.at(7062 + next(offsets)))
    floor = seconds(lambda: fft.ifft(domain.spectrum, axis=0, workers=-1))
    print(
        f"autofocus candidate, 1024 x 1024: {one:.3f} s of processor (< 0.15), "
        f"{one / floor:.1f} x its FFT"
    )


def domain_of(name: str) -> RangeDoppler:
    lines = read_recording(DATA / "radarsat1_vancouver" / f"{name}.npz")
    echo = lines.read()
    near = 988647.462 + (lines.first_cell - 1) * RADARSAT.range_spacing
    fraction, _ = fractional_centroid(echo, RADARSAT.prf)
    centroid = unwrapped_centroid(fraction, RADARSAT.prf, -6900.0)
    return range_doppler(
        echo, RADARSAT, near_range=near, centroid=centroid, velocity=7062.0
    ).cropped()


def focusing(domains: dict[str, RangeDoppler], starts: int) -> None:
    print(f"autofocus, {starts} starts within +-50 m/s of 7062")
    for k, (name, domain) in enumerate(domains.items()):
        rng = np.random.default_rng([1, k])
        curve = SharpnessCurve(domain, 2.0)
        found = [autofocus(curve, 7062 + x) for x in rng.uniform(-50, 50, starts)]
        V = np.array([f.velocity for f in found if f.accepted])
        far = np.abs(V - 7062).max() if len(V) else np.nan
        print(
            f"  {name:14s} {100 * len(V) / starts:5.0f} % accepted, {V.min():.1f} to "
            f"{V.max():.1f}, furthest {far:.1f} m/s"
        )
    refused = []
    for seed in range(20):
        echo = speckle((1536, 2048), seed)
        domain = range_doppler(
            echo, RADARSAT, near_range=988647.0, centroid=-7000.0, velocity=7062.0
        ).cropped()
        curve = SharpnessCurve(domain, 2.0)
        rng = np.random.default_rng([2, seed])
        refused += [not autofocus(curve, 7062 + x).accepted for x in rng.uniform(-50, 50, 5)]
    print(f"  speckle        {100 * np.mean(refused):5.0f} % refused, of {len(refused)}")


def chip(
    amplitude: np.ndarray, rng: np.random.Generator, turn: float, size: int = SIZE
) -> tuple[Searchable, np.ndarray]:
    """A chip at random, turned up to so many degrees, and its middle: whole pixels if it is not."""
    if turn == 0:
        first = np.array([rng.integers(0, n - size + 1) for n in amplitude.shape])
        (i, j), middle = first, first + (size - 1) / 2
        return Searchable(amplitude[i : i + size, j : j + size]), middle
    half = size / np.sqrt(2) + 2
    middle = np.array([rng.uniform(half, n - 1 - half) for n in amplitude.shape])
    M = cv2.getRotationMatrix2D((middle[1], middle[0]), rng.uniform(-turn, turn), 1.0)
    M[:, 2] += (size - 1) / 2 - middle[::-1]
    return Searchable(cv2.warpAffine(amplitude, M, (size, size), flags=cv2.INTER_LINEAR)), middle


def expected(middle: np.ndarray, size: int, rng: np.random.Generator, turn: float) -> Prediction:
    """What an orbit would say: off by PRIOR pixels along each axis, and of the turn nothing."""
    corner = middle - (size - 1) / 2 + rng.normal(0, PRIOR, 2)
    covariance = PRIOR**2 * np.eye(2)
    return Prediction.affine(
        np.column_stack([np.eye(2), corner]), covariance, np.radians(max(turn, 0.1)) / 2.5, 1e-3
    )


def beside(one: np.ndarray, other: Searchable, middle: np.ndarray, size: int) -> tuple:
    """How far the looks are apart in the rows of a chip, by columns outside it, and covariance.

    Along the track they are apart by what the motion of the radar leaves: up to 0.2 lines, the
    same in all columns. Columns that are not the chip's tell it with speckle of their own.
    """
    rows = slice(*(int(np.clip(middle[0] + s * size / 2, 0, one.shape[0])) for s in (-1, 1)))
    low, high = (int(middle[1] + s * (size / 2 + 8)) for s in (-1, 1))
    weight, total = np.zeros((2, 2)), np.zeros(2)
    for first, last in ((0, low), (high, one.shape[1])):
        if last - first < 96:
            continue
        strip = Searchable(one[rows, first:last])
        A = np.array([[1.0, 0.0, rows.start], [0.0, 1.0, first]])
        match = matched(strip, other, Prediction.affine(A, 4 * np.eye(2), 1e-6, 1e-6))
        if match.accepted:
            off = np.array([match.row, match.column]) - A[:, 2] - [(n - 1) / 2 for n in strip.shape]
            information = np.linalg.inv(match.covariance)
            weight, total = weight + information, total + information @ off
    if not weight.any():
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    covariance = np.linalg.inv(weight)
    return covariance @ total, covariance


def matching(domains: dict[str, RangeDoppler], places: int, seed: int) -> None:
    """Chips of one azimuth look on the other: two passes whose speckle is independent."""
    looks = {}
    for name, domain in domains.items():
        velocity = autofocus(SharpnessCurve(domain, 2.0), 7062.0).velocity
        looks[name] = [np.abs(i.valid) for i in azimuth_looks(domain, velocity, 2)]
    references = {n: Searchable(b) for n, (_, b) in looks.items()}
    for turn in (0.0, 12.0):
        print(
            f"matching of two looks, {places} places, turned up to {turn:.0f} degrees, prior of "
            f"{PRIOR:.0f} pixels, seed {seed}"
        )
        for k, (name, (one, _)) in enumerate(looks.items()):
            rng = np.random.default_rng([seed, k])
            errors, ratios, n = [], [], 0
            spent = 0.0
            for _ in range(places):
                image, middle = chip(one, rng, turn)
                started = time.process_time()
                match = matched(image, references[name], expected(middle, SIZE, rng, turn))
                spent += time.process_time() - started
                if not match.accepted:
                    continue
                n += 1
                error = np.array([match.row, match.column]) - middle
                off, covariance = beside(one, references[name], middle, SIZE)
                if np.isfinite(off).all():
                    error = error - off
                    ratios.append(error / np.sqrt(np.diag(match.covariance + covariance)))
                errors.append(error)
            distance = np.linalg.norm(np.reshape(errors, (-1, 2)), axis=1)
            ratio = np.reshape(ratios, (-1, 2))
            rms = np.sqrt(np.mean(np.square(np.reshape(errors, (-1, 2))), axis=0))
            whole = np.sqrt(np.mean(ratio**2)) if len(ratio) else np.nan
            print(
                f"  {name:14s} {100 * n / places:5.1f} % accepted, rms {np.round(rms, 3)} pixels, "
                f"error over sigma {np.round(np.sqrt(np.mean(ratio**2, axis=0)), 2)}, both "
                f"{whole:.2f} of {len(ratio)}; beyond 1.5 pixels {np.sum(distance > 1.5)}, "
                f"beyond 3 {np.sum(distance > 3)}; {spent / places:.3f} s each"
            )


def false_accepts(domains: dict[str, RangeDoppler], trials: int, seed: int) -> None:
    """Chips on references that do not show them: mirrored, of another place, of speckle alone."""
    rng = np.random.default_rng([seed, 99])
    looks = {}
    for name, domain in domains.items():
        velocity = autofocus(SharpnessCurve(domain, 2.0), 7062.0).velocity
        looks[name] = [np.abs(i.valid) for i in azimuth_looks(domain, velocity, 2)]
    names = list(looks)
    together = {"stanley_park", "ubc", "english_bay_1"}  # they overlap
    shape = looks[names[0]][0].shape
    speckled = Searchable(np.abs(speckle((shape[0], shape[1]), seed)))
    against: dict[str, list[tuple[np.ndarray, Searchable]]] = {
        "mirrored": [
            (one, Searchable(np.ascontiguousarray(b[:, ::-1]))) for one, b in looks.values()
        ],
        "upside down": [(one, Searchable(b[::-1].copy())) for one, b in looks.values()],
        "another place": [
            (looks[a][0], Searchable(looks[b][1]))
            for a in names
            for b in names
            if a != b and not {a, b} <= together
        ],
        "speckle": [(one, speckled) for one, _ in looks.values()],
        "chips of speckle": [(speckled.amplitude, Searchable(b)) for _, b in looks.values()],
    }
    total = wrong = 0
    for what, pairs in against.items():
        n, accepted, least = 0, 0, 1.0
        while n < trials / len(against):
            for one, reference in pairs:
                size = int(rng.choice([128, 192, 256]))
                turn = float(rng.choice([0.0, 12.0], p=[0.75, 0.25]))
                image, middle = chip(one, rng, turn, size)
                match = matched(image, reference, expected(middle, size, rng, turn))
                n, accepted = n + 1, accepted + match.accepted
                least = min(least, match.chance)
        total, wrong = total + n, wrong + accepted
        print(f"  {what:16s} {accepted} of {n} accepted; least chance {least:.1e}")
    print(f"  on wrong references: {wrong} of {total} accepted")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--places", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--trials", type=int, default=3000, help="on wrong references")
    parser.add_argument("--only", choices=("speed", "focusing", "matching", "wrong"))
    arguments = parser.parse_args()
    wanted = {arguments.only} if arguments.only else {"speed", "focusing", "matching", "wrong"}
    if "speed" in wanted:
        speed()
    if (DATA / "radarsat1_vancouver").is_dir():
        chunks = {name: domain_of(name) for name in CHUNKS}
        if "focusing" in wanted:
            focusing(chunks, arguments.starts)
        for number in range(arguments.seeds):
            if "matching" in wanted:
                matching(chunks, arguments.places, number)
            if "wrong" in wanted:
                false_accepts(chunks, arguments.trials, number)
    else:
        print(f"no recording in {DATA}: set TERRAFIX_DATA")
