"""The record of a search, RUN/run.sqlite: every evaluation and recheck, on disk before anything is told of it.

The log is the truth, and all else in the folder can be made again from it. `RunLog` is the one writer: a lock of the
operating system on RUN/run.lock keeps a second one out, and goes with the process that holds it, however that may end.
`read_run` reads, also while the writer writes (SQLite's write-ahead log, so both on one machine).

>>> import tempfile
>>> folder = Path(tempfile.mkdtemp()) / "run"
>>> settings = {"objects": None, "cells": 5, "preset": "draft"}
>>> with RunLog.start(folder, settings=settings, base={}, parameters=(), ranges={"volume_mm3": (0.0, 1.0)}) as log:
...     _ = log.append({"index": 0, "preset": "draft", "status": "ok", "fitness": 0.9, "margin": float("nan")})
...     log.note_told(1)
>>> [(record["index"], record["fitness"], record["margin"]) for record in read_run(folder).records()]
[(0, 0.9, None)]
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any

from finqd.contracts import Parameter
from finqd.errors import InputError
from finqd.provenance import versions as versions_of_simulation
from finqd.run_folder import FILE, locked, new_run_folder, plain, write_whole

if TYPE_CHECKING:
    from ribs.archives import GridArchive

APPLICATION, VERSION = 0x66716472, 1  # what SQLite keeps in the head of the file: finqd's, and the tables' version
REPEATABLE = ("ok", "failed")  # results that follow from the design: a crash or a time limit may not come again

__all__ = ["Run", "RunLog", "begun", "plain", "read_run", "write_whole"]

Record = dict[str, Any]

TABLES = """
CREATE TABLE header (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE versions (id INTEGER PRIMARY KEY, versions TEXT NOT NULL UNIQUE);
CREATE TABLE evaluations (
    number INTEGER NOT NULL, preset TEXT NOT NULL, design_digest TEXT, status TEXT NOT NULL, fitness REAL, margin REAL,
    objective REAL, seconds REAL, versions INTEGER REFERENCES versions, record TEXT NOT NULL,
    PRIMARY KEY (number, preset)
);
CREATE INDEX by_content ON evaluations (design_digest, preset);
CREATE TABLE rechecks (id INTEGER PRIMARY KEY, number INTEGER NOT NULL, record TEXT NOT NULL);
"""


# reading --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """A run as its log has it. Each call reads what the log holds by then.

    settings: what was asked for, and with which versions; base: what all designs share, as `Design.settings`;
    parameters: JSON path and `Parameter` of each entry of a design's vector; ranges: the map's axes, feature -> range
    """

    folder: Path
    settings: Mapping[str, Any]
    base: Mapping[str, Any]
    parameters: tuple[tuple[str, Parameter], ...]
    ranges: Mapping[str, tuple[float, float]]

    def records(self) -> tuple[Record, ...]:
        """Return the evaluations that the search was told, in that order; screened ones hold that as ``screen``."""
        with _opened(self.folder) as connection:
            told = _header(connection, "told") or 0
            return tuple(_told_records(connection, 0, told, self.settings, self.parameters))

    def rechecks(self) -> tuple[Record, ...]:
        """Return the rechecks of elites, in the order in which they were done."""
        with _opened(self.folder) as connection:
            return tuple(json.loads(text) for (text,) in connection.execute("SELECT record FROM rechecks ORDER BY id"))

    def archive(self) -> GridArchive:
        """Return the archive, rebuilt from the records: of each cell the first of the best."""
        return self._archive(self.records())

    def elites(self) -> list[tuple[tuple[int, ...], Record]]:
        """Return grid cell and record of each elite, in the order of the cells."""
        from finqd import archive as qd

        records = self.records()
        return qd.elites(self._archive(records), records)  # type: ignore[return-value]

    def _archive(self, records: Sequence[Record]) -> GridArchive:
        from finqd import archive as qd

        return qd.rebuilt(records, len(self.parameters), self.ranges, cells=self.settings["cells"])


def read_run(folder: Path) -> Run:
    """Return the run in a folder; nothing is written. Raises ``InputError``, one sentence, for what is no run."""
    folder = Path(folder)
    with _opened(folder) as connection:
        return _run(folder, connection)


def begun(folder: Path) -> bool:
    """Return whether a folder holds a log; one that was stopped before its first table was whole is none."""
    path = Path(folder) / FILE
    if not path.is_file() or path.stat().st_size == 0:
        return False
    with _in_words(path), closing(_read_only(path)) as connection:
        return connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] > 0


def _run(folder: Path, connection: sqlite3.Connection) -> Run:
    parameters = tuple((path, Parameter(**values)) for path, values in _header(connection, "parameters"))
    ranges = {name: (low, high) for name, (low, high) in _header(connection, "ranges").items()}
    return Run(folder, _header(connection, "settings"), _header(connection, "base"), parameters, ranges)


@contextmanager
def _opened(folder: Path) -> Iterator[sqlite3.Connection]:
    """Open a log to read it: of finqd, of this version, and with tables."""
    path = folder / FILE
    if not path.is_file():
        raise InputError("holds no run: there is no run.sqlite in it", str(folder))
    with _in_words(path):
        with closing(_read_only(path)) as connection:
            _check_version(connection, path)
            yield connection


def _read_only(path: Path) -> sqlite3.Connection:
    """Return a connection that cannot write. Where not even a shared index can be made, nobody writes either."""
    uri = path.resolve().as_uri()
    connection = sqlite3.connect(f"{uri}?mode=ro", uri=True, timeout=20.0)
    try:
        connection.execute("PRAGMA user_version").fetchone()
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        return connection
    except sqlite3.OperationalError:
        connection.close()
        if path.with_name(f"{FILE}-wal").exists():
            raise
        return sqlite3.connect(f"{uri}?mode=ro&immutable=1", uri=True)


def _check_version(connection: sqlite3.Connection, path: Path) -> None:
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application == 0 and version == 0:
        tables = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        raise InputError("is no log of finqd" if tables else "holds no run yet: it was stopped as it began", str(path))
    if application != APPLICATION:
        raise InputError("is no log of finqd", str(path))
    if version != VERSION:
        text = f"is a log of version {version}, and this finqd reads version {VERSION}; use the finqd that wrote it"
        raise InputError(text, str(path))


def _header(connection: sqlite3.Connection, key: str) -> Any:
    row = connection.execute("SELECT value FROM header WHERE key = ?", (key,)).fetchone()
    return None if row is None else json.loads(row[0])


def _told_records(
    connection: sqlite3.Connection, first: int, end: int, settings: Mapping[str, Any],
    parameters: Sequence[tuple[str, Parameter]],
) -> Iterator[Record]:
    """Yield one record for each evaluation: the confirmed one, with its screening in it, else the screening alone."""
    final = settings.get("confirm") or settings.get("preset")
    waiting: Record | None = None
    for record in _rows(connection, "number >= ? AND number < ? ORDER BY number", (first, end), parameters):
        if waiting is not None and waiting["index"] == record["index"]:
            pair = sorted((waiting, record), key=lambda one: one["preset"] == final)
            waiting = {**pair[1], "screen": pair[0]}
            continue
        if waiting is not None:
            yield waiting
        waiting = record
    if waiting is not None:
        yield waiting


def _rows(
    connection: sqlite3.Connection, where: str, values: Sequence[Any], parameters: Sequence[tuple[str, Parameter]]
) -> Iterator[Record]:
    known = {key: json.loads(text) for key, text in connection.execute("SELECT id, versions FROM versions")}
    for text, key in connection.execute(f"SELECT record, versions FROM evaluations WHERE {where}", tuple(values)):
        record = json.loads(text)
        numbers = record.get("parameters") or []
        if isinstance(numbers, list):
            record["parameters"] = {path: value for (path, _), value in zip(parameters, numbers)}
        yield {**record, "screen": None, "versions": known.get(key, {})}


# writing --------------------------------------------------------------------------------------------------------------


class RunLog:
    """The one writer of a run's log; what is appended is on the disk when the call returns.

    ``run``: as `read_run` returns it. Raises ``InputError`` where there is no run, where another process writes to it,
    and wherever the disk does not take what is appended: what was appended before stays.
    """

    def __init__(self, folder: Path) -> None:
        folder = Path(folder)
        with _opened(folder):
            pass
        self._open(folder, locked(folder))

    @classmethod
    def start(
        cls, folder: Path, *, settings: Mapping[str, Any], base: Mapping[str, Any],
        parameters: Sequence[tuple[str, Parameter]], ranges: Mapping[str, tuple[float, float]],
    ) -> RunLog:
        """Begin a new run in a folder that is new, or empty. Raises ``InputError`` otherwise."""
        folder = new_run_folder(Path(folder))
        log = cls.__new__(cls)
        lock = locked(folder)
        header = {
            "settings": settings, "base": base, "ranges": ranges, "told": 0,
            "parameters": [(path, asdict(parameter)) for path, parameter in parameters],
        }  # fmt: skip
        try:
            with _in_words(folder / FILE), closing(_writable(folder / FILE)) as connection, _transaction(connection):
                for statement in TABLES.split(";"):  # `executescript` would commit each by itself
                    connection.execute(statement)
                rows = [(key, json.dumps(plain(value), allow_nan=False)) for key, value in header.items()]
                connection.executemany("INSERT INTO header VALUES (?, ?)", rows)
                connection.execute(f"PRAGMA application_id = {APPLICATION}")
                connection.execute(f"PRAGMA user_version = {VERSION}")
        except BaseException:
            lock.close()
            raise
        log._open(folder, lock)
        return log

    def _open(self, folder: Path, lock: IO[str]) -> None:
        self._lock, self._path = lock, folder / FILE
        try:
            with _in_words(self._path):
                self._connection = _writable(self._path)
                _check_version(self._connection, self._path)
                self.run = _run(folder, self._connection)
        except BaseException:
            lock.close()
            raise

    @property
    def told(self) -> int:
        """How many evaluations the search was told."""
        with _in_words(self._path):
            return _header(self._connection, "told")

    @property
    def seconds(self) -> float:
        """Seconds of computing that the log knows of: when its last evaluation was finished."""
        with _in_words(self._path):
            row = self._connection.execute("SELECT max(json_extract(record, '$.finished_at')) FROM evaluations")
            return row.fetchone()[0] or 0.0

    def append(self, record: Mapping[str, Any]) -> Record:
        """Write one evaluation, and return it with plain values: numbers that JSON does not know become None."""
        written = plain(record)
        kept = {key: value for key, value in written.items() if key not in ("versions", "screen")}
        if isinstance(kept.get("parameters"), dict):
            kept["parameters"] = list(kept["parameters"].values())  # their paths are in the header
        columns = [kept.get(key) for key in ("design_digest", "status", "fitness", "margin", "objective", "seconds")]
        with _in_words(self._path), _transaction(self._connection):
            self._connection.execute(
                "INSERT INTO evaluations VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (kept["index"], kept["preset"], *columns, self._version_id(written.get("versions", {})),
                 json.dumps(kept, allow_nan=False)),
            )  # fmt: skip
        return written

    def append_recheck(self, row: Mapping[str, Any]) -> None:
        """Write one recheck of an elite; ``index`` is the evaluation's."""
        kept = plain(row)
        with _in_words(self._path), _transaction(self._connection):
            values = (kept["index"], json.dumps(kept, allow_nan=False))
            self._connection.execute("INSERT INTO rechecks (number, record) VALUES (?, ?)", values)

    def note_told(self, count: int) -> None:
        """Note how many evaluations the search was told, counted from the first."""
        self._set("told", count)

    def change_settings(self, settings: Mapping[str, Any]) -> None:
        """Put other settings in the place of those that the run began with: more iterations, other versions."""
        self._set("settings", settings)
        with _in_words(self._path):
            self.run = _run(self._path.parent, self._connection)

    def evaluations(self, first: int, end: int) -> dict[tuple[int, str], Record]:
        """Return what is there of the evaluations ``first`` to ``end - 1``, by index and preset, told or not."""
        with _in_words(self._path):
            rows = _rows(self._connection, "number >= ? AND number < ?", (first, end), self.run.parameters)
            return {(record["index"], record["preset"]): record for record in rows}

    def told_records(self, first: int, end: int) -> list[Record]:
        """Return the records of `Run.records` with these indices, told or not."""
        with _in_words(self._path):
            return list(_told_records(self._connection, first, end, self.run.settings, self.run.parameters))

    def elite_records(self, indices: Sequence[int]) -> list[Record]:
        """Return the final records with these indices."""
        return [record for index in sorted(indices) for record in self.told_records(index, index + 1)]

    def found(
        self, digest: str, preset: str, objects: Any, *, versions: Mapping[str, str] | None = None
    ) -> Record | None:
        """Return an earlier evaluation of the same content with a result that would come again, or None.

        versions: that the result must have been made with; by default those of `finqd.provenance.versions`
        """
        if plain(objects) != self.run.settings.get("objects"):
            return None
        wanted = versions_of_simulation() if versions is None else versions
        with _in_words(self._path):
            for record in _rows(
                self._connection, f"design_digest = ? AND preset = ? AND status IN {REPEATABLE} ORDER BY number",
                (digest, preset), self.run.parameters,
            ):  # fmt: skip
                if all(record["versions"].get(name) == version for name, version in wanted.items()):
                    return record
        return None

    def _set(self, key: str, value: Any) -> None:
        with _in_words(self._path), _transaction(self._connection):
            text = json.dumps(plain(value), allow_nan=False)
            self._connection.execute("UPDATE header SET value = ? WHERE key = ?", (text, key))

    def _version_id(self, versions: Mapping[str, str]) -> int:
        text = json.dumps(dict(versions), sort_keys=True)
        self._connection.execute("INSERT OR IGNORE INTO versions (versions) VALUES (?)", (text,))
        return self._connection.execute("SELECT id FROM versions WHERE versions = ?", (text,)).fetchone()[0]

    def close(self) -> None:
        """Close the log, and let others write."""
        with suppress(sqlite3.Error):
            self._connection.close()
        self._lock.close()

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _writable(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, timeout=20.0, check_same_thread=False)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")  # a commit outlives the power, too
    return connection


@contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:  # a full disk rolls back by itself
            connection.execute("ROLLBACK")
        raise


@contextmanager
def _in_words(path: Path) -> Iterator[None]:
    """Turn what SQLite raises into one sentence."""
    try:
        yield
    except (sqlite3.Error, json.JSONDecodeError, OSError) as error:
        text = " ".join(str(error).split())
        if "full" in text:
            text = "the disk is full; all that was written before is kept: make room, and run the same command again"
        elif "readonly" in text or "unable to open" in text:
            text = f"cannot be opened to write ({text})" if "readonly" in text else f"cannot be opened ({text})"
        elif isinstance(error, sqlite3.OperationalError):
            text = f"cannot be read or written ({text}); all that was written before is kept"
        elif isinstance(error, (sqlite3.DatabaseError, json.JSONDecodeError)):
            text = f"is damaged, or no log of finqd ({text})"
        raise InputError(text, str(path)) from error
