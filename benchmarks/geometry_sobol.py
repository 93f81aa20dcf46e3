"""Builds fin rays over the whole search space and compares each volume with an independent boolean.

    python benchmarks/geometry_sobol.py [--designs 2000] [--profile isosceles] [--seed 1]

Every finger: is the profile one valid piece, does its volume agree with walls, plate, tip and ribs that are built one
by one and joined by GEOS (shapely), and does the closed surface enclose the same volume? Prints a table and exits
with 1 if any finger fails (relative difference over 1e-6).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.stats import qmc

from finqd.plugins.geometry_fin_ray import FinRay
from finqd.solid import SurfaceSolid
from finqd.units import DEG, MM

LIMIT = 1e-6
FACTORS = {"mm": MM, "deg": DEG, "": 1}


def sobol_fingers(designs: int, seed: int) -> Iterator[dict[str, float]]:
    """Yield three fingers (SI) of each of ``designs`` points of a scrambled Sobol sequence over 28 dimensions."""
    units = qmc.Sobol(28, seed=seed).random_base2(max(1, int(np.ceil(np.log2(designs)))))[:designs]
    for values in units[:, :27].reshape(-1, 9):
        finger = {}
        for p, u in zip(FinRay.finger_parameters, values):
            number = p.low + int(u * (p.high - p.low + 1)) if p.integer else p.low + u * (p.high - p.low)
            finger[p.name] = number * FACTORS[p.unit]
        yield finger


def boolean_area(finger: dict[str, float], profile: str, base_plate: float = 2 * MM) -> float:
    """Return the profile's area [m^2]: GEOS joins bands and rotated strips, and clips them by the triangle."""
    from shapely import LineString, Polygon, box, union_all
    from shapely.affinity import rotate

    width, length = finger["width"], finger["length"]
    base, back, apex = (0.0, 0.0), (width, 0.0), (0.5 * width if profile == "isosceles" else 0.0, length)

    def band(a: tuple, b: tuple, thickness: float) -> Any:
        line = np.array([a, b]) + np.array([[-1.0], [1.0]]) * (np.array(b) - np.array(a))
        return LineString(line).buffer(thickness, cap_style="flat", single_sided=True)

    tip = length - finger["tip_length"]
    pieces = [
        band(base, back, base_plate), band(back, apex, finger["back_wall"]), band(apex, base, finger["contact_wall"]),
        box(-1.0, tip, 1.0, 1.0),
    ]
    for i in range(1, int(finger["rib_count"]) + 1):
        y = base_plate + i * (tip - base_plate) / (finger["rib_count"] + 1)
        x = 0.5 * width + (apex[0] - 0.5 * width) * y / length
        half = 0.5 * finger["rib_thickness"]
        pieces.append(rotate(box(x - 1, y - half, x + 1, y + half), finger["rib_angle"] / DEG, origin=(x, y)))
    return Polygon([base, back, apex]).intersection(union_all(pieces)).area


def main() -> int:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--designs", type=int, default=2000)
    parser.add_argument("--profile", choices=("isosceles", "right"), default="isosceles")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    geometry, start = FinRay(profile=arguments.profile), time.perf_counter()
    errors, closures, volumes, invalid, early, unhinted = [], [], [], 0, 0, 0
    for finger in sobol_fingers(arguments.designs, arguments.seed):
        solid = geometry.build(finger)
        invalid += not (solid.polygon.is_valid and solid.polygon.geom_type == "Polygon")
        errors.append(abs(solid.area / boolean_area(finger, arguments.profile) - 1.0))
        closures.append(abs(SurfaceSolid(*solid.surface()).volume / solid.volume - 1.0))
        volumes.append(solid.volume)
        top = max(hole[:, 1].max() for hole in solid.holes)
        early += top < finger["length"] - finger["tip_length"] - 1e-6
        unhinted += solid.patches is None
    totals = np.array(volumes).reshape(-1, 3).sum(axis=1) / MM**3
    failed = invalid + int(np.sum(np.array(errors) > LIMIT)) + int(np.sum(np.array(closures) > LIMIT))
    rows = [
        ("designs, fingers", f"{len(totals)}, {len(errors)}"),
        ("profile", arguments.profile),
        ("not one valid piece", invalid),
        ("volume against the boolean, largest relative difference", f"{max(errors):.2g}"),
        ("   share above 1e-12", f"{np.mean(np.array(errors) > 1e-12):.4%}"),
        ("closed surface against the polygon, largest relative difference", f"{max(closures):.2g}"),
        ("cavity ends below the tip line (walls or last rib meet there)", f"{early / len(errors):.3%}"),
        ("fingers without patches for the swept mesher", unhinted),
        ("three fingers [mm^3], 1 %, median, 99 %", ", ".join(f"{v:.0f}" for v in np.percentile(totals, [1, 50, 99]))),
        ("seconds", f"{time.perf_counter() - start:.1f}"),
        ("failed", failed),
    ]
    for name, value in rows:
        print(f"{name:<66}{value}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
