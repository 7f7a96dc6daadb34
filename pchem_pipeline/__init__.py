"""Characterise deep sub-electron read noise image sensors with PCH-EM.

The names below are the public ones; they are imported when first used.

    >>> import numpy as np
    >>> from pchem_pipeline import FitStatus, fit_histograms
    >>> rng = np.random.default_rng(1)
    >>> dn = np.rint(100 + 10 * (rng.poisson(2, 5000) + 0.25 * rng.normal(size=5000))).astype(int)
    >>> result = fit_histograms(np.bincount(dn)[None, :], origin=np.array([0]))
    >>> FitStatus(int(result.fit_status[0]))
    <FitStatus.OK: 0>
    >>> bool(abs(result.conversion_gain[0] - 0.1) < 5 * result.covariance[0, 1, 1] ** 0.5)
    True
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pchem_pipeline.base.errors import PchEmError
    from pchem_pipeline.commands.characterise import characterise, fit_counts
    from pchem_pipeline.commands.notebook import Pixel, Run, open_run
    from pchem_pipeline.discrepancy.verdict import Verdict
    from pchem_pipeline.model.fit.api import fit_histograms
    from pchem_pipeline.model.fit.result import FitResult
    from pchem_pipeline.model.fit.settings import FitSettings
    from pchem_pipeline.model.fit.status import FitStatus
    from pchem_pipeline.report.charts.on_paper import Drawing
    from pchem_pipeline.store.run_store import RunStore
    from pchem_pipeline.use.twin import Twin

__all__ = [
    "Drawing",
    "FitResult",
    "FitSettings",
    "FitStatus",
    "PchEmError",
    "Pixel",
    "Run",
    "RunStore",
    "Twin",
    "Verdict",
    "__version__",
    "characterise",
    "fit_counts",
    "fit_histograms",
    "open_run",
]

__version__ = "0.2.0"

_HOMES = {
    "Drawing": "report.charts.on_paper",
    "FitResult": "model.fit.result",
    "FitSettings": "model.fit.settings",
    "FitStatus": "model.fit.status",
    "PchEmError": "base.errors",
    "Pixel": "commands.notebook",
    "Run": "commands.notebook",
    "RunStore": "store.run_store",
    "Twin": "use.twin",
    "Verdict": "discrepancy.verdict",
    "characterise": "commands.characterise",
    "fit_counts": "commands.characterise",
    "fit_histograms": "model.fit.api",
    "open_run": "commands.notebook",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that the command starts at once."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, so that they are completed before they are used."""
    return sorted(__all__)
