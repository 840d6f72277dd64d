"""The satellite as it flies: all its parts together, end to end, beside brahe."""

from pathlib import Path

import brahe
import brahe_reference
import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.exchange.fmi.run.component import CO_SIMULATION, Fmu
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.models.core.timescales import DAY, parse_epoch
from terrafix.models.geometry.orientation import earth_orientation
from terrafix.models.motion import bodies
from terrafix.models.motion.air import air_about
from terrafix.models.motion.gravity_field import SHIPPED

EXAMPLE = Path(__file__).parents[2] / "examples" / "satellite.toml"
SUN, MOON = brahe.ThirdBody.SUN, brahe.ThirdBody.MOON


def in_vacuum():
    """The example without drag: the two take different atmospheres."""
    return read_system(EXAMPLE, [("satellite.ballistic_coefficient", "0 m^2/kg")])


def flown(system, **given):
    found = simulate(system, members=1, **given).dataset
    return {n: found[f"satellite.{n}"].values[-1, 0] for n in ("r_i", "v_i", "r_e", "v_e")}


def by_brahe(system):
    """The state (6,) in GCRF at the end of it, and the Earth-fixed place (3,), by brahe."""
    start = system.nodes["start"]
    read_tables("2022-09-18T07:54:21 UTC")  # the middle: brahe holds them
    (end,) = brahe_reference.propagated(
        start.setting("r0"),
        start.setting("v0"),
        [600.0],
        degree=20,
        field=SHIPPED,
        bodies=[brahe.ThirdBody.SUN, brahe.ThirdBody.MOON],
        tide=True,
        srp=True,
    )
    read_tables("2022-09-18T07:59:21 UTC")
    return end, brahe.position_gcrf_to_itrf(brahe_reference.epoch() + 600.0, end[:3])


def read_tables(epoch):
    """Give brahe what the table of the IERS has for an epoch."""
    known = earth_orientation(parse_epoch(epoch))
    values = {
        "ut1_utc": known.ut1_tai + 37.0,  # leap seconds of 2022
        "pm_x": known.xp,
        "pm_y": known.yp,
        "dx": known.dx,
        "dy": known.dy,
        "lod": -DAY * known.ut1_rate,
    }
    brahe_reference.use_tables({name: float(value) for name, value in values.items()})


@pytest.fixture
def their_bodies(monkeypatch):
    """Sun and Moon of brahe, in place of ours."""
    offset = parse_epoch("2022-09-18T07:49:21 UTC")

    def of(position):
        def moving(instant):
            t, h = brahe_reference.epoch() + instant.minus(offset), 30.0
            return position(t), (position(t + h) - position(t - h)) / (2 * h)

        return moving

    monkeypatch.setattr(bodies, "sun_position", of(brahe.sun_position))
    monkeypatch.setattr(bodies, "moon_position", of(brahe.moon_position))


def test_the_parts_together_fly_as_brahe_does(their_bodies):
    """From a file: epoch, start in GCRF, environment, 20 x 20, Sun, Moon, tide, sunlight; 10 min.

    2.4e-5 m (brahe 1.8.0). Without the Sun it would be 6 cm, the Moon 11 cm, the tide 3 cm,
    sunlight, into which it comes on the way, 9 mm, the field beyond degree 8 1.4 m.
    """
    end, (state, place) = flown(in_vacuum()), by_brahe(in_vacuum())
    assert np.linalg.norm(end["r_i"] - state[:3]) < 1e-4
    assert np.linalg.norm(end["v_i"] - state[3:]) < 1e-6
    assert np.linalg.norm(end["r_e"] - place) < 3e-4


def test_its_own_sun_and_moon_are_as_good():
    """Those of ERFA, 270 and 160 arc seconds from brahe's: 1.2e-4 m."""
    end, (state, _) = flown(in_vacuum()), by_brahe(in_vacuum())
    assert np.linalg.norm(end["r_i"] - state[:3]) < 1e-3


def test_the_air_holds_it_back():
    """5 mm: a constant push along the track, in the equations of Hill."""
    flight, vacuum = read_system(EXAMPLE), flown(in_vacuum())
    apart = np.linalg.norm(flown(flight)["r_i"] - vacuum["r_i"])
    middle = simulate(in_vacuum(), members=1, duration="300").dataset["satellite.r_e"][-1, 0]
    utc = np.datetime64("2022-09-18T07:54:21", "ns")
    density = np.exp(air_about(middle.to_numpy(), utc, 140.0, 130.0, 12.0)[0][0])
    speed, n, t = 7509.0 - 0.07 * 7.07e6 * 7.292e-5, 7509.0 / 7.07e6, 600.0
    push = 0.5 * density * flight.nodes["satellite"].setting("ballistic_coefficient") * speed**2
    radial = 2 * push / n**2 * (n * t - np.sin(n * t))
    along = push * (4 / n**2 * (1 - np.cos(n * t)) - 1.5 * t**2)
    assert apart == pytest.approx(np.hypot(radial, along), rel=0.1)


def test_as_an_fmu_it_flies_the_same_bits(tmp_path):
    """In place of the component, with its start, environment and air connected as before.

    FMI 2 and 20 x 20 over ten minutes: `benchmarks/real_orbit.py`.
    """
    file, settings = tmp_path / "satellite.fmu", [("satellite.degree", "4")]
    export_fmu(read_system(EXAMPLE, settings), file, component="satellite", fmi=3)
    native, foreign = (read_system(EXAMPLE, settings) for _ in range(2))
    foreign.replace("satellite", Fmu(file=file, kind=CO_SIMULATION, rate=Rate("1")))
    ends = [flown(system, duration="25") for system in (native, foreign)]
    for name, value in ends[0].items():
        assert ends[1][name].tobytes() == value.tobytes(), name
