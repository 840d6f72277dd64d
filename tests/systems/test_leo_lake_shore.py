"""A satellite that never sees all of its lake."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf

ROOT = Path(__file__).parents[2]
SHORE = ROOT / "examples" / "leo_lake_shore.toml"
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
PARTS = ("orbit", "camera", "matcher", "predict", "correct", "evaluation")
TEN_HZ = [(f"{n}.period", "0.1 s") for n in PARTS]


def read(outline, *settings, case="T3"):
    told = [("lakes.file", str(outline)), ("case", case), *TEN_HZ, *settings]
    return tf.read_system(SHORE, told)


@pytest.mark.campaign
def test_part_of_a_lake_is_found_from_seventy_kilometers_and_the_filter_is_consistent(outline):
    """All of 15 members at once; NEES of three and NIS of six in their 99.9 % intervals."""
    system = read(outline)
    system.record("looks", [system.find("camera")["look"], system.find("matcher")["reason"]])
    data = tf.simulate(system, members=15).dataset
    assert np.nanmax(data["camera.look.whole"].values) == 0.0
    assert (data["matcher.reason"].values[1] == 0).all()
    nees = data["evaluation.nees"].values
    low, high = chi2.ppf([0.0005, 0.9995], 3 * 15) / 15
    for epoch in (1, 10, 40, 65):
        assert low < nees[epoch].mean() < high, (epoch, nees[epoch].mean())
    nis = data["evaluation.nis"].values
    nis = nis[np.isfinite(nis)]
    low, high = chi2.ppf([0.0005, 0.9995], 6 * nis.size) / nis.size
    assert low < nis.mean() < high
    error = np.linalg.norm(data["evaluation.position_error"].values[65], axis=1)
    assert np.median(error) < 200.0
    assert error.max() < 1000.0


def test_what_lies_outside_of_the_frame_is_not_used(outline, monkeypatch):
    """Whatever a contour says of places that the frame does not show: the same bytes."""
    from terrafix.components.sensors.camera import LakeCamera

    def flown():
        return tf.simulate(read(outline), members=3, duration="0.5").dataset

    plain, seen = flown(), LakeCamera._outline

    def spoiled(self, lake, rows, t):
        pixels, inside = seen(self, lake, rows, t)
        outside = ((pixels < -2.0) | (pixels > self.size[rows, None] + 2.0)).any(axis=2)
        assert outside.any()
        pixels[outside] -= 5000.0 * np.sign(128.0 - pixels[outside])
        return pixels, inside

    monkeypatch.setattr(LakeCamera, "_outline", spoiled)
    name = "evaluation.position_error"
    np.testing.assert_array_equal(plain[name].values, flown()[name].values)
