"""Recorded files of a component, one for each of its steps: its parameters `folder` and `files`."""

from __future__ import annotations

import logging
from dataclasses import astuple
from functools import lru_cache
from pathlib import Path

import numpy as np

from terrafix.components.sensors.compiled import row_operations
from terrafix.components.shared import shared_setting
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.models.core.arrays import FloatArray
from terrafix.models.radar.boresight import Boresight
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, Radar
from terrafix.models.radar.doppler import fractional_centroid, unwrapped_centroid
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.recordings.recording import Recording, Sent
from terrafix.models.radar.recordings.slips import Seen, without_slips
from terrafix.models.sensors.effective_velocity import effective_velocity_array

_log = logging.getLogger(__name__)
_MOST_KEPT = 32 * 1024 * 1024
"""Bytes of a file of arrays that is kept in memory between steps."""
_ALIKE = 1e-6
"""How far a setting may be from what a file says, relative to it."""


def read_lines(component: Component, path: Path, *, report: bool = False) -> Recording:
    """Recording in a file of a component; `report` says if lines were lost.

    Lines may have slipped: `in_place` puts them where they belong.
    """
    try:
        lines = _read(path, _channel(component))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"'{component.name}' cannot read its echo: {error}\n"
            f"  set {component.name}.folder and {component.name}.files, or TERRAFIX_DATA to the "
            "folder with the data"
        ) from error
    if report and lines.told():
        _log.warning("'%s' reads '%s': %s", component.name, path.name, lines.told())
    return lines


def in_place(
    component: Component,
    lines: Recording,
    radar: Radar,
    near: float,
    beam: Boresight,
    states: tuple[FloatArray, FloatArray],
) -> Recording:
    """A recording whose lines are where they belong, by what is seen before and after a slip.

    Parameters
    ----------
    component : Component
    lines : Recording
    radar : Radar
    near : float
        Slant range of the first cell [m].
    beam : Boresight
        In the middle of it.
    states : tuple of ndarray, shape (3,)
        Position [m] and velocity [m/s] of the radar then, Earth-fixed.

    Raises
    ------
    ConfigurationError
        If what is seen does not tell how many lines were lost.
    """
    if not lines.slips:
        return lines
    fraction, _ = fractional_centroid(lines.read(0, lines.slips[0]), radar.prf)
    centroid = unwrapped_centroid(fraction, radar.prf, beam.doppler(radar.wavelength))
    velocity = float(effective_velocity_array(*states, beam.point))
    seen = Seen(radar, near, float(centroid), velocity, row_operations())
    try:
        found = without_slips(lines, seen)
    except ValueError as error:
        raise ConfigurationError(
            f"'{component.name}' cannot use '{lines.path}': {lines.slipped()}\n  {error}"
        ) from error
    _log.warning(
        "'%s' found by the echo of '%s' that lines slipped, and put them where they belong: %s",
        *(component.name, lines.path.name, found.told()),
    )
    return found


def sent_by(component: Component) -> Sent | None:
    """What the files of a component say that their radar sends; None if they say nothing.

    Raises
    ------
    ConfigurationError
        If a file cannot be read, or they do not agree.
    """
    paths = recorded_files(component)
    told = [read_lines(component, path).sent for path in paths]
    for path, sent in zip(paths[1:], told[1:], strict=True):
        if (sent is None) != (told[0] is None) or (sent and told[0] and not _alike(sent, told[0])):
            raise ConfigurationError(
                f"'{component.name}' has files of two radars: '{paths[0].name}' says {told[0]}, "
                f"'{path.name}' {sent}\n  give each radar a component of its own"
            )
    return told[0]


def _read(path: Path, channel: str) -> Recording:
    """A recording, looked through once as long as its file stays as it is."""
    if not path.is_file():
        return read_recording(path, channel)
    stat = path.stat()
    # of arrays all are in memory, of other formats none
    if path.suffix == ".npz" and stat.st_size > _MOST_KEPT:
        return read_recording(path, channel, slips=True)
    return _read_once(path, channel, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _read_once(path: Path, channel: str, _changed: int, _size: int) -> Recording:
    return read_recording(path, channel, slips=True)


def _channel(component: Component) -> str:
    channel: str = component.setting("channel")
    return channel


def _alike(one: Sent, other: Sent) -> bool:
    return bool(np.allclose(astuple(one), astuple(other), rtol=_ALIKE, atol=0))


def settled(component: Component, name: str, value: float, told: float | None, unit: str) -> float:
    """A number that a person may set and a file may say: infinite where it is not set.

    Raises
    ------
    ConfigurationError
        If neither says it, or they contradict each other.
    """
    if told is None and np.isinf(value):
        raise ConfigurationError(
            f"the files of '{component.name}' do not say its {name}\n  set {component.name}.{name}"
        )
    if told is None or np.isinf(value):
        return value if told is None else told
    if abs(value - told) > _ALIKE * abs(told):
        raise ConfigurationError(
            f"'{component.name}.{name}' is {value:.12g} {unit}, but its files say {told:.12g} "
            f"{unit}\n  leave it out, or name the files of that radar"
        )
    return told


def near_range(component: Component, lines: Recording, sample_rate: float) -> float:
    """Slant range of the first cell of a recording [m]: of its file, or of the setting `range0`.

    Raises
    ------
    ConfigurationError
        If neither says it, or they contradict each other.
    """
    before = (lines.first_cell - 1) * (SPEED_OF_LIGHT / (2 * sample_rate))
    told = None if lines.near_range is None else lines.near_range - before
    value = float(shared_setting(component, "range0"))
    return settled(component, "range0", value, told, "m") + before


def require_files(component: Component, duration: float) -> list[tuple[float, Path]]:
    """Time and file of every step within a run; ConfigurationError if there are too few."""
    times, paths = steps_within(component.rate, duration), recorded_files(component)
    if len(times) > len(paths):
        raise ConfigurationError(
            f"'{component.name}' steps {len(times)} times within {duration:g} s, but has "
            f"{len(paths)} file{'s' if len(paths) != 1 else ''}\n"
            f"  name one for each step in {component.name}.files, or list fewer times"
        )
    return list(zip(times, paths, strict=False))


def file_of_step(component: Component) -> Path:
    """File of the step that is being taken."""
    paths = recorded_files(component)
    if component.step_index > len(paths):
        raise ConfigurationError(
            f"'{component.name}' has no file for its step {component.step_index}\n"
            f"  name one for each step in {component.name}.files"
        )
    return paths[component.step_index - 1]


def recorded_files(component: Component) -> list[Path]:
    """Files of a component with the parameters `folder` and `files`."""
    folder: Path = component.setting("folder")
    names = component.setting("files").replace(",", " ").split()
    if not names:
        raise ConfigurationError(
            f"'{component.name}' has no file\n  name one for each step in {component.name}.files"
        )
    return [folder / name for name in names]


def steps_within(rate: Rate | None, duration: float) -> list[float]:
    """Times of the steps after t = 0 within a run [s]."""
    if rate is None:
        return []
    if rate.times is not None:
        return [float(t) for t in rate.times if 0 < t <= duration]
    assert rate.period is not None
    first = float(rate.offset) or float(rate.period)
    n = int((duration - first) / float(rate.period) + 1e-9) + 1 if duration >= first else 0
    return [first + k * float(rate.period) for k in range(n)]
