"""Numbers of the parts of the imaging chain, each against a closed form of its own."""

from types import SimpleNamespace

import numpy as np
import pytest

from terrafix.components.images import reference
from terrafix.components.images.image_former import ImageFormer
from terrafix.components.images.matcher import ImageMatcher
from terrafix.components.images.reference import EarlierPass, RenderedReference
from terrafix.components.sensors import echo
from terrafix.components.sensors.echo import SceneEcho
from terrafix.components.shared import generator
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Environment
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geolocation import ground_point
from terrafix.models.maps.dem import flat_dem
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.boresight import boresight_on_terrain
from terrafix.models.radar.chirp import SPEED_OF_LIGHT
from terrafix.models.radar.imaging import BLIND, OPEN, REASONS
from terrafix.models.sensors.effective_velocity import effective_velocity_array

ALIGNED = np.array([0.0, 0.0, 0.0, 1.0])
LOOK = np.radians(34.3)
WAVELENGTH = SPEED_OF_LIGHT / 1269.768992e6
RADAR = {
    "carrier": 1269.768992e6,
    "prf": 2160.0,
    "sample_rate": 16e6,
    "chirp_rate": -5.185185185185185e11,
    "pulse_length": 27e-6,
    "doppler_bandwidth": 1513.0,
}
# the start of the papers' pass: level, over Texas, looking at 29.76 N, 95.37 W
R_E = np.array([-1104646.3356338572, -6096830.387203118, 3395727.381187697])
V_E = np.array([-1004.68596649, 3810.13924464, 6497.93626104])
Q_BE = np.array([-0.59547836, -0.62105225, -0.42482638, 0.28146433])
BEAM = boresight_on_terrain(R_E, V_E, Q_BE, ALIGNED, LOOK, 0.0, flat_dem(100.0))


def bound(component, name, seed=0, **views):
    """A component as one member of a run sees it, with given values behind its ports."""
    members = np.arange(1)
    component.name = name
    component.bind(Environment(name, seed, members, members >= 0, lambda *_: None, False))
    component.port_views = views
    return component


def surface_views():
    dem = flat_dem(100.0)
    grid = np.array([0.0, 0.0, 1.0, 1.0, 1.0])
    shared = {"height": dem.height, "grid": grid, "surface": np.array([1.0, 0, 0, 0, 0, 0, 1, 0])}
    return {k: SimpleNamespace(value=v) for k, v in shared.items()}


def motion():
    return {"r_e": R_E[None], "v_e": V_E[None], "q_be": Q_BE[None], "q_mu": ALIGNED[None]}


@pytest.mark.parametrize("n_cells", [800, 1072])
def test_the_receive_window_is_centered_on_the_boresight(monkeypatch, n_cells):
    """Columns that hear a whole pulse are n_cells - n_pulse: the beam's center is amid them."""
    made = {}

    def simulated(scene, arc, acquisition, *_, **__):
        made["acquisition"] = acquisition
        return np.zeros((acquisition.n_lines, acquisition.n_cells), np.complex64)

    monkeypatch.setattr(echo, "simulated_echo", simulated)
    radar = SceneEcho(**RADAR, look=LOOK, n_lines=64, n_cells=n_cells)
    bound(radar, "echo", **surface_views(), **motion())
    monkeypatch.setattr(radar, "_publish", lambda *args: made.update(published=args))
    radar.step(8.2, 8.2)
    spacing = SPEED_OF_LIGHT / (2 * RADAR["sample_rate"])
    acquisition, n_pulse = made["acquisition"], 27e-6 * 16e6
    middle = acquisition.near_range + (n_cells - n_pulse) / 2 * spacing
    assert middle == pytest.approx(BEAM.slant_range, abs=1e-6)
    # and its middle line is received at the time of the step
    assert acquisition.first_time + 63 / 2 / 2160.0 == pytest.approx(8.2, abs=1e-12)
    assert acquisition.centroid == pytest.approx(2 * BEAM.closing / WAVELENGTH, rel=1e-9)
    t, _, first_time, near = made["published"]
    assert (t, first_time, near) == (8.2, acquisition.first_time, acquisition.near_range)


def test_what_is_published_of_an_echo_is_relative_to_its_time():
    """Time of the first line after the message's; range and Doppler frequency of the beam."""
    sent = {}
    radar = SceneEcho(**RADAR, look=LOOK)
    acquired = SimpleNamespace(publish=lambda t, **fields: sent.update(fields, t=t))
    shared = SimpleNamespace(put=lambda value: sent.update(echo=value))
    bound(radar, "echo", acquired=acquired, echo=shared, **surface_views(), **motion())
    lines = np.zeros((8, 4000), np.complex64)
    radar._publish(8.2, lines, 7.0, BEAM.slant_range - 9000.0)
    assert sent["t"] == 8.2
    assert sent["first_time"] == pytest.approx(-1.2)
    assert sent["near_range"] == BEAM.slant_range - 9000.0
    assert sent["beam_range"] == pytest.approx(BEAM.slant_range)
    line = (BEAM.point - R_E) / BEAM.slant_range
    assert sent["beam_doppler"] == pytest.approx(2 * (V_E @ line) / WAVELENGTH, rel=1e-9)
    assert sent["echo"] is lines


def test_noise_of_an_echo_is_of_the_whole_seed_the_path_and_the_step():
    """The words are 64 bits of seed in halves, the step, and the path: no half is lost."""

    def draws(seed, name="echo", step=1):
        component = bound(SceneEcho(**RADAR, look=LOOK), name, seed=seed)
        component.step_index = step
        return generator(component).random(3)

    seed = 7 + (9 << 32)
    words = np.random.SeedSequence([7, 9, 1, *b"echo"])
    expected = np.random.Generator(np.random.Philox(words)).random(3)
    np.testing.assert_array_equal(draws(seed), expected)
    others = [draws(7), draws(9), draws(seed, "other"), draws(seed, step=2)]
    assert all((other != expected).all() for other in others)


def test_the_earlier_pass_flew_where_it_is_said_to(monkeypatch):
    """Along the velocity, to its right (the side of velocity x up), and up, by so many meters."""
    made = {}

    class SeenError(Exception):
        pass

    def footprint(arc, radar, first_time, n_lines, near_range, n_cells, centroid, side):
        made.update(arc=arc, middle=near_range + (n_cells - 1) / 2 * radar.range_spacing)
        made.update(time=first_time + (n_lines - 1) / 2 / radar.prf, side=side)
        raise SeenError

    monkeypatch.setattr(reference, "Footprint", footprint)
    views = surface_views() | {"radar": SimpleNamespace(value=np.array([*RADAR.values()]))}
    earlier = EarlierPass(look=LOOK, displacement=[20.0, 300.0, 150.0])
    bound(earlier, "reference", **views, **motion())
    with pytest.raises(SeenError):
        earlier.step(8.2, 8.2)
    moved = made["arc"].position(0.0) - R_E
    up = R_E / np.linalg.norm(R_E)  # of the ellipsoid, to 0.2 deg
    right = np.cross(V_E, up) / np.linalg.norm(np.cross(V_E, up))
    along = np.cross(up, right)
    assert [moved @ a for a in (along, right, up)] == pytest.approx([20, 300, 150], abs=1.5)
    assert np.linalg.norm(moved) == pytest.approx(np.sqrt(20**2 + 300**2 + 150**2), abs=1e-3)
    np.testing.assert_allclose(made["arc"].velocity(0.0), V_E, atol=1e-6)
    # what it saw in the middle is what the nominal boresight looks at from there
    beam = boresight_on_terrain(R_E + moved, V_E, Q_BE, ALIGNED, LOOK, 0.0, flat_dem(100.0))
    assert made["middle"] == pytest.approx(beam.slant_range, abs=1e-3)
    assert made["time"] == pytest.approx(0.0, abs=1e-12)
    assert made["side"] == 1


def test_a_rendered_reference_errs_as_it_is_said_to():
    """By one error of brightness for a run, and by another of places for each image."""
    views = surface_views() | {"radar": SimpleNamespace(value=np.array([*RADAR.values()]))}
    views["surface"] = SimpleNamespace(value=np.array([1.0, 2.5, 0, 0, 0, 0, 1, 5]))

    def drawn(step, seed=0, **settings):
        made = RenderedReference(look=LOOK, n_lines=400, n_cells=200, **settings)
        bound(made, "reference", seed, **views, **motion())
        made.step_index = step
        published = {}
        made._publish = lambda reference: published.update(reference=reference)
        made.step(8.2, 8.2)
        return published["reference"]

    one, next_one, other = drawn(1), drawn(2), drawn(1, seed=5)
    exact = drawn(1, class_sigma=0.0, placing_sigma=0.0)
    assert one.amplitude.shape == (200, 200)
    np.testing.assert_array_equal(one.amplitude, next_one.amplitude)
    assert np.abs(np.log(one.amplitude / exact.amplitude)).max() > 0.05
    assert np.abs(np.log(one.amplitude / other.amplitude)).max() > 0.05
    moved = [(r.latitude - exact.latitude)[0, 0] * 6.36e6 for r in (one, next_one, other)]
    assert len(set(moved)) == 3
    assert max(map(abs, moved)) < 4 * 3.0  # [m]
    relief = drawn(1, classes=False)
    assert np.ptp(relief.amplitude) < 0.1 < np.ptp(exact.amplitude)
    assert not RenderedReference(look=LOOK, classes=False).takes("class_sigma")


def believing(**settings):
    """An image former whose member believes the truth, with variances of 1 to 9."""
    acquired = SimpleNamespace(
        beam_range=np.array([861013.0]),
        beam_doppler=np.array([54.0]),
        time_sigma=np.array([1e-5]),
        side=np.array([1.0]),
        fresh=np.ones(1, np.bool_),
    )
    P = np.diag(np.arange(1.0, 10.0))[None]
    prior = SimpleNamespace(r_e=R_E[None], v_e=V_E[None], q_mu=ALIGNED[None], P=P)
    former = ImageFormer(look=LOOK, **settings)
    return bound(former, "former", acquired=acquired, prior=prior, q_be=Q_BE[None])


def test_the_velocity_that_focuses_falls_with_range():
    """V^2 = v^2 + (r - p) a with central gravity, Coriolis and centrifugal acceleration.

    Left out is J2, a thousandth of it. The place at a range is that of `ground_point`.
    """
    omega = np.array([0.0, 0.0, EARTH.rotation_rate])
    a = -EARTH.mu * R_E / np.linalg.norm(R_E) ** 3
    a = a - 2 * np.cross(omega, V_E) - np.cross(omega, np.cross(omega, R_E))
    sine = WAVELENGTH * 54.0 / (2 * np.linalg.norm(V_E))
    near, middle, far = (
        np.sqrt(V_E @ V_E + (R_E - ground_point(R_E, V_E, 861013.0 + d, sine)) @ a)
        for d in (-1000.0, 0.0, 1000.0)
    )
    field, sigma = believing()._expected_velocity(0, WAVELENGTH)
    assert field.velocity == pytest.approx(middle, rel=1e-4)
    assert field.by_range == pytest.approx((far - near) / 2000.0, rel=0.02)
    assert field.by_range < -1e-4  # 0.13 m/s in a kilometer
    arc = OrbitArc(R_E, V_E, 0.0, 2.0, 2.0)
    early, late = (
        effective_velocity_array(r, v, ground_point(r, v, 861013.0, sine))
        for r, v in ((arc.position(t), arc.velocity(t)) for t in (-1.5, 1.5))
    )
    assert field.by_time == pytest.approx((late - early) / 3.0, rel=0.02)
    # variances 4, 5, 6 of velocity: that along the track, times the speed over the effective one
    variance = V_E @ np.diag([4.0, 5.0, 6.0]) @ V_E / middle**2
    assert sigma == pytest.approx(np.sqrt(variance), rel=1e-4)


def test_the_expected_centroid_has_the_estimates_uncertainty():
    """2 v u / lambda; its variance is of velocity along u, and of v turned by the misalignment."""
    centroid, sigma = believing()._expected_centroid(WAVELENGTH)
    u = (BEAM.point - R_E) / BEAM.slant_range
    assert centroid[0] == pytest.approx(2 / WAVELENGTH * V_E @ u, rel=1e-6)
    variance = u @ np.diag([4.0, 5.0, 6.0]) @ u + V_E @ V_E * 9.0
    assert sigma[0] == pytest.approx(2 / WAVELENGTH * np.sqrt(variance), rel=1e-6)


def forming(monkeypatch, focus, **settings):
    """What an image former sends whose imager has a focus at hand."""
    sent = {}
    former = believing(range_sigma=0.0, **settings)
    former.prior.P[:, 6:, 6:] *= 1e-8
    former.port_views |= {
        "image": SimpleNamespace(publish=lambda t, valid, **fields: sent.update(fields)),
        "images": SimpleNamespace(put=lambda _: None),
        "reason": np.full(1, np.nan),
    }
    imager = SimpleNamespace(
        radar=SimpleNamespace(wavelength=WAVELENGTH, prf=2160.0, range_spacing=9.4),
        fraction=0.0,
        step=1.0,
        migration_step=50.0,
        processing=lambda f, *_: f,
        focus=lambda found, *_, **reach: sent.update(reach) or (found[0], focus),
        image=lambda _, V: SimpleNamespace(
            data=np.ones((400, 400), complex),
            velocity=V,
            pixel=lambda *_: (0.0, 0.0),
            seen_at=lambda _, column, f: (f, 861013.0 + 9.4 * column),
        ),
        velocity_at=lambda _, V, *rest: V + 0.25,
    )
    place = slice(0, 192), slice(0, 96), (95.5, 47.5)
    monkeypatch.setattr(former, "_place", lambda *_: place)
    former._form(8.2, imager, np.ones(1, np.bool_))
    return former, sent


def test_relief_is_part_of_the_velocitys_error(monkeypatch):
    """600 m of height are 0.28 m/s (V^2 grows by the acceleration times the height over range)."""
    focus = SimpleNamespace(velocity=7101.0, sigma=0.4, accepted=True, reason="accepted")
    former, sent = forming(monkeypatch, focus, height_sigma=600.0)
    sine = WAVELENGTH * 54.0 / (2 * np.linalg.norm(V_E))
    low, high = (
        effective_velocity_array(R_E, V_E, ground_point(R_E, V_E, 861013.0, sine, h))
        for h in (0.0, 600.0)
    )
    assert sent["velocity_sigma"][0] == pytest.approx(np.hypot(0.4, high - low), rel=1e-3)
    assert sent["velocity_sigma"][0] > 0.47
    assert (sent["velocity"][0], sent["focused"][0]) == (7101.25, 1.0)  # at the beam's center
    assert former.reason[0] == 0
    assert sent["reach"] == 50.0  # five standard deviations of 2.5 m/s in whole steps
    assert sent["slant_range"][0] == 861013.0
    speed = np.linalg.norm(V_E)
    assert sent["sine"][0] == pytest.approx(WAVELENGTH * 54.0 / (2 * speed), rel=1e-12)
    assert sent["row_time"][0] == 2 / 2160.0
    assert sent["column_range"][0] == pytest.approx(9.4, abs=1e-8)
    assert (sent["time_sigma"][0], sent["side"][0]) == (1e-5, 1.0)


def test_where_autofocus_refuses_the_velocity_is_the_estimates(monkeypatch):
    """With its standard error, and the reason."""
    focus = SimpleNamespace(velocity=7101.0, sigma=0.4, accepted=False, reason=REASONS[4])
    former, sent = forming(monkeypatch, focus)
    field, sigma = former._expected_velocity(0, WAVELENGTH)
    assert sent["focused"][0] == 0.0
    assert (sent["velocity"][0], sent["velocity_sigma"][0]) == (field.velocity, sigma)
    assert former.reason[0] == 4


def test_an_estimate_without_an_image_is_told_why(monkeypatch):
    """It goes without one this time: it is not failed, and nothing is sent."""
    focus = SimpleNamespace(velocity=7101.0, sigma=0.4, accepted=True, reason="accepted")
    former, sent = forming(monkeypatch, focus)
    prior = former.prior
    for change, reason in (
        ({"r_e": 1.3 * R_E[None]}, BLIND),
        ({"P": 1e6 * prior.P}, OPEN),
    ):
        former.port_views["prior"] = SimpleNamespace(**vars(prior) | change)
        imager = SimpleNamespace(
            radar=SimpleNamespace(wavelength=WAVELENGTH, prf=2160.0), migration_step=50.0
        )
        sent.clear()
        former._form(8.2, imager, np.ones(1, np.bool_))
        assert REASONS[int(former.reason[0])] == reason
        assert not sent


def test_a_fix_states_the_variance_of_what_it_measures():
    """R holds squares; of a time known to 1 ms 7 m of the track are 8.75e-6 of the range."""
    matcher = ImageMatcher(range_sigma=1.5)
    sent = {}
    fix = SimpleNamespace(publish=lambda t, **fields: sent.update(fields, t=t))
    image = SimpleNamespace(
        slant_range=np.array([8e5]),
        velocity=np.array([7100.0]),
        velocity_sigma=np.array([0.4]),
        focused=np.array([1.0]),
        time_sigma=np.array([1e-3]),
    )
    east = SimpleNamespace(v_e=np.array([[0.0, 7000.0, 0.0]]))
    bound(matcher, "matcher", fix=fix, image=image, prior=east)
    place, D = np.array([[EARTH.radius + 50.0, 0.0, 0.0]]), np.diag([25.0, 4.0, 9.0])[None]
    matcher._publish(8.2, place, D, np.array([True]))
    np.testing.assert_allclose(sent["y"][0], [0, 0, 8e5, 7100.0])
    np.testing.assert_allclose(sent["R"][0], np.diag([8.75e-6**2, 0.0, 1.5**2, 0.4**2]))
    np.testing.assert_allclose(sent["r_f_e"], place)
    np.testing.assert_allclose(sent["D"], D)
    np.testing.assert_array_equal(sent["present"][0], [1, 1, 1, 1])


def test_a_former_that_looks_to_the_other_side_than_its_echo_is_told_so():
    former = believing()
    former.acquired.side = -np.ones(1)
    message = "'former' looks to the right of the track, but its echo came from the left"
    with pytest.raises(ConfigurationError, match=message):
        former._require_side(np.ones(1, np.bool_))
    former.acquired.side = np.ones(1)
    former._require_side(np.ones(1, np.bool_))
