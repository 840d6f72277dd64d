"""Rendering: coverage is exact, a scene has the statistics that were asked for."""

from time import process_time

import numpy as np
import pytest
import shapely
from scipy.special import ndtr

from terrafix.models.images.polygons import clip_to_frame, moments
from terrafix.models.images.rendering import (
    Appearance,
    cloud_opacity,
    render_polygon,
    render_scene,
    ring_coverage,
)


def lake(n=200, size=60.0, center=(160.0, 128.0)):
    """A lobed outline, concave, of n vertices."""
    t = 2 * np.pi * np.arange(n) / n
    r = size * (1 + 0.35 * np.cos(3 * t) + 0.15 * np.sin(7 * t))
    return np.stack([r * np.cos(t), 0.4 * r * np.sin(t)], 1) + np.array(center)


def pixelwise(polygon, width, height):
    """Area of the intersection with every pixel's square: an independent way."""
    y, x = np.mgrid[:height, :width]
    squares = shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5)
    return shapely.area(shapely.intersection(polygon, squares))


# ------------------------------------------------------------------------------------- coverage


def test_a_rectangle_covers_parts_of_pixels():
    """From 0.75 to 2.5 and 1 to 2.25: by hand, pixels are centered on whole numbers."""
    f = render_polygon([[0.75, 1], [2.5, 1], [2.5, 2.25], [0.75, 2.25]], 4, 4)
    expected = np.outer([0, 0.5, 0.75, 0], [0, 0.75, 1, 0])
    np.testing.assert_allclose(f, expected, atol=1e-15)


def test_a_triangle_halves_its_pixels():
    f = render_polygon([[-0.5, -0.5], [2.5, 2.5], [-0.5, 2.5]], 3, 3)
    np.testing.assert_allclose(f, np.tri(3) - 0.5 * np.eye(3), atol=1e-15)


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("center", [(22.3, 14.6), (2.0, 1.0), (39.0, 27.0), (20.0, -3.0)])
def test_coverage_is_the_exact_area(center, turn):
    """Inside, across each corner and beyond a border; to 1e-12 (rounding of 60 px)."""
    ring = lake(40, 12.0, center)[::turn]
    f = render_polygon(ring, 40, 28)
    np.testing.assert_allclose(f, pixelwise(shapely.Polygon(ring), 40, 28), atol=1e-12)


def test_vertices_on_borders_and_at_corners_of_pixels():
    ring = np.array([[0.5, 0.5], [6.5, 0.5], [8.5, 4.5], [4.5, 3.5], [4.0, 7.5], [0.5, 7.5]])
    np.testing.assert_allclose(
        render_polygon(ring, 10, 9), pixelwise(shapely.Polygon(ring), 10, 9), atol=1e-14
    )


def test_islands_are_cut_out():
    """Whichever way they turn."""
    island = lake(12, 3.0, (24.0, 14.0))
    polygon = shapely.Polygon(lake(40, 12.0, (22, 14)), [island])
    assert polygon.is_valid
    for hole in (island, island[::-1]):
        f = render_polygon(lake(40, 12.0, (22, 14)), 40, 28, holes=[hole])
        np.testing.assert_allclose(f, pixelwise(polygon, 40, 28), atol=1e-12)


def test_the_sum_is_the_area_within_the_frame():
    for center in ((160.0, 128.0), (0.0, 128.0), (310.0, 250.0), (160.0, -4.0), (160.0, 260.0)):
        ring = lake(center=center)
        area = sum(moments(part)[0][0] for part in clip_to_frame(ring, 320, 256).rings)
        assert render_polygon(ring, 320, 256).sum() == pytest.approx(area, abs=1e-8)


def test_a_polygon_out_of_sight_or_around_the_frame():
    for center in ((900, 128), (-900, 128), (160, 900), (160, -900)):
        assert np.abs(render_polygon(lake(center=center), 320, 256)).max() < 1e-12
    np.testing.assert_allclose(render_polygon(lake(4, 9e3), 32, 16), 1.0, atol=1e-11)
    assert not ring_coverage([], 5, 4).any()


def test_coverage_is_quick():
    """A few milliseconds; the best of ten, since others use the machine."""
    ring, took = lake(), []
    for _ in range(10):
        start = process_time()
        render_polygon(ring, 320, 256)
        took.append(process_time() - start)
    assert min(took) < 10e-3


# ------------------------------------------------------------------------------------- scene

RNG = np.random.default_rng


def test_reflectances_and_light():
    """Without noise and codes: light times reflectance, by hand."""
    f = np.array([[0.0, 1.0, 0.5], [0.0, 0.0, 1.0], [0.25, 0.0, 0.0]])
    look = Appearance(water=0.1, land=0.3, bits=0, gradient=(0.4, -0.2))
    image = render_scene(f, look, RNG(0))
    light = 1 + np.array([[-0.2, 0, 0.2]]) - np.array([[-0.1], [0], [0.1]])
    np.testing.assert_allclose(image, light * (0.1 * f + 0.3 * (1 - f)), rtol=1e-14)


def test_the_point_spread_keeps_the_sum_and_adds_its_variance():
    ring = lake(40, 12.0, (40, 30))
    f = render_polygon(ring, 80, 60)
    y, x = np.mgrid[:60, :80]

    def spread(g):
        return [(g * (a - (g * a).sum() / g.sum()) ** 2).sum() / g.sum() for a in (x, y)]

    for blur in (0.3, 0.7, 1.5):
        g = render_polygon(ring, 80, 60, blur=blur)
        assert g.sum() == pytest.approx(f.sum(), rel=1e-9)
        # pixels of f hold other harmonics than those of g: 0.01 px^2
        np.testing.assert_allclose(np.subtract(spread(g), spread(f)), blur**2, atol=0.01)


@pytest.mark.parametrize("blur", [0.5, 0.7, 1.2])
def test_the_point_spread_of_a_straight_edge(blur):
    """An error function, averaged over pixels: the closed form, as two of its integrals."""
    edge = 20.3
    g = render_polygon([[-90, -90], [edge, -90], [edge, 90], [-90, 90]], 40, 12, blur=blur)

    def integral(x):  # of the normal distribution function
        return x * ndtr(x / blur) + blur * np.exp(-((x / blur) ** 2) / 2) / np.sqrt(2 * np.pi)

    x = np.arange(40)
    expected = integral(edge - x + 0.5) - integral(edge - x - 0.5)
    # trapezoidal rule at half of blur, across a kink: (blur / 2)^2 / 12 of 0.4 / blur at most
    np.testing.assert_allclose(g, np.broadcast_to(expected, g.shape), atol=5e-3)


def test_the_point_spread_sees_beyond_the_border():
    ring = lake(40, 12.0, (30, 20))
    whole = render_polygon(ring, 70, 50, blur=0.7)
    part = render_polygon(ring - np.array([22, 14]), 16, 12, blur=0.7)
    np.testing.assert_allclose(part, whole[14:26, 22:38], atol=1e-9)
    assert not render_polygon(ring + 500, 16, 12, blur=0.7).any()


def test_noise_and_codes():
    """Variance of the noise plus 1/12 of a code's step; within 4.5 standard errors."""
    f, n = np.zeros((200, 300)), 60_000
    for bits in (8, 12):
        step = 1 / (2**bits - 1)
        image = render_scene(f, Appearance(land=0.4, noise=0.01, bits=bits), RNG(1))
        np.testing.assert_array_equal(image, np.rint(image))
        assert np.var(image * step) == pytest.approx(
            0.01**2 + step**2 / 12, rel=4.5 * np.sqrt(2 / n)
        )
        assert image.mean() * step == pytest.approx(0.4, abs=4.5 * 0.011 / np.sqrt(n))
    bright = render_scene(f, Appearance(land=3.0, bits=8), RNG(1))
    np.testing.assert_array_equal(bright, 255)


def test_the_same_seed_gives_the_same_image():
    f = render_polygon(lake(), 320, 256)
    images = [render_scene(f, Appearance(noise=0.01), RNG(k)) for k in (3, 3, 4)]
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()


def test_clouds_cover_their_share_and_hide_what_is_below():
    for share in (0.0, 0.2, 1.0):
        alpha = cloud_opacity(320, 256, share, RNG(2))
        assert alpha.shape == (256, 320)
        assert (alpha > 0).mean() == pytest.approx(share, abs=1e-4)
    alpha = cloud_opacity(320, 256, 0.3, RNG(2))
    assert alpha.min() == 0
    assert alpha.max() == 1
    f = render_polygon(lake(), 320, 256)
    look = Appearance(bits=0)
    hidden = [render_scene(g, look, RNG(0), alpha) for g in (f, 1 - f)]
    np.testing.assert_allclose(hidden[0][alpha == 1], look.cloud)
    np.testing.assert_allclose(
        (hidden[0] - hidden[1]), (1 - alpha) * (look.water - look.land) * (2 * f - 1), atol=1e-12
    )


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: render_polygon([[0, 0], [2, 2], [2, 0], [0, 2]], 9, 9), "does not cross itself"),
        (lambda: render_polygon([[0, 0], [2, 2]], 9, 9), "three vertices or more, got 2"),
        (lambda: render_polygon(lake(), 9, 0), "one pixel or more along each side, got 9 x 0"),
        (lambda: render_polygon(lake(), 9, 9, [[[0, np.nan], [1, 1], [1, 0]]]), "got a NaN"),
        (lambda: render_polygon(lake(), 9, 9, blur=-1), "blur is 0 px or more, got -1"),
        (lambda: Appearance(noise=-1), "noise must be 0 or more, got -1"),
        (lambda: Appearance(full_scale=0), "full_scale must be positive, got 0"),
        (lambda: Appearance(gradient=(1.5, 0.6)), "light in every corner"),
        (lambda: render_scene(np.zeros(4), Appearance(), RNG(0)), r"image \(height, width\), got"),
        (
            lambda: render_scene(np.zeros((4, 5)), Appearance(), RNG(0), np.zeros((5, 4))),
            r"shape of the coverage, \(4, 5\), got \(5, 4\)",
        ),
        (lambda: cloud_opacity(9, 9, 1.2, RNG(0)), "0 to 1, got 1.2"),
        (lambda: cloud_opacity(9, 9, 0.2, RNG(0), size=0), "are positive, got 0 px"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
