"""Light at a place and pixels that blink: forward models, what they add to the exposure, and estimators."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, exposures, seen, taken
from hidden.chain import hide

from pchem_pipeline.effects.estimators.spots import best_spot
from pchem_pipeline.effects.operators.light import DarkCurrentRts, Glow, Persistence, spot_image


@pytest.mark.parametrize(("low", "high"), [(30.0, 10.0), (4.0, 4.0)])
def test_blinking_pixels_are_a_markov_chain(low, high):
    n, step = 60_000, 0.8
    effect = DarkCurrentRts(fraction=0.25, step_e=step, dwell_low_frames=low, dwell_high_frames=high)
    h = exposures(effect, np.ones((12, 12)), n) - 1.0
    blinks = h.any(axis=0)
    assert abs(blinks.mean() - 0.25) < 5 * np.sqrt(0.25 * 0.75 / 144)
    s = h[:, blinks] / step
    assert np.all((s == 0) | (abs(s - 1) < 1e-9))
    share, tau = high / (low + high), 1.0 / (1.0 / low + 1.0 / high)
    error = np.sqrt(share * (1 - share) * 2 * tau / s.size)
    assert abs(s.mean() - share) < 5 * error
    d = s - s.mean()
    for lag in (1, 5, 20):
        seen = (d[lag:] * d[:-lag]).mean()
        assert abs(seen - share * (1 - share) * np.exp(-lag / tau)) < 5 * error
    assert share * (1 - share) * np.exp(-1 / tau) > 20 * error


def test_pixels_that_blink_at_a_small_fraction_blink_alike_at_a_larger_one():
    small, large = (
        exposures(DarkCurrentRts(fraction=f, steps="exponential"), np.ones((15, 15)), 500) for f in (0.1, 0.3)
    )
    blinks = (small != 1.0).any(axis=0)
    assert 5 < blinks.sum() < (large != 1.0).any(axis=0).sum()
    assert np.array_equal(small[:, blinks], large[:, blinks])


def test_an_image_in_a_part_of_the_sensor_stays_at_its_place():
    y, x = np.mgrid[0:8, 0:12] + 0.5
    smooth = np.exp(-((y - 3.0) ** 2 + (x - 8.0) ** 2) / 18.0)
    effect = Persistence(peak_e=2.0, decay_frames=9.0, image=tuple(map(tuple, smooth.tolist())))
    whole = 2.0 * effect.pattern(np.arange(40), (40, 60))
    for rows, columns in (((0, 20), (20, 50)), ((16, 40), (0, 30)), ((0, 40), (0, 60))):
        size = (rows[1] - rows[0], columns[1] - columns[0])
        part = effect.to_window(rows, columns, (40, 60))
        own = part.peak_e * part.pattern(np.arange(size[0]), size)
        assert np.abs(own - whole[slice(*rows), slice(*columns)]).max() < 0.1
        back = part.to_sensor(rows, columns, (40, 60))
        seen = back.peak_e * back.pattern(np.arange(40), (40, 60))
        middle = (slice(rows[0] + 4, rows[1] - 4), slice(columns[0] + 4, columns[1] - 4))
        assert np.abs(seen - whole)[middle].max() < 0.2
        seen[slice(*rows), slice(*columns)] = 0.0
        beside = seen.copy()
        beside[max(rows[0] - 5, 0) : rows[1] + 5, max(columns[0] - 5, 0) : columns[1] + 5] = 0.0
        assert not beside.any()
    tiny = effect.to_sensor((20, 21), (30, 31), (4000, 6000))
    assert np.isfinite(tiny.pattern(np.arange(40), (4000, 6000))).all()


def test_the_ghost_of_an_image_fades():
    place = {"centre_y": 0.25, "centre_x": 0.75, "radius": 0.1}
    effect = Persistence(peak_e=2.0, decay_frames=10.0, slow_decay_frames=40.0, slow_share=0.25, **place)
    h = exposures(effect, np.zeros((40, 20)), 100)
    assert np.unravel_index(h[0].argmax(), h[0].shape) == (9, 14)
    assert np.allclose(h[20] / h[0], 0.75 * np.exp(-2.0) + 0.25 * np.exp(-0.5))
    # one radius (a tenth of 40 rows) away
    assert h[0, 9 + 4, 14] / h[0, 9, 14] == pytest.approx(np.exp(-0.5 * (3.5**2 - 0.5**2) / 16.0), rel=0.2)
    image = Persistence(peak_e=2.0, decay_frames=10.0, image=((0.0, 4.0), (0.0, 2.0)))
    h = exposures(image, np.zeros((40, 20)), 1)[0]
    assert h[0, 0] == 0.0
    assert h[0, -1] == 2.0
    assert h[-1, -1] == 1.0


SHAPE = (10, 14)


def added_light(effect, n_frames=400, **place):
    context = context_of(SHAPE, n_frames, **place)
    return effect.apply(np.ones((context.frames.size, context.rows.size, SHAPE[1])), context) - 1.0


def test_bursts_are_a_share_of_the_frames_and_a_growth_is_straight():
    effect = Glow(peak_e=2.0, burst_share=0.1, centre_y=0.5, centre_x=0.0, radius=0.3)
    added = added_light(effect)
    on = added.any(axis=(1, 2))
    assert abs(on.sum() - 40) < 5 * 6
    np.testing.assert_allclose(added[on], np.broadcast_to(added[on][0], added[on].shape))
    assert added[on][0].max() == pytest.approx(2.0)
    band = added_light(effect, frames=range(50, 90), rows=np.arange(3, 7))
    np.testing.assert_array_equal(band, added[50:90, 3:7])
    grown = added_light(Glow(peak_e=2.0))
    np.testing.assert_allclose(grown[:, 0, 0], 2.0 * np.arange(400) / 399, atol=1e-12)


def test_a_spot_is_1_in_its_brightest_pixel_and_falls_with_the_distance():
    for falloff in ("gaussian", "exponential"):
        for centre in ((0.0, 0.0), (0.43, 0.9), (1.0, 0.5)):
            spot = spot_image(np.arange(10), np.arange(14), SHAPE, centre, 0.2, falloff)
            assert spot.max() == pytest.approx(1.0)
    spot = spot_image(np.arange(9), np.arange(9), (9, 9), (0.5, 0.5), 0.2, "exponential")
    assert spot[4, 4 + 3] == pytest.approx(np.exp(-3 / (0.2 * 9)))


@pytest.mark.parametrize("effect", [
    Glow(peak_e=2.0, centre_y=0.1, centre_x=0.6, radius=0.3, falloff="gaussian"),
    Glow(peak_e=2.0, centre_y=0.1, centre_x=0.6, radius=0.3, falloff="exponential"),
    Persistence(peak_e=2.0, centre_y=0.1, centre_x=0.6, radius=0.3, decay_frames=100.0),
])  # fmt: skip
def test_a_window_sees_its_part_of_the_glow(effect):
    image = effect.peak_e * effect.pattern(np.arange(40), (40, 60))
    for rows, columns in (((0, 20), (20, 50)), ((16, 40), (0, 30)), ((0, 40), (0, 60))):
        part = effect.to_window(rows, columns, (40, 60))
        size = (rows[1] - rows[0], columns[1] - columns[0])
        own = part.peak_e * part.pattern(np.arange(size[0]), size)
        np.testing.assert_allclose(own, image[slice(*rows), slice(*columns)], rtol=1e-9)
    part = effect.to_window((0, 20), (20, 50), (40, 60)).to_sensor((0, 20), (20, 50), (40, 60))
    found = part.peak_e, part.centre_y, part.centre_x, part.radius
    np.testing.assert_allclose(found, [2.0, 0.1, 0.6, 0.3])


def test_what_it_adds_has_the_moments_of_the_frames():
    maps = seen(taken(drawn_truth(SHAPE), n_frames=300)).maps
    for effect in (Glow(peak_e=2.0, burst_share=0.1), Glow(peak_e=2.0)):
        shown = added_light(effect, 20_000)
        added = effect.added_exposure(np.zeros((1, *SHAPE), np.uint16), np.arange(1), maps)
        np.testing.assert_allclose(added.weight.sum(axis=0), 1.0)
        for power in (1, 2):
            moment = (added.weight * added.exposure_e**power).sum(axis=0)
            assert np.abs(moment - (shown**power).mean(axis=0)).max() < 5 * 2.0**power * 0.3 / np.sqrt(20_000)


# in bursts: from a corner, from an edge; growing: from an edge, from a corner
@pytest.mark.parametrize("seed", [180100, 180103, 180101, 180104])
def test_an_independent_camera_s_glow_is_found(seed):
    hiding = hide(("glow",), 4.0, seed, (24, 24), 1500)
    (hidden,) = hiding.effects
    found = Glow.estimate(seen(hiding.frames))[0]
    bursts = hidden.parameters["course"] == "bursts"
    assert (found.burst_share is not None) == bursts
    if bursts:
        assert abs(1500 * found.burst_share - hidden.parameters["bursts"]) < 0.3 * hidden.parameters["bursts"]
    image = found.peak_e * found.pattern(np.arange(24), (24, 24))
    true = hidden.strength * hidden.shape
    assert np.corrcoef(image.ravel(), true.ravel())[0, 1] > 0.9
    assert image.sum() == pytest.approx(true.sum(), rel=0.25)


@pytest.mark.parametrize("seed", [5, 7])
def test_bursts_so_bright_that_they_mislead_the_fits_keep_their_form(seed):
    # without single peaks a fit takes bright bursts for electrons, at a tenth of the gain
    truth = drawn_truth((24, 24), noise_e=(0.36, 0.42), step=(11.5, 12.5))
    hidden = Glow(peak_e=10.0, burst_share=0.015, centre_y=0.3, centre_x=0.0, radius=0.2)
    found = Glow.estimate(seen(taken(truth, hidden, n_frames=1200, seed=seed)))[0]
    assert found.falloff == "exponential"
    assert found.peak_e == pytest.approx(10.0, rel=0.15)
    assert found.radius == pytest.approx(0.2, rel=0.1)


def test_a_spot_that_no_cell_shows_is_no_guess():
    rng = np.random.default_rng(5)
    lost = np.full((4, 4), 0.01)
    lost[:2] = np.inf  # no usable pixel in the upper half
    # and cells far wider than the narrowest spot, and noise only: its far tail would fit with any peak
    for error in 6 * [lost, np.full((2, 2), 0.01)]:
        spot = best_spot(rng.normal(0.0, 0.01, error.shape), error, np.ones(error.shape), (64, 64))
        assert spot is None or spot.peak < 1.0
