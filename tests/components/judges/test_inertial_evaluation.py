"""Errors of a navigator are told in north, east and down of the true place."""

import casadi as ca
import numpy as np
import pytest

from terrafix.components.judges.evaluation import RadarInertialEvaluation
from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.models.core.batch import over_members
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.geometry.geodesy import ecef_from_geodetic_array, north_east_down


def test_quantities_are_level_and_biases_have_no_axes_of_the_earth():
    told = {q.name: q.axes for q in RadarInertialEvaluation.quantities}
    assert told["position"] == told["attitude"] == ("north", "east", "down")
    assert told["accel_bias"] == ("x", "y", "z")
    assert told["range_bias"] == ("",)
    assert RadarInertialEvaluation().outputs()["velocity_error"].fields[""].frame == "n"


@pytest.mark.parametrize("earth", ["wgs84", "flat"])
def test_the_error_model_turns_what_lies_in_e(earth):
    """An estimate that is 3 m too far along an axis of e; a tilt likewise."""
    judge = RadarInertialEvaluation(earth=earth)
    model = judge.error_model()
    r = ecef_from_geodetic_array(0.8, 0.3, 1000.0)
    truth = {n: np.zeros(model.shape(n)) for n in model.inputs if "." not in n}
    truth |= {"r_e": r, "q_be": np.array([0, 0, 0, 1.0])}
    off = np.array([3.0, 0.0, 0.0])
    half = np.array([0.0, 1e-3, 0.0]) / 2
    estimate = {f"estimate.{n}": v for n, v in truth.items()}
    estimate |= {"estimate.r_e": r + off, "estimate.q_be": np.append(half, 1.0)}
    values = {**truth, **estimate}
    error = model.step_function()(*(values[n] for n in model.inputs))
    error = np.array(ca.DM(error[0] if isinstance(error, tuple) else error)).ravel()
    axes = over_members(lambda r_e: north_east_down(r_e)[0], (3,))(r)
    axes = np.eye(3) if earth == "flat" else axes
    assert error[:3] == pytest.approx(axes @ off, abs=1e-9)
    assert error[6:9] == pytest.approx(axes @ (2 * half), abs=1e-8)


def test_errors_in_other_axes_need_a_rotation_and_blocks_that_are_there():
    """Said where the class is declared, not in the middle of a run."""
    level = ("n", "north", "east", "down")
    with pytest.raises(ValueError, match=r"errors of r in other axes: it needs .* `rotation`"):

        class Unturned(FilterEvaluation):
            error_state, turned = ErrorState(vector("r")), {"r": level}

    with pytest.raises(ValueError, match=r"turned names 'v', which is no block .* are r"):

        class Misnamed(FilterEvaluation):
            error_state, turned = ErrorState(vector("r")), {"v": level}
