"""The catalog of lakes: shared arrays, islands, settings, and files that cannot be used."""

import json
import logging
import os

import numpy as np
import pytest

import terrafix as tf
from terrafix.components.truth import lakes as module
from terrafix.components.truth.lakes import LakeCatalog
from terrafix.cosim.basics.errors import ComponentError, ConfigurationError, SystemCheckError
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.files.writing import write_system
from terrafix.cosim.system.system import System
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.maps.catalogs import read_lakes

NAMES = ("vertices", "starts", "owner", "center", "radius", "area")


def ring(west, south, size, n=1):
    """Closed, counterclockwise [deg], n edges on each side."""
    t = np.arange(n) / n
    u = np.concatenate([t, np.ones(n), 1 - t, np.zeros(n), [0]])
    v = np.concatenate([np.zeros(n), t, np.ones(n), 1 - t, [0]])
    return np.stack([west + size * u, south + size * v], axis=-1).tolist()


def feature(name, *rings):
    geometry = {"type": "Polygon", "coordinates": list(rings)}
    return {"type": "Feature", "properties": {"name": name}, "geometry": geometry}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "lakes.geojson"
    features = [
        feature("Big", ring(10, 50, 0.4), ring(10.1, 50.1, 0.1, 2)[::-1], ring(10.3, 50.1, 0.05)),
        feature("Small", ring(-77, 42, 0.1, 3)),
        feature("Middle", ring(179.9, -30, 0.2), ring(179.95, -29.9, 0.05)),
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def published(members=1, **settings):
    """What is on the ports at the start."""
    system = System("lakes")
    lakes = system.add(LakeCatalog(**settings), "lakes")
    simulation = Simulation(system, duration="1", members=members)
    simulation.initialize()
    found = {name: getattr(lakes, name) for name in NAMES}
    simulation.master.terminate()
    return found


def test_shores_are_published_in_order_and_islands_after_them(file):
    """Lake k is starts[k] to starts[k + 1], whether there are islands or not."""
    out = published(file=file, height="136 m")
    models = read_lakes(file, height=136.0)
    np.testing.assert_array_equal(out["starts"], [0, 4, 16, 20, 28, 32, 36])
    np.testing.assert_array_equal(out["owner"], [0, 1, 2, 0, 0, 2])
    assert out["starts"].dtype == out["owner"].dtype == np.int64
    assert out["vertices"].shape == (36, 3)
    rings = [*(lake.points for lake in models), *models[0].island_points]
    rings += models[2].island_points
    np.testing.assert_array_equal(out["vertices"], np.concatenate(rings))
    np.testing.assert_allclose(geodetic(out["vertices"])[2], 136.0, atol=1e-6)
    south_west = ecef(*np.radians([42.0, -77.0]), 136.0)
    shore = out["vertices"][4:16]
    assert np.linalg.norm(shore - south_west, axis=1).min() < 1e-6
    for k, lake in enumerate(models):
        mine = out["vertices"][out["starts"][k] : out["starts"][k + 1]]
        reach = np.linalg.norm(mine - out["center"][k], axis=1).max()
        assert out["radius"][k] == pytest.approx(reach, rel=1e-12)
        assert out["area"][k] == lake.area


def test_areas_are_those_of_the_rings_that_are_published(file):
    """By the vector area of the flat rings: 1 in 1e5 less than on the curved Earth."""
    for islands in (True, False):
        out = published(file=file, islands=islands)
        assert len(out["starts"]) == (7 if islands else 4)
        total = np.zeros(3)
        for k, lake in enumerate(out["owner"]):
            p = out["vertices"][out["starts"][k] : out["starts"][k + 1]]
            up = out["center"][lake] / np.linalg.norm(out["center"][lake])
            total[lake] += 0.5 * np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0) @ up
        # up is geocentric, 0.19 deg from the vertical: 6e-6
        np.testing.assert_allclose(out["area"], total, rtol=3e-5)


def test_settings_select(file):
    def areas(**settings):
        return len(published(file=file, **settings)["area"])

    everything = published(file=file)
    assert areas(names="small; Big") == 2
    assert areas(box="[170, -40, -170, -20] deg") == 1
    assert areas(area_min="200 km^2") == 2
    assert areas(area_max="200 km^2") == 1
    assert areas(area_min="200 km^2", area_max="500 km^2") == 1
    largest = published(file=file, most=2)
    np.testing.assert_array_equal(largest["area"], everything["area"][[0, 2]])
    np.testing.assert_array_equal(largest["owner"], [0, 1, 0, 0, 1])


def test_all_members_see_the_same_and_a_second_run_the_same_bytes(file):
    one, many = published(file=file), published(3, file=file)
    for name in NAMES:
        assert one[name].tobytes() == many[name].tobytes()


def test_a_reader_gets_the_arrays_themselves(file):
    """By reference through a connection, at the start."""

    class Sum(tf.Component):
        """Total area."""

        default_rate = tf.Rate(hz=1)
        area = tf.SharedInput((None,), unit="m^2", doc="of lakes")
        vertices = tf.SharedInput((None, 3), unit="m", frame="e", doc="of rings")
        total = tf.Output(unit="m^2", doc="of all lakes")

        def _initialize_impl(self) -> None:
            self.total = self.area.sum()

        def _step_impl(self, t: float, dt: float) -> None:
            self.total = self.area.sum()

    system = System("lakes", duration="2")
    lakes = system.add(LakeCatalog(file=file), "lakes")
    reader = system.add(Sum(), "reader")
    system.connect(lakes["area"], reader["area"])
    system.connect(lakes["vertices"], reader["vertices"])
    system.record("total", [reader["total"]])
    result = tf.simulate(system, members=2)
    values = result.dataset["reader.total"].to_numpy()
    np.testing.assert_array_equal(values, sum(lake.area for lake in read_lakes(file)))


def test_the_file_is_read_once_and_again_when_it_has_changed(file, monkeypatch):
    calls = []
    monkeypatch.setattr(
        module, "read_lakes", lambda *a, **o: calls.append(a) or read_lakes(*a, **o)
    )
    system = System("lakes")
    lakes = system.add(LakeCatalog(file=file), "lakes")
    system.check()
    simulation = Simulation(system, duration="1")
    simulation.initialize()
    simulation.master.terminate()
    assert len(calls) == 1
    tree = json.loads(file.read_text())
    file.write_text(json.dumps(tree | {"features": tree["features"][:1]}))
    os.utime(file, ns=(1, 1))
    assert len(published(file=file)["area"]) == 1
    assert len(calls) == 2
    assert lakes.name == "lakes"


def test_lakes_are_named_in_the_log(file, caplog):
    with caplog.at_level(logging.INFO, "terrafix"):
        published(file=file)
    assert "'lakes' holds Big, Small, Middle" in caplog.text


def test_a_system_is_written_and_read_back(file, tmp_path):
    """Infinity and the whole Earth, the defaults, too."""
    system = System("lakes", duration="1")
    system.add(LakeCatalog(file=file, names="Big", box="[0, 0, 90, 90] deg"), "lakes")
    write_system(system, tmp_path / "lakes.toml")
    again = read_system(tmp_path / "lakes.toml").nodes["lakes"]
    assert again.setting("area_max") == np.inf
    assert again.setting("names") == "Big"
    np.testing.assert_allclose(again.setting("box"), np.radians([0, 0, 90, 90]), rtol=1e-15)


# ------------------------------------------------------------------------- what is refused


def refused(**settings) -> str:
    lakes = LakeCatalog(**settings)
    lakes.name = "lakes"
    with pytest.raises(ConfigurationError) as raised:
        lakes.validate()
    return str(raised.value)


def test_what_cannot_be_read_is_one_configuration_error(file, tmp_path):
    told = refused()
    assert told.startswith("'lakes' needs a catalog of lakes\n  set lakes.file, or lakes.source to")
    told = refused(file=tmp_path / "gone.shp")
    assert told == (
        f"'lakes' cannot read its lakes: '{tmp_path}/gone.shp' is not there\n"
        "  set lakes.file, or TERRAFIX_DATA to the folder with the data"
    )
    assert "did you mean 'Small'?" in refused(file=file, names="Smal")
    assert "cannot select lakes: the box is empty" in refused(file=file, box="[1, 2, 3, 2] deg")
    assert "cannot select lakes: no lake has at least" in refused(
        file=file, area_min="2 km^2", area_max="1 km^2"
    )
    (tmp_path / "map.geojson").write_bytes(b"II*\0" + bytes(60))
    assert "is not a catalog of lakes in GeoJSON: it is a TIFF" in refused(
        file=tmp_path / "map.geojson"
    )


def test_a_package_that_is_absent_is_one_configuration_error(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "'lakes' cannot read its lakes: lakes of gshhg-high are in the package" in refused(
        source="gshhg-high", box="[1, 2, 3, 4] deg"
    )


def test_a_file_that_may_not_be_read_is_one_configuration_error(file, monkeypatch):
    def denied(path, *arguments, **options):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(module, "read_lakes", denied)
    told = refused(file=file, names="Nobody")
    assert told == f"'lakes' cannot read its lakes: '{file}': permission denied"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ([], "'lakes' needs a catalog of lakes\n  set lakes.file, or"),
        ([("lakes.file", "")], "'lakes.file' is ''; it takes the path of a file"),
        ([("lakes.source", "gshhg"), ("lakes.file", "a.csv")], "cannot set 'lakes.file'\n  'lakes' "
         "does not take 'file' with source = 'gshhg', islands = true: it would change nothing"),
    ],
)  # fmt: skip
def test_settings_that_do_not_go_together_are_one_problem_of_the_check(tmp_path, settings, said):
    """A file that is not named is looked for, too; one that was refused is not asked for again."""
    (tmp_path / "system.toml").write_text(
        'schema = "terrafix-system/1"\nduration = "1 s"\n'
        '[component.lakes]\ntype = "lake_catalog"\nbox = "[-78, 42, -76, 43] deg"\n'
    )
    with pytest.raises(SystemCheckError) as raised:
        read_system(tmp_path / "system.toml", settings)
    told = [str(p) for p in raised.value.problems if "package" not in str(p)]  # is not installed
    assert len(told) == 1
    assert said in told[0]


def test_a_bad_file_is_a_problem_of_the_check(tmp_path):
    (tmp_path / "lakes.csv").write_text("1,2\n3,4\n")
    (tmp_path / "system.toml").write_text(
        'schema = "terrafix-system/1"\nduration = "1 s"\n'
        '[component.lakes]\ntype = "lake_catalog"\nfile = "lakes.csv"\n'
    )
    with pytest.raises(SystemCheckError) as raised:
        read_system(tmp_path / "system.toml")
    (problem,) = raised.value.problems
    assert isinstance(problem, ConfigurationError)
    assert "lakes.csv' is open: it starts at longitude 1.00000" in str(problem)


@pytest.mark.parametrize("name", ["height", "area_min", "area_max", "box"])
def test_settings_are_one_for_all_members(file, name):
    system = System("lakes")
    system.add(LakeCatalog(file=file, area_max="1e6 km^2"), "lakes")
    simulation = Simulation(system, duration="1", members=2)
    values = getattr(system.nodes["lakes"], name)
    values[1] = np.where(values[1] == 0.0, 1e-3, 0.99 * values[1])
    with pytest.raises(ComponentError, match=rf"'lakes\.{name}' differs between members"):
        simulation.initialize()
