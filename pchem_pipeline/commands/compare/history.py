"""Runs of one camera over time: a line for each, with what it found and which pixels changed."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.base.variables import MEASURED_MAPS, VARIABLES
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.model.checks.run_differences import LIMIT, CommonFit
from pchem_pipeline.model.fit.status import FitStatus, words_of
from pchem_pipeline.model.maps.defects import FAULTS, OPEN, Defect
from pchem_pipeline.report.comparison import DefectChange, HistoryRow, Pair, RunFacts, by_change
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.stages.fit.fitted_model import fitted_effects
from pchem_pipeline.store.files import read_json, write_atomic
from pchem_pipeline.store.lock import locked
from pchem_pipeline.store.remote_path import RemotePath
from pchem_pipeline.store.run_store import RunStore

HISTORY = "history.csv"

_NAMES = [name.removeprefix("maps/") for name in VARIABLES if name.startswith("maps/")]
#: Maps whose medians are kept: those with a standard error.
_MEDIANS = tuple(name for name in _NAMES if f"{name}_stderr" in _NAMES)


def identity_of(store: RunStore, digest: str) -> str:
    """Return a digest of the frames of a run, and of how they were characterised."""
    record = store.records.read("maps")
    return hashlib.sha256(f"{digest} {record and record.fingerprint}".encode()).hexdigest()[:12]


def history_row(
    run: RunFacts, store: RunStore, states: PixelStates, label: str, folder: Path, pair: Pair | None
) -> HistoryRow:
    """Return the line of a run in the history of a folder, below a label, or its date where that is empty.

    ``pair`` are the differences from the reference; None: it is the reference.
    """
    camera = SensorInfo.read(store).camera
    date = _date(store, camera)
    path = str(store.path)
    if not isinstance(store.path, RemotePath):
        path = os.path.relpath(store.path.resolve(), folder.resolve())
    row: dict[str, object] = {
        "label": _cell(label or date),
        "date": date,
        "temperature": "" if camera.temperature is None else f"{camera.temperature:.6g}",
        "run": _cell(path),
        "frames": run.n_frames or "",
    }
    row |= dict(zip(("pixels_good", "pixels_caution", "pixels_no_value"), run.pixels, strict=True))
    row |= {f"{kind}_pixels": n for kind, n in states.defects().items()}
    for kind, changes in by_change(() if pair is None else pair.defects).items():
        row[f"defects_{kind.replace(' ', '_')}"] = " ".join(f"{each.y}/{each.x}" for each in changes)
    for name in _MEDIANS:
        values = run.summary.get(name, (float("nan"),) * 3)
        for part, value in zip(("median", "median_stderr", "scatter"), values, strict=True):
            row[f"{name}_{part}"] = "" if value != value else f"{value:.9g}"
    moved = {} if pair is None else {name: each.n_changed for name, each in pair.maps.items()}
    row |= {f"{name}_moved": moved.get(name, "") for name in MEASURED_MAPS}
    row |= {
        "moved_pixels": "" if pair is None else pair.n_changed,
        "compared_pixels": "" if pair is None else pair.n_compared,
        "effects": " ".join(effect.tag for effect in fitted_effects(store)),
    }
    row |= {f"flag_{name}": n for name, n in states.flags().items()}
    row |= {"id": run.identity, "reference": run.identity if pair is None else pair.one.identity}
    return {name: str(value) for name, value in row.items()}


def read_history(path: Path) -> list[HistoryRow]:
    """Return the lines of a history, none where there is no file.

    Raises:
        StoreError: it is no history, or a line is damaged.
    """
    try:
        lines = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"), newline=""), restval="")
        # a column that an earlier version did not have is empty
        rows: list[HistoryRow] = [defaultdict(str, row) for row in lines]
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise StoreError(f"{path}: cannot be read ({error}); move it away") from error
    if not {"id", "reference", "run", "date", "label"} <= set(lines.fieldnames or ()):
        raise StoreError(f"{path} is no history of this version; move it away or choose another --output")
    for number, row in enumerate(rows, 2):
        try:
            datetime.fromisoformat(row["date"] or "2000-01-01")
            for name, text in row.items():
                if name.startswith(_MEDIANS) or name.endswith("_pixels") or name.startswith("pixels_"):
                    float(text or 0)
        except (ValueError, AttributeError, TypeError) as error:
            raise StoreError(f"{path}, row {number}: damaged ({error}); correct or delete it") from error
    return rows


def append_history(path: Path, rows: Sequence[HistoryRow]) -> None:
    """Add those lines that a history does not have yet; existing ones stay as they are.

    Raises:
        LockedError: another process adds lines.
        StoreError: the file cannot be written.
    """
    text = io.StringIO()
    with locked(path, path.parent / ".pchem"):  # what others added since the comparison began stays
        kept, old = read_history(path), path.read_bytes() if path.exists() else b""
        there = {(row["id"], row["reference"]) for row in kept}
        columns = list((kept or rows)[0])
        writer = csv.DictWriter(text, columns, restval="", extrasaction="ignore", lineterminator="\n")
        if not old:
            writer.writeheader()
        writer.writerows(row for row in rows if (row["id"], row["reference"]) not in there)
        end = b"\n" if old and not old.endswith(b"\n") else b""
        write_atomic(path, old + end + text.getvalue().encode())


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


@dataclass(frozen=True)
class PixelStates:
    """What the pixels of a run are, as its report has them; maps of shape (y, x).

    Attributes:
        kinds: faults, and what the data leave open, as bits.
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
        kinds = stored_defects(store, config).kinds & np.uint16(FAULTS | OPEN)
        return cls(kinds, exposure, noise, store.read("fit/fit_status"), maps["quality"])

    def defects(self) -> dict[str, int]:
        """Return how many pixels have each kind of fault."""
        return {words_of(kind): int(((self.kinds & int(kind)) != 0).sum()) for kind in FAULTS}

    def flags(self) -> dict[str, int]:
        """Return how many pixels bear each word of the status."""
        return {str(bit.name).lower(): int(((self.status & int(bit)) != 0).sum()) for bit in FitStatus if bit}

    def changes_since(self, first: PixelStates, confirm: CommonFit | None = None) -> tuple[DefectChange, ...]:
        """Return the pixels whose faults differ, unless what these are seen in agrees within its error.

        ``confirm`` gives p-values of pixels (y, x) for a common fit of both runs; None: not known. Only it
        tells whether a pixel changed that is flagged, or has no value, in one of them.
        """
        if self.kinds.shape != first.kinds.shape:
            return ()
        changed = self.kinds ^ first.kinds
        changed[_near(self.exposure, first.exposure)] &= np.uint16(~(Defect.HOT | Defect.DEAD))
        changed[_near(self.noise, first.noise)] &= np.uint16(~Defect.NOISY)
        faults = (changed & np.uint16(FAULTS)) != 0
        y, x = np.nonzero(faults if confirm is None else changed)
        if confirm is not None and y.size:
            p, most = confirm(y, x), erfc(LIMIT / np.sqrt(2.0))
            differs = np.where(np.isnan(p), faults[y, x], p <= most)
            y, x = y[differs], x[differs]
        words = (words_of(Defect(int(kinds))) for each in (first, self) for kinds in each.kinds[y, x])
        found = np.array([*words], np.str_).reshape(2, -1)
        return tuple(map(DefectChange, y.tolist(), x.tolist(), *found.tolist()))


def _near(one: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray]) -> BoolArray:
    """Return which values agree within their errors, as far as these are known."""
    error = np.hypot(np.nan_to_num(one[1]), np.nan_to_num(other[1]))
    return np.asarray(np.abs(one[0] - other[0]) <= LIMIT * error)


def _cell(text: str) -> str:
    """Return a text such that a spreadsheet takes it for no formula; a signed number with its unit stays."""
    formula = text[:1] in tuple("=+-@\t\r") and re.fullmatch(r"[+-]?[\d.,]+( ?[\w°%]+)?", text) is None
    return f"'{text}" if formula else text
