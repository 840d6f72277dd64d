"""What lost lines do to an image: filled with zeros, and not filled, on RADARSAT-1's chunks.

    python benchmarks/lost_lines.py [--chunks stanley_park airport] [--cells 640]

Needs the recording (TERRAFIX_DATA). At 5 places of each chunk 3 and 10 lines are lost. Printed are,
where they are filled with zeros, and where lines that follow are taken for those that were lost (a
slip): the displacement of the image along the track against the whole one's, above and below the
place, the change of the velocity that autofocus finds, and the sharpness left. Then, how often a
slip is found by the phases of lines, and its length by what is seen before and after it: right,
refused, and wrong.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from pathlib import Path

import numpy as np

from terrafix.components.sensors.compiled import row_operations
from terrafix.models.core.arrays import ComplexArray
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.correlation import contrast, shift_between
from terrafix.models.radar.doppler import fractional_centroid, unwrapped_centroid
from terrafix.models.radar.focusing import Image
from terrafix.models.radar.imaging import Imager
from terrafix.models.radar.recordings.arrays import ArrayLines
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.recordings.lines import slips_among
from terrafix.models.radar.recordings.recording import Recording, looked_through
from terrafix.models.radar.recordings.slips import Seen, without_slips

RADAR = Radar(5.3e9, 1256.98, 32.317e6, -0.72135e12, 41.75e-6, 1000.0)
NEAR, CENTROID, VELOCITY = 988647.462, -6900.0, 7062.0
PLACES = (500, 640, 768, 900, 1040)
KINDS = ("zeros", "slip")
REACH = (40, 12)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chunks", nargs="*", default=["stanley_park", "airport"])
    parser.add_argument("--cells", type=int, default=640, help="beyond those of a pulse")
    arguments = parser.parse_args()
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TERRAFIX_DATA", default)) / "radarsat1_vancouver"
    found: dict[tuple[str, int], list[list[float]]] = {}
    cost = time.process_time()
    lengths: dict[str, Counter[str]] = {}
    for chunk in arguments.chunks:
        recording = read_recording(folder / f"{chunk}.npz")
        lengths[chunk] = Counter(
            length_found(recording, at, n_lost) for n_lost in (3, 10) for at in PLACES
        )
        first = recording.first_cell - 1
        echo = recording.read()[:, : RADAR.n_pulse + arguments.cells]
        near = NEAR + first * RADAR.range_spacing
        whole, velocity, sharpness = formed(echo, near)
        for n_lost in (3, 10):
            for at in PLACES:
                for kind in KINDS:
                    image, v, sharp = formed(spoiled(echo, at, n_lost, kind), near)
                    above, below = (displaced(image, whole, part, at) for part in (-1, 1))
                    row = [above, below, v - velocity, sharp / sharpness]
                    found.setdefault((kind, n_lost), []).append(row)
    for (kind, n_lost), rows in sorted(found.items()):
        values = np.array(rows)
        rms = np.sqrt(np.nanmean(values**2, axis=0))
        print(
            f"{kind:6} {n_lost:2} lines, {len(values)} cases: moved above {rms[0]:.3f}, below "
            f"{rms[1]:.3f} lines rms; velocity {rms[2]:.3f} m/s rms "
            f"({int(np.isnan(values[:, 2]).sum())} refused); sharpness {values[:, 3].mean():.3f}"
        )
    for chunk, counted in lengths.items():
        print(f"length of a slip, {chunk}: {dict(counted)}")
    print(f"{time.process_time() - cost:.0f} s of one processor")


def length_found(recording: Recording, at: int, n_lost: int) -> str:
    """What becomes of a recording that lacks lines."""
    echo = np.delete(recording.read(), np.s_[at : at + n_lost], axis=0)
    lines, place = ArrayLines((echo,), None), np.arange(len(echo))
    slips = slips_among(looked_through(lines), place)
    if not slips:
        return "not found"
    slipped = Recording(recording.path, lines, place, np.zeros(0, np.intp), slips=slips)
    near = NEAR + (recording.first_cell - 1) * RADAR.range_spacing
    fraction, _ = fractional_centroid(echo[:at], RADAR.prf)
    centroid = unwrapped_centroid(fraction, RADAR.prf, CENTROID)
    seen = Seen(RADAR, near, float(centroid), VELOCITY, row_operations())
    try:
        whole = without_slips(slipped, seen)
    except ValueError:
        return "refused"
    right = np.array_equal(whole.lost, at + 1 + np.arange(n_lost))
    return "right" if right else "wrong"


def spoiled(echo: ComplexArray, at: int, n_lost: int, kind: str) -> ComplexArray:
    if kind == "zeros":
        made = echo.copy()
        made[at : at + n_lost] = 0
        return made
    gone = np.delete(echo, np.s_[at : at + n_lost], axis=0)
    return np.concatenate([gone, echo[:n_lost] * 0])


def formed(echo: ComplexArray, near: float) -> tuple[Image, float, float]:
    imager = Imager(echo, RADAR, near, 0.0, operations=row_operations())
    centroid = imager.fraction + RADAR.prf * np.round((CENTROID - imager.fraction) / RADAR.prf)
    processing = imager.processing(float(centroid), VELOCITY, 0.0)
    _, focus = imager.focus([processing], VELOCITY)
    image = imager.image(processing, VELOCITY)
    velocity = focus.velocity if focus.accepted else np.nan
    return image, velocity, focus.sharpness


def displaced(image: Image, whole: Image, side: int, at: int) -> float:
    """Lines that an image is moved by beside the place, 20 to 300 lines from it."""
    rows = slice(at - 300, at - 20) if side < 0 else slice(at + 20, at + 300)
    down, right = REACH
    inner = contrast(np.abs(image.data[rows.start + down : rows.stop - down, right:-right]))
    shift = shift_between(inner, contrast(np.abs(whole.data[rows])), REACH)
    return float(shift.pixels[0] + (image.t[0] - whole.t[0]) * RADAR.prf)


if __name__ == "__main__":
    main()
