"""What a search leaves in its folder beside the log, all of it made from the log, and made again as it goes on.

    RUN/run.sqlite     the log, which is the truth (`finqd.runlog`); RUN/run.lock: who writes to it
    RUN/progress.log   how far it was, line by line (`finqd.search_progress`)
    RUN/archive.csv    the elites
    RUN/elites/*.json  their design files, named after their cells
    RUN/*.png          heatmap, coverage, QD score (`finqd.search_plots`), when a session ends
"""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from finqd import archive as qd
from finqd.design import Design
from finqd.runlog import RunLog, write_whole
from finqd.search_evaluate import decoded

if TYPE_CHECKING:
    from ribs.archives import GridArchive

WRITE_EVERY_S = 60.0

_last: dict[Path, float] = {}


def write_derived(
    log: RunLog, archive: GridArchive, written: dict[tuple[int, ...], int], *, always: bool = False
) -> None:
    """Write the archive as a table and as design files, and with ``always`` the pictures, each whole or not at all.

    written: cell -> evaluation of the design files that are there, brought up to date here. Without ``always`` not more
    often than once a minute. A full disk is a warning: these files can be made again.
    """
    folder = log.run.folder
    now = time.monotonic()
    if not always and now - _last.get(folder, -WRITE_EVERY_S) < WRITE_EVERY_S:
        return
    _last[folder] = now
    try:
        _write_elites(log, archive, written)
        if always:
            from finqd.search_plots import draw

            draw(folder, archive, log.told_records(0, log.told), log.run.ranges)
    except OSError as error:
        place = error.filename or folder
        warnings.warn(f"{place}: cannot be written ({error.strerror or error}); the log is whole", stacklevel=2)


def _write_elites(log: RunLog, archive: GridArchive, written: dict[tuple[int, ...], int]) -> None:
    run = log.run
    found = qd.elites(archive, log.elite_records(qd.elite_indices(archive)))
    write_whole(run.folder / "archive.csv", qd.archive_table(found, run.ranges, run.parameters))
    (run.folder / "elites").mkdir(exist_ok=True)
    for cell, record in found:
        if written.get(cell) == record["index"]:
            continue
        design = decoded(np.array(record["unit"]), record["index"], base=run.base, seed=run.settings["seed"])
        assert isinstance(design, Design)  # it was evaluated
        name = "_".join(["cell", *(f"{i:02d}" for i in cell)])
        write_whole(run.folder / "elites" / f"{name}.json", design.to_json())
        written[cell] = record["index"]
