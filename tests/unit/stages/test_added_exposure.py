"""Exposure beside H: how effects give it, how it is put together, and how the store keeps it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.analog.row_noise import RowNoise
from pchem_pipeline.effects.exposure.dark_current_rts import DarkCurrentRts
from pchem_pipeline.effects.exposure.persistence import Persistence
from pchem_pipeline.effects.framework.added_exposure import AddedExposure, added_exposures
from pchem_pipeline.effects.framework.compose import marginal_model, pixel_maps
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.stages.fit.added_exposure import read_added_exposure, write_added_exposure
from pchem_pipeline.store.run_store import RunStore

MAPS = PixelMaps(*(np.full((6, 8), v) for v in (1.5, 0.1, 100.0, 3.0)), np.ones((6, 8), bool))
GHOST = Persistence(peak_e=0.5, decay_frames=300.0, slow_decay_frames=2000.0, radius=0.3)


def test_ghost_has_the_moments_of_its_course() -> None:
    numbers = np.arange(1000)
    frames = np.zeros((0, 6, 8), np.uint16)
    added = GHOST.added_exposure(frames, numbers, MAPS)
    assert added is not None
    course = 0.25 * (np.exp(-numbers / 300) + np.exp(-numbers / 2000))
    pattern = GHOST.pattern(np.arange(6), (6, 8))
    for power in (1, 2, 3):
        expected = (course**power).mean() * pattern**power
        np.testing.assert_allclose((added.weight * added.exposure_e**power).sum(axis=0), expected, rtol=1e-9)
    np.testing.assert_allclose(added.weight.sum(axis=0), 1.0)
    assert Persistence(peak_e=0.0, decay_frames=300.0).added_exposure(frames, numbers, MAPS) is None


def test_effects_add_up_and_the_others_add_nothing() -> None:
    one = AddedExposure(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.7, 1.0], [0.3, 0.0]]))
    two = AddedExposure(np.array([[0.1, 0.2], [0.4, 0.6]]), np.array([[0.5, 0.5], [0.5, 0.5]]))
    both = one.beside(two)
    assert both.weight.shape == (4, 2)
    np.testing.assert_allclose(both.weight.sum(axis=0), 1.0)
    np.testing.assert_allclose((both.weight * both.exposure_e).sum(axis=0), [0.3 + 0.25, 0.4])
    np.testing.assert_array_equal(both.of(np.array([1])).exposure_e[:, 0], both.exposure_e[:, 1])
    frames = np.zeros((1000, 6, 8), np.uint16)
    alone = added_exposures([RowNoise(row_noise_dn=1.0), GHOST], frames, np.arange(1000), MAPS)
    assert alone is not None
    columns = [MAPS.quanta_exposure, MAPS.conversion_gain, MAPS.bias, MAPS.read_noise_dn]
    law = marginal_model([RowNoise(row_noise_dn=1.0)], pixel_maps(columns, MAPS.usable), alone)
    assert law.added_exposure.shape == (48, 3)
    np.testing.assert_array_equal(law.added_exposure[10], alone.exposure_e[:, 1, 2])
    assert added_exposures([RowNoise(row_noise_dn=1.0)], frames, np.arange(1000), MAPS) is None


def test_an_effect_that_fails_is_named() -> None:
    class Broken(RowNoise):
        def added_exposure(self, *_: object) -> AddedExposure | None:
            raise ZeroDivisionError("oh")

    frames = np.zeros((2, 6, 8), np.uint16)
    with pytest.raises(ConfigError, match=r"row_noise .* cannot tell .* ZeroDivisionError: oh"):
        added_exposures([Broken(row_noise_dn=1.0)], frames, np.arange(2), MAPS)


def test_store_gives_it_back_to_the_model_that_it_belongs_to(tmp_path: Path) -> None:
    store = RunStore.create(tmp_path / "run.zarr")
    blinking, noise = DarkCurrentRts(fraction=0.1), RowNoise(row_noise_dn=1.0)
    exposure = np.zeros((2, 3, 4))
    exposure[1, 1, 2] = 0.8
    weight = np.stack([np.ones((3, 4)), np.zeros((3, 4))])
    weight[:, 1, 2] = 0.6, 0.4
    kept = AddedExposure(exposure, weight)
    write_added_exposure(store, kept, [noise, blinking], (2, 5), (3, 7))
    whole = read_added_exposure(store, [blinking], (8, 9))
    assert whole is not None
    assert whole.exposure_e.shape == (2, 8, 9)
    assert np.argwhere(whole.exposure_e[1] > 0).tolist() == [[3, 5]]
    np.testing.assert_array_equal(whole.weight.sum(axis=0), 1.0)
    part = read_added_exposure(store, [blinking, noise], (8, 9), (slice(3, 8), slice(4, 9)))
    assert part is not None
    np.testing.assert_array_equal(part.exposure_e, whole.exposure_e[:, 3:8, 4:9])
    np.testing.assert_array_equal(part.weight, whole.weight[:, 3:8, 4:9])
    # pixels that were not looked at, and models without the effect or with another of its kind
    assert read_added_exposure(store, [blinking], (8, 9), (slice(5, 8), slice(None))) is None
    assert read_added_exposure(store, [noise], (8, 9)) is None
    assert read_added_exposure(store, [DarkCurrentRts(fraction=0.2)], (8, 9)) is None
    write_added_exposure(store, None, [], (0, 8), (0, 9))
    assert read_added_exposure(store, [blinking], (8, 9)) is None
