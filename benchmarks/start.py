"""How long finqd takes to start: `--help`, and `evaluate` until its first step, warm and the first time ever.

    python benchmarks/start.py [--preset standard] [--repeats 5] [--cold]

Each run is a process of its own; figures are medians over runs, and the second column is processor time of that process
alone, which says more where the machine has other work. What is run is what ``evaluate --jobs 1`` does with one object,
in its order: interpreter and command line; libraries and design; geometry and objects; mesh (in a process of its own,
so that it costs little processor time here); scene (distances, overlaps, pairs of faces, stiffness); first step. The
last two hold the seconds in which kernels were loaded or compiled, which the row below says again. ``--cold`` adds one
run with an empty folder of kernels, and the kernels that took longest there, those that they call included.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from typing import Any

SLOWEST = 12


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cold", action="store_true", help="the first run ever too: a minute or more")
    parser.add_argument("--child", type=float, help=argparse.SUPPRESS)  # what it measures; holds when that was started
    given = parser.parse_args()
    if given.child is not None:
        print(json.dumps(run_to_first_step(given.preset, given.child)))
        return
    seconds = statistics.median(help_seconds() for _ in range(given.repeats))
    print(f"finqd --help: {seconds:.2f} s, median of {given.repeats}")
    first_step(given.preset)  # whatever has not been compiled is
    rows = [first_step(given.preset) for _ in range(given.repeats)]
    print_split(f"evaluate --preset {given.preset} until the first step, warm, median of {given.repeats}", rows)
    if given.cold:
        with tempfile.TemporaryDirectory() as folder:
            cold = first_step(given.preset, NUMBA_CACHE_DIR=folder)
        print_split("the same, the first time ever, one run", [cold])
        for name, seconds in sorted(cold["slowest"].items(), key=lambda one: -one[1])[:SLOWEST]:
            print(f"    {name:45s} {seconds:7.2f} s")


def help_seconds() -> float:
    """Return the seconds of ``finqd --help``."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "finqd", "--help"], check=True, capture_output=True)
    return time.perf_counter() - begun


def first_step(preset: str, **environment: str) -> dict[str, Any]:
    """Return what a process says that runs until its first step."""
    command = [sys.executable, __file__, "--preset", preset, "--child", repr(time.time())]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env={**os.environ, **environment})
    return json.loads(done.stdout)


def print_split(title: str, rows: list[dict[str, Any]]) -> None:
    """Print where the seconds went, a line a part."""
    print(f"\n{title}: {rows[0]['compiled']} kernels compiled, {rows[0]['loaded']} loaded")
    print(f"    {'':45s} {'seconds':>9s} {'processor':>9s}")
    for part in rows[0]["parts"]:
        wall, processor = (statistics.median(row["parts"][part][i] for row in rows) for i in range(2))
        print(f"    {part:45s} {wall:9.2f} {processor:9.2f}")
    wall, processor = (statistics.median(sum(times[i] for times in row["parts"].values()) for row in rows)
                       for i in range(2))
    print(f"    {'in all':45s} {wall:9.2f} {processor:9.2f}")
    print(f"    {'of which loading or compiling kernels':45s} {statistics.median(r['kernels'] for r in rows):9.2f}")


def run_to_first_step(preset: str, begun: float) -> dict[str, Any]:
    """Go the way of an evaluation until the first step, and return the seconds of its parts."""
    clock = Clock(begun)
    import finqd.cli  # noqa: F401

    clock.lap("interpreter and command line")
    from finqd.data import designs_folder
    from finqd.design import Design
    from finqd.evaluate import finger_meshes, load_objects
    from finqd.grasp import GraspTask, compile_clock, grasp_scene, overlap_at_start
    from finqd.mechanics.compiled import kernel_counts
    from finqd.presets import apply_preset
    from finqd.simulate import simulate
    from finqd.units import MS

    design = apply_preset(Design.from_json(designs_folder() / "benchmark.json"), preset)
    stepper, contact = design.plugin("stepper"), design.plugin("contact")
    clock.lap("libraries and design")
    (grasped,) = load_objects(["sphere"])
    solids = [design.plugin("geometry").build(design.finger_si(i)) for i in range(len(design.fingers))]
    clock.lap("geometry and object")
    task = GraspTask(design=design, meshes=finger_meshes(design, solids), grasped=grasped)
    clock.lap("mesh")
    step = design.protocol.time_step_ms * MS
    with compile_clock() as compiled, slowest_kernels() as slowest:
        scene = grasp_scene(task)
        assert overlap_at_start(scene, grasped, design.protocol) is None
        simulate(scene, duration=step, time_step=step, stepper=Announced(stepper, clock), contact=contact)
        clock.lap("first step")
        kernels = compiled()
    counts = kernel_counts()
    return {"parts": clock.parts, "kernels": kernels, "compiled": counts[0], "loaded": counts[1], "slowest": slowest}


class Clock:
    """Seconds, of the wall and of this process's processor time, since the last lap or since ``begun``."""

    def __init__(self, begun: float) -> None:
        self.parts: dict[str, tuple[float, float]] = {}
        self.last = begun, 0.0

    def lap(self, part: str) -> None:
        """End a part."""
        now = time.time(), time.process_time()
        self.parts[part] = now[0] - self.last[0], now[1] - self.last[1]
        self.last = now


class Announced:
    """A stepper whose first step ends the lap before it."""

    def __init__(self, stepper: Any, clock: Clock) -> None:
        self.stepper, self.clock = stepper, clock

    def step(self, *arguments: Any) -> Any:
        """See `finqd.contracts.Stepper`."""
        if "scene" not in self.clock.parts:
            self.clock.lap("scene")
        return self.stepper.step(*arguments)


@contextlib.contextmanager
def slowest_kernels() -> Iterator[dict[str, float]]:
    """Yield what will hold the seconds of each kernel that is compiled, those that it calls included."""
    from numba.core import event

    class Listener(event.Listener):
        """Kernels that others call end before these."""

        def on_start(self, event: Any) -> None:
            began.append(time.perf_counter())

        def on_end(self, event: Any) -> None:
            function = event.data["dispatcher"].py_func
            name = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
            found[name] = found.get(name, 0.0) + time.perf_counter() - began.pop()

    began: list[float] = []
    found: dict[str, float] = {}
    with event.install_listener("numba:compile", Listener()):
        yield found


if __name__ == "__main__":
    main()
