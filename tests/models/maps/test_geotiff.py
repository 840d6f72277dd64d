"""Georeferenced images: where their pixels lie, and what is refused."""

import numpy as np
import pymap3d
import pytest
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from terrafix.models.maps.geotiff import GeoImage, read_geotiff, read_texture

UTM_21, UTM_60, WGS84 = 32621, 32660, 4326


def written(folder, code, origin, spacing, pixels=None, *, point=True):
    """A small GeoTIFF of a projection, with the middle (or the corner) of its first pixel."""
    pixels = np.arange(600, dtype=np.uint16).reshape(20, 30) if pixels is None else pixels
    tags = ImageFileDirectory_v2()
    tags[33550] = (spacing, spacing, 0.0)
    tags[33922] = (0.0, 0.0, 0.0, *origin, 0.0)
    geographic = code == WGS84
    keys = [(1024, 2 if geographic else 1), (1025, 2 if point else 1)]
    keys += [(2048 if geographic else 3072, code)]
    tags[34735] = (1, 1, 0, len(keys), *(w for k, v in keys for w in (k, 0, 1, v)))
    tags.tagtype.update({33550: 12, 33922: 12, 34735: 3})
    file = folder / "map.tif"
    Image.fromarray(pixels).save(file, tiffinfo=tags)
    return file


def test_a_place_has_its_pixel_in_degrees(tmp_path):
    image = read_geotiff(written(tmp_path, WGS84, (-92.0, 39.5), 1e-3))
    column, row = image.pixel(np.radians(39.49), np.radians(-91.98))
    assert (column, row) == (pytest.approx(20.0), pytest.approx(10.0))
    corner = read_geotiff(written(tmp_path, WGS84, (-92.0, 39.5), 1e-3, point=False))
    column, row = corner.pixel(np.radians(39.49), np.radians(-91.98))
    assert (column, row) == (pytest.approx(19.5), pytest.approx(9.5))
    np.testing.assert_array_equal(image.pixels[0], np.arange(30))


@pytest.mark.parametrize("code", [UTM_21, WGS84])
def test_meters_about_a_place_are_those_of_the_ellipsoid(tmp_path, code):
    """200 m to the north-east by pymap3d: the grid says where that is, to a decimeter."""
    origin, spacing = ((694020.0, -2766630.0), 30.0) if code == UTM_21 else ((-55.1, -25.0), 3e-4)
    image = read_geotiff(written(tmp_path, code, origin, spacing))
    latitude, longitude = np.radians(-25.005), np.radians(-55.07)
    there = pymap3d.enu2geodetic(200, 200, 0, latitude, longitude, 0, deg=False)
    moved = np.subtract(image.pixel(*there[:2]), image.pixel(latitude, longitude))
    np.testing.assert_allclose(image.grid(latitude, longitude) @ [200.0, 200.0], moved, atol=0.003)


def test_a_map_without_a_georeference_is_refused(tmp_path):
    file = tmp_path / "plain.tif"
    Image.fromarray(np.ones((8, 8), np.uint8)).save(file)
    with pytest.raises(ValueError, match=r"'.*plain\.tif' has no georeference"):
        read_geotiff(file)
    assert read_texture(file).shape == (8, 8)


def test_a_projection_that_is_not_understood_is_refused(tmp_path):
    with pytest.raises(ValueError, match="in a projection of code 3413; understood are UTM"):
        read_geotiff(written(tmp_path, 3413, (0.0, 0.0), 30.0))


def test_a_date_line_inside_the_map_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"the date line lies inside the map 'map\.tif'"):
        read_geotiff(written(tmp_path, WGS84, (179.99, 10.0), 1e-3))
    read_geotiff(written(tmp_path, WGS84, (179.9, 10.0), 1e-3))
    # zone 60 ends at 180 degrees, 834 km east on the equator
    with pytest.raises(ValueError, match="the date line lies inside"):
        read_geotiff(written(tmp_path, UTM_60, (833_900.0, 0.0), 30.0))
    read_geotiff(written(tmp_path, UTM_60, (800_000.0, 0.0), 30.0))


def test_an_image_that_is_too_large_is_refused(tmp_path, monkeypatch):
    """Of the limit of Pillow, which says that it does not decompress so much."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    with pytest.raises(ValueError, match="is too large\n  cut out the part about the target"):
        read_geotiff(written(tmp_path, WGS84, (-92.0, 39.5), 1e-3))


def test_what_is_no_image_is_refused(tmp_path):
    file = tmp_path / "no.tif"
    file.write_bytes(b"no image")
    with pytest.raises(ValueError, match="is no image that can be read"):
        read_geotiff(file)
    with pytest.raises(FileNotFoundError):
        read_geotiff(tmp_path / "absent.tif")
    color = tmp_path / "color.tif"
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(color)
    with pytest.raises(ValueError, match="no image of one band"):
        read_texture(color)
    with pytest.raises(ValueError, match="no image of one band"):
        GeoImage(np.zeros((2, 2, 3), np.float32), 0.0, 0.0, (1.0, 1.0), 0, "color")
