"""A wrong track, recovered from recorded X-band echo by a system of components."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import terrafix as tf
from terrafix.cosim.basics.errors import TerrafixError

ROOT = Path(__file__).parents[2]
SYSTEM = ROOT / "examples" / "aircraft_gotcha.toml"
GOTCHA = Path(os.environ.get("TERRAFIX_DATA", ROOT.parent / "shared" / "data")) / "afrl_gotcha"


@pytest.mark.parametrize("errors", ["small", "large"])
def test_a_wrong_track_is_recovered_from_another_aspect(errors):
    """Two draws each, within three of the rms that 80 may have: 0.08 m, 0.25 m, 0.06 m/s."""
    if not GOTCHA.is_dir():
        pytest.skip(f"no phase history: {GOTCHA} is absent")
    system = tf.read_system(SYSTEM, [("errors", errors)])
    data = tf.simulate(system, members=2).dataset
    assert (data["evaluation.accepted"].values[-1] == 1).all()
    bars = {"range": 3 * 0.08, "along": 3 * 0.25, "speed": 3 * 0.06}
    for name, bar in bars.items():
        assert np.abs(data[f"evaluation.{name}_error"].values[-1]).max() < bar, name


def test_a_folder_without_the_set_is_named(tmp_path):
    shutil.copy(SYSTEM, tmp_path)
    settings = [(f"{name}.folder", str(tmp_path)) for name in ("flown", "other")]
    with pytest.raises(TerrafixError, match="'flown' cannot read its phase history"):
        tf.read_system(tmp_path / SYSTEM.name, settings)
