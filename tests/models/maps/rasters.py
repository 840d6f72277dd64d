"""Rasters for tests, written by rasterio."""

import numpy as np
import rasterio
from rasterio.transform import Affine

UTM = "EPSG:32617"
ORIGIN = (500_000.0, 4_000_000.0)  # on the central meridian of zone 17, 81 W


def write(path, values, transform, crs=UTM, **profile):
    """Write bands (n, rows, columns), or one (rows, columns)."""
    values = np.asarray(values)
    bands = values if values.ndim == 3 else values[None]
    options = {
        "driver": "GTiff",
        "count": len(bands),
        "height": bands.shape[1],
        "width": bands.shape[2],
        "dtype": bands.dtype,
        "crs": crs,
        "transform": transform,
    }
    tags, mask = profile.pop("tags", {}), profile.pop("mask", None)
    with rasterio.open(path, "w", **(options | profile)) as dataset:
        dataset.write(bands)
        dataset.update_tags(**tags)
        if mask is not None:
            dataset.write_mask(mask)
    return path


def turned(spacing, angle_deg, origin=ORIGIN):
    """A north-up grid turned clockwise about its first corner."""
    return (
        Affine.translation(*origin) @ Affine.rotation(-angle_deg) @ Affine.scale(spacing, -spacing)
    )
