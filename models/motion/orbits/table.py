r"""Tables of states (.csv).

The first lines may be remarks, after ``#``; one of them names the frame. The next line names the
columns with their units: the epoch by its time scale (``utc``, ``gps``, ``tai`` or ``tt``), ``x``,
``y``, ``z`` in m or km, and where they are known ``vx``, ``vy``, ``vz`` in m/s or km/s, in any
order; other columns are not read::

    # frame: ITRF
    gps,x [km],y [km],z [km],vx [km/s],vy [km/s],vz [km/s]
    2022-09-18T05:32:13.470319,-4421.8,3525.1,4208.6,4.47,-1.23,5.81
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from terrafix.models.motion.epochs import SCALES
from terrafix.models.motion.orbits.axes import frame_named
from terrafix.models.motion.orbits.states import States, number, read_text

_POSITION, _VELOCITY = ("x", "y", "z"), ("vx", "vy", "vz")
_UNITS = {
    **{name: {"m": 1.0, "km": 1e3} for name in _POSITION},
    **{name: {"m/s": 1.0, "km/s": 1e3} for name in _VELOCITY},
}
_COLUMN = re.compile(r"(\w+)\s*(?:\[\s*(.*?)\s*\])?")


def read_table(path: Path) -> States:
    """Read a table of states (.csv).

    Raises
    ------
    ValueError
        If it is no such table, names no frame, or has epochs of more than one time scale.
    OSError
        If it cannot be read.
    """
    lines = read_text(path, "table of states (.csv)").splitlines()
    remarks = [line.lstrip("# ") for line in lines if line.startswith("#")]
    rows = [(k, line) for k, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not rows:
        raise ValueError("it has no line that names its columns")
    frames = [r.partition(":")[2] for r in remarks if r.lower().startswith("frame:")]
    if len(frames) != 1:
        raise ValueError(
            f"it names {len(frames) or 'no'} frame{'s' * (len(frames) > 1)}\n"
            "  its first line says which: # frame: ITRF"
        )
    columns = _columns(next(csv.reader([rows[0][1]])))
    scale = _scale(columns)
    wanted = [n for n in (*_POSITION, *_VELOCITY) if n in columns]
    tags, states = [], []
    for k, line in rows[1:]:
        cells = next(csv.reader([line]))
        if len(cells) != len(columns):
            raise ValueError(f"line {k} has {len(cells)} cells, its columns are {len(columns)}")
        told = dict(zip(columns, cells, strict=True))
        tags.append(told[scale.lower()])
        states.append([number(told[n], f"line {k}, {n},") * columns[n] for n in wanted])
    values = np.array(states, np.float64).reshape(len(tags), len(wanted))
    velocities = values[:, 3:] if len(wanted) == len(_UNITS) else None
    return States(tags, scale, frame_named(frames[0]), values[:, :3], velocities)


def _columns(header: list[str]) -> dict[str, float]:
    """Names of columns, and what their numbers are multiplied by."""
    columns: dict[str, float] = {}
    for cell in header:
        found = _COLUMN.fullmatch(cell.strip())
        name, unit = (found[1].lower(), found[2]) if found else (cell.strip(), None)
        if name in columns:
            raise ValueError(f"it has two columns '{name}'")
        units = _UNITS.get(name)
        if units is not None and unit not in units:
            raise ValueError(
                f"its column '{cell.strip()}' has {f'the unit {unit!r}' if unit else 'no unit'}\n"
                f"  write {' or '.join(f'{name} [{u}]' for u in units)}"
            )
        columns[name] = 1.0 if units is None or unit is None else units[unit]
    for group in (_POSITION, _VELOCITY):
        missing = [n for n in group if n not in columns]
        if missing and (group == _POSITION or len(missing) < len(group)):
            raise ValueError(f"it has no column '{missing[0]}'; it has {', '.join(columns)}")
    return columns


def _scale(columns: dict[str, float]) -> str:
    """Time scale of the column of epochs."""
    scales = [s for s in SCALES if s.lower() in columns]
    if len(scales) > 1:
        raise ValueError(f"it mixes time scales: {', '.join(scales)}\n  leave one of the columns")
    if not scales:
        raise ValueError(
            f"it has no column of epochs, named {', '.join(s.lower() for s in SCALES)} by their "
            "time scale"
        )
    return scales[0]
