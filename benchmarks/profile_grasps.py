"""Where the time of grasps goes, by kind of work, cold and warm.

    python benchmarks/profile_grasps.py [--presets draft,standard] [--objects sphere,cube] [--warm 1]

Each preset and object is run in this process, one after the other: first cold, where kernels are compiled or loaded
from Numba's cache and libraries are loaded, then warm. What is in memory from an earlier preset is warm for the later
ones: name one preset and one object for a first run that is cold in all. Tables are those of
`finqd evaluate --profile`; categories are disjoint, and add up to the whole time (`finqd.profiling`).
"""

from __future__ import annotations

import argparse
import json

from finqd.cli_tables import print_profile
from finqd.data import designs_folder
from finqd.design import Design
from finqd.evaluate import evaluate


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--design", default="benchmark")
    parser.add_argument("--presets", default="draft,standard")
    parser.add_argument("--objects", default="sphere,cube")
    parser.add_argument("--warm", type=int, default=1, help="warm runs of each")
    arguments = parser.parse_args()
    design = Design.from_json(designs_folder() / f"{arguments.design}.json")
    for preset in arguments.presets.split(","):
        for name in arguments.objects.split(","):
            for run in range(1 + arguments.warm):
                result = evaluate(design, objects=[name], preset=preset, profile=True).to_dict()
                row, how = result["objects"][name], "warm" if run else "cold: first run in this process"
                print(f"\n{preset} {name} ({how}): {row['status']}, {row['seconds']:.1f} s, {row['steps']} steps, "
                      f"{row['newton_iterations']} Newton iterations, "
                      f"{row['counters'].get('quasi_iterations', 0)} without a matrix")
                print_profile(result["profile"])
            told = {"effects": result["effects"], "reductions": result["reductions"]}
            print(json.dumps({**told, "versions": result["versions"]}), flush=True)


if __name__ == "__main__":
    main()
