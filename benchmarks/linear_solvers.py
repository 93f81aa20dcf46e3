"""What the linear solvers cost on the Newton systems of a real grasp: the benchmark gripper closing on a sphere.

    python benchmarks/linear_solvers.py [--object sphere] [--until 1.0] [--repeat 7]

First table: one factorisation, triangular solves and a product, by backend. Second table: all systems of successive
time steps, one after the other, by method; "per system" includes everything. Milliseconds of processor time, the
fastest of the repeats; one thread.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402

from finqd.data import designs_folder  # noqa: E402
from finqd.design import Design  # noqa: E402
from finqd.grasp import GraspTask, grasp_scene  # noqa: E402
from finqd.mechanics.linear import LinearSolver, make_solver  # noqa: E402
from finqd.mechanics.linear_backends import available_backends, create_factorisation  # noqa: E402
from finqd.mechanics.pattern import BlockPattern  # noqa: E402
from finqd.mechanics.preconditioners import CoupledMatrix  # noqa: E402
from finqd.objects import load_object  # noqa: E402
from finqd.simulate import simulate  # noqa: E402

KEPT = 24


@dataclass(frozen=True)
class Newton:
    """One Newton system: soft blocks, coupling, rigid matrix and right-hand sides."""

    blocks: np.ndarray
    coupling: np.ndarray
    rigid: np.ndarray
    rhs_soft: np.ndarray
    rhs_rigid: np.ndarray

    def solve(self, solver: LinearSolver, tolerance: float):
        """Solve by ``solver``."""
        parts = (self.blocks, self.coupling, self.rigid, self.rhs_soft, self.rhs_rigid)
        return solver.solve(*parts, tolerance=tolerance)


def grasp_systems(object_name: str, until: float) -> tuple[BlockPattern, list[Newton]]:
    """Return the sparsity and the last systems of a grasp that is stopped at ``until`` [s]."""
    design = Design.from_json(designs_folder() / "benchmark.json")
    mesher, geometry = design.plugin("mesher"), design.plugin("geometry")
    meshes = tuple(mesher.mesh(geometry.build(design.finger_si(i))) for i in range(len(design.fingers)))
    scene = grasp_scene(GraspTask(design=design, meshes=meshes, grasped=load_object(object_name)))
    kept: list[Newton] = []
    patterns: list[BlockPattern] = []

    def keep(system, state) -> None:
        d = system.derivatives
        patterns[:] = [system.pattern]
        free = np.where(system.fixed, 0.0, system.forces)  # gravity: a smooth right-hand side, as a step has it
        rigid = np.hstack([system.rigid_forces, np.full((system.n_rigid, 3), 1e-3)])
        kept.append(Newton(d.blocks.copy(), d.coupling.copy(), d.rigid_matrix.copy(), free, rigid))
        del kept[:-KEPT]

    simulate(scene, duration=until, time_step=0.01, watch=keep)
    return patterns[0], kept


def fastest(function: Callable[[], object], repeat: int) -> float:
    """Return the smallest processor time of ``repeat`` calls [ms]."""
    times = []
    for _ in range(repeat):
        begun = time.process_time()
        function()
        times.append(time.process_time() - begun)
    return 1e3 * min(times)


def backend_table(pattern: BlockPattern, system: Newton, repeat: int) -> None:
    """Print what factorising and solving costs, by backend, and what a product costs."""
    matrix = CoupledMatrix(pattern, system.blocks, system.coupling, system.rigid)
    x = np.ones(matrix.size)
    matrix.product(x)
    print(f"{3 * pattern.n_vertices} soft and {len(system.rigid)} rigid unknowns, {9 * pattern.n_blocks} numbers")
    print(f"product with the coupled matrix: {fastest(lambda: matrix.product(x), 5 * repeat):.2f} ms\n")
    print("| backend | first factorisation | next ones | solve, 1 | solve, 7 | entries of L |")
    print("|---|---|---|---|---|---|")
    for name in available_backends():
        one, seven = np.ones(3 * pattern.n_vertices), np.ones((3 * pattern.n_vertices, 7), order="F")
        factorisation = create_factorisation(name, pattern)
        first = fastest(lambda f=factorisation: f.factorise(system.blocks), 1)
        again = fastest(lambda f=factorisation: f.factorise(system.blocks), repeat)
        solves = [fastest(lambda f=factorisation, b=b: f.solve(b), repeat) for b in (one, seven)]
        entries = factorisation.factor_entries
        print(f"| {name} | {first:.1f} | {again:.1f} | {solves[0]:.2f} | {solves[1]:.2f} | {entries} |")


def method_table(pattern: BlockPattern, systems: list[Newton], repeat: int) -> None:
    """Print what solving ``systems`` in turn costs, by method."""
    rows: list[tuple[str, dict, float, int]] = []
    for name in available_backends():
        rows.append((f"direct, {name}", {"method": "direct", "backend": name}, 1e-3, repeat))
        for tolerance in (1e-3, 1e-6):
            rows.append((f"cg, lagged {name}, {tolerance:g}", {"backend": name}, tolerance, repeat))
    for name in ("block_jacobi", "jacobi"):
        rows.append((f"cg, {name}, 1e-3", {"preconditioner": name, "max_iterations": 20_000}, 1e-3, 1))
    print(f"\n{len(systems)} systems of successive steps\n")
    print("| method | per system | iterations | factorisations |")
    print("|---|---|---|---|")
    for label, options, tolerance, count in rows:
        used = systems if count > 1 else systems[:2]
        solutions: list = []

        def run(options=options, tolerance=tolerance, used=used, solutions=solutions) -> None:
            solver = make_solver(pattern, **options)
            solutions[:] = [system.solve(solver, tolerance) for system in used]

        spent = fastest(run, max(count // 2, 1)) / len(used)
        iterations = np.mean([s.iterations for s in solutions])
        factorised = np.mean([s.factorised for s in solutions])
        failed = "" if all(s.converged for s in solutions) else " (not converged)"
        print(f"| {label} | {spent:.1f} | {iterations:.1f}{failed} | {factorised:.2f} |")


def main() -> None:
    """Run both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", default="sphere")
    parser.add_argument("--until", type=float, default=1.0, help="when to stop the grasp [s]")
    parser.add_argument("--repeat", type=int, default=7)
    arguments = parser.parse_args()
    pattern, systems = grasp_systems(arguments.object, arguments.until)
    backend_table(pattern, systems[-1], arguments.repeat)
    method_table(pattern, systems, arguments.repeat)


if __name__ == "__main__":
    main()
