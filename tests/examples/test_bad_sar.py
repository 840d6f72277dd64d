"""Bad input of the closed loop of images: one clear message before anything is flown."""

from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.cosim.files.readers import read_system
from terrafix.models.images.reference import Reference, write_reference
from terrafix.models.maps.dem import Dem, write_dem

EXAMPLES = Path(__file__).parents[2] / "examples"
SYSTEM = EXAMPLES / "spacecraft_sar_closed_loop.toml"


def said(*settings, file=SYSTEM):
    with pytest.raises(SystemCheckError) as raised:
        read_system(file, settings).check()
    text = str(raised.value)
    assert "1 problem" in text
    assert "Traceback" not in text
    return text


def tile(folder, height):
    file = folder / "tile.npz"
    write_dem(Dem(np.asarray(height, np.float32), 0.5, -1.7, 1e-4, 1e-4), file)
    return (
        ("terrain.source", "file"),
        ("terrain.mirrored", "false"),
        ("terrain.dem_file", str(file)),
    )


def test_heights_that_the_earth_has_not(tmp_path):
    text = said(*tile(tmp_path, np.full((4, 4), 1e9)))
    assert "16 of its 16 heights are beyond -12000 to 9000 m, the first is 1e+09 m" in text


def test_a_void_that_is_to_be_mirrored(tmp_path):
    height = np.full((4, 4), 100.0)
    height[1, 2] = -9999.0
    text = said(*tile(tmp_path, height), ("terrain.mirrored", "true"))
    assert "of which 1 points are void" in text
    assert "terrain.fill_voids = true" in text


def with_reference(folder, amplitude):
    """The system with a reference from a file, of 40 x 60 pixels."""
    ties = np.array([0.0, 20.0, 39.0]), np.array([0.0, 30.0, 59.0])
    places = np.meshgrid(0.53 + ties[0] * 1e-6, -1.67 + ties[1] * 1e-6, indexing="ij")
    file = folder / "reference.npz"
    write_reference(Reference(amplitude.astype(np.float32), *ties, *places, np.zeros((3, 3))), file)
    head, rest = SYSTEM.read_text().split("[component.reference]\n")
    _, tail = rest.split("\n\n", 1)
    table = (
        f'type = "reference_file"\ntimes = ["8.2 s"]\nfolder = "{folder}"\nfiles = "{file.name}"'
    )
    lines = f"{head}[component.reference]\n{table}\n\n{tail}".splitlines()
    written = folder / "system.toml"
    written.write_text("\n".join(line for line in lines if "-> reference." not in line))
    return written


def test_a_reference_that_holds_no_amplitudes(tmp_path):
    """It was found when the first image was matched."""
    amplitude = np.ones((40, 60))
    amplitude[3, 4] = -1.0
    text = said(file=with_reference(tmp_path, amplitude))
    assert "reference.npz': an amplitude cannot be negative" in text
    assert "set reference.folder and reference.files" in text


def test_a_reference_that_is_one_is_taken(tmp_path):
    system = read_system(with_reference(tmp_path, np.ones((40, 60))))
    assert system.check().order
