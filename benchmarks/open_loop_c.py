"""The open loop written by hand in C: the same numbers, and what they cost without components.

    python benchmarks/open_loop_c.py [--members 100]

`open_loop.c` has the mathematics and the noise of examples/spacecraft_sar_open_loop.toml in one
block-structured program. It is the reference for the cost of flying that system with terrafix.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import terrafix.cosim.kernels
from terrafix.cosim.basics.noise import stream_key
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System

SOURCE = Path(__file__).with_name("open_loop.c")
SYSTEM = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"
FLAGS = [
    *("-std=c11", "-O3", "-march=native", "-ffp-contract=off", "-fno-math-errno"),
    *("-shared", "-fPIC"),
]

# As in `struct parameters`, after the step
PARAMETERS = {
    "orbit": "r0_i v0_i earth_angle0 mu radius j2 rotation_rate",
    "attitude": "rotation_rate",
    "antenna": "misalignment misalignment_sigma0 misalignment_walk",
    "ads": "noise_sigma bias_sigma",
    "imu": "velocity_random_walk accel_bias_sigma0 accel_bias_walk "
    "angle_random_walk gyro_bias_sigma0 gyro_bias_walk gyro_scale_factor",
    "sar": "look squint range_sigma speed_sigma geolocation_sigma geolocation_bias "
    "radius flattening",
    "last_known": "position_sigma velocity_sigma",
    "predict": "mu radius j2 rotation_rate accel_psd misalignment_psd misalignment_sigma0",
    "correct": "look squint underweighting underweighted_updates gate",
}
# As in `struct keys`
STREAMS = (
    *("ads.white", "imu.accel_white", "imu.accel_bias_noise"),
    *("imu.gyro_white", "imu.gyro_bias_noise"),
    *("antenna.misalignment_noise", "sar.range_noise", "sar.speed_noise"),
    *("sar.geolocation_noise", "ads.bias_draw", "last_known.error"),
)
# What the program is written for
STRUCTURE = {
    "orbit.gravity": "j2",
    "orbit.drag": False,
    "attitude.velocity": "earth-fixed",
    "imu.bias": "walk",
    "imu.grade": "simple",
    "sar.boresight": "true",
    "sar.in_track": "speed",
    "predict.gravity": "j2",
    "predict.transition": "exact",
    "correct.update": "ekf",
    "correct.jacobian": "exact",
    "correct.in_track": "speed",
}
# Every error source that the example leaves at zero
ALL_ERRORS = (
    ("config", "B"),
    ("antenna.misalignment", "[0.02, -0.01, 0.03] deg"),
    ("ads.noise_sigma", "3 arcsec"),
    ("ads.bias_sigma", "2 arcsec"),
    ("imu.accel_bias_sigma0", "1e-5 m/s^2"),
    ("imu.accel_bias_walk", "1e-7 m/s^2/s^0.5"),
    ("imu.angle_random_walk", "1e-6 rad/s^0.5"),
    ("imu.gyro_bias_sigma0", "1e-6 rad/s"),
    ("imu.gyro_bias_walk", "1e-9 rad/s/s^0.5"),
    ("imu.gyro_scale_factor", "1e-4"),
    ("sar.geolocation_bias", "[1, -2, 3] m"),
)
Settings = Sequence[tuple[str, str]]


@functools.cache
def library() -> ctypes.CDLL:
    """The program, compiled now; the file is not needed once it is loaded."""
    include = Path(terrafix.cosim.kernels.__file__).parent
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "open_loop.so")
        subprocess.run(
            ["cc", *FLAGS, f"-I{include}", str(SOURCE), "-o", str(file), "-lm"], check=True
        )
        loaded = ctypes.CDLL(str(file))
    loaded.open_loop.restype = ctypes.c_int64
    loaded.open_loop.argtypes = [ctypes.c_void_p] * 2 + [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 4
    return loaded


def _system(case: str, settings: Settings) -> System:
    system = read_system(SYSTEM, [("case", case), *settings])
    for path, value in STRUCTURE.items():
        component, name = path.split(".")
        if system.find(component).setting(name) != value:
            raise ValueError(f"{path} must be {value!r}: open_loop.c knows no other")
    return system


def fly(
    n_members: int, n_ticks: int, seed: int, case: str, settings: Settings = ()
) -> tuple[float, dict[str, np.ndarray]]:
    """Fly an ensemble: seconds, and the last state of every member.

    Parameters
    ----------
    n_members, n_ticks : int
        Size of the ensemble, and how far it flies.
    seed : int
        Root seed.
    case : str
        Choice of the example.
    settings : sequence of (str, str)
        As `read_system` takes them.

    Returns
    -------
    seconds : float
        Of the program alone.
    results : dict
        ``truth`` and ``estimate``, shape (n_members, 6), position and velocity; ``P`` (n_members,
        9, 9); ``delta_theta_b`` (n_members, 3); ``accepted``, how many fixes were, of all members.
    """
    system = _system(case, settings)
    step, fixes = system.find("orbit").rate.period, system.find("sar").rate.period
    values = [np.array([float(step)])]
    for path, names in PARAMETERS.items():
        component = system.find(path)
        for name in names.split():
            shape = type(component).settings()[name].shape
            values.append(np.broadcast_to(component.setting(name), shape).ravel())
    parameters = np.concatenate(values).astype(np.float64)
    streams = [stream.split(".") for stream in STREAMS]
    keys = np.array([stream_key(seed, *stream) for stream in streams], dtype=np.uint64)
    results = {
        "truth": np.empty((n_members, 6)),
        "estimate": np.empty((n_members, 6)),
        "P": np.empty((n_members, 9, 9)),
        "delta_theta_b": np.empty((n_members, 3)),
    }
    arrays = [array.ctypes.data for array in results.values()]
    program = library().open_loop
    started = time.perf_counter()
    accepted = program(
        parameters.ctypes.data, keys.ctypes.data, n_members, n_ticks, int(fixes / step), *arrays
    )
    seconds = time.perf_counter() - started
    return seconds, results | {"accepted": np.array(accepted)}


def agreement(n_members: int, n_fixes: int, case: str, settings: Settings) -> dict[str, float]:
    """Largest difference of program and terrafix at the last fix, relative.

    Vectors to their length, the error of the estimate to its own, elements of the covariance to
    the standard deviations they belong to.
    """
    system = _system(case, settings)
    step, fixes = system.find("orbit").rate.period, system.find("sar").rate.period
    system.record("gyroscopes", "imu.delta_theta_b", period=fixes)
    theirs = simulate(system, members=n_members, duration=n_fixes * fixes).dataset
    n_ticks = n_fixes * int(fixes / step)
    _, ours = fly(n_members, n_ticks, system.seed, case, settings)
    if ours["accepted"] != n_members * n_fixes:
        raise ValueError(f"{ours['accepted']} fixes accepted of {n_members * n_fixes}")

    def last(name: str) -> np.ndarray:
        return theirs[name].to_numpy()[-1]

    def relative(mine: np.ndarray, other: np.ndarray) -> float:
        lengths = np.linalg.norm(other, axis=1)
        return float(np.max(np.linalg.norm(mine - other, axis=1) / lengths))

    truth = np.hstack([last("orbit.r_e"), last("orbit.v_e")])
    estimate = np.hstack([last("correct.estimate.r_e"), last("correct.estimate.v_e")])
    P = last("correct.estimate.P")
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    found = {}
    for i, what in enumerate(("position", "velocity")):
        part = slice(3 * i, 3 * i + 3)
        found[f"true {what}"] = relative(ours["truth"][:, part], truth[:, part])
        found[f"estimated {what}"] = relative(ours["estimate"][:, part], estimate[:, part])
        found[f"error of {what}"] = relative(
            (ours["estimate"] - ours["truth"])[:, part], (estimate - truth)[:, part]
        )
    found["covariance"] = float(
        np.max(np.abs(ours["P"] - P) / (sigma[:, :, None] * sigma[:, None, :]))
    )
    found["gyroscopes"] = relative(ours["delta_theta_b"], last("imu.delta_theta_b"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--members", type=int, default=100, help="of the ensemble that is timed")
    members = parser.parse_args().members
    print("largest relative difference from terrafix after 10 fixes, 3 members")
    cases = {
        "TC-1": agreement(3, 10, "TC-1", ()),
        "TC-2": agreement(3, 10, "TC-2", ()),
        "TC-1, all errors": agreement(3, 10, "TC-1", ALL_ERRORS),
    }
    print(" " * 20 + "".join(f"{case:>18}" for case in cases))
    rows = list(cases["TC-1"])
    for what in rows:
        print(f"{what:20}" + "".join(f"{found[what]:18.1e}" for found in cases.values()))
    # rounding of positions is a larger part of their errors, and grows with every correction
    limits = {what: 1e-9 if what.startswith(("true", "estimated")) else 1e-8 for what in rows}
    wrong = [w for w in rows if not all(found[w] < limits[w] for found in cases.values())]
    if wrong:
        raise SystemExit(f"they do not agree: {', '.join(wrong)}")
    n_ticks = 5740
    best = min(fly(members, n_ticks, 2008, "TC-1")[0] for _ in range(5))
    print(
        f"{members} members, {n_ticks} ticks: {best:.3f} s, "
        f"{best / (members * n_ticks) * 1e9:.0f} ns per member and tick (best of 5)"
    )


if __name__ == "__main__":
    main()
