"""The satellite as a component: its choices, its errors, its maneuvers, its FMU."""

import numpy as np
import pytest

from terrafix.components.fields import ENVIRONMENT, START
from terrafix.components.truth.satellite_orbit import SatelliteOrbit
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import BundleOutput, MessageOutput
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run.component import CO_SIMULATION, MODEL_EXCHANGE, Fmu
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.gravity import j2_acceleration
from terrafix.models.motion.gravity_field import SHIPPED, shipped_field

R_E = np.array([-1104646.3, -6096830.4, 3395727.4])  # [m], an orbit of 700 km
V_E = np.array([-1004.7, 3648.9, 6498.0])  # [m/s]
BEGIN = {"start_from": "parameters", "r0_e": R_E, "v0_e": V_E}


class Sky(Component):
    """Surroundings that turn uniformly, with a Sun and a Moon that stand."""

    default_rate = Rate("10")
    around = BundleOutput(ENVIRONMENT, doc="surroundings")

    def _initialize_impl(self):
        self._publish(0.0)

    def _step_impl(self, t, dt):
        self._publish(t)

    def _publish(self, t):
        angle = EARTH.rotation_rate * t
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        self.around.time[:] = t
        self.around.omega_e[:] = [0, 0, EARTH.rotation_rate]
        self.around.q_ei[:] = [0, 0, np.sin(angle / 2), np.cos(angle / 2)]
        self.around.sun_e[:] = turn @ [1.2e11, 8e10, 3e10]
        self.around.moon_e[:] = turn @ [-3e8, 2e8, 1e8]
        self.around.sun_rate_e[:] = self.around.moon_rate_e[:] = 0.0


class Pad(Component):
    """Says where to start."""

    default_rate = Rate(times=["0"])
    state = MessageOutput(fields=START, doc="start")

    def _initialize_impl(self):
        self.state.publish(0.0, r_e=R_E, v_e=V_E)


def alone(rate="10 Hz", **settings):
    system = System("alone", duration="60 s")
    system.add(SatelliteOrbit(rate=Rate(hz=10), **{**BEGIN, **settings}), "orbit")
    system.record("all", ["orbit.r_e", "orbit.v_e", "orbit.r_i", "orbit.v_i", "orbit.delta_v_e"])
    return system


def last(system, name, **given):
    return simulate(system, members=1, **given).dataset[f"orbit.{name}"].values[-1, 0]


def test_a_sky_that_turns_uniformly_is_the_parameter_that_says_so():
    """Connected or not: the same Earth, the same orbit, to rounding."""
    expected = alone(degree=4)
    system = alone(degree=4, surrounded=True)
    sky = system.add(Sky(), "sky")
    system.connect(sky["around"], system.nodes["orbit"]["surroundings"])
    for name, atol in (("r_e", 2e-8), ("r_i", 2e-8), ("v_i", 2e-11)):
        np.testing.assert_allclose(
            last(system, name), last(expected, name), rtol=0, atol=atol, err_msg=name
        )


def test_it_starts_where_it_is_told():
    expected = alone(degree=4)
    system = System("told", duration="60 s")
    orbit = system.add(SatelliteOrbit(rate=Rate(hz=10), degree=4), "orbit")
    pad = system.add(Pad(), "pad")
    system.connect(pad["state"], orbit["start"])
    system.record("all", ["orbit.r_e"])
    assert last(system, "r_e").tolist() == last(expected, "r_e").tolist()


def test_a_burn_is_felt_by_whoever_feels_delta_v():
    """The sum of what is felt is the burn, in the end of it; it flies off by it."""
    burn = {"start": "20 s", "duration": "10 s", "delta_v": "[0, 0, 1] m/s"}
    flown = simulate(alone(degree=2, maneuvers={"plane": burn}), members=1).dataset
    coasted = simulate(alone(degree=2), members=1).dataset
    felt = flown["orbit.delta_v_e"].values[:, 0]
    assert np.linalg.norm(felt, axis=1).sum() == pytest.approx(1.0, rel=1e-9)
    apart = flown["orbit.r_e"].values[-1, 0] - coasted["orbit.r_e"].values[-1, 0]
    assert np.linalg.norm(apart) == pytest.approx(35.0, rel=1e-3)  # from the middle of it, 25 s


@pytest.mark.parametrize("fmi", [2, 3])
def test_its_fmu_gives_the_same_bits_and_model_exchange_agrees(tmp_path, fmi):
    """A split step in co-simulation; its derivatives, integrated by CVode, in model exchange."""
    file = tmp_path / "orbit.fmu"
    source = alone(degree=8, pole=[1e-6, -2e-6])
    export_fmu(source, file, component="orbit", fmi=fmi)

    def fly(component):
        system = System("flown")
        system.add(component, "orbit")
        simulation = Simulation(system)
        simulation.run_until("60")
        slots = simulation.master.wiring.slots
        found = {p: slots[f"orbit.{p}"].data[0].copy() for p in ("r_e", "v_e", "r_i")}
        simulation.master.terminate()
        return found

    orbit = source.nodes["orbit"]
    source.remove("orbit")
    expected = fly(orbit)
    stepped = fly(Fmu(file=file, kind=CO_SIMULATION, rate=Rate(hz=10)))
    for name, value in expected.items():
        assert stepped[name].tobytes() == value.tobytes(), name
    integrated = fly(Fmu(file=file, kind=MODEL_EXCHANGE, rate=Rate(hz=10), tolerance=1e-13))
    # the split's error at 0.1 s is 1e-9 m after a minute; CVode's at this tolerance 1e-6 m
    np.testing.assert_allclose(integrated["r_e"], expected["r_e"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(integrated["v_e"], expected["v_e"], rtol=0, atol=1e-7)


def test_a_gravity_file_in_place_of_the_shipped_one(tmp_path):
    """The same coefficients from a file: the same bytes; C20 changed: another orbit."""
    path = tmp_path / "own.gfc"
    path.write_text(SHIPPED.read_text())
    shipped = last(alone(degree=4), "r_e")
    assert last(alone(degree=4, gravity_file=path), "r_e").tobytes() == shipped.tobytes()
    path.write_text(SHIPPED.read_text().replace("-0.484165143790815e-03", "-0.485e-03"))
    moved = np.linalg.norm(last(alone(degree=4, gravity_file=path), "r_e") - shipped)
    field = shipped_field()
    change = (0.485 / 0.484165143790815 - 1) * field.j2
    pull = over_members(j2_acceleration, (3,), (), (), ())
    more, less = (pull(R_E, field.mu, field.radius, j2) for j2 in (field.j2 + change, field.j2))
    # it turns by 4 degrees in a minute
    assert moved == pytest.approx(0.5 * 60**2 * np.linalg.norm(more - less), rel=0.05)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"degree": 90}, r"degree 90 is more than the 70 of EGM2008(.|\n)*gravity_file"),
        ({"sun": True}, "need the surroundings"),
        ({"gravity": "j2", "tide": True}, 'goes with gravity = "harmonics"'),
        ({"r0_e": [7070.0, 0, 0]}, r"'orbit.r0_e' lies inside the Earth: 7070 m from its center"),
        ({"gravity_file": "none.gfc"}, "cannot read the gravity field"),
        ({"surrounded": True}, r"input 'orbit.surroundings' is not connected"),
        ({"start_from": "message"}, r"input 'orbit.start' is not connected"),
        ({"maneuvers": {"up": {"start": "1 s"}}}, "'orbit.maneuvers.up' does not say its delta_v"),
        ({"maneuvers": {"up": 3}}, "is 3, not a maneuver"),
        (
            {"maneuvers": {"up": {"start": "1 s", "delta_v": [0, 1, 0], "lasts": 3}}},
            "'orbit.maneuvers.up' has no 'lasts'",
        ),
        (
            {"maneuvers": {"up": {"start": "55 s", "duration": "6 s", "delta_v": [0, 1, 0]}}},
            r"maneuver 'up' of 'orbit' ends at 61 s, outside the run of 60 s",
        ),
    ],
)
def test_what_is_refused_before_it_flies(settings, message):
    with pytest.raises((SystemCheckError, ConfigurationError), match=message):
        simulate(alone(**settings))


def test_a_date_without_surroundings_is_refused():
    """Its inertial outputs would be of axes of no date, kilometers from those of GCRF."""
    system = System("dated", duration="1", epoch="2022-09-18T07:49:21 UTC")
    system.add(SatelliteOrbit(degree=2, **BEGIN), "satellite")
    with pytest.raises(SystemCheckError, match=r"set satellite.surrounded = true and connect"):
        simulate(system)


def test_what_would_change_nothing_is_said():
    orbit = alone(gravity="j2").nodes["orbit"]
    for name in ("degree", "gravity_file", "wind", "density", "radiation_coefficient"):
        assert f"does not take '{name}'" in orbit.idle(name)
    assert orbit.idle("j2") is None
    assert alone().nodes["orbit"].idle("j2") is not None


def test_a_satellite_that_comes_down_fails():
    system = alone(gravity="two-body", r0_e=[EARTH.radius + 500.0, 0, 0], v0_e=[-1000.0, 0, 0])
    rates = np.array([[-1000.0, 0.0, 0.0], [0.0, 7905.0, 0.0]])
    system.disperse(Dispersion("start", ("orbit.v0_e",), rates, kind="list"))
    (failure,) = simulate(system, members=2, duration="10").excluded
    assert failure["reason"] == "the orbit is inside the Earth"
    assert failure["t_s"] == pytest.approx(0.5, abs=0.11)
