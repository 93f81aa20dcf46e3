"""The verification cases as fast twins; wrong operators that they must reject; pressing a finger; the command."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from finqd import registry
from finqd.accuracy_reference import read_reference
from finqd.cli import finqd
from finqd.data import designs_folder, studies_folder
from finqd.design import Design
from finqd.errors import InputError, MeshError
from finqd.mechanics.material import Material
from finqd.mesh import Mesh
from finqd.objects import load_object
from finqd.plugins.elasticity_corotated import Corotated
from finqd.scene import Scene
from finqd.units import MM
from finqd.verification import catalogue, contact, dynamics, elastic, friction, press, statics
from finqd.verification.cases import Case, Failed, Row, measure, observed_order
from finqd.verification.catalogue import cases
from finqd.verification.press import press_finger, touching_centre

#: without whole grasps
FAST = [name for name in catalogue.CATALOGUE if name not in catalogue.SLOW]
#: rows that the README names: a viscous law damps silicone wrongly, and the recorded bars were not let go at once
KNOWN_MISSES = {"silicone-release": ["0.51 N: ring-down, damping ratio", " 0 N: first peak", "0.51 N: first peak"]}


def missed(rows: list[Row]) -> list[str]:
    return [f"{row.quantity}: {row.value:.6g}, not {row.reference:.6g} ({row.note})" for row in rows if not row.passed]


@pytest.mark.parametrize("name", FAST)
def test_a_fast_twin_stays_inside_its_bands(name: str) -> None:
    rows = [measure(case) for case in cases([name], fast=True)]
    assert rows and not missed(rows)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAST)
def test_a_case_stays_inside_its_bands(name: str) -> None:
    found = [row.quantity for row in map(measure, cases([name])) if not row.passed]
    known = KNOWN_MISSES.get(name, [])
    assert len(found) == len(known) and all(row.endswith(end) for row, end in zip(found, known)), found


@pytest.mark.parametrize("element", elastic.ELEMENTS)
def test_all_laws_agree_for_small_strains(element: str) -> None:
    names = [name for name in registry.names("elasticity") if elastic.supported(name, element)]
    assert "corotated" in names
    for nu in (1 / 3, 0.4999):
        found = [elastic.cook(element, 4, nu, name) for name in names]
        assert found == pytest.approx([found[0]] * len(found), rel=1e-7)


# -- the harness -------------------------------------------------------------------------------------------------------


def a_case(value: Any, *, reference: float = 2.0, band: float = 0.01, absolute: bool = False) -> Case:
    def compute() -> Any:
        if isinstance(value, Exception):
            raise value
        return value

    return Case(name="a", quantity="q", unit="m", reference=reference, source="s", band=band, absolute=absolute,
                compute=compute)


@pytest.mark.parametrize(("value", "settings", "passed"), [
    (2.0199, {}, True), (2.0201, {}, False), (1.9799, {}, False), (math.nan, {}, False), (math.inf, {}, False),
    (-2.0, {}, False), (-2.01, {"reference": -2.0, "band": 0.006}, True), (2.0101, {"absolute": True}, False),
    (1e-11, {"reference": 0.0, "absolute": True, "band": 1e-10}, True),
    (-1e-9, {"reference": 0.0, "absolute": True, "band": 1e-10}, False),
    (0.0, {"reference": 0.0, "absolute": True, "band": 0.0}, True),
    (Failed("it broke"), {}, False), (MeshError("it broke"), {}, False), (ZeroDivisionError("it broke"), {}, False),
    (np.linalg.LinAlgError("it broke"), {}, False), (MemoryError("it broke"), {}, False),
])
def test_a_band_is_a_band(value: Any, settings: dict[str, Any], passed: bool) -> None:
    row = measure(a_case(value, **settings))
    assert row.passed is passed
    assert row.note.endswith("it broke") if isinstance(value, Exception) else row.note == ""
    json.dumps(row.to_dict(), allow_nan=False)


def test_an_observed_order_is_the_slope_of_the_last_two_errors() -> None:
    assert observed_order([7.0, 3 * 0.5**2, 3 * 0.25**2]) == pytest.approx(2.0)
    assert observed_order([1.0, 1.0 / 27], 3.0) == pytest.approx(3.0)
    assert observed_order([0.1, 0.2]) == pytest.approx(-1.0)  # errors that grow


# -- wrong operators ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Wrong:
    """Corotated elasticity with a fault: ``gradient`` scales the forces only, ``poisson_ratio`` replaces the
    material's, ``first`` scales the stiffness of the first element, ``still`` adds energy that turns with the world."""

    gradient: float = 1.0
    poisson_ratio: float | None = None
    first: float = 1.0
    still: float = 0.0

    def potential(self, mesh: Mesh, material: Material, *, first_vertex: int = 0) -> WrongPotential:
        if self.poisson_ratio is not None:
            material = replace(material, poisson_ratio=self.poisson_ratio)
        right = Corotated().potential(mesh, material, first_vertex=first_vertex)
        for block in right.blocks:
            block.stiffness[0] *= self.first
        return WrongPotential(right, self, mesh.vertices)


@dataclass(frozen=True)
class WrongPotential:
    right: Any
    fault: Wrong
    rest: np.ndarray

    @property
    def cliques(self) -> tuple[np.ndarray, ...]:
        return self.right.cliques

    def energy(self, positions: np.ndarray) -> float:
        return self.right.energy(positions) + self.fault.still * float(np.sum((positions - self.rest) ** 2))

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        own = np.zeros_like(gradient)
        energy = self.right.add_gradient(positions, own)
        gradient += self.fault.gradient * own
        return energy

    def add_hessian(self, positions: np.ndarray, slots: Any, blocks: np.ndarray, *, projected: bool = False) -> None:
        self.right.add_hessian(positions, slots, blocks, projected=projected)


def verdict(name: str, compute: Any, *, quantity: str = "") -> bool:
    """Measure the first fast case of a name with ``compute`` in the place of its own; say whether it passes."""
    case = next(case for case in cases([name], fast=True) if quantity in case.quantity)
    return measure(replace(case, compute=compute)).passed


def test_the_patch_test_rejects_one_element_that_is_one_percent_too_stiff() -> None:
    for element in elastic.ELEMENTS:
        assert verdict("patch", lambda element=element: elastic.patch_error(element, Wrong()))
        assert not verdict("patch", lambda element=element: elastic.patch_error(element, Wrong(first=1.01)))


def test_the_rotation_rejects_energy_that_knows_where_up_is() -> None:
    assert verdict("rotation", lambda: elastic.rotation_energy("hex8", Wrong()))
    assert not verdict("rotation", lambda: elastic.rotation_energy("hex8", Wrong(still=1.0)))


@pytest.mark.parametrize("element", elastic.ELEMENTS)
def test_the_order_in_the_mesh_rejects_a_wrong_shear_stiffness(element: str) -> None:
    wrong = Wrong(poisson_ratio=0.1)  # 18 % more shear stiffness at the same modulus
    sizes = (2, 4) if element in elastic.QUADRATIC else (4, 8)
    order = observed_order([elastic.field_error(element, n, wrong) for n in sizes])
    assert not verdict("mesh-order", lambda: order, quantity=f"{element}:")


def test_the_elastica_rejects_forces_that_are_one_percent_too_large() -> None:
    def shortening(elasticity: Any) -> float:
        statics.elastica.cache_clear()
        return statics.elastica(1.0, (50, 1, 1), "hex8", elasticity)[1]

    case = next(c for c in cases(["elastica"]) if c.quantity.startswith("hex8") and "= 1: shortening" in c.quantity)
    assert measure(replace(case, compute=lambda: shortening(Wrong()))).passed
    assert not measure(replace(case, compute=lambda: shortening(Wrong(gradient=1.01)))).passed


def test_the_slope_rejects_two_percent_more_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    right = Scene.friction_between
    monkeypatch.setattr(Scene, "friction_between", lambda self, a, b: 1.02 * right(self, a, b))
    assert not verdict("slope", lambda: friction.block_on_slope(1.01)[0], quantity="1.01")


def rejected(case: Case) -> bool:
    """Measure a case; say whether it came to a number, and that number misses."""
    row = measure(case)
    assert math.isfinite(row.value), row.note
    return not row.passed


@pytest.fixture
def forgetful() -> Iterator[None]:
    """Clear what cases remember, before a fault and after it."""
    remembering = (elastic.cook, statics.silicone_sag, contact.hertz, friction.squeezed_block, press.benchmark_force)
    for function in remembering:
        function.cache_clear()
    yield
    for function in remembering:
        function.cache_clear()


def case_of(name: str, quantity: str, *, fast: bool = True) -> Case:
    return next(case for case in cases([name], fast=fast) if quantity in case.quantity)


@pytest.mark.usefixtures("forgetful")
def test_cook_s_membrane_rejects_a_modulus_three_percent_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    case = case_of("cook", "hex8, 64 x 64, nu 0.3333", fast=False)
    assert measure(case).passed
    monkeypatch.setattr(elastic, "COOK_MODULUS", 0.97 * elastic.COOK_MODULUS)
    elastic.cook.cache_clear()
    assert rejected(case)


@pytest.mark.slow
def test_the_roll_up_rejects_forces_that_are_three_percent_too_large() -> None:
    assert verdict("roll-up", lambda: statics.roll_up((30, 1, 1), "hex8", Wrong(), ramp=30))
    assert not verdict("roll-up", lambda: statics.roll_up((30, 1, 1), "hex8", Wrong(gradient=1.03), ramp=30))


@pytest.mark.usefixtures("forgetful")
def test_silicone_rejects_a_tenth_more_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statics, "SILICONE_GRAVITY", 1.1 * statics.SILICONE_GRAVITY)
    assert rejected(case_of("silicone", "0 N"))


@pytest.mark.usefixtures("forgetful")
def test_hertz_rejects_a_ball_that_is_a_tenth_too_stiff(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact, "BALL", replace(contact.BALL, youngs_modulus=1.1e6))
    assert rejected(case_of("hertz", "approach"))


def test_rolling_rejects_five_percent_more_inertia(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = load_object("sphere")
    monkeypatch.setattr(friction, "load_object", lambda name: replace(ball, inertia=1.05 * ball.inertia))
    assert rejected(case_of("rolling", ""))


@pytest.mark.slow
@pytest.mark.usefixtures("forgetful")
def test_the_pads_reject_three_percent_more_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    right = Scene.friction_between
    monkeypatch.setattr(Scene, "friction_between", lambda self, a, b: 1.03 * right(self, a, b))
    assert rejected(case_of("pads", "weight 1.02"))


def test_the_landing_rejects_contact_that_gives_energy_back() -> None:
    case = case_of("landing", "rigid block")
    assert rejected(replace(case, compute=lambda: dynamics.rebound("imex", 0.01)))


@pytest.mark.usefixtures("forgetful")
def test_the_press_rejects_a_material_that_is_five_percent_too_stiff(monkeypatch: pytest.MonkeyPatch) -> None:
    right = press.press_finger

    def stiffer(design: Design) -> press.Press:
        modulus = design.resolved()["material"]["youngs_modulus_MPa"]
        return right(design.with_overrides({"material.youngs_modulus_MPa": 1.05 * modulus}))

    monkeypatch.setattr(press, "press_finger", stiffer)
    assert rejected(case_of("press", "standard"))


def test_the_order_in_time_rejects_a_first_order_stepper_that_claims_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(dynamics.ORDERS, "implicit_euler", 2)
    (case,) = [case for case in cases(["time-order"], fast=True) if case.quantity.startswith("implicit_euler")]
    row = measure(case)
    assert not row.passed
    assert row.value == pytest.approx(1.0, abs=0.15)


# -- the press ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def benchmark() -> Design:
    return Design.from_json(designs_folder() / "benchmark.json").with_overrides({"mesher.size_mm": 8})


def test_a_press_has_a_history_and_its_work_is_the_energy(benchmark: Design) -> None:
    found = press_finger(benchmark, depth=4 * MM, duration=0.3, rest=0.1)
    assert found.status == "ok", found.reason
    assert len(found.forces) == len(found.depths) == found.steps
    assert found.depths[-1] == pytest.approx(4 * MM)
    assert np.all(np.diff(found.depths) >= 0.0) and np.all(np.diff(found.forces[found.depths > 0.1 * MM]) > -1e-3)
    assert found.force == found.forces[-1] > 1.0
    assert found.max_penetration < 0.1 * MM and found.dofs > 300 and found.seconds > 0.0
    work = np.trapezoid(np.append(0.0, found.forces), np.append(0.0, found.depths))
    assert found.energy == pytest.approx(work, rel=0.02)


def test_the_cylinder_just_touches_the_contact_face(benchmark: Design) -> None:
    solid = benchmark.plugin("geometry").build(benchmark.finger_si(0))
    mesh = benchmark.plugin("mesher").mesh(solid)
    flat = np.array(touching_centre(mesh, solid, 20 * MM))
    foot, tip = solid.contact_line
    along = (tip - foot) / np.linalg.norm(tip - foot)
    across = flat - foot
    assert abs(across[0] * along[1] - across[1] * along[0]) == pytest.approx(20 * MM)
    assert foot[1] + across @ along * along[1] == pytest.approx(mesh.vertices[:, 1].max() / 2)
    x, y = touching_centre(mesh, replace(solid, contact_line=None), 20 * MM)  # the same face, brought up along x
    assert y == pytest.approx(mesh.vertices[:, 1].max() / 2)
    assert abs((x - foot[0]) * along[1] - (y - foot[1]) * along[0]) == pytest.approx(20 * MM, abs=0.2 * MM)


@pytest.mark.parametrize(("settings", "message"), [
    ({"finger": 3}, "finger"), ({"depth": -1.0}, "depth"), ({"radius": math.nan}, "radius"),
    ({"duration": 0.0}, "duration"), ({"rest": -0.1}, "rest"), ({"friction": math.inf}, "friction"),
])
def test_a_press_refuses_nonsense(benchmark: Design, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        press_finger(benchmark, **settings)


def test_the_press_is_held_against_the_reference_that_ships() -> None:
    shipped = read_reference(studies_folder() / "reference_press_benchmark.json")
    assert press.REFERENCE == pytest.approx(shipped.values["force_N"], rel=1e-4)


def test_what_fails_in_a_press_is_its_status(benchmark: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    late = press_finger(benchmark, wall_clock_limit=1e-9)
    assert late.status == "timeout" and "computing" in late.reason and math.isnan(late.force)

    def refuse(*args: Any, **options: Any) -> Mesh:
        raise MeshError("it has no inside")

    monkeypatch.setattr(press, "mesh_solid", refuse)
    found = press_finger(benchmark)
    assert (found.status, found.reason) == ("mesh_failed", "it has no inside")
    assert math.isnan(found.force) and found.dofs == 0


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_prints_rows_and_writes_them(tmp_path: Any) -> None:
    out = tmp_path / "rows.json"
    command = ["verify", "free-fall", "tumbling-brick", "--json", str(out)]
    done = CliRunner().invoke(finqd, command, standalone_mode=False)
    assert done.exception is None and done.return_value == 0, done.output
    assert "2 of 2 inside their bands" in done.output
    rows = json.loads(out.read_text())
    assert [row["case"] for row in rows] == ["free-fall", "tumbling-brick"]
    assert all(row["passed"] and row["error"] <= row["band"] and row["seconds"] >= 0.0 for row in rows)


def test_the_command_says_when_a_case_misses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(catalogue.CATALOGUE, "free-fall", lambda fast: iter([a_case(3.0), a_case(Failed("stuck"))]))
    done = CliRunner().invoke(finqd, ["verify", "free-fall"], standalone_mode=False)
    assert done.return_value == 1
    assert "MISSED" in done.output and "stuck" in done.output and "0 of 2" in done.output


def test_an_unknown_case_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match="there is no case 'nobody'; known: patch, rotation"):
        cases(["nobody"])
    listed = CliRunner().invoke(finqd, ["verify", "--list"], standalone_mode=False)
    assert listed.return_value == 0
    assert all(name in listed.output for name in FAST)
    assert not any(name in listed.output for name in catalogue.SLOW)
