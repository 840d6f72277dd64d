"""Frames of a scene, and matching them: signs, parts of pixels, refusal."""

import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter

from terrafix.models.images.frames import (
    METHODS,
    REASONS,
    blurred,
    coded,
    frame_to_scene,
    hidden_square,
    inside,
    least_squares_shift,
    match_frame,
    sampled,
    shifted,
    textured_scene,
)

NORTH_UP = np.array([[0.0, 1.0], [-1.0, 0.0]]) / 50.0  # a scene of 50 m
PLACE = np.array([255.5, 255.5])


@pytest.fixture(scope="module")
def scene():
    return blurred(textured_scene(512, seed=4), 1.0)


def frame(scene, target, size=48, view=None):
    view = np.eye(2)[None] / 100.0 if view is None else view
    at = frame_to_scene(np.array([target]), view, PLACE, NORTH_UP, size)
    return sampled(scene, at[0], size)


def test_a_target_north_in_the_frame_is_seen_up_and_east_to_the_right():
    """A single bright pixel of the scene at its place, seen at 3 px north and 5 px east."""
    scene = np.zeros((512, 512), np.float32)
    scene[255:257, 255:257] = 100.0  # about (255.5, 255.5)
    seen = frame(scene, (3.0, 5.0), size=49)  # whose middle is (24, 24)
    assert np.unravel_index(seen.argmax(), seen.shape) == (24 - 3, 24 + 5)


def test_a_view_that_is_half_as_fine_sees_twice_the_ground():
    scene = np.zeros((512, 512), np.float32)
    scene[255 - 40 : 257 - 40, 255:257] = 100.0  # 40 pixels of 50 m, 2 km to the north
    fine, coarse = (
        frame(scene, (0.0, 0.0), 49, np.eye(2)[None] / meters) for meters in (100.0, 200.0)
    )
    assert np.unravel_index(fine.argmax(), (49, 49)) == (24 - 20, 24)
    assert np.unravel_index(coarse.argmax(), (49, 49)) == (24 - 10, 24)


def test_a_turned_scene_is_seen_with_north_up():
    """Grid north off by 30 degrees: as an unturned scene, but for places rounded to 1/32 pixel."""
    y, x = np.mgrid[:512, :512] - 255.5
    angle = np.radians(30.0)
    c, s = np.cos(angle), np.sin(angle)

    def ground(east, north):
        return 128 + 50 * np.sin(east / 2800.0) * np.cos(north / 2000.0) + east / 300.0

    straight = ground(50 * x, -50 * y).astype(np.float32)
    turned = ground(50 * (c * x + s * y), -50 * (c * y - s * x)).astype(np.float32)
    grid = np.array([[s, c], [-c, s]]) / 50.0
    view = np.eye(2)[None] / 100.0
    at = frame_to_scene(np.array([[1.3, -2.4]]), view, PLACE, grid, 48)
    np.testing.assert_allclose(sampled(turned, at[0], 48), frame(straight, (1.3, -2.4)), atol=0.15)


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


def test_frames_beyond_the_scene_are_told():
    view = np.eye(2)[None] / 100.0
    for target, there in (((0.0, 0.0), True), ((110.0, 0.0), False), ((0.0, -110.0), False)):
        at = frame_to_scene(np.array([target]), view, PLACE, NORTH_UP, 48)
        assert inside(at, 48, (512, 512)).tolist() == [there]


def test_motion_is_a_mean_over_its_line():
    """A step seen while it moves by 4 pixels is a ramp of 4 pixels; sums are kept."""
    step = np.zeros((64, 64), np.float32)
    step[:, 32:] = 1.0
    seen = blurred(step, 0.0, (0.0, 4.0))[32]
    np.testing.assert_allclose(
        seen[26:38], np.interp(np.arange(26, 38), [29.5, 33.5], [0, 1]), atol=0.03
    )
    assert blurred(step, 0.0).sum() == step.sum()


def test_codes_are_whole_and_cut_off():
    rng = np.random.default_rng(0)
    image = coded(np.linspace(-20, 300, 64 * 64, dtype=np.float32).reshape(64, 64), 3.0, 8, rng)
    assert set(np.unique(image)) <= set(range(256))
    assert coded(image, 0.0, 0, rng) is image


def test_a_cloud_hides_its_square():
    image = np.zeros((48, 48), np.float32)
    hidden_square(image, 24, np.random.default_rng(0))
    assert (image > 0).mean() == pytest.approx(0.25, abs=1e-9)


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
    """200 draws of noise in the template alone: spread of the shift as told, to 10 percent."""
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


def test_a_shift_by_a_windowed_sinc_keeps_what_is_fine(scene):
    """There and back by 0.37 px: a wave of five pixels to 1 percent; whole shifts are exact."""
    wave = np.sin(2 * np.pi * np.arange(64) / 5)[None].repeat(64, 0).astype(np.float32)
    moved = shifted(wave, 0.0, 0.37)
    truth = np.sin(2 * np.pi * (np.arange(64) - 0.37) / 5)
    np.testing.assert_allclose(moved[32, 8:-8], truth[8:-8], atol=0.01)
    np.testing.assert_allclose(shifted(wave, 2.0, -3.0)[8:-8, 8:-8], wave[6:-10, 11:-5], atol=1e-6)


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
