"""Files of CEOS: records, each of which begins with its kind and its length.

Bytes of a record are counted from 1, as descriptions of the format do. Numbers are spelled as text
but for those of lines of samples, which are binary, their highest byte first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

Kind = tuple[int, int, int, int]
"""Four codes of a record."""

HEADER = 12
"""Bytes of a record that say its number, its kind and its length."""
_LONGEST = 2**24
"""Bytes of a record that is read whole."""
_MOST = 1000
"""Records of a file that are looked through."""


@dataclass(frozen=True)
class Record:
    """A record.

    Parameters
    ----------
    content : bytes
        Of all of it, its header included.
    what : str
        For messages.
    """

    content: bytes
    what: str

    def text(self, first: int, last: int) -> str:
        """Text of its bytes `first` to `last`."""
        return self.content[first - 1 : last].decode("ascii", "replace").strip(" \0")

    def number(self, first: int, last: int, name: str) -> float:
        """Finite number that its bytes `first` to `last` spell.

        Raises
        ------
        ValueError
            If they spell none.
        """
        text = self.text(first, last)
        try:
            value = float(text.upper().replace("D", "E"))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(
                f"{self.what} has '{text}' for {name} (bytes {first} to {last}), not a number"
            )
        return value

    def whole(self, first: int, last: int, name: str, least: int, most: int) -> int:
        """Whole number from `least` to `most` that its bytes `first` to `last` spell.

        Raises
        ------
        ValueError
            If they spell none.
        """
        value = self.number(first, last, name)
        if value != round(value) or not least <= value <= most:
            raise ValueError(
                f"{self.what} says {value:.12g} for {name} (bytes {first} to {last}), not a whole "
                f"number from {least} to {most}"
            )
        return round(value)


def read_records(path: Path, wanted: Mapping[Kind, str]) -> dict[Kind, Record]:
    """First record of each kind that is wanted, of a file's first thousand records.

    Parameters
    ----------
    path : Path
    wanted : mapping
        What records of a kind are called.

    Raises
    ------
    ValueError
        If a record cannot be as long as it says.
    OSError
        If the file cannot be read.
    """
    size, found = path.stat().st_size, dict[Kind, Record]()
    with path.open("rb") as file:
        for k in range(1, _MOST + 1):
            at = file.tell()
            if at >= size or len(found) == len(wanted):
                break
            kind, length = _header(file, f"its record {k}", size - at)
            if kind in wanted and kind not in found:
                if length > _LONGEST:
                    raise ValueError(f"{wanted[kind]} says that it is {length} bytes long")
                file.seek(at)
                found[kind] = Record(file.read(length), wanted[kind])
            file.seek(at + length)
    return found


def _header(file: BinaryIO, what: str, left: int) -> tuple[Kind, int]:
    header = file.read(HEADER)
    length = int.from_bytes(header[8:], "big")
    if len(header) < HEADER or not HEADER <= length <= left:
        raise ValueError(
            f"{what} says that it is {length} bytes long, and {left} are left: "
            "the file is truncated, damaged or of the other order of bytes"
        )
    a, b, c, d = header[4:8]
    return (a, b, c, d), length
