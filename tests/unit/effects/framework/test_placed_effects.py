"""Effects with a place and a time: in the simulator, the YAML, words and the law of the samples."""

import numpy as np
import pytest

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.config.load import load_config, parse_config, write_model
from pchem_pipeline.effects.framework.compose import effect_words, model_words
from pchem_pipeline.effects.framework.effect import registered_effects
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.effects.framework.registry import effect_class, effect_classes
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.effects.operators.curve import Clipping
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

SHAPE, FRAMES = (12, 16), 60
REGION, WHEN = Region(rows=((2, 9),), columns=((4, 8),)), When(range=((20, 40),))


def simulate(effects, frames=(0, FRAMES), rows=None):
    settings = SimulateSettings(shape=SHAPE, n_frames=FRAMES, seed=7, effects=effects)
    return simulate_block(draw_truth(settings), settings, frames, rows)[0].astype(np.int64)


def strong(tag):
    """Return an effect so strong that it changes many of these few samples."""
    effect = next(iter(effect_class(tag).typical()), None) or Clipping(low=104)
    if tag == "repeated_frames":
        return type(effect)(frames=(5, 25, 30))
    if tag in ("cosmic_rays", "rts_noise", "dark_current_rts", "heavy_tailed_noise"):
        return effect
    return effect.scaled(20.0) if effect.strength else effect


@pytest.mark.parametrize("tag", sorted(effect_classes()))
def test_an_effect_acts_in_its_place_as_everywhere_and_not_beside_it(tag):
    effect = strong(tag)
    try:
        every = simulate((effect,))
    except Exception:
        effect = next(iter(effect_class(tag).typical()))
        every = simulate((effect,))
    plain = simulate(())
    placed = simulate((effect.at_place(REGION, WHEN),))
    inside = WHEN.frames(np.arange(FRAMES))[:, None, None] & REGION.mask(SHAPE)
    np.testing.assert_array_equal(placed[~inside], plain[~inside])
    if effect.plane.value in ("adc", "readout"):
        # nothing that happens later mixes the samples
        np.testing.assert_array_equal(placed[inside], every[inside])
    part = simulate((effect.at_place(REGION, WHEN),), (15, 33), (1, 7))
    np.testing.assert_array_equal(part, placed[15:33, 1:7])


def test_taps_may_have_strengths_of_their_own():
    taps = [RowNoise(row_noise_dn=s, region=f"taps=4/{i}") for i, s in enumerate((0.0, 4.0, 0.0, 40.0))]
    moved = simulate(tuple(taps)) - simulate(())
    spread = moved.reshape(FRAMES, SHAPE[0], 4, 4).mean(axis=3).std(axis=(0, 1))
    np.testing.assert_allclose(spread, [0.0, 4.0, 0.0, 40.0], rtol=5.0 / np.sqrt(2 * FRAMES * SHAPE[0]))
    one, other = moved[:, :, 5].ravel(), moved[:, :, 13].ravel()
    assert abs(np.corrcoef(one, other)[0, 1]) < 5.0 / np.sqrt(one.size)


def test_every_effect_may_have_a_place_and_none_needs_one():
    for each in registered_effects().values():
        assert {"region", "when"} <= each.model_fields.keys()
    effect = RowNoise(row_noise_dn=1.0)
    assert effect.everywhere
    assert effect.model_dump() == {"tag": "row_noise", "row_noise_dn": 1.0}
    assert effect.scaled(2.0).at_place(REGION).scaled(0.5).region == REGION


def test_words_of_a_model_tell_the_places():
    effects = [RowNoise(row_noise_dn=1.0, region="columns=120:160"), RowNoise(row_noise_dn=1.0)]
    assert model_words(effects) == "PCD + row_noise in columns 120 to 159 + row_noise"
    words = effect_words(effects[1].at_place(REGION, WHEN))
    assert words == "row_noise in rows 2 to 8, columns 4 to 7, frames 20 to 39"


YAML = """input: {files: [night.npy], integration_time: 1.0}
model:
  effects:
    - tag: row_noise  # of the last amplifier
      row_noise_dn: 1.0
      region: {mask: tap.npy}
"""


def test_a_mask_of_the_yaml_is_beside_it_and_stays_when_another_model_is_written(tmp_path):
    np.save(tmp_path / "tap.npy", REGION.mask(SHAPE))
    path = tmp_path / "night.yaml"
    path.write_text(YAML)
    [effect] = load_config(path).model.effects
    np.testing.assert_array_equal(effect.region.mask(SHAPE), REGION.mask(SHAPE))
    more = RowNoise(row_noise_dn=0.5, region="columns=0:4", when="frames=0:9")
    moved = effect.at_place(Region(columns=((4, 8),)))
    for effects in ((effect, more), (moved,), (effect.at_place(None),)):
        write_model(path, ModelSettings(effects=effects))
        assert load_config(path).model.effects == effects
    assert path.read_text() == YAML


def test_a_wrong_place_is_told_with_its_key():
    with pytest.raises(ConfigError, match=r"tap\.npy: cannot be read"):
        parse_config(YAML, "night.yaml")
    with pytest.raises(ConfigError, match=r"region.*'colums=3:4'.*columns=A:B"):
        parse_config(YAML.replace("{mask: tap.npy}", "colums=3:4"), "night.yaml")
