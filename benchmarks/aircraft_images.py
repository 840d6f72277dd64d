"""What an aircraft's radar images measure: fixes over many places, map drift, their cost.

    python benchmarks/aircraft_images.py [--places 16]

The scenario is that of the tests (tests/models/radar/aircraft.py): 70 m/s at 1 km, X band, 1 s
apertures, relief of 10 m rms, 8 scatterers in a resolution cell, earlier passes with speckle of
their own; navigators are off by 3 m and 0.1 m/s. Printed for each kind of scene: how many fixes are
right, refused, and accepted but wrong (by 3 m); rms errors across and along the track; those over
what the fix claims, which `SHEAR` of terrafix.models.images.aperture_matching is set by; the bias
and scatter of map drift; then processor seconds per echo and per fix, the first also as a ratio to
a sum with NumPy and to its own transforms.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import fft

from terrafix.models.images.aperture_matching import matched_aperture
from terrafix.models.radar.aperture_image import aperture_image
from terrafix.models.radar.lit_ground import LitGround
from terrafix.models.radar.map_drift import map_drift
from terrafix.models.radar.pulse_echo import pulse_echo
from terrafix.models.radar.pulses import ArraySums

HELPER = Path(__file__).parents[1] / "tests" / "models" / "radar" / "aircraft.py"


def aircraft() -> Any:
    spec = importlib.util.spec_from_file_location("aircraft", HELPER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def fixes(scenario: Any, scene: Any, n: int, flight: dict[str, Any]) -> dict[str, Any]:
    errors, claims, drifts, cost = [], [], [], []
    refused = wrong = 0
    for k in range(n):
        rng = np.random.default_rng(1000 + k)
        center = np.array([rng.uniform(-1000, 1000), rng.uniform(-1300, 0), -scenario.HEIGHT])
        t, r, axis = scenario.track(r=center, **flight)
        own = scenario.aperture(t, r, axis)
        lit = LitGround(scene, scenario.GROUND, own)
        echo = pulse_echo([lit.clutter(rng), lit.points()], own, scenario.SUMS, rng)
        reference = scenario.reference(scene, r.mean(axis=0), 2000 + k, length=260.0)
        believed = r + rng.normal(0, 3, 3) + np.outer(t, rng.normal(0, 0.1, 3))
        start = time.process_time()
        height = float(lit.scene.dem.at(*scenario.GROUND.geodetic(lit.base)[:2]))
        seen = scenario.seen_by(echo, t, believed, axis, height)
        drift = map_drift(seen.domain, seen.speed)
        image = aperture_image(seen, drift.velocity)
        fix = matched_aperture(
            image.amplitude(), image.grid, reference, scene.dem.at, expected=9.0 * np.eye(2)
        )
        cost.append(time.process_time() - start)
        if drift.accepted:
            drifts.append(drift.velocity - scenario.SPEED)
        if not fix.accepted:
            refused += 1
            continue
        away = fix.place - r.mean(axis=0)
        v = (r[-1] - r[0]) / (t[-1] - t[0])
        error = fix.measured - [np.linalg.norm(away), -(v @ away) / image.line.speed]
        if np.abs(error).max() > 3:
            wrong += 1
            continue
        errors.append(error)
        claims.append(np.diag(fix.covariance))
    return {
        "right": len(errors),
        "refused": refused,
        "wrong": wrong,
        "errors": np.array(errors).reshape(-1, 2),
        "claims": np.array(claims).reshape(-1, 2),
        "drifts": np.array(drifts),
        "cost": float(np.mean(cost)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=16)
    n = parser.parse_args().places
    scenario = aircraft()
    land = scenario.LAND
    smooth = {"parcels_db": 0.0, "smooth_db": 0.0, "fine_db": 0.0}
    cases: dict[str, tuple[Any, dict[str, Any]]] = {
        "texture and points": (land, {}),
        "texture": (replace(land, points_per_km2=0.0), {}),
        "points": (replace(land, **smooth), {}),
        "nothing": (replace(land, points_per_km2=0.0, **smooth, dem=scenario.FIELD.dem), {}),
        "crab of 5 deg": (land, {"crab": np.radians(5.0)}),
        "turn of 3 deg/s": (land, {"acceleration": (0.0, 3.66, 0.0)}),
    }
    for name, (scene, flight) in cases.items():
        found = fixes(scenario, scene, n, flight)
        line = f"{name:20} right {found['right']}, refused {found['refused']}, wrong "
        line += f"{found['wrong']} of {n}"
        if found["right"]:
            rms = np.sqrt(np.mean(found["errors"] ** 2, axis=0))
            mean = found["errors"].mean(axis=0)
            claimed = np.sqrt(found["claims"].mean(axis=0))
            line += f"; across {rms[0]:.3f} (mean {mean[0]:+.3f}), along {rms[1]:.3f} "
            line += f"(mean {mean[1]:+.3f}) m; error over claimed {rms[0] / claimed[0]:.2f} "
            line += f"{rms[1] / claimed[1]:.2f}"
        if len(found["drifts"]):
            line += f"; map drift {len(found['drifts'])}, bias {found['drifts'].mean():+.3f}, sd "
            line += f"{found['drifts'].std():.3f} m/s"
        print(f"{line}; {found['cost']:.2f} s a fix", flush=True)
    costs(scenario, land)


def costs(scenario: Any, scene: Any) -> None:
    t, r, axis = scenario.track()
    own, rng = scenario.aperture(t, r, axis), np.random.default_rng(0)

    def spent(call: Any) -> tuple[float, Any]:
        start = time.process_time()
        found = call()
        return time.process_time() - start, found

    strewn, clutter = spent(lambda: LitGround(scene, scenario.GROUND, own).clutter(rng))
    summed, echo = spent(lambda: pulse_echo([clutter], own, scenario.SUMS, rng))
    few = scenario.aperture(t[:8], r[:8], axis[:8])
    slow, _ = spent(lambda: pulse_echo([clutter], few, ArraySums(), rng))
    quick, _ = spent(lambda: pulse_echo([clutter], few, scenario.SUMS, rng))
    transforms, _ = spent(lambda: fft.ifft(fft.fft(echo, axis=0, workers=1), axis=0, workers=1))
    print(
        f"echo: {len(clutter.reflection)} scatterers strewn in {strewn:.2f} s and summed in "
        f"{summed:.2f} s; with NumPy {slow / quick:.1f} times as long; {summed / transforms:.0f} "
        "times its own azimuth transforms"
    )


if __name__ == "__main__":
    main()
