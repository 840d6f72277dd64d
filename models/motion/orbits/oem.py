"""Orbit ephemeris messages (OEM) of CCSDS: key and value notation, or XML.

References
----------
.. [1] CCSDS 502.0-B-3, "Orbit Data Messages", 2023, section 5; 505.0-B-3, "XML Specification for
       Navigation Data Messages".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from terrafix.models.motion.epochs import read_tags, scale_named
from terrafix.models.motion.orbits.axes import frame_named
from terrafix.models.motion.orbits.states import States, number, read_text

_AXES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
_NEEDED = ("CENTER_NAME", "REF_FRAME", "TIME_SYSTEM")
_BOUNDS = ("STOP_TIME", "USEABLE_START_TIME", "USEABLE_STOP_TIME")
_ROUNDING = np.timedelta64(1, "ms")
"""Of the bounds of a segment, against its states."""


@dataclass
class _Segment:
    """Metadata and lines of one part of a message."""

    meta: dict[str, str] = field(default_factory=dict)
    tags: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)


def read_oem(path: Path, satellite: str = "") -> States:
    """Read an orbit ephemeris message.

    Parameters
    ----------
    path : Path
    satellite : str
        Name or number of the object, where the message holds more than one.

    Raises
    ------
    ValueError
        If it is no such message, is truncated, mixes time scales or frames, or holds several
        objects of which none is named.
    OSError
        If it cannot be read.
    """
    text = read_text(path, "orbit ephemeris message (OEM)")
    segments = _of_xml(text) if text.lstrip().startswith("<") else _of_keys(text)
    if not segments:
        raise ValueError("it holds no segment")
    chosen = _of_object(segments, satellite)
    return _joined([_complete(segment, k) for k, segment in enumerate(chosen, 1)])


def _of_object(segments: list[_Segment], satellite: str) -> list[_Segment]:
    """Segments of one object."""
    names = [(s.meta.get("OBJECT_NAME", ""), s.meta.get("OBJECT_ID", "")) for s in segments]
    objects = sorted(set(names))
    listed = ", ".join(f"{a} ({b})" for a, b in objects)
    if not satellite:
        if len(objects) > 1:
            raise ValueError(f"it holds several objects: {listed}\n  name one: satellite = ...")
        return segments
    chosen = [s for s, name in zip(segments, names, strict=True) if satellite in name]
    if not chosen:
        raise ValueError(f"it holds no object '{satellite}', but {listed}")
    return chosen


def _joined(segments: list[_Segment]) -> States:
    """States of all segments, one after the other."""
    scale = _one([scale_named(s.meta["TIME_SYSTEM"]) for s in segments], "time scales")
    frame = _one([frame_named(s.meta["REF_FRAME"]) for s in segments], "frames")
    tags: list[str] = []
    rows: list[list[float]] = []
    ends: list[int] = []
    for segment in segments:
        tags += segment.tags
        rows += segment.rows
        ends.append(len(tags) - 1)
    states = np.array(rows, np.float64) * 1e3
    return States(tags, scale, frame, states[:, :3], states[:, 3:6], tuple(ends))


def _one(found: list[str], what: str) -> str:
    """What all segments have in common."""
    if len(set(found)) > 1:
        raise ValueError(f"it mixes {what}: {', '.join(sorted(set(found)))}\n  use a file with one")
    return found[0]


def _complete(segment: _Segment, place: int) -> _Segment:
    """A segment that has what it must, without the states that are not to be used.

    Raises
    ------
    ValueError
        If something is missing.
    """
    meta = segment.meta
    missing = [n for n in _NEEDED if n not in meta]
    if missing:
        raise ValueError(f"segment {place} has no {missing[0]}")
    if meta["CENTER_NAME"].upper() != "EARTH":
        raise ValueError(f"its center is '{meta['CENTER_NAME']}', read is EARTH")
    if not segment.tags:
        raise ValueError(f"segment {place} has no states; is it truncated?")
    scale = scale_named(meta["TIME_SYSTEM"])
    tags, _ = read_tags(segment.tags, scale)
    bounds = {k: read_tags([meta[k]], scale)[0][0] for k in _BOUNDS if k in meta}
    stop = bounds.get("STOP_TIME", tags.max())
    if tags.max() < stop - _ROUNDING:
        raise ValueError(
            f"segment {place} ends with the state of {segment.tags[-1]}, its STOP_TIME is "
            f"{meta['STOP_TIME']}: it is truncated"
        )
    first = bounds.get("USEABLE_START_TIME", tags.min()) - _ROUNDING
    last = bounds.get("USEABLE_STOP_TIME", tags.max()) + _ROUNDING
    kept = np.flatnonzero((tags >= first) & (tags <= last))
    return _Segment(meta, [segment.tags[k] for k in kept], [segment.rows[k] for k in kept])


def _of_keys(text: str) -> list[_Segment]:
    """Segments of a message in key and value notation."""
    lines = [(k, line.strip()) for k, line in enumerate(text.splitlines(), 1)]
    lines = [(k, x) for k, x in lines if x and x.split(maxsplit=1)[0] != "COMMENT"]
    if not lines or not lines[0][1].startswith("CCSDS_OEM_VERS"):
        raise ValueError("it does not begin with CCSDS_OEM_VERS, as such a message does")
    segments: list[_Segment] = []
    within = ""
    for k, line in lines[1:]:
        start, stop = line.removesuffix("_START"), line.removesuffix("_STOP")
        if line in ("META_START", "COVARIANCE_START"):
            if within:
                raise ValueError(f"line {k}: {line} within {within}")
            within = start
            if start == "META":
                segments.append(_Segment())
        elif line in ("META_STOP", "COVARIANCE_STOP"):
            if within != stop:
                raise ValueError(f"line {k}: {line} without its {stop}_START")
            within = ""
        elif within == "META":
            key, equals, value = line.partition("=")
            if not equals:
                raise ValueError(f"line {k}: '{line}' is no key = value")
            segments[-1].meta[key.strip()] = value.strip()
        elif segments and not within:
            tag, *values = line.split()
            _add(segments[-1], tag, values, f"line {k}")
    if within:
        raise ValueError(f"it ends within {within}: it is truncated")
    return segments


def _add(segment: _Segment, tag: str, values: list[str], where: str) -> None:
    if len(values) not in (6, 9):
        raise ValueError(
            f"{where} has {len(values)} numbers after its epoch, a state has 6, or 9 with its "
            "acceleration"
        )
    segment.tags.append(tag)
    segment.rows.append([number(value, where) for value in values[:6]])


def _of_xml(text: str) -> list[_Segment]:
    """Segments of a message in XML."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares a document type, which no orbit file does")
    try:
        root = ET.fromstring(text.lstrip())
    except ET.ParseError as error:
        raise ValueError(f"damaged or truncated: {error}") from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    message = root if root.tag == "oem" else root.find(".//oem")
    if message is None:
        raise ValueError(f"it is XML of '{root.tag}', no orbit ephemeris message (OEM)")
    segments = []
    for part in message.iter("segment"):
        meta = {e.tag: (e.text or "").strip() for e in part.iterfind("metadata/*")}
        segments.append(_Segment(meta))
        for k, vector in enumerate(part.iterfind("data/stateVector")):
            where = f"state vector {k}"
            values = [_value(vector, axis, where) for axis in _AXES]
            _add(segments[-1], vector.findtext("EPOCH", ""), values, where)
    return segments


def _value(vector: ET.Element, axis: str, where: str) -> str:
    found = vector.find(axis)
    if found is None:
        raise ValueError(f"{where} has no {axis}")
    unit = "km/s" if axis.endswith("_DOT") else "km"
    if found.get("units", unit) != unit:
        raise ValueError(f"{where} has {axis} in '{found.get('units')}', not '{unit}'")
    return found.text or ""
