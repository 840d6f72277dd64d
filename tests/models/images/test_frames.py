"""Frames of a scene: signs, scales, motion, codes."""

import numpy as np
import pytest

from terrafix.models.images.frames import (
    blurred,
    coded,
    frame_to_scene,
    hidden_square,
    inside,
    sampled,
    shifted,
    textured_scene,
    turned_back,
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


def test_a_turned_frame_is_shown_as_the_first_one(scene):
    """Turned by 3 degrees and 2 percent finer; turned the other way it is off by ten codes.

    Places are rounded to 1/32 pixel, twice, and slopes are up to 25 codes a pixel.
    """
    c, s = 1.02 * np.cos(np.radians(3.0)), 1.02 * np.sin(np.radians(3.0))
    from_first = np.array([[c, -s], [s, c]])
    smooth = blurred(scene, 2.0)
    turned = frame(smooth, (0.0, 0.0), view=from_first[None] / 100.0)
    back = turned_back(turned, from_first)[8:-8, 8:-8]
    np.testing.assert_allclose(back, frame(smooth, (0.0, 0.0))[8:-8, 8:-8], rtol=0, atol=1.3)


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


def test_a_shift_by_a_windowed_sinc_keeps_what_is_fine(scene):
    """There and back by 0.37 px: a wave of five pixels to 1 percent; whole shifts are exact."""
    wave = np.sin(2 * np.pi * np.arange(64) / 5)[None].repeat(64, 0).astype(np.float32)
    moved = shifted(wave, 0.0, 0.37)
    truth = np.sin(2 * np.pi * (np.arange(64) - 0.37) / 5)
    np.testing.assert_allclose(moved[32, 8:-8], truth[8:-8], atol=0.01)
    np.testing.assert_allclose(shifted(wave, 2.0, -3.0)[8:-8, 8:-8], wave[6:-10, 11:-5], atol=1e-6)
