"""Gravity fields of files: fully normalized coefficients of spherical harmonics (ICGEM, .gfc).

References
----------
.. [1] F. Barthelmes and C. Förste, "The ICGEM-format", GFZ Potsdam, 2011.
.. [2] G. Petit and B. Luzum (eds.), "IERS Conventions (2010)", IERS Technical Note 36, sections
       1.1 and 6.2.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.earth import EARTH

SHIPPED = Path(__file__).with_name("egm2008_70.gfc")
"""EGM2008 to degree and order 70."""

MAX_BYTES = 512 * 1024 * 1024
"""Largest file read; EGM2008 to degree 2190 takes 230 MB."""

TIDE_SYSTEMS = ("tide_free", "zero_tide", "mean_tide", "unknown")

_DIRECT = 4.4228e-8 * -0.31460
"""Permanent tide of Sun and Moon in C20, eq. (6.14) of [2]_ without its Love number."""
_PERMANENT = {"tide_free": 0.0, "zero_tide": _DIRECT * 0.30190, "mean_tide": _DIRECT * 1.30190}
_NORMALIZE = (
    "\n  multiply them by sqrt((n + m)! / ((2 - [m = 0]) (2 n + 1) (n - m)!)), or fetch the field "
    "anew"
)
_VARIABLE = ("gfct", "trnd", "dot", "acos", "asin")


@dataclass(frozen=True, eq=False)
class GravityField:
    """A gravity field in spherical harmonics.

    Parameters
    ----------
    name : str
        Of the model.
    mu : float
        Gravitational parameter [m^3/s^2].
    radius : float
        That the coefficients refer to [m].
    tide_system : {"tide_free", "zero_tide", "mean_tide", "unknown"}
        Which of the permanent tides the coefficient of degree two holds.
    C, S : ndarray, shape (n_max + 1, n_max + 1)
        Fully normalized coefficients by degree and order.
    """

    name: str
    mu: float
    radius: float
    tide_system: str
    C: FloatArray
    S: FloatArray

    @property
    def max_degree(self) -> int:
        """Largest degree that there is."""
        return len(self.C) - 1

    @property
    def j2(self) -> float:
        """Second zonal coefficient, unnormalized."""
        return float(-np.sqrt(5.0) * self.C[2, 0])

    def cut(self, degree: int) -> GravityField:
        """The same field to a lower degree.

        Raises
        ------
        ValueError
            If the field does not reach it, or it is below two.
        """
        if not 2 <= degree <= self.max_degree:
            raise ValueError(
                f"a degree of {degree} cannot be had: the gravity field {self.name} has degrees 2 "
                f"to {self.max_degree}"
            )
        n = degree + 1
        return replace(self, C=self.C[:n, :n], S=self.S[:n, :n])

    def without_permanent_tide(self) -> GravityField:
        """The same field as a tide-free one, which takes the whole tide beside it.

        Raises
        ------
        ValueError
            If it is not known which permanent tide it holds.
        """
        if self.tide_system not in _PERMANENT:
            raise ValueError(
                f"the gravity field {self.name} does not say which permanent tide it holds (its "
                f"tide_system is '{self.tide_system}'), so that a tide would be counted twice or "
                "not at all\n  fly it without the tide, or write the tide_system into its file"
            )
        C = self.C.copy()
        C[2, 0] -= _PERMANENT[self.tide_system]
        return replace(self, C=C, tide_system="tide_free")

    def __str__(self) -> str:
        system = self.tide_system.replace("_", "-")
        return f"{self.name} to degree {self.max_degree} ({system})"


@lru_cache(maxsize=1)
def shipped_field() -> GravityField:
    """EGM2008 to degree and order 70, tide-free."""
    return read_gfc(SHIPPED)


def chosen_field(path: Path | None, degree: int) -> GravityField:
    """The field of a file, or the one that is shipped, to a degree.

    Raises
    ------
    ValueError
        If the file cannot be read or is refused, or does not reach the degree.
    """
    try:
        field = shipped_field() if path is None else read_gfc(path)
    except OSError as error:
        raise ValueError(
            f"cannot read the gravity field '{path}': {(error.strerror or str(error)).lower()}\n"
            "  set gravity_file to a file (.gfc), or leave it out: EGM2008 to degree 70 is there"
        ) from error
    if path is None and degree > field.max_degree:
        raise ValueError(
            f"degree {degree} is more than the {field.max_degree} of EGM2008 that is shipped\n"
            "  set gravity_file to a file (.gfc) of https://icgem.gfz.de that has it"
        )
    return field.cut(degree)


def read_gfc(path: str | Path) -> GravityField:
    """Read a static gravity field in the format of ICGEM [1]_.

    Raises
    ------
    ValueError
        If the file is not such a file, is damaged or incomplete, its coefficients are not fully
        normalized, or change in time; the message names the file.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: larger than {MAX_BYTES} bytes, which no gravity field is")
    lines = path.read_text(errors="replace").splitlines()
    end = next((k for k, line in enumerate(lines) if line.startswith("end_of_head")), None)
    if end is None:
        raise ValueError(f"{path}: has no 'end_of_head': it is no gravity field of ICGEM (.gfc)")
    head = dict(line.split()[:2] for line in lines[:end] if len(line.split()) >= 2)
    norm = head.get("norm", "fully_normalized")
    if norm != "fully_normalized":
        raise ValueError(
            f"{path}: coefficients of another normalization: its norm is '{norm}', and "
            f"'fully_normalized' is taken{_NORMALIZE}"
        )
    tide_system = head.get("tide_system", "unknown")
    if tide_system not in TIDE_SYSTEMS:
        raise ValueError(
            f"{path}: its tide_system is '{tide_system}', none of {', '.join(TIDE_SYSTEMS)}"
        )
    mu, radius = (_number(path, head, key) for key in ("earth_gravity_constant", "radius"))
    degree = int(_number(path, head, "max_degree"))
    C, S = _coefficients(path, lines, end + 1, degree)
    if degree >= 2 and abs(C[2, 0] / -EARTH.j2 - 1) < 0.01:
        raise ValueError(
            f"{path}: coefficients of another normalization: C20 is {C[2, 0]:.6g}, which is the "
            f"Earth's without one; fully normalized it is {-EARTH.j2 / np.sqrt(5):.6g}{_NORMALIZE}"
        )
    return GravityField(head.get("modelname", path.stem), mu, radius, tide_system, C, S)


def _number(path: Path, head: dict[str, str], key: str) -> float:
    text = head.get(key)
    if text is None:
        raise ValueError(f"{path}: its head has no '{key}'")
    try:
        value = _fortran(text)
    except ValueError:
        raise ValueError(f"{path}: its head has '{text}' for {key}, not a number") from None
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{path}: its head has {text} for {key}, which must be positive")
    return value


def _fortran(text: str) -> float:
    return float(text.replace("D", "e").replace("d", "e"))


def _coefficients(
    path: Path, lines: list[str], first: int, degree: int
) -> tuple[FloatArray, FloatArray]:
    C, S = np.full((2, degree + 1, degree + 1), np.nan)
    # what files leave out: the center of mass is the origin
    C[0, 0], S[0, 0], C[1, :2], S[1, :2] = 1.0, 0.0, 0.0, 0.0
    for number, line in enumerate(lines[first:], first + 1):
        words = line.split()
        if not words:
            continue
        if words[0] in _VARIABLE:
            raise ValueError(
                f"{path}: line {number} is '{words[0]}', of a field that changes in time\n"
                "  a static field is taken: lines 'gfc' alone"
            )
        if words[0] != "gfc":
            raise ValueError(f"{path}: line {number} is '{words[0]}', where 'gfc' was expected")
        try:
            n, m = int(words[1]), int(words[2])
            pair = _fortran(words[3]), _fortran(words[4])
        except (ValueError, IndexError):
            raise ValueError(f"{path}: line {number} is damaged: '{line.strip()[:60]}'") from None
        if not (0 <= m <= n <= degree and np.isfinite(pair).all()):
            raise ValueError(
                f"{path}: line {number} has degree {n}, order {m} and {pair}, in a field of "
                f"degree {degree}"
            )
        C[n, m], S[n, m] = pair
    missing = np.isnan(C) & np.tri(degree + 1, dtype=bool)
    if missing.any():
        n, m = np.argwhere(missing)[0]
        raise ValueError(
            f"{path}: says degree {degree}, but has no coefficient of degree {n} and order {m}: "
            "it is not whole"
        )
    return np.nan_to_num(C), np.nan_to_num(S)
