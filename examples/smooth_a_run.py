"""What would the spacecraft have known of every instant, had it waited for its last fix?

The open-loop spacecraft with the part of its filter that puts out the transition of its error;
the recorded run is smoothed backward, from its last fix to its first.
"""

import argparse
from pathlib import Path

import numpy as np

import terrafix as tf

SYSTEM = Path(__file__).parent / "spacecraft_sar_open_loop.toml"


def main(*, members: int = 20, case: str = "TC-2", out: str | None = None) -> tf.SmoothedRun:
    """Fly and smooth; print both sigmas of the position after a minute."""
    system = tf.read_system(SYSTEM, [("case", case)])
    settings = ("accel_psd", "misalignment_sigma0", "misalignment_psd")
    old = system.find("predict")
    new = tf.components.mekf_predict_smoothed(**{name: old.setting(name) for name in settings})
    system.replace("predict", new)
    ports = ["error_transition", "transition_since", "prior"]
    truth = ["orbit.r_e", "orbit.v_e", "antenna.q_mu"]
    recorded = [*(f"predict.{port}" for port in ports), "correct.estimate", *truth]
    system.record("smoother", recorded, period="8.2")

    smoothed = tf.smooth_run(tf.simulate(system, members=members, out=out))
    print(smoothed)
    minute = smoothed.dataset.sel(time=57.4)
    filtered, after = (
        float(np.linalg.norm(minute[f"{who}.sigma"].values[:, :3], axis=1).mean())
        for who in ("filter", "smoothed")
    )
    print(f"position sigma after a minute: filter {filtered:.0f} m, smoothed {after:.0f} m")
    return smoothed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", help="write the run there (.nc), for terrafix smooth")
    main(out=parser.parse_args().out)
