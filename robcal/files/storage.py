"""Reading and writing whole files: guarded reading, atomic writing, hashes; operating system errors in plain words."""

import errno
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from robcal.errors import InvalidInput, RobcalError


class StorageError(RobcalError):
    """A result cannot be written: full disk, no permission, a file where a folder should be."""


_REMEDIES = {
    errno.ENOSPC: "the disk is full: free some space and run again, finished stages are kept",
    errno.EFBIG: "the file grows beyond what this process may write (ulimit -f): raise the limit and run again",
    errno.EDQUOT: "the disk quota is used up: free some space and run again, finished stages are kept",
    errno.EACCES: "no permission: choose another folder with --out or change its rights",
    errno.EPERM: "no permission: choose another folder with --out or change its rights",
    errno.EROFS: "the file system is read-only: choose another folder with --out",
    errno.ENOTDIR: "a file stands where a folder is needed: choose another folder with --out",
    errno.EEXIST: "a file stands where a folder is needed: choose another folder with --out",
}


def in_plain_words(error: OSError) -> str:
    """What the operating system says, with a remedy where there is one."""
    return _REMEDIES.get(error.errno or 0, error.strerror or str(error))


def storage_error(path: Path, error: OSError) -> StorageError:
    """The error to raise when the operating system refuses to write ``path``."""
    return StorageError(f"{path}: cannot be written: {in_plain_words(error)}")


def read_bytes(path: Path, limit: int) -> bytes:
    """Content of a file that a person gave.

    Raises
    ------
    InvalidInput : missing, a folder, unreadable, or larger than ``limit`` bytes.
    """
    try:
        if not path.exists():
            raise InvalidInput(f"{path}: no such file: check the name, it is relative to the file that mentions it")
        if not path.is_file():
            raise InvalidInput(f"{path}: is a folder or a device, a file is needed")
        size = path.stat().st_size
        if size > limit:
            raise InvalidInput(f"{path}: has {size / 1e6:.0f} MB, such a file may have {limit / 1e6:.0f} MB at most")
        return path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read: {error.strerror or error}") from None


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            for block in iter(lambda: stream.read(1 << 20), b""):
                digest.update(block)
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read: {error.strerror or error}") from None
    return digest.hexdigest()


def write_atomic(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that it is either complete or not there: a temporary file beside it, flushed, then renamed.

    Raises
    ------
    StorageError : the operating system refuses.
    """
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
        with os.fdopen(handle, "wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise storage_error(path, error) from None
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically; file names that are no text (bytes of another encoding) are spelt out."""
    write_atomic(path, lambda stream: stream.write(text.encode("utf-8", "backslashreplace")))
