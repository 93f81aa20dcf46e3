"""RUN.toml: what a search is asked for, in a file. Every key has an option of the same meaning on the command line.

    finger = "fin_ray"          # geometry plugin, or a table with its name and options
    algorithm = "cma_me"        # cma_me, cma_mae, map_elites, sobol
    iterations = 5
    batch = 15
    objects = ["cube", "mine.json"]
    screen = "draft"            # cheap evaluation of every design
    confirm = "standard"        # of those that would enter the map
    out = "search"
    workers = "processes"       # inline, dask (with scheduler = "tcp://host:8786"); jobs = 2
    recheck = 8                 # conditions under which the elites are evaluated again in the end

    [ranges]                    # of the map's axes; sampled where there are none
    volume_mm3 = [35e3, 95e3]

    [set]                       # of the designs
    "protocol.hold_s" = 2

Paths in it are relative to its folder.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Len

from finqd.errors import InputError
from finqd.json_input import SIZE_LIMIT
from finqd.options import checked_fields

Preset = Literal["draft", "standard", "fine", "reference", "paper"]
Count = Annotated[int, Ge(1), Le(10_000_000)]


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """What may stand in RUN.toml, and the defaults."""

    finger: str | dict[str, Any] | None = None
    design: str | None = None
    algorithm: Literal["cma_me", "cma_mae", "map_elites", "sobol"] = "cma_me"
    iterations: Count = 5
    batch: Annotated[int, Ge(1), Le(100_000)] = 15
    seed: Annotated[int, Ge(0), Le(2**63 - 1)] = 0
    cells: Annotated[int, Ge(1), Le(1000)] = 10
    objects: Annotated[list[str], Len(1, 1000)] | None = None
    preset: Preset | None = None
    screen: Preset | None = None
    confirm: Preset | None = None
    time_limit_s: Annotated[float, Gt(0), Le(1e7)] = 3600.0
    workers: Literal["inline", "processes", "dask"] | None = None
    scheduler: str | None = None
    jobs: Annotated[int, Ge(1), Le(1024)] | None = None
    recheck: Annotated[int, Ge(0), Le(1000)] = 0
    out: str | None = None
    ranges: dict[str, tuple[float, float]] | None = None
    set: dict[str, Any] | None = None


def read_run_file(path: Path) -> dict[str, Any]:
    """Return what RUN.toml sets, checked; paths of files are made absolute. Raises ``InputError``, one sentence."""
    try:
        if path.is_file() and path.stat().st_size > SIZE_LIMIT:
            raise InputError(f"is too large to be meant: more than {SIZE_LIMIT // 1000} kB", str(path))
        document = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text: byte {error.start} cannot be read", str(path)) from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {' '.join(str(error).split())}", str(path)) from error
    except RecursionError as error:
        raise InputError("is nested too deeply", str(path)) from error
    except (OSError, ValueError) as error:
        text = "there is no such file" if isinstance(error, FileNotFoundError) else "cannot be read"
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(text if "such" in text else f"{text} ({reason})", str(path)[:200]) from error
    given = checked_fields(RunFile, document, f"{path}:")
    if given.get("preset") and given.get("confirm"):
        raise InputError("give preset or confirm, they mean the same", f"{path}: confirm")
    return _absolute(given, path.parent)


def _absolute(given: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    found = dict(given)
    if "out" in found:
        found["out"] = str(folder / found["out"])
    if "objects" in found and found["objects"]:
        found["objects"] = [str(folder / one) if Path(one).suffix else one for one in found["objects"]]
    if found.get("design") and Path(found["design"]).suffix:
        found["design"] = str(folder / found["design"])
    return found
