"""Runs of one camera over time: what each found, and which pixels moved since the first."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.model.checks.run_differences import LIMIT, CommonFit
from pchem_pipeline.model.fit.status import FitStatus, words_of
from pchem_pipeline.model.maps.defects import FAULTS, Defect
from pchem_pipeline.model.maps.maps import GOOD
from pchem_pipeline.report.comparison import DefectChange, HistoryRow, Pair, RunFacts, by_change
from pchem_pipeline.run.model_versions import model_of
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.store.files import read_json
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from pchem_pipeline.config.tree import RunConfig


def history_rows(
    runs: Sequence[RunFacts],
    stores: Sequence[RunStore],
    pairs: Sequence[Pair],
    labels: Sequence[str],
    states: Sequence[PixelStates],
) -> list[HistoryRow]:
    """Return a row for each run, in the order given.

    Args:
        runs: the runs.
        stores: of them.
        pairs: the first with each of the others.
        labels: of the runs; none: their dates.
        states: of the pixels of each run.

    Raises:
        ConfigError: there are labels, but not one for each run.
    """
    if labels and len(labels) != len(runs):
        raise ConfigError(
            f"--label: {len(labels)} labels for {len(runs)} runs; give one per run, in the same order"
        )
    rows = []
    for i, (run, store) in enumerate(zip(runs, stores, strict=True)):
        moved, any_moved, compared = _moved(pairs[i - 1], states[0], states[i]) if i else ({}, 0, 0)
        camera = SensorInfo.read(store).camera
        date = _date(store, camera)
        label = labels[i] if labels else date
        days = datetime.fromisoformat(date).timestamp() / 86400.0 if date else float("nan")
        version = model_of(store, "fit")
        rows.append(
            HistoryRow(
                label,
                date,
                camera.temperature,
                _number(label) if labels else days,
                run,
                states[i].defects(),
                pairs[i - 1].defects if i else (),
                states[i].flags(),
                () if version is None else tuple(effect.tag for effect in version.effects),
                moved,
                any_moved,
                compared,
            )
        )
    return rows


def _date(store: RunStore, camera: CameraFacts) -> str:
    """Return when the frames of a run were taken, else written, else read, UTC, ISO 8601; or empty."""
    if camera.taken is not None:
        return datetime.fromtimestamp(camera.taken, UTC).isoformat(timespec="seconds")
    kept: Any = read_json(store.path / ".pchem" / "ingested.json") or {}
    times = [each.get("mtime_ns") for each in (kept.get("quick") or {}).get("files", [])]
    known = [time for time in times if time]
    if known:
        return datetime.fromtimestamp(min(known) / 1e9, UTC).isoformat(timespec="seconds")
    record = store.records.read("ingest")
    return "" if record is None else record.started


def _number(label: str) -> float:
    """Return the number that a label begins with; NaN where it begins with none."""
    match = re.match(r"\s*([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)", label)
    return float(match[1]) if match else float("nan")


@dataclass(frozen=True)
class PixelStates:
    """What the pixels of a run are, as its report has them; maps of shape (y, x).

    Attributes:
        kinds: faults, as bits.
        exposure, noise: H and read noise, each with its error, e-.
        status: words of the fit.
        quality: good, caution or no value.
    """

    kinds: NDArray[np.integer]
    exposure: tuple[FloatArray, FloatArray]
    noise: tuple[FloatArray, FloatArray]
    status: NDArray[np.integer]
    quality: NDArray[np.integer]

    @classmethod
    def of(cls, store: RunStore, config: RunConfig) -> PixelStates:
        """Read those of a run."""
        maps = store.at(group="maps")
        exposure, noise = (
            (maps[name], maps[f"{name}_stderr"]) for name in ("quanta_exposure", "read_noise_e")
        )
        kinds = stored_defects(store, config).kinds & np.uint16(FAULTS)
        return cls(kinds, exposure, noise, store.read("fit/fit_status"), maps["quality"])

    def defects(self) -> dict[str, int]:
        """Return how many pixels have each kind of fault."""
        return {words_of(kind): int(((self.kinds & int(kind)) != 0).sum()) for kind in FAULTS}

    def flags(self) -> dict[str, int]:
        """Return how many pixels bear each word of the status."""
        return {str(bit.name).lower(): int(((self.status & int(bit)) != 0).sum()) for bit in FitStatus if bit}

    def changes_since(self, first: PixelStates, confirm: CommonFit | None = None) -> tuple[DefectChange, ...]:
        """Return the pixels whose faults differ, unless what these are seen in agrees within its error.

        Args:
            first: the pixels of an earlier run.
            confirm: p-values of pixels (y, x) for a common fit of both runs; None: not known.
        """
        if self.kinds.shape != first.kinds.shape:
            return ()
        changed = self.kinds ^ first.kinds
        changed[_near(self.exposure, first.exposure)] &= np.uint16(~(Defect.HOT | Defect.DEAD) & FAULTS)
        changed[_near(self.noise, first.noise)] &= np.uint16(~Defect.NOISY & FAULTS)
        y, x = np.nonzero(changed)
        if confirm is not None and y.size:
            differs = ~(confirm(y, x) > erfc(LIMIT / np.sqrt(2.0)))
            y, x = y[differs], x[differs]
        words = (words_of(Defect(int(kinds))) for each in (first, self) for kinds in each.kinds[y, x])
        found = np.array([*words], np.str_).reshape(2, -1)
        return tuple(map(DefectChange, y.tolist(), x.tolist(), *found.tolist()))


def _near(one: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray]) -> BoolArray:
    """Return which values agree within their errors, as far as these are known."""
    error = np.hypot(np.nan_to_num(one[1]), np.nan_to_num(other[1]))
    return np.asarray(np.abs(one[0] - other[0]) <= LIMIT * error)


def _moved(pair: Pair, one: PixelStates, other: PixelStates) -> tuple[dict[str, int], int, int]:
    """Return the pixels whose parameters moved: of each map, of any, and how many were compared."""
    if pair.same_data or not pair.maps:
        return {}, 0, 0
    good = (one.quality == GOOD) & (other.quality == GOOD)
    any_moved = np.logical_or.reduce([each.changed for each in pair.maps.values()])
    return {name: each.n_changed for name, each in pair.maps.items()}, int(any_moved.sum()), int(good.sum())


def history_csv(rows: Sequence[HistoryRow]) -> str:
    """Return the history as CSV: a line of headings, and a line for each run."""
    maps = list(dict.fromkeys(name for row in rows for name in row.run.summary))
    moved = list(dict.fromkeys(name for row in rows for name in row.moved))
    text = io.StringIO()
    lines = [_csv_line(row, maps, moved) for row in rows]
    writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _csv_line(row: HistoryRow, maps: Sequence[str], moved: Sequence[str]) -> dict[str, object]:
    found: dict[str, object] = {
        "label": _cell(row.label),
        "date": row.date,
        "temperature": "" if row.temperature is None else f"{row.temperature:.6g}",
        "run": _cell(row.run.name),
        "frames": row.run.n_frames or "",
    }
    found |= dict(zip(("pixels_good", "pixels_caution", "pixels_no_value"), row.run.pixels, strict=True))
    found |= {f"{kind}_pixels": n for kind, n in row.defects.items()}
    for kind, changes in by_change(row.defects_changed).items():
        found[f"defects_{kind.replace(' ', '_')}"] = " ".join(f"{each.y}/{each.x}" for each in changes)
    for name in maps:
        values = row.run.summary.get(name, (float("nan"),) * 3)
        for part, value in zip(("median", "median_stderr", "scatter"), values, strict=True):
            found[f"{name}_{part}"] = "" if value != value else f"{value:.9g}"
    found |= {f"{name}_moved": row.moved.get(name, "") for name in moved}
    found |= {
        "moved_pixels": row.any_moved,
        "compared_pixels": row.compared,
        "effects": " ".join(row.effects),
    }
    return found | {f"flag_{name}": n for name, n in row.flags.items()}


def _cell(text: str) -> str:
    """Return a text such that a spreadsheet takes it for no formula; a signed number with its unit stays."""
    formula = text[:1] in tuple("=+-@\t\r") and re.fullmatch(r"[+-]?[\d.,]+( ?[\w°%]+)?", text) is None
    return f"'{text}" if formula else text
