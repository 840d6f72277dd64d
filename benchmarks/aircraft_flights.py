"""An aircraft that navigates by images of its own: flights with scenes and draws of their own.

    python benchmarks/aircraft_flights.py [--flights 20] [--seconds 50] [--first 1] [--set a=b ...]

Each flight is examples/aircraft_sar.toml with one member, and with a seed, hills, texture and
points of its own. Printed are the share of apertures that gave a fix and how many of them were
wrong by more than 3 m; errors across and along the track of what images measure, against the true
motion, with their mean over its standard error, and rms over claimed; what map drift read against
what is true; NEES (16 elements: biases of images have no truth) and NIS; position at the end,
3 sigma of the sample and of the filter; and processor seconds per aperture.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

import terrafix as tf

SYSTEM = Path(__file__).parents[1] / "examples" / "aircraft_sar.toml"
RECORDED = {
    "flight": ("r_e", "v_e"),
    "matcher": ("fix", "reason", "quality", "residual"),
    "radar": ("lost",),
    "former": ("image",),
}
WRONG = 3.0
"""What an accepted fix must not be off by [m]."""


def fly(k: int, seconds: float, settings: list[tuple[str, str]]) -> dict[str, Any]:
    """One flight: errors of what its images measure, and of its navigator."""
    own = [(f"{n}.relief_seed", str(k)) for n in ("terrain", "map")]
    own += [("terrain.surface_seed", str(1000 + k)), ("seed", str(k))]
    system = tf.read_system(SYSTEM, own + settings)
    for name, ports in RECORDED.items():
        system.record(name, [system.find(name)[port] for port in ports], period="0.5")
    begin = time.process_time()
    data = tf.simulate(system, members=1, duration=str(seconds)).dataset
    spent = time.process_time() - begin
    get = {str(n): np.asarray(v.values)[:, 0] for n, v in data.items() if "member" in v.dims}
    n = int(seconds)
    ends, centers = 2 * np.arange(1, n + 1), 2 * np.arange(1, n + 1) - 1
    y, p, R, present, speed = (
        get[f"matcher.fix.{name}"][ends] for name in ("y", "p_t_e", "R", "present", "speed")
    )
    r, v = get["flight.r_e"], get["flight.v_e"]
    d, a = p - r[centers], v[ends] - v[ends - 2]
    size = np.linalg.norm(v[centers], axis=1)
    true = [
        np.linalg.norm(d, axis=1),
        -np.einsum("ij,ij->i", d, v[centers]) / speed[:, 0],
        size - np.einsum("ij,ij->i", d, a) / (2 * size),
    ]
    fixed = get["matcher.reason"][ends] == 0
    focused = get["former.image.focused"][ends] > 0
    read = np.linalg.norm(get["former.image.v_e"][ends], axis=1) + get["former.image.drift"][ends]
    flown = np.linalg.norm(r[ends] - r[ends - 2], axis=1)
    return {
        "error": (y - np.stack(true, axis=1))[fixed],
        "claim": np.sqrt(np.diagonal(R, axis1=1, axis2=2))[fixed],
        "drift": (present[:, 2] > 0)[fixed],
        "at": np.arange(1, n + 1)[fixed],
        "reason": get["matcher.reason"][ends],
        "lost": get["radar.lost"][ends],
        "speed": (read - flown)[focused],
        "cost": spent / n,
        **{
            name: get[f"evaluation.{name}"]
            for name in (
                *("position_error", "position_sigma", "velocity_error", "velocity_sigma"),
                *("nees", "radar_nis", "radar_nis_dof"),
            )
        },
    }


def told(flights: list[dict[str, Any]]) -> str:
    """The numbers of some flights."""
    error, claim, drift = (
        np.concatenate([f[n] for f in flights]) for n in ("error", "claim", "drift")
    )
    asked = sum(len(f["reason"]) for f in flights)
    right = (np.abs(error[:, :2]) < WRONG).all(axis=1)
    reasons = np.concatenate([f["reason"] for f in flights])
    lines = [
        f"fixes {len(error)} of {asked} ({len(error) / asked:.1%}; bar 97 %), wrong by over "
        f"{WRONG:g} m {int((~right).sum())} (bar 0); reasons of the others "
        f"{sorted(reasons[reasons > 0].astype(int).tolist())}"
    ]
    for k, (name, use) in enumerate((("across", right), ("along", right), ("drift", drift))):
        e, s = error[use, k], claim[use, k]
        if not len(e):
            continue
        by = np.array(
            [f["error"][f["drift"] if k == 2 else slice(None), k].mean() for f in flights]
        )
        error_of_mean = by.std(ddof=1) / np.sqrt(len(by)) if len(by) > 1 else np.nan
        lines.append(
            f"{name:6} rms {np.sqrt(np.mean(e**2)):.3f}, sd {e.std():.3f}, mean {e.mean():+.4f} "
            f"(its standard error over flights {error_of_mean:.4f}), rms over claimed "
            f"{np.sqrt(np.mean(e**2) / np.mean(s**2)):.2f}, largest {np.abs(e).max():.3f}"
        )
    speed = np.concatenate([f["speed"] for f in flights])
    lines.append(
        f"map drift accepted in {len(speed)} of {asked}; what it reads less the true speed: rms "
        f"{np.sqrt(np.mean(speed**2)):.3f}, largest {np.abs(speed).max(initial=0):.3f} m/s"
    )
    nees = np.array([f["nees"][1:] for f in flights])
    low, high = chi2.ppf([0.025, 0.975], 16 * len(flights)) / len(flights)
    inside = ((nees.mean(axis=0) > low) & (nees.mean(axis=0) < high)).mean()
    nis = sum(np.nansum(f["radar_nis"]) for f in flights)
    dof = sum(np.nansum(f["radar_nis_dof"]) for f in flights)
    end = np.array([f["position_error"][-1] for f in flights])
    sigma = np.sqrt(np.mean([f["position_sigma"][-1] ** 2 for f in flights], axis=0))
    lines.append(
        f"NEES(16) mean {nees.mean():.1f}, at the end {nees[:, -1].mean():.1f}, 95 % of "
        f"{len(nees)}: {low:.1f} to {high:.1f}, inside at {inside:.0%} of the seconds; NIS / dof "
        f"{nis / dof:.2f}"
    )
    lines.append(
        f"3 sigma at the end N E D: sample {np.round(3 * np.sqrt((end**2).mean(axis=0)), 2)}, "
        f"filter {np.round(3 * sigma, 2)} m"
    )
    lines.append(f"{np.mean([f['cost'] for f in flights]):.2f} s of processor time per aperture")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=50.0)
    parser.add_argument("--first", type=int, default=1, help="seed of the first flight")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--keep", type=Path, help="file (.npy) to add each flight to")
    given = parser.parse_args()
    settings = [(name, value) for name, _, value in (s.partition("=") for s in given.set)]
    flights = []
    for k in range(given.first, given.first + given.flights):
        flights.append(fly(k, given.seconds, settings))
        if given.keep:
            np.save(given.keep, np.array(flights, dtype=object), allow_pickle=True)
        print(f"-- {len(flights)} flights of {given.seconds:g} s\n{told(flights)}", flush=True)


if __name__ == "__main__":
    main()
