"""The terrain: what is filled is said, what cannot be is refused."""

import logging

import numpy as np
import pytest

from terrafix.components.truth.terrain import Terrain
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.system import System
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
