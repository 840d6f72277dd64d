"""What the tests of the models share: a nominal pass of the radar satellite, data, derivatives."""

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.motion.attitude import lvlh_quaternion_array

# the first call builds a function, which a deadline would count; the same examples every time
settings.register_profile("terrafix", deadline=None, derandomize=True)
settings.load_profile("terrafix")

# start of the spacecraft papers' pass over Houston (see test_start)
R0_I = np.array([-1104646.3356338572, -6096830.387203118, 3395727.381187697])  # [m]
V0_I = np.array([-560.0980743545368, 3729.5871618791953, 6497.9362610432145])  # [m/s]


@pytest.fixture(scope="session")
def constants():
    """Parameters of the Earth as the models name them."""
    return {
        "mu": EARTH.mu,
        "radius": EARTH.radius,
        "j2": EARTH.j2,
        "rotation_rate": EARTH.rotation_rate,
    }


@pytest.fixture(scope="session")
def start_i():
    return R0_I, V0_I


@pytest.fixture(scope="session")
def start_e():
    """Earth-fixed position, velocity and level attitude at the start."""
    r_e, v_e = earth_fixed_from_inertial_array(R0_I, V0_I, 0.0, EARTH.rotation_rate)
    return r_e, v_e, lvlh_quaternion_array(r_e, v_e)


@pytest.fixture(scope="session")
def check_jacobian():
    """Compare a derived Jacobian with central differences, row by row."""

    def check(model, output, wrt, step, rtol=1e-6, **values):
        derived = model.jacobian(output, wrt, **values)
        base = np.asarray(values[wrt], dtype=float)
        columns = []
        for i in range(base.size):
            offset = np.zeros(base.size)
            offset[i] = step
            ahead = model(**values | {wrt: base + offset})[output]
            behind = model(**values | {wrt: base - offset})[output]
            columns.append((ahead - behind) / (2 * step))
        numeric = np.stack(columns, axis=-1)
        scale = np.abs(numeric).max(axis=-1, keepdims=True)
        assert np.all(np.abs(derived - numeric) <= rtol * scale + 1e-300)

    return check


@pytest.fixture(scope="session")
def data_folder():
    """Real data outside the repository; tests that need it skip where it is absent."""
    default = Path(__file__).parents[2] / ".." / "shared" / "data"
    folder = Path(os.environ.get("TERRAFIX_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is absent (set TERRAFIX_DATA)")
    return folder


def _helper(name):
    spec = importlib.util.spec_from_file_location(
        name, Path(__file__).with_name("radar") / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def points():
    """Echo of point targets, and radars to see them with (radar/points.py)."""
    return _helper("points")


@pytest.fixture(scope="session")
def aircraft():
    """An aircraft's radar, its tracks and what it sees (radar/aircraft.py)."""
    return _helper("aircraft")


@pytest.fixture(scope="session")
def land_echo(aircraft):
    """Echo of an aperture over relief with texture and points."""
    return aircraft.echo_of(aircraft.LAND, aircraft.aperture(*aircraft.track()), 11)


@pytest.fixture(scope="session")
def field_echo(aircraft):
    """Echo of an aperture over a field with nothing on it."""
    return aircraft.echo_of(aircraft.FIELD, aircraft.aperture(*aircraft.track()), 12, points=False)
