"""Two-line elements, and where SGP4 puts their satellite.

The state is in the frame TEME, of `terrafix.models.geometry.celestial`. Two-line elements are mean
elements of SGP4 alone: their state errs by about a kilometer at their epoch, and by one to three
more with each day from it in a low orbit.

References
----------
.. [1] D. A. Vallado, P. Crawford, R. Hujsak, T. S. Kelso, "Revisiting Spacetrack Report #3",
       AIAA 2006-6753.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.extras import optional
from terrafix.models.core.timescales import DAY, Instant, tai_from

LENGTH = 69
"""Characters of a line."""

_CENTURY = 57  # two digits of a year from here on are of 1900
_MJD_1900 = 15019  # 31 December 1899


@dataclass(frozen=True)
class TwoLines:
    """Two-line elements.

    Parameters
    ----------
    first, second : str
        The lines.
    """

    first: str
    second: str

    @staticmethod
    def read(text: str) -> TwoLines:
        """Elements of a text of two lines, a line with a name before them or not.

        Raises
        ------
        ValueError
            If it is no such text, or a checksum disagrees.
        """
        lines = [line.rstrip() for line in text.strip().splitlines() if line.strip()]
        if len(lines) == 3:
            del lines[0]
        if len(lines) != 2:
            raise ValueError(
                f"two-line elements have two lines, and a name before them perhaps; got "
                f"{len(lines)}"
            )
        for number, line in zip("12", lines, strict=True):
            if not line.startswith(f"{number} ") or len(line) != LENGTH or not line.isascii():
                raise ValueError(
                    f"line {number} of two-line elements begins with '{number} ' and has {LENGTH} "
                    f"characters; got '{line}', {len(line)} characters"
                )
            total = sum(int(c) if c.isdigit() else c == "-" for c in line[:-1]) % 10
            if str(total) != line[-1]:
                raise ValueError(
                    f"line {number} of the two-line elements is damaged: its checksum is "
                    f"{line[-1]}, that of what it holds is {total}"
                )
        first, second = lines
        if first[2:7] != second[2:7]:
            raise ValueError(
                f"the two lines are of satellites '{first[2:7].strip()}' and "
                f"'{second[2:7].strip()}'"
            )
        return TwoLines(first, second)

    @property
    def epoch(self) -> Instant:
        """When the elements hold.

        Raises
        ------
        ValueError
            If the field cannot be read, or lies where UTC is not known.
        """
        try:
            year, day = int(self.first[18:20]), float(self.first[20:32])
        except ValueError as error:
            raise ValueError(
                f"the two-line elements have the epoch '{self.first[18:32]}', year and day of it"
            ) from error
        year += 1900 if year >= _CENTURY else 2000
        before = _MJD_1900 + 365 * (year - 1900) + (year - 1901) // 4
        whole = int(day)
        return tai_from("UTC", before + whole, (day - whole) * DAY)

    def state(self, instant: Instant) -> tuple[FloatArray, FloatArray]:
        """Position [m] and velocity [m/s], two (3,), in TEME by SGP4.

        Raises
        ------
        ValueError
            If SGP4 does not know where the satellite is: it has decayed, say.
        ImportError
            If the packages of the extra ``truth`` are not installed.
        """
        sgp4 = optional("sgp4.api", "a start from two-line elements")
        satellite: Any = sgp4.Satrec.twoline2rv(self.first, self.second)
        error, r, v = satellite.sgp4_tsince(instant.minus(self.epoch) / 60)
        if error:
            raise ValueError(
                f"SGP4 does not know where the satellite is: {sgp4.SGP4_ERRORS[error]}"
            )
        return 1e3 * np.array(r), 1e3 * np.array(v)
