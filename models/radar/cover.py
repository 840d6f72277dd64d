r"""What covers the ground: patterns of fields, streets and shores that any image of a place shows.

Functions of (seed, cell) alone. What has to be rectangular on the ground lies in districts: Voronoi
cells of some 3 km about scattered centers, each with axes of its own, in meters. Lengths are those
of a scene of detail 1; a finer one has them finer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray, Single

COVERS = ("parcels", "texture", "urban", "coast", "causeway", "fields")
"""Kinds of land cover.

parcels: areas with sharp, winding borders; texture: variations alone, without borders and bright
points; urban: blocks of streets, densely strewn with bright points; coast: parcels and the sea;
causeway: a bright, narrow, straight line in the sea; fields: rectangles with sharp borders.
"""

SEA_DB = -13.5
"""Brightness of the sea, relative to the mean of land [dB]."""
CALM = 0.1
"""Strength of the sea's texture, relative to that of land."""
DENSE = 0.004
"""Bright points of a town in a square of a cell's height: their share of cells."""

_DISTRICT = 256
"""Spacing of the centers of districts [cells]."""
_SCATTER = 0.7
"""How far centers are scattered about a square grid, of its spacing."""
STREET_DB = -8.0
"""Brightness of a street, relative to a block [dB]."""
_STREET = 2.0
"""Its width [cells]."""
_BLOCKS = np.array([9.0, 12.0, 15.0])
"""Lengths of a block's sides, street and all [cells]: one of them along each axis of a district."""
BUILT = float(np.mean(1 - _STREET / _BLOCKS)) ** 2
"""Share of a town that is no street."""
_FARM = 54
"""Side of the squares that are divided into fields [cells]."""
_MOST_FIELDS = 4
CROPS = np.array([-1.414, -0.707, 0.0, 0.707, 1.414], np.float32)
"""Brightness of fields, one of five as often as another, in standard deviations."""
_LINES = 540
"""Spacing of causeways from west to east [cells of longitude]."""
_LEAN = np.radians(35.0)
"""Largest angle between a causeway and the meridian, on the map."""
_NARROW, _WIDE = 2.7, 5.4
"""Width of a causeway, least and largest [cells]: 30 and 60 m."""

Words = NDArray[np.uint64]


@dataclass(frozen=True)
class Districts:
    """Which district cells lie in, and where in it.

    Parameters
    ----------
    key : ndarray of uint64, shape (...)
        A number of each district's own.
    x, y : ndarray of float32, shape (...)
        From its center along its axes [cells], as long to the east as to the north.
    """

    key: Words
    x: Single
    y: Single


def words(seed: int, name: str, *parts: NDArray[np.int64] | Words | int) -> Words:
    """A random 64-bit number of every element of some whole numbers (SplitMix64)."""
    start = np.random.SeedSequence([seed & 0xFFFFFFFF, *name.encode()])
    out = np.asarray(start.generate_state(1, np.uint64), np.uint64)
    with np.errstate(over="ignore"):
        for part in parts:
            out = out ^ np.asarray(part).astype(np.uint64)
            out = out + np.uint64(0x9E3779B97F4A7C15)
            out = (out ^ (out >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            out = (out ^ (out >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            out = out ^ (out >> np.uint64(31))
    return out


def unit(random: Words, part: int = 0) -> FloatArray:
    """One of four numbers from 0 to 1 that a random 64-bit number holds, to 2e-5."""
    return np.asarray(((random >> np.uint64(16 * part)) & np.uint64(0xFFFF)) + 0.5) / 65536


def districts(seed: int, rows: range, columns: range, cell: float) -> Districts:
    """Districts of cells in latitude and longitude, shape (len(rows), len(columns)).

    Parameters
    ----------
    seed : int
    rows, columns : range
    cell : float
        Spacing of the cells [rad].
    """
    shape = len(rows), len(columns)
    nearest, which = np.full(shape, np.inf, np.float32), np.zeros(shape, np.int32)
    ci, cj = (
        np.arange(r.start // _DISTRICT - 1, (r.stop - 1) // _DISTRICT + 2) for r in (rows, columns)
    )
    key = words(seed, "districts", ci[:, None], cj[None, :])
    i0, j0 = (
        _DISTRICT * (c + 0.5 + _SCATTER * (unit(key, part) - 0.5))
        for part, c in ((0, ci[:, None]), (1, cj[None, :]))
    )
    narrow = np.cos(i0 * cell)
    for a, b in np.ndindex(key.shape):
        # a cell asks the centers of the nine squares about it: whatever window it is in
        own = tuple(
            slice(max((c - 1) * _DISTRICT - r.start, 0), max((c + 2) * _DISTRICT - r.start, 0))
            for c, r in ((int(ci[a]), rows), (int(cj[b]), columns))
        )
        di, dj = (
            np.asarray(r[s]) - c[a, b]
            for r, s, c in zip((rows, columns), own, (i0, j0), strict=True)
        )
        distance = ((di**2)[:, None] + (narrow[a, b] * dj)[None, :] ** 2).astype(np.float32)
        closer = distance < nearest[own]
        nearest[own][closer] = distance[closer]
        which[own][closer] = a * key.shape[1] + b
    own_i, own_j, own_narrow = (v.ravel()[which] for v in (i0, j0, narrow))
    north = (np.asarray(rows)[:, None] - own_i).astype(np.float32)
    east = ((np.asarray(columns)[None, :] - own_j) * own_narrow).astype(np.float32)
    turn = 0.5 * np.pi * unit(key, 2).ravel()
    c, s = np.cos(turn).astype(np.float32)[which], np.sin(turn).astype(np.float32)[which]
    return Districts(key.ravel()[which], c * east + s * north, c * north - s * east)


def streets(at: Districts) -> tuple[NDArray[np.bool_], Words]:
    """Whether cells are street, and a number of each block's own."""
    block, street = [], np.zeros(at.x.shape, np.bool_)
    for part, x in enumerate((at.x, at.y)):
        length = _BLOCKS[
            ((at.key >> np.uint64(48 + 4 * part)) % np.uint64(len(_BLOCKS))).astype(int)
        ]
        k = np.floor(x / length)
        street |= x - k * length < _STREET
        block.append(k.astype(np.int64))
    return street, words(0, "blocks", at.key, *block)


def fields(at: Districts) -> Words:
    """A number of the own of each field that cells lie in.

    A square of a district is divided along one axis into one to four fields.
    """
    i, j = (np.floor(a / _FARM) for a in (at.y, at.x))
    farm = words(0, "farms", at.key, i.astype(np.int64), j.astype(np.int64))
    number = 1 + (farm % np.uint64(_MOST_FIELDS)).astype(np.int64)
    along = np.where(farm >> np.uint64(63), at.y - _FARM * i, at.x - _FARM * j) / _FARM
    return words(0, "fields", farm, np.floor(along * number).astype(np.int64))


def crops(seed: int, own: Words) -> NDArray[np.int64]:
    """Which of `CROPS` fields or blocks are, by numbers of their own."""
    return np.asarray((words(seed, "crops", own) % np.uint64(len(CROPS))).astype(np.int64))


def causeway(seed: int, rows: range, columns: range, cell: float) -> Single:
    """Share of cells that a causeway covers, shape (len(rows), len(columns)).

    They are straight on the map and lie side by side, so that every image 8 km wide has one.
    """
    lean = (2 * unit(words(seed, "lean", 0))[0] - 1) * _LEAN
    ahead, across = np.tan(lean), np.asarray(columns, np.float64)[None, :]
    u = across + ahead * np.asarray(rows, np.float64)[:, None]
    line = np.rint(u / _LINES).astype(np.int64)
    own = words(seed, "causeways", line)
    width = _NARROW + (_WIDE - _NARROW) * unit(own)
    narrow = np.cos(np.asarray(rows) * cell)[:, None]
    distance = np.abs(u - line * _LINES) / np.hypot(1 / narrow, ahead)
    return np.asarray(np.clip(width / 2 - distance + 0.5, 0.0, 1.0), np.float32)
