"""Coastline: area and moments of water without bias, noise as stated, clouds and frame excluded."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from contourpy import contour_generator
from scipy.ndimage import gaussian_filter

from terrafix.models.images.coastline import coastline, gray_moments
from terrafix.models.images.polygons import distances, moments
from terrafix.models.images.rendering import (
    Appearance,
    cloud_opacity,
    render_polygon,
    render_scene,
)

DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))
WIDTH, HEIGHT = 320, 256
RNG = np.random.default_rng


def bay(shift=(0.0, 0.0)):
    """A long narrow lake with bays, 176 x 36 px and 3 to 14 px wide, 60 vertices."""
    x = np.linspace(-88, 88, 30)
    middle = 8 * np.sin(x / 30) + 0.08 * x
    half = 4.2 + 2.5 * np.sin(x / 11) * np.cos(x / 29) * (1 - (x / 88) ** 6)
    ring = np.concatenate([np.stack([x, middle - half], 1), np.stack([x, middle + half], 1)[::-1]])
    return ring + np.array([160.0, 128.0]) + np.array(shift)


def seneca(shift=(0.0, 0.0)):
    """The outline of Lake Seneca at 176 x 33 px, by an affine map."""
    file = DATA / "lakes_gshhg" / "seneca_full.csv"
    if not file.is_file():
        pytest.skip(f"no real data: {file} is absent (set TERRAFIX_DATA)")
    ring = np.loadtxt(file, delimiter=",")[:-1, ::-1]
    ring = ring / np.ptp(ring, axis=0) * np.array([175.9, 32.636])
    return ring - ring.mean(axis=0) + np.array([160.0, 128.0]) + np.array(shift)


LAKES = {"bay": bay, "seneca": seneca}


def camera(ring, blur, n=8):
    """Coverage through a continuous Gaussian and a pixel's square, n x n samples to a pixel.

    An independent way: finer, and with a Gaussian that is sampled.
    """
    fine = render_polygon((ring + 0.5) * n - 0.5, n * WIDTH, n * HEIGHT)
    fine = gaussian_filter(fine, n * blur, truncate=6) if blur else fine
    return fine.reshape(HEIGHT, n, WIDTH, n).mean(axis=(1, 3))


def seen(coverage, noise=0.0, rng=None):
    """Image with land 0.25 and water 0.05; noise relative to the contrast."""
    return 0.25 - 0.2 * (coverage + (noise * rng.standard_normal(coverage.shape) if noise else 0))


def measured(image, blur=0.0):
    """Moments of the one ring, and of the coverage."""
    c = coastline(image, blur=blur)
    assert len(c.rings) == 1
    assert c.rings[0].whole
    gray, P, bias = gray_moments(c.coverage, c.noise, c.band, gain=c.gain, blur=blur)
    return moments(c.rings[0].vertices)[0], gray - bias, P, c


def placed(rng):
    return rng.uniform(-0.5, 0.5, 2)


# ------------------------------------------------------------------------------------- bias


@pytest.mark.parametrize("lake", LAKES)
@pytest.mark.parametrize("blur", [0.0, 0.7, 1.2])
def test_area_is_unbiased(lake, blur):
    """0.05 percent of area, that is 1.4 km of altitude at 550 km; second moments 0.05 percent."""
    for seed in range(3):
        ring = LAKES[lake](placed(RNG(seed)))
        m, _ = moments(ring)
        fit, gray, _, _ = measured(seen(camera(ring, blur, 1 if blur == 0 else 6)), blur)
        for got in (fit, gray):
            assert abs(got[0] / m[0] - 1) < 5e-4
            np.testing.assert_allclose(got[1:3], m[1:3], atol=2e-3)
            np.testing.assert_allclose(got[3:], m[3:], atol=5e-4 * m[3])


@pytest.mark.parametrize("lake", LAKES)
def test_filled_masks_and_contours_of_opencv_are_biased(lake):
    """Some 10 percent either way, as the notes have it; a plain contour of the coverage by less."""
    filled, traced, plain = [], [], []
    for seed in range(6):
        ring = LAKES[lake](placed(RNG(seed)))
        area = moments(ring)[0][0]
        raster = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.fillPoly(raster, [np.rint(ring).astype(np.int32)], 1)
        filled.append(raster.sum() / area - 1)
        f = render_polygon(ring, WIDTH, HEIGHT)
        rings, _ = cv2.findContours(
            (f > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        traced.append(sum(cv2.contourArea(c) for c in rings) / area - 1)
        line = max(contour_generator(z=f).lines(0.5), key=len)[:-1]
        plain.append(moments(line)[0] - moments(ring)[0])
    assert 0.07 < np.mean(filled) < 0.14
    assert -0.14 < np.mean(traced) < -0.07
    assert np.mean(plain, axis=0)[3] < -0.5, "capes are rounded off: the fit has work to do"


def test_light_may_vary_and_codes_may_be_coarse():
    """A plane of light is taken out exactly: the same area to rounding, or to 8 bits."""
    ring = bay((0.2, 0.3))
    m, _ = moments(ring)
    f = render_polygon(ring, WIDTH, HEIGHT, blur=0.7)
    for gradient in ((0.0, 0.0), (0.6, -0.4), (-0.5, 0.5)):
        look = Appearance(bits=0, gradient=gradient)
        fit, gray, _, _ = measured(render_scene(f, look, RNG(0)), 0.7)
        for got in (fit, gray):
            assert abs(got[0] / m[0] - 1) < 1e-4
        coarse = Appearance(bits=8, gradient=gradient, noise=0.002)
        fit, gray, P, _ = measured(render_scene(f, coarse, RNG(0)), 0.7)
        for got in (fit, gray):
            assert np.all(np.abs(got - m) < 4.5 * np.sqrt(np.diag(P)) + 5e-4 * np.abs(m))


def test_brightness_may_have_any_unit():
    f = render_polygon(bay((0.2, 0.3)), WIDTH, HEIGHT)
    one, other = (coastline(scale * seen(f)).rings[0] for scale in (1.0, 4000.0))
    np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-9)


# ------------------------------------------------------------------------------------- noise


@pytest.mark.parametrize(
    ("blur", "noise"),
    [(0.0, 0.05), pytest.param(0.7, 0.01, marks=pytest.mark.campaign), (0.7, 0.05)],
)
def test_noise_is_as_stated(blur, noise):
    """Over 60 images: standard deviations to 4 standard errors, 4 / sqrt(120); means to 4.5.

    A bias of 0.05 percent is left to either estimator, as above.
    """
    n, rng = 60, RNG(11)
    fits, grays, off, stated = [], [], [], []
    for _ in range(n):
        ring = bay(placed(rng) - np.array([60, 92]))
        m, _ = moments(ring)
        f = render_polygon(ring, 200, 72, blur=blur)
        fit, gray, P, c = measured(seen(f, noise, rng), blur)
        fits.append(fit - m)
        grays.append(gray - m)
        off.append(distances(c.rings[0].vertices, ring).signed.std())
        stated.append(c.rings[0].sigma)
        assert c.noise == pytest.approx(noise, rel=0.05)
    sigma = np.sqrt(np.diag(P))
    for got in (np.array(fits), np.array(grays)):
        np.testing.assert_allclose(got.std(axis=0, ddof=1) / sigma, 1, atol=4 / np.sqrt(2 * n))
        left = 5e-4 * np.array([m[0], 0, 0, m[3], m[3], m[3]])
        assert np.all(np.abs(got.mean(axis=0)) < 4.5 * sigma / np.sqrt(n) + left)
    assert np.mean(stated) == pytest.approx(np.mean(off), rel=0.25)


@pytest.mark.parametrize("blur", [0.0, 0.8])
def test_gray_moments_of_a_rectangle(blur):
    """Over all places within a pixel, b h, b^2/12, h^2/12: the closed form.

    Each alone is off: what covers whole pixels lacks 1/6 px^2 of it.
    """
    corners, n = np.array([[0, 0], [12, 0], [12, 4], [0, 4]]) - 0.5, 8
    got = []
    for i in range(n):
        for j in range(n):
            f = render_polygon(corners + np.array([14 + i / n, 13 + j / n]), 40, 30, blur=blur)
            m, P, bias = gray_moments(f, blur=blur)
            got.append(m - [0, i / n, j / n, 0, 0, 0])
    assert not P.any()
    assert not bias.any()
    # by place, the error is a parabola from -1/6 to 1/12: its mean over n places is off by 1/6 n^2
    expected = [48, 19.5, 14.5, 12, 16 / 12, 0]
    np.testing.assert_allclose(np.mean(got, axis=0), expected, atol=1 / 6 / n**2 + 1e-9)
    if blur == 0:
        np.testing.assert_allclose(got[0], [48, 19.5, 14.5, 12 - 1 / 6, 16 / 12 - 1 / 6, 0])


def test_noise_of_gray_moments_is_that_of_monte_carlo():
    """8000 draws of noise in a band and of a shared factor, within 4.5 standard errors."""
    f = render_polygon(bay((-110, -110)) * 0.3 + np.array([5.0, 8.0]), 60, 30)
    smooth = gaussian_filter(f, 0.7)
    band = (smooth > 1e-3) & (smooth < 1 - 1e-3)
    rng, n, sigma, gain = RNG(2), 8000, 0.05, 0.01
    m, P, bias = gray_moments(f, sigma, band, gain=gain)
    drawn = np.array(
        [
            gray_moments(
                f + band * (sigma * rng.standard_normal(f.shape) + gain * rng.standard_normal() * f)
            )[0]
            for _ in range(n)
        ]
    )
    error = np.sqrt(np.diag(P) / n)
    # the factor has a bias of the order of gain^2, 1e-4, of moments
    assert np.all(np.abs(drawn.mean(axis=0) - m - bias) < 4.5 * error + 1e-4 * np.abs(m))
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    np.testing.assert_allclose(np.cov(drawn.T) / scale, P / scale, atol=4.5 * np.sqrt(2 / n) + 0.01)


def test_the_bias_of_gray_moments_is_half_the_trace_of_the_hessian():
    """By second differences of every pixel of a band, with steps of 0.1: to h^2 / A^2."""
    f = render_polygon(small := bay() * 0.1 + np.array([0.3, -4.0]), 36, 18)
    assert moments(small)[0][0] > 10
    band = gaussian_filter(f, 0.7) > 1e-3
    m, _, bias = gray_moments(f, 0.2, band)
    trace, h = np.zeros(6), 0.1
    for row, column in np.argwhere(band):
        step = np.zeros(f.shape)
        step[row, column] = h
        trace += (gray_moments(f + step)[0] - 2 * m + gray_moments(f - step)[0]) / h**2
    np.testing.assert_allclose(bias, 0.2**2 / 2 * trace, rtol=2e-3, atol=1e-9)
    assert np.abs(bias[3:]).max() > 1e-3


def test_the_shared_factor_is_that_of_the_mean_of_clear_water():
    """Noise over the square root of the number of pixels that hold water alone."""
    ring = bay((0.2, 0.3))
    f = render_polygon(ring, WIDTH, HEIGHT, blur=0.7)
    c = coastline(seen(f, 0.02, RNG(3)), blur=0.7)
    # at 0.99 the contour's own noise moves some pixels over the border
    assert c.gain == pytest.approx(0.02 / np.sqrt((f > 0.99).sum()), rel=0.05)


# ------------------------------------------------------------------------------------- shapes


def test_a_ring_is_near_the_outline_it_came_from():
    """Pixels' rounding of capes is 0.05 px rms; within 0.5 px everywhere."""
    ring = bay((0.3, -0.2))
    c = coastline(seen(render_polygon(ring, WIDTH, HEIGHT)))
    off = distances(c.rings[0].vertices, ring)
    assert off.distance.max() < 0.5
    assert off.signed.std() < 0.05
    assert c.rings[0].sigma == pytest.approx(off.signed.std(), abs=0.015)
    assert not c.rings[0].island
    assert not c.hidden.any()
    assert c.mask.sum() == pytest.approx(moments(ring)[0][0], rel=0.02)


def test_islands_and_other_lakes_are_rings_of_their_own():
    t = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    big, island, other = 40 * circle + 100, 8 * circle + 105, 12 * circle + [240, 60]
    f = render_polygon(big, WIDTH, HEIGHT, [island]) + render_polygon(other, WIDTH, HEIGHT)
    rings = coastline(seen(f)).rings
    assert [r.island for r in rings] == [False, False, True]
    for ring, true in zip(rings, (big, other, island), strict=True):
        m, _ = moments(true)
        np.testing.assert_allclose(moments(ring.vertices)[0], m, rtol=5e-4, atol=2e-3)
    x, y = np.moveaxis(rings[2].vertices - rings[2].vertices[0], -1, 0)
    assert (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0


def test_a_lake_at_the_frame_is_not_whole():
    c = coastline(seen(render_polygon(bay((100, 0)), WIDTH, HEIGHT)))
    (ring,) = c.rings
    assert not ring.whole
    x = ring.vertices[:, 0]
    np.testing.assert_array_equal(~ring.coast, x > WIDTH - 0.5 - 1e-6)
    off = distances(ring.vertices[ring.coast], bay((100, 0)))
    assert off.distance.max() < 0.5


# ------------------------------------------------------------------------------------- clouds


def test_edges_of_clouds_are_no_coast():
    """What is said to be coast is one, to half a pixel or 5 sigma, whatever the clouds."""
    judged = cut = 0
    for seed in range(8):
        ring = bay(placed(RNG(seed)))
        f = render_polygon(ring, WIDTH, HEIGHT, blur=0.7)
        alpha = cloud_opacity(WIDTH, HEIGHT, 0.25, RNG(100 + seed))
        look = Appearance(noise=0.002, gradient=(0.2, 0.1))
        c = coastline(render_scene(f, look, RNG(seed), alpha), blur=0.7)
        assert c.hidden[alpha > 0.3].all()
        assert not (c.mask & (alpha > 0.3)).any()
        for part in c.rings:
            off = distances(part.vertices[part.coast], ring)
            judged += len(off.distance)
            assert off.distance.max(initial=0) < 0.75
        cut += sum(not part.whole for part in c.rings)
    assert judged > 1000
    assert cut >= 3, "clouds must lie on the lake to be tested"


def test_a_soft_edge_of_a_cloud_across_the_lake_is_no_coast():
    """It darkens from cloud to water over 40 px: nowhere is there a border, but gray."""
    t = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    ring = np.stack([150 + 60 * np.cos(t), 120 + 50 * np.sin(t)], axis=1)
    f = render_polygon(ring, WIDTH, HEIGHT, blur=0.7)
    alpha = np.broadcast_to(np.clip((np.arange(WIDTH) - 150) / 40, 0, 1), f.shape)
    image = render_scene(
        f, Appearance(noise=0.002), RNG(0), alpha * (np.arange(HEIGHT) < 200)[:, None]
    )
    c = coastline(image, blur=0.7)
    assert not any(part.whole for part in c.rings)
    off = [distances(part.vertices[part.coast], ring).distance for part in c.rings]
    assert sum(map(len, off)) > 100
    assert np.concatenate(off).max() < 0.75


def test_clouds_off_the_lake_do_no_harm():
    ring = bay()
    m, _ = moments(ring)
    f = render_polygon(ring, WIDTH, HEIGHT, blur=0.7)
    alpha = cloud_opacity(WIDTH, HEIGHT, 0.3, RNG(1))
    alpha[80:180] = 0
    image = render_scene(f, Appearance(bits=0), RNG(0), alpha)
    got, gray, _, c = measured(image, 0.7)
    assert abs(got[0] / m[0] - 1) < 5e-4
    assert abs(gray[0] / m[0] - 1) < 5e-4
    assert c.hidden.mean() > 0.05


def test_water_that_clouds_hide_is_refused():
    """Cloud over all but a strip of the lake that is within the margin of them."""
    f = render_polygon(bay(), WIDTH, HEIGHT)
    alpha = np.zeros(f.shape)
    alpha[90:170, 60:157] = alpha[90:170, 164:260] = 1
    image = render_scene(f, Appearance(bits=0), RNG(0), alpha)
    with pytest.raises(ValueError, match=r"shows water, clouds and their 4 px of margin hide all"):
        coastline(image)
    assert not coastline(image, margin=1.0).rings[0].whole


# ------------------------------------------------------------------------------------- bad input


def flat(noise=0.0):
    return 0.25 + noise * RNG(0).standard_normal((60, 80))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: coastline(np.zeros(5)), r"two axes, \(height, width\), .* got shape \(5,\)"),
        (lambda: coastline(np.zeros((60, 80, 3))), r"got shape \(60, 80, 3\)"),
        (lambda: coastline(np.zeros((3, 80))), "of 8 pixels or more"),
        (lambda: coastline(np.full((60, 80), np.nan)), "finite numbers, got nan at row 0"),
        (lambda: coastline(np.full((60, 80), "a")), "real numbers, got <U1"),
        (lambda: coastline(flat()), "shows water, .* darkest pixels of this one are 0.0 darker"),
        (lambda: coastline(flat(0.01)), "shows water, 6 standard deviations or more darker"),
        (lambda: coastline(np.zeros((60, 80))), "land is brighter than 0"),
        (
            lambda: coastline(seen(render_polygon(bay(), WIDTH, HEIGHT)), smallest=1e5),
            "water of 100000 px",
        ),
        (lambda: coastline(flat(), blur=-1), "blur is finite and 0 or more, got -1"),
        (lambda: gray_moments(np.zeros((9, 9))), "positive sum, got 0 px.*there is no water"),
        (lambda: gray_moments(np.ones(9)), r"got shape \(9,\)"),
        (lambda: gray_moments(np.ones((9, 9)), -1), "are 0 or more, got -1"),
        (
            lambda: gray_moments(np.ones((9, 9)), 0.1, np.ones((9, 8), bool)),
            r"shape of the coverage, \(9, 9\), got \(9, 8\)",
        ),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
