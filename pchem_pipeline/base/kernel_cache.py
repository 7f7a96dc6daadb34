"""The cache of compiled kernels on disk: a file for each state of the source, processor and types.

numba's own cache looks at the file of a function alone, though the code of all functions that it calls is in
it, and its index loses entries where several processes write it. Here the name of a file says all that its
content depends on: it is never stale and never changed, it may be written by any process or copied from
elsewhere, and after a change only the kernels that use the changed file are compiled again.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import importlib.util
import os
import pickle
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from filelock import FileLock

#: Variable of the environment that says: memory is short, for this process and those that it starts.
TIGHT_MEMORY = "PCHEM_TIGHT_MEMORY"

#: Called with the name of a kernel that is missing and None, then with the seconds that it took to have it.
Listener = Callable[[str, float | None], None]
_listeners: list[Listener] = []

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_PATIENCE = 300  # seconds that another process may take for one kernel
_IMPORT = re.compile(r"^(?:from ([\w.]+) import (\([^)]*\)|[^\n]*)|import ([\w.]+))", re.MULTILINE)


@functools.cache
def cache_folder() -> Path:
    """Return the folder of the compiled kernels.

    ``NUMBA_CACHE_DIR`` where it is set, else in the user's cache folder. Where the home is read-only, in
    the folder for temporary files: one that this user alone can write, or else a new one that ends with the
    process.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given)
    from platformdirs import user_cache_path

    folder = user_cache_path("pchem_pipeline") / "kernels"
    if is_writable(folder):
        return folder
    folder = Path(tempfile.gettempdir()) / f"pchem_pipeline-{os.getuid()}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
    try:
        state = folder.lstat()
        if stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & _OTHERS_WRITE:
            return folder
    except OSError:
        pass
    folder = Path(tempfile.mkdtemp(prefix="pchem_pipeline-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def is_writable(folder: Path) -> bool:
    """Return whether files can be made in a folder, which is made where it does not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _own_bytes(path: Path) -> bytes:
    """Read a file that nobody could have written who could not change this program: pickles run code.

    Raises:
        OSError: it cannot be read, or belongs to somebody else, or others may write it.
    """
    with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        state = os.fstat(file.fileno())
        owners = (0, os.getuid(), Path(__file__).stat().st_uid)
        if state.st_uid not in owners or state.st_mode & _OTHERS_WRITE or not stat.S_ISREG(state.st_mode):
            raise PermissionError(f"{path} may be another user's")
        return file.read()


@functools.cache
def source_state(module: str) -> str:
    """Return the hash of the source of a module and of all modules of its package that it imports.

    Only imports at the margin count: those inside functions come too late for kernels.
    """
    found: dict[str, bytes] = {}
    _collect(module, {module.partition(".")[0], __name__.partition(".")[0]}, found)
    return hashlib.sha256(repr(sorted(found.items())).encode()).hexdigest()


def _collect(name: str, packages: set[str], found: dict[str, bytes]) -> None:
    """Add the hash of a module's source, and those of what it imports from the packages."""
    file = getattr(sys.modules.get(name), "__file__", None)
    if name in found or file is None or name.partition(".")[0] not in packages:
        return
    source = Path(file).read_bytes()
    found[name] = hashlib.sha256(source).digest()
    for imported in _imports(name, source.decode()):
        _collect(imported, packages, found)


def _imports(name: str, source: str) -> Iterator[str]:
    """Yield the names of modules, and of what may be modules, that a source imports."""
    package = sys.modules[name].__package__ or ""
    for origin, names, plain in _IMPORT.findall(source):
        if plain:
            yield plain
            continue
        base = importlib.util.resolve_name(origin, package) if origin.startswith(".") else origin
        yield base
        yield from (f"{base}.{word}" for word in re.findall(r"\w+", names))


@contextlib.contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Call a function for each kernel that is compiled meanwhile, here or by another process."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def values_of_closure(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return in words what a function made by another function was given: numbers, text, kernels."""
    values = [cell.cell_contents for cell in function.__closure__ or ()]
    return tuple(_words(value) for value in values)


def _words(value: Any) -> str:
    function = getattr(value, "py_func", value)
    if callable(function):
        return f"{function.__module__}.{function.__qualname__}{values_of_closure(function)}"
    return repr(value)


class KernelCache:
    """The compiled variants of one kernel: what numba's dispatchers ask of a cache."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._locks: dict[Path, FileLock] = {}
        self._begun = 0.0

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(cache_folder())

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the kernel for some types, or None where the caller is to compile it.

        What another process is compiling is waited for.
        """
        target_context.refresh()
        path = self._path(signature, target_context.codegen())
        found = self._read(path, target_context)
        if found is not None:
            return found
        self._begun = time.monotonic()
        self._report(None)
        if self._lock(path, _PATIENCE):
            found = self._read(path, target_context)
            if found is not None:
                self._unlock(path)
                self._report(time.monotonic() - self._begun)
        return found

    def _report(self, seconds: float | None) -> None:
        for listener in _listeners:
            listener(self._function.__name__, seconds)

    def save_overload(self, signature: Any, result: Any) -> None:
        """Write a compiled kernel to its file, whole or not at all, and release its lock."""
        from numba.core.serialize import dumps

        codegen = result.library.codegen
        for environment in result._find_referenced_environments():  # of the kernels that it calls
            codegen.set_env(environment.env_name, environment)
        path = self._path(signature, codegen)
        try:
            if not result.library.has_dynamic_globals:
                _write(path, dumps(result._reduce()))
        finally:
            self._unlock(path)
            self._report(time.monotonic() - self._begun)

    def _path(self, signature: Any, codegen: Any) -> Path:
        import llvmlite
        import numba

        function = self._function
        code = function.__code__
        content = (
            (function.__qualname__, code.co_firstlineno, code.co_code, code.co_names),
            values_of_closure(function),
            [_description(each) for each in getattr(signature, "args", signature)],
            str(getattr(signature, "return_type", None)),
            codegen.magic_tuple(),
            (sys.version_info[:3], numba.__version__, llvmlite.__version__),
        )
        digest = hashlib.sha256(repr(content).encode()).hexdigest()[:32]
        return cache_folder() / f"{self._stem()}-{digest}.nbc"

    def _stem(self) -> str:
        """Return how the names of its files begin: the name of the kernel and the state of its source."""
        module, name = self._function.__module__, self._function.__qualname__
        words = re.sub(r"\W+", "_", f"{module.rpartition('.')[2]}.{name}")
        return f"{words}-{source_state(module)[:32]}"

    def _read(self, path: Path, target_context: Any) -> Any:
        """Return what a file holds; None where there is none, or a damaged one."""
        from numba.core.compiler import CompileResult

        try:
            payload = pickle.loads(_own_bytes(path))
        except (OSError, EOFError, pickle.UnpicklingError):
            return None
        return CompileResult._rebuild(target_context, *payload)

    def _lock(self, path: Path, patience: float) -> bool:
        """Lock a kernel that is to be compiled; return False if that fails or another holds it too long."""
        from filelock import FileLock, Timeout

        lock = FileLock(path.with_suffix(".lock"), timeout=patience)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except (OSError, Timeout):
            return False
        self._locks[path] = lock
        return True

    def _unlock(self, path: Path) -> None:
        lock = self._locks.pop(path, None)
        if lock is not None:
            with contextlib.suppress(OSError):
                path.with_suffix(".lock").unlink(missing_ok=True)
            lock.release()

    def flush(self) -> None:
        """Nothing to do: a file is never stale."""


def _description(kind: Any) -> str:
    """Return a type in words that are the same in every process; named tuples also by their class."""
    own = getattr(kind, "instance_class", None)
    parts = [_description(part) for part in getattr(kind, "types", ())]
    return f"{kind}" if own is None else f"{own.__module__}.{own.__qualname__}{own._fields}{parts}"


def _write(path: Path, content: bytes) -> None:
    """Write a file in one step; where the disk is full or read-only, the next process compiles again."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            Path(name).replace(path)
        except OSError:
            Path(name).unlink(missing_ok=True)
            raise
