"""The empirical component: shifts of the samples are measured, simulated and fitted, and never compete."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from pchem_pipeline.discrepancy.build_verdict import Added, Addition, Findings
from pchem_pipeline.discrepancy.by_simulation.candidates import candidate_classes
from pchem_pipeline.discrepancy.by_simulation.empirical import measured_shifts
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.adc.empirical import Empirical
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

SHAPE, FRAMES, STEP = (10, 12), 3000, 12.0


def frames(seed: int, share: float = 0.0, shift: int = 0) -> tuple[np.ndarray, PixelMaps]:
    """Return frames of a plain sensor, some samples moved, and its true parameters."""
    rng = np.random.default_rng(seed)
    exposure, bias = rng.uniform(0.6, 2.0, SHAPE), rng.uniform(95.0, 105.0, SHAPE)
    noise = rng.uniform(0.22, 0.28, SHAPE) * STEP
    signal = (
        bias + STEP * rng.poisson(exposure, (FRAMES, *SHAPE)) + noise * rng.standard_normal((FRAMES, *SHAPE))
    )
    code = np.floor(signal + 0.5).astype(np.int64)
    code += shift * (rng.random(code.shape) < share)
    maps = PixelMaps(
        exposure, np.full(SHAPE, 1 / STEP), bias, np.sqrt(noise**2 + 1 / 12), np.ones(SHAPE, bool)
    )
    return code.astype(np.uint16), maps


@pytest.mark.parametrize(("share", "shift"), [(0.004, -8), (0.02, 4)])
def test_shifts_are_measured(share: float, shift: int) -> None:
    found = measured_shifts(*frames(3, share, shift), ())
    assert found is not None
    samples = FRAMES * SHAPE[0] * SHAPE[1]
    mean = float(found.shares() @ np.array(found.shift_dn))
    # neighbouring shifts of the grid stand for one another: their mean is what is known well
    assert mean == pytest.approx(share * shift, rel=0.1)
    assert found.share == pytest.approx(share, rel=0.35)
    assert found.share * samples > 100


def test_nothing_is_measured_where_there_is_nothing() -> None:
    found = [measured_shifts(*frames(seed), ()) for seed in range(4)]
    assert [one for one in found if one is not None and one.share > 1e-3] == []


def test_what_is_simulated_follows_the_law_that_is_fitted() -> None:
    effect = Empirical(share=0.2, shift_dn=(-9.0, 5.0), weight=(3.0, 1.0))
    np.testing.assert_allclose(effect.shares(), [0.15, 0.05])

    class Random:
        def uniform(self, dims: tuple[str, ...], draw: int = 0) -> np.ndarray:
            assert dims == ("frame", "y", "x")
            return np.random.default_rng(5).random((200_000, 1, 1))

    class Context:
        random = Random()

    moved = effect.apply(np.zeros((200_000, 1, 1)), Context())  # type: ignore[arg-type]
    for shift, share in ((-9.0, 0.15), (5.0, 0.05), (0.0, 0.8)):
        error = np.sqrt(share * (1 - share) / moved.size)
        assert abs((moved == shift).mean() - share) < 5 * error
    maps = PixelMaps(*(np.array([v]) for v in (1.2, 1 / STEP, 100.0, 3.0)), np.ones(1, bool))
    codes = np.arange(40, 260)
    law = sample_mass(effect.sample_law(SampleLaw(), maps), (1.2, 1 / STEP, 100.0, 3.0), codes)[0]
    plain = sample_mass(SampleLaw(), (1.2, 1 / STEP, 100.0, 3.0), codes)[0]
    wanted = 0.8 * plain + 0.15 * np.roll(plain, -9) + 0.05 * np.roll(plain, 5)
    np.testing.assert_allclose(law[20:-20], wanted[20:-20], atol=1e-9)


def test_it_competes_with_nothing_and_refuses_half_a_table() -> None:
    assert "empirical" not in candidate_classes(DiscrepancySettings())
    with pytest.raises(ValidationError, match="one weight"):
        Empirical(share=0.1, shift_dn=(1.0, 2.0), weight=(1.0,))


def test_a_described_sensor_is_said_so_and_keeps_the_component_in_its_model() -> None:
    effect = Empirical(share=0.004, shift_dn=(-8.0,), weight=(1.0,))
    before, after = Gap(2e-3, 5e-5, (0.0, 0.0), {}), Gap(3e-5, 5e-5, (0.0, 0.0), {})
    addition = Addition(effect, True, "", (), 1e-4, before, after, (), None, (), described=True)
    found = Findings(
        "frames",
        None,
        None,
        None,
        before,
        [],
        False,
        Added((addition,), after),  # type: ignore[arg-type]
    )
    assert found.state == "described"
    assert found.named == ()
    assert found.model((), (effect,)) == (effect,)
    step = addition.step(None)
    assert (step.verdict, step.effect) == ("described", None)
    from pchem_pipeline.discrepancy.build_verdict import _sentence

    assert "0.004 of the samples" in _sentence(found, {})
    assert "-8 DN" in _sentence(found, {})
    assert "have it alike" in _sentence(found, {})
    assert "not known" in _sentence(replace(found, still=True), {})
