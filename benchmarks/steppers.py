"""What a stepper's accuracy costs where nothing touches: a silicone bar let go, error of its swing against seconds.

    python benchmarks/steppers.py

The press of `finqd accuracy` ends at rest, where steppers have nothing to be wrong about, and its contact asks `imex`
and `explicit` for substeps of microseconds. Here the tip of a clamped bar (100 x 30 x 30 mm, 20 x 6 x 6 bricks) swings
for 0.2 s under its own weight; the error is the root mean square over that time of the tip's distance from the same
mesh stepped by `bdf2` at 0.25 ms, as a share of the first peak. Prints a table; seconds are warm, medians of
three (`explicit`: one run). Errors below 0.05 % are not resolved: that is about what the truth itself is off by.
"""

from __future__ import annotations

import statistics
import time

import numpy as np

from finqd.units import MM, MS
from finqd.verification.dynamics import silicone_course
from finqd.verification.statics import silicone_scene

DIVISIONS, DURATION = (20, 6, 6), 0.2
STEPS_MS = {
    "implicit_euler": (20.0, 10.0, 5.0, 2.0, 1.0, 0.5), "bdf2": (20.0, 10.0, 5.0, 2.0, 1.0),
    "imex": (20.0, 10.0, 5.0, 2.0, 1.0, 0.5), "explicit": (10.0,),
}
REPEATS = 3


def measured(stepper: str, step_ms: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return times [s], sag [m] and seconds, a median, of the swing by one stepper."""
    seconds = []
    for _ in range(REPEATS if stepper != "explicit" else 1):
        silicone_course.cache_clear()
        begun = time.perf_counter()
        times, sag = silicone_course(DIVISIONS, 0.0, stepper=stepper, time_step=step_ms * MS, duration=DURATION)
        seconds.append(time.perf_counter() - begun)
    return times, sag, statistics.median(seconds)


def main() -> None:
    """Measure and print."""
    for stepper in STEPS_MS:  # compiles
        silicone_course(DIVISIONS, 0.0, stepper=stepper, time_step=10 * MS, duration=10 * MS)
    exact_times, exact = silicone_course(DIVISIONS, 0.0, stepper="bdf2", time_step=0.25 * MS, duration=DURATION)
    _, beam = silicone_scene(DIVISIONS, "hex8", "corotated", 0.0)
    print(f"{3 * beam.mesh.n_vertices} unknowns, first peak {exact.max() / MM:.2f} mm")
    for stepper, steps in STEPS_MS.items():
        for step_ms in steps:
            times, sag, seconds = measured(stepper, step_ms)
            off = sag - np.interp(times, exact_times, exact)
            error = 100.0 * float(np.sqrt(np.mean(off**2)) / exact.max())
            print(f"{stepper:15s} {step_ms:6.2f} ms  error {error:7.3f} %  {seconds:7.2f} s", flush=True)


if __name__ == "__main__":
    main()
