"""The law of samples of which some are replaced: against drawn samples, and against itself."""

import numpy as np

from pchem_pipeline.model.law.mass import sample_mass, sample_parabolas
from pchem_pipeline.model.law.replaced_samples import ReplacedSamples
from pchem_pipeline.model.law.sample_law import SampleLaw

EXPOSURE, STEP, BIAS, NOISE = np.array([0.6, 3.0]), np.array([12.0, 9.0]), np.array([100.0, 96.0]), 0.28
MAPS = EXPOSURE, 1.0 / STEP, BIAS, np.hypot(NOISE * STEP, 12.0**-0.5)
FIRST, N_CODES = np.array([60, 50]), 200
EXCESS, SHARE = np.array([14, 9]), np.array([1.0, 0.6])


def drawn(rng, n):
    """Return samples of both pixels, what stands in for each, and what comes out, (n, 2)."""
    samples = np.rint(BIAS + STEP * (rng.poisson(EXPOSURE, (n, 2)) + NOISE * rng.standard_normal((n, 2))))
    values = np.rint(rng.normal([104.0, 112.0], [5.0, 9.0], (n, 2)))
    gone = (samples - values > EXCESS) & (rng.random((n, 2)) < SHARE)
    return values.astype(np.int64), np.where(gone, values, samples).astype(np.int64), gone


def law_by(values):
    return ReplacedSamples.by(values, EXCESS, SHARE, FIRST, N_CODES)


def mass_of(law):
    found = sample_mass(SampleLaw(), MAPS, FIRST[:, None] + np.arange(N_CODES + EXCESS.max()))
    return law.mass_and_slopes(found, found[:, None][:, :0])[0]


def test_codes_are_as_frequent_as_in_drawn_samples():
    rng, n = np.random.default_rng(1), 400_000
    law = law_by(drawn(rng, n)[0])
    _, out, gone = drawn(rng, n)
    assert (gone.mean(axis=0) > 0.03).all()
    mass = mass_of(law)
    np.testing.assert_allclose(mass.sum(axis=1), 1.0, atol=1e-6)
    seen = np.stack([np.bincount(out[:, i] - FIRST[i], minlength=N_CODES) for i in range(2)])
    # the law itself rests on as many drawn values
    pull = (seen - n * mass) / np.sqrt(2.0 * n * mass + 4.0)
    assert np.abs(pull).max() < 5.0
    plain = sample_mass(SampleLaw(), MAPS, FIRST[:, None] + np.arange(N_CODES))
    assert np.abs((seen - n * plain) / np.sqrt(2.0 * n * plain + 4.0)).max() > 40.0


def test_what_stands_in_may_lie_outside_of_the_codes():
    values = np.tile(FIRST - 40, (50, 1))
    law = law_by(values)
    assert not law.comes.any()
    # all samples exceed it by far
    np.testing.assert_allclose(law.stays, np.broadcast_to(1.0 - SHARE[:, None], law.stays.shape))
    above = law_by(values + 40 + N_CODES + 30)
    assert (above.stays == 1.0).all()
    assert not above.comes.any()


def test_the_score_is_the_slope_of_the_likelihood_and_zero_on_average():
    rng = np.random.default_rng(2)
    law = law_by(drawn(rng, 3000)[0])
    counts = rng.multinomial(5000, mass_of(law)).astype(np.uint32)
    theta = np.stack([np.log(EXPOSURE), STEP, BIAS, 2.0 * np.log(NOISE * STEP)])

    def parabolas(at):
        maps = np.exp(at[0]), 1.0 / at[1], at[2], np.sqrt(np.exp(at[3]) + 1.0 / 12.0)
        return sample_parabolas(SampleLaw(), maps, counts, FIRST, law)

    _, score, information = parabolas(theta)
    for parameter, small in enumerate(1e-4 * np.eye(4)[:, :, None]):
        slope = (parabolas(theta + small)[0] - parabolas(theta - small)[0]) / 2e-4
        np.testing.assert_allclose(score[:, parameter], slope, rtol=1e-5, atol=1e-3)
    assert (np.abs(score) < 5.0 * np.sqrt(np.diagonal(information, axis1=1, axis2=2))).all()
    np.testing.assert_allclose(information, information.swapaxes(1, 2))


def test_nothing_is_replaced_at_no_share_and_pixels_keep_their_own():
    rng = np.random.default_rng(3)
    values = drawn(rng, 500)[0]
    counts = rng.multinomial(5000, mass_of(law_by(values))).astype(np.uint32)
    none = ReplacedSamples.by(values, EXCESS, 0.0 * SHARE, FIRST, N_CODES)
    replaced, plain, both = (
        sample_parabolas(SampleLaw(), MAPS, counts, FIRST, *law) for law in ([none], [], [law_by(values)])
    )
    for found, expected in zip(replaced, plain, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    one = law_by(values).of(np.array([1]))
    alone = sample_parabolas(SampleLaw(), [m[1:] for m in MAPS], counts[1:], FIRST[1:], one)
    for found, expected in zip(alone, both, strict=True):
        np.testing.assert_allclose(found[0], expected[1], rtol=1e-9)
