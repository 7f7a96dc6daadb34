"""The steps of a search for missing effects: split, null, gap, disagree, explain, add, close, verdict.

They are the same for frames and for ready-made histograms; only the comparison of effects differs. With
frames, effects are simulated and compared by their shift of many statistics (:mod:`.by_simulation`); with
histograms they are parameters of the exact likelihood (:mod:`.by_likelihood`). Either is an
:class:`Explainer`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.build_verdict import Added, Findings, Fitted, build_verdict
from pchem_pipeline.discrepancy.effort import Effort, EffortSpentError
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel, disagrees
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.verdict import Discrepancy, Examined
from pchem_pipeline.discrepancy.where import locate
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence

Explanation = TypeVar("Explanation")


@dataclass(frozen=True)
class Prepared:
    """Data that are split into train, test and final part, and the model that they are compared with."""

    settings: DiscrepancySettings
    samples: str  # what the data are, for the verdict's sentence ("frames", "histograms")
    evidence: Evidence  # of the train part
    examined: Examined
    first: NullModel  # statistics of the model before anything is added, from its replicates
    z: Measured  # statistics of the data
    effort: Effort
    untestable: dict[str, str]  # effects that such data cannot show, and why
    doubt: str = ""  # why the pixels are not identified and what would help; empty where they are
    defects: dict[str, str] = field(default_factory=dict)  # candidates that failed, and why


class Explainer(ABC, Generic[Explanation]):
    """A way to tell effects apart in one kind of data; it keeps the model."""

    prepared: Prepared  # the data and the model before the search
    candidates: Sequence[str] = ()  # tags (with numbers) of the effects that are compared, once they are
    limit: str = ""  # what was not tried when the search had used its budget; empty if it finished

    @property
    @abstractmethod
    def model(self) -> tuple[Effect, ...]:
        """Effects: those that were there before, and those added since."""

    @abstractmethod
    def gap(self, null: NullModel) -> Gap:
        """Measure the gap of the model on the final part."""

    @abstractmethod
    def suspects(self, null: NullModel) -> bool:
        """Return whether candidates are worth asking although no statistic deviates beyond chance."""

    @abstractmethod
    def explain(self, null: NullModel, disagreed: bool) -> Explanation | None:
        """Compare the candidates on train and test part; None where none explains anything."""

    @abstractmethod
    def add(self, explanation: Explanation, null: NullModel) -> NullModel | None:
        """Put effects into the model and draw replicates of it; None where no effect is established."""

    @abstractmethod
    def close(self, before: Gap, null: NullModel, disagreed: bool) -> Added:
        """Measure the gap on the final part with each added effect, and with rivals in its place."""

    @abstractmethod
    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the parameters of the pixels under the model that the verdict leaves."""

    def tolerance(self) -> FloatArray | float:
        """Return the deviations that are not held against the added effects, shape (m,)."""
        return 0.0


def no_progress(_: str) -> None:
    """Report nothing."""


def search(by: Explainer[Explanation], progress: Callable[[str], None] = no_progress) -> Discrepancy:
    """Find where data disagree with the fitted model, name the effects, and add them to the model.

    The explainer has drawn the model; ``progress`` is given what is done next.
    """
    data, present = by.prepared, by.model
    first, z, significance = data.first, data.z, data.settings.significance
    progress("measuring how far model and data disagree")
    before = by.gap(first)
    places = locate(data.evidence, first, z.both, significance)
    null, limit = first, ""
    still = disagreed = disagrees(null, z, significance)
    if still or (not data.doubt and by.suspects(null)):
        try:
            progress("comparing candidates")
            explanation = by.explain(null, still)
            if explanation is not None:
                progress("refitting the pixels with the likeliest effects")
                null = by.add(explanation, null) or null
        except EffortSpentError as spent:
            limit = data.effort.limit_words(spent, by.candidates)
        still = disagrees(null, z, significance, by.tolerance())
    progress("measuring the remaining disagreement")
    added = by.close(before, null, still)
    if not disagreed and before.at_floor and not any(each.named for each in added.additions):
        # data that agree with the model are not made doubtful by what they do not confirm
        null, still, added = first, False, Added((), before)
    many = len({tag.partition(" ")[0] for tag in by.candidates})
    found = Findings(
        data.samples, z, first, null, before, places, still, added, data.doubt, limit or by.limit, many
    )
    model = found.model(present, by.model)
    return build_verdict(found, data, model, by.fitted(model))
