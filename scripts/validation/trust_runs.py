"""Whole runs of ``pchem run`` on files of random sensors, with a mishap or none, checked against the truth.

Sensors are drawn by plain numpy and written by tifffile, astropy, zarr or numpy. A median over good pixels is
wrong where that of their deviations is beyond 1 % (of the bias 0.02 e-) and 5 standard errors.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import zarr
from astropy.io import fits
from numpy.typing import NDArray

from pchem_pipeline.cli.app import main
from pchem_pipeline.model.fit import status

Array = NDArray[np.float64]
SYSTEMATIC, ERRORS = 0.01, 5.0
TOP = 65535
STAGE_OF = {"frames": "histogram", "histogram": "fit", "fit": "maps", "maps": "ensemble"}
ARRAYS = (
    "frames/dn",
    "histogram/counts",
    "fit/bias",
    "fit/quanta_exposure",
    "maps/bias",
    "maps/read_noise_e",
)
#: keyword, comment, further cards of a header whose exposure time is in ms
UNITS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("EXPTIME", "exposure time in ms", {}),
    ("EXPTIME", "[ms] exposure", {}),
    ("EXPTIME", "exposure (ms)", {}),
    ("EXPOSURE", "milliseconds", {}),
    ("EXPTIME", "exposure time", {"TIMEUNIT": "ms"}),
)


@dataclass
class Case:
    """A sensor, its frames as they are written, and how the run is called.

    Attributes:
        truth: (y, x) by the name of the map.
        words: what some warning, error or remark must match; empty where nothing need be said.
        again: what happens to the finished run, given store and frames; returns the command that follows.
        until: stage up to which the run goes before that.
    """

    number: int
    folder: Path
    rng: np.random.Generator
    truth: dict[str, Array]
    electrons: Array
    step: Array
    frames: NDArray[Any]
    form: str = "tif"
    header: fits.Header = field(default_factory=fits.Header)
    options: list[str] = field(default_factory=lambda: ["--mode", "copy"])
    words: str = ""
    seconds: float | None = None
    again: Callable[[Case, Path], list[list[str]]] | None = None
    until: str = "report"

    @property
    def noise(self) -> float:
        """Return the median standard deviation of the samples, DN."""
        return float(np.median(self.frames.std(axis=0)))


def sensor(number: int, folder: Path, step_dn: float = 0.0) -> Case:
    """Draw a sensor: maps of H, gain, bias and read noise, hot and dead pixels."""
    rng = np.random.default_rng(number)
    shape = tuple(rng.choice(np.arange(8, 17), 2, replace=False))
    n = int(np.exp(rng.uniform(np.log(150), np.log(1500))))
    step = (step_dn or np.exp(rng.uniform(np.log(3), np.log(30)))) * rng.normal(1, 0.01, shape)
    exposure = np.exp(rng.uniform(np.log(0.2), np.log(4))) * rng.lognormal(0, 0.25, shape)
    odd = rng.choice(exposure.size, 3, replace=False)
    exposure.flat[odd[: rng.integers(4)]] *= rng.choice([0.01, 12])
    noise = rng.uniform(0.12, 0.3) * rng.lognormal(0, 0.05, shape)
    bias = 10 * step.mean() + rng.normal(0, 0.3 * step.mean(), shape)
    electrons = rng.poisson(exposure, (n, *shape)) + noise * rng.normal(size=(n, *shape))
    case = Case(number, folder, rng, {}, electrons, step, np.empty(0))
    case.truth = {"quanta_exposure": exposure, "bias": bias, "noise": noise}
    case.form = str(rng.choice(["tif", "npy", "fits", "zarr"]))
    digitise(case)
    return case


def digitise(case: Case, high: float = TOP) -> None:
    """Round the samples to DN, and set the true maps that depend on the gain."""
    values = case.electrons * case.step + case.truth["bias"]
    case.frames = np.rint(values).clip(0, high).astype(np.uint16)
    case.truth["conversion_gain"] = 1 / case.step
    case.truth["read_noise_e"] = np.hypot(case.truth["noise"], 12**-0.5 / case.step)


def black_level(case: Case) -> None:
    case.truth["bias"] += case.rng.uniform(-0.3, 0.4) * case.step.mean() - case.truth["bias"].mean()
    digitise(case)
    case.words = r"(?i)\b0 DN|black level|limits? of the ADC"


def full_scale(case: Case) -> None:
    top = int(np.quantile(case.frames, case.rng.uniform(0.8, 0.97)))
    bits = int(np.ceil(np.log2(top + 1)))
    case.truth["bias"] += 2**bits - 1 - top
    digitise(case, high=2**bits - 1)
    case.options += ["--bit-depth", str(bits)] if case.rng.random() < 0.5 else []
    case.words = r"(?i)limits? of the ADC|saturat|highest code|largest code|full scale|% of the samples are"


def first_frame(case: Case) -> None:
    case.frames[0] = (case.frames[0] + case.rng.uniform(2, 6) * case.noise).clip(0, TOP)
    case.words = r"(?i)first frame|frames? 0\b"


def warm_up(case: Case) -> None:
    n = int(case.rng.integers(3, 12))
    rise = case.rng.uniform(2, 6) * case.noise * np.exp(-np.arange(n) / n)
    case.frames[:n] = (case.frames[:n] + rise[:, None, None]).clip(0, TOP)
    case.words = r"(?i)first frame|frames? 0\b|drift|level of the frames|along the run"


def dropped_frames(case: Case) -> None:
    case.frames[case.rng.choice(len(case.frames), int(case.rng.integers(1, 5)), replace=False)] = 0
    case.words = r"(?i)empty|dropped|all zero|frames? \d+"


def repeated_frames(case: Case) -> None:
    first = int(case.rng.integers(1, len(case.frames) - 20))
    case.frames[first : first + int(case.rng.integers(2, 12))] = case.frames[first - 1]
    case.words = r"(?i)repeat|identical|equal|duplicate|the same as|cop(y|ies) of"


def byte_order(case: Case) -> None:
    case.form = "raw"
    case.frames = case.frames.byteswap()
    case.words = r"(?i)byte"


def left_justified(case: Case) -> None:
    shift = 16 - int(np.ceil(np.log2(case.frames.max() + 1)))
    case.frames <<= shift
    case.truth |= {
        "bias": case.truth["bias"] * 2**shift,
        "conversion_gain": case.truth["conversion_gain"] / 2**shift,
    }
    case.words = r"(?i)justified|bit.shift|multiples? of" if shift else ""


def time_unit(case: Case) -> None:
    case.form, milliseconds = "fits", int(case.rng.integers(20, 900))
    name, comment, more = UNITS[case.rng.integers(len(UNITS))]
    case.header[name] = (milliseconds, comment)
    case.seconds = milliseconds / 1000
    case.header.update(more)
    case.options += ["--kind", "dark"]


def unwritten_chunk(case: Case) -> None:
    case.form, case.words = "unwritten", r"(?i)never written|not written|unwritten"


def store_damage(case: Case, flip: bool) -> None:
    """Delete a chunk of the run's store between two stages, or change a bit of it."""
    name = str(case.rng.choice(ARRAYS))
    stage = STAGE_OF[name.split("/")[0]]
    case.until = stage

    def damage(case: Case, store: Path) -> list[list[str]]:
        chunk = case.rng.choice(sorted(path for path in (store / name / "c").rglob("*") if path.is_file()))
        if flip:
            content = bytearray(chunk.read_bytes())
            content[case.rng.integers(len(content))] ^= 1 << int(case.rng.integers(8))
            chunk.write_bytes(bytes(content))
        else:
            chunk.unlink()
        return [[stage, str(store), "--force"], ["run", str(store)]]

    case.again, case.words = damage, "" if flip else r"(?i)is missing|damaged|corrupt"


def report_deleted(case: Case) -> None:
    def delete(case: Case, store: Path) -> list[list[str]]:
        (store / str(case.rng.choice(["report.html", "report.json"]))).unlink()
        return [["run", str(store)]]

    case.again = delete


def replaced_files(case: Case) -> None:
    case.form, case.until = "tif", "fit"
    case.options += ["--mode", "reference"]  # the last one counts

    def replace(case: Case, store: Path) -> list[list[str]]:
        case.step = case.step * 1.2
        digitise(case)
        write(case)
        return [["run", str(store)]]

    case.again, case.words = replace, r"(?i)chang|differ|replac|other"


def hundreds_of_dn(case: Case) -> None:
    other = sensor(case.number, case.folder, step_dn=float(case.rng.uniform(150, 900)))
    case.step, case.truth, case.electrons = other.step, other.truth, other.electrons
    digitise(case)


def two_taps(case: Case) -> None:
    case.step[:, case.step.shape[1] // 2 :] *= case.rng.uniform(1.12, 1.3)
    digitise(case)
    case.words = r"(?i)columns \d|two (parts|taps|modes|gains)|parts? of the sensor|\bstep\b"


def hot_pixel(case: Case) -> None:
    place = (0, 0)
    case.truth["quanta_exposure"][place] = case.rng.uniform(500, 3000)
    case.electrons[:, *place] += case.rng.poisson(case.truth["quanta_exposure"][place], len(case.electrons))
    digitise(case)


MISHAPS: dict[str, tuple[str, Callable[[Case], None]]] = {
    "none": ("nothing", lambda case: None),
    "black_level": ("samples piled up at 0 DN", black_level),
    "full_scale": ("samples piled up at the top", full_scale),
    "first_frame": ("odd first frame", first_frame),
    "warm_up": ("warm-up", warm_up),
    "dropped": ("empty frames", dropped_frames),
    "repeated": ("repeated frames", repeated_frames),
    "byte_order": ("bytes in the wrong order", byte_order),
    "justified": ("left-justified samples", left_justified),
    "milliseconds": ("exposure time in ms", time_unit),
    "unwritten": ("zarr chunk never written", unwritten_chunk),
    "chunk_deleted": ("chunk of the store deleted", lambda case: store_damage(case, flip=False)),
    "bit_flipped": ("bit of the store flipped", lambda case: store_damage(case, flip=True)),
    "report_deleted": ("report deleted", report_deleted),
    "replaced": ("files replaced, reference mode", replaced_files),
    "hundreds": ("150 to 900 DN per electron", hundreds_of_dn),
    "taps": ("two taps", two_taps),
    "hot_pixel": ("a hot pixel", hot_pixel),
}


def write(case: Case) -> Path:
    """Write the frames in the case's format."""
    path = case.folder / f"frames.{case.form}"
    if case.form == "tif":
        tifffile.imwrite(path, case.frames, photometric="minisblack")
    elif case.form == "npy":
        np.save(path, case.frames)
    elif case.form == "fits":
        fits.PrimaryHDU(case.frames, case.header).writeto(path, overwrite=True)
    elif case.form == "raw":
        case.frames.tofile(path)
        shape = [int(side) for side in case.frames.shape[1:]]
        path.with_name("frames.raw.json").write_text(json.dumps({"shape": shape, "dtype": "uint16"}))
    else:
        path = case.folder / "frames.zarr"
        n, *sides = case.frames.shape
        chunks = (-(-n // 5), *map(int, sides))
        array = zarr.create_array(path, shape=case.frames.shape, chunks=chunks, dtype="u2", fill_value=0)
        last = n if case.form == "zarr" else (n // chunks[0]) * chunks[0] - chunks[0]
        array[:last] = case.frames[:last]
    return path


def pchem(*words: str) -> tuple[int, str]:
    """Return exit code and all output of a command, -1 where it ends with a traceback."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        try:
            main([*words, "--workers", "1", "--backend", "serial"])
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1 if end.code else 0
        except Exception:
            code = -1
            traceback.print_exc(file=text)
    lines = text.getvalue().splitlines()
    return code, "\n".join(line for line in lines if not line.startswith(("Next:", "Or:"))) + "\n"


def mishap_of(number: int) -> str:
    """Return what happens to a run: every fourth time nothing, else each mishap in turn."""
    names = [name for name in MISHAPS if name != "none"]
    return "none" if number % 4 == 0 else names[(number - number // 4 - 1) % len(names)]


def study_run(number: int, folder: Path, mishap: str | None = None) -> dict[str, Any]:
    """Do one run, and return what was said and what was wrong."""
    begin, mishap = time.process_time(), mishap or mishap_of(number)
    case = sensor(number, folder)
    MISHAPS[mishap][1](case)
    folder.mkdir(parents=True, exist_ok=True)
    store = folder / "run.zarr"
    code, text = pchem("run", str(write(case)), "--store", str(store), *case.options, "--until", case.until)
    before = medians(store)
    refused = code not in (0, 3)
    if code == 0 and case.again is not None:
        code, more, refused = again(case, store)
        text += more
    row: dict[str, Any] = {"number": number, "mishap": mishap, "code": int(code), "refused": refused}
    row["uncured"] = case.again is not None and code != 0
    row |= {
        "wrong": [],
        "answer": "none",
        "traceback": code == -1 or "Traceback" in text or "Error: " in text,
    }
    report = store / "report.json"
    if code == 0 and not ((store / "report.html").exists() and report.exists()):
        row["wrong"].append("no report")
    elif code in (0, 3) and report.exists():
        content = json.loads(report.read_text())
        text += said(content)
        row["answer"] = content["answers"][-1]["level"]
        row |= check(case, store, content)
        changed = [
            name
            for name, value in medians(store).items()
            if mishap != "replaced" and before.get(name, value) != value
        ]
        row["wrong"] += [f"{name} changed" for name in changed]
    row |= {
        "silent": bool(case.words) and not re.search(case.words, text.replace(str(folder), "")),
        "text": text,
    }
    row["no"] = row["answer"] in ("serious", "none")
    return row | {"cpu": time.process_time() - begin}


def again(case: Case, store: Path) -> tuple[int, str, bool]:
    """Do what happens to a run, then the printed cures; return code, output, and whether one was needed."""
    text, refused = "", False
    for command in case.again(case, store) if case.again else ():
        code, more = pchem(*command)
        text += more
    for _ in range(3):
        cures = re.findall(r"pchem (\w+) \S+ --force", more)
        if code == 0 or not cures:
            break
        refused = True
        _, redone = pchem(cures[-1], str(store), "--force")
        code, more = pchem("run", str(store))
        text += redone + more
    return code, text, refused or code != 0


def said(content: dict[str, Any]) -> str:
    """Return all remarks of a report that are no good news."""
    remarks = [each["text"] for each in (*content["flags"], *content["answers"]) if each["level"] != "good"]
    return "\n".join([*remarks, *(note for stage in content["stages"] for note in stage["notes"])])


def medians(store: Path) -> dict[str, float | None]:
    """Return the medians in the report, by quantity; none without one."""
    path = store / "report.json"
    summary = json.loads(path.read_text())["summary"] if path.exists() else {}
    return {name: each["median"] for name, each in summary.items()}


def check(case: Case, store: Path, content: dict[str, Any]) -> dict[str, Any]:
    """Return which medians, rates and counts differ from the truth, and how many good pixels do."""
    maps = zarr.open_group(store, mode="r")
    words = np.asarray(maps["fit/fit_status"]).astype(int)
    wrong, beyond, pixels = [], 0, 0
    stated = medians(store)
    for name in ("quanta_exposure", "conversion_gain", "bias", "read_noise_e"):
        good = (words & int(status.FAILED | status.flags_of(name))) == 0
        if not good.any() or (found := stated.get(name)) is None:
            continue
        truth, values, stderr = (
            np.asarray(each)[good]
            for each in (case.truth[name], maps[f"maps/{name}"], maps[f"maps/{name}_stderr"])
        )
        floor = SYSTEMATIC * np.abs(truth) if name != "bias" else 0.02 / case.truth["conversion_gain"][good]
        beyond += int((np.abs(values - truth) > ERRORS * stderr + floor).sum())
        pixels += int(good.sum())
        limit = np.median(floor) + ERRORS * 1.2533 * np.median(stderr) / good.sum() ** 0.5
        shift = np.median(values - truth)
        if abs(shift) > limit or abs(found - np.median(values)) > limit:
            wrong.append(f"{name} {found:.4g} for {np.median(truth):.4g}")
    rate, exposure = stated.get("dark_current"), stated.get("quanta_exposure")
    if rate is not None and exposure is not None:
        expected = exposure / (case.seconds or np.nan)
        wrong += [] if abs(rate / expected - 1) < 0.05 else [f"rate {rate:.4g} for {expected:.4g}"]
    good = (words & int(status.FAILED | status.FLAGGED)) == 0
    counts = content["fit_status"]
    number = counts["n_pixels"] - sum(counts[name] for name in ("n_flagged", "n_failed", "n_unfitted"))
    wrong += [] if number == good.sum() else [f"good pixels {number} for {good.sum()}"]
    return {"wrong": wrong, "beyond": beyond, "pixels": pixels, "good": float(good.mean())}


def study_runs(n: int, seed: int, folder: Path) -> list[dict[str, Any]]:
    """Do n runs."""
    rows = []
    for number in range(seed * 1_000_000, seed * 1_000_000 + n):
        rows.append(study_run(number, folder / str(number)))
        shutil.rmtree(folder / str(number))
    return rows
