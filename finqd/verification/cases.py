"""What a verification case is, and what becomes of it.

>>> case = Case(name="sum", quantity="1 + 1", unit="-", reference=2.0, source="arithmetic", band=0.01,
...             absolute=False, compute=lambda: 2.01)
>>> row = measure(case)
>>> round(row.error, 6), row.passed
(0.005, True)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from finqd.errors import FinqdError
from finqd.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Case:
    """One number that can be checked.

    name: what is typed to run it; several cases may share one. quantity, unit: what ``compute`` returns
    reference, source: what it should be and who says so
    band: largest error, relative to the reference, or in ``unit`` if ``absolute``
    compute: returns the value, or value and a remark
    """

    name: str
    quantity: str
    unit: str
    reference: float
    source: str
    band: float
    absolute: bool
    compute: Callable[[], float | tuple[float, str]] = field(compare=False)


@dataclass(frozen=True, kw_only=True)
class Row:
    """What became of a case; ``error`` as ``Case.band`` has it; ``note``: a remark, or why there is no value."""

    case: str
    quantity: str
    unit: str
    reference: float
    source: str
    value: float
    error: float
    band: float
    absolute: bool
    passed: bool
    seconds: float
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the row as JSON holds it: what is no number is null."""
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(self).items()}


class Failed(RuntimeError):
    """A case could not be computed; ``str()`` says why."""


def measure(case: Case) -> Row:
    """Run a case. What fails is a row that has not passed, with a note that says why."""
    begun = time.perf_counter()
    value, note = math.nan, ""
    try:
        found = case.compute()
        value, note = found if isinstance(found, tuple) else (found, "")
        value = float(value)
    except (Failed, FinqdError, ArithmeticError) as error:
        note = str(error)
    except Exception as error:  # of a library: the other rows count none the less
        note = f"{type(error).__name__}: {error}"
    off = value - case.reference
    error = off if case.absolute else off / abs(case.reference)
    return Row(
        case=case.name, quantity=case.quantity, unit=case.unit, reference=case.reference, source=case.source,
        value=value, error=error, band=case.band, absolute=case.absolute,
        passed=math.isfinite(error) and abs(error) <= case.band, seconds=time.perf_counter() - begun, note=note,
    )


def checked(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory if it ran through; raise Failed with the reason if not."""
    if trajectory.status != "ok":
        raise Failed(f"{trajectory.status}: {trajectory.reason}")
    return trajectory


def observed_order(errors: list[float], ratio: float = 2.0) -> float:
    """Return the order of convergence between the last two ``errors``, whose step sizes differ by ``ratio``.

    >>> observed_order([0.4, 0.1])
    2.0
    """
    return math.log(errors[-2] / errors[-1], ratio)
