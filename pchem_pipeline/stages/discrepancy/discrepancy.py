"""Stage ``discrepancy``: find what the model is missing.

It looks at the frames alone, never at the truth of a simulated run. Its units are simulated stacks; each
leaves its statistics in its marker, so that a stopped search goes on where it was. It is not part of ``run``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pchem_pipeline.base.errors import PchEmError, StoreError, error_words, quoted
from pchem_pipeline.discrepancy.by_likelihood.explainer import find_in_histograms
from pchem_pipeline.discrepancy.by_likelihood.observed import SampleHistograms
from pchem_pipeline.discrepancy.by_simulation.elsewhere import deviation
from pchem_pipeline.discrepancy.by_simulation.explainer import find_discrepancies
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import Replicate
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.observe.places import SensorWindow
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.splits import block_length
from pchem_pipeline.discrepancy.verdict import VERDICT_FILE, Discrepancy, Elsewhere
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.operators.curve import Clipping
from pchem_pipeline.frames.stream import FrameSource
from pchem_pipeline.model.histogram.odd_frames import frame_words
from pchem_pipeline.run.input import open_source
from pchem_pipeline.run.model_versions import model_of, write_added_exposure
from pchem_pipeline.run.stage import WHOLE, Named, StageContext
from pchem_pipeline.stages.discrepancy.arrays import evidence_arrays
from pchem_pipeline.stages.discrepancy.survey import mean_codes, survey
from pchem_pipeline.stages.discrepancy.window import (
    SURVEY,
    Survey,
    Window,
    choose_window,
    fewer_samples,
    other_window,
    read_window,
    within_memory,
)
from pchem_pipeline.stages.samples import open_samples
from pchem_pipeline.store.run_store import RunStore

_STAGE = "discrepancy"


def run(context: StageContext) -> None:
    """Find discrepancies; write ``discrepancy.json`` and the arrays of its pictures.

    Raises:
        InputError: the frames are too few, or there are none.
        StoreError: the store refuses.
    """
    # the model that this search starts from, and its region, see `search_start`
    record, model = context.store.records.read(_STAGE), model_of(context.store, _STAGE)
    before = (context.model if model is None else model).effects
    roi = None if record is None else tuple(record.content["input"]["roi"]) or None
    with context.reporter.phases(_STAGE) as progress, context.stop.at_once():
        try:
            if context.sensor.kind == "frames":
                _run_frames(context, before, roi, progress)
            else:
                _run_histograms(context, before, progress)
        except _Ended as ended:
            raise ended.error from ended.error.__cause__


def _run_frames(
    context: StageContext,
    before: Sequence[Effect],
    roi: tuple[int, ...] | None,
    progress: Callable[[str], None],
) -> None:
    source = open_source(context)
    block_length(source.shape[0], context.config.discrepancy.block_frames)
    limits = _limits(context, before)
    model = (*before, *limits)
    search = _Search(context, source, model, roi, Survey(), progress)
    settings, whole = search.survey()
    window, found = search.found(settings, "")
    elsewhere = search.elsewhere(settings, "elsewhere-", window, found, whole)
    if elsewhere is not None and elsewhere.deviates and whole != settings:
        context.note(
            f"the model found does not hold in {elsewhere.words()}: {elsewhere.deviates}; comparing "
            "discrepancy.max_samples samples now"
        )
        window, found = search.found(whole, "whole-")
        elsewhere = search.elsewhere(whole, "whole-elsewhere-", window, found)
    rows, columns = window.rows, window.columns
    verdict = found.verdict.on_sensor(
        source.shape[1:], rows, columns, lambda y, x: (y + rows[0], x + columns[0])
    )
    verdict = search.seen.told(verdict, window.share(source.shape)).costing(search.work)
    found = replace(found, verdict=verdict if elsewhere is None else verdict.checked(elsewhere))
    _write(context, found, limits)
    write_added_exposure(context.store, _STAGE, found.added, found.model, rows, columns)


@dataclass
class _Search:
    """Compares windows of the frames with simulations, and counts the work, CPU seconds."""

    context: StageContext
    source: FrameSource
    model: Sequence[Effect]
    roi: tuple[int, ...] | None
    seen: Survey
    progress: Callable[[str], None]
    work: float = 0.0

    def survey(self) -> tuple[DiscrepancySettings, DiscrepancySettings]:
        """Look at the whole sensor, once; return the settings of the search, and the most that it may take.

        A marker keeps what was seen: a search that was stopped goes on in the same window.
        """
        context, store, settings = self.context, self.context.store, self.context.config.discrepancy

        def scanned(chosen: DiscrepancySettings) -> Survey:  # except where all of it is compared closely
            compared = min(chosen.max_samples, chosen.max_pixels * self.source.shape[0])
            return survey(context, self.source, compared)

        known = store.records.summaries(_STAGE, context.fingerprint).get(WHOLE.key)
        if known is None:
            limit = context.config.compute.max_memory
            if limit is not None:
                codes = mean_codes(store) if store.has("histogram/counts") else 128.0
                less = within_memory(settings, self.source.shape, self.roi, codes, limit << 20)
                if less != settings:
                    context.note(
                        f"compute.max_memory (--max-memory) limits the comparison to {less.max_pixels} "
                        f"pixels ({settings.max_pixels} without this limit)"
                    )
                settings = less
            self.progress("scanning all pixels and frames")
            seen = scanned(settings)
            if seen.left_out:
                context.note(
                    f"left out (empty, repeated, outlying or moved): {frame_words(np.array(seen.left_out))}"
                )
            few = fewer_samples(self.source, settings, self.roi, seen, self.model)
            if few != settings:
                context.note(
                    f"clear disagreement in {few.max_samples:,} samples, so the search takes no more; for "
                    "smaller errors raise discrepancy.clear_samples"
                )
                seen = scanned(few)
            known = SURVEY.dump_python(seen, mode="json")
            known |= {"window": _amounts(few), "whole": _amounts(settings)}
            context.run_units([WHOLE], lambda *_: known, total=1)
        self.seen = SURVEY.validate_python(known)
        few, most = (
            settings.model_copy(update=known.get(name, known["window"])) for name in ("window", "whole")
        )
        return few, most

    def found(self, settings: DiscrepancySettings, prefix: str) -> tuple[Window, Discrepancy]:
        """Search for what the model is missing in the window of the settings; ``prefix`` begins its units."""
        window = choose_window(self.source.shape, settings, self.roi, self.seen)
        found = find_discrepancies(
            read_window(self.source, window),
            window.times,
            settings,
            **self._taken(window),
            model=tuple(self.model),
            mapper=_Mapper(self.context, prefix),
            progress=self.progress,
        )
        self.work += found.verdict.work
        return window, found

    def elsewhere(
        self,
        settings: DiscrepancySettings,
        prefix: str,
        window: Window,
        found: Discrepancy,
        whole: DiscrepancySettings | None = None,
    ) -> Elsewhere | None:
        """Test effects that explain everything in more samples, or else in another window.

        A weak effect beside a strong one shows only there. None: there are no such effects, or no others than
        the samples in which they were found. ``whole``: all that may be compared, if these were fewer.
        """
        shape, roi = self.source.shape, self.roi
        if whole is None or whole == settings:
            other = other_window(window, shape, roi)
        else:
            other = choose_window(shape, whole, roi, self.seen)
        if other is None or found.verdict.verdict != "named":
            return None
        self.progress("testing the model in other samples")
        frames = FrameStack.of(
            read_window(self.source, other), other.times, settings.block_frames, **self._taken(other)
        )
        there, effort = Elsewhere(rows=other.rows, columns=other.columns), Effort(None)
        # a verdict that is known is not lost for pixels that cannot be used, or an effect that fails there
        try:
            observed = ObservedFrames.of(frames)
            by = Simulations(observed, _Mapper(self.context, prefix), settings.seed, effort)
            return there.model_copy(update={"deviates": deviation(by, found.model)})
        except Exception as error:
            self.context.note(f"not checked in {there.words()}: {error_words(error)}")
            return None
        finally:
            self.work += effort.spent

    def _taken(self, window: Window) -> dict[str, Any]:
        n_frames, *shape = self.source.shape
        known = tuple(place.region for place in self.seen.places.values())
        return {
            "n_run": n_frames - len(window.copied),
            "bit_depth": self.context.sensor.bit_depth,
            "integration_time": self.context.sensor.integration_time or 1.0,
            "window": SensorWindow(window.rows, window.columns, (shape[0], shape[1]), known),
        }


def _amounts(settings: DiscrepancySettings) -> dict[str, int]:
    names = ("max_samples", "max_pixels", "replicates", "extended_replicates")
    return {name: getattr(settings, name) for name in names}


def _limits(context: StageContext, model: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return as an effect the codes at which samples pile up: the fit has them without a model."""
    sensor, store = context.sensor, context.store
    (low, high), ends = sensor.seen_limits, sensor.adc_limits
    if ends is not None and store.has("histogram/minimum"):
        share = 0.01  # of the pixels, from which a limit that samples reach is in the model
        low = ends[0] if (store.read("histogram/minimum") <= ends[0]).mean() > share else low
        high = ends[1] if (store.read("histogram/maximum") >= ends[1]).mean() > share else high
    if (low is None and high is None) or any(effect.tag == "clipping" for effect in model):
        return ()
    return (Clipping(low=low, high=high),)


def _run_histograms(context: StageContext, before: Sequence[Effect], progress: Callable[[str], None]) -> None:
    """Do the same with ready-made histograms, or with those of several samples together, in one unit."""
    samples = _samples(context) if context.sensor.samples else [_histograms(context.store)]
    limits, settings = _limits(context, before), context.config.discrepancy
    found = find_in_histograms(
        samples, settings, width=context.sensor.nx, model=(*before, *limits), progress=progress
    )
    _write(context, found, limits)
    context.run_units([WHOLE])


def _samples(context: StageContext) -> list[SampleHistograms]:
    """Return the histograms of the samples, with their integration times where H is drawn against these."""
    of_time = context.config.input.against == "integration_time"
    opened = open_samples(context.config, context.base_dir)
    return [
        replace(
            _histograms(each.store),
            bias=sample.bias,
            integration_time=sample.integration_time if of_time else None,
        )
        for each, sample in zip(opened, context.sensor.samples, strict=True)
    ]


def _histograms(store: RunStore) -> SampleHistograms:
    if not store.has("histogram/counts"):
        place = quoted(store.path)
        raise StoreError(f"{_STAGE}: no histograms in the store; run: pchem histogram {place}")
    counts = store.read("histogram/counts")
    return SampleHistograms(counts.reshape(-1, counts.shape[2]), store.read("histogram/origin").ravel())


class _Ended(BaseException):
    """Takes what ends the stage (a signal, a full disk) past what guards a search against strange effects."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


@dataclass
class _Mapper:
    """Runs replicates as units of the stage; those done before an interruption are not done again."""

    context: StageContext
    prefix: str = ""  # of the keys of its replicates
    total: int = 1  # with what was done before

    def __call__(self, replicates: Sequence[Replicate]) -> list[Mapping[str, float] | Exception]:
        """Return the statistics of each replicate, or what it raised."""
        replicates = [replace(each, key=self.prefix + each.key) for each in replicates]
        units = {r.key: Named(r.key, r) for r in replicates}
        self.total += len(units)
        try:
            summaries = self.context.run_units(
                list(units.values()),
                _simulate,
                unit_name="stack",
                total=self.total,
                unit_bytes=max((r.memory for r in replicates), default=0),
            )
        except Exception as error:
            raise _Ended(error) from error
        found: list[Mapping[str, float] | Exception] = []
        for replicate in replicates:
            reason = self.context.failed.pop(replicate.key, None)
            if reason is None:
                found.append(summaries[replicate.key])
            else:
                self.total -= 1
                found.append(PchEmError(reason))
        return found


def _simulate(unit: Named[Replicate], store: RunStore) -> dict[str, float]:
    return unit.content()


def _write(context: StageContext, found: Discrepancy, limits: Sequence[Effect]) -> None:
    """Write the arrays, and the verdict with its model but for the limits of the ADC."""
    context.begin()
    names, z_before, z_after = found.statistics
    arrays = evidence_arrays(
        found.evidence,
        dict(zip(names, z_before.tolist(), strict=True)),
        dict(zip(names, z_after.tolist(), strict=True)) if found.verdict.steps else None,
        [e for e in found.model if e.tag in found.verdict.effects],
        context.sensor.integration_time or 1.0,
        context.sensor.bit_depth or 16,
        found.code_extended,
    )
    for name, array in arrays.items():
        context.store.write_array(f"{_STAGE}/{name}", array)
    kept = tuple(each.model_dump(mode="json") for each in found.model if each not in limits)
    verdict = found.verdict.model_copy(update={"model_effects": kept})
    if (line_time := context.config.input.line_time) is not None:
        verdict = verdict.in_hertz(line_time)
    context.store.write_file(VERDICT_FILE, verdict.to_json().encode())
    for tag, reason in found.verdict.defects.items():
        context.note(f"effect {tag} failed and was not compared: {reason}")
