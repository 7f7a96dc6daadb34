"""Of all that can be measured what explains most is simulated first; what fails is told and no more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from pchem_pipeline.discrepancy.by_simulation.explainer import FrameExplainer
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.measured.samples import Measurement
from pchem_pipeline.discrepancy.by_simulation.measured.unexplained import Unexplained, _Likely
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import Prepared
from pchem_pipeline.effects.analog.empirical_noise import EmpiricalNoise, NoiseMode
from pchem_pipeline.effects.analog.empirical_response import EmpiricalResponse, ResponseTerm
from pchem_pipeline.effects.charge.empirical_electrons import ElectronMode, EmpiricalElectrons
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.readout.empirical import Empirical, MixtureShift

TAP = Part(Region(columns=((8, 16),)))


@dataclass
class Goodness:
    """Fits nothing, and says the same of every set."""

    passes: bool = True
    small: bool = True
    present: tuple[()] = ()

    def passes_goodness_of_fit(self, _: Any) -> bool:
        return self.passes

    def residual_is_small(self, _: Any) -> bool:
        return self.small

    def model(self, effects: Any) -> Any:
        return effects


def unexplained_beside(fit: Goodness, work: Any = None) -> Unexplained:
    """Return what measures frames, with fits of which so much is said."""
    nothing: Any = None
    return Unexplained(work, fit, nothing, 0)  # type: ignore[arg-type]


def test_the_form_and_part_that_explain_most_come_first() -> None:
    effect = Empirical.typical()[0]

    def moves(part: Part, *_: Any) -> Measurement | None:
        return Measurement(effect, 30.0) if part == Part() else None

    def noise(part: Part, *_: Any) -> Measurement:
        return Measurement(effect, 700.0 if part == TAP else 20.0)

    def broken(*_: Any) -> Measurement:
        raise ValueError("no such line")

    frames: Any = SimpleNamespace(parts=(TAP,), samples=lambda part: 300 if part == TAP else 1000)
    nothing: Any = None
    effort = Effort(1.0)
    observed = ObservedFrames(frames, nothing, nothing)
    work = SimpleNamespace(frames=frames, observed=observed, effort=effort)
    unexplained = unexplained_beside(Goodness(), work)
    forms = {"moves": moves, "noise": noise, "broken": broken}
    found = [(one.part, one.form) for one in unexplained._likeliest((), forms)]
    assert found == [(TAP, "noise"), (Part(), "moves"), (Part(), "noise")]
    assert "no such line" in unexplained.defects["broken"]
    counted = Effort(1.0)
    counted.ask(1300)
    assert effort.spent == counted.spent > 0.0


def test_effects_that_leave_a_tenth_of_what_they_closed_get_no_name_where_the_final_frames_prove_it() -> None:
    left = Gap(0.3, 0.01, (0.11, 0.5), {})
    assert left.too_wide(1.0)
    assert not left.too_wide(1.2)
    assert not Gap(0.3, 0.01, (-0.1, 0.7), {}).too_wide(1.0)


def test_by_itself_only_what_no_named_effect_makes_is_tried_and_kept_where_it_leaves_little(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bias = EmpiricalNoise(noise_dn=1.0, modes=(NoiseMode(of="row", share=1.0),))
    gain = EmpiricalNoise(
        noise_dn=1.0, modes=(NoiseMode(of="row", share=1.0, changes="gain", signal_dn=9.0),)
    )
    fit = Goodness()
    unexplained = unexplained_beside(fit)
    likely = [_Likely(Part(), name, Measurement(e, 9.0)) for name, e in (("bias", bias), ("gain", gain))]
    unexplained.__dict__["_of_all"] = likely
    tried = []

    def described(_: Any, one: _Likely, **__: Any) -> Any:
        tried.append(one.form)
        return SimpleNamespace(effects=(one.measured.effect,))

    monkeypatch.setattr(unexplained, "_tried", described)
    assert not unexplained.explains_all()  # what is clearest has a name
    assert not tried
    for little in (False, True):
        fit.small = little
        found = unexplained.by_itself()
        assert (found is not None and found.effects == (gain,)) is little
    assert tried == ["gain"]
    assert not unexplained.explains_all()
    unexplained.__dict__["_of_all"] = likely[1:]
    unexplained.alone.clear()
    assert unexplained.explains_all()
    assert tried.pop() == "gain"
    # what is known is measured once
    assert unexplained.measured(()) is unexplained.by_itself() is unexplained.instead
    assert tried == ["gain"]


@pytest.mark.parametrize("little", [True, False])
def test_the_clearest_stands_by_itself_where_it_leaves_little(
    little: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    unexplained = unexplained_beside(Goodness(small=little))
    effects = Empirical.typical()[0], EmpiricalNoise.typical()[0]
    unexplained.__dict__["_of_all"] = [_Likely(Part(), "any", Measurement(e, 9.0)) for e in effects]
    monkeypatch.setattr(unexplained, "_tried", lambda _, one, **__: one.measured.effect)
    assert unexplained.clearest() == (effects[0] if little else None)
    both = NoiseMode(of="row", share=0.5), NoiseMode(of="frame", share=0.5)
    several = EmpiricalNoise(noise_dn=1.0, modes=both)
    unexplained.__dict__["_of_all"].insert(0, _Likely(Part(), "any", Measurement(several, 20.0)))
    assert unexplained.clearest() is None  # one of them may have a name
    unexplained.__dict__["_of_all"][0] = _Likely(Part(), "any", Measurement(several, 17.0))
    assert unexplained.clearest() == (effects[0] if little else None)  # another one is as clear
    assert unexplained.clearest(unlisted=True) is None
    ghost = EmpiricalResponse(response=0.1, terms=(ResponseTerm(place=(-1, 0, 0), above=4.0),))
    unexplained.__dict__["_of_all"].append(_Likely(Part(), "any", Measurement(ghost, 9.0)))
    assert unexplained.clearest(unlisted=True) == (ghost if little else None)


def test_what_is_measured_is_fitted_where_it_is_on_the_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = SimpleNamespace(on_sensor=lambda effect: effect.to_sensor((8, 16), (4, 12), (32, 32)))
    unexplained = unexplained_beside(Goodness(), SimpleNamespace(frames=frames))
    effect = EmpiricalResponse(response=0.1, terms=(ResponseTerm(place=(0, 0, -1), columns=(0, 2)),))
    fitted: list[Any] = []
    monkeypatch.setattr(unexplained, "_fitted", lambda _, one, __: fitted.append(one))
    found = unexplained._described((), TAP, lambda *_: Measurement(effect, 9.0), whole=False)
    assert found is None
    [one] = fitted
    assert one.terms[0].columns == (4, 6)
    assert one.region == TAP.region


def test_the_clearer_of_noise_and_gain_is_told_and_a_wave_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unexplained = unexplained_beside(Goodness())
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
        assert found.gain == best
    # a wave is in the covariances of all distances: it is tried first, however many nats these have
    gains["wave"] = 2.0
    found = unexplained._noise(Part(), (), ())
    assert (found.gain, len(found.others)) == (3.0, 1)
    gains.update(mode=None, noise=None, wave=None)
    assert unexplained._noise(Part(), (), ()) is None


def test_of_what_leaves_little_by_itself_the_better_one_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    unexplained = unexplained_beside(Goodness(passes=False, small=True))
    effects = [
        EmpiricalResponse(response=0.1, terms=(ResponseTerm(of=of),)) for of in ("row", "column", "frame")
    ]
    scores = dict(zip(effects, (-9.0, -3.0, -5.0), strict=True))
    unexplained.__dict__["_of_all"] = [_Likely(Part(), "response", Measurement(e, 9.0)) for e in effects]

    def described(_: Any, one: _Likely, **__: Any) -> Any:
        return SimpleNamespace(effects=(one.measured.effect,), score=scores[one.measured.effect])

    monkeypatch.setattr(unexplained, "_tried", described)
    found = unexplained.by_itself()
    assert found.effects == (effects[1],)


@pytest.mark.parametrize(
    ("effect", "unlisted"),
    [
        (NoiseMode(of="frame", share=1.0, changes="gain"), True),
        (NoiseMode(of="frame", share=1.0, changes="gain", lags=((1, 0, 0),), correlation=(0.5,)), False),
        (NoiseMode(of="frame", share=1.0, changes="light"), False),
        (NoiseMode(of="column", share=1.0, changes="light"), True),
        (ElectronMode(fate="followed"), False),
        (ElectronMode(fate="followed", place=(0, 1, 0)), False),
        (ElectronMode(fate="followed", place=(1, 0, 0)), True),
        (ElectronMode(fate="lost"), True),
        (ElectronMode(fate="emptied"), False),
        (MixtureShift(shift_dn=4), False),
        (MixtureShift(towards=(0, 0, 1)), False),
        (MixtureShift(towards=(-1, 0, 0), part=0.5), True),
    ],
)
def test_what_an_effect_with_a_name_makes_is_told_from_what_none_does(effect: Any, unlisted: bool) -> None:
    made = {
        NoiseMode: lambda: EmpiricalNoise(noise_dn=1.0, modes=(effect,)),
        ElectronMode: lambda: EmpiricalElectrons(chance=0.01, modes=(effect,)),
        MixtureShift: lambda: Empirical(share=0.1, moves=(effect,)),
    }
    assert made[type(effect)]().empirical_unnamed is unlisted


def test_rows_that_come_from_elsewhere_have_a_name() -> None:
    for place in ((0, 0, 1), (0, 1, 0)):
        shift = MixtureShift(towards=place)
        assert not Empirical(share=0.1, moves=(shift,), together="row").empirical_unnamed


def explainer(judge: Any, put: Callable[[Any], Any]) -> FrameExplainer:
    """Return a search that is judged so, and puts what was measured into its model so."""
    work: Any = SimpleNamespace(effort=Effort(None))
    grown: Any = SimpleNamespace(rounds=[], put_measured=put)
    nothing: Any = None
    data = Prepared(DiscrepancySettings(), "frames", nothing, nothing, nothing, nothing, work.effort, 3, {})
    return FrameExplainer(data, nothing, work, nothing, judge, grown)


@pytest.mark.parametrize(
    ("alone", "beside", "chosen"),
    [
        ((True, 1), (True, 1), "alone"),  # one form by itself closes all: nothing else is asked
        ((True, 2), (True, 1), "beside"),
        ((True, 2), (True, 2), "beside"),  # what has a name is kept where it does as well
        ((False, 1), (True, 2), "beside"),
        ((True, 2), (False, 1), "alone"),
        (None, (True, 1), "beside"),
        (None, None, None),
    ],
)
def test_what_closes_the_gap_in_fewest_forms_describes(
    monkeypatch: pytest.MonkeyPatch, alone: Any, beside: Any, chosen: str | None
) -> None:
    held = (SimpleNamespace(tag="row_noise"),)

    def found(name: str, how: Any) -> Any:
        modes = (NoiseMode(of="row", share=1.0), NoiseMode(of="frame", share=1.0))
        effects = [] if how is None else [EmpiricalNoise(noise_dn=1.0, modes=modes[: how[1]])]
        return None if how is None else SimpleNamespace(name=name, effects=effects, mean=how[0], vectors=None)

    known = {0: found("alone", alone), 1: found("beside", beside)}
    measures = SimpleNamespace(measured=lambda kept: known[len(kept)], by_itself=lambda: None)
    wide, closed = Gap(1.0, 0.01, (0.9, 1.1), {}), Gap(0.0, 0.01, (-0.01, 0.01), {})
    part = Gap(0.2, 0.01, (0.1, 0.3), {})
    judge = SimpleNamespace(
        gap=lambda _: wide,
        gap_at=lambda *one: closed if one[0] else part,
    )
    search = explainer(judge, lambda one: one.name)
    monkeypatch.setattr(FrameExplainer, "_unexplained", measures)
    monkeypatch.setattr(FrameExplainer, "_added", SimpleNamespace(accounted=lambda _: held))
    named = SimpleNamespace(additions=[SimpleNamespace(named=True)])
    monkeypatch.setattr(search, "close", lambda *_, **__: named)
    nothing: Any = None
    assert search.describe(wide, nothing) == chosen


@pytest.mark.parametrize(("named", "chosen"), [(True, None), (False, "measured")])
def test_what_is_measured_need_not_do_better_than_effects_that_get_no_name(
    monkeypatch: pytest.MonkeyPatch, named: bool, chosen: str | None
) -> None:
    wide, part = Gap(1.0, 0.01, (0.9, 1.1), {}), Gap(0.2, 0.01, (0.1, 0.3), {})
    judge = SimpleNamespace(gap=lambda _: part, gap_at=lambda *_: part)
    effects = [EmpiricalNoise(noise_dn=1.0, modes=(NoiseMode(of="row", share=1.0),))]
    found = SimpleNamespace(effects=effects, mean=None, vectors=None)
    measures = SimpleNamespace(measured=lambda _: found, by_itself=lambda: None)
    search = explainer(judge, lambda _: "measured")
    monkeypatch.setattr(FrameExplainer, "_added", SimpleNamespace(accounted=lambda _: ()))
    monkeypatch.setattr(FrameExplainer, "_unexplained", measures)
    additions = [SimpleNamespace(named=named)]
    monkeypatch.setattr(search, "close", lambda *_, **__: SimpleNamespace(additions=additions))
    nothing: Any = None
    assert search.describe(wide, nothing) == chosen


@pytest.mark.parametrize(
    ("left", "found", "nothing", "replaced"),
    [
        ("part", "closed", False, True),
        ("part", "part", False, False),
        ("wide", "part", False, True),
        ("closed", "closed", False, False),  # what has a name is kept where it does as well
        ("closed", "closed", True, True),
    ],
)
def test_what_leaves_clearly_less_replaces_effects_with_a_name(
    monkeypatch: pytest.MonkeyPatch, left: str, found: str, nothing: bool, replaced: bool
) -> None:
    gaps = {
        "wide": Gap(1.0, 0.01, (0.9, 1.1), {}),
        "part": Gap(0.2, 0.01, (0.1, 0.3), {}),
        "closed": Gap(0.0, 0.01, (-0.01, 0.01), {}),
    }
    judge = SimpleNamespace(gap=lambda _: gaps[left], gap_at=lambda *_: gaps[found])
    search, one = explainer(judge, lambda one: one), SimpleNamespace(mean=None, vectors=None)
    measures = SimpleNamespace(by_itself=lambda: one, refitter=Goodness(passes=nothing))
    monkeypatch.setattr(FrameExplainer, "_unexplained", measures)
    unused: Any = None
    assert search.replaced(unused) == (one if replaced else None)
