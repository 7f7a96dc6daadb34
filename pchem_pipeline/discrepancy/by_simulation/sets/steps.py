"""The way to the strengths of a set that explain the data best: which step comes next.

Slopes are those of the last step, and what a set leaves is a matter of chance, too: a step may explain less
where the way on explains more, or do a fraction of what it promised, time after time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted

FloatArray = NDArray[np.float64]
State = TypeVar("State")

#: Most that the logarithm of the factor of a strength changes in one step.
LARGEST_STEP = float(np.log(4.0))
_FURTHER = 2  # steps beyond one that explains less, where the data go on asking for the same
# of a step, what the data ask for after it: too much for a good slope, and the most that is believed
_SLOW, _SLOWEST = 0.5, 0.75
_SHORTEST = 0.25  # of the step that the data ask for


@dataclass
class DampedSteps(Generic[State]):
    """The best of several states, and the length of the next step, which a step in vain halves.

    Attributes:
        best: the state of the highest score so far.
        score: its log score, nats.
        length: of the next step, in what the data ask for.
    """

    best: State
    score: float
    length: float = 1.0

    def judge(self, now: State | None, score: float = -np.inf) -> bool:
        """Keep the better one, and tell whether it is the new one; None: the step led nowhere."""
        if now is None or not score > self.score:
            self.length *= 0.5
            return False
        self.best, self.score, self.length = now, score, 1.0
        return True


def broyden(slopes: FloatArray, step: FloatArray, unforeseen: FloatArray) -> FloatArray:
    """Return slopes that account for what a step has done, too (Broyden 1965).

    Args:
        slopes: of the statistics with each coordinate, shape (e, m).
        step: of the coordinates, shape (e,).
        unforeseen: change of the statistics beyond that by these slopes, shape (m,).
    """
    return np.asarray(slopes + np.outer(step, unforeseen / float(step @ step)))


@dataclass
class Steps:
    """A way, as far as it was gone.

    Attributes:
        best: the set at its best strengths so far.
        now: at the last ones.
        step: that led there, logarithms of factors, shape (e,).
        gained: by the last step to something better, nats.
        length: of the next step, in what the data ask for.
        further: steps that were gone on after one that explains less.
    """

    best: Refitted
    now: Refitted
    step: FloatArray
    gained: float = np.inf
    length: float = 1.0
    further: int = 0

    @classmethod
    def begin(cls, one: Refitted) -> Steps:
        """Begin at the guessed strengths."""
        return cls(one, one, one.change)

    @property
    def kept_its_promise(self) -> bool:
        """Whether the last step did about what it promised; else the next one's promise says little."""
        return self.length <= 1.0

    def ahead(self) -> tuple[Refitted, FloatArray]:
        """Return from where the next step is to be, and the step."""
        if self.further:
            change = self.now.change
            step = change * (np.linalg.norm(self.step) / max(float(np.linalg.norm(change)), 1e-12))
            return self.now, np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        return self.best, np.clip(self.best.change * self.length, -LARGEST_STEP, LARGEST_STEP)

    def taken(self, step: FloatArray, now: Refitted | None) -> bool:
        """Take note of where a step led (None: nowhere), and tell whether there is another one to try."""
        self.step = step
        if now is not None and now.score > self.best.score:
            self.gained, self.best, self.now = now.score - self.best.score, now, now
            self.length, self.further = _lengthened(now.change, step), 0
        elif now is not None and self._goes_on(now):
            self.now, self.further = now, self.further + 1
        elif self.length > _SHORTEST:
            self.length, self.further = min(self.length, 2.0) / 2.0, 0
        else:
            return False
        return True

    def _goes_on(self, now: Refitted) -> bool:
        """Tell whether the data ask for more of the same on both sides of a dip."""
        return self.further < _FURTHER and self.length >= 1.0 and float(now.change @ self.step) > 0.0


def _lengthened(change: FloatArray, step: FloatArray) -> float:
    """Return by how much the next step is to be longer than the change that is asked for after a step.

    Where each asks for nearly as much as the last one, slopes are too steep: all of them together are a
    geometric series.
    """
    ratio = float(change @ step) / max(float(step @ step), 1e-12)
    return 1.0 if ratio < _SLOW else 1.0 / (1.0 - min(ratio, _SLOWEST))
