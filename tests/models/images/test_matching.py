"""Matching: where an image lies is found with a covariance that holds, or refused."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from terrafix.models.images.matching import REASONS, Prediction, Searchable, matched, misplaced
from terrafix.models.radar.autofocus import SharpnessCurve, autofocus
from terrafix.models.radar.doppler import fractional_centroid, unwrapped_centroid
from terrafix.models.radar.focusing import azimuth_looks, range_doppler
from terrafix.models.radar.recordings.files import read_recording

DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))


def surface(rng, shape=(620, 620)):
    """Mean amplitude of a scene: fields with borders, a river, bright points."""
    smooth = [cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), s) for s in (14, 25)]
    power = np.exp(0.8 * np.sign(smooth[0]) + 0.6 * np.sign(smooth[1]))
    power[
        np.abs(np.arange(shape[1]) - 300 - 60 * np.sin(np.arange(shape[0])[:, None] / 70)) < 6
    ] = 0.1
    rows, columns = rng.integers(0, shape[0], 90), rng.integers(0, shape[1], 90)
    power[rows, columns] += 60
    return np.sqrt(cv2.GaussianBlur(power, (0, 0), 0.7))


def speckled(amplitude, rng, looks=2):
    """Fully developed speckle at the resolution of a pixel and a half."""
    total = np.zeros(amplitude.shape)
    for _ in range(looks):
        field = rng.standard_normal((*amplitude.shape, 2))
        field = cv2.GaussianBlur(field, (0, 0), 0.6)
        total += (field**2).sum(axis=2)
    return (amplitude * np.sqrt(total / total.mean())).astype(np.float32)


def cut(amplitude, center, size, angle=0.0, scale=1.0):
    """A square chip about (row, column), turned [deg] and enlarged."""
    row, column = center
    M = cv2.getRotationMatrix2D((column, row), angle, scale)
    M[:, 2] += np.array([(size - 1) / 2 - column, (size - 1) / 2 - row])
    return cv2.warpAffine(amplitude, M, (size, size), flags=cv2.INTER_LINEAR)


SIZE = 256


def expected(center, size=SIZE, sigma=20.0, off=(0.0, 0.0), turn=1e-3, growth=1e-3):
    """Prediction of a chip about a center: where its first pixel lies, off by so much."""
    first = np.asarray(center) - (size - 1) / 2 + off
    transform = np.column_stack([np.eye(2), first])
    return Prediction.affine(transform, sigma**2 * np.eye(2), turn, growth)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(11)
    mean = surface(rng)
    return mean, Searchable(speckled(mean, rng)), rng


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (9.0, 1.03), (-11.0, 0.97)])
def test_a_turned_and_scaled_chip_is_found(scene, angle, scale):
    """A turn or growth beyond what one look of speckle correlates over is tried first."""
    mean, reference, rng = scene
    center = (310.3, 287.6)
    chip = speckled(cut(mean, center, SIZE, angle, scale).astype(np.float64), rng)
    match = matched(
        Searchable(chip), reference, expected(center, off=(9, -7), turn=0.1, growth=0.03)
    )
    assert match.reason == "accepted"
    assert (match.row, match.column) == pytest.approx(center, abs=0.4)
    assert match.shift == pytest.approx([-9, 7], abs=0.4)
    turn = np.degrees(np.arctan2(match.linear[0, 1], match.linear[0, 0]))
    assert abs(turn) == pytest.approx(abs(angle), abs=0.3)
    assert np.sqrt(np.linalg.det(match.linear)) == pytest.approx(1 / scale, rel=5e-3)
    corner = np.array(center) + match.linear @ np.full(2, -(SIZE - 1) / 2)
    assert match.outline[0] == pytest.approx(corner, abs=0.6)


@pytest.fixture(scope="module")
def chips(scene):
    """Errors of 40 chips, and the covariances that they came with."""
    mean, reference, _ = scene
    rng = np.random.default_rng(12)
    errors, covariances = [], []
    for _ in range(40):
        center = rng.uniform(140, 480, 2)
        chip = Searchable(speckled(cut(mean, center, 224).astype(np.float64), rng))
        match = matched(chip, reference, expected(center, 224, off=rng.normal(0, 20, 2)))
        if match.accepted:
            errors.append([match.row - center[0], match.column - center[1]])
            covariances.append(match.covariance)
    return np.array(errors), np.array(covariances)


def test_errors_are_what_their_covariance_says(chips):
    """Normalized squares have mean 2; 40 chips of one scene are some 12 independent ones: within
    0.8^2 and 1.25^2 of it, as is asked of every scene."""
    errors, covariances = chips
    assert len(errors) >= 38
    squares = [e @ np.linalg.solve(C, e) for e, C in zip(errors, covariances, strict=True)]
    assert 0.8 < np.sqrt(np.mean(squares) / 2) < 1.25
    assert np.max(squares) < 25
    assert np.sqrt(np.mean(errors**2)) < 0.15
    assert np.abs(errors.mean(axis=0)).max() < 4 * errors.std(axis=0).max() / np.sqrt(len(errors))


def test_an_error_does_not_depend_on_where_in_a_pixel_it_was_expected(scene):
    """What is drawn of the reference is interpolated: by lines, which do not move a ramp. OpenCV's
    cubic moves it by 0.047 pixels at a quarter."""
    mean, reference, rng = scene
    chip = Searchable(speckled(cut(mean, (300, 300), SIZE).astype(np.float64), rng))
    found = [
        matched(chip, reference, expected((300, 300), off=(f, f))) for f in (0.0, 0.25, 0.5, 0.75)
    ]
    assert np.ptp([m.row for m in found]) < 0.02
    assert np.ptp([m.column for m in found]) < 0.02


def test_rows_and_columns_of_a_prediction_are_not_taken_for_each_other(scene):
    """Mutations of what an orbit predicts: exchanged axes and a sign of the shift are refused."""
    mean, reference, rng = scene
    center = np.array([250.0, 330.0])
    chip = Searchable(speckled(cut(mean, center, SIZE).astype(np.float64), rng))
    right = expected(center, sigma=8.0)
    assert matched(chip, reference, right).accepted
    swapped = Prediction(
        right.rows, right.columns, right.places.swapaxes(0, 1), right.covariance, right.linear
    )
    assert not matched(chip, reference, swapped).accepted
    back = expected(2 * np.array([309.5, 309.5]) - center, sigma=8.0)
    assert not matched(chip, reference, back).accepted


def test_what_lies_farther_off_than_predicted_is_refused(scene):
    """30 pixels at a sigma of 6: 5 sigmas, where 3.5 are searched."""
    mean, reference, rng = scene
    chip = Searchable(speckled(cut(mean, (300, 300), SIZE).astype(np.float64), rng))
    assert matched(chip, reference, expected((300, 300), sigma=6.0, off=(12, 0))).accepted
    assert not matched(chip, reference, expected((300, 300), sigma=6.0, off=(30, 0))).accepted


def test_a_correlated_prediction_searches_along_its_long_axis(scene):
    """Off by 40 pixels along a covariance of correlation 0.98: right on it, wrong across it."""
    mean, reference, rng = scene
    chip = Searchable(speckled(cut(mean, (300, 300), SIZE).astype(np.float64), rng))
    C = 20.0**2 * np.array([[1, 0.98], [0.98, 1]])
    for off, found in (((40, 40), True), ((40, -40), False)):
        first = np.array([300, 300]) - (SIZE - 1) / 2 + off
        where = Prediction.affine(np.column_stack([np.eye(2), first]), C, 1e-3, 1e-3)
        assert matched(chip, reference, where).accepted == found


def test_a_stretch_that_the_orbit_leaves_open_does_not_move_the_center(scene):
    """Rows 0.4 % too long, as a wrong velocity has them, move what is off the middle by 0.4 px."""
    mean, reference, rng = scene
    center = np.array([300.0, 300.0])
    A = np.array([[1, 0, 0], [0, 1.004, 300 * (1 - 1.004)]])  # x, y: of rows alone
    stretched = cut(cv2.warpAffine(mean.astype(np.float32), A, mean.shape[::-1]), center, SIZE)
    chip = Searchable(speckled(stretched.astype(np.float64), rng))
    at = (30.0, 127.5)
    true = 300 + (30 - 127.5) / 1.004
    free = expected(center)
    linear = np.diag([3e-3**2, 1e-6, 1e-6, 1e-6])
    freed = Prediction(free.rows, free.columns, free.places, free.covariance, linear)
    match = matched(chip, reference, freed, at)
    assert match.row == pytest.approx(true, abs=4 * match.sigma[0])
    assert match.linear[0, 0] - 1 == pytest.approx(1 / 1.004 - 1, abs=1.2e-3)
    held = matched(chip, reference, expected(center, turn=0.0, growth=0.0), at)
    assert abs(held.row - true) > 4 * held.sigma[0]


def test_another_point_than_the_middle_can_be_asked_for(scene):
    mean, reference, rng = scene
    chip = Searchable(speckled(cut(mean, (300, 300), SIZE).astype(np.float64), rng))
    middle, corner = (
        matched(chip, reference, expected((300, 300)), c) for c in (None, (20.0, 40.0))
    )
    assert corner.row - middle.row == pytest.approx(20 - 127.5, abs=0.5)
    assert corner.column - middle.column == pytest.approx(40 - 127.5, abs=0.5)
    assert np.linalg.det(corner.covariance) > np.linalg.det(middle.covariance)


def test_a_reference_of_other_spacing_and_order_is_matched_through_its_prediction(scene):
    """Turned by a right angle and twice as fine: a map that is not in the image's geometry."""
    mean, _, rng = scene
    finer = cv2.resize(np.rot90(mean).astype(np.float32), None, fx=2, fy=2)
    reference = Searchable(speckled(finer.astype(np.float64), rng))
    n = mean.shape[0] - 1
    # rot90: (row, column) goes to (n - column, row); cv2.resize puts k at 2 k + 0.5
    turned = np.array([[0.0, -2.0, 2 * n + 0.5], [2.0, 0.0, 0.5]])
    center = np.array([300.0, 280.0])
    chip = Searchable(speckled(cut(mean, center, SIZE).astype(np.float64), rng))
    first = turned @ [*(center - (SIZE - 1) / 2), 1.0]
    where = Prediction.affine(np.column_stack([turned[:, :2], first]), 9 * np.eye(2), 1e-3, 1e-3)
    match = matched(chip, reference, where)
    assert match.accepted
    true = turned @ [*center, 1.0]
    assert (match.row, match.column) == pytest.approx(true, abs=0.4)


def test_speckle_alone_is_refused(scene):
    _, reference, rng = scene
    for _ in range(10):
        match = matched(
            Searchable(speckled(np.ones((SIZE, SIZE)), rng)), reference, expected((310, 310))
        )
        assert not match.accepted
        assert match.reason in REASONS[1:]


def test_a_mirrored_and_an_unrelated_reference_are_refused(scene):
    mean, reference, rng = scene
    other = Searchable(speckled(surface(np.random.default_rng(99)), rng))
    mirrored = Searchable(np.ascontiguousarray(reference.amplitude[:, ::-1]))
    for _ in range(6):
        center = rng.uniform(190, 430, 2)
        chip = Searchable(speckled(cut(mean, center, SIZE).astype(float), rng))
        for wrong in (mirrored, other):
            assert not matched(chip, wrong, expected(center, sigma=60.0, turn=0.05)).accepted


def test_the_chance_of_a_wrong_place_is_no_smaller_than_it_says(scene):
    """Where nothing is right: of 40 chips of speckle it is below 0.25 at most 10 + 3 times 2.7, and
    about 1/40 at the least. It is larger than uniform, as peaks count that are not allowed."""
    _, reference, _ = scene
    rng = np.random.default_rng(5)
    where = expected((310, 310), 128)
    chances = [
        matched(Searchable(speckled(np.ones((128, 128)), rng)), reference, where).chance
        for _ in range(40)
    ]
    assert min(chances) > 1e-4
    assert np.sum(np.array(chances) < 0.25) <= 18
    assert min(chances) < 0.5


@pytest.mark.parametrize("beyond", [0.1, 0.5])
def test_a_fifth_may_lie_beyond_the_edge(scene, beyond):
    mean, _, rng = scene
    wide = speckled(mean, rng)
    first = 200 + round(beyond * SIZE)
    edge = Searchable(np.ascontiguousarray(speckled(mean, rng)[:, first:]))
    chip = Searchable(np.ascontiguousarray(wide[200:456, 200:456]))
    match = matched(chip, edge, expected((327.5, 327.5 - first), sigma=5.0))
    assert match.accepted == (beyond < 0.2)
    if match.accepted:
        assert (match.row, match.column) == pytest.approx((327.5, 327.5 - first), abs=0.3)


def test_what_was_not_seen_is_left_out(scene):
    """Zero is no amplitude: of half an image without data the other half is matched."""
    mean, reference, rng = scene
    chip = speckled(cut(mean, (300, 300), SIZE).astype(np.float64), rng)
    chip[:, 180:] = 0
    match = matched(Searchable(chip), reference, expected((300, 300)))
    assert match.accepted
    assert (match.row, match.column) == pytest.approx((300, 300), abs=0.5)


def test_a_dark_or_constant_image_is_refused_without_complaint(scene):
    _, reference, _ = scene
    for chip in (np.zeros((200, 200)), np.full((200, 200), 3.0)):
        match = matched(Searchable(chip), reference, expected((300, 300), 200))
        assert not match.accepted
        assert np.isnan(match.row)


def test_what_is_predicted_elsewhere_is_beyond_the_edge(scene):
    mean, reference, rng = scene
    chip = Searchable(speckled(cut(mean, (300, 300), SIZE).astype(np.float64), rng))
    match = matched(chip, reference, expected((5000, 300)))
    assert match.reason == "it lies beyond the edge of the reference"


def test_the_same_images_give_the_same_bytes(scene):
    mean, reference, _ = scene
    chip = speckled(cut(mean, (300, 300), 200).astype(float), np.random.default_rng(3))
    one, again = (
        matched(Searchable(chip), Searchable(reference.amplitude), expected((300, 300), 200))
        for _ in range(2)
    )
    assert one.covariance.tobytes() == again.covariance.tobytes()


@pytest.mark.parametrize(
    ("amplitude", "message"),
    [
        (np.zeros(100), "an image to be matched has 96 rows and columns at least"),
        (np.zeros((50, 500)), r"got shape \(50, 500\)"),
        (np.full((100, 100), np.nan), "must be finite and not negative"),
        (np.full((100, 100), -1.0), "must be finite and not negative"),
    ],
)
def test_what_is_no_image_is_refused(amplitude, message):
    with pytest.raises(ValueError, match=message):
        Searchable(amplitude)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"covariance": -np.eye(2)}, "is no covariance"),
        ({"covariance": np.full((2, 2), np.nan)}, "not finite"),
        ({"linear": np.eye(2)}, "has shape"),
        ({"places": np.zeros((3, 2, 2))}, "have shape"),
    ],
)
def test_an_impossible_prediction_is_refused(change, message):
    given = expected((300, 300))
    values = {
        "rows": given.rows,
        "columns": given.columns,
        "places": given.places,
        "covariance": given.covariance,
    }
    with pytest.raises(ValueError, match=message):
        Prediction(**(values | change))


def causeway(rng, width=24, n_points=40, shape=(620, 620)):
    """Mean amplitude of a narrow strip of land in the sea, and its direction [rad]."""
    angle = rng.uniform(0, np.pi)
    y, x = np.mgrid[: shape[0], : shape[1]] - 309.5
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    land = np.abs(across - 8 * np.sin(along / 90 + rng.uniform(0, 6))) < width / 2
    texture = np.sign(cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 6))
    power = np.where(land, np.exp(0.8 * texture), 0.02)
    points = rng.choice(np.flatnonzero(land), n_points, replace=False)
    power.flat[points] += 60
    return np.sqrt(cv2.GaussianBlur(power, (0, 0), 0.7)), angle


@pytest.mark.parametrize("points", [0, 40])
def test_a_scene_that_is_a_line_is_refused_or_right(points):
    """A causeway off the middle: with bright points it may be held, without it slides along
    itself. What is accepted is within 3.5 sigmas, and no sigma is beyond 0.35 pixels."""
    for seed in range(3):
        rng = np.random.default_rng([seed, 5])
        mean, angle = causeway(rng, n_points=max(points, 1))
        reference = Searchable(speckled(mean, rng))
        axes = np.array([[np.sin(angle), np.cos(angle)], [np.cos(angle), -np.sin(angle)]])
        for _ in range(4):
            off = rng.uniform(-60, 60), rng.uniform(20, 60) * rng.choice([-1, 1])
            center = 309.5 + off @ axes
            chip = speckled(cut(mean, center, SIZE).astype(float), rng)
            match = matched(Searchable(chip), reference, expected(center, off=rng.normal(0, 20, 2)))
            if match.accepted:
                error = np.array([match.row, match.column]) - center
                assert error @ np.linalg.solve(match.covariance, error) < 12.5 + 6
                assert np.sqrt(np.linalg.eigvalsh(match.covariance)[1]) <= 0.35 + 1e-6


def two_looks(name, radar):
    """Amplitudes of two disjoint looks of recorded echo."""
    file = DATA / "radarsat1_vancouver" / f"{name}.npz"
    if not file.is_file():
        pytest.skip(f"no real data: {file} is absent (set TERRAFIX_DATA)")
    lines = read_recording(file)
    echo = lines.read()
    near = 988647.462 + (lines.first_cell - 1) * radar.range_spacing
    fraction, _ = fractional_centroid(echo, radar.prf)
    centroid = unwrapped_centroid(fraction, radar.prf, -6900.0)
    domain = range_doppler(
        echo, radar, near_range=near, centroid=centroid, velocity=7062.0
    ).cropped()
    velocity = autofocus(SharpnessCurve(domain, 2.0), 7062.0).velocity
    return [np.abs(look.valid) for look in azimuth_looks(domain, velocity, 2)]


@pytest.mark.parametrize(
    "name",
    [
        "stanley_park",
        *(
            pytest.param(name, marks=pytest.mark.campaign)
            for name in ("airport", "ubc", "english_bay_2")
        ),
    ],
)
def test_disjoint_looks_of_real_echo_are_matched(points, name):
    """12 chips that do not overlap much; benchmarks/imaging.py has 100 at random and false ones.

    Their offsets from what they have in common: 0.8 to 1.25 sigmas are asked for, and along the
    track the looks are apart by up to 0.2 lines more, by how the radar moved.
    """
    one, other = two_looks(name, points.RADARSAT)
    reference = Searchable(other)
    found = []
    for i in np.linspace(0, one.shape[0] - SIZE, 4).astype(int):
        for j in np.linspace(0, one.shape[1] - SIZE, 3).astype(int):
            center = np.array([i, j]) + (SIZE - 1) / 2
            chip = Searchable(one[i : i + SIZE, j : j + SIZE])
            match = matched(chip, reference, expected(center, off=(7.3, -11.8)))
            if match.accepted:
                found.append(([match.row, match.column] - center, match.sigma))
    assert len(found) >= 9
    errors, sigmas = (np.array(x) for x in zip(*found, strict=True))
    assert np.abs(errors).max() < 0.6
    errors -= np.sum(errors / sigmas**2, axis=0) / np.sum(1 / sigmas**2, axis=0)
    assert 0.3 < np.sqrt(np.mean((errors[:, 1] / sigmas[:, 1]) ** 2)) < 1.6
    assert np.sqrt(np.mean((errors[:, 0] / sigmas[:, 0]) ** 2)) < 2.0


@pytest.mark.parametrize(("angle", "scale"), [(45.0, 1.0), (0.0, 1.1)])
def test_a_reference_that_shows_it_turned_or_of_other_spacing_is_told_by_which(scene, angle, scale):
    mean, reference, rng = scene
    chip = Searchable(speckled(cut(mean, (300, 300), SIZE, angle, scale).astype(np.float64), rng))
    where = expected((300, 300), sigma=10.0)
    assert not matched(chip, reference, where).accepted
    turn, growth = misplaced(chip, reference, where)
    assert abs(np.degrees(turn)) == pytest.approx(angle, abs=4.0)
    assert growth == pytest.approx(1 / scale - 1, abs=0.05)
    assert misplaced(Searchable(speckled(np.ones((SIZE, SIZE)), rng)), reference, where) is None
