"""What a file is by its first bytes, for errors about files of the wrong kind."""

from __future__ import annotations

from pathlib import Path

ARCHIVE = "a zip archive"
"""What a file of named arrays (.npz) is, too."""
HDF5 = "HDF5 or NetCDF-4"
CEOS_DATA = "CEOS, a file of lines"
CPHD = "CPHD, phase history"
CEOS_LEADER = "CEOS, a leader"
_NUMPY = "write its arrays with numpy.savez"
_KINDS = (
    (b"II*\0", "a TIFF (GeoTIFF)", f"read it with GDAL or rasterio, and {_NUMPY}"),
    (b"MM\0*", "a TIFF (GeoTIFF)", f"read it with GDAL or rasterio, and {_NUMPY}"),
    (b"II+\0", "a big TIFF (GeoTIFF)", f"read it with GDAL or rasterio, and {_NUMPY}"),
    (b"\x89HDF\r\n\x1a\n", HDF5, f"read it with h5py or xarray, and {_NUMPY}"),
    (b"\0\0\0\1\x32\xc0\x12\x12", CEOS_DATA, f"read it with GDAL, and {_NUMPY}"),
    (b"\0\0\0\1\x0b\xc0\x12\x12", CEOS_LEADER, "name the file with the data"),
    (b"\0\0\0\1\x3f\xc0\x12\x12", "CEOS, a trailer", "name the file with the data"),
    (b"\0\0\0\1\xc0\xc0\x12\x12", "CEOS, a volume directory", "name the file with the data"),
    (b"\1\0\0\0\x32\xc0\x12\x12", "CEOS of the other order of bytes", "fetch the original"),
    (b"CPHD/", CPHD, "name it in 'recorded_spotlight'"),
    (b"CDF", "NetCDF", f"read it with xarray, and {_NUMPY}"),
    (b"MATLAB 7.3", "a MATLAB file, 7.3", f"read it with h5py, and {_NUMPY}"),
    (b"MATLAB", "a MATLAB file", f"read it with scipy.io.loadmat, and {_NUMPY}"),
    (b"\x93NUMPY", "one array of NumPy (.npy) without a name", _NUMPY + ", by name"),
    (b"PK\x03\x04", ARCHIVE, "unpack it, and name the file that is meant"),
    (b"PK\x05\x06", "an empty zip archive", "name the file that is meant"),
    (b"\x1f\x8b", "gzip", "unpack it, and name the file that is meant"),
    (b"BZh", "bzip2", "unpack it, and name the file that is meant"),
    (b"\xfd7zXZ", "xz", "unpack it, and name the file that is meant"),
    (b"\x80\x02", "a pickle", f"have whoever made it {_NUMPY}: pickles are not read"),
    (b"\x80\x03", "a pickle", f"have whoever made it {_NUMPY}: pickles are not read"),
    (b"\x80\x04", "a pickle", f"have whoever made it {_NUMPY}: pickles are not read"),
    (b"\x80\x05", "a pickle", f"have whoever made it {_NUMPY}: pickles are not read"),
    (b"\x89PNG", "a picture (PNG)", f"read it with an imaging library, and {_NUMPY}"),
    (b"\xff\xd8\xff", "a picture (JPEG)", f"read it with an imaging library, and {_NUMPY}"),
    (b"\0\0\0\x0cjP", "JPEG 2000", f"read it with GDAL or rasterio, and {_NUMPY}"),
    (b"%PDF", "a PDF", "name the file that is meant"),
    (b"SQLite format 3\0", "SQLite (a GeoPackage)", f"read it with GDAL, and {_NUMPY}"),
    (b"<?xml", "XML", "name the file with the data, which it may only describe"),
)
"""First bytes, what begins with them, and what to do with it."""
_POINTER = b"version https://git-lfs"


def kind_of(path: Path) -> tuple[str, str]:
    """What a file is, and what to do with it; empty texts where it is not known.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    if not head:
        return "empty", "name the file that is meant, or fetch it again"
    if head.startswith(_POINTER):
        return "a pointer of Git LFS, not the data", "fetch the data: git lfs pull"
    for start, what, cure in _KINDS:
        if head.startswith(start):
            return what, cure
    text = all(byte in b"\t\n\r\f" or 32 <= byte < 127 for byte in head)
    return ("text", f"read it with numpy.loadtxt, and {_NUMPY}") if text else ("", "")
