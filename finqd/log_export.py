"""The log of a search as a table, for other programs: CSV, or Parquet through pyarrow."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from finqd.cli_files import written_at_end
from finqd.errors import InputError, MissingLibraryError

if TYPE_CHECKING:
    from finqd.runlog import Run

SUFFIXES = (".csv", ".parquet")
PLAIN = ("index", "iteration", "emitter", "seed", "preset", "status", "reason", "fitness", "margin", "objective",
         "seconds", "finished_at", "host", "attempts", "design_digest", "accuracy")  # fmt: skip
OF_OBJECTS = ("status", "held", "margin", "drop_mm", "seconds")


def export_log(run: Run, path: Path) -> int:
    """Write a row for each evaluation that the search was told; return how many.

    Columns: the record's own values, features, parameters by their JSON paths, ``unit_0`` ..., and per object status,
    verdict, margin, drop and seconds; ``screen_fitness`` and ``screen_objective`` where a design was screened. Raises
    ``InputError`` for another suffix and a file that cannot be written, ``MissingLibraryError`` without pyarrow.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"must end in {' or '.join(SUFFIXES)}, not {path.suffix or 'nothing'!r}", "--to")
    rows = [_row(record) for record in run.records()]
    columns = list(dict.fromkeys(name for row in rows for name in row)) or list(PLAIN)
    if path.suffix.lower() == ".parquet":
        _write_parquet(rows, columns, path)
        return len(rows)
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with written_at_end(path, "--to") as write:
        write(text.getvalue())
    return len(rows)


def _row(record: Mapping[str, Any]) -> dict[str, Any]:
    screen = record["screen"] or {}
    row = {name: record.get(name) for name in PLAIN}
    row |= {"screen_fitness": screen.get("fitness"), "screen_objective": screen.get("objective")}
    row |= dict(record["features"]) | dict(record["parameters"])
    row |= {f"unit_{i}": value for i, value in enumerate(record["unit"])}
    for name, values in record["objects"].items():
        row |= {f"{name}_{key}": values.get(key) for key in OF_OBJECTS}
    return row | {f"version_{name}": value for name, value in record["versions"].items()}


def _write_parquet(rows: list[dict[str, Any]], columns: list[str], path: Path) -> None:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingLibraryError("Parquet needs pyarrow: pip install 'finqd[parquet]', or write .csv") from error
    table = pyarrow.table({name: [row.get(name) for row in rows] for name in columns})
    temporary = path.with_name(f".{path.name}.part")
    try:
        parquet.write_table(table, temporary)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(f"cannot write to {str(path)!r} ({error.strerror or error})", "--to") from error
