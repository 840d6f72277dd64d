"""Orbit files SP3-c and SP3-d: positions, or positions and velocities, of many satellites.

References
----------
.. [1] S. Hilla, "The Extended Standard Product 3 Orbit Format (SP3-d)", 2016; (SP3-c), 2010.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from terrafix.models.motion.epochs import scale_named
from terrafix.models.motion.orbits.axes import frame_named
from terrafix.models.motion.orbits.states import States, number, read_text

_POSITION, _VELOCITY = 1e3, 0.1
"""Meters in a kilometer, meters per second in a decimeter per second."""


def read_sp3(path: Path, satellite: str = "") -> States:
    """Read the states of one satellite.

    An epoch at which it has no position (zeros) is left out, and so is one without a velocity in a
    file with velocities.

    Parameters
    ----------
    path : Path
    satellite : str
        As the file has it ("G05", "L51"), where it holds more than one.

    Raises
    ------
    ValueError
        If it is no such file, is truncated, or holds several satellites of which none is named.
    OSError
        If it cannot be read.
    """
    lines = read_text(path, "orbit file (SP3)").splitlines()
    head = lines[0] if lines else ""
    if head[:2] not in ("#c", "#d") or head[2:3] not in ("P", "V"):
        raise ValueError("it does not begin with #cP, #cV, #dP or #dV, as SP3-c and SP3-d do")
    if not any(line.startswith("EOF") for line in lines[-3:]):
        raise ValueError("it does not end with EOF: it is truncated")
    scale = next((line[9:12] for line in lines if line.startswith("%c")), "")
    scale, frame = scale_named(scale), frame_named(head[46:51])
    chosen = _satellite(lines, satellite)
    declared, epochs = head[32:39].strip(), sum(line.startswith("*") for line in lines)
    if declared != str(epochs):
        raise ValueError(f"it holds {epochs} epochs but declares {declared or 'no number'}")
    tags, r, v = _states(lines, chosen)
    if not tags:
        raise ValueError(f"it has no position of '{chosen}'")
    if head[2] == "P":
        return States(tags, scale, frame, np.array(r), None)
    known = [k for k, velocity in enumerate(v) if velocity is not None]
    if not known:
        raise ValueError(f"it is to have velocities, and has none of '{chosen}'")
    return States(
        [tags[k] for k in known],
        scale,
        frame,
        np.array([r[k] for k in known]),
        np.array([v[k] for k in known], np.float64),
    )


def _satellite(lines: list[str], satellite: str) -> str:
    """The satellite that is wanted, as lines have it."""
    held = sorted({line[1:4].replace(" ", "0") for line in lines if line.startswith("P")})
    listed = ", ".join(held)
    if not satellite and len(held) > 1:
        raise ValueError(f"it holds {len(held)} satellites: {listed}\n  name one: satellite = ...")
    if satellite and satellite not in held:
        raise ValueError(f"it holds no satellite '{satellite}', but {listed or 'none'}")
    return satellite or (held[0] if held else "")


def _states(
    lines: list[str], satellite: str
) -> tuple[list[str], list[list[float]], list[list[float] | None]]:
    """Epochs, positions [m] and velocities [m/s] of a satellite."""
    tags: list[str] = []
    r: list[list[float]] = []
    v: list[list[float] | None] = []
    now, known = "", False
    for k, line in enumerate(lines, 1):
        kind = line[:1]
        if kind == "*":
            now, known = _epoch(line, k), False
        elif kind not in ("P", "V") or line[1:4].replace(" ", "0") != satellite:
            continue
        elif not now:
            raise ValueError(f"line {k}: a state before the first epoch")
        else:
            values = _three(line, k)
            if kind == "P":
                known = any(values)
            if not known or not any(values):
                continue
            if kind == "P":
                tags.append(now)
                r.append([x * _POSITION for x in values])
                v.append(None)
            else:
                v[-1] = [x * _VELOCITY for x in values]
    return tags, r, v


def _three(line: str, k: int) -> list[float]:
    return [number(line[a : a + 14].strip(), f"line {k}") for a in (4, 18, 32)]


def _epoch(line: str, k: int) -> str:
    parts = line[1:].split()
    try:
        year, month, day, hour, minute = (int(p) for p in parts[:5])
        whole, _, fraction = parts[5].partition(".")
        return f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{int(whole):02d}." + (
            fraction or "0"
        )
    except (IndexError, ValueError) as error:
        raise ValueError(f"line {k}: '{line}' is no epoch") from error
