"""What candidates are asked for, everywhere and in parts."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.discrepancy_material import evidence

from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import ReplicateSimulator
from pchem_pipeline.discrepancy.by_simulation.candidates.screening import Screening
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.region import When
from pchem_pipeline.effects.framework.registry import effect_class

PART = Part(None, When(range=((300, 420),)))
NAMES = ("tail.low.count", f"tail.low.count@{PART.text}", "shape.He4.mean")


@pytest.mark.parametrize(("of_all", "of_itself", "seen"), [(8.0, 1.5, 8.0), (0.5, -6.0, -6.0)])
def test_a_part_shows_what_it_does_beside_the_model_of_all_frames_or_of_itself(
    of_all: float, of_itself: float, seen: float
) -> None:
    """A few samples far below all others are lost in a fit of few frames, and stand out in one of all."""
    null = NullModel.from_replicates(NAMES, np.random.default_rng(1).standard_normal((4000, 3)))
    chance = np.sqrt(0.5)  # of the mean of two splits
    z = Measured(*(np.array([0.0, of_all * chance, 9.0]) for _ in range(3)))
    own = replace(evidence(), z={"tail.low.count": of_itself, "shape.He4.mean": 1.0})
    observed: Any = SimpleNamespace(
        plain=own, samples=1, frames=SimpleNamespace(seen_apart=lambda _: [(PART, own)])
    )
    work: Any = SimpleNamespace(effort=SimpleNamespace(ask=lambda _: None))
    asked: list[Any] = []
    simulator: Any = SimpleNamespace(guesses=lambda *given: asked.append(given[2]) or [])
    Screening(observed, work, z, {}, (), 0.1)._guesses(simulator, (), null, (), 5)
    [[(part, found)]] = asked
    assert part == PART
    assert found.z["tail.low.count"] == pytest.approx(seen, rel=0.05)
    # what is known of all frames only says nothing about the part
    assert found.z["shape.He4.mean"] == 1.0


def test_what_chance_hides_of_an_effect_is_seen_at_a_larger_strength() -> None:
    acquisition: Any = SimpleNamespace(numbers=np.arange(100))

    def simulated(replicates: Any) -> Any:
        return [{"shape.He4.mean": 1000.0 * sum(e.share for e in one.effects)} for one in replicates]

    simulator = ReplicateSimulator(evidence().maps, (), acquisition, NAMES, simulated, 1)
    kind = effect_class("heavy_tailed_noise")
    weak, other, strong = (kind.model_validate({"share": share}) for share in (0.002, 0.0019, 0.02))
    hypotheses = simulator.fingerprints([weak, other, strong])
    assert [h.fingerprint[2] for h in hypotheses] == [0.0, 0.0, pytest.approx(20.0)]
    told, guessed, clear = simulator._visible(hypotheses, [weak])
    # numbers that are told stay, and so does what they do
    assert told.effect is weak
    assert told.fingerprint[2] == pytest.approx(2.0)
    assert guessed.effect.share == pytest.approx(4 * 0.0019)
    assert guessed.fingerprint[2] == pytest.approx(7.6)
    assert clear is hypotheses[2]


def test_a_signature_of_no_statistic_is_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    acquisition: Any = SimpleNamespace(numbers=np.arange(100), window=None)
    simulator = ReplicateSimulator(evidence().maps, (), acquisition, NAMES, lambda _: [], 1)
    kind = effect_class("row_noise")
    monkeypatch.setattr(kind, "signature", ("frame.readout.varience",))
    assert simulator.guesses({"row_noise": kind}, [evidence()]) == []
    assert "names no statistics: frame.readout.varience" in simulator.defects["row_noise"]
