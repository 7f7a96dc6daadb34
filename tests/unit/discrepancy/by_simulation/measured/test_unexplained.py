"""Of all that can be measured what explains most is simulated first; what fails is told and no more."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis
from pchem_pipeline.discrepancy.by_simulation.explainer import FrameExplainer
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.measured.samples import Measurement
from pchem_pipeline.discrepancy.by_simulation.measured.unexplained import Unexplained, _Likely
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import Prepared
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.empirical_noise import EmpiricalNoise
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.effects.operators.replace import Empirical

TAP = Part(Region(columns=((8, 16),)))


def unexplained_beside(work: Any = None) -> Unexplained:
    """Return what measures frames beside no effects."""
    fit: Any = SimpleNamespace(present=(), model=lambda effects: effects)
    return Unexplained(work, fit)


def test_each_form_comes_in_its_likeliest_part_and_the_likeliest_form_first() -> None:
    of = partial(Measurement, Empirical.typical()[0])

    def broken(*_: Any) -> Measurement:
        raise ValueError("no such line")

    frames: Any = SimpleNamespace(parts=(TAP,), samples=lambda part: 300 if part == TAP else 1000)
    nothing, effort, counted = None, Effort(1.0), Effort(1.0)
    work = SimpleNamespace(frames=frames, observed=ObservedFrames(frames, nothing, nothing), effort=effort)
    unexplained = unexplained_beside(work)
    forms = {
        "moves": lambda part, *_: of(30.0) if part == Part() else None,
        "noise": lambda part, *_: of(700.0 if part == TAP else 20.0),
        "broken": broken,
    }
    found = [(one.part, one.form) for one in unexplained._likeliest((), forms)]
    assert found == [(TAP, "noise"), (Part(), "moves")]
    assert "no such line" in unexplained.defects["broken"]
    counted.ask(1300)
    assert effort.spent == counted.spent > 0.0


def test_effects_that_leave_a_tenth_of_what_they_closed_get_no_name_where_the_final_frames_prove_it() -> None:
    left = Gap(0.3, 0.01, (0.11, 0.5), {})
    assert left.too_wide(1.0)
    assert not left.too_wide(1.2)
    assert not Gap(0.3, 0.01, (-0.1, 0.7), {}).too_wide(1.0)


def test_the_clearer_of_noise_and_gain_is_told_and_a_wave_first(monkeypatch: pytest.MonkeyPatch) -> None:
    unexplained = unexplained_beside()
    samples = SimpleNamespace(of=lambda _: None, maps=None, evidence=None, inside=None)
    monkeypatch.setattr(unexplained, "_of", lambda *_: samples)
    effect = EmpiricalNoise.typical()[0]
    gains: dict[str, float | None] = {"wave": None}
    for name in ("mode", "noise", "wave"):

        def measured(*_: Any, own: str = name) -> Measurement | None:
            return None if gains[own] is None else Measurement(effect, gains[own] or 0.0)

        monkeypatch.setattr(f"{Unexplained.__module__}.measured_{name}", measured)
    for gains["mode"], gains["noise"], best in ((3.0, 9.0, 9.0), (9.0, 3.0, 9.0), (None, 3.0, 3.0)):
        found = unexplained._noise(Part(), (), ())
        assert (found.gain, len(found.others)) == (best, gains["mode"] is not None)
    # a wave is in the covariances of all distances: it is tried first, however many nats these have
    gains["wave"] = 2.0
    found = unexplained._noise(Part(), (), ())
    assert (found.gain, len(found.others)) == (3.0, 1)
    gains.update(mode=None, noise=None, wave=None)
    assert unexplained._noise(Part(), (), ()) is None


def test_all_forms_are_yielded_and_measured_once_whatever_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    unexplained = unexplained_beside()
    one = Measurement(Empirical.typical()[0], 9.0)
    likely = [_Likely(Part(), form, one) for form in ("any", "fails", "other")]
    asked: list[Any] = []

    def described(_: Any, __: Any, form: str) -> list[str]:
        if form == "fails":
            raise ValueError("no such line")
        return [form, f"or {form}"]

    unexplained.__dict__["_forms"] = {form: form for form in ("any", "fails", "other", "empirical")}
    monkeypatch.setattr(unexplained, "_likeliest", lambda _, forms: asked.append([*forms]) or likely)
    monkeypatch.setattr(unexplained, "_described", described)
    kept = (Hypothesis(one.effect, np.zeros(1)),)
    assert [*unexplained.measured(kept)] == ["any", "or any", "other", "or other"]
    assert unexplained.defects == {"fails": "ValueError: no such line"}
    assert [*unexplained.measured(kept)] == []
    assert asked == [["any", "fails", "other"]]  # the form that is among the effects is not measured again


@pytest.mark.parametrize(
    ("after", "measured", "closes"),
    [(0.0, True, True), (0.4, True, True), (0.6, True, False), (0.6, False, True), (2.0, False, False)],
)
def test_what_is_measured_must_close_half_of_the_gap(after: float, measured: bool, closes: bool) -> None:
    first, last = (Gap(value, 0.01, (value - 0.1, value + 0.1), {}) for value in (1.0, after))
    judge: Any = SimpleNamespace(gap=lambda _: first, gap_at=lambda *_: last, widens=lambda _: after > 1.0)
    nothing: Any = None
    work: Any = SimpleNamespace(effort=Effort(None))
    data = Prepared(DiscrepancySettings(), "frames", nothing, nothing, nothing, nothing, work.effort, {})
    search = FrameExplainer(data, nothing, work, nothing, judge, ())
    effect = EmpiricalNoise.typical()[0] if measured else RowNoise.typical()[0]
    one: Any = SimpleNamespace(effects=(effect,), mean=None, vectors=None)
    assert search._closes(one) is closes
