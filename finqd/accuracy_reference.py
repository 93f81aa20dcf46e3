"""What errors are measured against: the finest rung of one element family, which another family has to confirm.

A reference that ships with finqd is a file ``studies/reference_*.json``; the same file is what a study leaves in its
folder, so anybody can repeat it, compare, and put another one there.
"""

from __future__ import annotations

import json
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from pydantic import StrictBool, StrictFloat, StrictInt, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from finqd.accuracy_cases import Case, Quantity
from finqd.data import studies_folder
from finqd.errors import InputError
from finqd.json_input import read_json_object

FORMAT = "finqd accuracy reference"
Number = StrictBool | StrictInt | StrictFloat
AGREEMENT_PERCENT = 1.0  # two families that differ by more are no agreement


class Family(TypedDict):
    """What one rung of a reference gave."""

    rung: str
    options: str
    status: str
    reason: str
    values: Mapping[str, Number]
    seconds: float
    dofs: int
    steps: int
    newton_iterations: int


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Converged values of a case, and where they come from.

    physics: hash of what the values depend on (`finqd.accuracy.Study.physics`)
    values: key -> value, of the first family that worked
    families: what each gave: rung, options, status, values, seconds, dofs, steps; a third one is the second's on a mesh
        half as fine
    confirmed_by: the case's quantity by the second family, extrapolated if there are two meshes of it (`extrapolated`)
    difference_percent: between both in the case's quantity, None if only one is there
    one_family: both meshes are of the same family, which is no agreement whatever they differ by
    quantity: the case's quantity that ``difference_percent`` is of
    source: "computed" by this study, or "shipped", or a file's name
    """

    case: str
    physics: str
    values: Mapping[str, Number]
    families: Sequence[Family]
    difference_percent: float | None
    confirmed_by: float | None = None
    one_family: bool = False
    quantity: str = "force_N"  # of files that do not say
    source: str = "computed"
    design: str = ""
    date: str = ""
    repeat: str = ""
    versions: Mapping[str, str]
    machine: Mapping[str, Any]

    @property
    def uncertainty_percent(self) -> float:
        """Half of what the two families differ by: errors below it are not told apart. Of one family, all of that:
        it converges at first order at notches, so that the finer mesh is as far off as the two are apart."""
        return (1.0 if self.one_family else 0.5) * (self.difference_percent or 0.0)

    @property
    def agrees(self) -> bool:
        """Whether there are two families, within `AGREEMENT_PERCENT` of each other."""
        if self.one_family or self.difference_percent is None:
            return False
        return self.difference_percent <= AGREEMENT_PERCENT

    def sentence(self) -> str:
        """Return what a reader has to know."""
        good = [str(family["rung"]) for family in self.families if family["status"] == "ok"]
        names = " and ".join(good)
        if len(good) == 3:
            names = f"{good[0]} and the limit of {good[2]} and {good[1]}"
        if self.difference_percent is None:
            failed = "; ".join(f"{f['rung']}: {f['status']}" for f in self.families if f["status"] != "ok")
            return f"reference by {names} alone ({failed}): nothing says how far off it is"
        differ = f"{names} differ by {self.difference_percent:.2g} %"
        floor = f"errors below {self.uncertainty_percent:.2g} % are not resolved"
        first = next(str(family["rung"]) for family in self.families if family["status"] == "ok")
        verdict = f"the reference is {first}" if self.agrees else f"that is NO agreement; the reference is {first}"
        if self.one_family:
            verdict = f"that is one family alone, and no second one confirms it; the reference is {first}"
        return f"{differ}: {verdict}, and {floor}"

    def to_dict(self) -> dict[str, Any]:
        """Return it as its file holds it."""
        return {"format": FORMAT, **{key: value for key, value in asdict(self).items() if key != "source"}}


def make_reference(
    case: Case, physics: str, rows: Sequence[Mapping[str, Any] | None], *, full: bool, one_family: bool = False
) -> Reference | None:
    """Return the first of two families that worked, compared with the other; None if none did.

    rows: of the reference, of the second family, and perhaps of the second family on a mesh half as fine.
    one_family: the second row is of the first one's family, on a mesh half as fine
    """
    done = [row for row in rows if row is not None and row["status"] == "ok"]
    if not done:
        return None
    values: dict[str, Any] = {}
    for key in case.quantities:
        found = [row["values"][key] for row in done if key in row["values"]]
        if found and isinstance(found[0], bool):
            values.update({key: found[0]} if len(set(found)) == 1 else {})  # no verdict where the families disagree
        elif found:
            values[key] = found[0]
    main = [row["values"][case.main] for row in done if case.main in row["values"]]
    if not main:
        return None
    other = None
    if len(main) == len(rows) > 1 and values[case.main] != 0.0:
        other = extrapolated(main[1], main[2]) if len(rows) == 3 else main[1]
    difference = None if other is None else 100.0 * abs(main[0] - other) / abs(values[case.main])
    families = [_family(row) for row in rows if row is not None]
    first = done[0]
    return Reference(
        case=case.name, physics=physics, values=values, families=families, difference_percent=difference,
        confirmed_by=other, one_family=one_family, quantity=case.main, design=first["design"],
        date=clock.strftime("%Y-%m-%d", clock.gmtime()),
        versions=first["versions"], machine=first["machine"],
        repeat=f"finqd accuracy {case.name} --design {first['design']}{' --full' if full else ''} --reference compute",
    )


def _family(row: Mapping[str, Any]) -> Family:
    return Family(**{key: row[key] for key in Family.__annotations__})  # type: ignore[typeddict-item]


def extrapolated(fine: float, coarse: float, *, order: float = 2.0) -> float:
    """Return what values on a mesh and on one half as fine tend to, at that ``order`` (Richardson, 1911).

    hex8 graded with exponent 2 is of second order at the notches too: its compliance with 4, 8 and 10 elements through
    a wall (15.722, 16.615, 16.722 mm) fits 2.00.
    """
    return fine + (fine - coarse) / (2.0**order - 1.0)


def shipped_reference(case: str, physics: str) -> Reference | None:
    """Return the reference that ships with finqd for these physics, if there is one."""
    for path in sorted(studies_folder().glob("reference_*.json")):
        found = read_reference(path, source="shipped")
        if (found.case, found.physics) == (case, physics):
            return found
    return None


def read_reference(path: Path, *, source: str = "") -> Reference:
    """Read a reference's file. Raises ``InputError`` if it is none."""
    document, _ = read_json_object(path, kind="reference")
    if document.pop("format", None) != FORMAT:
        raise InputError("is no reference of an accuracy study", str(path))
    unknown = sorted(document.keys() - {one.name for one in fields(Reference)})
    try:
        if unknown:
            raise InputError(f"is no reference of this version of finqd: {unknown[0]} is unknown", str(path))
        found = TypeAdapter(Reference).validate_python({**document, "source": source or path.name})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"is no reference of this version of finqd: {where}: {first['msg']}", str(path)) from error
    if not any(family["status"] == "ok" for family in found.families) or found.quantity not in found.values:
        raise InputError("is no reference: none of its families worked", str(path))
    if not (found.difference_percent is None or found.difference_percent >= 0.0):
        raise InputError(f"is no reference: families cannot differ by {found.difference_percent:g} %", str(path))
    return found


def write_reference(path: Path, reference: Reference) -> None:
    """Write a reference's file, whole or not at all."""
    from finqd.runlog import plain, write_whole

    write_whole(path, json.dumps(plain(reference.to_dict()), indent=2, ensure_ascii=False) + "\n")


def error_of(quantity: Quantity, value: Any, exact: Any) -> float | None:
    """Return the signed error: in percent where the quantity is relative, else in its unit; a verdict's is 0 or 1."""
    if value is None or exact is None:
        return None
    if isinstance(value, bool):
        return float(value != exact)
    if quantity.relative:
        return 100.0 * (value / exact - 1.0) if exact else None
    return value - exact
