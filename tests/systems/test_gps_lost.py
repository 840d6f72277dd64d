"""An aircraft that loses GPS: it drifts as its filter says, and is found again."""

from pathlib import Path

import numpy as np

from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system

EXAMPLE = Path(__file__).parents[2] / "examples" / "gps_lost.toml"
MEMBERS, FAR = 24, 5.0


def flown(*settings, duration):
    dataset = simulate(read_system(EXAMPLE, settings), members=MEMBERS, duration=duration).dataset
    found = {n: dataset[f"evaluation.{n}"] for n in ("position_error", "nees", "gnss_accepted")}
    t = found["nees"][found["nees"].dims[0]].to_numpy()
    return t, {n: values.to_numpy() for n, values in found.items()}


def test_it_drifts_in_an_outage_as_its_filter_says():
    """NEES of 19 elements, and of 24 members at each of three times, inside five sigmas."""
    outage = ("gnss.outages", [{"start": "20 s", "stop": "105 s"}])
    t, found = flown(outage, duration="115")
    for when in (19.0, 104.0, 114.0):
        nees = found["nees"][t == when].mean()
        assert abs(nees - 19.0) < FAR * np.sqrt(2 * 19 / MEMBERS)
    level = np.linalg.norm(found["position_error"][..., :2], axis=-1)
    before, lost, after = (np.sqrt((level[t == k] ** 2).mean()) for k in (19.0, 104.0, 114.0))
    assert lost > 3 * max(before, after)
    fresh = np.isfinite(found["gnss_accepted"]).all(axis=1)
    np.testing.assert_array_equal(t[~fresh & (t > 0)], np.arange(20.0, 105.0))


def test_a_spoofer_that_begins_with_a_step_is_seen():
    """0.5 m/s from 20 s on: ten sigmas of a velocity, beyond any gate of one in ten thousand."""
    t, found = flown(("loss", "spoofed"), ("gnss.spoof_from", "20 s"), duration="40")
    taken = found["gnss_accepted"]
    assert (taken[(t > 0) & (t <= 20)] == 1.0).mean() > 0.99
    assert (taken[t > 21] == 0.0).mean() > 0.99
