"""What components need that know what time it is."""

from __future__ import annotations

from terrafix.cosim.basics.errors import EpochError
from terrafix.cosim.declare.component import Component, Environment
from terrafix.models.core.timescales import Instant, parse_epoch


class Dated(Component):
    """Base of components that publish, now and then, what the date says; `_publish(t)` does it."""

    _start: Instant | None = None

    def bind(self, environment: Environment) -> None:
        """Read the epoch."""
        super().bind(environment)
        self._start = read_epoch(self, environment.epoch)

    def _now(self, t: float) -> Instant:
        assert self._start is not None
        return self._start.plus(t)

    def _initialize_impl(self) -> None:
        self._publish(0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self._publish(t)

    def _publish(self, t: float) -> None:
        raise NotImplementedError(f"{type(self).__name__} must provide _publish(t)")


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
