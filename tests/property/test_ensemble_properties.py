"""What must hold for any pixels and any tiling of the ensemble."""

import itertools

import numpy as np
from helpers.drawn_pixels import draw
from helpers.plain_law import joint_mass
from hypothesis import given, settings
from hypothesis import strategies as st

from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.ensemble import DnAxis, EnsembleAxes, nuced_axis
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.stages.ensemble.tile import PixelHistograms, ensemble_tile

RNG = np.random.default_rng(21)
N = 40
MAPS = (
    RNG.lognormal(0.7, 0.5, N),
    0.1 * RNG.lognormal(0, 0.05, N),
    RNG.normal(100, 4, N),
    RNG.normal(3.2, 0.2, N),
)
DN = DnAxis(60, 240)
AXES = EnsembleAxes(DN, nuced_axis(UsablePixels(*MAPS), DN), 12)
COUNTS = RNG.poisson(2.0, size=(N, 60)).astype(np.uint16)
OUTSIDE = RNG.poisson(0.3, size=N)
ORIGIN = RNG.integers(80, 100, N)
WITH_GAPS = tuple(np.where(np.arange(N) == 11, np.nan, column) for column in MAPS)


def sums_of(start, stop):
    part = slice(start, stop)
    chosen, everything = (
        PixelHistograms(COUNTS[part] // n, ORIGIN[part], OUTSIDE[part] // n) for n in (2, 1)
    )
    return ensemble_tile(tuple(column[part] for column in WITH_GAPS), chosen, everything, AXES)


@given(st.sets(st.integers(1, N - 1)))
@settings(max_examples=30, deadline=None)
def test_any_tiling_gives_the_same_ensemble(cuts):
    borders = [0, *sorted(cuts), N]
    rows = [sums_of(a, b) for a, b in itertools.pairwise(borders)]
    integers, floats = sums_of(0, N)
    np.testing.assert_array_equal(sum(row[0] for row in rows), integers)
    np.testing.assert_allclose(sum(row[1] for row in rows), floats, rtol=1e-12, atol=1e-18)
    assert integers[AXES.integers["pixels"]] == N - 1
    assert integers[AXES.integers["excluded"]] == 1
    # every pixel counts the same, however many samples it has
    inside, outside = (COUNTS // 2).sum(axis=1), OUTSIDE // 2
    expected = np.delete(inside / (inside + outside), 11).sum()
    np.testing.assert_allclose(floats[AXES.floats["share"]].sum(), expected, rtol=1e-12)


@given(
    exposure=st.floats(1e-6, 1e3),
    gain=st.floats(0.02, 2.0),
    bias=st.floats(-50, 500),
    noise=st.floats(0.01, 1.5),
    data=st.data(),
)
@settings(max_examples=100, deadline=None)
def test_numbers_have_the_largest_joint_mass(exposure, gain, bias, noise, data):
    dn = np.array(data.draw(st.lists(st.integers(0, 6000), min_size=1, max_size=30)), dtype=np.uint16)
    sigma = np.sqrt((noise / gain) ** 2 + 1 / 12)
    pixels = KnownPixels([np.full(1, v) for v in (exposure, gain, bias, sigma)], SampleLaw())
    ends = (np.atleast_1d(each) for each in (dn.min(), dn.max()))
    found = number_tables(*ends, pixels.exposure, pixels).convert(dn[:, None]).number.ravel()
    joint = joint_mass(dn, exposure, gain, bias, sigma, 2500)
    most = joint.max(axis=0)
    # a code where two numbers are as good as alike may have either; one that is never seen may have any
    known = (most > 1e-16) & ((joint > (1 - 1e-6) * most).sum(axis=0) == 1)
    np.testing.assert_array_equal(found[known], joint.argmax(axis=0)[known])


_N = 24


_DRAWN = draw(RNG, *(RNG.uniform(*ends, _N) for ends in ((0.05, 9), (8, 14), (0.15, 0.5))), n_frames=4000)
_DRAWN.counts[5] = 0  # a dead pixel amid the others
_WHOLE = vars(fit_histograms(*_DRAWN[:2]))


@settings(max_examples=25, deadline=None)
@given(
    cuts=st.lists(st.integers(1, _N - 1), unique=True, max_size=6),
    extra=st.integers(0, 40),
    reverse=st.booleans(),
)
def test_any_batching_gives_the_same_bits(cuts, extra, reverse):
    order = np.arange(_N)[::-1] if reverse else np.arange(_N)
    padded = np.pad(_DRAWN.counts, ((0, 0), (3, extra)))
    for part in np.split(order, sorted(cuts)):
        answer = vars(fit_histograms(padded[part].astype(np.uint16), _DRAWN.origin[part] - 3))
        for name in _WHOLE.keys() - {"intervals"}:
            np.testing.assert_array_equal(answer[name], _WHOLE[name][part])
