"""From effects to the law of the pixels, and what the fit of a tile makes of it."""

from typing import ClassVar, Literal

import numpy as np
import pytest
from pydantic import confloat

from pchem_pipeline.base.errors import ConfigError, PchEmError
from pchem_pipeline.effects.framework.compose import along_chain, model_words, pixel_maps, sample_law
from pchem_pipeline.effects.framework.draws import regrouped
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.effects.operators.couple import BlackClamp
from pchem_pipeline.effects.operators.curve import AdcInl, Clipping
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.effects.operators.replace import RepeatedFrames
from pchem_pipeline.model.law.pcd import nearest_pcd
from pchem_pipeline.model.law.sample_law import SampleLaw


class Broken(Effect):
    """An effect of somebody else that cannot say what it does."""

    tag: Literal["broken"] = "broken"
    plane: ClassVar[Plane] = Plane.ANALOG

    def apply(self, values, context):
        return values

    def sample_law(self, model, maps):
        raise IndexError("list index out of range")


class Wide(Broken):
    """Variance in e-^2 that grows with the pixel's own exposure."""

    tag: Literal["wide"] = "wide"

    def sample_law(self, model, maps):
        return model.with_variance(e2=0.01 * np.nan_to_num(maps.quanta_exposure))


def maps_of(*exposures):
    h = np.array(exposures)
    return pixel_maps([h, h * 0 + 0.1, h * 0 + 100, h * 0 + 2.5], np.ones(h.size, bool))


class OneSided(Broken):
    """A parameter of which pydantic keeps the limits together, one of them None."""

    tag: Literal["one_sided"] = "one_sided"
    size: confloat(ge=0.5) = 1.0


def test_limits_may_be_on_one_side_alone():
    assert [OneSided.limited("size", value) for value in (0.1, 2.0)] == [0.5, 2.0]


def test_effects_add_up_in_their_order():
    maps = maps_of(1.0, np.nan, 3.0)
    assert maps.usable.tolist() == [True, False, True]
    assert np.isnan(maps.bias).tolist() == [False, True, False]
    model = sample_law([Wide(), RowNoise(row_noise_dn=0.5), RowNoise(row_noise_dn=1.0)], maps)
    np.testing.assert_allclose(model.extra_variance_e2, [0.01, 0.0, 0.03])
    np.testing.assert_allclose(model.extra_variance_dn2, [1.25])
    assert sample_law([], maps).neutral
    assert model_words([RowNoise(row_noise_dn=0.5), Wide()]) == "PCD + row_noise + wide"
    assert model_words([]) == "PCD"


def test_new_effects_stand_where_the_signal_comes_to_them():
    limit, clamp, steps = Clipping(high=260), BlackClamp(follow=0.4), AdcInl(inl_lsb=1.0, period_dn=64.0)
    rows, repeated = RowNoise(row_noise_dn=0.5), RepeatedFrames(probability=0.1)
    chain = rows, clamp, steps, limit, repeated
    assert along_chain((), chain[::-1]) == along_chain((), chain) == chain
    assert along_chain((limit,), (clamp,)) == (clamp, limit)
    # an order that is there already may be meant
    assert along_chain((limit, clamp), (repeated, rows)) == (rows, limit, clamp, repeated)


def test_an_effect_that_raises_is_named():
    words = r"model\.effects: broken \(test_effects_compose\).*IndexError.*remove it"
    with pytest.raises(PchEmError, match=words) as caught:
        sample_law([RowNoise(row_noise_dn=0.5), Broken()], maps_of(1.0))
    assert not isinstance(caught.value, ConfigError)  # that says that there is no law


def test_the_nearest_pcd_has_the_whole_width_of_the_peaks():
    columns = [np.array([value, np.nan]) for value in (2.0, 0.1, 100.0, 2.5)]
    model = SampleLaw().with_variance(dn2=1.0, e2=0.01, per_electron=0.005, per_electron2=0.001)
    model = model.with_levels(scale=0.98, shift_e=0.1, curvature=0.02)
    model = model.with_noise([0.5, 0.5], shift_dn=[-1.0, 2.0])
    exposure, gain, bias, sigma = nearest_pcd(columns, model)
    # near k = H: levels 100 + 10 (0.98 k (1 + 0.01 (k - 1)) + 0.1) + 0.5
    levels = [100 + 10 * (0.98 * k * (1 + 0.01 * (k - 1)) + 0.1) + 0.5 for k in (1.9, 2.0, 2.1)]
    assert exposure[0] == 2.0
    assert 1 / gain[0] == pytest.approx((levels[2] - levels[0]) / 0.2)
    assert bias[0] + 2.0 / gain[0] == pytest.approx(levels[1])
    # satellites at -1 and 2 DN have the variance 2.25; the electrons' in e-^2 counts a hundredfold in DN^2
    assert sigma[0] ** 2 == pytest.approx(2.5**2 + 1.0 + 2.25 + 100 * (0.01 + 0.01 + 0.004))
    assert np.isnan([gain[1], bias[1], sigma[1]]).all()


def test_of_very_many_electrons_of_which_nearly_all_are_lost_the_few_are_left():
    """The chance that none is lost is 0 in doubles, which is no reason for a warning."""
    electrons, rng = np.full(2000, 900), np.random.default_rng(4)
    none = lambda u, index: np.zeros(u.size, np.int64)  # noqa: E731
    left = regrouped(electrons, rng.random(2000), 1.0, lambda index: (0.9, 0.0), none)
    assert abs(left.mean() - 90.0) < 4.0 * np.sqrt(900 * 0.09 / 2000)
    assert left.var() == pytest.approx(81.0, rel=4.0 * np.sqrt(2.0 / 2000))
