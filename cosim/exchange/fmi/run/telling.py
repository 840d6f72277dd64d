"""What FMUs say: their log, with member and time; members that failed, or ended their run."""

from __future__ import annotations

import logging

import numpy as np

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Parameter, Setting
from terrafix.cosim.declare.settling import Settling
from terrafix.cosim.exchange.fmi.run.binding import STATUS
from terrafix.cosim.exchange.fmi.run.fleet import Ended, Failures
from terrafix.cosim.exchange.fmi.run.places import AnyFleet

_log = logging.getLogger(__name__)
MOST_LOGGED = 20
"""Warnings of one component that are shown."""


class Telling(Settling):
    """Base of components that run FMUs."""

    _t = 0.0
    _logged = 0

    def refuse_attributes(self) -> None:
        """Refuse parameters of FMUs that were assigned as attributes."""
        for name in self._found_settings.keys() & self.__dict__.keys():
            raise ConfigurationError(
                f"'{self.name}.{name}' was assigned as an attribute, which sets nothing\n"
                f'  write set_parameter("{name}", ...)'
            )

    def is_handed_on(self, name: str, setting: Setting[object]) -> bool:
        """Whether a parameter was set, or members have values of their own of it."""
        if name in self.given_parameters:
            return True
        if not isinstance(setting, Parameter) or name not in self.parameter_values:
            return False
        return bool(np.any(self.parameter_values[name] != setting.default))

    def _tell(self, fleet: AnyFleet, failures: Failures, part: str = "") -> None:
        """Show what a fleet logged, and report failures; `part` names one FMU of several."""
        for row, status, text in fleet.take_log():
            if text not in failures.get(row, ""):  # which a failure quotes
                self._show(row, status, text, part)
        for row, said in failures.items():
            mask = np.zeros(self.n_members, dtype=np.bool_)
            mask[row] = True
            end = self.end_run if isinstance(said, Ended) else self.fail
            end(mask, f"'{part}': {said}" if part else said)

    def _show(self, row: int, status: int, text: str, part: str) -> None:
        level = logging.WARNING if status > 0 else logging.INFO
        path = f"{self.environment.path}.{part}" if part else self.environment.path
        if level == logging.WARNING:
            self._logged += 1
            if self._logged > MOST_LOGGED:
                return
        what = STATUS[status] if 0 <= status < len(STATUS) else f"status {status}"
        member = self.environment.members[row]
        _log.log(level, "'%s', member %d, t = %.9g s: %s: %s", path, member, self._t, what, text)
        if level == logging.WARNING and self._logged == MOST_LOGGED:
            _log.warning("'%s': further messages of this FMU are not shown", path)
