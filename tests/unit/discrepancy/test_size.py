"""The size of an effect: as large as its law says, wherever it acts in the signal chain."""

from dataclasses import replace

import numpy as np
import pytest

from pchem_pipeline.discrepancy.size import size_of
from pchem_pipeline.discrepancy.verdict import Size
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.framework.registry import effect_class

SHAPE = (24, 24)
GAIN, NOISE, EXPOSURE = 0.1, 3.0, 2.0
MAPS = PixelMaps(
    np.full(SHAPE, EXPOSURE), np.full(SHAPE, GAIN), np.full(SHAPE, 100.0), np.full(SHAPE, NOISE),
    np.ones(SHAPE, bool),
)  # fmt: skip


@pytest.mark.parametrize(
    ("tag", "fields", "electrons", "draws", "n_frames"),
    [
        ("row_noise", {"row_noise_dn": 0.5}, 0.5 * GAIN, 12 * 20_000, 300),
        ("frame_noise", {"frame_noise_dn": 0.2}, 0.2 * GAIN, 20_000, 4000),
        ("signal_dependent_noise", {"noise_e": 0.1}, 0.1 * np.sqrt(EXPOSURE), 144 * 20_000, 4000),
        # not the electrons that a simulation happens to move: few samples, one each
        ("overdispersed_counts", {"relative_variance": 0.01}, 0.1 * EXPOSURE, 144 * 20_000, 300),
    ],
)
def test_the_size_is_what_the_law_of_the_effect_says(
    tag: str, fields: dict[str, float], electrons: float, draws: int, n_frames: int
) -> None:
    """Of a short run no less well than of a long one: the draws are as many."""
    size = size_of(effect_class(tag).model_validate({"tag": tag, **fields}), MAPS, n_frames)
    assert size.electrons == pytest.approx(electrons, rel=4.0 / np.sqrt(2.0 * draws) + 0.005)
    assert size.dn == pytest.approx(size.electrons / GAIN)
    assert size.of_read_noise == pytest.approx(size.dn / NOISE)


def test_an_effect_that_goes_back_far_in_time_has_a_size() -> None:
    """A trap that is full in a share f of the frames takes as often as it releases, f times the release."""
    fields = {"tag": "trapping", "capture": 0.03, "release": 0.02}
    effect = effect_class("trapping").model_validate(fields)
    assert effect.history() > 500
    size = size_of(effect, MAPS, 4000)
    caught = fields["capture"] * (1.0 - np.exp(-EXPOSURE))
    full = caught / (caught + fields["release"])
    assert size.samples == pytest.approx(2.0 * full * fields["release"], rel=0.05)
    assert size.electrons == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("changes", ["offset", "light"])
def test_a_measured_noise_has_the_size_that_was_measured(changes: str) -> None:
    """Light that varies by 5 % changes few samples, by whole electrons: that is their shot noise."""
    mode = {"of": "row", "share": 1.0, "changes": changes, "signal_dn": EXPOSURE / GAIN}
    fields = {"tag": "empirical_noise", "noise_dn": 1.0, "modes": [mode]}
    size = size_of(effect_class("empirical_noise").model_validate(fields), MAPS, 4000)
    wanted = Size(electrons=GAIN, dn=1.0, of_read_noise=1.0 / NOISE, samples=1.0)
    assert size.model_dump() == pytest.approx(wanted.model_dump())


def test_the_size_in_a_part_is_that_where_it_acts_and_there_is_none_of_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    effect = effect_class("row_noise").model_validate({"tag": "row_noise", "row_noise_dn": 0.5})
    part = effect.at_place(Region.model_validate({"columns": [[0, 4]]}))
    assert size_of(part, MAPS, 1000) == size_of(effect, MAPS, 1000)
    assert size_of(effect, replace(MAPS, usable=np.zeros(SHAPE, bool)), 1000) is None
    nothing = f"{size_of.__module__}._change", lambda _, maps, *__: np.zeros((4, *maps.usable.shape))
    monkeypatch.setattr(*nothing)
    assert size_of(effect_class("black_clamp").typical()[0], MAPS, 1000) is None


def test_a_size_is_told_with_the_samples_that_change() -> None:
    for (electrons, dn, of_read_noise, samples), words in (
        ((0.039, 0.61, 0.11, 1.0), "samples change by 0.61 DN rms, 11 % of the median read noise"),
        (
            (213.0, 2028.0, 831.06, 0.0081),
            "0.81 % of the samples in its region and frames change by 2028 DN rms, 831 times the median read "
            "noise",
        ),
        ((1.1, 12.0, 3.41, 1.0), "samples change by 12 DN rms, 3.4 times the median read noise"),
    ):
        size = Size(electrons=electrons, dn=dn, of_read_noise=of_read_noise, samples=samples)
        assert size.words() == words
