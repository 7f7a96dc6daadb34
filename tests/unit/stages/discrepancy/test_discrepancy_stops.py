"""What ends the stage ``discrepancy`` passes all that guards its search against effects that fail."""

from __future__ import annotations

import contextlib
import signal
from types import SimpleNamespace
from typing import Any

import pytest

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.signals import InterruptedRunError
from pchem_pipeline.stages.discrepancy import discrepancy


@pytest.mark.parametrize("error", [InterruptedRunError(signal.SIGINT), StoreError("no space left")])
def test_a_stop_in_the_middle_of_a_comparison_makes_no_verdict(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """Not even where the search takes whatever a candidate raises for a defect of the candidate."""

    def run_units(*_: Any, **__: Any) -> None:
        raise error

    def search(context: Any, *_: Any) -> None:
        try:
            discrepancy._Mapper(context)([])
        except Exception:
            pytest.fail("the stop was taken for a defect")

    context = SimpleNamespace(sensor=SimpleNamespace(kind="frames"), reporter=Reporter(quiet=True))
    context.run_units = run_units
    context.stop = SimpleNamespace(at_once=contextlib.nullcontext)
    monkeypatch.setattr(discrepancy, "_start", lambda _: ((), None))
    monkeypatch.setattr(discrepancy, "_run_frames", search)
    with pytest.raises(type(error)) as found:
        discrepancy.run(context)
    assert found.value is error
