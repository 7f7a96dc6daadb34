"""The budget of a search for missing effects, in counted work instead of time.

The same search therefore ends at the same point on any machine.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

# CPU seconds on a core of about 2022: of a simulated stack, and of its samples with all that is looked at; of
# a code in an evaluation of the likelihood by a plain fit, and in one with effects, by components of the law
# and one more
_STACK, _SAMPLE, _CODE, _WITH_EFFECTS = 0.2, 6.5e-8, 1.0e-8, 2.0e-8
# of what is learnt of the sensor from a pixel, and the same by components
_LEARN, _LEARN_BY = 4.0e-4, 1.0e-4
MOST_LEARNT_FROM = 1000  # pixels
# of a sample that is asked for guesses of all effects, or for all forms of what no effect explains
_ASKED = 4.0e-7
#: CPU seconds, by count, that a search has at least, and what it has of the cost of the null distribution.
_LEAST, _OF_NULL = 170.0, 6.0
#: Shares of that: kept for measuring what no effect explains, and for the choice among the sets.
_KEPT, _FOR_CHOICE = 0.25, 0.3
#: The same that is left for fits, whatever it cost to find out what candidates would do.
_FOR_FITS = 0.4


class EffortSpentError(Exception):
    """The search has used its budget; the message is the next step."""


@dataclass
class Effort:
    """Work of a search, CPU seconds by count."""

    share: float | None  # factor on the default budget; None: no limit
    spent: float = 0.0  # so far
    most: float = math.inf  # nothing more is begun beyond it; infinite until the null distribution is drawn
    kept: float = 0.0  # for what no effect explains
    for_choice: float = 0.0  # for the choice among the sets that were tried
    for_fits: float = 0.0  # the least that is left for fits of candidates once they are compared
    tried: set[str] = field(default_factory=set)  # tags of all effects with which the pixels were fitted
    replicates: int = 0  # parts of simulated stacks, or sets of histograms, drawn so far

    def begin(self) -> None:
        """Set the limit, now that the null distribution has been paid; no candidate was fitted for that."""
        self.tried.clear()
        share = math.inf if self.share is None else self.share
        limit = share * max(_LEAST, _OF_NULL * self.spent)
        self.kept, self.for_choice = _KEPT * limit, _FOR_CHOICE * limit
        self.most = self.spent + (1.0 - _KEPT) * limit
        # a short search may end before any fit
        self.for_fits = _FOR_FITS * limit if share >= 1.0 else 0.0

    def leave_for_fits(self) -> None:
        """Let something be left for fits: a search that asks all candidates and fits none is in vain."""
        self.most = max(self.most, self.spent + self.for_fits)

    def measure(self) -> None:
        """Let what was kept for it be spent, all of it: what had no limit may have gone beyond."""
        self.most, self.kept = max(self.most, self.spent) + self.kept, 0.0

    def choose(self) -> None:
        """Let what was kept for the choice among the sets be spent, all of it."""
        self.most, self.for_choice = max(self.most, self.spent) + self.for_choice, 0.0

    def simulate(self, samples: int, evaluated: float) -> None:
        """Count a simulated stack whose plain fits evaluated so many codes, see `Evidence.evaluated`."""
        self.spent += _STACK + _SAMPLE * samples + _CODE * evaluated

    def evaluate(self, codes: float, components: int, tags: Iterable[str]) -> None:
        """Count evaluations of the likelihood with effects, at so many codes, by components of the law."""
        self.spent += _WITH_EFFECTS * codes * (1 + components)
        self.tried |= set(tags)

    def learn(self, pixels: int, components: int) -> None:
        """Count what is learnt of the sensor from pixels, whose law has so many components."""
        self.spent += (_LEARN + _LEARN_BY * components) * min(pixels, MOST_LEARNT_FROM)

    def ask(self, samples: int) -> None:
        """Count a look at samples for guesses of all effects, or for what none of them explains."""
        self.spent += _ASKED * samples

    def check(self, doing: str) -> None:
        """Raise an error if there is nothing left for what comes next."""
        if self.spent >= self.most:
            raise EffortSpentError(doing)

    @property
    def used(self) -> str:
        """The used share of the budget, to a tenth, in words."""
        return f"{10 * min(math.floor(10.0 * self.spent / self.most), 10)} % of the budget used"

    def limit_words(self, spent: EffortSpentError, candidates: Iterable[str]) -> str:
        """State where the search ended, and which candidates (tags) were not tried."""
        untried = ", ".join(tag for tag in dict.fromkeys(candidates) if tag not in self.tried)
        return f"the search used its budget before {spent}" + (f"; not tried: {untried}" if untried else "")
