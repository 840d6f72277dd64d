"""Recorded files of a component, one for each of its steps: its parameters `folder` and `files`."""

from __future__ import annotations

import logging
from pathlib import Path

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.recordings.recording import Recording

_log = logging.getLogger(__name__)


def read_lines(component: Component, path: Path, *, report: bool = False) -> Recording:
    """Recording in a file of a component; `report` says if lines were lost."""
    try:
        lines = read_recording(path)
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"'{component.name}' cannot read its echo: {error}\n"
            f"  set {component.name}.folder and {component.name}.files, or TERRAFIX_DATA to the "
            "folder with the data"
        ) from error
    if report and lines.told():
        _log.warning("'%s' reads '%s': %s", component.name, path.name, lines.told())
    return lines


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
