"""The run folder: the only place that knows where artifacts lie, whether they are up to date, and who may write.

Every file is written to a temporary name and renamed. A stage is done when its record (``state/<stage>.json``) stands;
the record is written last, so a run killed at any moment resumes with the stage it was in.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from pipeline import codec
from pipeline.artifacts import Artifact
from pipeline.json_io import read_json, write_json
from robcal.errors import InvalidInput, RobcalError
from robcal.files.storage import sha256_of, storage_error

RECORD_FORMAT = "robcal/stage-record-1"
RUN_FORMAT = "robcal/run-1"

T = TypeVar("T")


class RunLocked(RobcalError):
    """Another process works in the run folder."""


@dataclass(frozen=True)
class StageRecord:
    """What a finished stage left behind.

    Attributes
    ----------
    key : hash of everything the stage depends on; outputs : file name in the run -> its hash.
    result : the stage's part of result.json; notes : sentences about what was left out or assumed.
    """

    stage: str
    key: str
    outputs: Mapping[str, str]
    result: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    seconds: float = 0.0


@dataclass
class Run:
    """A run folder and its artifacts.

    Raises
    ------
    StorageError : from every writing method, when the disk is full or permission is missing.
    """

    folder: Path
    _hashes: dict[str, tuple[int, int, str]] = field(default_factory=dict, repr=False)

    @property
    def report(self) -> Path:
        """report.html"""
        return self.folder / "report.html"

    @property
    def result(self) -> Path:
        """result.json"""
        return self.folder / "result.json"

    @property
    def diagnosis(self) -> Path:
        """diagnosis.json"""
        return self.folder / "diagnosis.json"

    @property
    def next_poses(self) -> Path:
        """Poses that would tell apart what the diagnosis could not."""
        return self.folder / "next_poses.csv"

    @property
    def robot(self) -> Path:
        """robot_calibrated.yaml"""
        return self.folder / "robot_calibrated.yaml"

    @property
    def covariance(self) -> Path:
        """covariance.npz: names, theta, covariance of the calibrated robot."""
        return self.folder / "covariance.npz"

    @property
    def points(self) -> Path:
        """points.csv"""
        return self.folder / "points.csv"

    @property
    def frames(self) -> Path:
        """frames.csv"""
        return self.folder / "frames.csv"

    @property
    def residuals(self) -> Path:
        """residuals.csv"""
        return self.folder / "residuals.csv"

    @property
    def log(self) -> Path:
        """log.txt"""
        return self.folder / "log.txt"

    def contract_files(self) -> tuple[Path, ...]:
        """The files that a run writes for others to read."""
        return (
            self.report,
            self.result,
            self.diagnosis,
            self.next_poses,
            self.robot,
            self.covariance,
            self.points,
            self.frames,
            self.residuals,
            self.log,
        )

    def body(self, name: str) -> Path:
        """bodies/<name>.yaml"""
        return self.folder / "bodies" / f"{_plain(name)}.yaml"

    def camera(self, name: str) -> Path:
        """cameras/<name>.yaml"""
        return self.folder / "cameras" / f"{_plain(name)}.yaml"

    def colmap(self, name: str) -> Path:
        """Folder of a survey's network in COLMAP's text format."""
        return self.folder / "colmap" / _plain(name)

    def artifact(self, artifact: Artifact[Any]) -> Path:
        """cache/<name>.npz: a stage's typed result."""
        return self.folder / "cache" / f"{artifact.name}.npz"

    def save(self, artifact: Artifact[T], value: T) -> Path:
        """Store a typed result; returns its path."""
        path = self.artifact(artifact)
        codec.save(path, value)
        return path

    def load(self, artifact: Artifact[T]) -> T:
        """A typed result stored by :meth:`save`.

        Raises
        ------
        InvalidInput : it is not there. StaleCache : it is damaged or of another version of the program.
        """
        found: T = codec.load(self.artifact(artifact))
        return found

    def find(self, artifact: Artifact[T]) -> T | None:
        """A typed result, None where its stage is not done or left none."""
        made = self.record(artifact.stage) is not None and self.artifact(artifact).is_file()
        return self.load(artifact) if made else None

    def record_path(self, stage: str) -> Path:
        """state/<stage>.json"""
        return self.folder / "state" / f"{stage}.json"

    def record(self, stage: str) -> StageRecord | None:
        """The record of a finished stage, None if it is not there or not readable."""
        try:
            data = json.loads(self.record_path(stage).read_text(encoding="utf-8"))
            if data.get("format") != RECORD_FORMAT:
                return None
            return StageRecord(
                data["stage"], data["key"], data["outputs"], data["result"], tuple(data["notes"]), data["seconds"]
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def write_record(self, record: StageRecord) -> None:
        """Store the record of a finished stage: the last thing a stage does."""
        data = {"format": RECORD_FORMAT, **record.__dict__, "notes": list(record.notes)}
        write_json(self.record_path(record.stage), data)

    def forget(self, stage: str) -> None:
        """Remove the record of a stage, so that it runs again."""
        try:
            self.record_path(stage).unlink(missing_ok=True)
        except OSError as error:
            raise storage_error(self.record_path(stage), error) from None

    def remove_stale(self, before: StageRecord | None, after: StageRecord | None) -> None:
        """Remove what an earlier run of a stage wrote and the present one did not."""
        if before is None or after is None:
            return
        for name in set(before.outputs) - set(after.outputs):
            path = (self.folder / name).resolve()
            try:
                if path.is_relative_to(self.folder.resolve()):
                    path.unlink(missing_ok=True)
            except OSError as error:
                raise storage_error(path, error) from None

    def up_to_date(self, stage: str, key: str) -> bool:
        """Whether the stage ran with this key and its outputs are still what it wrote."""
        record = self.record(stage)
        if record is None or record.key != key:
            return False
        for name, digest in record.outputs.items():
            path = self.folder / name
            if not path.is_file() or self.hash(path) != digest:
                return False
        return True

    def outputs(self, paths: Sequence[Path]) -> dict[str, str]:
        """Names and hashes of files of this run."""
        return {path.relative_to(self.folder).as_posix(): self.hash(path) for path in paths}

    def hash(self, path: Path) -> str:
        """SHA-256 of a file; remembered while size and time of change stay the same."""
        try:
            status = path.stat()
        except OSError as error:
            raise InvalidInput(f"{path}: cannot be read: {error.strerror or error}") from None
        name = str(path.resolve())
        known = self._hashes.get(name)
        if known and known[:2] == (status.st_size, status.st_mtime_ns):
            return known[2]
        digest = sha256_of(path)
        self._hashes[name] = (status.st_size, status.st_mtime_ns, digest)
        return digest

    def load_hashes(self) -> None:
        """Take over the hashes remembered by the last run."""
        try:
            data = json.loads((self.folder / "cache" / "hashes.json").read_text(encoding="utf-8"))
            self._hashes.update({name: (int(a), int(b), str(c)) for name, (a, b, c) in data.items()})
        except (OSError, ValueError, TypeError, AttributeError):
            self._hashes.clear()  # only a saving of time is lost

    def save_hashes(self) -> None:
        """Remember hashes for the next run."""
        write_json(self.folder / "cache" / "hashes.json", {k: list(v) for k, v in self._hashes.items()})

    def write_result(self, data: Mapping[str, Any]) -> None:
        """result.json"""
        write_json(self.result, data)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the run folder for this process; released by the system even after kill -9.

        Raises
        ------
        RunLocked : another process holds it.
        """
        lock = FileLock(self.folder / ".lock", timeout=0)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout:
            raise RunLocked(
                f"{self.folder}: another run works in this folder: wait for it, or choose another with --out"
            ) from None
        except OSError as error:
            raise storage_error(self.folder, error) from None
        try:
            yield
        finally:
            lock.release()


def open_run(path: Path) -> Run:
    """The run in a folder.

    Raises
    ------
    InvalidInput : the folder holds no run.
    """
    run = Run(path)
    if not run_file(run).is_file():
        raise InvalidInput(f"{path}: is not a run folder: name the folder that 'pipeline run' wrote (its --out)")
    return run


def is_run(path: Path) -> bool:
    """Whether a folder holds a run."""
    return run_file(Run(path)).is_file()


def campaign_of(run: Run) -> Path:
    """Path of the campaign that a run belongs to."""
    return Path(str(read_json(run_file(run)).get("campaign", "")))


def run_file(run: Run) -> Path:
    """state/run.json: which campaign the run belongs to."""
    return run.folder / "state" / "run.json"


def _plain(name: str) -> str:
    if not name or name in {".", ".."} or any(c in name for c in "/\\\0"):
        raise InvalidInput(f"'{name}' cannot be the name of a body or camera: it names a file, use letters and digits")
    return name
