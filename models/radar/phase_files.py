"""One phase history of files of either format that is read: the Gotcha set's (.mat), or CPHD."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from terrafix.models.core.formats import CPHD, kind_of
from terrafix.models.radar.cphd import read_cphd
from terrafix.models.radar.phase_history import PhaseHistory, read_gotcha

_READ = "phase history is a file of the Gotcha set (MATLAB, .mat), or CPHD"


def read_phase_history(paths: Sequence[Path], channel: str = "") -> PhaseHistory:
    """Read files of phase history, one after the other in order of flight.

    Parameters
    ----------
    paths : sequence of Path
        All of the Gotcha set, of the same frequencies, or one of CPHD.
    channel : str
        Which one, where files have several (CPHD).

    Raises
    ------
    FileNotFoundError
        If one is not there.
    ImportError
        If one is CPHD, and the extra ``sar`` is not installed.
    ValueError
        If one is of another kind or damaged, or they do not fit together.
    """
    for path in paths:
        if not path.is_file():
            what = "is a folder" if path.is_dir() else "is not there"
            raise FileNotFoundError(f"'{path}' {what}")
    kinds = [kind_of(path) for path in paths]
    ours = [kind == CPHD for kind, _ in kinds]
    if not any(ours):
        for path, (kind, cure) in zip(paths, kinds, strict=True):
            if kind and "MATLAB" not in kind:
                raise ValueError(f"'{path}' is {kind}\n  {_READ}\n  {cure}")
        if channel:
            raise ValueError(f"'{paths[0]}' has no channels: '{channel}' need not be named")
        return read_gotcha(paths)
    if not all(ours):
        raise ValueError(f"'{paths[0]}' and '{paths[ours.index(not ours[0])]}' are of two formats")
    if len(paths) > 1:
        raise ValueError(
            f"'{paths[0]}' is CPHD, and so are others, each about a reference point of its own\n"
            "  name one"
        )
    return read_cphd(paths[0], channel)
