"""The empirical component: an offset that runs as a wave across rows, columns and frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_simulation.measured.modes import MADE
from pchem_pipeline.discrepancy.by_simulation.measured.samples import Measurement, PartSamples
from pchem_pipeline.discrepancy.observe.waves import Waves, waves_across
from pchem_pipeline.effects.analog.empirical_noise import EmpiricalNoise, NoiseMode, root_mean_square
from pchem_pipeline.effects.estimators.common_modes import mean_response
from pchem_pipeline.effects.framework.evidence import Evidence


def running_waves(samples: PartSamples) -> Waves:
    """Measure the waves that run across rows, columns and frames."""
    return waves_across(samples.frames, samples.numbers, samples.laws, samples.maps, samples.inside)


def measured_wave(
    data: Waves, model: Waves, evidence: Evidence, inside: NDArray[np.bool_]
) -> Measurement | None:
    """Return the wave whose phase runs on, beyond a model's; None where there is none.

    Args:
        data: of the frames.
        model: of frames simulated with it.
        evidence: of the frames.
        inside: pixels that were looked at, shape (y, x).
    """
    wave, made = data.steady, model.steady
    if wave is None or (made is not None and made.amplitude > MADE * wave.amplitude):
        return None
    per_frame, per_row, per_column = wave.per_frame or 0.0, wave.per_row, wave.per_column
    cycles = round(per_frame, 7), round(per_row, 6), round(per_column, 6)
    size = wave.amplitude * root_mean_square(cycles) / mean_response(evidence, inside)
    mode = NoiseMode(of="sample", share=1.0, wave=cycles)
    return Measurement(EmpiricalNoise(noise_dn=size, modes=(mode,)), wave.excess)
