"""A wrong track, recovered from recorded X-band phase history: 80 draws.

    python benchmarks/gotcha.py [--draws 20]

Needs the AFRL "Gotcha" set (TERRAFIX_DATA). Two degrees of aspect are imaged with a track that is
off by a position and a velocity, focused by map drift, and correlated with the image of the next
two degrees: other speckle, the same cars. The speed is not in the data, 100 m/s are assumed.
Printed are, for four kinds of errors, how many are right (within 0.5 m in range and 1 m along), how
many are accepted and wrong, and the rms of what is measured less what is true. Mirrored images are
the negative control: none must be accepted.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np

from terrafix.components.sensors.compiled import pulse_sums
from terrafix.models.core.arrays import Single
from terrafix.models.images.aperture_matching import recognized
from terrafix.models.radar.compensation import straight_line
from terrafix.models.radar.correlation import contrast, shift_between
from terrafix.models.radar.phase_history import (
    compressed_pulses,
    ground_grid,
    moved,
    projected,
    projected_drift,
    read_gotcha,
)

SPEED, SPACING, REACH = 100.0, 0.25, (144, 72)
KINDS = {
    "0.5 m, 0.1 m/s": (0.5, 0.1, (0.0, 0.0)),
    "5 m, 0.1 m/s": (5.0, 0.1, (0.0, 0.0)),
    "5 m, 0.02 m/s": (5.0, 0.02, (0.0, 0.0)),
    "0.5 m, 0.5 to 2 m/s along": (0.5, 0.02, (0.5, 2.0)),
}
"""Standard deviations of position [m] and velocity [m/s], each axis, and along the track more."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    draws = parser.parse_args().draws
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TERRAFIX_DATA", default)) / "afrl_gotcha"
    files = [folder / f"data_3dsar_pass1_az00{k}_HH.mat" for k in (1, 2, 3, 4)]
    flown, other = read_gotcha(files[:2]), read_gotcha(files[2:])
    sums, rng = pulse_sums(), np.random.default_rng(1)
    grid = ground_grid(flown.r, SPACING, 440, 440)
    wide = projected(compressed_pulses(other), grid.grown(*REACH), sums)
    reference: Single = contrast(wide)
    t = flown.times(SPEED)
    true, pulses = straight_line(t, flown.r), compressed_pulses(flown)
    right = wrong = mirrored = 0
    for name, (position, velocity, along) in KINDS.items():
        errors, cost = [], time.process_time()
        for _ in range(draws):
            dv = rng.normal(0, velocity, 3)
            dv += true.along * rng.choice([-1.0, 1.0]) * rng.uniform(*along)
            believed = flown.r + rng.normal(0, position, 3) + np.outer(t, dv)
            drift, focused = projected_drift(moved(pulses, believed), t, grid, sums)
            image = contrast(projected(focused, grid, sums))
            shift = shift_between(image, reference, REACH)
            at = SPACING * (shift.pixels[0] * grid.along + shift.pixels[1] * grid.out)
            now, speed = straight_line(t, focused.r), straight_line(t, believed).speed
            range_error = np.linalg.norm(at - now.r) - np.linalg.norm(true.r)
            along_error = (now.v @ (at - now.r) + true.v @ true.r) / speed
            good = abs(range_error) < 0.5 and abs(along_error) < 1.0
            right += recognized(shift) and good
            wrong += recognized(shift) and not good
            if recognized(shift) and good:
                found = drift.velocity - true.speed if drift.accepted else np.nan
                errors.append((range_error, along_error, found))
            flipped = np.ascontiguousarray(image[::-1, ::-1])
            mirrored += recognized(shift_between(flipped, reference, REACH))
        rms = np.sqrt(np.nanmean(np.square(errors), axis=0))
        refused = int(np.isnan(errors).any(axis=1).sum())
        print(
            f"{name:28} right {len(errors)} of {draws}; rms range {rms[0]:.3f} m, along "
            f"{rms[1]:.3f} m, velocity {rms[2]:.3f} m/s ({refused} refused); "
            f"{(time.process_time() - cost) / draws:.2f} s each"
        )
    print(
        f"right {right} of {4 * draws} (bar: 76 of 80), accepted and wrong {wrong} (bar: 0), "
        f"mirrored and accepted {mirrored} (bar: 0)"
    )


if __name__ == "__main__":
    main()
