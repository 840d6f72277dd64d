"""Frames matched: parts of pixels, noise, what hides the ground, refusal."""

import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter

from terrafix.models.images.frame_matching import (
    METHODS,
    REASONS,
    least_squares_shift,
    match_frame,
)
from terrafix.models.images.frames import blurred, coded, frame_to_scene, sampled, textured_scene

NORTH_UP = np.array([[0.0, 1.0], [-1.0, 0.0]]) / 50.0  # a scene of 50 m
PLACE = np.array([255.5, 255.5])


@pytest.fixture(scope="module")
def scene():
    return blurred(textured_scene(512, seed=4), 1.0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shift", [(0, 0), (3, -5), (-6, 2)])
def test_whole_shifts_are_found(scene, method, shift):
    image = scene[100:164, 100:164]
    i, j = shift
    template = scene[108 + i : 156 + i, 108 + j : 156 + j]
    match = match_frame(template, image, method=method, subpixel=False)
    assert (match.row, match.column, match.reason) == (i, j, 0)
    assert match.correlation == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(("method", "worst"), [("ssd", 0.1), ("ncc", 0.1), ("phase", 0.2)])
def test_parts_of_pixels_are_found_to_a_tenth(method, worst):
    """Of a scene shifted exactly, by its spectrum: the error of a parabola, with no noise."""
    rough = gaussian_filter(np.random.default_rng(2).standard_normal((128, 128)), 1.2, mode="wrap")
    for part in (0.2, 0.5, 0.7):
        moved = np.fft.ifft2(fourier_shift(np.fft.fft2(rough), (part, -part))).real
        image, template = (100 * a.astype(np.float32) for a in (moved, rough))
        match = match_frame(template[40:88, 40:88], image[36:92, 36:92], method=method)
        assert match.row == pytest.approx(part, abs=worst)
        assert match.column == pytest.approx(-part, abs=worst)


def test_noise_moves_a_match_as_its_bend_says():
    """200 pairs with noise of 8 codes at whole shifts: predicted sigma within 15 percent."""
    scene = blurred(textured_scene(256, seed=9), 1.0)
    rng = np.random.default_rng(0)
    found, told = [], []
    for method in ("ssd", "ncc"):
        for _ in range(200):
            a, b = (coded(scene[x:y, x:y], 8.0, 0, rng) for x, y in ((100, 132), (96, 136)))
            match = match_frame(a, b, method=method, noise=8.0)
            found.append((match.row, match.column))
            told.append((match.sigma_row, match.sigma_column))
    for half in (slice(0, 200), slice(200, 400)):
        spread = np.std(found[half], axis=0)
        np.testing.assert_allclose(spread, np.mean(told[half], axis=0), rtol=0.15)
    assert match_frame(a, b, method="phase", noise=8.0).sigma_row == 0.0


def test_light_throws_squares_and_not_correlation(scene):
    """A frame lighter by 60 percent: normalized correlation finds it, and says it is alike."""
    template, image = scene[110:142, 113:145] * 1.6, scene[100:152, 100:152]
    right = match_frame(template, image, method="ncc", subpixel=False)
    assert (right.row, right.column) == (0, 3)
    wrong = match_frame(template, image, method="ssd", subpixel=False)
    assert (wrong.row, wrong.column, wrong.reason) != (0, 3, 0)


@pytest.mark.parametrize("method", METHODS)
def test_a_frame_without_texture_is_refused(method):
    """Noise alone, and nothing at all."""
    rng = np.random.default_rng(1)
    image = coded(np.full((64, 64), 100.0, np.float32), 4.0, 8, rng)
    match = match_frame(image[8:56, 8:56], image, method=method, noise=4.0)
    assert REASONS[match.reason] == "no texture"
    flat = np.full((64, 64), 100.0, np.float32)
    assert REASONS[match_frame(flat[8:56, 8:56], flat, method=method).reason] == "no texture"


@pytest.mark.parametrize("method", METHODS)
def test_another_place_is_refused(scene, method):
    """40 pairs of places that are not the same: none is accepted."""
    rng = np.random.default_rng(3)
    for _ in range(40):
        i, j = rng.integers(0, 100, 2)
        template, image = scene[i : i + 48, j : j + 48], scene[300:364, j + 200 : j + 264]
        match = match_frame(template, image, method=method, least=0.8)
        assert match.reason in (2, 3)
        assert np.isnan(match.row)


def test_a_peak_at_the_edge_is_refused(scene):
    """The template lies one pixel beyond the gate."""
    match = match_frame(scene[100:148, 100:148], scene[101:157, 96:152], method="ssd")
    assert REASONS[match.reason] == "the peak lies at the edge of the gate"


def test_bad_input_is_refused(scene):
    with pytest.raises(ValueError, match="method must be one of"):
        match_frame(scene[:48, :48], scene[:64, :64], method="sift")
    with pytest.raises(
        ValueError, match="a template of 64 x 64 pixels cannot be sought in an imag"
    ):
        match_frame(scene[:64, :64], scene[:48, :48])


def pair(scene, shift, n=40, noise=0.0, seed=0):
    """A template and the window of two pixels more that it lies in, but for a shift (down, right).

    Both sampled twice as coarsely as the scene is, behind a point spread of one pixel of theirs.
    """
    rng = np.random.default_rng(seed)
    smooth, view = blurred(scene, 2.0), np.eye(2)[None] / 100.0
    images = []
    for target, size in (((shift[0], -shift[1]), n), ((0.0, 0.0), n + 4)):
        at = frame_to_scene(np.array([target]), view, PLACE, NORTH_UP, size)[0]
        images.append(coded(sampled(smooth, at, size), noise, 0, rng))
    return images


def test_least_squares_have_no_error_by_the_part_of_a_pixel(scene):
    """Shifts to 0.3 px, found to the second order: a second look at what is left is exact."""
    for shift in ((0.3, -0.2), (0.05, 0.0), (-0.25, 0.25)):
        found = least_squares_shift(*pair(scene, shift))
        assert np.hypot(found.row - shift[0], found.column - shift[1]) < 0.03
    same = least_squares_shift(*pair(scene, (0.0, 0.0)))
    assert (same.row, same.column) == (0.0, 0.0)


def test_least_squares_tell_the_noise_of_a_template(scene):
    """200 draws of noise in the template alone: spread of the shift as told, to 15 percent."""
    template, image = pair(scene, (0.0, 0.0))
    rng = np.random.default_rng(4)
    found = [
        least_squares_shift(coded(template, 4.0, 0, rng), image, noise=4.0) for _ in range(200)
    ]
    for axis in ("row", "column"):
        spread = np.std([getattr(f, axis) for f in found])
        assert spread == pytest.approx(
            np.mean([getattr(f, f"sigma_{axis}") for f in found]), rel=0.15
        )


def test_two_clouds_are_left_out_and_what_they_hold_together_is_refused(scene):
    """A third of both is hidden, not the same: found. Nine tenths of one: refused."""
    template, image = (x.copy() for x in pair(scene, (0.1, -0.1)))
    template[:23, :23], image[-25:, -25:] = 250.0, 250.0
    found = least_squares_shift(template, image, noise=1.0)
    assert found.reason == 0
    assert np.hypot(found.row - 0.1, found.column + 0.1) < 0.03
    hidden = template.copy()
    hidden[:36] = 250.0
    assert least_squares_shift(hidden, image).reason != 0
