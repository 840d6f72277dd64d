"""What components need that know what time it is."""

from __future__ import annotations

from terrafix.cosim.basics.errors import EpochError
from terrafix.cosim.declare.component import Component
from terrafix.models.core.timescales import Instant, parse_epoch


def read_epoch(component: Component, epoch: str | None) -> Instant:
    """The instant of t = 0, of the epoch of the system that a component is part of.

    Raises
    ------
    EpochError
        If there is no epoch, or it cannot be read.
    """
    if epoch is None:
        raise EpochError(
            f"'{component.name}' needs to know what time it is, and the system has no epoch\n"
            '  give it one, at the top of its file: epoch = "2022-09-18T07:49:21.5 UTC"'
        )
    try:
        return parse_epoch(epoch)
    except (ImportError, ValueError) as error:
        raise EpochError(str(error)) from error
