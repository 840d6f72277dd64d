"""Geocoded references: places between tie points, across the date line and about a pole."""

import numpy as np
import pytest

from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.geometry.geolocation import ground_point_on_terrain, track_axes
from terrafix.models.images.reference import Reference, read_reference, write_reference
from terrafix.models.maps.dem import read_jacksboro

ROWS, COLUMNS = np.array([0.0, 50.0, 100.0]), np.array([0.0, 40.0, 80.0])


def reference(longitude_deg, latitude_deg=(10.0, 10.01, 10.02)):
    """Tie points of which the longitude goes on with the column, the latitude with the row."""
    latitude, longitude = np.meshgrid(latitude_deg, longitude_deg, indexing="ij")
    return Reference(
        np.ones((101, 81), np.float32),
        ROWS,
        COLUMNS,
        np.radians(latitude),
        np.radians(longitude),
        np.zeros((3, 3)),
    )


@pytest.mark.parametrize(
    "longitude_deg",
    [
        (179.98, 179.999, -179.982),
        (-179.982, 179.999, 179.98),  # a descending pass, seen from the east
        (179.98, -179.98, -179.94),
        (359.98, 0.0, 0.02),
        (-0.02, 0.0, 0.02),
    ],
)
def test_places_go_on_across_the_date_line(longitude_deg):
    """Halfway between two tie points is the mean of their longitudes on the circle."""
    made = reference(longitude_deg)
    points = np.exp(1j * np.radians(longitude_deg))
    for column, (a, b) in ((20.0, points[:2]), (60.0, points[1:])):
        latitude, longitude, _ = made.place(25.0, column)
        assert latitude == pytest.approx(np.radians(10.005), abs=1e-14)
        assert np.angle(np.exp(1j * longitude) / (a + b)) == pytest.approx(0.0, abs=1e-14)


def test_a_file_keeps_what_crosses_the_date_line(tmp_path):
    path = tmp_path / "reference.npz"
    write_reference(reference((179.98, -179.98, -179.94)), path)
    _, longitude, _ = read_reference(path).place(0.0, 20.0)
    assert abs(np.degrees(longitude)) == pytest.approx(180.0, abs=1e-12)


def test_longitudes_are_told_in_the_references_own_turn():
    made = reference((179.98, -179.98, -179.94))
    own = np.degrees(made.own_turn(np.radians([179.99, -179.99, 180.01, 0.0])))
    span = np.degrees([made.longitude.min(), made.longitude.max()])
    assert ((own[:3] > span[0]) & (own[:3] < span[1])).all()
    np.testing.assert_allclose(np.abs(own[:3] - own[0]), [0.0, 0.02, 0.02], atol=1e-9)
    assert not span[0] < own[3] < span[1]


def test_a_reference_about_a_pole_is_refused():
    with pytest.raises(ValueError, match=r"lies about a pole: .* changes by 120 deg"):
        reference((0.0, 120.0, 240.0), latitude_deg=(89.99, 89.992, 89.994))


def test_latitudes_in_other_units_are_refused():
    with pytest.raises(ValueError, match="latitude of a reference is beyond a pole"):
        reference((0.0, 0.01, 0.02), latitude_deg=(91.0, 91.1, 91.2))


def test_a_place_is_found_on_the_image_again():
    """`pixel` undoes `place` on ties that relief has bent; what is beyond them is outside."""
    rng = np.random.default_rng(3)
    rows, columns = np.linspace(0, 300, 31), np.linspace(0, 200, 21)
    i, j = np.meshgrid(rows, columns, indexing="ij")
    bent = j + 3 * np.sin(i / 40) * np.cos(j / 30)
    reference = Reference(
        np.ones((301, 201), np.float32), rows, columns, 0.6 + 1e-7 * i, 0.2 + 2e-7 * bent, 0 * i
    )
    row, column = rng.uniform(5, 295, 50), rng.uniform(5, 195, 50)
    latitude, longitude, _ = reference.place(row, column)
    found = reference.pixel(latitude, longitude)
    np.testing.assert_allclose(found[0], row, atol=1e-2)
    np.testing.assert_allclose(found[1], column, atol=1e-2)
    assert found[2].all()
    assert not reference.pixel(0.6 + 1e-7 * 330, 0.2 + 2e-7 * 100)[2]


class TestPlaceOnTerrain:
    """Tie points 16 by 4 pixels (50 by 60 m) apart over relief that is known every 90 m."""

    v = np.array([0.0, 900.0, 7100.0])
    r = ecef(np.radians(36.25), np.radians(-91.0), 0.0) * (1 + 692e3 / 6371e3)

    def seen(self, dem, row, column):
        """Where pixels are on a terrain: 3.3 m of track and 9.4 m of slant range each."""
        r = self.r + row[..., None] * 3.3 * self.v / np.linalg.norm(self.v)
        start = 500.0
        return ground_point_on_terrain(r, self.v, self.near + 9.37 * column, 0.0, dem.at, start)

    def made(self, dem):
        line = ecef(np.radians(36.2), np.radians(-84.3), 500.0) - self.r
        # broadside of the middle
        self.r = self.r + self.v * (self.v @ line) / (self.v @ self.v)
        middle = ecef(np.radians(36.2), np.radians(-84.3), 500.0)
        self.near = float(np.linalg.norm(middle - self.r)) - 9.37 * 100
        rows, columns = np.arange(0.0, 801.0, 16), np.arange(0.0, 201.0, 4)
        p = self.seen(dem, *np.meshgrid(rows, columns, indexing="ij"))
        return Reference(np.ones((801, 201), np.float32), rows, columns, *geodetic(p))

    def errors(self, dem, reference):
        """Across the track, of `place_on` and of `place` [m]."""
        rng = np.random.default_rng(4)
        row, column = rng.uniform(0, 800, 60), rng.uniform(0, 200, 60)
        p = self.seen(dem, row, column)
        axes = track_axes(p, self.v)[:, 1]
        own = [reference.place_on(dem.at, i, j) for i, j in zip(row, column, strict=True)]
        latitude, longitude, _ = reference.place(row, column)
        line = ecef(latitude, longitude, dem.at(latitude, longitude))
        return (np.sum((q - p) * axes, axis=1) for q in (ecef(*np.array(own).T), np.asarray(line)))

    def test_relief_between_tie_points_is_that_of_the_terrain(self):
        """It was meters off, at one place always the same: what moved fixes across the track."""
        dem = read_jacksboro()
        own, line = self.errors(dem, self.made(dem))
        assert np.sqrt(np.mean(line**2)) > 0.8
        assert np.abs(own).max() < 0.05

    def test_tie_points_of_another_kind_are_joined_by_lines(self):
        """Ones that scatter by meters are no view of a terrain."""
        dem = read_jacksboro()
        made = self.made(dem)
        noise = 1e-6 * np.random.default_rng(0).standard_normal(made.latitude.shape)
        rough = Reference(
            *(made.amplitude, made.rows, made.columns, made.latitude + noise),
            *(made.longitude, made.height),
        )
        latitude, longitude, height = rough.place_on(dem.at, 100.7, 50.3)
        expected = [float(x) for x in rough.place(100.7, 50.3)]
        assert (latitude, longitude) == pytest.approx(expected[:2], abs=1e-15)
        assert height == pytest.approx(float(dem.at(*expected[:2])))

    def test_a_map_has_its_pixels_where_they_are_at_any_height(self):
        dem = read_jacksboro()
        rows, columns = np.arange(0.0, 801.0, 16), np.arange(0.0, 201.0, 4)
        i, j = np.meshgrid(rows, columns, indexing="ij")
        latitude, longitude = np.radians(36.2) + 1e-6 * i, np.radians(-84.3) + 2e-6 * j
        made = Reference(
            *(np.ones((801, 201), np.float32), rows, columns),
            *(latitude, longitude, dem.at(latitude, longitude)),
        )
        place = made.place_on(dem.at, 100.7, 50.3)
        assert place[:2] == pytest.approx(np.array(made.place(100.7, 50.3)[:2]), abs=1e-11)
