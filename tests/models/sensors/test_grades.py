"""Grades of inertial sensors: the page that people read has the numbers that are flown."""

from pathlib import Path

import pytest

from terrafix.models.sensors.grades import GRADES

PAGE = Path(__file__).parents[3] / "docs" / "imu.md"


def table():
    """Cells of the table of grades: by grade, what stands beside each setting."""
    rows = [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in PAGE.read_text(encoding="utf-8").split("## Grades")[1].splitlines()
        if line.startswith("|")
    ]
    found = {grade: {} for grade in rows[0][1:]}
    for setting, *cells in rows[2:]:
        for grade, cell in zip(found, cells, strict=True):
            if cell:
                names = [name.strip(" `") for name in setting.split(",")]
                values = [value.strip() for value in cell.split(",")]
                found[grade] |= dict(zip(names, values, strict=True))
    return found


def as_printed(text):
    """A value of the table in the units of a sheet."""
    return text.replace("h^0.5", "sqrt(h)").replace("_0", "")


@pytest.mark.parametrize("grade", GRADES)
def test_the_page_has_the_numbers_that_are_flown(grade):
    printed = {name: as_printed(value) for name, value in GRADES[grade].values.items()}
    assert table()[grade] == printed


def test_the_page_has_no_other_grade():
    assert list(table()) == list(GRADES)
