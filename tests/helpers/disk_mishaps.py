"""A disk that fails at a chosen operation, and one that forgets at a power cut what was not yet synced."""

import os
import shutil
from pathlib import Path

from pchem_pipeline.store import disk

CHANGES = ("make_folder", "write", "replace", "remove", "remove_tree")
SYNCS = ("sync_file", "sync_folder")


class FailingDisk:
    """Lets the n-th operation fail once, with an error of the operating system; counts all."""

    def __init__(self, monkeypatch):
        self.count, self.at, self.number = 0, None, 0
        for name in (*CHANGES, *SYNCS):
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
    """Writes down what changes and what is synced, by whole paths: the disk as a power cut leaves it."""

    def __init__(self, monkeypatch):
        self.log = []
        self._known = set()
        for name in (*CHANGES, *SYNCS):
            monkeypatch.setattr(disk, name, self._noted(name, getattr(disk, name)))

    def _noted(self, name, operation):
        def call(*given):
            arguments = [each.absolute() if isinstance(each, Path) else each for each in given]
            entry = (name, *arguments)
            if name == "make_folder":
                above = [arguments[0], *arguments[0].parents]
                entry = (*entry, [folder for folder in above if not folder.exists()])
            elif name == "write":
                entry = (name, arguments[0], bytes(arguments[1]))
                self._known.add(arguments[0])
            elif name == "sync_file" and arguments[0] not in self._known:  # a library wrote it
                self.log.append(("write", arguments[0], arguments[0].read_bytes()))
            elif name == "replace":
                self._known.add(arguments[1])
            result = None if name in SYNCS else operation(*arguments)
            self.log.append(entry)
            return result

        return call

    def after_power_cut(self, end, rng, before=None):
        """Return the files (path -> content) where the power is cut behind ``end`` operations.

        ``before`` are those that were on the disk already.

        Each change of names in a folder that was not synced later is there or not, in any order; so is what
        lies in a new folder whose own name was not. A content that was not synced is whole, cut, or empty.
        """
        log = self.log[:end]
        files, kept, lost = dict(before or {}), self._kept(log), []
        for i, (name, *arguments) in enumerate(log):
            path = arguments[0]
            if name not in CHANGES or (
                i not in kept and rng.random() < 0.5 and name not in ("write", "make_folder")
            ):
                continue
            if name == "make_folder":
                lost += [
                    folder
                    for folder in arguments[1]
                    if ("sync_folder", folder.parent) not in log[i:] and rng.random() < 0.2
                ]
            elif name == "write":
                data = arguments[1]
                files[path] = data if _is_synced(log[i:]) else _what_is_left(data, rng)
            elif name == "replace":
                if path in files:
                    files[arguments[1]] = files.pop(path)
            elif name == "remove":
                files.pop(path, None)
            elif name == "remove_tree":
                for other in [each for each in files if path in each.parents]:
                    if i in kept or rng.random() < 0.7:
                        del files[other]
        return {path: data for path, data in files.items() if not set(lost) & set(path.parents)}

    def _kept(self, log):
        """Return the numbers of changes of names in folders that were synced later."""
        return {
            i
            for i, (name, *arguments) in enumerate(log)
            if name in ("replace", "remove", "remove_tree")
            and ("sync_folder", arguments[-1].parent) in log[i:]
        }


def _is_synced(log):
    """Tell whether the file that the first entry writes is synced later, under whatever name it has then."""
    names = {log[0][1]}
    for name, *arguments in log[1:]:
        if name == "sync_file" and arguments[0] in names:
            return True
        if name == "replace":
            names = names | {arguments[1]} if arguments[0] in names else names - {arguments[1]}
    return False


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
