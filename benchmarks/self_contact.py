"""What self-contact costs where nothing touches itself: the benchmark gripper's grasps with it and without.

    python benchmarks/self_contact.py [--preset standard] [--objects sphere] [--angle 10] [--repeats 5]

Both run in turn in one process, warm. The motions must be the same to the last bit, else something has touched and the
ratio means nothing: on `draft`, whose faces are large, notches close under the whole stroke, and ``--angle`` asks for a
shorter one. Seconds of whole grasps scatter by 10 % and more from one to the next, so that two figures are printed: the
ratio of their medians, and, within each grasp with self-contact, the seconds inside `SoftContact` over those outside.
The second leaves out what the compiler and the caches make of it elsewhere, and repeats to a tenth of itself.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from finqd.data import designs_folder
from finqd.design import Design
from finqd.evaluate import evaluate
from finqd.mechanics.soft_contact import SoftContact
from finqd.trajectory import Trajectory

#: all that `contact_penalty` calls
METHODS = (
    "__init__", "add_gradient", "add_hessian", "bind", "bodies", "bounds", "couplings", "energy", "find", "forces",
    "lag", "mapped_slips", "step_limit",
)


class Stopwatch:
    """Seconds inside of any of the functions that it is put round; calls within calls count once."""

    def __init__(self) -> None:
        self.seconds, self._depth = 0.0, 0

    def round(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return ``function``, timed."""

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._depth += 1
            begun = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self._depth -= 1
                if self._depth == 0:
                    self.seconds += time.perf_counter() - begun

        return timed


@contextlib.contextmanager
def watched() -> Iterator[Stopwatch]:
    """Time `SoftContact` for a while."""
    watch, plain = Stopwatch(), {name: getattr(SoftContact, name) for name in METHODS}
    for name, method in plain.items():
        setattr(SoftContact, name, watch.round(method))
    try:
        yield watch
    finally:
        for name, method in plain.items():
            setattr(SoftContact, name, method)


def measured(preset: str, name: str, changes: dict[str, float], *, soft_contact: bool) -> tuple[Trajectory, float]:
    """Return the trajectory of a grasp and its seconds."""
    design = Design.from_json(designs_folder() / "benchmark.json")
    overrides = {**changes, "contact.soft_contact": soft_contact}
    found = evaluate(design, objects=[name], preset=preset, overrides=overrides)
    trajectory = found.trajectories[name]
    return trajectory, trajectory.timings["set_up"] + trajectory.timings["steps"]


def compared(preset: str, name: str, changes: dict[str, float], repeats: int) -> None:
    """Print both figures for one object."""
    slower, faster, inside = [], [], []
    for repeat in range(repeats + 1):
        with watched() as watch:
            on, with_it = measured(preset, name, changes, soft_contact=True)
        off, without = measured(preset, name, changes, soft_contact=False)
        if not np.array_equal(on.rigid_positions, off.rigid_positions):
            print(f"{preset:9s} {name:12s} touches itself: no comparison")
            return
        if repeat:  # the first compiles
            slower.append(with_it)
            faster.append(without)
            inside.append(watch.seconds / (with_it - watch.seconds))
    with_it, without, share = (statistics.median(values) for values in (slower, faster, inside))
    print(f"{preset:9s} {name:12s} with {with_it:6.2f} s, without {without:6.2f} s, ratio {with_it / without:.3f};  "
          f"inside over outside {100 * share:.1f} % ({100 * min(inside):.1f} to {100 * max(inside):.1f})", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--objects", default="sphere")
    parser.add_argument("--angle", type=float, help="of the closed fingers [degrees], the design's if not given")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    changes = {} if arguments.angle is None else {"actuation.angle_deg": arguments.angle}
    for name in arguments.objects.split(","):
        compared(arguments.preset, name, changes, arguments.repeats)


if __name__ == "__main__":
    main()
