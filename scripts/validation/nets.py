"""Freeze what the command line finds for fixed frames, and compare two such nets array by array.

Frames are drawn here, by numpy alone, and everything else goes through ``pchem`` and its stores, so that a
net outlives every change of the package's inside. A change of the fit is compared with the net of the
commit before it: arrays that are equal to the bit, largest differences (parameters in units of their own
standard errors), status words, verdicts.

    python scripts/validation/nets.py freeze nets/before        # two to three minutes with compiled kernels
    python scripts/validation/nets.py compare nets/before nets/after

The comparison exits with 1 where a log-likelihood is lower by more than 1e-9 of itself, a parameter is off by
more than 1e-3 of its standard error (unless the likelihood rose), a status word differs (``--status N``: in
more than N pixels), an array is missing, or a verdict is another.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zarr
from numpy.typing import NDArray

Array = NDArray[Any]

SPECTRA = sorted((Path(__file__).parents[2] / "tests" / "data" / "sipm").glob("*.csv"))
PAGES = ("report.json", "discrepancy.json", "methods.json")

#: Not compared: what a kill-safe run notes for itself, and how many steps a fit took.
NO_RESULT = ("n_iterations", "ensemble_tiles/", "summary/open_")

LOWER = 1e-9  # of the log-likelihood
HIGHER = 1e-7  # nats: a likelihood that rose by more has found a better maximum
STANDARD_ERRORS = 1e-3
BOUND = 1e-6  # relative, of parameters without a standard error


# -- frames


@dataclass(frozen=True)
class Sensor:
    """Parameters of the pixels, each of shape (y, x): H (e-), 1/g (DN/e-), bias (DN) and read noise (e-)."""

    exposure: Array
    step: Array
    bias: Array
    noise: Array

    @classmethod
    def drawn(
        cls,
        seed: int,
        side: int,
        exposure: tuple[float, float] = (0.5, 5.0),
        step: tuple[float, float] = (9.0, 13.0),
        noise: tuple[float, float] = (0.2, 0.5),
    ) -> Sensor:
        """Draw pixels evenly over these ranges."""
        rng = np.random.default_rng(seed)
        ranges = (exposure, step, (95.0, 105.0), noise)
        return cls(*(rng.uniform(*each, (side, side)) for each in ranges))

    def frames(self, seed: int, n: int, scale: float = 1.0) -> Array:
        """Return ``n`` frames of the PCD at ``scale`` times the exposure, before rounding, DN."""
        rng = np.random.default_rng(seed)
        electrons = rng.poisson(scale * self.exposure, (n, *self.bias.shape))
        return self.read(electrons.astype(np.float64), rng)

    def read(self, electrons: Array, rng: np.random.Generator) -> Array:
        """Return DN before rounding of a signal in e-, read noise added."""
        signal = electrons + self.noise * rng.standard_normal(electrons.shape)
        return self.bias + self.step * signal


def odd_pixels(frames: Array) -> Array:
    """Make some pixels of a stack such as no model describes; changes the stack."""
    rng = np.random.default_rng(99)
    n = frames.shape[0]
    frames[:, 0, 0] = 100.0  # stuck
    frames[:, 0, 1] = 100.3 + 3.0 * rng.standard_normal(n)  # dead
    frames[:, 0, 2] = 100.0 + (rng.random(n) < 0.5)  # two codes
    frames[:, 0, 3] += 16_350  # at the top of the ADC
    frames[:, 0, 4] = 100.0 + 11.0 * (rng.poisson(40.0, n) + 0.3 * rng.standard_normal(n))  # hot
    frames[:, 0, 5] += 5.5 * (np.arange(n) % 200 < 60)  # slow telegraph noise of half an electron
    frames[:, 0, 6] += np.where(rng.random(n) < 0.002, 400.0, 0.0)  # cosmic rays
    frames[:, 0, 7] = 100.0 + 11.0 * (rng.poisson(2.0, n) + 1.4 * rng.standard_normal(n))  # too noisy
    frames[:, 1, 0] = rng.uniform(50, 400, n)  # no peaks at all
    frames[:, 1, 1] = 100.0 + 11.0 * (rng.poisson(0.004, n) + 0.25 * rng.standard_normal(n))  # few electrons
    frames[: n // 2, 1, 2] += 11.0  # the bias jumps by an electron
    return frames


def with_effects(sensor: Sensor, seed: int, n: int) -> Array:
    """Return frames with noise that grows with the signal, a bent comb, telegraph noise and row noise."""
    rng = np.random.default_rng(seed)
    k = rng.poisson(sensor.exposure, (n, *sensor.bias.shape)).astype(np.float64)
    signal = k * (1 + 0.004 * (k - 1) / 2) + 0.09 * np.sqrt(k) * rng.standard_normal(k.shape)
    traps = rng.random(sensor.bias.shape) < 0.15
    moved = rng.choice([-1.0, 0.0, 1.0], p=[0.1, 0.8, 0.1], size=k.shape)
    rows = 1.2 * rng.standard_normal((n, k.shape[1], 1))
    return sensor.read(signal + traps * moved, rng) + rows


def codes(frames: Array) -> Array:
    """Return what an ADC of 14 bits makes of DN."""
    return np.clip(np.rint(frames), 0, (1 << 14) - 1).astype(np.uint16)


# -- runs


@dataclass
class Folder:
    """A folder of runs."""

    path: Path

    def run(self, name: str, frames: Array | None, time: float = 4.87, **sections: Any) -> str:
        """Write frames and the YAML of a run; return its name."""
        content: dict[str, Any] = {"run": {"store": f"{name}.zarr", "tile": 8}}
        if frames is not None:
            (self.path / name).mkdir()
            np.save(self.path / name / "frames.npy", codes(frames))
            files = [f"{name}/frames.npy"]
            content["input"] = {"files": files, "integration_time": time, "bit_depth": 14}
        for section, settings in sections.items():
            content[section] = {**content.get(section, {}), **settings}
        (self.path / f"{name}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
        return f"{name}.yaml"

    def pchem(self, *arguments: str) -> None:
        """Run the command of the package that is imported here: PYTHONPATH chooses it."""
        began = time.monotonic()
        command = [sys.executable, "-m", "pchem_pipeline", *arguments, "--quiet"]
        done = subprocess.run(command, cwd=self.path, capture_output=True, text=True)
        print(f"  {time.monotonic() - began:6.1f} s  pchem {' '.join(arguments)}", flush=True)
        if done.returncode == 3:
            print(f"           {done.stderr.strip().splitlines()[-1]}", flush=True)
        if done.returncode not in (0, 3):
            raise SystemExit(f"pchem {' '.join(arguments)}: exit code {done.returncode}\n{done.stderr}")


def plain(at: Folder) -> None:
    """Fit the PCD to a spread of read noises and some odd pixels; electrons, methods and the report, too."""
    frames = odd_pixels(Sensor.drawn(1, 24).frames(2, 2000))
    methods = {"pixels": 60, "study_pixels": 12, "study_read_noise": [0.25, 0.45, 0.8]}
    run = at.run("plain", frames, methods=methods)
    at.pchem("run", run, "--until", "ensemble")
    at.pchem("electrons", run)
    at.pchem("methods", run)
    at.pchem("report", run)


def exact(at: Folder) -> None:
    """Fit coarse steps with exact masses, in all pixels and where it matters."""
    frames = odd_pixels(Sensor.drawn(3, 12, step=(1.2, 6.0), noise=(0.2, 0.4)).frames(4, 3000))
    for likelihood in ("exact", "auto"):
        run = at.run(likelihood, frames, fit={"likelihood": likelihood})
        at.pchem("run", run, "--until", "ensemble")


def errors(at: Folder) -> None:
    """Take sandwich errors and profile intervals."""
    frames = odd_pixels(Sensor.drawn(5, 16, exposure=(0.05, 4.0), noise=(0.2, 0.55)).frames(6, 1500))
    run = at.run("errors", frames, fit={"errors": "sandwich", "intervals": "profile"})
    at.pchem("run", run, "--until", "maps")


def effects(at: Folder) -> None:
    """Fit with effects in the model."""
    added = [
        {"tag": "signal_dependent_noise", "noise_e": 0.09},
        {"tag": "nonlinearity", "step_change": 0.004},
        {"tag": "rts_noise", "fraction": 0.15, "amplitude_e": 1.0, "probability": 0.2},
        {"tag": "row_noise", "row_noise_dn": 1.2},
    ]
    frames = odd_pixels(with_effects(Sensor.drawn(7, 16, noise=(0.2, 0.42)), 8, 2500))
    run = at.run("effects", frames, model={"effects": added})
    at.pchem("run", run, "--until", "ensemble")
    at.pchem("electrons", run)


def joint(at: Folder) -> None:
    """Fit three exposures and a bias together, by the density and by exact masses."""
    for name, step in (("joint", (9.0, 13.0)), ("joint_exact", (1.5, 5.0))):
        sensor = Sensor.drawn(9, 12, exposure=(0.3, 0.8), step=step, noise=(0.25, 0.8))
        runs = []
        for seed, length in enumerate((1.0, 3.0, 8.0, 0.0)):
            frames = sensor.frames(10 + seed, 1200, length)
            if length == 1.0:
                frames[:, 0, 0] = 100.0
            runs.append(at.run(f"{name}_{length:g}s", frames, max(length, 0.001)))
        likelihood = "exact" if name.endswith("exact") else "density"
        samples = [*({"run": run} for run in runs[:3]), {"run": runs[3], "bias": True}]
        run = at.run(name, None, input={"samples": samples}, fit={"likelihood": likelihood})
        at.pchem("joint", run)


def hidden(at: Folder) -> None:
    """Name row noise on simulated frames, by replicates."""
    camera = {"shape": [16, 16], "n_frames": 1800, "seed": 5, "output": "hidden", "format": "npy"}
    camera["effects"] = [{"tag": "row_noise", "row_noise_dn": 1.2}]
    search = {"replicates": 20, "extended_replicates": 12, "candidates": ["row_noise", "frame_noise"]}
    run = at.run("hidden", None, simulate=camera, discrepancy=search)
    at.pchem("simulate", run)
    at.pchem("run", run, "--until", "fit")
    at.pchem("discrepancy", run, "--no-refit")


def spectra(at: Folder) -> None:
    """Name what the spectra of a silicon photomultiplier show, by likelihood; fit with it."""
    files = []
    for path in SPECTRA:
        shutil.copy(path, at.path)
        files.append(path.name)
    run = at.run("spectra", None, input={"files": files})
    at.pchem("run", run, "--until", "ensemble")
    at.pchem("discrepancy", run)


CASES: tuple[Callable[[Folder], None], ...] = (plain, exact, errors, effects, joint, hidden, spectra)


def freeze(folder: Path, wanted: list[str]) -> None:
    """Do all runs and keep their arrays as ``NAME.npz`` and what they say as JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    for case in CASES:
        if wanted and case.__name__ not in wanted:
            continue
        print(f"{case.__name__}: {(case.__doc__ or '').splitlines()[0]}", flush=True)
        runs = folder / "runs" / case.__name__
        shutil.rmtree(runs, ignore_errors=True)
        runs.mkdir(parents=True)
        case(Folder(runs))
        for store in sorted(runs.glob("*.zarr")):
            keep(store, folder, case.__name__)
        shutil.rmtree(runs)
    shutil.rmtree(folder / "runs", ignore_errors=True)


def keep(store: Path, folder: Path, case: str) -> None:
    """Copy the results of a store; its frames stay behind."""
    name = store.stem
    if case == "joint" and name not in ("joint", "joint_exact"):
        return
    arrays = {path: array for path, array in arrays_of(store) if not path.startswith("frames/")}
    np.savez_compressed(folder / f"{name}.npz", **arrays)
    for page in PAGES:
        if (store / page).exists():
            shutil.copy(store / page, folder / f"{name}.{page}")


def arrays_of(store: Path) -> Iterator[tuple[str, Array]]:
    """Yield path and values of every array of a store."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the pages that lie beside the arrays
        groups = sorted(zarr.open_group(store, mode="r").groups())
    for name, group in groups:
        for array, values in sorted(group.arrays()):
            yield f"{name}/{array}", np.asarray(values[...])


# -- comparison


class Comparison:
    """What differs between two nets."""

    def __init__(self, allowed_words: int) -> None:
        self.allowed_words = allowed_words
        self.words = 0
        self.wrong: list[str] = []

    def say(self, where: str, what: str, *, wrong: bool = False) -> None:
        """Print a difference; ``wrong``: beyond the limits."""
        print(f"{'! ' if wrong else '  '}{where:44s} {what}")
        if wrong:
            self.wrong.append(f"{where} {what}")

    def nets(self, old: Path, new: Path) -> None:
        """Compare all files of two nets."""
        for path in (*sorted(old.glob("*.npz")), *sorted(old.glob("*.json"))):
            other = new / path.name
            if not other.exists():
                self.say(path.name, "missing", wrong=True)
            elif path.suffix == ".json":
                self.page(path.name, json.loads(path.read_text()), json.loads(other.read_text()))
            else:
                with np.load(path) as left, np.load(other) as right:
                    self.run(path.stem, dict(left), dict(right))
        if self.words > self.allowed_words:
            self.wrong.append(f"{self.words} status words differ")

    def run(self, run: str, old: dict[str, Array], new: dict[str, Array]) -> None:
        """Compare the arrays of one run."""
        equal = 0
        rose = self.likelihood(run, old, new)
        for name, left in old.items():
            right = new.get(name)
            if right is None:
                self.say(f"{run}:{name}", "missing", wrong=not skipped(name))
            elif left.shape != right.shape:
                self.say(f"{run}:{name}", f"shape {left.shape} is now {right.shape}", wrong=not skipped(name))
            elif left.tobytes() == right.tobytes() or np.array_equal(left, right, equal_nan=is_float(left)):
                equal += 1
            elif name.endswith("fit_status"):
                self.status(f"{run}:{name}", left, right)
            elif is_float(left) and f"{name}_stderr" in old:
                self.parameter(f"{run}:{name}", left, right, old[f"{name}_stderr"], rose)
            else:
                self.say(f"{run}:{name}", difference(left, right))
        more = Counter(name.split("/")[0] for name in new.keys() - old.keys())
        added = ", ".join(f"{n} in {group}" for group, n in sorted(more.items())) or "none"
        print(f"  {run}: {equal} of {len(old)} arrays are equal to the bit; new: {added}")

    def likelihood(self, run: str, old: dict[str, Array], new: dict[str, Array]) -> Array | None:
        """Compare log-likelihoods; return where they rose, (y, x)."""
        name = "fit/log_likelihood"
        if name not in old or name not in new:
            return None
        change = new[name] - old[name]
        with np.errstate(invalid="ignore"):
            lower = change < -LOWER * np.abs(old[name])
            rose = np.asarray(change > HIGHER)
        bias = "maps/bias" if "maps/bias" in old else "fit/bias"  # a net may end with the fit
        nothing = lower & np.isnan(old[bias]) & np.isnan(new[bias])
        lower &= ~nothing
        for where, words in (
            (nothing, "lower in {} pixels without a value before and after"),
            (lower, f"lower in {{}} pixels, by up to {-np.nanmin(change, initial=0.0):.3g} nats"),
            (rose, f"higher in {{}} pixels, by up to {np.nanmax(change, initial=0.0):.3g} nats"),
        ):
            if where.any():
                text = f"{words.format(int(where.sum()))}: {places(where)}"
                self.say(f"{run}:{name}", text, wrong=where is lower)
        return rose

    def status(self, where: str, old: Array, new: Array) -> None:
        """Compare status words."""
        differ = old != new
        changes = Counter(zip(old[differ].tolist(), new[differ].tolist(), strict=True))
        listed = ", ".join(f"{a} -> {b} ({n})" for (a, b), n in changes.most_common(8))
        self.words += int(differ.sum())
        self.say(where, f"{int(differ.sum())} words differ: {listed}; {places(differ)}")

    def parameter(self, where: str, old: Array, new: Array, stderr: Array, rose: Array | None) -> None:
        """Compare estimates in units of their standard errors."""
        known = np.isfinite(old)
        gone, came = int((known & ~np.isfinite(new)).sum()), int((~known & np.isfinite(new)).sum())
        both = known & np.isfinite(new)
        if rose is not None and rose.shape == old.shape[-rose.ndim :]:
            both &= ~rose
        change = np.abs(new - old)
        errors = np.where(np.isfinite(stderr) & (stderr > 0), stderr, np.nan)
        pulls = np.where(both, change / errors, 0.0)
        free = both & np.isnan(errors)
        pulls = np.where(free, STANDARD_ERRORS / BOUND * change / np.maximum(np.abs(old), 1e-300), pulls)
        off = pulls > STANDARD_ERRORS
        words = f"{np.nanmax(pulls, initial=0.0):.2g} standard errors at most"
        if off.any():
            words += f", {int(off.sum())} beyond {STANDARD_ERRORS}: {places(off)}"
        if gone or came:
            words += f"; {gone} lost, {came} new values"
        self.say(where, words, wrong=bool(off.any() or gone))

    def page(self, name: str, old: Any, new: Any) -> None:
        """Compare JSON, a verdict strictly."""
        if "verdict" in old:
            self.verdict(name, old, new)
        left, right = dict(leaves(old)), dict(leaves(new))
        numbers, gone = [], 0
        for key, value in left.items():
            if key not in right:
                gone += 1
            elif is_number(value) and is_number(right[key]):
                change = abs(right[key] - value) / max(abs(value), 1e-300)
                if change > 1e-9:
                    numbers.append((change, f"{key} {value:.6g} -> {right[key]:.6g}"))
            elif value != right[key] and not volatile(key):
                numbers.append((np.inf, f"{key} {str(value)[:50]} -> {str(right[key])[:50]}"))
        numbers.sort(key=lambda each: -each[0])
        added = len(right.keys() - left.keys())
        words = f"{len(numbers)} of {len(left)} entries differ beyond 1e-9, {gone} are gone, {added} new"
        self.say(name, words)
        for _, words in numbers[:12]:
            print(f"      {words}")

    def verdict(self, name: str, old: dict[str, Any], new: dict[str, Any]) -> None:
        """Compare the verdict, the effects it names and the gap."""
        for key in ("verdict", "effects"):
            if new.get(key) != old[key]:
                self.say(name, f"{key} {old[key]} -> {new.get(key)}", wrong=True)
        gap, other = old["gap"], new.get("gap", {})
        for end in ("before", "after"):
            low, high = gap[f"interval_{end}"]
            now = other.get(end)
            if now is None:
                self.say(name, f"gap {end} is gone", wrong=True)
                continue
            words = f"gap {end} {gap[end]:.6g} -> {now:.6g} nats per sample"
            self.say(name, words, wrong=abs(now - gap[end]) > 0.1 * (high - low))


def skipped(name: str) -> bool:
    """Tell whether an array is no result."""
    return any(part in name for part in NO_RESULT)


def volatile(key: str) -> bool:
    """Tell whether an entry of a page changes from run to run or with every version."""
    parts = r"seconds|version|time|digest|path|environment|sentence|host|made|started|memory"
    return re.search(parts, key, re.I) is not None


def is_float(array: Array) -> bool:
    """Tell whether an array may hold NaN."""
    return array.dtype.kind == "f"


def is_number(value: Any) -> bool:
    """Tell whether a JSON value is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def difference(old: Array, new: Array) -> str:
    """Say how far two arrays of one shape are apart."""
    if not is_float(old):
        return f"{int((old != new).sum())} of {old.size} values differ"
    change = np.abs(new - old)
    scale = max(float(np.nanmax(np.abs(old), initial=0.0)), 1e-300)
    lost = int((np.isnan(old) != np.isnan(new)).sum())
    largest = float(np.nanmax(np.where(np.isfinite(change), change, 0.0), initial=0.0))
    return f"{largest:.3g} at most, {largest / scale:.2g} of the largest value" + (
        f"; {lost} NaN come or go" if lost else ""
    )


def places(chosen: Array) -> str:
    """Name the first places of a mask."""
    found = [".".join(map(str, place)) for place in np.argwhere(chosen)[:6].tolist()]
    return " ".join(found) + (" ..." if chosen.sum() > 6 else "")


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of JSON data with their paths."""
    if isinstance(value, dict):
        for name, each in value.items():
            yield from leaves(each, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for i, each in enumerate(value):
            yield from leaves(each, f"{key}.{i}")
    elif not volatile(key):
        yield key, value


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    freezing = commands.add_parser("freeze", help="do all runs and keep what they find")
    freezing.add_argument("folder", type=Path)
    freezing.add_argument("cases", nargs="*", help=f"of {', '.join(c.__name__ for c in CASES)}; default: all")
    comparing = commands.add_parser("compare", help="print the differences; exit with 1 beyond the limits")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    comparing.add_argument("--status", type=int, default=0, help="status words that may differ [0]")
    chosen = parser.parse_args()
    if chosen.command == "freeze":
        freeze(chosen.folder, chosen.cases)
        return
    comparison = Comparison(chosen.status)
    comparison.nets(chosen.old, chosen.new)
    for line in comparison.wrong:
        print("BEYOND THE LIMITS:", line)
    print("within the limits" if not comparison.wrong else f"{len(comparison.wrong)} beyond the limits")
    sys.exit(bool(comparison.wrong))


if __name__ == "__main__":
    main()
