"""Of all that can be measured what explains most is simulated first; what fails is told and no more."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from pchem_pipeline.discrepancy.by_simulation.additions import leaves_too_much
from pchem_pipeline.discrepancy.by_simulation.empirical import Measurement
from pchem_pipeline.discrepancy.by_simulation.unexplained import Unexplained
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.readout.empirical import Empirical

TAP = Part(Region(columns=((8, 16),)))


def test_the_form_and_part_that_explain_most_come_first() -> None:
    effect = Empirical.typical()[0]

    def moves(part: Part, *_: Any) -> Measurement | None:
        return Measurement(effect, 30.0) if part == Part() else None

    def noise(part: Part, *_: Any) -> Measurement:
        return Measurement(effect, 700.0 if part == TAP else 20.0)

    def broken(*_: Any) -> Measurement:
        raise ValueError("no such line")

    frames = SimpleNamespace(parts=(TAP,))
    refitter = SimpleNamespace(model=lambda effects: effects)
    nothing: Any = None
    unexplained = Unexplained(
        frames, nothing, refitter, nothing, nothing, nothing, 0, 0, nothing  # type: ignore[arg-type]
    )  # fmt: skip
    forms = {"moves": moves, "noise": noise, "broken": broken}
    assert unexplained._likeliest((), forms) == [(TAP, "noise"), (Part(), "moves"), (Part(), "noise")]
    assert "no such line" in unexplained.defects["broken"]


def test_effects_that_leave_a_tenth_of_what_they_closed_get_no_name_where_the_final_frames_prove_it() -> None:
    left = Gap(0.3, 0.01, (0.11, 0.5), {})
    assert leaves_too_much(left, 1.0)
    assert not leaves_too_much(left, 1.2)
    assert not leaves_too_much(Gap(0.3, 0.01, (-0.1, 0.7), {}), 1.0)
