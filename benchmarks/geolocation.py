"""How well a target is tracked in images from orbit: errors, consistency, matches, time.

    python benchmarks/geolocation.py [--members 100] [--other B2.TIF B3.TIF] [--only printed]

Of the printed system, the corrected one and the pass: root mean square of the target's error over
members and epochs, at the end, NEES and NIS of each profile; the attitude's standard deviation; of
the matcher its error, and how long that lasts; time and memory. The corrected system and the pass
need the Landsat image (TERRAFIX_DATA). `--other` names images of the same place in other bands, or
of another row, from which the scene is cut while the map stays.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.optimize import curve_fit

import terrafix as tf

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
BAND_4 = DATA / "landsat8" / "LC08_L1TP_224077_20200518_20200518_01_RT_B4.TIF"
PROFILES = ("non_updated", "image_matched", "image_corrected", "map_matched")
ORBITS = ("LEO", "MOL")
PLACE = ("-25.25 deg", "-54.66 deg")
"""In the overlap of two rows of the satellite."""
NCC = (("matcher.method", "ncc"), ("georeference.method", "ncc"))
OTHER_BAND = (
    ("known_located.georeference_sigma", "0.1 px"),
    ("known_mapped.mismatch_sigma", "0.1 px"),
    ("located_predict.mismatch_sigma", "0.1 px"),
    ("located_predict.mismatch_time", "1000 s"),
)
"""What a match of one band to another is off by, the same in all frames."""
EFFECTS: dict[str, tuple[tuple[str, str], ...]] = {
    "point spread 1 px": (("camera.blur", "1 px"), ("georeference.blur", "1 px")),
    "noise 16 codes": (
        ("camera.noise", "16"),
        ("matcher.noise", "16"),
        ("georeference.noise", "16"),
    ),
    "motion blur 3 px": (("camera.smear", "[3, 0] px"),),
    "light +24 %, ssd": (("camera.light_rate", "2e-4 1/s"),),
    "light +24 %, ncc": (("camera.light_rate", "2e-4 1/s"), *NCC),
    "10 % hidden": (("camera.hidden", "0.1"),),
    "30 % hidden": (("camera.hidden", "0.3"),),
    "30 % hidden, gate": (("camera.hidden", "0.3"), ("corrected_correct.gate", "13.8")),
    "10 % hidden, phase": (("camera.hidden", "0.1"), ("matcher.method", "phase")),
    "turned by 1 deg": (("camera.turn_rate", "1.454e-5 rad/s"),),
    "grown by 1 %": (("camera.stretch_rate", "8.33e-6 1/s"),),
}


def fly(file: str, members: int, *settings: tuple[str, str]) -> Any:
    """Fly a system, print a line for each profile, and return the records."""
    system = tf.read_system(EXAMPLES / file, list(settings))
    system.record("matches", ["matcher.fix", "matcher.reason", "satellite.target"], period="1")
    began, processor = time.perf_counter(), time.process_time()
    data = tf.simulate(system, members=members).dataset
    took, used = time.perf_counter() - began, time.process_time() - processor
    print(f"{file} {dict(settings)}: {members} members, {took:.1f} s, {used:.1f} s of processors")
    rms = {}
    for name in PROFILES:
        if f"{name}.target_error" not in data:
            continue
        square = (data[f"{name}.target_error"].values ** 2).sum(axis=-1)
        rms[name] = np.sqrt(np.nanmean(square))
        ends = [np.sqrt(np.nanmean(square[k])) for k in (0, -1)]
        nees = np.nanmean(data[f"{name}.nees"].values)
        nis = data[f"{name}.nis"].values
        told = f"{np.nanmean(nis):9.3f}" if np.isfinite(nis).any() else "        -"
        print(
            f"  {name:16s} RSS {rms[name]:8.4f} px  t = 0 {ends[0]:8.4f}  end {ends[1]:8.4f}"
            f"  NEES {nees:9.3f}  NIS {told}"
        )
    if "image_corrected" in rms:
        by = {n: rms[n] / rms["image_corrected"] for n in ("non_updated", "image_matched")}
        print("  over corrected: " + ", ".join(f"{n} {ratio:.1f}" for n, ratio in by.items()))
    reasons, counts = np.unique(data["matcher.reason"].values, return_counts=True)
    print(f"  reasons {dict(zip(reasons.tolist(), counts.tolist(), strict=True))}")
    return data


def lasting(k: Any, part: float, duration: float, rest: float) -> Any:
    """Autocorrelation of white noise, a Gauss-Markov process and a constant, beyond lag 0."""
    return part * np.exp(-k / duration) + rest


def match_errors(data: Any) -> None:
    """Print the error of matches, and its parts: white, lasting, constant [px]."""
    fix, target = data["matcher.fix.y"].values, data["satellite.target"].values
    error = (fix - (target - target[0]))[1:]
    lags = np.arange(61)
    c = np.array([np.nanmean(error[: len(error) - k] * error[k:]) for k in lags])
    bounds = ([0.0, 0.3, 0.0], [2.0, 100.0, 1.0])
    p, _ = curve_fit(lasting, lags[1:], c[1:] / c[0], p0=(0.5, 3.0, 0.1), bounds=bounds)
    white, held, rest = (np.sqrt(max(0.0, c[0] * x)) for x in (1 - p[0] - p[2], p[0], p[2]))
    share = np.isfinite(fix[1:, :, 0]).mean()
    print(
        f"  matched {100 * share:.2f} %, error per axis {np.sqrt(c[0]):.4f} px: white {white:.4f}, "
        f"lasting {held:.4f} for {p[1]:.1f} s, constant {rest:.4f}"
    )
    if "image_corrected.target_error" in data:
        first = data["image_corrected.target_error"].values[0]
        print(f"  first frame per axis {np.sqrt(np.nanmean(first**2)):.4f} px")


def attitude(data: Any) -> None:
    """Print standard deviations of pitch and roll, and what is left of their correlation."""
    angles = [np.degrees(data[f"non_updated.{n}_error"].values[..., 0]) for n in ("pitch", "roll")]
    both = np.concatenate(angles, axis=1)
    sigmas = [np.sqrt((both[k] ** 2).mean()) for k in (0, 600, 1200)]
    left = (both[:-600] * both[600:]).mean() / (both**2).mean()
    print(f"  attitude {sigmas} deg at 0, 10, 20 min; correlation after 600 s {left:.3f}")
    lags = np.arange(0, 1000, 10)
    c = np.array([(both[: len(both) - k] * both[k:]).mean() for k in lags])
    print(f"  correlation of 1/e after {lags[np.argmax(c / c[0] < np.exp(-1))]} s")


def printed(members: int) -> None:
    """Print the printed system in all its kinds."""
    for orbit in ORBITS:
        for matching in ("parts", "whole", "all_whole"):
            data = fly(
                "geolocation_printed.toml", members, ("orbit", orbit), ("matching", matching)
            )
            match_errors(data)
        attitude(data)
        start = (data["image_matched.target_error"].values ** 2).sum(axis=-1).mean(axis=1)
        rss = np.sqrt(start)
        print(f"  matched over its first: {rss.min() / rss[0]:.3f} to {rss.max() / rss[0]:.3f}")


def effects(few: int) -> None:
    """Print what disturbs the images of the corrected system."""
    for name, settings in EFFECTS.items():
        print(name)
        match_errors(fly("geolocation.toml", few, *settings))


def corrected(members: int, few: int) -> None:
    """Print the corrected system, its methods, and what disturbs its images."""
    for orbit in ORBITS:
        match_errors(fly("geolocation.toml", members, ("orbit", orbit)))
        for method in ("ncc", "phase"):
            match_errors(fly("geolocation.toml", few, ("orbit", orbit), ("matcher.method", method)))


def others(files: list[str], few: int) -> None:
    """Print what comes of a scene that is another image of the place that the map is of."""
    for file in files:
        text = (EXAMPLES / "geolocation_pass.toml").read_text()
        map_of = text[text.index("[component.scene]") : text.index("# at its apogee")]
        text += map_of.replace("[component.scene]", "[component.map]")
        for name in ("scene", "place", "grid"):
            for matcher in ("georeference", "map_matcher"):
                text = text.replace(f"scene.{name} -> {matcher}", f"map.{name} -> {matcher}")
        settings = [("scene.file", str(Path(file).absolute())), ("map_matcher.method", "ncc"), *NCC]
        settings += [("map.file", str(BAND_4.absolute()))]
        for part in ("scene", "map", "satellite"):
            settings += [(f"{part}.latitude", PLACE[0]), (f"{part}.longitude", PLACE[1])]
        print(f"scene of {Path(file).name}, map of band 4")
        with TemporaryDirectory() as folder:
            path = Path(folder) / "other_pass.toml"
            path.write_text(text)
            fly(str(path), few, *settings)
            fly(str(path), few, *settings, *OTHER_BAND)


def speed() -> None:
    """Print the time of 100 runs and of one, warm, and the largest memory of a campaign."""
    for members in (100, 1):
        system = tf.read_system(EXAMPLES / "geolocation_printed.toml")
        tf.simulate(system, members=members, duration="2")
        began, processor = time.perf_counter(), time.process_time()
        tf.simulate(system, members=members)
        took, used = time.perf_counter() - began, time.process_time() - processor
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        print(f"printed, {members}: {took:.1f} s, {used:.1f} s of processors, {memory:.0f} MB")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--members", type=int, default=100)
    parser.add_argument("--few", type=int, default=20)
    parser.add_argument("--other", nargs="*", default=[])
    parser.add_argument(
        "--only",
        choices=("printed", "corrected", "effects", "pass", "others", "speed"),
        default=None,
    )
    options = parser.parse_args()
    all_parts = ["speed", "printed", "corrected", "effects", "pass", "others"]
    wanted = [options.only] if options.only else all_parts
    if "speed" in wanted:
        speed()
    if "printed" in wanted:
        printed(options.members)
    if not BAND_4.is_file():
        print("no Landsat image: the rest is left out (set TERRAFIX_DATA)")
        return
    if "corrected" in wanted:
        corrected(options.members, options.few)
    if "effects" in wanted:
        effects(options.few)
    if "pass" in wanted:
        for settings in ((), (("camera.cycle", "20 s"), ("camera.stare", "5 s"))):
            fly("geolocation_pass.toml", options.members, *settings)
    if "others" in wanted:
        others(options.other, options.few)


if __name__ == "__main__":
    main()
