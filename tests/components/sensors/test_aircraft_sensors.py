"""Altimeters, apertures and their fixes without images; what is known of a flight at its start."""

import numpy as np
import pytest

import terrafix as tf
from terrafix.components.filters.known_state import LastKnownFlight
from terrafix.components.sensors.altimeter import Altimeter, RadarAltimeter
from terrafix.components.truth.flight import Flight
from terrafix.components.truth.terrain import Terrain
from terrafix.cosim.basics.errors import TerrafixError
from terrafix.models.geometry.geodesy import ecef_from_geodetic_array
from terrafix.models.geometry.quaternion import (
    inverse_array,
    product_array,
    rotation_vector_array,
)
from terrafix.models.sensors.aperture import LOOKS, synthetic_shift_model

MANY = 4000
FAR = 5.0  # sigmas of an estimate that are never met by chance


def flown(*parts, duration="1", members=1, earth="wgs84", **flight):
    """A flight, and components that read its ports by the same names."""
    with tf.System("s", duration=duration, seed=3) as system:
        truth = system.add(Flight(earth=earth, **flight), "flight")
        for k, part in enumerate(parts):
            system.add(part, f"part{k}")
            for name in ("r_e", "v_e", "q_be"):
                if name in part.inputs():
                    system.connect(truth[name], part[name])
        system.record("truth", [truth[name] for name in ("r_e", "v_e", "q_be")])
        outputs = [part[n] for part in parts for n, p in part.outputs().items()]
        system.record("parts", outputs)
    return tf.simulate(system, members=members).dataset


@pytest.mark.parametrize("earth", ["wgs84", "flat"])
def test_an_altimeter_measures_height_with_a_bias_and_noise(earth):
    """1234 m; sigma 1 m beside a bias of 0.8 m, which keeps exp(-10 / 100) of itself in 10 s."""
    data = flown(Altimeter(earth=earth), members=MANY, duration="11", earth=earth, height=1234.0)
    bias = data["part0.bias"].values[..., 0]
    y = data["part0.fix.y"].values[..., 0]
    off = (y - bias)[np.isfinite(y).all(axis=1)][-1] - 1234.0
    bound = FAR / np.sqrt(MANY)
    assert abs(off.mean()) < bound
    assert off.std() == pytest.approx(1.0, abs=bound)
    assert bias[-1].std() == pytest.approx(0.8, abs=0.8 * bound)
    kept = (bias[-1] * bias[-11]).mean() / 0.64
    assert kept == pytest.approx(np.exp(-0.1), abs=1.5 * bound)


@pytest.mark.parametrize("earth", ["wgs84", "flat"])
def test_a_start_is_off_as_it_says_in_level_axes(earth):
    """Errors over their own covariance: mean square 9, and a heading known four times worse."""
    data = flown(LastKnownFlight(earth=earth), members=MANY, earth=earth, latitude=0.7)
    r, v, q = (data[f"flight.{n}"].values[0] for n in ("r_e", "v_e", "q_be"))
    told = {n: data[f"part0.state.{n}"].values[0] for n in ("r_e", "v_e", "q_be", "P")}
    turn = rotation_vector_array(product_array(inverse_array(q), told["q_be"]))
    error = np.concatenate([told["r_e"] - r, told["v_e"] - v, turn], axis=1)
    P = told["P"]
    square = np.einsum("ki,kij,kj->k", error, np.linalg.inv(P), error)
    assert square.mean() == pytest.approx(9.0, abs=FAR * np.sqrt(18 / MANY))
    sigmas = np.sqrt(np.linalg.eigvalsh(P[0, :3, :3]))
    assert sigmas == pytest.approx([1.0, 3.0, 3.0], rel=1e-9)
    assert np.sqrt(np.linalg.eigvalsh(P[0, 6:, 6:])) == pytest.approx([5e-4, 5e-4, 2e-3], rel=1e-9)
    down = np.array([0, 0, 1.0]) if earth == "flat" else -np.array([np.cos(0.7), 0, np.sin(0.7)])
    assert down @ P[0, 6:, 6:] @ down == pytest.approx(4e-6, rel=1e-2)


def sent(looks, *, earth="flat", apertures=3, every=2, off=(0.0, 0.0, 0.0), rows="shift", **told):
    """Fixes of a model that flies north at 70 m/s, its estimate of the center off by `off`.

    A step of half a second is a center once in `every`.
    """
    model = synthetic_shift_model(earth, looks, rows)
    step = model.step_function()
    names = [*model.inputs, *model.states, *model.parameters, *model.noise]
    values = {n: np.zeros(model.shape(n)) for n in names}
    values |= {"ground_range": 1200.0, "largest_bank": 1.5, "q_be": np.array([0, 0, 0, 1.0])}
    values |= {n: 1.0 for n in names if n.endswith("_time")} | told
    values["prior.v_e_at_aperture"] = values["v_e"] = np.array([70.0, 0.0, 0.0])
    found = []
    for k in range(1, every * apertures + 1):
        t = k / 2
        values["r_e"] = np.array([70.0 * t, 0.0, -1000.0])
        values["center.fresh"] = float(k % every == 1)
        if k % every == 1:
            values["prior.r_e_at_aperture"] = values["r_e"] + off
        results = [r.full() for r in step(*(values[n] for n in names), 0.5, t)]
        out = dict(zip(model.outputs, results, strict=False))
        values |= dict(zip(model.states, results[len(model.outputs) :], strict=True))
        if out["fix.valid"] > 0.5:
            found.append({n.removeprefix("fix."): v.ravel() for n, v in out.items()})
    return found


@pytest.mark.parametrize("looks", LOOKS)
def test_points_lie_abeam_on_the_side_that_is_looked_to(looks):
    """1200 m east or west of the center, on the ground: slant range sqrt(1200^2 + 1000^2)."""
    fixes = sent(looks)
    sides = {"right": [1, 1, 1], "left": [-1, -1, -1], "in-turn": [1, -1, 1]}[looks]
    for k, (fix, side) in enumerate(zip(fixes, sides, strict=True)):
        assert fix["p_t_e"] == pytest.approx([70 * (k + 0.5), 1200 * side, 0.0])
        assert fix["y"] == pytest.approx([np.hypot(1200, 1000), 0.0, 0.0], abs=1e-9)
        assert fix["t_center"] == pytest.approx(k + 0.5)
        assert fix["present"].tolist() == [1, 1, 0]


def test_an_aperture_is_measured_once():
    """Also where the radar steps more often than at centers and ends."""
    assert [fix["t_center"][0] for fix in sent("right", every=4)] == [0.5, 2.5, 4.5]


def test_a_navigator_that_is_off_sees_it_in_the_fix():
    """1 m too far north: the center lies 1 m behind what is abeam of it; 1 m down, range +0.64."""
    (north,) = sent("right", apertures=1, off=(1.0, 0.0, 0.0))
    assert north["y"][1] == pytest.approx(-1.0, abs=1e-9)
    (east,) = sent("right", apertures=1, off=(0.0, 1.0, 0.0))
    assert east["y"][0] == pytest.approx(np.hypot(1201, 1000), abs=1e-9)


def test_noise_is_what_the_fix_reports():
    """A draw of one moves each element by the sigma whose square stands in R."""
    quiet = sent("left", apertures=1, rows="shift-and-drift")[0]
    sigmas = {"range_sigma": 0.5, "cross_range_sigma": 0.4, "map_drift_sigma": 0.04}
    drawn = dict.fromkeys(("range_noise", "cross_range_noise", "map_drift_noise"), 1.0)
    loud = sent("left", apertures=1, rows="shift-and-drift", **sigmas, **drawn)[0]
    assert loud["y"] - quiet["y"] == pytest.approx([0.5, 0.4, 0.04])
    assert loud["R"].reshape(3, 3) == pytest.approx(np.diag([0.25, 0.16, 0.0016]))
    assert loud["present"].tolist() == [1, 1, 1]


def test_a_banked_beam_and_one_that_is_off_send_nothing():
    bank = np.array([np.sin(0.1), 0, 0, np.cos(0.1)])  # 0.2 rad
    assert len(sent("right", q_be=bank, largest_bank=0.21)) == 3
    assert not sent("right", q_be=bank, largest_bank=0.19)
    with pytest.raises(ValueError, match="looks must be one of"):
        synthetic_shift_model("flat", "up")


def over(altitude, *, latitude=36.3, members=2, flat=None):
    """A radar altimeter over Jacksboro, at an altitude [m]."""
    with tf.System("s", duration="2", seed=3) as system:
        start = {"latitude": np.radians(latitude), "longitude": np.radians(-84.25)}
        truth = system.add(Flight(height=altitude, **start), "flight")
        source = (
            {"source": "jacksboro"} if flat is None else {"source": "flat", "flat_height": flat}
        )
        ground = system.add(Terrain(**source), "terrain")
        sensor = system.add(RadarAltimeter(), "radar_altimeter")
        system.connect(truth["r_e"], sensor["r_e"])
        for name in ("height", "grid"):
            system.connect(ground[name], sensor[name])
        system.record("fix", [sensor["fix"]])
    return tf.simulate(system, members=members).dataset


def test_a_radar_altimeter_measures_the_clearance():
    y = over(1500.0, flat=200.0, members=MANY)["radar_altimeter.fix.y"].values[-1, :, 0]
    assert y.mean() == pytest.approx(1300.0, abs=FAR * 5 / np.sqrt(MANY))
    assert y.std() == pytest.approx(5.0, rel=FAR / np.sqrt(2 * MANY))


@pytest.mark.parametrize(
    ("altitude", "latitude", "said"),
    [
        (250.0, 36.3, r"at 36.3000, -84.2500 deg .* and 250 m, below the ground of \d+ m"),
        (1500.0, 36.5, "where no ground is known: it is latitude 36.160 to 36.446"),
    ],
)
def test_a_flight_below_the_ground_or_off_the_map_is_refused(altitude, latitude, said):
    with pytest.raises(TerrafixError, match=said):
        over(altitude, latitude=latitude)


def test_positions_are_those_of_the_ellipsoid():
    """The flight's own: what the altimeters above stand on."""
    data = flown(LastKnownFlight(), latitude=0.6, height=500.0)
    expected = ecef_from_geodetic_array(0.6, 0.0, 500.0)
    assert data["flight.r_e"].values[0, 0] == pytest.approx(expected, abs=1e-6)
