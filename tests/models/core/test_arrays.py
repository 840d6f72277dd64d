"""Files of arrays, and every other kind of file in their place: what it is, and what to do."""

import gzip
import io
import pickle
import zipfile

import cv2
import numpy as np
import pytest
import scipy.io
import xarray

from terrafix.models.core.arrays import read_arrays
from terrafix.models.images.reference import read_reference
from terrafix.models.maps.dem import read_dem
from terrafix.models.motion.ephemeris import read_eof
from terrafix.models.radar.recordings.files import read_recording

VALUES = np.arange(12.0).reshape(3, 4)
WHAT = {
    "tiff": ("a TIFF (GeoTIFF)", "read it with GDAL or rasterio"),
    "netcdf4": ("HDF5 or NetCDF-4", "read it with h5py or xarray"),
    "netcdf3": ("NetCDF", "read it with xarray"),
    "mat": ("a MATLAB file", "read it with scipy.io.loadmat"),
    "mat73": ("a MATLAB file, 7.3", "read it with h5py"),
    "npy": ("one array of NumPy (.npy) without a name", "numpy.savez, by name"),
    "pickle": ("a pickle", "pickles are not read"),
    "gzip": ("gzip", "unpack it"),
    "png": ("a picture (PNG)", "read it with an imaging library"),
    "text": ("text", "read it with numpy.loadtxt"),
    "xml": ("XML", "name the file with the data"),
    "empty": ("empty", "name the file that is meant"),
    "lfs": ("a pointer of Git LFS, not the data", "git lfs pull"),
}


def write(path, kind):
    """A file of a kind, as the tools of that kind write it."""
    if kind in ("tiff", "png"):
        suffix = f".{kind}"
        path.write_bytes(cv2.imencode(suffix, VALUES.astype(np.uint8))[1].tobytes())
    elif kind.startswith("netcdf"):
        dataset = xarray.Dataset({"height_m": (("y", "x"), VALUES)})
        form = "NETCDF4" if kind == "netcdf4" else "NETCDF3_64BIT"
        engine = "netcdf4" if kind == "netcdf4" else "scipy"
        dataset.to_netcdf(path, format=form, engine=engine)
    elif kind == "mat":
        scipy.io.savemat(path, {"height_m": VALUES}, appendmat=False)
    elif kind == "npy":
        with path.open("wb") as file:
            np.save(file, VALUES)
    else:
        path.write_bytes(
            {
                "mat73": b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512)
                + b"\x89HDF\r\n\x1a\n",
                "pickle": pickle.dumps({"height_m": VALUES}),
                "gzip": gzip.compress(b"data"),
                "text": b"1.0, 2.0\n3.0, 4.0\n",
                "xml": b"<?xml version='1.0'?><product/>",
                "empty": b"",
                "lfs": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n",
            }[kind]
        )


@pytest.mark.parametrize("kind", WHAT)
@pytest.mark.parametrize("read", [read_reference, read_recording, read_dem])
def test_a_file_of_another_kind_is_named_with_what_to_do(tmp_path, kind, read):
    path = tmp_path / "data.npz"
    write(path, kind)
    with pytest.raises(ValueError, match="is not ") as raised:
        read(path)
    text, (what, cure) = str(raised.value), WHAT[kind]
    assert str(path) in text
    assert f"it is {what}\n" in text
    assert cure in text
    assert "is a file of NumPy (.npz) with the arrays " in text
    assert "pickle=" not in text
    assert "allow_pickle" not in text


@pytest.mark.parametrize("kind", WHAT)
@pytest.mark.parametrize("name", ["data.tif", "N44W072.hgt"])
def test_an_elevation_model_of_another_kind_is_named(tmp_path, kind, name):
    write(tmp_path / name, kind)
    with pytest.raises(ValueError, match=r"elevation model|tile of SRTM") as raised:
        read_dem(tmp_path / name)
    assert all(part in str(raised.value) for part in WHAT[kind])


@pytest.mark.parametrize("kind", ["gzip", "tiff", "netcdf4", "pickle"])
def test_an_orbit_file_of_another_kind_is_named(tmp_path, kind):
    write(tmp_path / "orbit.EOF", kind)
    with pytest.raises(ValueError, match="no orbit file") as raised:
        read_eof(tmp_path / "orbit.EOF")
    assert all(part in str(raised.value) for part in WHAT[kind])


def archive(**entries):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as made:
        for name, content in entries.items():
            made.writestr(name.replace("_", "."), content)
    return buffer.getvalue()


def test_archives_that_are_no_arrays_are_refused(tmp_path):
    path = tmp_path / "data.npz"
    path.write_bytes(archive(readme_txt=b"hello"))
    with pytest.raises(ValueError, match=r"a zip archive of other files \('readme.txt'\)"):
        read_arrays(path, ["a"], "a thing")
    np.savez(path, a=np.array([[1.0], [1.0, 2.0]], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="its 'a' holds Python objects") as raised:
        read_arrays(path, ["a"], "a thing")
    assert "allow_pickle" not in str(raised.value)
    np.savez(path, a=np.array(["12 m"]))
    with pytest.raises(ValueError, match="its 'a' holds <U4, not numbers"):
        read_arrays(path, ["a"], "a thing")
    path.write_bytes(b"\x01\x02\xff\xfe\x00" * 50)
    with pytest.raises(ValueError, match="damaged, or of a kind that is not known") as raised:
        read_arrays(path, ["a"], "a thing")
    assert "allow_pickle" not in str(raised.value)


def test_a_torn_archive_is_damaged(tmp_path):
    path = tmp_path / "data.npz"
    np.savez_compressed(path, a=np.random.default_rng(0).random(1000))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="it is damaged"):
        read_arrays(path, ["a"], "a thing")
    path.write_bytes(whole[:3000] + b"\0" * 200 + whole[3200:])
    with pytest.raises(ValueError, match="it is damaged"):
        read_arrays(path, ["a"], "a thing")


@pytest.mark.parametrize(
    "name",
    [
        "dem/mark_twain_srtm_dem.tif",
        "alos_palsar/calib_RSLC_ALPSRP025826990_RIO_BRANCO_CR.h5",
        "afrl_gotcha/data_3dsar_pass1_az001_HH.mat",
        "lakes_gshhg/seneca_high.csv",
    ],
)
def test_real_files_of_other_kinds_are_named(data_folder, name):
    path = data_folder / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    what = {".tif": "TIFF (GeoTIFF)", ".h5": "HDF5", ".mat": "MATLAB", ".csv": "text"}[path.suffix]
    for read in (read_reference, read_recording, read_dem):
        with pytest.raises(ValueError, match="is n") as raised:
            read(path)
        assert f" {what}" in str(raised.value)
        assert "numpy.savez" in str(raised.value)
