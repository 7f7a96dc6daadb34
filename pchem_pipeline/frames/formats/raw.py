"""Raw binary frames, described by a sidecar file or by the settings.

The sidecar lies beside ``frames.raw`` as ``frames.raw.json`` (or ``frames.json``, ``.yaml``, ``.yml``) with
the keys ``shape`` ([rows, columns] or [frames, rows, columns]), ``dtype``, ``offset``, ``byte_order``,
``packing``, ``header_bytes``, ``frame_padding_bytes``, ``bit_shift``, ``bit_depth``, ``integration_time``
(s). Other keys are left alone, but for those of the camera. Beside ``movie.dax`` of STORM microscopes HAL
writes ``movie.inf``, lines ``name = value``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from pchem_pipeline.base.errors import InputError, error_words
from pchem_pipeline.frames.camera import facts_from_names
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout, even_offsets, write_plain
from pchem_pipeline.frames.formats.kinds import check_samples
from pchem_pipeline.frames.formats.packing import PACKINGS
from pchem_pipeline.frames.settings import InputSettings, PackingName
from pchem_pipeline.frames.writing import StackFacts
from pchem_pipeline.store.files import write_atomic

#: suffixes of descriptions beside raw files
SIDECARS = (".json", ".yaml", ".yml", ".inf")
_NAMES_IN_INF = {
    "camera": "camera head",
    "temperature": "camera temperature (deg. C)",
    "exposure_time": "Exposure Time",
    "gain": "EMCCD Gain",
    "binning": "binning",
}
#: factor between the steps of samples from frame to frame by which another packing is told
_CLEARLY = 4


class _Sidecar(BaseModel):
    """What a sidecar can say of the layout; other keys may be facts of the camera."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    shape: tuple[int, ...] | None = None
    dtype: Literal["uint8", "uint16", "uint32", "int16", "int32"] | None = None
    offset: int | None = None
    byte_order: Literal["little", "big"] | None = None
    packing: PackingName | None = None
    header_bytes: int | None = None
    frame_padding_bytes: int | None = None
    bit_shift: int | None = None
    bit_depth: int | None = None
    integration_time: float | None = None


def find_sidecar(path: Path) -> Path | None:
    """Return the sidecar of a raw file, or None."""
    places = (each for end in SIDECARS for each in (path.with_name(path.name + end), path.with_suffix(end)))
    return next((place for place in places if place.is_file()), None)


def _read_sidecar(path: Path) -> _Sidecar:
    found = find_sidecar(path)
    if found is None:
        return _Sidecar()
    import yaml

    try:
        text = found.read_text(encoding="utf-8")
        readers: dict[str, Callable[[str], Any]] = {".json": json.loads, ".inf": _from_inf}
        return _Sidecar.model_validate(readers.get(found.suffix, yaml.safe_load)(text))
    except ValidationError as error:
        raise InputError(f"sidecar {found.name}: {error_words(error)}; correct the sidecar") from error
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        words = "not valid YAML" if isinstance(error, yaml.YAMLError) else error
        raise InputError(f"sidecar {found.name} cannot be read ({words}); correct the sidecar") from error


def _from_inf(text: str) -> dict[str, Any]:
    """Return what the lines of HAL say, by the names that other sidecars have."""
    lines = (line.partition("=") for line in text.splitlines())
    stated = {name.strip(): value.strip() for name, _, value in lines if value.strip() not in ("", "NA")}
    content: dict[str, Any] = {ours: stated.get(name) for ours, name in _NAMES_IN_INF.items()}
    size = re.fullmatch(r"(\d+) x (\d+)", stated.get("frame dimensions", ""))  # columns x rows
    if size:
        content["shape"] = [int(stated.get("number of frames", 0)), int(size[2]), int(size[1])]
    if kind := re.match(r"(8|16) bit integers \(binary, (big|little) endian\)", stated.get("data type", "")):
        content |= {"dtype": f"uint{kind[1]}", "byte_order": kind[2]}
    return content


class RawReader(ContiguousReader):
    """Frames as plain bytes: header, then frames of rows, each followed by padding."""

    format_name = "raw"
    suffixes: ClassVar[tuple[str, ...]] = (".raw", ".bin", ".dat", ".dax")

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        side = _read_sidecar(path)
        facts = {name: getattr(settings, name, None) for name in _Sidecar.model_fields}
        facts = {name: getattr(side, name) if value is None else value for name, value in facts.items()}
        if facts["packing"] is not None:
            if extra := [name for name in ("dtype", "offset", "byte_order") if facts[name] is not None]:
                raise InputError(
                    f"packing {facts['packing']} says what the samples are; remove {' and '.join(extra)} "
                    "from the section input or the sidecar"
                )
            depth = facts["bit_depth"] or PACKINGS[facts["packing"]].bits
            facts |= {"dtype": "uint16", "bit_depth": depth}
        if facts["shape"] is None or facts["dtype"] is None:
            missing = " and ".join(f"input.{name}" for name in ("shape", "dtype") if facts[name] is None)
            raise InputError(f"raw frames need {missing}; set this, or write a sidecar {path.name}.json")
        self.bit_shift = facts["bit_shift"] or 0
        self.take_facts(*facts_from_names({**side.model_dump(), "bit_depth": facts["bit_depth"]}))
        self._lay_out(path, facts)

    def _lay_out(self, path: Path, facts: dict[str, Any]) -> None:
        shape, header, padding = facts["shape"], facts["header_bytes"] or 0, facts["frame_padding_bytes"] or 0
        if len(shape) not in (2, 3) or min(shape) < 1 or header < 0 or padding < 0:
            raise InputError(
                f"shape {list(shape)}, header_bytes {header}, frame_padding_bytes {padding} are invalid; "
                "shape is [rows, columns] or [frames, rows, columns]; correct the sidecar"
            )
        self.byte_order = facts["byte_order"] or "little"
        stored = np.dtype(facts["dtype"])
        if facts["offset"] is not None:
            stored = np.dtype(f"i{stored.itemsize}")
        offset = check_samples(stored, InputSettings(offset=facts["offset"]))
        stored = stored.newbyteorder(self.byte_order)
        rows, columns = shape[-2:]
        packing, what = PACKINGS.get(facts["packing"]), "packing" if facts["packing"] else "dtype"
        layout = Layout(np.empty(0, np.int64), rows, columns, stored, offset, packing)
        if packing is not None and rows * columns % len(packing.places):
            raise InputError(
                f"frames of {rows} x {columns} samples are no whole bytes as {facts['packing']} (groups of "
                f"{len(packing.places)}); correct input.shape or input.packing"
            )
        frame = layout.frame_bytes
        step = frame + padding
        size = self.size
        whole, rest = divmod(size - header, step) if size >= header else (0, size)
        if rest == frame:  # the padding of the last frame may be missing
            whole, rest = whole + 1, 0
        n = shape[0] if len(shape) == 3 else whole
        if len(shape) == 2 and (rest or whole == 0):
            raise InputError(
                f"truncated, or not {rows} x {columns} {facts[what]}: {size} bytes = header of {header} + "
                f"{whole} frames of {step} + {rest}; copy the file again, or correct input.shape, "
                f"input.{what}, input.header_bytes or input.frame_padding_bytes"
            )
        if n < whole:
            self.notes = (f"has {whole} frames; the first {n} are used (shape)",)
        offsets = even_offsets(n, frame, size, start=header, step=step)
        self.set_layout(replace(layout, offsets=offsets))
        if packing is not None:
            self._check_packing(facts["packing"])

    def _check_packing(self, name: str) -> None:
        """Refuse samples that change far less from frame to frame with their bytes read in another order."""
        layout, steps = self._layout, {}
        for other, packing in PACKINGS.items():
            if packing[:2] == PACKINGS[name][:2]:
                self._layout = replace(layout, packing=packing)
                some = self.read(0, min(self.shape[0], 8), 0, min(self.shape[1], 64)).astype(np.int64)
                steps[other] = int(np.abs(np.diff(some, axis=0)).sum())
                if other == name and not (some & 15).any():
                    steps[other] = 0  # left-justified: smaller in another order
        self._layout = layout
        best = min(steps, key=lambda each: steps[each])
        if steps[name] > _CLEARLY * steps[best]:
            raise InputError(f"the samples look like {best}; correct input.packing")


def write_frames(path: Path, blocks: Iterator[NDArray[Any]], stack: StackFacts) -> None:
    """Write frames as bytes, with a sidecar ``<path>.json``; see `frames.writing.write_frames`."""
    write_plain(path, b"", blocks, stack.dtype.newbyteorder("<"))
    record: dict[str, Any] = {"shape": stack.shape, "dtype": stack.dtype.name}
    record |= {"byte_order": "little", "header_bytes": 0, **stack.stated}
    write_atomic(path.with_name(path.name + ".json"), (json.dumps(record) + "\n").encode())
