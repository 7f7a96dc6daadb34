"""What the report is made of: plain arrays and dictionaries, no store.

The stage ``report`` fills a :class:`ReportData`; figures and pages are made from it. A part that a run
does not have is empty here, and ``missing`` says why in words for the reader.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, BoolArray, FloatArray
from pchem_pipeline.base.errors import quoted
from pchem_pipeline.base.variables import CHARGE_RATES
from pchem_pipeline.base.wording import measured, symbol
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.quick.checks import QuickLook
from pchem_pipeline.discrepancy.verdict import Verdict
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.model.fit.status import FAILED, MEANINGS, FitStatus, flagged, flagged_share
from pchem_pipeline.model.maps.defects import Defects
from pchem_pipeline.model.maps.maps import MapSummary, summarise
from pchem_pipeline.model.maps.ordered import Ordered, median_of
from pchem_pipeline.report.settings import Criteria
from pchem_pipeline.report.style.ranges import finite

if TYPE_CHECKING:
    from pchem_pipeline.model.checks.map_parts import Parts
    from pchem_pipeline.report.figures.figure import Figure
    from pchem_pipeline.report.inspector import InspectorData


#: A line of fewer channels than this gets a point for each, no histogram.
FEW_CHANNELS = 32

#: The maps of Appendix C, in the order of the paper.
MAP_NAMES = (*CHARGE_RATES, "conversion_gain", "bias", "read_noise_e")

#: Maps of the line through several exposures, beside the charge rate.
LINE_MAPS = ("charge_per_level", "spurious_charge", "dark_signal")

#: Order of the axis ``channel`` of the arrays of a verdict.
CHANNELS = ("charge", "readout")


def reasons_in(status: NDArray[np.integer[Any]]) -> list[tuple[FitStatus, str, int]]:
    """Return each reason for caution or failure, gravest first: bit, sentence, pixels that have it."""
    counts = [(bit, text, int(np.count_nonzero(status & int(bit)))) for bit, text in MEANINGS.items()]
    return [row for row in counts if row[2]]


@dataclass(frozen=True)
class PixelFit:
    """Histogram and fit of one shown pixel."""

    label: str  # why the pixel is shown, such as ``low read noise``
    y: int  # row on the sensor; 0 for ready-made histograms
    x: int  # column, or channel
    origin: int  # DN of ``counts[0]``
    counts: NDArray[np.integer[Any]]  # number of frames at each DN, (n_bins,)
    parameters: Mapping[str, float]  # of the PCD, and ``read_noise_e``, in stored units; NaN: no fit
    stderr: Mapping[str, float] = field(default_factory=dict)  # errors under the same names; may lack some
    status: str = ""  # words of ``fit_status``; empty if all is well
    goodness_p: float = float("nan")  # probability of a larger chi-square if the model holds; NaN if unknown
    channel: bool = False  # whether it is a channel of ready-made histograms
    mass: FloatArray | None = None  # of each DN under a model with effects; None where the PCD was fitted

    @property
    def place(self) -> str:
        """Where the pixel is, in words."""
        return f"channel {self.x}" if self.channel else f"pixel y = {self.y}, x = {self.x}"

    def text(self, name: str) -> str:
        """Return a parameter with its standard error and unit."""
        value, error = self.parameters.get(name, np.nan), self.stderr.get(name, np.nan)
        return measured(value, error, symbol(name)[2])


@dataclass(frozen=True)
class DiscrepancyData:
    """A verdict on what the model is missing, and arrays of group ``discrepancy``, of which any may lack."""

    found: Verdict
    arrays: Arrays = field(default_factory=dict)

    @cached_property
    def statistics(self) -> dict[str, tuple[str, str]]:
        """Name of each statistic, in the order of ``z_before``, to its channel and sentence."""
        signs = dict(zip(STATISTICS, self.arrays.get("z_before", ()), strict=False))
        return {name: (s.channel, s.says(signs.get(name, 1.0))) for name, s in STATISTICS.items()}

    @cached_property
    def titles(self) -> dict[str, str]:
        """Tag of an effect to its name in the literature."""
        return {tag: effect.title for tag, effect in effect_classes().items() if effect.title}

    def title(self, tag: str) -> str:
        """Return the name of an effect in the literature, or its tag."""
        return self.titles.get(tag) or tag.replace("_", " ")


@dataclass(frozen=True)
class Sample:
    """One exposure of the sensor."""

    name: str
    kind: str  # exposed, or bias for frames without electrons
    x: float | None  # integration time or light level; None where it is not on the line
    n_frames: int


@dataclass(frozen=True)
class Samples:
    """Several exposures of the same pixels that were fitted together.

    Arrays are ``quanta_exposure``, ``mean``, ``variance``, ``linearity_residual``, (sample, y, x), and
    ``linearity_p`` (y, x); any may lack.
    """

    samples: tuple[Sample, ...]
    against: str  # what exposures are drawn against: integration_time, light_level or none
    arrays: Arrays
    shown: int = 0  # place of the one whose H the maps and the first screen show

    @property
    def on_line(self) -> list[int]:
        """Samples that the line goes through."""
        return [i for i, sample in enumerate(self.samples) if sample.x is not None]


@dataclass(frozen=True)
class ReportData:
    """All that a report shows.

    Maps are ``name`` and ``name_stderr`` of ``variables.py`` (y, x), NaN where a fit failed; beside them are
    ``fit_status``, ``likelihood_gap``, ``goodness_p``, ... of the fit. Moments (Appendix A) have ``name``,
    ``quantity``, ``unit``, ``predicted``, ``observed``, ``stderr`` (None where data do not show it). Misfits
    are ``tested``, ``misfits``, ``false_discovery_rate``, ``worst`` (rows of ``y``, ``x``, ``chi2``, ``dof``,
    ``p``, ``q``), ``pixels_with_outliers``. A stage has ``stage``, ``state``, ``seconds``, ``cpu_seconds``,
    ``peak_memory_bytes``, ``units``, ``notes``.
    """

    title: str
    shape: tuple[int, int]  # (ny, nx) of the sensor or region; (1, n_channels) for ready-made histograms
    kind: str = "unknown"  # what made the charge: dark, light or unknown
    n_frames: int | None = None  # frames per pixel, or None if pixels differ or it is unknown
    integration_time: float | None = None  # s
    camera: str = ""  # name, serial number and temperature of the sensor as the files say
    maps: Mapping[str, FloatArray] = field(default_factory=dict)
    fit: Arrays = field(default_factory=dict)
    criteria: Criteria = field(default_factory=Criteria)
    pixels: Sequence[PixelFit] = ()  # the shown pixels
    ensemble: Arrays = field(default_factory=dict)  # arrays of group ``ensemble``
    ensemble_facts: Mapping[str, Any] = field(default_factory=dict)  # ``rmse``, ``n_frames``, ...
    component_cases: Sequence[str] = ()  # the parameters held constant by row of ``component_variance``
    moments: Sequence[Mapping[str, Any]] = ()
    truth: Mapping[str, FloatArray] = field(default_factory=dict)  # of simulated data
    overscan: Mapping[str, FloatArray] = field(default_factory=dict)  # of pixels without electrons
    overscan_facts: Mapping[str, float] = field(default_factory=dict)  # variances of frames and rows, DN^2
    channel_names: Sequence[str] = ()  # of ready-made histograms
    outlier_sigmas: float = 6.0  # robust standard deviations beyond which a pixel is an outlier
    allowed_failed: float = 0.1  # fraction of pixels without a value that is accepted
    config_yaml: str = ""
    run: Mapping[str, Any] = field(default_factory=dict)  # name, started, host, versions, ...
    inputs: Sequence[Mapping[str, Any]] = ()  # of each input file name, size, hash, ...
    stages: Sequence[Mapping[str, Any]] = ()
    misfits: Mapping[str, Any] = field(default_factory=dict)
    intervals: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    interval_level: float = 0.6827  # probability that profile intervals cover the truth
    missing: Mapping[str, str] = field(default_factory=dict)  # part to the reason of its absence
    discrepancy: DiscrepancyData | None = None  # what the model is missing, or None where nobody looked
    defects: Defects | None = None  # pixels that are not ordinary; None without a fit
    quick_look: QuickLook | None = None  # None without a fit
    stability: Sequence[Figure] = ()  # figures made of sums as large as several maps
    inspector: Callable[[], InspectorData] | None = None  # maps and pixels to look at, asked for last
    methods: Mapping[str, Any] | None = None  # content of ``methods.json``, if any
    plan: Mapping[str, Any] | None = None  # frames that precisions need, if a pixel has a value
    samples: Samples | None = None  # the exposures of a run whose input is several samples
    regions: Mapping[str, Region] = field(default_factory=dict)
    _summaries: dict[tuple[str, bool], MapSummary] = field(default_factory=dict, init=False, repr=False)
    _errors: dict[tuple[str, bool], float | None] = field(default_factory=dict, init=False, repr=False)
    _ordered: dict[str, Ordered] = field(default_factory=dict, init=False, repr=False)

    @property
    def noun(self) -> str:
        """What an element of a map is called: ``pixel``, or ``channel`` for ready-made histograms."""
        return "channel" if self.shape[0] == 1 else "pixel"

    @property
    def few_channels(self) -> bool:
        """Return whether this is a line of so few channels that a histogram over them says nothing."""
        return self.shape[0] == 1 and self.shape[1] < FEW_CHANNELS

    @cached_property
    def status(self) -> NDArray[np.integer[Any]]:
        """Status word of each pixel; without a fit none is fitted; shape ``shape``."""
        return self.fit.get("fit_status", np.full(self.shape, int(FitStatus.NOT_FITTED)))

    @cached_property
    def failed(self) -> BoolArray:
        """Pixels that have a reason for having no value; shape ``shape``."""
        return np.asarray(self.status & int(FAILED) != 0)

    @cached_property
    def unfitted(self) -> BoolArray:
        """Pixels that no fit has reached yet: neither a value nor a reason; shape ``shape``."""
        gain = self.maps.get("conversion_gain")
        return np.asarray(~self.failed & (np.False_ if gain is None else ~np.isfinite(gain)))

    @cached_property
    def flagged(self) -> BoolArray:
        """Pixels with a value that the data leave open by whole electrons, or altogether; shape ``shape``."""
        return self.flagged_in("quanta_exposure")

    def flagged_in(self, name: str) -> BoolArray:
        """Return which pixels the data leave open in one map: a gain is known where the bias is not."""
        return flagged(self.status, name)

    def flagged_share(self, name: str = "quanta_exposure") -> float:
        """Return the share of flagged pixels among those with a value, in one map; by default all flags."""
        return flagged_share(self.status, name)

    @property
    def mostly_flagged(self) -> bool:
        """Return whether the gain of most pixels is open: medians of the rest describe no sensor."""
        return self.flagged_share("conversion_gain") > 0.5

    @property
    def mostly_coarse(self) -> bool:
        """Return whether rounding, which the fit did not count, biases the estimates of most pixels."""
        return bool(np.mean(self.status & int(FitStatus.COARSE_STEPS) != 0) > 0.5)

    @property
    def typed_run(self) -> str:
        """The run as it is typed in a command."""
        return quoted(Path(str(self.run.get("store", "RUN"))))

    @property
    def often_flagged(self) -> bool:
        """Return whether more pixels are flagged than the criteria allow: the others are a selection."""
        limit = self.criteria.flagged_pixels
        return self.flagged_share() > (0.1 if limit is None else limit)

    @property
    def code_step(self) -> int:
        """Distance in DN at which codes occur in the whole sensor: 1, or 4 if left-justified by 2 bits."""
        dn, counts = (self.ensemble.get(name) for name in ("dn", "counts"))
        seen = np.empty(0) if dn is None or counts is None else dn[counts > 0]
        # the distance of fewer codes is chance
        return int(np.gcd.reduce(np.diff(seen).astype(np.int64))) if seen.size >= 8 else 1

    def has_values(self, name: str) -> bool:
        """Return whether a map exists and at least one pixel has a value in it."""
        return name in self.maps and self.summary(name, with_flagged=True).n_valid > 0

    def has_median(self, name: str) -> bool:
        """Return whether a map exists whose median is not of a selection: most pixels are known in it."""
        return self.has_values(name) and self.flagged_share(name) <= 0.5

    @cached_property
    def parts(self) -> dict[str, list[Parts]]:
        """Parts of the sensor that differ in a map, by its name; flagged pixels are left out."""
        from pchem_pipeline.model.checks.map_parts import map_parts

        names = () if self.few_channels else ("conversion_gain", "read_noise_e", "quanta_exposure", "bias")
        known = (name for name in names if self.has_values(name))
        return {name: map_parts(np.where(self.flagged_in(name), np.nan, self.maps[name])) for name in known}

    def in_region(self, region: str) -> dict[str, MapSummary]:
        """Describe each map with values in a part of the sensor; flagged pixels are left out."""
        inside = self.regions[region].mask(self.shape)
        known = (name for name in self.maps if not name.endswith("_stderr") and self.has_values(name))
        return {
            name: self._summarised(Ordered.of(self.maps[name][inside], self.flagged_in(name)[inside]))
            for name in known
        }

    def ordered(self, name: str) -> Ordered:
        """Return the values of a map in their order; the last one is kept, which many ask for in turn."""
        if name not in self._ordered:
            self._ordered.clear()
            self._ordered[name] = Ordered.of(self.maps[name])
        return self._ordered[name]

    def summary(self, name: str, *, with_flagged: bool = False) -> MapSummary:
        """Describe a map, once, by order statistics of all pixels with a value or of unflagged ones."""
        key = name, with_flagged or not bool(self.flagged.any())
        if key not in self._summaries:
            known = self.ordered(name) if key[1] else Ordered.of(self.maps[name], self.flagged_in(name))
            self._summaries[key] = self._summarised(known)
        return self._summaries[key]

    @property
    def overscan_medians(self) -> dict[str, Any]:
        """Row and frame noise of the overscan (DN), and medians with errors there and of the other pixels."""
        found: dict[str, Any] = {
            f"{name}_noise_dn": self.overscan_facts[f"{name}_variance"] ** 0.5
            for name in ("row", "frame")
            if self.overscan
        }
        for name, values in self.overscan.items():
            both = {"overscan": summarise(values)}
            both |= {"active": self.summary(name)} if name in self.maps else {}
            found[name] = {
                where: {"median": each.median, "median_stderr": each.median_stderr, "n_pixels": each.n_valid}
                for where, each in both.items()
            }
        return found

    def _summarised(self, known: Ordered) -> MapSummary:
        return summarise(known, outlier_sigmas=self.outlier_sigmas)

    def estimate(self, name: str, y: int, x: int) -> tuple[float, float]:
        """Return the value of a pixel in a map with its standard error; NaN if unknown."""
        errors = self.maps.get(f"{name}_stderr")
        return float(self.maps[name][y, x]), np.nan if errors is None else float(errors[y, x])

    def pixel_error(self, name: str, *, with_flagged: bool = False) -> float | None:
        """Return the median standard error of a pixel, of all or of those without a flag; None if unknown."""
        errors = self.maps.get(f"{name}_stderr")
        if errors is None:
            return None
        key = name, with_flagged or not bool(self.flagged.any())
        if key not in self._errors:
            median = median_of(errors, None if key[1] else self.flagged_in(name))
            self._errors[key] = None if np.isnan(median) else median
        return self._errors[key]


class TruthErrors(NamedTuple):
    """Estimates of a map against the truth: medians, root mean square error, (estimate - truth) / error."""

    true_median: float
    median: float
    rmse: float
    pulls: FloatArray


def truth_errors(data: ReportData) -> dict[str, TruthErrors]:
    """Return by map how the estimates of simulated pixels differ from the truth, flagged pixels left out."""
    found = {}
    for name in (name for name in data.truth if name in data.maps):
        known = np.isfinite(data.maps[name]) & ~data.flagged_in(name)
        if not known.any():
            continue
        truth, estimate = (np.asarray(maps[name][known], np.float64) for maps in (data.truth, data.maps))
        errors = data.maps.get(f"{name}_stderr", np.full(data.shape, np.nan))[known]
        rmse = float(np.sqrt(np.mean((estimate - truth) ** 2)))
        pulls = finite((estimate - truth) / errors)
        found[name] = TruthErrors(float(np.median(truth)), float(np.median(estimate)), rmse, pulls)
    return found
