"""Files of another kind given as echo are named for what they are, with what to do."""

import pickle
import tracemalloc
import zipfile

import cv2
import numpy as np
import pytest
import scipy.io
from l0b_files import beam, codes, write
from netCDF4 import Dataset

from terrafix.models.radar.recordings.files import read_recording

CEOS = b"\0\0\0\1\x32\xc0\x12\x12"


def ceos(samples):
    return CEOS.ljust(400, b" ") + samples.ljust(28) + b"    " + b"\0" * 300


def make(path, kind):
    if kind == "GeoTIFF":
        path.write_bytes(cv2.imencode(".tiff", np.zeros((8, 8), np.uint8))[1].tobytes())
    elif kind in ("HDF5", "RSLC"):
        with Dataset(path, "w") as file:
            group = file.createGroup("science/LSAR/RSLC") if kind == "RSLC" else file
            group.createDimension("x", 4)
            group.createVariable("amplitude", np.float32, ["x"])
    elif kind == "mat":
        scipy.io.savemat(path, {"data": np.zeros(3)}, appendmat=False)
    elif kind == "SAFE":
        with zipfile.ZipFile(path, "w") as made:
            made.writestr("S1A.SAFE/manifest.safe", "<xml/>")
    else:
        path.write_bytes(
            {
                "level 1.1": ceos(b"COMPLEX*8"),
                "other bytes": ceos(b"COMPLEX INTEGER*2"),
                "leader": CEOS.replace(b"\x32", b"\x0b").ljust(720),
                "CPHD": b"CPHD/1.1.0\nXML_BLOCK_SIZE := 3\n",
                "swapped": b"\1\0\0\0\x32\xc0\x12\x12".ljust(720),
                "csv": b"time,i,q\n0.0,1,2\n",
                "empty": b"",
                "pickle": pickle.dumps(np.zeros(3)),
                "lines": bytes(range(256)) * 8,
            }[kind]
        )


@pytest.mark.parametrize(
    ("kind", "named", "cure"),
    [
        ("GeoTIFF", "it is a TIFF (GeoTIFF)", "name the raw echo (level 0)"),
        ("HDF5", "it is HDF5 or NetCDF-4\n  it holds amplitude", "if it holds raw echo, read it"),
        ("RSLC", "a NISAR product 'RSLC': an image, formed already", "name the raw echo"),
        ("mat", "it is a MATLAB file", "recorded_spotlight"),
        ("SAFE", "a zip archive of other files ('S1A.SAFE/manifest.safe')", "first_rg_line"),
        ("level 1.1", "CEOS, a file of lines\n  its samples are COMPLEX*8", "(level 1.1)"),
        ("other bytes", "CEOS, a file of lines\n  its samples are COMPLEX INTEGER*2", "'CI*1'"),
        ("leader", "CEOS, a leader", "name the file with the data"),
        ("CPHD", "it is CPHD, phase history", "recorded_spotlight"),
        ("swapped", "it is CEOS of the other order of bytes", "fetch the original"),
        ("csv", "it is text", "numpy.savez"),
        ("empty", "it is empty", "fetch it again"),
        ("pickle", "it is a pickle", "pickles are not read"),
        ("lines", "damaged, or of a kind that is not known", "first_rg_line"),
    ],
)
@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_a_file_is_named_with_what_to_do(tmp_path, kind, named, cure, suffix):
    path = tmp_path / f"echo.{suffix}"
    make(path, kind)
    with pytest.raises(ValueError, match="is not recorded echo: ") as raised:
        read_recording(path)
    text = str(raised.value)
    assert text.startswith(f"'{path}' is not recorded echo: ")
    assert named in text
    assert cure in text
    assert "allow_pickle" not in text
    assert text.count("\n") <= 4


def test_sizes_that_are_absurd_make_no_room(tmp_path):
    """Headers of 1e9 lines: refused by the bytes that are there, in some kilobytes of memory."""
    path = tmp_path / "a.npz"
    np.savez(path, echo=np.ones((40, 10)), first_rg_line=1, first_rg_cell=1)
    with zipfile.ZipFile(path) as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    parts["echo.npy"] = parts["echo.npy"].replace(b"(40, 10), }        ", b"(1000000000, 10), }")
    with zipfile.ZipFile(path, "w") as torn:
        for name, part in parts.items():
            torn.writestr(name, part)
    hdf5 = tmp_path / "a.h5"
    root = "science/LSAR/RRSD/swaths/frequencyA/txH/rxH"
    with Dataset(hdf5, "w") as file:
        group = file.createGroup(root)
        pair = group.createCompoundType(np.dtype([("r", "u2"), ("i", "u2")]), "pair")
        group.createDimension("lines", 10**9)
        group.createDimension("cells", 2200)
        group.createVariable("HH", pair, ("lines", "cells"), chunksizes=(1, 2200))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"it says shape \(1000000000, 10\) of float64"):
        read_recording(path)
    with pytest.raises(ValueError, match="it says 1000000000 lines of 2200 cells, and has"):
        read_recording(hdf5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6


@pytest.mark.parametrize("form", ["npz", "h5"])
def test_damaged_files_are_refused_or_read(tmp_path, form):
    """Truncated, and with bytes changed at random: a ValueError that names the file, or read."""
    path, rng, told = tmp_path / f"a.{form}", np.random.default_rng(7), []
    if form == "h5":
        write(path, codes(beam(100, 32)))
    else:
        np.savez(path, echo=beam(100, 32), first_rg_line=1, first_rg_cell=1)
    whole = path.read_bytes()
    for k in range(24):
        damaged = bytearray(whole)
        if k % 2:
            del damaged[rng.integers(8, len(whole)) :]
        else:
            for at in rng.integers(8, len(whole), 200):
                damaged[at] = rng.integers(256)
        path.write_bytes(bytes(damaged))
        try:
            read_recording(path)
        except ValueError as error:
            told.append(str(error))
    assert len(told) >= 12
    assert all(text.startswith(f"'{path}' is not recorded echo: ") for text in told)


def test_a_folder_and_nothing_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"is a folder\n  name the file in it"):
        read_recording(tmp_path)
    with pytest.raises(FileNotFoundError, match="is not there"):
        read_recording(tmp_path / "echo.npz")


def test_arrays_have_no_channels(tmp_path):
    np.savez(tmp_path / "a.npz", echo=np.ones((4, 4)), first_rg_line=1, first_rg_cell=1)
    with pytest.raises(ValueError, match="has no channels: 'A/HH' need not be named"):
        read_recording(tmp_path / "a.npz", "A/HH")
