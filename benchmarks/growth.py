"""How time grows: seconds of a step against unknowns, against an object's triangles, against contacts.

    python benchmarks/growth.py --log growth.jsonl [--series finger,block,triangles,contacts] [--minutes 60] [--report]

A soft body is driven, eased, against a rigid body that is held, in ten steps of 20 ms, without gravity and friction:

- finger: the benchmark finger 3 mm into a cylinder (20 mm in radius), 3k to 100k unknowns;
- block: a cube of 40 mm, its top driven 3 mm into a ball below it, 2k to 80k: the hardest case of a sparse solver;
- triangles: the finger, preset `standard`, into a ball made of 1k to 1.3M triangles;
- contacts: the finger, preset `standard`, 6 mm into the cylinder, with sample points 2.4 to 0.075 mm apart.

Effects: contact with the object, self-contact, inertia, large rotation; off: gravity, friction, floor, damping,
material nonlinearity, and long steps. Warm: kernels are compiled by the smallest case of the same kind before. A row
of the log is one case of one round. Seconds are of processor time, one thread: the machine may have other things to do.
Those of a step are the mean of a round, of which the table has the median. Newton iterations are those with a
matrix; "all" counts the cheap ones too. Resumes with what this commit has no row of. Prints the tables, and exponents
fitted to them.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["FINQD_CACHE_DIR"] = ""  # what is built once shall be built here
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402
import trimesh  # noqa: E402
from checkout import commit, commits  # noqa: E402

from finqd.data import designs_folder  # noqa: E402
from finqd.design import Design  # noqa: E402
from finqd.mechanics.linear_backends import available_backends  # noqa: E402
from finqd.mechanics.rounding import rounded_field  # noqa: E402
from finqd.mesh_shapes import box_mesh  # noqa: E402
from finqd.objects import load_object  # noqa: E402
from finqd.presets import apply_preset  # noqa: E402
from finqd.scene import Motion, Scene, Shift  # noqa: E402
from finqd.simulate import simulate  # noqa: E402
from finqd.study_log import append_row, read_rows  # noqa: E402
from finqd.units import MM  # noqa: E402
from finqd.verification.press import press_scene  # noqa: E402

STEPS, STEP_S = 10, 0.02
RADIUS = 20 * MM
FINGERS = ((4.0, 1), (2.5, 2), (2.0, 3), (1.6, 4), (1.2, 5), (1.0, 6), (0.9, 6))  # element size [mm], layers
BLOCKS = (5, 8, 10, 13, 16, 18)  # quadratic bricks along an edge
BALLS = (3, 4, 5, 6, 7, 8)  # subdivisions of an icosahedron: 20 * 4^n triangles
SPACINGS_MM = (2.4, 1.2, 0.6, 0.3, 0.15, 0.075)


@dataclass(frozen=True)
class Prepared:
    """A scene, the plugins that step it, and what is to be noted of it."""

    scene: Scene
    design: Design
    noted: dict[str, float]


def chosen(**overrides: Any) -> Design:
    """Return the benchmark design with `standard` and ``overrides`` (dots of paths as two underscores)."""
    paths = {key.replace("__", "."): value for key, value in overrides.items()}
    design = Design.from_json(designs_folder() / "benchmark.json")
    return apply_preset(design, "standard", overrides={"protocol.calm_step_factor": 1, **paths})


def pressed(design: Design, *, depth: float) -> Scene:
    """Return the scene of a finger that is pressed."""
    solid = design.plugin("geometry").build(design.finger_si(0))
    mesh = design.plugin("mesher").mesh(solid)
    return press_scene(design, mesh, solid, radius=RADIUS, depth=depth, duration=STEPS * STEP_S, friction=0.0)


def finger(size_mm: float, layers: int) -> Prepared:
    """Return the press of a finger with elements of a size."""
    design = chosen(mesher__size_mm=size_mm, mesher__layers=layers)
    return Prepared(pressed(design, depth=3 * MM), design, {})


def block(divisions: int) -> Prepared:
    """Return a cube over a ball."""
    design, edge = chosen(), 40 * MM
    scene = Scene(gravity=(0.0, 0.0, 0.0), friction=0.0)
    mesh = box_mesh((edge,) * 3, (divisions,) * 3, "hex20")
    body = scene.add_soft(mesh, design.material, elasticity=design.plugin("elasticity"))
    body.drive("zmax", Motion(path=Shift(vector=(0.0, 0.0, -3 * MM)), duration=STEPS * STEP_S))
    ball = load_object({"name": "ball", "shape": {"kind": "sphere", "diameter_mm": 2 * RADIUS / MM}, "mass_g": 10})
    scene.add_rigid(ball, position=(edge / 2, edge / 2, -RADIUS), held=True)
    return Prepared(scene, design, {})


def triangles(subdivisions: int) -> Prepared:
    """Return the press of a finger by a ball of triangles; notes what reading and rounding it takes."""
    design = chosen()
    scene = pressed(design, depth=3 * MM)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ball.stl"
        trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS / MM).export(path)
        begun = time.process_time()
        ball = load_object(path, mass_g=10)
    loaded = time.process_time()
    rounded_field(ball, design.plugin("contact").edge_radius_mm * MM)
    noted = {"load_s": loaded - begun, "rounded_s": time.process_time() - loaded}
    place = scene.rigid_bodies.pop().position
    scene.add_rigid(ball, position=place, held=True)
    return Prepared(scene, design, {**noted, "triangles": len(ball.triangles)})


def contacts(spacing_mm: float) -> Prepared:
    """Return a deep press of a finger with sample points so dense."""
    design = chosen(contact__sample_spacing_mm=spacing_mm)
    return Prepared(pressed(design, depth=6 * MM), design, {})


#: series -> what prepares a case, the cases, what the table counts and what is fitted against
SERIES: dict[str, tuple[Callable[..., Prepared], tuple[tuple[Any, ...], ...], str]] = {
    "finger": (finger, FINGERS, "dofs"),
    "block": (block, tuple((n,) for n in BLOCKS), "dofs"),
    "triangles": (triangles, tuple((n,) for n in BALLS), "triangles"),
    "contacts": (contacts, tuple((s,) for s in SPACINGS_MM), "contacts"),
}


class TimedStepper:
    """A stepper, and what each of its steps took and did."""

    def __init__(self, stepper: Any) -> None:
        self.stepper, self.seconds, self.most_contacts = stepper, [], 0
        self.newton = self.every = 0

    def step(self, system: Any, state: Any, dt: float) -> Any:
        """Take a step of the stepper's."""
        begun = time.process_time()
        state, report = self.stepper.step(system, state, dt)
        self.seconds.append(time.process_time() - begun)
        self.newton += report.iterations
        self.every += report.iterations + report.quasi_iterations
        self.most_contacts = max(self.most_contacts, system.contact.rows.count)
        return state, report


def measured(prepared: Prepared) -> dict[str, Any]:
    """Step through a scene; return what its steps took."""
    scene, design = prepared.scene, prepared.design
    timed = TimedStepper(design.plugin("stepper"))
    begun = time.process_time()
    found = simulate(
        scene, duration=STEPS * STEP_S, time_step=STEP_S, stepper=timed, contact=design.plugin("contact"))
    whole, stepping = time.process_time() - begun, sum(timed.seconds)
    return {
        "dofs": 3 * scene.n_vertices, "contacts": timed.most_contacts, "status": found.status, "reason": found.reason,
        "steps": len(timed.seconds), "newton": timed.newton, "all": timed.every, "set_up_s": whole - stepping,
        "stepping_s": stepping, "median_step_s": statistics.median(timed.seconds),
        "wall_s": found.timings["steps"], **prepared.noted,
    }


def run(arguments: argparse.Namespace, names: list[str]) -> list[dict[str, Any]]:
    """Measure what the log does not hold yet of this commit, until the time is up; return its rows."""
    source, deadline = commit(), time.monotonic() + 60.0 * arguments.minutes
    rows = read_rows(arguments.log)
    if arguments.report:
        return rows
    done = {(row["series"], tuple(row["case"]), row["round"]) for row in rows if row["commit"] == source}
    warm = set()
    for number in range(arguments.rounds):
        for name in names:
            prepare, cases, _ = SERIES[name]
            for case in cases[: arguments.largest]:
                if (name, case, number) in done:
                    continue
                if time.monotonic() > deadline:
                    return rows
                if name not in warm:
                    measured(prepare(*cases[0]))
                    warm.add(name)
                row = {"series": name, "case": case, "round": number, **measured(prepare(*case)), "commit": source}
                rows.append(row)
                append_row(arguments.log, row)
                print(name, *case, row["status"], f"{row['stepping_s']:.2f} s", row["reason"], flush=True)
    return rows


def report(rows: list[dict[str, Any]], name: str) -> None:
    """Print the table of a series, and the exponents that fit it."""
    _, cases, against = SERIES[name]
    whole = [row for row in rows if row["series"] == name and row["status"] == "ok"]
    table = []
    for case in cases:
        mine = [row for row in whole if tuple(row["case"]) == case]
        if mine:
            per = [statistics.median(row["stepping_s"] / row[key] for row in mine)
                   for key in ("steps", "all", "newton")]
            once = [statistics.median(row.get(key, math.nan) for row in mine)
                    for key in ("set_up_s", "load_s", "rounded_s")]
            table.append((mine[0], per, once))
    print(f"\n{name}: rows {commits(whole)}; solver {available_backends()[0]}; seconds of processor time")
    print(f"{against:>10s} contacts steps Newton   all |   a step iteration Newton it. |  set-up    load   round")
    for row, per, once in table:
        print(f"{row[against]:10d} {row['contacts']:8d} {row['steps']:5d} {row['newton']:6d} {row['all']:5d} | "
              f"{per[0]:8.4f} {per[1]:9.4f} {per[2]:10.4f} | {once[0]:7.2f} {once[1]:7.2f} {once[2]:7.2f}")
    if len(table) > 1:
        sizes = np.log([row[against] for row, _, _ in table])
        fits = [np.polyfit(sizes, np.log([per[i] for _, per, _ in table]), 1)[0] for i in range(3)]
        ends = [table[-1][1][i] / table[0][1][i] for i in range(3)]
        for title, values in (("exponents", fits), ("last over first", ends)):
            step, every, newton = values
            print(f"  {title}: {step:.2f} a step, {every:.2f} an iteration, {newton:.2f} a Newton iteration")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--series", default=",".join(SERIES))
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--largest", type=int, default=99, help="so many cases of a series, the smallest first")
    parser.add_argument("--report", action="store_true", help="only print what the log holds")
    arguments = parser.parse_args()
    names = arguments.series.split(",")
    unknown = sorted(set(names) - set(SERIES))
    if unknown:
        parser.error(f"there is no series {', '.join(unknown)}; known: {', '.join(SERIES)}")
    rows = run(arguments, names)
    for name in names:
        report(rows, name)


if __name__ == "__main__":
    main()
