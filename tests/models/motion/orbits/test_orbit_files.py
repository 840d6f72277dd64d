"""Orbit files of every format against the orbit that they were made of, and bad ones by name.

The orbit falls about an oblate Earth that turns; it is integrated by DOP853 of SciPy to micrometers
(`orbit_files`). Files hold it to the digits that they are written with: 1e-6 m (OEM, tables),
1e-3 m (SP3).
"""

import sys

import numpy as np
import pytest
from orbit_files import FIRST, HEAD, oem, oem_xml, sp3, states, table, tags

from terrafix.models.core.iers import leap_seconds
from terrafix.models.core.timescales import parse_epoch
from terrafix.models.geometry.celestial import frame_from_earth_fixed
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.motion.epochs import atomic, read_tags
from terrafix.models.motion.orbits.files import read_orbit

MINUTE = np.arange(0.0, 3601.0, 60.0)
BETWEEN = np.arange(7.0, 3590.0, 61.0)


def written(folder, text, name="orbit.oem"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("name", "text", "r_error", "v_error"),
    [
        # 9/16 squared (n h)^8 r / 8! = 2 um at the ends three times that; digits of 1e-6 m, and of
        # 1e-6 m/s, which in 60 s are 15e-6 m (Hermite: 60 s / 8 times 2e-6 m/s)
        ("orbit.oem", HEAD + oem(MINUTE), 5e-5, 5e-6),
        ("orbit.txt", HEAD + oem(MINUTE, scale="GPS"), 5e-5, 5e-6),
        ("orbit.xml", oem_xml(MINUTE), 5e-5, 5e-6),
        ("orbit.csv", table(MINUTE), 5e-5, 5e-6),
        # positions to 0.5e-3 m per axis, and what polynomials make of it
        ("orbit.sp3", sp3(MINUTE), 1.5e-3, 1e-4),
        # alone: at the ends 12 times the 2.5e-3 m of the middle, 105/16 squared times (n h)^8 r/8!
        ("orbit.sp3", sp3(MINUTE, velocities=False), 1e-2, 1e-3),
    ],
)
def test_a_file_gives_back_the_orbit_it_was_made_of(tmp_path, name, text, r_error, v_error):
    orbit = read_orbit(written(tmp_path, text, name))
    assert (len(orbit.t), orbit.tags[0], orbit.gaps) == (61, FIRST, [])
    np.testing.assert_array_equal(orbit.t, MINUTE)
    r, v = orbit.at(BETWEEN)
    expected_r, expected_v = states(BETWEEN)
    assert np.linalg.norm(r - expected_r, axis=1).max() < r_error
    assert np.linalg.norm(v - expected_v, axis=1).max() < v_error


@pytest.mark.parametrize(
    ("spacing", "kind", "velocities", "least", "most"),
    [
        # of the table in docs/recorded_orbit.md, by a factor of two
        (60.0, "leo", True, 0.0, 1e-5),
        (300.0, "leo", True, 5e-3, 3e-2),
        (900.0, "leo", True, 30.0, 150.0),
        (60.0, "leo", False, 2e-6, 2e-5),
        (300.0, "leo", False, 0.7, 3.0),
        (300.0, "gnss", False, 4e-6, 3e-5),
        (900.0, "gnss", False, 5e-3, 3e-2),
    ],
)
def test_the_error_that_is_stated_is_the_error_that_is_made(spacing, kind, velocities, least, most):
    t = np.arange(24 if spacing < 900.0 or kind == "gnss" else 14) * spacing
    r, v = states(t, kind)
    at = FIRST + (t * 1e9).astype("timedelta64[ns]")
    orbit = Ephemeris(at, t, r, v if velocities else None)
    middle = t[4:-5] + spacing / 2
    inner = np.linalg.norm(orbit.at(middle)[0] - states(middle, kind)[0], axis=1).max()
    assert least <= inner < most
    everywhere = t[:-1] + spacing / 2
    made = np.linalg.norm(orbit.at(everywhere)[0] - states(everywhere, kind)[0], axis=1).max()
    assert made == pytest.approx(orbit.error(), rel=0.35, abs=1e-4)


def test_every_time_scale_is_turned_to_tai(tmp_path):
    """GPS is 19 s behind TAI, terrestrial time 32.184 s ahead, UTC 37 s behind since 2017."""
    behind = {"GPS": 19.0, "TAI": 0.0, "TT": -32.184, "UTC": 37.0}
    for scale, shift in behind.items():
        orbit = read_orbit(written(tmp_path, HEAD + oem(MINUTE, scale=scale)))
        first = orbit.instant0()
        assert (first.day, round(first.seconds, 6)) == (59840, 5 * 3600 + 31 * 60 + 55.5 + shift)
        assert orbit.since_first(parse_epoch(f"2022-09-18T05:32:55.5 {scale}")) == 60.0


def test_tags_within_a_leap_second():
    """TAI - UTC is 36 s until it is over, 37 s then (IERS Bulletin C 52)."""
    tai = atomic(*read_tags(["2016-12-31T23:59:60.5", "2017-001T00:00:00.25Z"], "UTC"), "UTC")
    np.testing.assert_array_equal(tai.day, [57754, 57754])
    np.testing.assert_array_equal(tai.seconds, [36.5, 37.25])


def test_a_file_over_a_leap_second_goes_on(tmp_path):
    """Twenty minutes about the last one, tags every 60 s of TAI, none at 23:59:60."""
    t = np.arange(0.0, 1201.0, 60.0)
    first = np.datetime64("2016-12-31T23:50:10", "ns")
    utc = [str(first + np.timedelta64(int(x) - (x > 589), "s")) for x in t]
    text = HEAD + oem(t)
    for old, new in zip([f"{FIRST + np.timedelta64(int(x), 's')}" for x in t], utc, strict=True):
        text = text.replace(old, new)
    orbit = read_orbit(written(tmp_path, text))
    np.testing.assert_array_equal(orbit.t, t)


def test_without_the_tables_only_what_needs_them_is_refused(tmp_path, monkeypatch):
    leap_seconds.cache_clear()
    monkeypatch.setitem(sys.modules, "astropy_iers_data", None)
    orbit = read_orbit(written(tmp_path, HEAD + oem(MINUTE)))
    np.testing.assert_array_equal(orbit.t, MINUTE)
    with pytest.raises(ImportError, match=r"pip install 'terrafix\[truth\]'"):
        orbit.instant0()
    inertial = written(tmp_path, HEAD + oem(MINUTE, frame="GCRF"))
    with pytest.raises(ImportError, match=r"orbit.oem: .*needs the package"):
        read_orbit(inertial)


@pytest.mark.parametrize(
    ("name", "frame"), [("GCRF", "gcrf"), ("EME2000", "j2000"), ("TEME", "teme")]
)
@pytest.mark.parametrize("velocities", [True, False])
def test_states_of_inertial_frames_are_turned_with_the_earth(tmp_path, name, frame, velocities):
    """Written in a frame by the whole chain, read back: to the digits of the file."""
    r, v = states(MINUTE)
    first = parse_epoch("2022-09-18T05:31:55.5 UTC")
    r_i, v_i = frame_from_earth_fixed(frame, first.plus(MINUTE), r, v)
    rows = [
        ",".join([tag, *(f"{x:.9f}" for x in (*p, *(u if velocities else ())))])
        for tag, p, u in zip(tags(MINUTE), r_i, v_i, strict=True)
    ]
    columns = "x [m],y [m],z [m]" + ",vx [m/s],vy [m/s],vz [m/s]" * velocities
    text = f"# frame: {name}\nutc,{columns}\n" + "\n".join(rows) + "\n"
    orbit = read_orbit(written(tmp_path, text, "orbit.csv"))
    np.testing.assert_allclose(orbit.r_e, r, atol=1e-8)
    if velocities:
        np.testing.assert_allclose(orbit.v_e, v, atol=1e-8)
    else:
        assert np.linalg.norm(orbit.at(MINUTE)[1] - v, axis=1).max() < 1e-5


@pytest.mark.parametrize("lost", [{20, 21, 22}, {20, 21}])
def test_nothing_is_interpolated_across_a_gap(tmp_path, lost):
    orbit = read_orbit(written(tmp_path, sp3(MINUTE, lost=lost), "orbit.sp3"))
    gap = (19 * 60.0, (max(lost) + 1) * 60.0)
    assert orbit.gaps == [gap]
    assert orbit.gap_within(0.0, 1139.0) is None
    assert orbit.gap_within(1200.0, 1210.0) == gap
    for edge in gap:
        np.testing.assert_allclose(orbit.at(edge)[0], states(edge)[0], atol=1e-3)
    with pytest.raises(ValueError, match=r"no states are known between 1140.0 s and"):
        orbit.at(1200.0)


def test_a_state_that_lacks_is_bridged(tmp_path):
    """Over 120 s the eighth order errs by 256 times 2 um."""
    orbit = read_orbit(written(tmp_path, sp3(MINUTE, lost={20}), "orbit.sp3"))
    assert orbit.gaps == []
    assert np.linalg.norm(orbit.at(1200.0)[0] - states(1200.0)[0]) < 5e-3


def test_segments_of_a_message_are_not_joined_across_a_maneuver(tmp_path):
    """The second one begins where the first ends, on another orbit: 1 m/s more on each axis."""
    one, two = MINUTE[:31], MINUTE[30:]
    pushed = [
        " ".join([*row.split()[:4], *(f"{float(x) + 1e-3:.9f}" for x in row.split()[4:])])
        if row[:2] == "20"
        else row
        for row in oem(two).splitlines()
    ]
    text = HEAD + oem(one) + "\n".join(pushed)
    orbit = read_orbit(written(tmp_path, text))
    assert orbit.gaps == []
    before, after = orbit.at(1800.0 - 1e-6), orbit.at(1800.0)
    np.testing.assert_allclose(before[1], states(1800.0)[1], atol=1e-4)
    np.testing.assert_allclose(after[1] - before[1], 1.0, atol=1e-4)


def test_states_outside_the_useable_span_are_not_read(tmp_path):
    useable = {
        "USEABLE_START_TIME": "2022-09-18T05:33:55.5",
        "USEABLE_STOP_TIME": "2022-09-18T06:29:55.5",
    }
    orbit = read_orbit(written(tmp_path, HEAD + oem(MINUTE, **useable)))
    assert (orbit.tags[0], len(orbit.t)) == (FIRST + np.timedelta64(120, "s"), 57)


def test_one_satellite_of_many_is_chosen(tmp_path):
    path = written(tmp_path, sp3(MINUTE, satellites=("L51", "L52")), "orbit.sp3")
    assert len(read_orbit(path, "L52").t) == 61
    with pytest.raises(ValueError, match="holds 2 satellites: L51, L52\n  name one"):
        read_orbit(path)
    with pytest.raises(ValueError, match="no satellite 'G05', but L51, L52"):
        read_orbit(path, "G05")
    other = oem(MINUTE, OBJECT_NAME="OTHER", OBJECT_ID="2016-025A")
    path = written(tmp_path, HEAD + oem(MINUTE) + other)
    assert len(read_orbit(path, "2016-025A").t) == 61
    with pytest.raises(ValueError, match="several objects: OTHER \\(2016-025A\\), SAT"):
        read_orbit(path)


def lines_moved(text):
    """The last two states in each other's place."""
    lines = text.splitlines()
    lines[-2:] = lines[:-3:-1]
    return "\n".join(lines)


OEM = HEAD + oem(MINUTE)
BAD = [
    ("orbit.oem", OEM[:3000], "6 numbers|has .* numbers after its epoch|is truncated"),
    ("orbit.oem", OEM[: OEM.rindex("2022")], "its STOP_TIME is 2022-09-18T06:31:55.500000000"),
    ("orbit.oem", HEAD + "META_START\nOBJECT_NAME = A\n", "ends within META: it is truncated"),
    ("orbit.oem", lines_moved(HEAD + oem(MINUTE, STOP_TIME="2022-09-18T06:00:00")), "not increase"),
    ("orbit.oem", OEM + OEM.splitlines()[-1], "epochs number 60 and 61 are the same"),
    ("orbit.oem", HEAD + oem(MINUTE, unit=1e6), "inside the Earth"),
    ("orbit.oem", HEAD + oem(MINUTE, unit=1.0), "beyond what orbits the Earth"),
    ("orbit.oem", HEAD + oem(MINUTE, turning=False), "not those of|move as in inertial axes"),
    ("orbit.oem", HEAD + oem(MINUTE, frame="EME2000"), "not move as a satellite|not those of its"),
    ("orbit.oem", HEAD + oem(MINUTE, frame="MOON_ME"), "its frame is 'MOON_ME', known are ITRF"),
    ("orbit.oem", HEAD + oem(MINUTE, scale="TDB"), "its time scale is 'TDB', read are UTC, GPS"),
    ("orbit.oem", HEAD + oem(MINUTE) + oem(MINUTE + 3660, scale="GPS"), "mixes time scales: GPS"),
    ("orbit.oem", HEAD + oem(MINUTE, CENTER_NAME="MARS"), "its center is 'MARS', read is EARTH"),
    ("orbit.oem", OEM.replace("REF_FRAME", "FRAME"), "segment 1 has no REF_FRAME"),
    ("orbit.oem", OEM.replace("05:33:55.5", "05:33:99.5"), "is no epoch of UTC"),
    ("orbit.oem", OEM.replace("T05:33:55.5", "T23:59:60.5"), "no leap second before 2022-09-19"),
    ("orbit.oem", oem_xml(MINUTE), ""),
    ("orbit.xml", oem_xml(MINUTE)[:2000], "damaged or truncated"),
    ("orbit.xml", oem_xml(MINUTE, "m"), "has X in 'm', not 'km'"),
    ("orbit.sp3", sp3(MINUTE)[:-5], "does not end with EOF: it is truncated"),
    ("orbit.sp3", sp3(MINUTE).replace("     61", "     62", 1), "61 epochs but declares 62"),
    ("orbit.sp3", sp3(MINUTE, scale="GLO"), "its time scale is 'GLO'"),
    ("orbit.sp3", sp3(MINUTE).replace("#dV", "#aV", 1), "does not begin with #cP"),
    ("orbit.csv", table(MINUTE).replace("# frame: ITRF\n", ""), "names no frame"),
    ("orbit.csv", table(MINUTE).replace("gps,x [m]", "gps,x"), "column 'x' has no unit"),
    ("orbit.csv", table(MINUTE).replace("x [m]", "x [ft]", 1), "has the unit 'ft'"),
    ("orbit.csv", table(MINUTE).replace("x [m]", "x [km]", 1), "beyond what orbits the Earth"),
    ("orbit.csv", table(MINUTE).replace("[km/s]", "[m/s]"), "velocities are not those of its pos"),
    ("orbit.csv", table(MINUTE).replace("remark", "utc"), "mixes time scales: UTC, GPS"),
    ("orbit.csv", table(MINUTE).replace("gps,x", "time,x"), "no column of epochs, named utc, gps"),
    ("orbit.csv", table(MINUTE).replace("vz [km/s]", "w"), "has no column 'vz'"),
    ("orbit.csv", table(MINUTE)[:-30], "cells, its columns are 8"),
    ("orbit.csv", table(MINUTE, turning=False), "move as in inertial axes"),
    ("orbit.txt", "It was a dark and stormy night.\n", "it is text; read are OEM, SP3-c, SP3-d"),
    ("orbit.txt", "", "it is empty; read are"),
]


@pytest.mark.parametrize(("name", "text", "message"), BAD)
def test_a_bad_file_is_named_with_what_is_wrong(tmp_path, name, text, message):
    path = written(tmp_path, text, name)
    if not message:
        assert len(read_orbit(path).t) == 61  # of another suffix than its content
        return
    with pytest.raises(ValueError, match=message) as caught:
        read_orbit(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_file_of_bytes_is_named(tmp_path):
    path = tmp_path / "orbit.sp3"
    path.write_bytes(b"\x1f\x8b" + bytes(100))
    with pytest.raises(ValueError, match="it is gzip; read are OEM"):
        read_orbit(path)


def test_a_format_of_one_satellite_wants_no_name(tmp_path):
    with pytest.raises(ValueError, match="holds one satellite: 'L51' need not be named"):
        read_orbit(written(tmp_path, table(MINUTE), "orbit.csv"), "L51")
