"""Where the time goes: that it adds up, that nothing depends on who asks, and that who does not ask pays nothing."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numba import njit

from finqd import cli, profiling, registry
from finqd.cli_tables import print_profile
from finqd.data import designs_folder
from finqd.design import Design
from finqd.evaluate import evaluate
from finqd.mechanics.linear import LinearSolver, make_solver
from finqd.mechanics.material import Material
from finqd.mechanics.pattern import BlockPattern
from finqd.mechanics.preconditioners import CoupledMatrix
from finqd.mechanics.system import System
from finqd.mesh_shapes import box_mesh
from finqd.objects import load_object
from finqd.profiling import AVOIDABLE, CATEGORIES, KERNELS, Clock, Timed, profiled, total
from finqd.scene import Motion, Scene, Shift
from finqd.simulate import simulate
from finqd.trajectory import Trajectory

RUBBER = {"youngs_modulus": 1e6, "poisson_ratio": 0.4, "density": 1000.0}
CUBE = {"name": "cube", "shape": {"kind": "box", "size_mm": [20, 20, 20]}, "mass_g": 20}
METHODS = ("energy", "add_gradient", "add_hessian", "hold_fixed", "solver")
ARRAYS = ("times", "rigid_positions", "rigid_rotations", "soft_positions", "contact_forces", "penetrations", "stroke")
OBJECTS = ("sphere", "disk")
#: two grasps that close and begin to rise, in a few seconds
SHORT = {
    "mesher.size_mm": 12, "protocol.time_step_ms": 50, "actuation.duration_s": 0.3, "protocol.close_s": 0.3,
    "protocol.squeeze_s": 0.05, "protocol.lift_s": 0.05, "protocol.lift_mm": 1.0, "protocol.hold_s": 0.0,
}


def pressed(**material: float) -> Scene:
    """Return a soft block that lifts a cube of 20 mm which it is driven into, above a floor."""
    scene = Scene()
    scene.add_plane(point=(0.0, 0.0, -0.005))
    block = scene.add_soft(box_mesh((0.03, 0.03, 0.01), (3, 3, 2)), Material(**RUBBER, **material), name="block")
    block.drive("zmin", Motion(path=Shift(vector=(0.0, 0.0, 0.002)), duration=0.05))
    scene.add_rigid(load_object(CUBE), position=(0.015, 0.015, 0.0202))
    return scene


def simulated(scene: Scene, **options: Any) -> Trajectory:
    return simulate(scene, **{"duration": 0.06, "time_step": 0.01, "record": True, **options})


def simulated_and_profiled(scene: Scene, **options: Any) -> tuple[Trajectory, dict[str, Any]]:
    with profiled() as profile:
        found = simulated(scene, profile=profile, **options)
    return found, total([profile.timings()])


def assert_same_bits(one: Trajectory, other: Trajectory) -> None:
    for name in ARRAYS:
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    assert one.counters == other.counters and (one.status, one.reason) == (other.status, other.reason)


def seconds(profile: dict[str, Any]) -> dict[str, float]:
    return {name: row["seconds"] for name, row in profile["categories"].items()}


# -- the clock ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def hand(monkeypatch):
    """Return a function that lets time go on by so many seconds; nothing else does."""
    now = [0.0]
    monkeypatch.setattr(profiling.time, "perf_counter", lambda: now[0])

    def wait(duration: float) -> None:
        now[0] += duration

    return wait


def test_time_counts_once_for_the_innermost_category(hand):
    clock = Clock()
    hand(1.0)
    clock.begin_steps()
    search = clock.timed(lambda: hand(2.0), "contact_search")

    def gradient() -> str:
        hand(4.0)
        search()
        clock.timed(lambda: hand(8.0), "contact_gradient")()
        return "found"

    assert clock.timed(gradient, "contact_gradient")() == "found"
    hand(16.0)
    clock.tick()
    expected = {"set_up": 1.0, "contact_search": 2.0, "contact_gradient": 12.0, "rest": 16.0}
    assert clock.seconds == {**dict.fromkeys(CATEGORIES, 0.0), **expected}
    calls = {"set_up": 1, "contact_search": 1, "contact_gradient": 1}
    assert clock.calls == {**dict.fromkeys(CATEGORIES, 0), **calls}, "a call from within its own category is none"


def test_what_is_timed_as_a_whole_takes_all_but_compiling(hand):
    clock = Clock()
    clock.begin_steps()
    compiling = clock.timed(lambda: hand(1.0), "compile")

    def factorise() -> None:
        hand(2.0)
        compiling()

    clock.timed(clock.timed(factorise, "factorisation"), "early_verdict")()
    assert clock.seconds["early_verdict"] == 2.0 and clock.seconds["compile"] == 1.0
    assert clock.seconds["factorisation"] == 0.0 and clock.calls["factorisation"] == 0


def test_the_clock_goes_on_after_an_exception(hand):
    clock = Clock()
    clock.begin_steps()

    def fail() -> None:
        hand(1.0)
        raise ValueError("no")

    with pytest.raises(ValueError):
        clock.timed(fail, "solves")()
    hand(2.0)
    clock.tick()
    assert (clock.seconds["solves"], clock.seconds["rest"]) == (1.0, 2.0)


def test_compiling_is_told_apart():
    @njit
    def cube(x):
        return x * x * x

    with profiled() as profile:
        assert cube(2.0) == 8.0
    found = total([profile.timings()])
    compiled = hasattr(cube, "signatures")
    assert (found["categories"]["compile"]["calls"] > 0) == (seconds(found)["compile"] > 0.0) == compiled


# -- simulations -------------------------------------------------------------------------------------------------------


def test_categories_add_up_to_the_wall_time():
    simulated(pressed())  # compiles
    begun = time.perf_counter()
    with profiled() as profile:
        found = simulated(pressed(), profile=profile, duration=0.2)
    wall = time.perf_counter() - begun
    told = total([profile.timings()])
    parts = seconds(told)
    assert set(parts) == set(CATEGORIES) and min(parts.values()) >= 0.0
    assert told["seconds"] == pytest.approx(sum(parts.values())) and told["simulations"] == 1
    assert told["seconds"] == pytest.approx(wall, rel=0.05)
    assert found.timings["set_up"] + found.timings["steps"] == pytest.approx(wall, rel=0.1)
    assert sum(row["share"] for row in told["categories"].values()) == pytest.approx(1.0)
    steps = told["steps"]
    assert steps["seconds"] == pytest.approx(sum(parts[name] for name in (*KERNELS, "rest")))
    assert steps["kernels_share"] == pytest.approx(sum(parts[name] for name in KERNELS) / steps["seconds"])
    spared = sum(row["seconds"] for row in steps["avoidable"].values())
    assert steps["unavoidable_share"] == pytest.approx(steps["kernels_share"] - spared / steps["seconds"])
    for row in told["categories"].values():
        assert row["ms_per_call"] == (pytest.approx(1e3 * row["seconds"] / row["calls"]) if row["calls"] else None)


def test_calls_agree_with_the_counters():
    found, told = simulated_and_profiled(pressed())
    calls = {name: row["calls"] for name, row in told["categories"].items()}
    assert calls["factorisation"] >= found.counters["factorisations"] > 0, "one in single precision may be repeated"
    assert calls["recording"] == found.n_frames - 1, "the first frame is of the set-up"
    assert calls["contact_search"] > found.counters["newton_iterations"] and calls["early_verdict"] == 0
    avoidable = told["steps"]["avoidable"]
    assert avoidable["rejected_steps"] == {"seconds": 0.0, "calls": 0} and not found.counters["rejected_steps"]
    assert avoidable["line_search_trials"]["calls"] == found.counters["line_search_steps"]


def test_rejected_steps_are_avoidable_as_a_whole():
    hopeless = registry.create(
        "stepper", {"name": "implicit_euler", "max_iterations": 1, "tolerance_N": 1e-300, "quasi_newton": False}
    )
    found, told = simulated_and_profiled(pressed(), stepper=hopeless)
    assert found.status == "diverged" and found.counters["rejected_steps"] == 9
    avoidable = told["steps"]["avoidable"]
    assert avoidable["rejected_steps"]["calls"] == 9 and avoidable["line_search_trials"]["calls"] == 0
    assert told["steps"]["kernels_share"] > 0.0
    assert told["steps"]["unavoidable_share"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("stepper", [
    "implicit_euler", "bdf2", "quasi_static",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("imex", "explicit")),
])  # fmt: skip
def test_no_result_depends_on_a_profile(stepper):
    soft = {"name": "penalty", "stiffness_N_mm3": 0.1}  # those with substeps need few for that
    options = {"stepper": stepper, "contact": soft, "duration": 0.02}
    plain = simulated(pressed(), **options)
    found, told = simulated_and_profiled(pressed(), **options)
    assert plain.status == "ok" and plain.rigid_positions[-1, 0, 2] > 0.0195, "it was to fall by 2 mm"
    assert_same_bits(plain, found)
    parts = seconds(told)
    for name in ("elastic_gradient", "contact_search", "contact_gradient", "contact_update", "assembly"):
        assert parts[name] > 0.0, name
    assert (parts["factorisation"] > 0.0) == (stepper != "explicit")


@pytest.mark.parametrize("elasticity", ["corotated", "linear", "neo_hookean"])
def test_nor_do_damped_ones_and_those_of_other_elasticities(elasticity):
    def scene() -> Scene:
        made = pressed(rayleigh_mass=1.0, rayleigh_stiffness=1e-3)
        made.soft_bodies[0].elasticity = registry.create("elasticity", elasticity)
        return made

    found, told = simulated_and_profiled(scene())
    assert_same_bits(simulated(scene()), found)
    assert seconds(told)["elastic_gradient"] > 0.0 and seconds(told)["elastic_hessian"] > 0.0


def test_nor_do_contacts_that_couple_soft_faces():
    def stack() -> Scene:
        scene = Scene()
        scene.add_plane()
        for i in range(2):
            block = box_mesh((0.02, 0.02, 0.01), (2, 2, 1))
            block.vertices[:, 2] += 0.0103 * i
            scene.add_soft(block, Material(**RUBBER), name=f"block {i}")
        return scene

    for contact in ("penalty", "ipc"):
        found, told = simulated_and_profiled(stack(), contact=contact)
        assert found.contact_forces[-1].min() > 0.0
        assert_same_bits(simulated(stack(), contact=contact), found)
        assert told["categories"]["contact_search"]["calls"] > 0
        assert told["categories"]["factorisation"]["calls"] >= found.counters["factorisations"], "of all solvers"


def test_a_run_goes_on_from_its_checkpoint_with_a_profile(tmp_path):
    whole = simulated(pressed())
    with pytest.raises(KeyboardInterrupt):
        simulated(pressed(), checkpoint=tmp_path / "run.npz", checkpoint_every=0.0, watch=interrupt)
    found, told = simulated_and_profiled(pressed(), checkpoint=tmp_path / "run.npz", checkpoint_every=0.0)
    assert_same_bits(whole, found)
    assert told["categories"]["recording"]["calls"] > 4, "checkpoints are counted beside frames"


def interrupt(system: System, state: Any) -> None:
    if state.time > 0.025:
        raise KeyboardInterrupt


# -- who does not ask, pays nothing ------------------------------------------------------------------------------------


def wrapped(system: System) -> list[str]:
    """Return what of a system is not its own."""
    own = vars(System(pressed(), contact=registry.create("contact", "penalty")))
    found = [name for name in vars(system) if name not in own]
    found += [name for name in METHODS if getattr(system, name).__func__ is not getattr(System, name)]
    parts = {"contact": system.contact, "potential": system.potentials[0], "derivatives": system.derivatives}
    found += [name for name, part in parts.items() if isinstance(part, Timed) or "clear_gradient" in vars(part)]
    found += [name for name in ("_fill", "add_gradient") if name in vars(system.contact)]
    for solver in system._solvers.values():
        found += [name for name in ("_renewed_cg", "_direct", "solve") if name in vars(solver)]
        found += ["factorisation"] if isinstance(solver._factorisation, Timed) else []
        found += ["rows"] if "fill" in vars(solver._factorisation._rows) else []
    return found


def test_without_a_profile_nothing_is_wrapped_and_with_one_only_until_its_end():
    seen: list[System] = []
    simulated(pressed(), watch=lambda system, state: seen.append(system))
    assert seen and wrapped(seen[-1]) == []
    with profiled() as profile:
        inside: list[bool] = []

        def watch(system: System, state: Any) -> None:
            seen.append(system)
            inside.append(isinstance(system.contact, Timed) and isinstance(system.potentials[0], Timed))

        simulated(pressed(), watch=watch, profile=profile)
    assert inside and all(inside)
    assert wrapped(seen[-1]) == []


def test_without_a_profile_its_module_is_not_even_imported():
    code = (
        "import sys; import finqd.cli, finqd.evaluate; from finqd.mechanics.material import Material\n"
        "from finqd.mesh_shapes import box_mesh; from finqd.scene import Scene; from finqd.simulate import simulate\n"
        "rubber = Material(youngs_modulus=1e6, poisson_ratio=0.4, density=1e3)\n"
        "scene = Scene(); scene.add_soft(box_mesh((1, 1, 1), (1, 1, 1)), rubber)\n"
        "assert simulate(scene, duration=0.01, time_step=0.01).status == 'ok'\n"
        "assert 'finqd.profiling' not in sys.modules and 'finqd.mechanics.newton' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# -- plugins of others -------------------------------------------------------------------------------------------------


class BareContact:
    """A contact with the methods of the contract and no others; nothing can be written to it."""

    __slots__ = ("_own",)

    def __init__(self, own: Any) -> None:
        object.__setattr__(self, "_own", own)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(name)

    soft_forces = property(lambda self: self._own.soft_forces)
    relagged_forces = property(lambda self: self._own.relagged_forces)
    penetration = property(lambda self: self._own.penetration)

    def bind(self, pattern):
        self._own.bind(pattern)

    def begin_step(self, state):
        self._own.begin_step(state)

    def relag(self, state, *, whole=False):
        return self._own.relag(state, whole=whole)

    def energy(self, state):
        return self._own.energy(state)

    def add_gradient(self, state, derivatives):
        return self._own.add_gradient(state, derivatives)

    def add_hessian(self, state, derivatives, *, projected=False):
        self._own.add_hessian(state, derivatives, projected=projected)

    def step_limit(self, state, direction):
        return self._own.step_limit(state, direction)

    def commit(self, state):
        self._own.commit(state)


@dataclass(frozen=True, kw_only=True)
class Bare:
    """The plugin of it."""

    def potential(self, scene: Scene) -> BareContact:
        return BareContact(registry.create("contact", {"name": "penalty", "soft_contact": False}).potential(scene))


def test_a_contact_with_nothing_but_its_contract_is_timed_by_that():
    found, told = simulated_and_profiled(pressed(), contact=Bare())
    assert_same_bits(simulated(pressed(), contact=Bare()), found)
    categories = told["categories"]
    assert categories["contact_search"]["calls"] == 0, "it counts where it is called"
    for name in ("contact_gradient", "contact_hessian", "contact_step_limit", "contact_update"):
        assert categories[name]["calls"] > 0 and categories[name]["seconds"] > 0.0, name


# -- linear solvers ----------------------------------------------------------------------------------------------------


def small_system() -> tuple[LinearSolver, CoupledMatrix, np.ndarray]:
    pattern = BlockPattern.from_cliques(2, [np.array([[0, 1]])])
    blocks = pattern.new_blocks()
    blocks[pattern.indptr[:-1]] = 2.0 * np.eye(3)
    matrix = CoupledMatrix(pattern, blocks, np.zeros((6, 0)), np.zeros((0, 0)))
    return make_solver(pattern, backend="qdldl"), matrix, np.ones(6)


def test_a_factorisation_that_takes_the_place_of_another_is_timed_too():
    solver, matrix, rhs = small_system()
    with profiled() as profile:
        profile.clock.begin_steps()
        timed = profile.timed_solver(solver)
        first = solver._factorisation
        solver._precise_cg(matrix, rhs, 1e-6)
        assert profile.clock.calls["factorisation"] == 1 and isinstance(solver._factorisation, Timed)
        assert solver._factorisation is not first
        inverse = timed.lagged
        assert inverse is timed.lagged, "an inverse is told from another by identity"
        timed.forget()
        assert timed.lagged is None
        blocks = (matrix.blocks, matrix.coupling, matrix.rigid)
        assert timed.solve(*blocks, rhs, np.zeros(0)).soft == pytest.approx(0.5 * rhs)
        assert timed.lagged is not None and timed.lagged is not inverse
        before = profile.clock.calls["solves"]
        assert timed.lagged.apply(rhs) == pytest.approx(0.5 * rhs)
        assert profile.clock.calls["solves"] == before + 1 and profile.clock.calls["assembly"] == 2
    assert "_precise_cg" not in vars(solver) and "_renewed_cg" not in vars(solver)
    assert not isinstance(solver._factorisation, Timed) and "fill" not in vars(solver._factorisation._rows)


# -- evaluations -------------------------------------------------------------------------------------------------------


def run(**options: Any) -> dict[str, Any]:
    design = Design.from_json(designs_folder() / "benchmark.json")
    return evaluate(design, objects=OBJECTS, preset="draft", overrides=SHORT, **options).to_dict()


def untimed(result: dict) -> str:
    """Return the JSON of a result without what a clock said."""
    rows = {name: {**row, "seconds": None} for name, row in result["objects"].items()}
    whole = {**result, "objects": rows, "timings": None, "profile": None}
    return json.dumps(whole, allow_nan=False, sort_keys=True)


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    return run()


def test_an_evaluation_is_profiled_only_if_asked_for(plain):
    assert "profile" not in plain
    assert not any("profile" in name for name in plain["timings"])


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_profile_comes_from_processes_too_and_changes_no_bit(plain, jobs):
    result = run(profile=True, jobs=jobs)
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert untimed(result) == untimed(plain)
    told, timings = result["profile"], result["timings"]
    parts = seconds(told)
    assert told["simulations"] == 2 and min(parts.values()) >= 0.0
    assert parts["mesh"] == pytest.approx(timings["mesh"]) and parts["set_up"] > timings["geometry"]
    assert parts["compile"] == pytest.approx(timings["compile"], rel=0.02, abs=0.02)
    inside = sum(row["seconds"] for row in result["objects"].values())
    assert told["seconds"] >= inside + timings["geometry"] + timings["mesh"]
    if jobs == 1:
        assert told["seconds"] == pytest.approx(timings["total"], rel=0.05, abs=0.05)
    counters = [row["counters"] for row in result["objects"].values()]
    factorised = sum(count["factorisations"] for count in counters)
    assert told["categories"]["factorisation"]["calls"] >= factorised
    assert told["steps"]["avoidable"].keys() == set(AVOIDABLE)


def test_a_trajectory_with_a_profile_can_be_kept(tmp_path):
    with profiled() as profile:
        profile.clock.begin_steps()
    kept = Trajectory(status="ok", timings=profile.timings())
    kept.save(tmp_path / "run.npz")
    assert total([Trajectory.load(tmp_path / "run.npz").timings]) == total([kept.timings])


def test_where_nothing_was_simulated_there_is_a_profile_all_the_same(capsys):
    told = total([{"set_up": 1.0}], set_up=0.5, mesh=1.5)
    assert told["simulations"] == 0 and told["seconds"] == 2.0 and told["steps"]["kernels_share"] is None
    assert told["categories"]["mesh"]["calls"] == 1 and told["categories"]["rest"]["ms_per_call"] is None
    print_profile(json.loads(json.dumps(told, allow_nan=False)))
    out = capsys.readouterr().out
    assert "profile of 0 simulations" in out and "75.0 %" in out and "no method of this kind can avoid: -" in out


def test_the_command_prints_the_table_and_writes_it(tmp_path, capsys):
    settings = [word for key, value in SHORT.items() for word in ("--set", f"{key}={value}")]
    with pytest.raises(SystemExit) as ended:
        cli.main(["evaluate", "benchmark", "--objects", "sphere", "--preset", "draft", "--jobs", "1", *settings,
                  "--profile", "--out", str(tmp_path / "result.json")])
    assert ended.value.code == 0
    told = json.loads((tmp_path / "result.json").read_text())["profile"]
    lines = capsys.readouterr().out.splitlines()
    begun = next(i for i, line in enumerate(lines) if line.startswith("profile of 1 simulation, added up"))
    table = {line[4:22].strip(): line[22:].split() for line in lines[begun + 2 :]}
    for name, row in told["categories"].items():
        first, share, percent, calls = table[name.replace("_", " ")][:4]
        assert (first, percent) == (f"{row['seconds']:.3f}", "%"), name
        assert (share, calls) == (f"{100 * row['share']:.1f}", str(row["calls"] or "-")), name
    assert not any("…" in line for line in lines[begun:])
    text = " ".join(line.strip() for line in lines[begun:])
    assert f"factorisation and solves are {100 * told['steps']['kernels_share']:.1f} %" in text
    assert f"can avoid: {100 * told['steps']['unavoidable_share']:.1f} %" in text
