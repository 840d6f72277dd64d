"""What every component type keeps: one test for all that are registered, new ones included.

Each is flown alone, on inputs that differ between members: a member of an ensemble equals the same
member alone, a state taken and set back continues to the same bytes, every port and parameter says
what it is.
"""

import importlib
import pkgutil

import numpy as np
import pytest
import xarray

from terrafix import components
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component, docstring
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import BundleOutput, MessageOutput, Output
from terrafix.cosim.declare.registry import component_entries, component_type
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.records.checkpoint import read_checkpoint, write_checkpoint
from terrafix.cosim.system.system import System
from terrafix.models.motion.attitude import lvlh_quaternion_array

TYPES = sorted(n for n, e in component_entries().items() if e.value.startswith("terrafix."))
IMAGING = {  # whose inputs are images and maps: flown in test_imaging
    *("earlier_pass", "image_album", "image_former", "image_matcher"),
    *("recorded_echo", "recorded_reference", "reference_file", "scene_echo", "terrain"),
    "rendered_reference",
    *("elevation_map", "reference_map"),  # in images/test_maps
    *("aircraft_radar", "aperture_former", "aperture_matcher"),
    "earlier_flight",  # in systems/test_aircraft_sar
    *("recorded_spotlight", "spotlight_matcher", "spotlight_evaluation"),  # in test_aircraft_gotcha
    "lake_catalog",  # and of maps of lakes: in truth/test_lakes
    *(
        "image_moments",
        "lake_imager",
        "contour_moments",
        "lake_camera",
        "lake_correct",
        "lake_correct_considered",
    ),
    *("shore_matcher", "shore_correct", "orbit_evaluation_shore"),  # in systems/test_leo_lake_shore
    *("last_known_orbit", "orbit_evaluation", "orbit_evaluation_considered"),
    *("orbit_predict", "orbit_predict_considered"),  # in systems/test_leo_lake
    *("ground_scene", "staring_camera", "staring_satellite"),
    *("frame_georeference", "frame_georeference_printed"),
    *("frame_matcher", "frame_matcher_printed"),
    *("known_pointing", "known_pointing_printed", "target_predict", "target_predict_printed"),
    *("target_correct", "target_correct_located", "pointing_correct", "pointing_fix"),
    *("target_correct_misprinted", "target_correct_printed"),
    *("target_evaluation", "target_evaluation_printed"),  # in systems/test_geolocation
    "radar_altimeter",  # in sensors/test_aircraft_sensors
    "profile_matcher",  # in images/test_profile
    "synthetic_shift",  # of apertures that end: in systems/test_aircraft
    *(
        "clearance_correct",
        "clearance_correct_gnss",
        "clearance_correct_radar",
    ),  # in filters/test_clearance
}
FOREIGN = {"elements", "fmu", "fmu_loop", "linear"}  # whose ports come from files: tests/fmi
BASES = {  # of which types are made
    "Dated",
    *("EnsembleCorrect", "FilterAcquisition", "FilterCorrect", "FilterEvaluation", "FilterMonitor"),
    *(
        "FilterPredict",
        "FilterSensor",
        "FilterTruth",
        "InView",
        "NoisyComponent",
        "OwnOrCommon",
        "OnGround",
        "OnReference",
    ),
    *("Optics", "Playback", "ReferenceSource", "SendsChirps"),
}
SIZES = (1, 100)
STEP, HALF, WHOLE = "0.1", "0.8", "1.6"  # [s]

R_E = np.array([-1104646.3, -6096830.4, 3395727.4])  # [m], an orbit of 700 km
V_E = np.array([-1004.7, 3648.9, 6498.0])  # [m/s]
Q_BE = lvlh_quaternion_array(R_E, V_E)
SIGMA = np.array([100.0] * 3 + [1.0] * 3 + [1e-4] * 3)  # [m], [m/s], [rad]

# Values of inputs and parameters: (mean, sigma over members and steps), by name of port or field.
INPUTS = {
    "r_e": (R_E, 100.0),
    "v_e": (V_E, 0.1),
    "q_be": (Q_BE, 0.0),
    "q_be_true": (Q_BE, 0.0),
    "q_mu": (np.array([0.0, 0.0, 0.0, 1.0]), 0.0),
    "delta_v_e": (np.zeros(3), 1e-3),
    "delta_v_b": (np.zeros(3), 1e-3),
    "delta_v_b_true": (np.zeros(3), 1e-3),
    "delta_theta_b": (np.zeros(3), 1e-4),
    "delta_theta_b_true": (np.zeros(3), 1e-4),
    "r_e_at_aperture": (R_E, 100.0),
    "v_e_at_aperture": (V_E, 0.1),
    "t_aperture": (np.zeros(1), 0.0),
    "accel_bias_b": (np.zeros(3), 1e-4),
    "gyro_bias_b": (np.zeros(3), 1e-6),
    "altimeter_bias": (np.zeros(1), 1.0),
    "gnss_bias": (np.zeros(3), 1.0),
    "range_bias": (np.zeros(1), 1.0),
    "cross_range_bias": (np.zeros(1), 1.0),
    "p_t_e": (R_E * 0.9, 100.0),
    "p_e": (R_E, 100.0),
    "speed": (np.array([7.5e3]), 0.0),
    "f_b": (np.zeros(3), 1e-3),
    "t_center": (np.zeros(1), 0.0),
    "F": (1e-6 * np.eye(3), 0.0),
    "index": (0.0, 0.0),
    "P": (np.diag(np.append(SIGMA, [1e-2] * 15) ** 2), 0.0),
    "y": (np.array([0, 0, 9e5, 7.5e3, 0, 0]), np.array([1e-3, 1e-3, 100.0, 1.0, 1.0, 1.0])),
    "r_f_e": (R_E * 0.9, 100.0),
    "R": (np.diag([0.0, 0.0, 1.0, 0.3, 1.0, 1.0]), 0.0),
    "D": (25.0 * np.eye(3), 0.0),
    "present": (np.ones(6), 0.0),
    "residual": (np.zeros(6), 1.0),
    "sigma": (np.ones(6), 0.0),
    "nis": (4.0, 0.1),
    "dof": (4.0, 0.0),
    "accepted": (1.0, 0.0),
    "reason": (0.0, 0.0),
    "time": (0.0, 0.0),
    "omega_e": (np.array([0.0, 0.0, 7.292115e-5]), 1e-9),
    "q_ei": (np.array([0.0, 0.0, 0.0, 1.0]), 0.0),
    "sun_e": (R_E / 7e6 * 1.5e11, 1e6),
    "sun_rate_e": (np.array([0.0, 3e4, 0.0]), 1.0),
    "moon_e": (R_E / -7e6 * 3.8e8, 1e3),
    "moon_rate_e": (np.array([0.0, 1e3, 0.0]), 1.0),
    "log_density": (-31.0, 0.1),
    "gradient": (-R_E / np.linalg.norm(R_E) / 7e4, 1e-7),
}
INERTIAL = {
    "velocity_random_walk": 1e-3,
    "angle_random_walk": 1e-5,
    "accel_bias_sigma": 1e-3,
    "gyro_bias_sigma": 1e-5,
}
SETTINGS = {
    "atmosphere": {"f107": 140.0, "f107a": 130.0, "ap": 12.0},
    "antenna_mount": {"misalignment_sigma0": 1e-3, "misalignment_walk": 1e-4},
    "antenna_steering": {"looks": "34.3 deg"},
    "attitude_sensor": {"noise_sigma": 1e-4, "bias_sigma": 1e-3},
    "flight": {
        "turbulence": "dryden",
        "segments": [{"duration": "4 s"}, {"turn": "20 deg", "bank": "30 deg"}],
    },
    "imu": {
        "velocity_random_walk": 1e-5,
        "accel_bias_sigma0": 1e-4,
        "accel_bias_walk": 1e-6,
        "angle_random_walk": 1e-6,
        "gyro_bias_sigma0": 1e-6,
        "gyro_bias_walk": 1e-8,
    },
    "inertial_predict": INERTIAL,
    "inertial_predict_gnss": INERTIAL,
    "inertial_predict_radar": INERTIAL,
    "mekf_correct": {"look": 0.6},
    "mekf_predict": {"misalignment_sigma0": 1e-3, "accel_psd": 1e-6},
    "mekf_predict_surrounded": {"misalignment_sigma0": 1e-3, "accel_psd": 1e-6, "degree": 3},
    "mekf_predict_smoothed": {"misalignment_sigma0": 1e-3, "accel_psd": 1e-6},
    "orbit": {"r0_i": R_E, "v0_i": [-560.1, 3729.6, 6497.9]},
    "orbit_start": {"frame": "gcrf", "r0": R_E, "v0": [-560.1, 3729.6, 6497.9]},
    "star_tracker": {"sun_exclusion": 0.0, "alignment_sigma": 1e-4},
    "sun_sensor": {"bias_sigma": 1e-3, "bias_time": 10.0},
    "horizon_sensor": {"bias_sigma": 1e-3, "bias_time": 10.0},
    "satellite": {
        "degree": 3,
        **dict.fromkeys(("surrounded", "sun", "moon", "tide", "radiation"), True),
        "drag": "atmosphere",
        "ballistic_coefficient": 0.02,
        "radiation_coefficient": 0.02,
        "maneuvers": {"up": {"start": 0.3, "duration": 0.4, "delta_v": [1.0, 0.0, 0.0]}},
    },
    "synthetic_sar_fix": {"look": 0.6},
}
RATES = dict.fromkeys(("last_known_state", "last_known_flight", "orbit_start"), Rate(times=["0"]))
EPOCHS = dict.fromkeys(("atmosphere", "environment", "orbit_start"), "2022-09-18T07:49:21.5 UTC")


class Inputs(Component):
    """Base of what drives a component under test: an output for each of its inputs."""

    default_rate = Rate(STEP)

    def _initialize_impl(self):
        self._publish(0.0)

    def _step_impl(self, t, dt):
        self._publish(t)

    def _publish(self, t):
        for name, port in self.ports.items():
            values = {f: self._draw(f or name, f"{name}.{f}", port.fields[f]) for f in port.fields}
            if port.kind == "message":
                self.port_views[name].publish(t, **values)
            elif port.is_bundle:
                for f, value in values.items():
                    self.port_views[name].__dict__[f][...] = value
            else:
                setattr(self, name, values[""])

    def _draw(self, name, stream, field):
        mean, sigma = INPUTS[name]
        mean = np.asarray(mean)[tuple(slice(n) for n in field.shape)]  # of P, what is needed
        noise = self.normals(stream, field.size).reshape(-1, *field.shape)
        if np.ndim(sigma):
            sigma = sigma[tuple(slice(n) for n in field.shape)]
        return mean + sigma * noise


def source_of(port):
    """An output that fits an input."""
    if port.kind == "message":
        return MessageOutput(fields=port.fields)
    if port.is_bundle:
        return BundleOutput(port.fields)
    one = port.single
    return Output(one.shape, unit=one.unit, frame=one.frame)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """What playback plays: attitude and position of 100 members, as if recorded on a run."""
    folder = tmp_path_factory.mktemp("recording")
    orbit, attitude = component_type("orbit"), component_type("lvlh_attitude")
    played = {n: orbit.declarations[n] for n in ("r_e", "v_e")}
    played |= {n: attitude.declarations[n] for n in ("q_be", "delta_v_b", "delta_theta_b")}
    kind = type("Played", (Inputs,), {n: source_of(p) for n, p in played.items()})
    system = System("recording")
    made = system.add(kind(), name="original")
    system.record("all", [made[n] for n in played])
    simulate(system, members=max(SIZES), duration=WHOLE, out=folder / "recording.nc")
    return folder / "recording.nc"


@pytest.fixture(scope="module")
def track(tmp_path_factory):
    """What a recorded flight follows: a slow turn over 8 s."""
    path = tmp_path_factory.mktemp("track") / "track.csv"
    rows = [(t, 47 + 6e-4 * t, 8 + 1e-5 * t * t, 1000 + t) for t in range(9)]
    lines = ["time,latitude,longitude,height", *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture(scope="module", params=[n for n in TYPES if n not in IMAGING | FOREIGN])
def build(request, recording, track):
    """A function that builds a system of one component and what drives it."""
    kind = component_type(request.param)
    settings = dict(SETTINGS.get(request.param, {}))
    for name, value in (("result_file", recording), ("orbit_file", recording)):
        if name in kind.settings():
            settings |= {name: value, "source": "original"}
    if "track_file" in kind.settings():
        settings["track_file"] = track

    def build_system() -> System:
        system = System("contract", epoch=EPOCHS.get(request.param))
        part = system.add(kind(rate=RATES.get(request.param, Rate(STEP)), **settings), name="part")
        if part.inputs():
            ports = {n: source_of(p) for n, p in part.inputs().items()}
            drive = system.add(type("Drive", (Inputs,), ports)(), name="drive")
            for name in ports:
                system.connect(drive[name], part[name])
        system.record("all", [part[n] for n in part.outputs()], period=STEP)
        return system

    build_system.kind = kind
    return build_system


@pytest.fixture(scope="module")
def seven(build):
    """A system and what seven members of it record: flown once for all that compare with it."""
    system = build()
    return system, simulate(system, members=7, duration=WHOLE).dataset


def payload(dataset: xarray.Dataset, member=None) -> dict[str, bytes]:
    """Bytes of every array of a result, or of one member in it."""
    if member is not None:
        dataset = dataset.sel(member=[member])
    return {str(n): v.to_numpy().tobytes() for n, v in dataset.variables.items()}


def test_a_member_of_an_ensemble_equals_the_same_member_alone(build, seven):
    """Ensembles of 1, 7 and 100, and the last of 100 alone: no member knows the others."""
    flown = {n: simulate(build(), members=n, duration=WHOLE).dataset for n in SIZES}
    flown[7] = seven[1]
    for name, values in flown[100].data_vars.items():
        assert np.isfinite(values.to_numpy()).any(), f"nothing was tested of {name}"
    for member in range(7):
        assert payload(flown[7], member) == payload(flown[100], member)
    assert payload(flown[1], 0) == payload(flown[100], 0)
    alone = simulate(build(), members=[99], duration=WHOLE).dataset
    assert payload(alone) == payload(flown[100], 99)


def test_the_same_system_gives_the_same_bytes_again(seven):
    system, first = seven
    assert payload(simulate(system, members=7, duration=WHOLE).dataset) == payload(first)


def test_a_state_set_back_continues_to_the_same_bytes(build, seven, tmp_path):
    """In the same simulation, and in another one, through a file."""
    whole = seven[1]
    halted = Simulation(build(), members=7)
    halted.run_until(HALF)
    write_checkpoint(tmp_path / "half.ckpt", halted.get_state())
    halted.run_until(WHOLE)
    saved = read_checkpoint(tmp_path / "half.ckpt")
    halted.set_state(saved)
    halted.run_until(WHOLE)
    assert payload(halted.result(wall_s=0.0).dataset) == payload(whole)
    continued = Simulation(build(), members=7)
    continued.set_state(saved)
    continued.run_until(WHOLE)
    times = [d for d in whole.dims if str(d).startswith("time")]
    rest = whole.isel({d: whole[d] > float(HALF) for d in times})  # the half before is not copied
    assert payload(continued.result(wall_s=0.0).dataset) == payload(rest)


@pytest.mark.parametrize("name", TYPES)
def test_ports_and_parameters_say_what_they_are(name):
    kind = component_type(name)
    assert docstring(kind)
    for name, declared in kind.declarations.items():
        if isinstance(declared, Parameter) or not hasattr(declared, "fields"):
            assert declared.doc, f"{kind.__name__}.{name} has no doc"
            continue
        for field in declared.fields.values():
            assert declared.doc or field.doc or field.labels, f"{kind.__name__}.{name} has no doc"


def test_parameters_are_read_back_as_they_were_written(build):
    part = build().nodes["part"]
    for name, setting in part.settings().items():
        value = part.setting(name)
        again = setting.read(setting.write(value), where=name, bare=False)
        np.testing.assert_array_equal(again, value)


def test_parameters_cannot_be_set_while_a_simulation_runs(build):
    system = build()
    part = system.nodes["part"]
    Simulation(system)
    for name in part.settings():
        with pytest.raises(ConfigurationError, match=f"'part.{name}' cannot be set while"):
            setattr(part, name, part.setting(name))


def test_every_type_that_comes_with_terrafix_is_registered_and_tested():
    modules = [
        importlib.import_module(module.name)
        for module in pkgutil.walk_packages(components.__path__, f"{components.__name__}.")
    ]
    public = {
        kind.__name__
        for module in modules
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, Component)
        if kind.__module__ == module.__name__ and not kind.__name__.startswith("_")
    }
    registered = {component_entries()[n].value.split(":")[1] for n in TYPES if n not in FOREIGN}
    assert registered == public - BASES
    assert public >= BASES
