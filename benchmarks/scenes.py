"""Matching on every kind of simulated scene: acceptance, errors, and errors over their sigmas.

    python benchmarks/scenes.py [--chips 20] [--scenes 3] [--kinds coast,urban]

Two ideal passes over each scene, 300 m apart, with speckle of their own; chips of one at random on
the other, whose place is predicted within 20 pixels and 0.1 %. What is true is known by geometry.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np
from passes import EARTH, LOOKS, PALSAR, footprint, seen

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.geolocation import track_axes
from terrafix.models.images.matching import Prediction, Searchable, matched
from terrafix.models.maps.dem import Dem, flat_dem, read_jacksboro
from terrafix.models.radar.footprint import Footprint
from terrafix.models.radar.multilook import full_index, multilook_index
from terrafix.models.radar.scene import Scene

KINDS = ("parcels", "flat", "texture", "urban", "coast", "causeway", "fields")
SHAPE, AROUND, SIZE = (700, 800), 160, 256
PRIOR, LINEAR = 20.0, 1e-3


def place(grid: Footprint, dem: Dem, row: FloatArray, column: FloatArray) -> FloatArray:
    """Points (..., 3) [m] of the terrain that pixels show."""
    line, cell = (full_index(k, n) for k, n in zip((row, column), LOOKS, strict=True))
    t = grid.first_time + line / PALSAR.prf
    R = grid.near_range + cell * PALSAR.range_spacing
    h = np.zeros(np.shape(row))
    for _ in range(80):
        p = grid.points(t, R, h)
        latitude, longitude, _ = EARTH.geodetic(p)
        h = h + 0.5 * (dem.at(latitude, longitude) - h)
    return p


def pixel(grid: Footprint, p: FloatArray) -> FloatArray:
    """Row and column (..., 2) at which points are seen, broadside."""
    t = np.zeros(p.shape[:-1])
    for _ in range(20):
        r, v = grid.arc.position(t), grid.arc.velocity(t)
        t = t + np.sum((p - r) * v, axis=-1) / np.sum(v * v, axis=-1)
    R = np.linalg.norm(p - grid.arc.position(t), axis=-1)
    full = (t - grid.first_time) * PALSAR.prf, (R - grid.near_range) / PALSAR.range_spacing
    return np.stack([multilook_index(k, n) for k, n in zip(full, LOOKS, strict=True)], axis=-1)


def trial(kind: str, number: int, chips: int) -> list[dict[str, object]]:
    """Chips of one scene."""
    rng = np.random.default_rng([number, KINDS.index(kind)])
    dem = flat_dem(0.0) if kind == "flat" else read_jacksboro().tiled()
    middle = np.radians([36.3, -84.25]) + rng.uniform(-0.1, 0.1, 2)
    scene = Scene(dem, number + 50, cover="parcels" if kind == "flat" else kind)
    here = footprint(dem, (middle[0], middle[1]), SHAPE)
    r, v = here.arc.position(np.array(0.0)), here.arc.velocity(np.array(0.0))
    off = np.array([0.0, 300.0, 150.0]) @ track_axes(r, v)
    around = SHAPE[0] + AROUND, SHAPE[1] + AROUND
    there = footprint(dem, (middle[0], middle[1]), around, off=off)
    one, other = (seen(scene, grid, rng).amplitude for grid in (here, there))
    reference = Searchable(other)
    i, j = np.meshgrid(*(np.linspace(0, n - 1, 9) for n in SHAPE), indexing="ij")
    design = np.stack([np.ones_like(i), i, j], axis=-1).reshape(-1, 3)
    known = pixel(there, place(here, dem, i, j)).reshape(-1, 2)
    first, *slopes = np.linalg.lstsq(design, known, rcond=None)[0]
    A = np.stack(slopes, axis=1)
    found: list[dict[str, object]] = []
    for _ in range(chips):
        at = np.array([rng.integers(0, n - SIZE) for n in SHAPE])
        corner = first + A @ at + rng.normal(0, PRIOR, 2)
        where = Prediction.affine(
            np.column_stack([A, corner]), PRIOR**2 * np.eye(2), LINEAR, LINEAR
        )
        started = time.process_time()
        image = Searchable(one[at[0] : at[0] + SIZE, at[1] : at[1] + SIZE])
        match = matched(image, reference, where)
        spent = time.process_time() - started
        c = at + (SIZE - 1) / 2
        true = pixel(there, place(here, dem, c[0], c[1]))
        error = np.array([match.row, match.column]) - true
        found.append({"match": match, "error": error, "spent": spent})
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--chips", type=int, default=20)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--kinds", default=",".join(KINDS))
    options = parser.parse_args()
    for kind in options.kinds.split(","):
        found = [t for k in range(options.scenes) for t in trial(kind, k, options.chips)]
        good = [t for t in found if t["match"].accepted]
        why = Counter(t["match"].reason for t in found)
        print(f"{kind:9s} {len(good)} of {len(found)} accepted; {dict(why)}")
        if not good:
            continue
        errors = np.array([t["error"] for t in good])
        sigmas = np.array([t["match"].sigma for t in good])
        ratios, distance = errors / sigmas, np.linalg.norm(errors, axis=1)
        print(
            f"  rms {np.sqrt(np.mean(errors**2, axis=0)).round(3)} pixels, median sigma "
            f"{np.median(sigmas, axis=0).round(3)}; error over sigma "
            f"{np.sqrt(np.mean(ratios**2, axis=0)).round(2)}, both "
            f"{np.sqrt(np.mean(ratios**2)):.2f}, largest {np.abs(ratios).max():.1f}; beyond 1.5 "
            f"pixels {np.sum(distance > 1.5)}, beyond 3 {np.sum(distance > 3)}; "
            f"{np.mean([t['spent'] for t in found]):.3f} s each"
        )


if __name__ == "__main__":
    main()
