"""Paths of an object storage (``s3://bucket/run.zarr``, what else fsspec knows), used like those of a disk.

What a run does to its small files beside the arrays is a handful of operations; here each is one request of
fsspec. An object appears whole or not at all, so a put takes the place of writing aside and renaming.

Not universal_pathlib: it asks S3 four times for a glob and twice for a listing or an unlink, where this asks
once, and its errors, which differ by storage, would have to be made one line all the same.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Generator
from fnmatch import fnmatchcase
from pathlib import Path, PosixPath, PurePosixPath
from typing import TYPE_CHECKING, Any, NoReturn, Self, TypeVar, cast

from pchem_pipeline.base.errors import ConfigError, MissingDependencyError, StoreError, install_hint
from pchem_pipeline.base.settings import NO_SECRETS, holds_secret

F = TypeVar("F", bound=Callable[..., Any])

# Path makes one slash of two; no storage has a dot in its name, but file.h5:/dataset has
_URL = re.compile(r"^([a-z][a-z0-9+-]+):/+(.*)$", re.DOTALL)


class RemoteError(StoreError, OSError):
    """The object storage refused, or did not answer."""

    __str__ = StoreError.__str__


class UndefinedError(StoreError, AttributeError):
    """A method of paths that an object storage has not."""

    __str__ = StoreError.__str__


def refused(where: object, error: BaseException) -> RemoteError:
    """Translate an error of an object storage into one line with its cure."""
    words = " ".join(str(error).split()) or type(error).__name__
    return RemoteError(f"{where}: object storage error ({words}); check address, keys and network")


def place_of(path: Path | str, base_dir: Path | None = None) -> Path:
    """Return a path below a folder, or a `RemotePath` for a URL, also one that went through ``Path``.

    Raises:
        ConfigError: the URL holds a secret.
    """
    if isinstance(path, RemotePath):
        return path
    if _URL.match(str(path)):
        if holds_secret(str(path)):
            raise ConfigError(NO_SECRETS)
        return RemotePath(path)
    return Path(path) if base_dir is None else base_dir / path


def local_path(path: Path) -> Path:
    """Return a path to which this machine alone can write: a URL would be one of its folders, called s3:.

    Raises:
        ConfigError: it is a URL.
    """
    place = place_of(path)
    if isinstance(place, RemotePath):
        raise ConfigError(f"{place}: only stores can be in an object storage; give a local path")
    return place


def _asked(method: F) -> F:
    """Turn errors of the storage into FileNotFoundError, or into one line with the cure."""

    @functools.wraps(method)
    def ask(self: RemotePath, *args: Any, **kwargs: Any) -> Any:
        try:
            return method(self, *args, **kwargs)
        except (FileNotFoundError, FileExistsError, StoreError, MissingDependencyError):
            raise
        except Exception as error:  # each kind of storage has errors of its own
            raise refused(self, error) from error

    return cast("F", ask)


if TYPE_CHECKING:
    _Pure = PosixPath  # it stands where a Path is expected
else:
    _Pure = PurePosixPath


class RemotePath(_Pure):
    """A place in an object storage. Folders are but names with something below them.

    A method of ``Path`` that is not here does not exist: nothing falls through to the disk of this machine.
    Keys and the address of the server come from where the storage's library looks for them.
    """

    def __str__(self) -> str:
        """Return the URL."""
        return _URL.sub(r"\1://\2", super().__str__())

    def __fspath__(self) -> NoReturn:
        """Refuse, with a TypeError, to be a path of this machine."""
        raise TypeError(f"{self} is not a local path")

    @property
    def storage(self) -> Any:
        """The file system of fsspec; nothing that it lists is kept, since others write, too.

        Raises:
            MissingDependencyError: the library of that kind of storage is not installed.
        """
        return _storage(str(self).partition("://")[0])

    def resolve(self, strict: bool = False) -> Self:
        """Return the path itself: it is absolute."""
        return self

    absolute = resolve

    @_asked
    def exists(self, **unused: Any) -> bool:
        """Return whether there is an object or a folder of that name."""
        return bool(self.storage.exists(str(self)))

    @_asked
    def is_dir(self, **unused: Any) -> bool:
        """Return whether something lies below that name."""
        return bool(self.storage.isdir(str(self)))

    @_asked
    def is_file(self, **unused: Any) -> bool:
        """Return whether there is an object of that name."""
        return bool(self.storage.isfile(str(self)))

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing: folders come with what is in them."""

    @_asked
    def iterdir(self) -> Generator[Self, None, None]:
        """Return what lies directly below."""
        try:
            names = self.storage.ls(str(self), detail=False)
        except FileNotFoundError:
            names = []
        return (self / name.rstrip("/").rpartition("/")[2] for name in names)

    def glob(self, pattern: str, **unused: Any) -> Generator[Self, None, None]:
        """Return what lies directly below and has a name like the pattern."""
        return (path for path in self.iterdir() if fnmatchcase(path.name, pattern))

    @_asked
    def read_bytes(self) -> bytes:
        """Return the content of the object."""
        return bytes(self.storage.cat_file(str(self)))

    def read_text(self, encoding: str | None = None, errors: str | None = None, *unused: Any) -> str:
        """Return the content of the object as text."""
        return self.read_bytes().decode(encoding or "utf-8", errors or "strict")

    @_asked
    def write_bytes(self, data: Any) -> int:
        """Put an object in the place of an older one."""
        content = bytes(data)
        self.storage.pipe_file(str(self), content)
        return len(content)

    @_asked
    def create_bytes(self, data: bytes) -> None:
        """Put an object where there is none, which of several that try at once only one can.

        Raises:
            FileExistsError: there is one.
        """
        try:
            self.storage.pipe_file(str(self), data, mode="create")
        except Exception as error:
            if "NotImplemented" not in f"{type(error).__name__} {error}":
                raise
            if self.exists():  # a server that knows no conditions
                raise FileExistsError(str(self)) from error
            self.write_bytes(data)

    def __getattr__(self, name: str) -> NoReturn:
        """Refuse, with an UndefinedError, what a disk can do and an object storage cannot."""
        if not name.startswith("_") and hasattr(Path, name):
            raise UndefinedError(f"{self}: not possible in an object storage ({name}); use a store on a disk")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @_asked
    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the object."""
        try:
            self.storage.rm_file(str(self))
        except FileNotFoundError:
            if not missing_ok:
                raise

    @_asked
    def remove_folder(self) -> None:
        """Remove all that lies below."""
        if self.storage.exists(str(self)):
            self.storage.rm(str(self), recursive=True)


@functools.cache
def _storage(protocol: str) -> Any:
    import fsspec

    try:
        return fsspec.filesystem(protocol, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise MissingDependencyError(
            f"{protocol}://: this store needs another package ({error}); install it: {install_hint('s3')}"
        ) from error
