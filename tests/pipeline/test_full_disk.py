"""A disk that is full: one sentence, nothing half, and the same command goes on once there is space."""

from __future__ import annotations

import errno
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from pipeline.command_line import answers
from robcal.files.storage import StorageError, write_atomic


@pytest.fixture
def little_room() -> Iterator[None]:
    """Files of this process may grow to 10 kB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_nothing_half_is_left(tmp_path: Path, little_room: None) -> None:
    path = tmp_path / "result.json"
    write_atomic(path, lambda stream: stream.write(b"old"))
    with pytest.raises(StorageError, match=r"result\.json: cannot be written: the file grows beyond"):
        write_atomic(path, lambda stream: stream.write(b"x" * 100_000))
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_an_error_of_the_system_is_one_sentence_with_a_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended, answers("run", False, True):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert ended.value.exit_code == 1
    assert capsys.readouterr().err == (
        "error: the disk is full: free some space and run again, finished stages are kept\n"
    )
