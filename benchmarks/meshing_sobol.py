"""Meshes fin rays over the whole search space with both meshers, in the process that can be killed.

    python benchmarks/meshing_sobol.py [--designs 500] [--swept-mm 4] [--tetrahedral-mm 4] [--order 1]
                                       [--only swept] [--log FILE]

Every finger of every design. Rows go to the log as they come; started again, the script goes on where it stopped, and
with a finished log it just prints the table: quality, wedges, volume, dofs, seconds. Exits with 1 if any finger fails:
not meshed, an inverted element, or a volume that differs by more than 1e-9.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from geometry_sobol import sobol_fingers

from finqd.errors import MeshError
from finqd.meshing import mesh_solid
from finqd.plugins.geometry_fin_ray import FinRay
from finqd.plugins.mesher_swept import Swept
from finqd.plugins.mesher_tetrahedral import Tetrahedral
from finqd.study_log import append_row, read_rows

LIMIT = 1e-9


def measure(mesher: Any, finger: dict[str, float], time_limit_s: float) -> dict[str, Any]:
    """Return what one mesh is like, or why there is none."""
    solid = FinRay().build(finger)
    start = time.perf_counter()
    try:
        mesh = mesh_solid(mesher, solid, time_limit_s=time_limit_s)
    except MeshError as error:
        return {"error": str(error), "seconds": time.perf_counter() - start}
    seconds, quality = time.perf_counter() - start, mesh.quality()
    return {
        "seconds": seconds, "dofs": 3 * mesh.n_vertices, "inverted": quality.inverted,
        "worst": quality.scaled_jacobian_min, "median": quality.scaled_jacobian_median,
        "wedges": quality.elements.get("wedge6", 0), "elements": mesh.n_elements,
        "volume_error": abs(mesh.volume / solid.volume - 1.0),
    }


def run(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return one row a finger and mesher, from the log where it has them."""
    meshers = {
        f"swept {arguments.swept_mm:g} mm": Swept(size_mm=arguments.swept_mm),
        f"tetrahedral {arguments.tetrahedral_mm:g} mm, order {arguments.order}":
            Tetrahedral(size_mm=arguments.tetrahedral_mm, order=arguments.order),
    }
    meshers = {name: mesher for name, mesher in meshers.items() if name.startswith(arguments.only)}
    rows = read_rows(arguments.log)
    done = {(row["mesher"], row["finger"]) for row in rows}
    for number, finger in enumerate(sobol_fingers(arguments.designs, arguments.seed)):
        for name, mesher in meshers.items():
            if (name, number) not in done:
                row = {"mesher": name, "finger": number, **measure(mesher, finger, arguments.time_limit_s)}
                rows.append(row)
                append_row(arguments.log, row)
    return [row for row in rows if row["mesher"] in meshers and row["finger"] < 3 * arguments.designs]


def table(rows: list[dict[str, Any]]) -> int:
    """Print the table, one column a mesher; return how many fingers failed."""
    def spread(values: list[float], percentiles: tuple[float, ...], form: str) -> str:
        return " / ".join(format(v, form) for v in np.percentile(values, percentiles))

    failed = 0
    for name in dict.fromkeys(row["mesher"] for row in rows):
        mine = [row for row in rows if row["mesher"] == name]
        good = [row for row in mine if "error" not in row]
        wrong = [row for row in good if row["inverted"] or row["volume_error"] > LIMIT]
        failed += len(mine) - len(good) + len(wrong)
        column = {key: [row[key] for row in good] for key in good[0] if key not in ("mesher", "finger")}
        lines = [
            ("fingers, meshed", f"{len(mine)}, {len(good)}"),
            ("fingers with an inverted element", sum(1 for row in good if row["inverted"])),
            ("largest relative volume error", f"{max(column['volume_error']):.2g}"),
            ("worst scaled Jacobian: min / 1 % / 10 % / median", spread(column["worst"], (0, 1, 10, 50), ".3f")),
            ("median scaled Jacobian: min / 1 % / 10 % / median", spread(column["median"], (0, 1, 10, 50), ".3f")),
            ("wedges among elements", f"{sum(column['wedges']) / sum(column['elements']):.2%}"),
            ("dofs a finger: min / median / max", spread(column["dofs"], (0, 50, 100), ".0f")),
            ("seconds a finger: median / 99 % / max", spread(column["seconds"], (50, 99, 100), ".3f")),
        ]
        print(name)
        for label, value in lines:
            print(f"  {label:<54}{value}")
        for row in mine:
            if "error" in row:
                print(f"  finger {row['finger']}: {row['error']}")
    return failed


def main() -> int:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--designs", type=int, default=500)
    parser.add_argument("--swept-mm", type=float, default=4.0)
    parser.add_argument("--tetrahedral-mm", type=float, default=4.0)
    parser.add_argument("--only", choices=("swept", "tetrahedral", ""), default="")
    parser.add_argument("--order", type=int, choices=(1, 2), default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--time-limit-s", type=float, default=60.0)
    parser.add_argument("--log", type=Path, default=Path("meshing_sobol.jsonl"))
    return 1 if table(run(parser.parse_args())) else 0


if __name__ == "__main__":
    sys.exit(main())
