"""The terrain: what is filled is said, what cannot be is refused."""

import logging

import numpy as np
import pytest

from terrafix.components.truth.terrain import Terrain, scene_from
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.system import System
from terrafix.models.maps import geoid
from terrafix.models.maps.dem import Dem, write_dem


def test_filled_voids_are_reported_once(tmp_path, caplog):
    height = np.full((5, 5), 300.0, np.float32)
    height[2, 2:4] = -9999.0
    write_dem(Dem(height, 0.0, 0.0, 0.01, 0.01), tmp_path / "holes.npz")
    system = System("terrain")
    terrain = system.add(Terrain(dem_file=tmp_path / "holes.npz", fill_voids=True), "terrain")
    with caplog.at_level(logging.WARNING):
        simulation = Simulation(system, duration="1")
        simulation.initialize()
    np.testing.assert_array_equal(terrain.height, 300.0)
    simulation.master.terminate()
    assert [r.getMessage() for r in caplog.records if r.name.startswith("terrafix")] == [
        "'terrain' filled 2 void points of the 25 of 'holes.npz' by interpolation from their rims"
    ]


@pytest.mark.parametrize("height", ["1e9 m", "-20 km"])
def test_a_flat_earth_has_heights_of_the_earth(height):
    with pytest.raises(ConfigurationError, match=r"it must be at (most 9000|least -12000) m"):
        Terrain(source="flat", flat_height=height)


def test_a_terrain_without_a_file_is_a_problem_of_the_check():
    system = System("terrain")
    system.add(Terrain(), "terrain")
    with pytest.raises(SystemCheckError, match="'terrain' needs an elevation model\n  set terrain"):
        system.check()


def terrain_of(**settings):
    system = System("ground")
    system.add(Terrain(**{"source": "hills"} | settings), name="terrain")
    simulation = Simulation(system)
    simulation.run_until("0")
    return np.array(system.nodes["terrain"].height)


def test_heights_that_are_not_the_true_ones_are_off_by_their_error():
    """3 m rms, to the float32 of heights; and the hills are the same under them."""
    true, known = terrain_of(), terrain_of(error=3.0)
    assert (known - true).std() == pytest.approx(3.0, rel=1e-4)
    assert np.array_equal(true, terrain_of())


def test_heights_of_any_source_but_a_flat_one_can_err():
    """As hills: 3 m rms. And a border of the model is too near for errors 20 km long."""
    true, known = (
        terrain_of(source="jacksboro", mirrored=True, **settings)
        for settings in ({}, {"error": 3.0, "error_length": 300.0})
    )
    assert (known - true).std() == pytest.approx(3.0, rel=1e-4)
    assert not Terrain(source="flat").takes("error")
    assert not Terrain(source="jacksboro").takes("error_length")
    assert Terrain(source="jacksboro", error=3.0).takes("error_length")
    with pytest.raises(SystemCheckError, match=r"set terrain\.error_length"):
        terrain_of(source="jacksboro", error=3.0, error_length=20e3)


def test_what_hills_do_not_read_is_refused():
    terrain = Terrain(source="hills")
    assert terrain.takes("relief")
    assert not terrain.takes("mirrored")
    assert not terrain.takes("error_seed")
    assert not Terrain(source="flat").takes("relief")
    with pytest.raises(SystemCheckError, match=r"set terrain\.relief_length"):
        terrain_of(relief_length=5.0)


def test_what_covers_the_ground_is_told_and_what_it_has_no_use_for_is_refused():
    system = System("ground")
    terrain = system.add(Terrain(source="flat", cover="coast", surface_seed=4), name="terrain")
    Simulation(system).run_until("0")
    scene = scene_from(terrain.height, terrain.grid, terrain.surface)
    assert (scene.cover, scene.seed, scene.points_db, scene.detail) == ("coast", 4, 25.0, 1)
    assert terrain.takes("point_density")
    assert not Terrain(source="flat", cover="texture").takes("parcels")
    assert not Terrain(source="flat", cover="urban").takes("point_density")
    assert Terrain(source="flat", cover="urban").takes("point_brightness")


def tile(folder, value=100):
    path = folder / "N44W072.hgt"
    np.full((1201, 1201), value, ">i2").tofile(path)
    return path


def heights(**settings):
    system = System("ground")
    system.add(Terrain(**settings), name="terrain")
    simulation = Simulation(system)
    simulation.run_until("0")
    return system.nodes["terrain"].height


def test_heights_of_srtm_are_told_above_the_ellipsoid(tmp_path):
    """Mount Washington stands on a geoid 27 to 28 m below the ellipsoid."""
    rise = heights(dem_file=tile(tmp_path), geoid="degree 70") - 100
    assert rise.mean() == pytest.approx(-27.6, abs=1.0)
    assert np.ptp(rise) > 0.5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "the geoid EGM96 is not there: PROJ has no grid"),
        ({"vertical_datum": "EGM2008"}, "'N44W072.hgt' says that its heights refer to EGM96"),
    ],
)
def test_a_geoid_that_is_not_there_or_contradicts_is_an_error(
    tmp_path, settings, message, monkeypatch
):
    monkeypatch.setattr(geoid, "_by_proj", lambda grid: None)
    monkeypatch.setattr(geoid, "_package_grid", lambda: None)
    with pytest.raises(SystemCheckError, match=message):
        heights(dem_file=tile(tmp_path), **settings)


def test_a_file_that_does_not_say_what_its_heights_refer_to_is_refused_unless_it_is_stated(
    tmp_path,
):
    path = tmp_path / "map.npz"
    write_dem(Dem(np.full((3, 3), 5, np.float32), 0.6, -1.4, 1e-3, 1e-3, datum=""), path)
    with pytest.raises(SystemCheckError, match=r"(?s)does not say .* set terrain\.vertical_datum"):
        heights(dem_file=path)
    assert (heights(dem_file=path, vertical_datum="ellipsoid") == 5).all()
    assert not Terrain(dem_file=path, vertical_datum="ellipsoid").takes("geoid")
    assert Terrain(dem_file=path).takes("geoid")


def test_a_tile_of_voids_is_refused(tmp_path):
    with pytest.raises(SystemCheckError, match=r"N44W072\.hgt' holds nothing but voids"):
        heights(dem_file=tile(tmp_path, -32768), geoid="degree 70")
