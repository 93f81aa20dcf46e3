"""Writes what a study of the press found of each preset to studies/presets.json, which every result then carries.

    finqd accuracy press --full --knob preset --out STUDY
    python benchmarks/preset_bands.py STUDY

Numbers of whole grasps (``benchmarks/verdict_flips.py``) are left as they are.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from finqd.accuracy_reference import read_reference
from finqd.data import studies_folder
from finqd.presets import PRESETS
from finqd.runlog import write_whole
from finqd.study_log import read_rows


def main() -> None:
    """Read the study, write the bands, print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="folder of a study of the press")
    study = parser.parse_args().study
    reference = read_reference(study / "reference.json")
    if reference.case != "press" or not reference.agrees:
        parser.exit(1, f"{study}: {reference.sentence()}: no bands from this\n")
    exact = reference.values["force_N"]
    rows = {row["rung"]: row for row in read_rows(study / "accuracy.jsonl") if row["status"] == "ok"}
    path = studies_folder() / "presets.json"
    document = json.loads(path.read_text())
    document["studies"]["press"] |= {"date": reference.date, "versions": dict(reference.versions),
                                     "repeat": f"{reference.repeat} --knob preset"}
    for name, settings in PRESETS.items():
        row = rows.get(name)
        if row is None:
            parser.exit(1, f"{study}: the preset {name} is not among its rungs\n")
        error = 100.0 * (row["values"]["force_N"] / exact - 1.0)
        document["presets"][name] |= {
            "settings": settings, "press_force_error_percent": round(abs(error), 2),
            "press_seconds": round(row["seconds"], 2),
        }
        force = row["values"]["force_N"]
        print(f"{name:10} {force:8.3f} N  {error:+7.1f} %  {row['seconds']:7.1f} s  {row['dofs']} dofs")
    write_whole(path, json.dumps(document, indent=2) + "\n")


if __name__ == "__main__":
    main()
