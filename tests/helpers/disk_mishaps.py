"""A disk that fails at a chosen operation, and one that forgets at a power cut what was not yet synced."""

import os
import shutil
from pathlib import Path

from pchem_pipeline.store import disk

CHANGES = ("make_folder", "write", "replace", "remove", "remove_tree")
SYNCS = ("sync_file", "sync_folder", "sync_all")


class FailingDisk:
    """Lets the n-th operation fail once, with an error of the operating system; counts all."""

    def __init__(self, monkeypatch, operations=(*CHANGES, *SYNCS)):
        self.count, self.at, self.number = 0, None, 0
        for name in operations:
            monkeypatch.setattr(disk, name, self._failing(name, getattr(disk, name)))

    def fail(self, at, number):
        """Let operation ``at`` (from now on, 0 the next) fail with this errno; None: none."""
        self.count, self.at, self.number = 0, at, number

    def _failing(self, name, operation):
        def call(*arguments):
            now, self.count = self.count, self.count + 1
            if now == self.at:
                if name == "write":  # a half file stays
                    arguments[0].write_bytes(bytes(arguments[1])[: len(arguments[1]) // 2])
                raise OSError(self.number, os.strerror(self.number))
            return None if name in SYNCS else operation(*arguments)  # they cost time only

        return call


class ForgetfulDisk:
    """Writes down what changes and what is synced, to build the disk as a power cut leaves it."""

    def __init__(self, monkeypatch):
        self.log = []
        for name in (*CHANGES, *SYNCS):
            monkeypatch.setattr(disk, name, self._noted(name, getattr(disk, name)))

    def _noted(self, name, operation):
        def call(*arguments):
            result = None if name in SYNCS else operation(*arguments)
            self.log.append(
                (name, *arguments) if name != "write" else (name, arguments[0], bytes(arguments[1]))
            )
            return result

        return call

    def after_power_cut(self, end, rng, honest=True):
        """Return the files (path -> content) where the power is cut behind ``end`` operations.

        What came before the last ``sync_all`` is there. Of what came later, each change of names is there or
        not, in any order, and a content that was not synced is whole, cut, or empty. A disk that is not
        ``honest`` forgets what it was told to keep.
        """
        log = self.log[:end]
        barriers = [i for i, entry in enumerate(log) if entry[0] == "sync_all"] if honest else []
        sure = barriers[-1] if barriers else -1
        files, synced, kept = {}, set(), self._kept(log) if honest else set()
        for i, (name, *arguments) in enumerate(log):
            path = arguments[0]
            if name == "sync_file" and honest:
                synced.add(path)
            elif name not in CHANGES or (
                i > sure and i not in kept and rng.random() < 0.5 and name != "write"
            ):
                continue
            elif name == "write":
                data = arguments[1]
                whole = i <= sure or any(
                    entry[:2] == ("sync_file", path) for entry in (log[i:] if honest else ())
                )
                files[path] = data if whole else _what_is_left(data, rng)
            elif name == "replace":
                if path in files:
                    files[arguments[1]] = files.pop(path)
            elif name == "remove":
                files.pop(path, None)
            elif name == "remove_tree":
                for other in [each for each in files if path in each.parents]:
                    if i <= sure or i in kept or rng.random() < 0.7:
                        del files[other]
        return files

    def _kept(self, log):
        """Return the numbers of changes of names in folders that were synced later."""
        kept = set()
        for i, (name, *arguments) in enumerate(log):
            if name in ("replace", "remove"):
                folder = arguments[-1].parent
                if any(entry[0] == "sync_folder" and entry[1] == folder for entry in log[i:]):
                    kept.add(i)
        return kept


def _what_is_left(data, rng):
    """Return a content that was not synced: blocks of 4096 bytes are there or not, or are zeros."""
    kept = [0, len(data)] if len(data) <= 4096 else [0, 4096 * (len(data) // 8192), len(data)]
    data = data[: int(rng.choice(kept))]
    return bytes(len(data)) if rng.random() < 0.2 else data


def materialised(files, old, new):
    """Write files to the folder ``new`` as they would be in ``old``; return it."""
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    for path, content in files.items():
        target = new / Path(path).relative_to(old)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
    return new
