"""Offsets of frames, rows and columns: found as well as the pixels allow, with their noise."""

from typing import ClassVar

import numpy as np
import pytest
from helpers.known_camera import KnownCamera, pink

from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.effects.framework.effect import SharedOffset
from pchem_pipeline.effects.operators.drifts import BiasDrift
from pchem_pipeline.effects.operators.noise import NoiseSkew
from pchem_pipeline.effects.operators.offsets import (
    ColumnNoise,
    FrameNoise,
    PeriodicPickup,
    ReadOrderNoise,
    RowNoise,
)
from pchem_pipeline.use.common_modes import CommonModes, Reference, estimate_offsets, scene_of
from pchem_pipeline.use.electrons import electrons

SHAPE, N_FRAMES = (24, 40), 60
EVERYWHERE = np.ones((1, *SHAPE), bool)


def seen(frames, calibration):
    """All pixels, at the mean of the frames."""
    return Reference.of_pixels(calibration, scene_of(frames.mean(axis=0), calibration))


def taken(seed, read_noise, spread):
    """Frames whose offsets of (frame, row, column) have these standard deviations, DN."""
    rng = np.random.default_rng(seed)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=read_noise)
    sizes = (N_FRAMES, 1, 1), (N_FRAMES, SHAPE[0], 1), (N_FRAMES, 1, SHAPE[1])
    offset = sum(each * rng.standard_normal(size) for each, size in zip(spread, sizes, strict=True))
    true, frames = camera.frames(rng, 1.0, N_FRAMES, offset)
    modes = CommonModes(("row_noise",), EVERYWHERE, np.square([spread]))
    calibration = camera.calibration()
    return camera, true, frames, offset, modes, estimate_offsets(frames, seen(frames, calibration), modes)


@pytest.mark.parametrize(("read_noise", "share"), [((0.15, 0.25), 0.1), ((0.3, 0.45), 0.5)])
def test_offsets_are_as_near_as_they_say(read_noise, share):
    camera, true, frames, offset, modes, found = taken(50, read_noise, (1.0, 1.5, 1.2))
    total = found.of_samples(modes)
    variance = ((total - offset) ** 2).mean()
    # where peaks overlap, a sample says less of an offset than its read noise allows
    assert variance < share * (offset**2).mean()
    assert 0.6 < variance / found.left.mean() < 1.6
    calibration = camera.calibration()
    before, after = ((electrons(frames, calibration, each) - true).var() for each in (None, total))
    own = (camera.read_noise_e**2 + camera.gain**2 / 12).mean()
    square = (camera.gain**2).mean()
    assert before > own + 0.9 * square * (offset**2).mean()
    assert after < own + 1.1 * square * variance


def test_frames_without_offsets_lose_nothing():
    *_, found = taken(51, (0.15, 0.25), (0.0, 0.0, 0.0))
    assert not any(each.any() for each in (found.rows, found.columns, found.left))


def test_a_model_names_its_offsets():
    effects = (
        RowNoise(row_noise_dn=0.5),
        ColumnNoise(column_noise_dn=0.4),
        FrameNoise(frame_noise_dn=0.3),
        BiasDrift(drift_dn=0.2),
        PeriodicPickup(amplitude_dn=1.0, cycles_per_row=0.1),
        NoiseSkew.typical()[0],
    )
    modes = CommonModes.of_model(effects, SHAPE)
    assert modes.removed == ("row_noise", "column_noise", "frame_noise", "bias_drift", "periodic_pickup")
    np.testing.assert_allclose(modes.variances[0], (0.09 + 0.04, 0.25, 0.16))
    np.testing.assert_allclose(modes.waves, [[0.1, 0.0, 0.5, 0.0]])
    timed = CommonModes.of_model([RowNoise(row_noise_dn=1.0, when="frames=3:9")], SHAPE)
    assert (timed.removed, timed.left) == ((), ("row_noise",))
    still = CommonModes.of_model([PeriodicPickup(amplitude_dn=1.0, cycles_per_frame=0.2)], SHAPE)
    assert (len(still.waves), still.variances[0, 0]) == (0, 0.5)


def test_pixels_without_calibration_tell_nothing():
    _, camera, _, frames = KnownCamera.taken(52, SHAPE, 1.0, 5)
    calibration = camera.calibration()
    calibration.bias[0] = np.nan
    modes = CommonModes(("row_noise",), EVERYWHERE, np.array([[0.0, 1.0, 0.0]]))
    found = estimate_offsets(frames, seen(frames, calibration), modes)
    assert (found.rows[:, 0, 0] == 0).all()
    assert np.isfinite(found.rows).all()


def test_offsets_of_a_tap_are_found_there_and_beside_those_of_all():
    """Row noise of one readout tap, frame noise everywhere: each is found, and none is invented elsewhere."""
    rng = np.random.default_rng(54)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.15, 0.25))
    tap = RowNoise(row_noise_dn=1.5, region="columns=24:40")
    whole = FrameNoise(frame_noise_dn=1.0)
    modes = CommonModes.of_model([tap, whole], SHAPE)
    assert modes.removed == ("row_noise", "frame_noise")
    assert [int(part.sum()) for part in modes.parts] == [24 * 16, 24 * 40]
    np.testing.assert_allclose(modes.variances, [[0, 2.25, 0], [1, 0, 0]])
    rows = 1.5 * rng.standard_normal((N_FRAMES, SHAPE[0], 1)) * (np.arange(40) >= 24)
    offset = rows + rng.standard_normal((N_FRAMES, 1, 1))
    _, frames = camera.frames(rng, 1.0, N_FRAMES, offset)
    calibration = camera.calibration()
    reference = seen(frames, calibration)
    found = estimate_offsets(frames, reference, modes)
    error = (found.of_samples(modes) - offset) ** 2
    # a frame's offset is known from 960 samples, a row's from 16
    inside, outside = error[..., 24:].mean(), error[..., :24].mean()
    assert outside < 0.02
    assert inside < 0.2 * 2.25
    assert 0.6 < inside / found.left.sum(axis=1).mean() < 1.6
    # taken for all of the row, the tap's noise would be smeared over the pixels beside it
    smeared = CommonModes.of_model([RowNoise(row_noise_dn=1.5), whole], SHAPE)
    wrong = estimate_offsets(frames, reference, smeared)
    assert ((wrong.of_samples(smeared) - offset) ** 2)[..., :24].mean() > 10 * outside


WAVES = [(0.13, 0.21, None), (-0.31, 0.07, None), (0.17, 0.0, None), (0.0, 0.23, "columns=8:32")]


@pytest.mark.parametrize("amplitude", [0.4, 6.0])
@pytest.mark.parametrize(("per_row", "per_column", "region"), WAVES)
def test_pickup_of_any_orientation_is_taken_from_each_frame(per_row, per_column, region, amplitude):
    """Amplitude and phase change from frame to frame; a wave along rows costs two numbers, not one a row."""
    rng = np.random.default_rng(55)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.15, 0.3))
    y, x = np.arange(SHAPE[0])[:, None], np.arange(SHAPE[1])
    size, phase = rng.rayleigh(amplitude / np.sqrt(2), (N_FRAMES, 1, 1)), rng.uniform(0, 7, (N_FRAMES, 1, 1))
    inside = (x >= 8) & (x < 32) if region else True
    offset = size * np.sin(2 * np.pi * (per_row * y + per_column * x) + phase) * inside
    true, frames = camera.frames(rng, 1.0, N_FRAMES, offset)
    cycles = {"cycles_per_row": per_row, "cycles_per_column": per_column}
    pickup = PeriodicPickup(amplitude_dn=amplitude, region=region, **cycles)
    modes = CommonModes.of_model([pickup], SHAPE)
    assert modes.removed == ("periodic_pickup",)
    calibration = camera.calibration()
    found = estimate_offsets(frames, seen(frames, calibration), modes)
    total = found.of_samples(modes)
    np.testing.assert_allclose(found.of_samples(modes, slice(5, 9)), total[:, 5:9])
    error = ((total - offset) ** 2)[np.broadcast_to(inside, offset.shape)]
    # two numbers of some thousand samples: what stays is known, and little beside a sample's 2.5 DN
    assert 0.6 < error.mean() / found.left.mean() < 1.6
    assert error.mean() < 0.05
    before, after = ((electrons(frames, calibration, each) - true).var() for each in (None, total))
    own = (camera.read_noise_e**2 + camera.gain**2 / 12).mean()
    if amplitude > 1.0:
        assert before > 1.5 * own
    assert abs(after / own - 1) < 0.02


def test_a_wave_and_noise_of_rows_are_told_apart():
    rng = np.random.default_rng(56)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.15, 0.25))
    y, x = np.arange(SHAPE[0])[:, None], np.arange(SHAPE[1])
    phase = rng.uniform(0, 7, (N_FRAMES, 1, 1))
    offset = 2.0 * np.sin(2 * np.pi * (0.13 * y + 0.21 * x) + phase)
    offset = offset + 1.5 * rng.standard_normal((N_FRAMES, SHAPE[0], 1))
    _, frames = camera.frames(rng, 1.0, N_FRAMES, offset)
    slanted = PeriodicPickup(amplitude_dn=2.0, cycles_per_row=0.13, cycles_per_column=0.21)
    modes = CommonModes.of_model([RowNoise(row_noise_dn=1.5), slanted], SHAPE)
    assert len(modes.parts) == 1
    calibration = camera.calibration()
    found = estimate_offsets(frames, seen(frames, calibration), modes)
    error = ((found.of_samples(modes) - offset) ** 2).mean()
    assert 0.6 < error / found.left.mean() < 1.6
    assert error < 0.1 * (offset**2).mean()


@pytest.mark.parametrize(("taps", "region"), [(1, None), (3, None), (2, "columns=8:32")])
def test_noise_along_the_readout_is_taken_from_each_frame(taps, region):
    """As far as it is common to samples that follow each other: more than is common to those of a row."""
    rng = np.random.default_rng(57)
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=(0.15, 0.3))
    inside = np.broadcast_to([not region or 8 <= x < 32 for x in range(SHAPE[1])], SHAPE)
    offset = 2.0 * pink(rng, SHAPE, taps, N_FRAMES) * inside
    true, frames = camera.frames(rng, 1.0, N_FRAMES, offset)
    reference = seen(frames, camera.calibration())
    along = CommonModes.of_model([ReadOrderNoise(noise_dn=2.0, taps=taps, region=region)], SHAPE)
    assert along.removed == ("read_order_noise",)
    found, rows = (
        estimate_offsets(frames, reference, modes)
        for modes in (along, CommonModes.of_model([RowNoise(row_noise_dn=2.0, region=region)], SHAPE))
    )
    total = found.of_samples(along)
    np.testing.assert_allclose(found.of_samples(along, slice(5, 9)), total[:, 5:9])
    error = ((total - offset) ** 2)[:, inside].mean()
    of_rows = ((rows.of_samples(along) - offset) ** 2)[:, inside].mean()
    assert error < min(0.7 * (offset**2)[:, inside].mean(), 0.9 * of_rows)
    assert 0.8 < error / found.left.mean() < 1.25
    before, after = (
        (electrons(frames, camera.calibration(), each) - true)[:, inside].var() for each in (None, total)
    )
    assert after < 0.75 * before
    assert not total[:, ~inside].any()


class Stranger(RowNoise):
    """Of another package: noise of odd columns, say; what it says of it is given."""

    says: ClassVar[SharedOffset] = SharedOffset("column", 4.0)

    def shared_offset(self):
        return self.says


def test_an_effect_of_another_package_is_taken_as_it_says(monkeypatch):
    modes = CommonModes.of_model((Stranger(row_noise_dn=1.0),), SHAPE)
    assert modes.removed == ("row_noise",)
    np.testing.assert_array_equal(modes.variances, [[0.0, 0.0, 4.0]])
    for wrong in (SharedOffset("tap", 1.0), SharedOffset("row", np.nan), SharedOffset("row", -1.0)):
        monkeypatch.setattr(Stranger, "says", wrong)
        with pytest.raises(PchEmError, match="'row_noise': shared_offset"):
            CommonModes.of_model((Stranger(row_noise_dn=1.0),), SHAPE)
