"""Images recognized on references that no radar has seen, rendered from what is known beforehand.

    python benchmarks/rendered_reference.py [--images 60] [--cover parcels] [--classes 1]

Every image has a place, a surface, speckle and an orbit of its own; what is known of the terrain,
of each class's brightness and of where both lie errs anew. Printed are the share that is
recognized, the errors of what was accepted, in pixels of the reference and in meters on the ground,
what map and heights alone account for, and the mean square of errors normalized by the covariance
of the fix.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from passes import EARTH, HEADING, INCIDENCE, LOOKS, footprint, found, seen

from terrafix.models.geometry.geolocation import track_axes
from terrafix.models.images.placing import placed
from terrafix.models.images.rendered_reference import rendered
from terrafix.models.maps.dem import Dem, read_dem, read_jacksboro, roughened
from terrafix.models.radar.scene import CoverMap, Scene

SIZE, AROUND = (480, 600), (1000, 1100)
"""Rows and columns of images and of references."""
AREA = np.array([[25.0, -100.0], [45.0, -60.0]])
"""Latitudes and longitudes of places [deg]."""


def trial(number: int, dem: Dem, options: argparse.Namespace) -> dict[str, object]:
    """One image."""
    rng = np.random.default_rng([20191, number])
    place = np.radians(rng.uniform(*options.area))
    seed = int(rng.integers(2**31))
    turn = HEADING + np.pi * rng.integers(2)  # ascending or descending
    true = footprint(dem, place, SIZE, heading=turn)
    image = seen(Scene(dem, seed=seed, cover=options.cover), true, rng)
    known = dem
    if options.height:
        known = roughened(dem, options.height, options.length, number)
    datum = options.datum * float(rng.standard_normal())
    known = replace(known, height=known.height + np.float32(datum))
    cover = CoverMap(
        known, seed=seed, cover=options.cover, class_sigma=options.brightness, map_seed=number
    )
    if not options.classes:
        cover = CoverMap(known, cover="texture")
    displaced = options.placing * rng.standard_normal(2)
    # what is rendered is for an orbit some kilometer off
    off = 600.0 * rng.standard_normal(3)
    planned = footprint(known, place, AROUND, heading=turn, off=off)
    reference = rendered(cover, planned, LOOKS, displaced=tuple(displaced))
    match, view = found(image, reference, known, rng)
    row, column, inside = reference.pixel(image.place[0], image.place[1])
    out = {"accepted": match.accepted, "reason": match.reason, "inside": bool(inside)}
    if match.accepted:
        across = np.hypot(options.placing, options.datum / np.tan(INCIDENCE))
        up = np.hypot(options.height, options.datum)
        sigma = np.array([options.placing, across, up])
        p, D = placed(reference, known.at, match, view, sigma)
        error = p - EARTH.point(*image.place)
        out["pixels"] = (match.row - float(row), match.column - float(column))
        out["meters"] = track_axes(p, view.v) @ error
        out["square"] = error @ np.linalg.solve(D, error)
    return out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cover", default="parcels")
    parser.add_argument("--height", type=float, default=5.0, help="rms error of heights [m]")
    parser.add_argument("--length", type=float, default=300.0, help="its correlation [m]")
    parser.add_argument("--classes", type=int, default=1, help="0: relief alone")
    parser.add_argument("--brightness", type=float, default=1.5, help="error of classes [dB]")
    parser.add_argument("--placing", type=float, default=3.0, help="error of places [m]")
    parser.add_argument("--datum", type=float, default=0.0, help="error of all heights [m]")
    parser.add_argument("--tile", type=Path, help="another elevation model, a degree square")
    options = parser.parse_args()
    start, dem = time.process_time(), read_jacksboro().tiled()
    options.area = AREA
    if options.tile:
        dem = read_dem(options.tile)
        middle = [float(np.degrees(sum(dem._span(k)) / 2)) for k in (0, 1)]
        options.area = np.add(middle, [[-0.3, -0.25], [0.3, 0.25]])
    outcomes = [
        trial(k, dem, options) for k in range(options.first, options.first + options.images)
    ]
    right = [o for o in outcomes if o["accepted"]]
    pixels, meters = (np.array([o[k] for o in right]) for k in ("pixels", "meters"))
    print(f"{len(right)} of {len(outcomes)} recognized, {time.process_time() - start:.0f} s")
    print(Counter(str(o["reason"]) for o in outcomes))
    if len(right) < 2:
        return
    wrong = np.hypot(*pixels.T)
    print(f"beyond 1.5 and 3 pixels: {(wrong > 1.5).sum()}, {(wrong > 3).sum()}")
    for name, values in (("pixels", pixels), ("meters", meters)):
        rms = np.sqrt((values**2).mean(axis=0))
        print(f"{name}: mean {values.mean(axis=0).round(2)}, rms {rms.round(2)}")
    print(f"normalized square of the errors: {np.mean([o['square'] for o in right]):.2f} of 3")
    across = np.hypot(options.placing, options.height / np.tan(INCIDENCE))
    up = np.hypot(options.height, options.datum)
    print(f"of map and heights alone: {options.placing:.2f}, {across:.2f}, {up:.2f} m")


if __name__ == "__main__":
    main()
