"""How fast does a spacecraft get lost when GPS is gone and no fix comes?

The open-loop spacecraft with its radar taken out: the filter dead-reckons for ten minutes, and
its predicted sigma grows with nothing to hold it.
"""

import argparse
from pathlib import Path

import numpy as np

import terrafix as tf

SYSTEM = Path(__file__).parent / "spacecraft_sar_open_loop.toml"


def main(*, members: int = 20, duration: str = "590.4", plot: str | None = None) -> tf.Result:
    """Fly the system without its fixes; print the position sigma at the end."""
    system = tf.read_system(SYSTEM, [("sar.look", "80 deg")])  # a boresight past the Earth: no fix
    result = tf.simulate(system, members=members, duration=duration)
    position = result.evaluation["position"]
    predicted, sample = (np.linalg.norm(position[k]) for k in ("sigma_predicted", "sigma_sample"))
    print(f"position sigma after {duration} s: predicted {predicted:.0f} m, sample {sample:.0f} m")
    if plot is not None:
        result.plot(plot)
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", help="picture of the errors (.png, .svg)")
    main(plot=parser.parse_args().plot)
