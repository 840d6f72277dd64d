"""Orbit files and the interpolation between their epochs."""

import numpy as np
import pytest

from terrafix.models.motion.ephemeris import Ephemeris, read_eof

HEADER = """<?xml version="1.0" ?>
<Earth_Explorer_File{namespace}><Earth_Explorer_Header><Variable_Header>
<Ref_Frame>EARTH_FIXED</Ref_Frame><Time_Reference>UTC</Time_Reference>
</Variable_Header></Earth_Explorer_Header><Data_Block type="xml"><List_of_OSVs count="{count}">
"""
FOOTER = "</List_of_OSVs></Data_Block></Earth_Explorer_File>\n"


def state_vector(second, r, v=(1.0, 2.0, 3.0)):
    x, y, z = r
    vx, vy, vz = v
    return (
        f"<OSV><UTC>UTC=2022-09-18T05:31:{second:02d}.250000</UTC>"
        f'<X unit="m">{x}</X><Y unit="m">{y}</Y><Z unit="m">{z}</Z>'
        f'<VX unit="m/s">{vx}</VX><VY unit="m/s">{vy}</VY><VZ unit="m/s">{vz}</VZ></OSV>\n'
    )


GOOD = [state_vector(10 * i, (7e6 + i, -i, 1.5)) for i in range(3)]


def written(tmp_path, vectors=GOOD, count=None, namespace="", change=lambda text: text):
    path = tmp_path / "orbit.EOF"
    header = HEADER.format(namespace=namespace, count=len(vectors) if count is None else count)
    path.write_text(change(header + "".join(vectors) + FOOTER))
    return path


@pytest.mark.parametrize("namespace", ["", ' xmlns="http://eop-cfi.esa.int/CFI"'])
def test_a_small_file(tmp_path, namespace):
    orbit = read_eof(written(tmp_path, namespace=namespace))
    assert orbit.tags[1] == np.datetime64("2022-09-18T05:31:10.250", "ns")
    np.testing.assert_array_equal(orbit.t, [0, 10, 20])
    np.testing.assert_array_equal(orbit.r_e[2], [7e6 + 2, -2, 1.5])
    np.testing.assert_array_equal(orbit.v_e, np.tile([1.0, 2, 3], (3, 1)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"change": lambda t: t[: len(t) // 2]}, "damaged or truncated orbit file"),
        ({"count": 5}, "holds 3 state vectors but declares 5"),
        ({"change": lambda t: t.replace(' count="3"', "")}, "declares no count"),
        ({"change": lambda t: t.replace("EARTH_FIXED", "MEAN_2000")}, "Ref_Frame is 'MEAN_2000'"),
        ({"change": lambda t: t.replace("Ref_Frame", "Frame")}, "has no Ref_Frame"),
        ({"change": lambda t: t.replace("List_of_OSVs", "List")}, "has no List_of_OSVs"),
        ({"change": lambda t: t.replace("VY", "WY", 2)}, "state vector 0 has no VY"),
        ({"change": lambda t: t.replace("7000001.0", "7e6m")}, "state vector 1 has '7e6m' for X"),
        ({"change": lambda t: t.replace("7000001.0", "nan")}, "position at epoch 1 is not finite"),
        ({"change": lambda t: t.replace("05:31:20", "05:91:20")}, "state vector 2 has the epoch"),
        ({"change": lambda t: t.replace("UTC=2022-09-18T05:31:20.250000", "NaT")}, "the epoch"),
        ({"vectors": GOOD[::-1]}, "epochs do not increase from number 0 to 1"),
        ({"vectors": GOOD[:1]}, "wants two epochs at least, got 1"),
        (
            {"change": lambda t: t.replace("7000001.0", "7000.0")},
            "1 lies inside the Earth, 7000",
        ),
        ({"vectors": []}, "wants two epochs at least, got 0"),
        ({"change": lambda t: t.replace("<Earth", "<!DOCTYPE a><Earth", 1)}, "document type"),
        ({"change": lambda t: ""}, "damaged or truncated"),
    ],
)
def test_damage_is_named_with_the_file(tmp_path, damage, message):
    path = written(tmp_path, **damage)
    with pytest.raises(ValueError, match=message) as caught:
        read_eof(path)
    assert str(path) in str(caught.value)


LEAP = np.datetime64("2016-12-31T23:59:30")
"""A minute about the last leap second: TAI - UTC was 36 s before it, and is 37 s after it."""


def leap_vectors(tags, function, tai=True):
    """State vectors every 10 s from `LEAP` on; their UTC tags are given, their TAI counts on."""
    vectors = []
    for k, tag in enumerate(tags):
        r, v = function(np.array(10.0 * k))
        atomic = f"<TAI>TAI={LEAP + np.timedelta64(36 + 10 * k, 's')}.000000</TAI>" if tai else ""
        fields = zip(("X", "Y", "Z", "VX", "VY", "VZ"), [*r, *v], strict=True)
        values = "".join(f"<{name}>{float(x)}</{name}>" for name, x in fields)
        vectors.append(f"<OSV>{atomic}<UTC>UTC={tag}.000000</UTC>{values}</OSV>")
    return vectors


LEAP_TAGS = [
    *("2016-12-31T23:59:30", "2016-12-31T23:59:40", "2016-12-31T23:59:50"),
    *("2016-12-31T23:59:60", "2017-01-01T00:00:09", "2017-01-01T00:00:19"),
]


def test_a_leap_second_does_not_move_the_satellite(tmp_path):
    """Every 10 s of TAI on a circle: 20 s after the leap second the circle, not 7.6 km from it.

    The UTC tags are those of IERS Bulletin C 52: 23:59:59, 23:59:60, 0:00:00.
    """
    orbit = read_eof(written(tmp_path, leap_vectors(LEAP_TAGS, circle)))
    np.testing.assert_array_equal(orbit.t, [0, 10, 20, 30, 40, 50])
    assert orbit.tags[3] == np.datetime64("2017-01-01T00:00:00")
    r, _ = orbit.at(45.0)
    assert np.linalg.norm(r - circle(np.array(45.0))[0]) < 1e-3  # 7e6 (n h)^4 / 384 = 0.3 mm


@pytest.mark.parametrize("night", ["2016-12-31", "2015-06-30"])
def test_a_file_without_tai_is_refused_where_a_leap_second_may_lie(tmp_path, night):
    first = np.datetime64(f"{night}T23:59:30")
    tags = [first + np.timedelta64(10 * k, "s") for k in range(6)]
    with pytest.raises(ValueError, match="a leap second may lie, and has no TAI"):
        read_eof(written(tmp_path, leap_vectors(tags, circle, tai=False)))
    same = [np.datetime64("2016-11-30T23:59:30") + (tag - first) for tag in tags]
    assert read_eof(written(tmp_path, leap_vectors(same, circle, tai=False))).t[-1] == 50.0


@pytest.mark.parametrize("wrong", ["2017-01-01T00:00:09.5", "2017-01-01T00:00:11"])
def test_tags_that_contradict_each_other_are_refused(tmp_path, wrong):
    tags = [*LEAP_TAGS[:4], wrong, *LEAP_TAGS[5:]]
    text = [v.replace(".5.000000", ".500000") for v in leap_vectors(tags, circle)]
    with pytest.raises(ValueError, match="TAI and UTC of state vector 4 do not differ"):
        read_eof(written(tmp_path, text))


def test_states_in_other_units_are_refused(tmp_path):
    path = written(tmp_path, change=lambda text: text.replace('unit="m">-1', 'unit="km">-1'))
    with pytest.raises(ValueError, match="state vector 1 has Y in 'km', not 'm'"):
        read_eof(path)


def circle(t, n=1.1e-3):
    c, s = np.cos(n * t), np.sin(n * t)
    zero = np.zeros_like(t)
    r = 7e6 * np.stack([c, s, zero], axis=-1)
    return r, 7e6 * n * np.stack([-s, c, zero], axis=-1)


def cubic(t):
    coefficients = np.array([[7e6, 10.0, -3.0, 0.2], [1e6, -7e3, 1.0, 0.1], [0.0, 5.0, 0.0, 1.0]])
    powers = np.stack([np.ones_like(t), t, t**2, t**3], axis=-1)
    slopes = np.stack([np.zeros_like(t), np.ones_like(t), 2 * t, 3 * t**2], axis=-1)
    return powers @ coefficients.T, slopes @ coefficients.T


def ephemeris_of(function, t):
    r, v = function(t)
    return Ephemeris(np.datetime64(0, "ns") + (t * 1e9).astype("timedelta64[ns]"), t, r, v)


def test_a_cubic_is_reproduced():
    """The interpolant is exact there: what remains is rounding of 7e6."""
    orbit = ephemeris_of(cubic, np.array([0.0, 7.0, 10.0, 25.0]))
    t = np.array([[0.0, 3.3, 7.0], [9.99, 24.0, 25.0]])
    r, v = orbit.at(t)
    expected_r, expected_v = cubic(t)
    np.testing.assert_allclose(r, expected_r, atol=5e-9)
    np.testing.assert_allclose(v, expected_v, atol=2e-9)
    assert r.shape == (2, 3, 3)
    assert orbit.at(3.3)[0].shape == (3,)


@pytest.mark.parametrize(("velocities", "nodes"), [(True, (9 / 16) ** 2), (False, (105 / 16) ** 2)])
def test_error_falls_with_the_eighth_power_of_the_spacing(velocities, nodes):
    """On a circle, in the middle of the middle interval: product of (t - t_k), over 8!.

    Of states at +-1/2 and +-3/2 intervals, or of positions alone at +-1/2 to +-7/2.
    """
    n = 1.1e-3
    spacings = np.array([240.0, 180.0, 150.0])
    errors = []
    for h in spacings:
        whole = ephemeris_of(circle, h * np.arange(12.0))
        orbit = whole if velocities else Ephemeris(whole.tags, whole.t, whole.r_e)
        t = np.array([5.5 * h])
        errors.append(np.linalg.norm(orbit.at(t)[0] - circle(t)[0]))
        assert orbit.error(5 * h, 6 * h) == pytest.approx(errors[-1], rel=0.1)
    np.testing.assert_allclose(errors, nodes * 7e6 * (n * spacings) ** 8 / 40320, rtol=0.02)


@pytest.mark.parametrize("t", [-1e-9, 25.0001, np.nan, [3.0, 100.0]])
def test_extrapolation_is_refused(t):
    orbit = ephemeris_of(cubic, np.array([0.0, 7.0, 10.0, 25.0]))
    with pytest.raises(
        ValueError, match=r"cannot extrapolate to .* covers 0.0 s to 25.0 s after 1970"
    ):
        orbit.at(t)


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="an ephemeris wants shapes"):
        Ephemeris(np.zeros(2, "datetime64[ns]"), np.arange(2.0), np.zeros((2, 3)), np.zeros((3, 3)))


def test_real_orbit_file(data_folder):
    """Leaving out every second vector, those about it give it back to 0.2 mm.

    Velocities are the file's to some 5e-5 m/s, by which its positions and velocities disagree.
    """
    files = sorted((data_folder / "sentinel1").glob("*.EOF"))
    if not files:
        pytest.skip(f"no orbit file in {data_folder / 'sentinel1'}")
    orbit = read_eof(files[0])
    assert len(orbit.t) == 1186
    np.testing.assert_array_equal(np.diff(orbit.t), 10.0)
    assert orbit.tags[0] == np.datetime64("2022-09-18T05:31:55.470319", "ns")
    height = np.linalg.norm(orbit.r_e, axis=1) - 6.378e6
    assert np.all((height > 6.8e5) & (height < 7.3e5))
    half = Ephemeris(orbit.tags[::2], orbit.t[::2], orbit.r_e[::2], orbit.v_e[::2])
    r, v = half.at(orbit.t[1:-1:2])
    error = np.linalg.norm(r - orbit.r_e[1:-1:2], axis=1)
    assert error.max() < 3e-4
    assert np.linalg.norm(v - orbit.v_e[1:-1:2], axis=1).max() < 1e-4
