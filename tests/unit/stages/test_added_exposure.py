"""Exposure beside H: how effects give it, how it is put together, and how the store keeps it."""

import numpy as np
import pytest

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.compose import AddedExposure, added_exposures, pixel_maps, sample_law
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.effects.operators.light import DarkCurrentRts, Persistence
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.run.model_versions import (
    AddedArrays,
    keep_in_force,
    model_in_force,
    read_added_exposure,
    verdict_version,
    write_added_exposure,
)
from pchem_pipeline.store.run_store import RunStore

MAPS = PixelMaps(*(np.full((6, 8), v) for v in (1.5, 0.1, 100.0, 3.0)), np.ones((6, 8), bool))
GHOST = Persistence(peak_e=0.5, decay_frames=300.0, slow_decay_frames=2000.0, radius=0.3)


def test_ghost_has_the_moments_of_its_course():
    numbers = np.arange(1000)
    frames = np.zeros((0, 6, 8), np.uint16)
    added = GHOST.added_exposure(frames, numbers, MAPS)
    course = 0.25 * (np.exp(-numbers / 300) + np.exp(-numbers / 2000))
    pattern = GHOST.pattern(np.arange(6), (6, 8))
    for power in (1, 2, 3):
        expected = (course**power).mean() * pattern**power
        np.testing.assert_allclose((added.weight * added.exposure_e**power).sum(axis=0), expected, rtol=1e-9)
    np.testing.assert_allclose(added.weight.sum(axis=0), 1.0)
    assert Persistence(peak_e=0.0, decay_frames=300.0).added_exposure(frames, numbers, MAPS) is None


def test_effects_add_up_the_others_add_nothing_and_one_that_fails_is_named():
    one = AddedExposure(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.7, 1.0], [0.3, 0.0]]))
    two = AddedExposure(np.array([[0.1, 0.2], [0.4, 0.6]]), np.array([[0.5, 0.5], [0.5, 0.5]]))
    both = one.combined_with(two)
    assert both.weight.shape == (4, 2)
    np.testing.assert_allclose(both.weight.sum(axis=0), 1.0)
    np.testing.assert_allclose((both.weight * both.exposure_e).sum(axis=0), [0.3 + 0.25, 0.4])
    np.testing.assert_array_equal(both.of(np.array([1])).exposure_e[:, 0], both.exposure_e[:, 1])
    frames = np.zeros((1000, 6, 8), np.uint16)
    alone = added_exposures([RowNoise(row_noise_dn=1.0), GHOST], frames, np.arange(1000), MAPS)
    columns = [MAPS.quanta_exposure, MAPS.conversion_gain, MAPS.bias, MAPS.read_noise_dn]
    law = sample_law([RowNoise(row_noise_dn=1.0)], pixel_maps(columns, MAPS.usable), alone)
    assert law.added_exposure.shape == (48, 3)
    np.testing.assert_array_equal(law.added_exposure[10], alone.exposure_e[:, 1, 2])
    assert added_exposures([RowNoise(row_noise_dn=1.0)], frames, np.arange(1000), MAPS) is None

    class Broken(RowNoise):
        def added_exposure(self, *_):
            raise ZeroDivisionError("oh")

    with pytest.raises(ConfigError, match=r"row_noise .* cannot tell .* ZeroDivisionError: oh"):
        added_exposures([Broken(row_noise_dn=1.0)], frames, np.arange(1000), MAPS)


def test_a_version_of_the_model_gives_it_back_and_models_with_the_same_effect_take_it_over(tmp_path):
    store = RunStore.create(tmp_path / "run.zarr")
    store.create_array("histogram/origin", (8, 9), chunks=(8, 9))
    blinking, noise = DarkCurrentRts(fraction=0.1), RowNoise(row_noise_dn=1.0)
    exposure = np.zeros((2, 3, 4))
    exposure[1, 1, 2] = 0.8
    weight = np.stack([np.ones((3, 4)), np.zeros((3, 4))])
    weight[:, 1, 2] = 0.6, 0.4
    found = AddedExposure(exposure, weight)
    write_added_exposure(store, "discrepancy", found, [noise, blinking], (2, 5), (3, 7))
    plain = keep_in_force(store, model_in_force(store, ModelSettings()))
    assert read_added_exposure(store, plain) is None
    found = verdict_version(store, ModelSettings(effects=(blinking,)), plain, group="discrepancy")
    found = keep_in_force(store, found)
    store.delete("discrepancy")  # the version has its own
    whole = read_added_exposure(store, found)
    assert whole.exposure_e.shape == (2, 8, 9)
    assert np.argwhere(whole.exposure_e[1] > 0).tolist() == [[3, 5]]
    np.testing.assert_array_equal(whole.weight.sum(axis=0), 1.0)
    # a model by hand with the same effect and another one beside
    both = keep_in_force(store, model_in_force(store, ModelSettings(effects=(blinking, noise))))
    part = read_added_exposure(store, both, (slice(3, 8), slice(4, 9)))
    np.testing.assert_array_equal(part.exposure_e, whole.exposure_e[:, 3:8, 4:9])
    np.testing.assert_array_equal(part.weight, whole.weight[:, 3:8, 4:9])
    assert both.number == 3
    assert both.added.group == "model/0002"
    # pixels that were not looked at, and models without the effect or with another of its kind
    assert read_added_exposure(store, both, (slice(5, 8), slice(None))) is None
    for effect in (noise, DarkCurrentRts(fraction=0.2)):
        assert model_in_force(store, ModelSettings(effects=(effect,))).added is None
    write_added_exposure(store, "discrepancy", None, [], (0, 8), (0, 9))
    assert AddedArrays.of_group(store, "discrepancy") is None
