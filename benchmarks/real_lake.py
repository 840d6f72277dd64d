"""A lake of two sources: its image from one, the catalog from the other.

    python benchmarks/real_lake.py [--members 50] [--case T1]

Mark Twain Lake, Missouri, a reservoir of many arms: what the camera sees is the water of July 2025
(Landsat 9, NDVI below 0.1), what the filter knows is the surface that the Shuttle found flat in
February 2000 (SRTM, 181 m). How far the two outlines differ, and what the difference does to the
position; with what the filter considers of it. Two frames a second over seven seconds, by contours
of 300 m a pixel and through images of 150 m: in coarser ones arms of less than a pixel run together
with land, and are taken for the edges of clouds. Needs both files (TERRAFIX_DATA).
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from contourpy import FillType, contour_generator
from shapely.affinity import affine_transform

import terrafix as tf
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data")) / "dem"
STEP = 0.000269494585235857  # of both grids [deg]
CORNERS = {  # west, north of the first pixel [deg], from the files' own headers
    "mark_twain_ndvi_2025.tif": (-91.94724056911045, 39.58902406573255),
    "mark_twain_srtm_dem.tif": (-91.94709507643658, 39.5891579922956),
}
LATITUDE = np.radians(39.49)
METERS = np.array([111_412.8 * np.cos(LATITUDE) - 93.5 * np.cos(3 * LATITUDE), 111_025.0])
"""Of a degree of longitude and of latitude there [m]."""
HEIGHT = 150.0  # 181 m above the sea, 31 m of geoid below the ellipsoid
TOLERANCE = 30.0  # of the vertices that are left out: a pixel of both sources [m]
ISLAND = 30e3  # smallest that is kept [m^2]
FOCAL = {False: "1828.81 px", True: "3657.62 px"}  # of contours, of images


def largest_lake(file: str) -> Any:
    """Outline of the largest lake, with islands, in meters about 92 W, 39 N."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # tags of GeoTIFF
    values = cv2.imread(str(DATA / file), cv2.IMREAD_UNCHANGED).astype(np.float64)
    water, level = (-values, -0.1) if "ndvi" in file else ((values == 181.0) * 1.0, 0.5)
    west, north = CORNERS[file]
    x = west + STEP * (np.arange(values.shape[1]) + 0.5)
    y = north - STEP * (np.arange(values.shape[0]) + 0.5)
    found = contour_generator(x, y, water, fill_type=FillType.OuterOffset).filled(level, np.inf)
    lakes = []
    for points, offsets in zip(*found, strict=True):
        shore, *islands = (points[a:b] for a, b in pairwise(offsets))
        lakes.append(shapely.Polygon(shore, islands))
    lake = max(lakes, key=lambda p: p.area)
    kx, ky = METERS
    lake = shapely.simplify(affine_transform(lake, [kx, 0, 0, ky, 92 * kx, -39 * ky]), TOLERANCE)
    islands = [r for r in lake.interiors if shapely.Polygon(r).area > ISLAND]
    return shapely.Polygon(lake.exterior, islands)


def write(lake: Any, path: Path) -> None:
    """Write an outline as GeoJSON in degrees."""
    rings = [
        (np.array(r.coords) / METERS + [-92, 39]).tolist() for r in (lake.exterior, *lake.interiors)
    ]
    geometry = {"type": "Polygon", "coordinates": rings}
    path.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": geometry}))


def differences(seen: Any, known: Any) -> dict[str, float]:
    """How far an outline is from another, and what independent vertices would be as far."""
    shore = known.exterior
    at = np.arange(0, shore.length, 20.0)
    points = shapely.line_interpolate_point(shore, at)
    away = shapely.distance(points, seen.boundary)
    away = np.where(shapely.contains(seen, points), away, -away)
    power = np.abs(np.fft.fft(away)) ** 2 / len(away)  # periodic along the shore
    low = np.fft.fftfreq(len(away), 20.0)
    density = 20.0 * power[(np.abs(low) < 1 / 5e3)].mean()  # slower than 5 km [m^3]
    spacing = shore.length / (len(shore.coords) - 1)
    off = np.array(seen.centroid.coords[0]) - np.array(known.centroid.coords[0])
    return {
        "area seen [km^2]": seen.area / 1e6,
        "area known [km^2]": known.area / 1e6,
        "centroid off [m]": float(np.hypot(*off)),
        "median distance [m]": float(np.median(np.abs(away))),
        "rms distance [m]": float(np.sqrt(np.mean(away**2))),
        "equivalent sigma of a vertex [m]": float(np.sqrt(density / spacing)),
    }


def orbit_over(lake: Any) -> dict[str, str]:
    """A circular orbit 550 km high to the north-east, over the lake's middle at t = 3.5 s."""
    longitude, latitude = np.radians(np.array(lake.centroid.coords[0]) / METERS + [-92, 39])
    angle = np.radians(30.0) + EARTH.rotation_rate * 3.5
    up = ecef(latitude, longitude + angle, 0.0)
    up /= np.linalg.norm(up)
    r = (EARTH.radius + 550e3) * up
    east = np.cross([0, 0, 1], up)
    east /= np.linalg.norm(east)
    v = np.sqrt(EARTH.mu / np.linalg.norm(r)) * (0.8 * east + 0.6 * np.cross(up, east))
    pull = -EARTH.mu / np.linalg.norm(r) ** 3 * r
    r0, v0 = r - 3.5 * v + 3.5**2 / 2 * pull, v - 3.5 * pull
    return {"r0_i": f"{r0.tolist()} m", "v0_i": f"{v0.tolist()} m/s"}


def system(
    seen: Path,
    known: Path,
    orbit: dict[str, str],
    case: str,
    *,
    image: bool = False,
    **considered: str,
) -> tf.System:
    """The lake's system with one catalog for the camera and another for the filter."""
    text = (ROOT / "examples" / f"leo_lake{'_image' if image else ''}.toml").read_text()
    for kind in ("orbit_predict", "lake_correct", "orbit_evaluation") if considered else ():
        text = text.replace(f'type = "{kind}"', f'type = "{kind}_considered"')
    for name in ("vertices", "starts", "center", "radius"):
        text = text.replace(f'"lakes.{name} -> camera', f'"water.{name} -> camera')
    owners = '"water.owner -> camera.owner",\n"lakes.owner -> correct.owner",\n'
    text = text.replace("connect = [", "connect = [\n" + owners)
    text += '\n[component.water]\ntype = "lake_catalog"\nfile = "water.geojson"\n'
    file = seen.with_name("system.toml")
    file.write_text(text)
    parts = ("camera", "moments", "correct", "evaluation", *(("imager",) if image else ()))
    settings = [(f"{n}.period", "0.5 s") for n in parts]
    settings += [(f"{n}.period", "0.1 s") for n in ("orbit", "predict")]
    settings += [("lakes.file", str(known)), ("water.file", str(seen)), ("case", case)]
    settings += [(f"{n}.focal", FOCAL[image]) for n in ("camera", "correct")]
    settings += [(f"{n}.height", f"{HEIGHT} m") for n in ("lakes", "water")]
    settings += [(f"orbit.{n}", value) for n, value in orbit.items()]
    settings += [(f"predict.{n}_sigma0", value) for n, value in considered.items()]
    return tf.read_system(file, settings)


def report(what: str, flown: tf.System, members: int) -> None:
    """Fly it, and print errors, sigma and NEES of the position."""
    data = tf.simulate(flown, members=members).dataset
    error = np.linalg.norm(data["evaluation.position_error"].values[-1], axis=1) / 1e3
    sigma = np.linalg.norm(data["evaluation.position_sigma"].values[-1], axis=1).mean() / 1e3
    nees, nis = (data[f"evaluation.{n}"].values for n in ("nees", "nis"))
    print(
        f"{what:54s} median {np.nanmedian(error):7.3f}  90 % {np.nanpercentile(error, 90):7.3f} km"
        f"  sigma {sigma:6.3f}  NEES {np.nanmean(nees[-1]):9.3g}  NIS {np.nanmean(nis):8.3g}",
        flush=True,
    )


def main() -> None:
    """Print how far the outlines differ, and what that does."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--members", type=int, default=50)
    parser.add_argument("--case", default="T1")
    options = parser.parse_args()
    seen, known = (largest_lake(f) for f in CORNERS)
    apart = differences(seen, known)
    for name, value in apart.items():
        print(f"{name:34s} {value:9.3f}")
    with tempfile.TemporaryDirectory() as folder:
        water, map_of = Path(folder, "water.geojson"), Path(folder, "map.geojson")
        write(seen, water)
        write(known, map_of)
        orbit, case = orbit_over(seen), options.case
        vertex = f"{apart['equivalent sigma of a vertex [m]']} m"
        scale = str(abs(np.sqrt(seen.area / known.area) - 1))
        for image in (False, True):
            by = f"{case}, by {'images' if image else 'contours'}, "
            for what, catalog, considered in (
                ("its own outline", water, {}),
                ("the other's", map_of, {}),
                ("the other's, scale considered", map_of, {"scale": scale}),
                ("the other's, vertices considered", map_of, {"outline": vertex}),
            ):
                flown = system(water, catalog, orbit, case, image=image, **considered)
                report(by + what, flown, options.members)


if __name__ == "__main__":
    main()
