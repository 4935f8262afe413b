"""The database of a drift control: SQLite in one file, or PostgreSQL by URL. One transaction holds all or nothing."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import exc

from robcal.errors import InvalidInput
from robcal.files.storage import StorageError

LOCK_SECONDS = 30
METADATA = sa.MetaData()
_ID = sa.BigInteger().with_variant(sa.Integer, "sqlite")
META = sa.Table(
    "drift_meta", METADATA, sa.Column("key", sa.String, primary_key=True), sa.Column("value", sa.LargeBinary)
)
FILES = sa.Table(
    "drift_file",
    METADATA,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("name", sa.String, nullable=False),
    sa.Column("sha256", sa.String, nullable=False, index=True),
    sa.Column("taken_at", sa.String, nullable=False),
    sa.Column("rows", sa.Integer, nullable=False),
    sa.Column("added", sa.Integer, nullable=False),
    sa.Column("program", sa.String, nullable=False),
)
READINGS = sa.Table(
    "drift_reading",
    METADATA,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("cycle", sa.BigInteger, nullable=False),
    sa.Column("pose", sa.String, nullable=False),
    sa.Column("target", sa.BigInteger, nullable=False),
    sa.Column("time_s", sa.Float(53), nullable=False),
    sa.Column("content", sa.JSON, nullable=False),
    sa.Column("use", sa.String, nullable=False, index=True),
    sa.Column("tour", _ID, index=True),
    sa.Column("file", _ID, nullable=False),
    sa.UniqueConstraint("cycle", "pose", "target"),
)
TOURS = sa.Table(
    "drift_tour",
    METADATA,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("cycle", sa.BigInteger, nullable=False),
    sa.Column("time_s", sa.Float(53), nullable=False),
    sa.Column("version", sa.Integer),
    sa.Column("uncorrected_mm", sa.Float(53), nullable=False),
    sa.Column("corrected_mm", sa.Float(53), nullable=False),
    sa.Column("residual_mm", sa.Float(53), nullable=False),
    sa.Column("noise", sa.Float(53), nullable=False),
    sa.Column("rejected", sa.JSON, nullable=False),
    sa.Column("temperatures", sa.JSON, nullable=False),
    sa.Column("targets_mm", sa.JSON, nullable=False),
)
MODELS = sa.Table(
    "drift_model",
    METADATA,
    sa.Column("version", sa.Integer, primary_key=True),
    sa.Column("cycle", sa.BigInteger, nullable=False),
    sa.Column("time_s", sa.Float(53), nullable=False),
    sa.Column("change", sa.LargeBinary, nullable=False),
    sa.Column("covariance", sa.LargeBinary, nullable=False),
    sa.Column("tour", _ID),
    sa.Column("made_at", sa.String, nullable=False),
    sa.Column("program", sa.String, nullable=False),
)
IN_FORCE = sa.Table(
    "drift_in_force",
    METADATA,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("cycle", sa.BigInteger, nullable=False, index=True),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("reason", sa.String, nullable=False),
)
ALARMS = sa.Table(
    "drift_alarm",
    METADATA,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("cycle", sa.BigInteger, nullable=False),
    sa.Column("time_s", sa.Float(53), nullable=False),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("text", sa.String, nullable=False),
)

_REMEDIES = (
    ("locked", "another process works with it: run again, nothing was taken in"),
    ("disk is full", "the disk is full: free some space and run again, nothing was taken in"),
    ("disk i/o error", "the disk is full or broken: free some space and run again, nothing was taken in"),
    ("readonly", "it is write-protected: change its rights, nothing was taken in"),
    ("unable to open", "it cannot be opened: check folder and rights"),
    ("malformed", "it is damaged: restore it from a copy"),
    ("not a database", "it is no state of a drift control: name the one that 'pipeline drift init' made"),
    ("no such table", "it is no state of a drift control: name the one that 'pipeline drift init' made"),
    ("does not exist", "there is no such state: make it with 'pipeline drift init'"),
    ("connect", "the database server does not answer: start it and run again, nothing was lost"),
)


def database_url(place: Path | str) -> str:
    """URL of a state: one that is given (also where a path has swallowed its second slash), or a file's."""
    text = str(place)
    given = re.match(r"^([a-z]\w*(?:\+\w+)?):/{1,2}(?!/)(.*)$", text)
    if given and given[1] != "sqlite":
        scheme = "postgresql+psycopg" if given[1] in ("postgresql", "postgres") else given[1]
        return f"{scheme}://{given[2]}"
    return f"sqlite:///{state_file(Path(text)).absolute()}"


def state_file(place: Path) -> Path:
    """The file of a state: the one named, or drift.db in the folder that is named."""
    return place / "drift.db" if place.is_dir() else place


def is_drift(place: Path | str) -> bool:
    """Whether a place holds the state of a drift control (and not a run)."""
    if re.match(r"^[a-z]\w*(\+\w+)?:/", str(place)):
        return True
    try:
        with state_file(Path(place)).open("rb") as stream:
            return stream.read(15) == b"SQLite format 3"
    except OSError:
        return False


@contextmanager
def transaction(place: Path | str, *, make: bool = False) -> Iterator[sa.Connection]:
    """A connection whose changes are all kept when the block ends well, and none when it does not.

    Raises
    ------
    InvalidInput : there is no state. StorageError : the database is locked, full, gone.
    """
    url = database_url(place)
    name = sa.engine.make_url(url).render_as_string(hide_password=True)
    local = url.startswith("sqlite")
    if local:
        file = state_file(Path(place))
        name = str(file)
        if not make and not file.is_file():
            raise InvalidInput(f"{file}: there is no such state: make it with 'pipeline drift init'")
        if make:
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise StorageError(f"{file.parent}: cannot be made: {error.strerror or error}") from None
    with _transaction(url, name) as connection:
        yield connection


@contextmanager
def database_transaction(place: str, what: str) -> Iterator[sa.Connection]:
    """A transaction on a database of another kind (``what`` for messages), made where it is not there.

    Raises
    ------
    StorageError : the database is locked, full, gone.
    """
    given = re.match(r"^[a-z]\w*(\+\w+)?:/", place)
    url = place if place.startswith("sqlite:") else database_url(place)
    if not given:
        file = Path(place)
        if file.is_dir():
            raise InvalidInput(f"{file}: is a folder: name a file for the {what}")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"{file.parent}: cannot be made: {error.strerror or error}") from None
        url = f"sqlite:///{file.absolute()}"
    with _transaction(url, sa.engine.make_url(url).render_as_string(hide_password=True)) as connection:
        yield connection


@contextmanager
def _transaction(url: str, name: str) -> Iterator[sa.Connection]:
    local = url.startswith("sqlite")
    arguments: dict[str, Any] = {"timeout": LOCK_SECONDS} if local else {"connect_timeout": LOCK_SECONDS}
    try:
        engine = sa.create_engine(url, poolclass=sa.NullPool, connect_args=arguments)
        if local:
            _exclusive(engine)
        with engine.begin() as connection:
            yield connection
    except exc.NoSuchModuleError:
        raise InvalidInput(f"{name}: databases are SQLite files or postgresql://user@host/name") from None
    except ModuleNotFoundError as error:
        remedy = "install robcal[postgresql], or name a file"
        raise InvalidInput(f"{name}: the driver of this database is not installed ({error.name}): {remedy}") from None
    except exc.ArgumentError as error:
        raise InvalidInput(f"{name}: cannot be used as a database: {error}") from None
    except exc.DBAPIError as error:
        raise StorageError(f"{name}: {_remedy(str(error.orig))}") from None


def _exclusive(engine: sa.Engine) -> None:
    # sqlite3 begins transactions late and ends them at a table's making: begin them ourselves, as writers at once
    @sa.event.listens_for(engine, "connect")
    def _own_transactions(connection: Any, _: Any) -> None:
        connection.isolation_level = None
        connection.execute("PRAGMA synchronous=FULL")

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def _remedy(message: str) -> str:
    text = " ".join(message.split())
    return next((remedy for sign, remedy in _REMEDIES if sign in text.lower()), text[:200])
