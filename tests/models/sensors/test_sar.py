"""The SAR measurement: printed closed forms, finite differences, order of products, geometry."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafix.models.geometry.antenna import nominal_antenna
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef, geodetic_from_ecef_array
from terrafix.models.geometry.quaternion import (
    angle_between_array,
    from_rotation_vector_array,
    inverse_array,
    product_array,
    rotation_matrix_array,
    rotation_vector_array,
)
from terrafix.models.sensors.sar import (
    antenna_mount_model,
    sar_measurement_model,
    synthetic_fix_model,
)

MODEL = sar_measurement_model()
LOOK = np.radians(34.3)


def q_sb(look, squint):
    return ca.DM(nominal_antenna(look, squint)).full().ravel()


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


unit = st.floats(-1, 1)
vectors = st.tuples(unit, unit, unit).map(np.array)


@st.composite
def states(draw):
    """Random states, attitudes and misalignments (large ones too); pixel before the antenna."""
    r_e = 7.07e6 * (draw(vectors) + np.array([0, 0, 2])) / 2
    q_be, q_mu = (from_rotation_vector_array(3 * draw(vectors)) for _ in range(2))
    mount = q_sb(draw(st.floats(0.2, 0.9)), draw(st.floats(-0.2, 0.2)))
    slant = draw(st.floats(5e5, 1.2e6))
    line_s = slant * np.array([draw(unit) / 2, draw(unit) / 2, 1.0])
    T = rotation_matrix_array(product_array(q_mu, product_array(mount, q_be)))
    return {
        "r_e": r_e,
        "v_e": 7.5e3 * (draw(vectors) + np.array([2, 0, 0])) / 2,
        "q_mu": q_mu,
        "dmu": np.zeros(3),
        "q_be": q_be,
        "q_sb": mount,
        "r_f_e": r_e + T.T @ line_s,
    }


def printed(r_e, v_e, q_mu, dmu, q_be, q_sb, r_f_e):
    """Prediction and Jacobians typed from eqs. (18)-(34), an independent path."""
    del dmu
    T = rotation_matrix_array(q_mu) @ rotation_matrix_array(q_sb) @ rotation_matrix_array(q_be)
    line = r_f_e - r_e
    x, y, z = line_s = T @ line
    by_line_s = np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
    by_r = np.vstack([by_line_s @ -T, -line / np.linalg.norm(line), np.zeros(3)])
    by_v = np.vstack([np.zeros((3, 3)), v_e / np.linalg.norm(v_e)])
    by_mu = np.vstack([by_line_s @ cross_matrix(line_s), np.zeros((2, 3))])
    prediction = np.array([x / z, y / z, np.linalg.norm(line), np.linalg.norm(v_e)])
    return prediction, {"r_e": by_r, "v_e": by_v, "dmu": by_mu, "r_f_e": -by_r}


@given(states())
def test_derived_jacobians_are_the_printed_closed_forms(values):
    """1e-12 of the largest element of a row: the papers' eqs. (24)-(34)."""
    prediction, jacobians = printed(**values)
    # the line of 1e6 m between numbers of 7e6 m carries 1e-9 m, 1e-15 of itself
    np.testing.assert_allclose(MODEL(**values)["y"], prediction, rtol=1e-12, atol=1e-14)
    for wrt, closed in jacobians.items():
        derived = MODEL.jacobian("y", wrt, **values)
        scale = np.abs(closed).max(axis=1, keepdims=True)
        assert np.all(np.abs(derived - closed) <= 1e-12 * scale)


@settings(max_examples=50)
@given(values=states())
def test_jacobians_agree_with_central_differences(check_jacobian, values):
    """Steps at which the second order (step / slant)^2 and rounding are below 1e-7."""
    check_jacobian(MODEL, "y", "r_e", 10.0, **values)
    check_jacobian(MODEL, "y", "r_f_e", 10.0, **values)
    check_jacobian(MODEL, "y", "v_e", 1.0, **values)
    check_jacobian(MODEL, "y", "dmu", 1e-4, **values)


def test_the_effective_velocity_depends_on_position_and_its_derivative_says_so(
    check_jacobian, start_e
):
    """1 km moves the speed it implies by 0.14, 0.37 and -0.20 m/s; the speed itself by nothing."""
    r_e, v_e, q_be = start_e
    model = sar_measurement_model("effective")
    values = {
        "r_e": r_e,
        "v_e": v_e,
        "q_mu": np.array([0.0, 0.0, 0.0, 1.0]),
        "dmu": np.zeros(3),
        "q_be": q_be,
        "q_sb": q_sb(LOOK, 0.0),
        "r_f_e": ecef(np.radians(29.76), np.radians(-95.37), 0.0),
    }
    for wrt, step in (("r_e", 100.0), ("v_e", 1.0), ("r_f_e", 100.0)):
        check_jacobian(model, "y", wrt, step, **values)
    y = model(**values)["y"]
    assert y[3] == pytest.approx(7188.5, abs=0.6)
    by_speed = model.jacobian("y", "v_e", **values)[3] @ v_e / np.linalg.norm(v_e)
    by_position = model.jacobian("y", "r_e", **values)[3]
    assert 1e3 * by_position / by_speed == pytest.approx([0.14, 0.37, -0.20], abs=0.02)
    others = MODEL(**values)["y"]
    assert y[:3] == pytest.approx(others[:3])


@given(states(), vectors)
def test_misalignment_error_multiplies_from_the_left(values, direction):
    """At a large misalignment, where the wrong order is far off."""
    dmu = 0.2 * direction
    with_error = MODEL(**values | {"dmu": dmu})["y"]
    error = from_rotation_vector_array(dmu)
    moved = product_array(error, values["q_mu"])
    np.testing.assert_allclose(
        MODEL(**values | {"q_mu": moved})["y"], with_error, rtol=1e-11, atol=1e-12
    )


def test_the_wrong_order_of_the_product_would_show(start_e):
    r_e, v_e, q_be = start_e
    q_mu, dmu = from_rotation_vector_array([0.3, 0.8, -1.0]), np.array([0.02, -0.01, 0.03])
    T = rotation_matrix_array(product_array(q_mu, product_array(q_sb(LOOK, 0), q_be)))
    values = {
        "r_e": r_e,
        "v_e": v_e,
        "q_be": q_be,
        "q_sb": q_sb(LOOK, 0),
        "r_f_e": r_e + T.T @ [1e4, 2e4, 8.6e5],
    }
    right = MODEL(**values, q_mu=q_mu, dmu=dmu)["y"]
    wrong = MODEL(**values, q_mu=product_array(q_mu, from_rotation_vector_array(dmu)))["y"]
    assert np.abs(wrong - right)[:2].max() > 1e-3


@pytest.mark.parametrize("look", [LOOK, 0.6, -0.5])
@pytest.mark.parametrize("squint", [0.0, 0.1, -0.3])
def test_nominal_antenna_axes(look, squint):
    """Boresight in body axes as the angles say; x forward and orthogonal to it; y = z cross x."""
    T = rotation_matrix_array(q_sb(look, squint))
    x, y, z = T
    cos = np.cos(squint)
    expected = [np.sin(squint), np.sin(look) * cos, np.cos(look) * cos]
    np.testing.assert_allclose(z, expected, atol=1e-15)
    forward = np.array([1.0, 0, 0]) - z[0] * z
    np.testing.assert_allclose(x, forward / np.linalg.norm(forward), atol=1e-15)
    np.testing.assert_allclose(y, np.cross(z, x), atol=1e-15)


def fix(start_e, boresight="true", **values):
    r_e, v_e, q_be = start_e
    defaults = {
        "r_e": r_e,
        "v_e": v_e,
        "q_be": q_be,
        "q_mu": [0, 0, 0, 1],
        "look": LOOK,
        "radius": EARTH.radius,
        "flattening": EARTH.flattening,
    }
    return synthetic_fix_model(boresight)(**defaults | values)


def test_pixel_lies_on_the_true_boresight_and_the_ellipsoid(start_e):
    r_e, v_e, q_be = start_e
    q_mu = from_rotation_vector_array(np.radians([0.1, -0.2, 0.3]))
    made = fix(start_e, q_mu=q_mu)
    assert made["fix.valid"] == 1
    assert abs(geodetic_from_ecef_array(made["fix.r_f_e"])[2]) < 1e-8
    predicted = MODEL(
        r_e=r_e, v_e=v_e, q_mu=q_mu, q_be=q_be, q_sb=q_sb(LOOK, 0), r_f_e=made["fix.r_f_e"]
    )["y"]
    # at the true state the prediction is the measurement: tangents 0 to the rounding of 7e6 m
    np.testing.assert_allclose(predicted, made["fix.y"], rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(made["fix.y"][:2], [0, 0])
    aside = fix(start_e, "nominal", q_mu=q_mu)["fix.r_f_e"] - made["fix.r_f_e"]
    assert np.linalg.norm(aside) > 1000  # 0.1 deg is 1.5 km


def test_noise_goes_where_it_belongs(start_e):
    """Range and speed noise into y; the pixel's error into its reported position alone."""
    clean = fix(start_e)
    noisy = fix(
        start_e,
        range_sigma=2.0,
        speed_sigma=0.5,
        error_scale=1.0,
        geolocation_sigma=[8, 5, 2],
        geolocation_bias=[1, 2, 3],
        range_noise=1.5,
        speed_noise=-2.0,
        geolocation_noise=[1, -1, 2],
    )
    np.testing.assert_allclose(noisy["fix.y"] - clean["fix.y"], [0, 0, 3.0, -1.0], atol=1e-9)
    np.testing.assert_allclose(noisy["fix.r_f_e"] - clean["fix.r_f_e"], [9, -3, 7], atol=2e-9)
    np.testing.assert_array_equal(noisy["fix.R"], np.diag([0, 0, 4, 0.25]))
    np.testing.assert_array_equal(noisy["fix.D"], np.diag([64, 25, 4]))
    np.testing.assert_array_equal(noisy["fix.present"], np.ones(4))


def test_boresight_into_space_is_no_fix(start_e):
    made = fix(start_e, look=np.radians(80))
    assert made["fix.valid"] == 0
    assert all(np.isfinite(v).all() for v in made.values())


def test_mount_draws_and_walks_from_the_left():
    model = antenna_mount_model()
    noise = np.array([1.0, -2.0, 0.5])
    start = model.initial_function()(misalignment_noise=noise, misalignment_sigma0=1e-3)
    np.testing.assert_allclose(
        rotation_vector_array(start["q_mu_"].full().ravel()), 1e-3 * noise, atol=1e-18
    )
    q = from_rotation_vector_array([1.0, 1.0, -2.0])
    outputs, _ = model.advance(q_mu=q, misalignment_noise=noise, misalignment_walk=1e-4, step=4.0)
    step = rotation_vector_array(product_array(outputs["q_mu"], inverse_array(q)))
    # third order of 5e-4 rad is 1e-11; quaternions round at 1e-16
    np.testing.assert_allclose(step, 2e-4 * noise, atol=2e-11)
    still, _ = model.advance(q_mu=q, misalignment_noise=noise, step=4.0)
    assert angle_between_array(still["q_mu"], q) < 1e-15


def test_unknown_boresight_is_refused():
    with pytest.raises(ValueError, match=r"boresight must be one of .*got 'left'"):
        synthetic_fix_model("left")


def test_an_unknown_element_is_refused():
    with pytest.raises(ValueError, match=r"in_track must be one of .*got 'ground'"):
        sar_measurement_model("ground")


def test_the_scale_of_errors_is_that_of_every_random_error():
    """Twice the scale, twice the error of range, speed and place; not of what the fix states."""
    start = {
        "r_e": [-1104646.34, -6096830.39, 3395727.38],
        "v_e": [-1004.69, 3810.14, 6497.94],
        "q_be": [-0.59547836, -0.62105225, -0.42482638, 0.28146433],
        "q_mu": [0.0, 0.0, 0.0, 1.0],
        "look": np.radians(34.3),
        "radius": 6378137.0,
        "flattening": 1 / 298.257223563,
        "range_sigma": 3.0,
        "speed_sigma": 0.5,
        "geolocation_sigma": [8.0, 5.0, 2.0],
        "geolocation_bias": [10.0, 20.0, 30.0],
        "range_noise": 0.7,
        "speed_noise": -1.2,
        "geolocation_noise": [1.0, -2.0, 0.5],
    }
    model = synthetic_fix_model()
    none, one, two = (model(**start, error_scale=s) for s in (0.0, 1.0, 2.0))
    for scale, fix in ((1.0, one), (2.0, two)):
        moved = fix["fix.r_f_e"] - none["fix.r_f_e"]
        np.testing.assert_allclose(moved, scale * np.array([8.0, -10.0, 1.0]), atol=1e-8)
        error = fix["fix.y"] - none["fix.y"]
        np.testing.assert_allclose(error, [0, 0, scale * 2.1, scale * -0.6], atol=1e-8)
        np.testing.assert_array_equal(fix["fix.R"], none["fix.R"])
        np.testing.assert_array_equal(fix["fix.D"], none["fix.D"])
    np.testing.assert_allclose(np.diag(one["fix.R"]), [0, 0, 9.0, 0.25])
    np.testing.assert_allclose(np.diag(one["fix.D"]), [64.0, 25.0, 4.0])
    unbiased = model(**start | {"geolocation_bias": [0.0] * 3}, error_scale=1.0)
    np.testing.assert_allclose(one["fix.r_f_e"] - unbiased["fix.r_f_e"], [10, 20, 30], atol=1e-8)
