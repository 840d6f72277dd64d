"""How unlike two images may be and still be matched: by time, by heading, by incidence.

    python benchmarks/decorrelation.py [--trials 16] [--kinds relief,flat,...] [--of all]

Every trial has a place, a surface and speckle of its own. The reference is an earlier pass; the
image shows the place later (a share of texture and points has changed), from a track that is
turned, or at another incidence. Printed are the share that is recognized, the rms of the error of
what was (pixels of the reference, rows and columns together), and how many of these are wrong: by
1.5 pixels and more, by 3 and more.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from passes import HEADING, INCIDENCE, footprint, found, seen

from terrafix.models.maps.dem import flat_dem, read_jacksboro
from terrafix.models.radar.scene import Scene

KINDS = {
    "relief": ("jacksboro", "parcels"),
    "flat": ("flat", "parcels"),
    "texture": ("flat", "texture"),
    "urban": ("flat", "urban"),
    "coast": ("flat", "coast"),
    "causeway": ("flat", "causeway"),
    "fields": ("flat", "fields"),
}
LEVELS = {
    "correlation": (1.0, 0.8, 0.6, 0.45, 0.3),
    "heading": (0.0, 2.0, 5.0, 10.0, 15.0),
    "incidence": (0.0, 2.0, 5.0, 10.0),
}
SIZE, AROUND = (300, 300), (720, 620)
"""Rows and columns of images and of references."""


def trial(kind: str, what: str, level: float, number: int) -> tuple[bool, float]:
    """Whether one image was recognized, and by how many pixels wrong."""
    rng = np.random.default_rng([2019, number, sum(kind.encode())])
    relief, cover = KINDS[kind]
    dem = read_jacksboro().tiled() if relief == "jacksboro" else flat_dem(100.0)
    place = np.radians(rng.uniform([25.0, -100.0], [45.0, -60.0]))
    seed = int(rng.integers(2**31))
    view = {"heading": HEADING + np.pi * rng.integers(2), "incidence": INCIDENCE}
    earlier = seen(Scene(dem, seed=seed, cover=cover), footprint(dem, place, AROUND, **view), rng)
    change = level if what == "correlation" else 1.0
    if what in view:
        view[what] += np.radians(level) * rng.choice([-1, 1])
    now = Scene(dem, seed=seed, cover=cover, correlation=change, change_seed=seed + 1)
    image = seen(now, footprint(dem, place, SIZE, **view), rng)
    match, _ = found(image, earlier.reference, dem, rng)
    if not match.accepted:
        return False, np.nan
    row, column, _ = earlier.reference.pixel(image.place[0], image.place[1])
    return True, float(np.hypot(match.row - row, match.column - column))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=16)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--of", default="all", choices=["all", *LEVELS])
    options = parser.parse_args()
    start = time.process_time()
    for what, levels in LEVELS.items():
        if options.of not in ("all", what):
            continue
        print(f"{what}: recognized of {options.trials}, rms [pixels], wrong by 1.5 and by 3")
        print(" " * 10 + "".join(f"{level:>20g}" for level in levels))
        for kind in options.kinds.split(","):
            cells = []
            for level in levels:
                outcomes = [trial(kind, what, level, k) for k in range(options.trials)]
                errors = np.array([e for accepted, e in outcomes if accepted])
                close = errors[errors < 3]
                rms = np.sqrt((close**2).mean()) if len(close) else np.nan
                wrong = [(errors > limit).sum() for limit in (1.5, 3.0)]
                cells.append(f"{len(errors):>8d} {rms:5.2f} {wrong[0]:2d} {wrong[1]:2d}")
            print(f"{kind:10s}" + "".join(cells), flush=True)
    print(f"{time.process_time() - start:.0f} s")


if __name__ == "__main__":
    main()
