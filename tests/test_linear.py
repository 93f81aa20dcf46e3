"""Linear solvers: every method and backend against dense algebra, inertia, lagging, determinism."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finqd.errors import InputError
from finqd.mechanics.linear import make_solver
from finqd.mechanics.linear_backends import QdldlFactorisation, Rows, available_backends, create_factorisation
from finqd.mechanics.linear_kernels import coupled_product, dot, subtract_product, transposed_product
from finqd.mechanics.pattern import BlockPattern

SOLVERS = [
    *({"method": "direct", "backend": name} for name in available_backends()),
    *({"method": "cg", "backend": name} for name in available_backends()),
    {"preconditioner": "block_jacobi"},
    {"preconditioner": "jacobi"},
]


class System:
    """A random coupled system: 4-vertex elements along a chain, some vertices held, ``bodies`` rigid bodies."""

    def __init__(self, seed: int, *, vertices: int = 30, bodies: int = 1, shift: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        n, m = vertices, 6 * bodies
        elements = np.array([[i, i + 1, i + 2, (i * 7 + 3) % n] for i in range(n - 2)])
        elements = elements[[len(set(e)) == 4 for e in elements.tolist()]]
        self.pattern = BlockPattern.from_cliques(n, [elements])
        slots = self.pattern.slots(elements)
        self.blocks = self.pattern.new_blocks()
        self.coupling, self.rigid = np.zeros((3 * n, m)), 0.3 * np.eye(m)
        for slot in slots:
            factor = rng.normal(size=(12, 10))
            add = (factor @ factor.T).reshape(4, 3, 4, 3).transpose(0, 2, 1, 3)
            np.add.at(self.blocks, slot.reshape(-1), add.reshape(-1, 3, 3))
        diagonal = self.pattern.indptr[:-1]
        self.blocks[diagonal] += (0.1 - shift) * np.eye(3)
        for vertex in range(10, 16):  # contacts: k g g^T with g over one vertex and one body
            if m:
                g = np.zeros(3 * n + m)
                g[3 * vertex : 3 * vertex + 3] = rng.normal(size=3)
                body = 3 * n + 6 * (vertex % bodies)
                g[body : body + 6] = rng.normal(size=6)
                self.add(10.0 * np.outer(g, g), vertex)
        rows = np.repeat(np.arange(n), np.diff(diagonal, append=self.pattern.n_blocks))
        held = np.isin(rows, (0, 1)) | np.isin(self.pattern.indices, (0, 1))
        self.blocks[:-1][held] = 0.0
        self.blocks[diagonal[:2]] = np.eye(3)
        self.coupling[:6] = 0.0
        self.rhs_soft, self.rhs_rigid = rng.normal(size=(n, 3)), rng.normal(size=m)

    def add(self, dense: np.ndarray, vertex: int) -> None:
        size = len(self.coupling)
        place = slice(3 * vertex, 3 * vertex + 3)
        self.blocks[self.pattern.slots(np.array([[vertex]]))[0, 0, 0]] += dense[place, place]
        self.coupling += dense[:size, size:]
        self.rigid += dense[size:, size:]

    @property
    def dense(self) -> np.ndarray:
        soft = self.pattern.matrix(self.blocks).toarray()
        return np.block([[soft, self.coupling], [self.coupling.T, self.rigid]])

    @property
    def exact(self) -> np.ndarray:
        return np.linalg.solve(self.dense, np.concatenate([self.rhs_soft.reshape(-1), self.rhs_rigid]))

    def solve(self, solver, **options):
        return solver.solve(self.blocks, self.coupling, self.rigid, self.rhs_soft, self.rhs_rigid, **options)


def error(solution, exact: np.ndarray) -> float:
    found = np.concatenate([solution.soft.reshape(-1), solution.rigid.reshape(-1)])
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


@pytest.mark.parametrize("options", SOLVERS, ids=lambda o: "-".join(o.values()))
@pytest.mark.parametrize("bodies", [0, 1, 2])
def test_every_solver_agrees_with_dense_algebra(options, bodies):
    system = System(bodies, bodies=bodies)
    solution = system.solve(make_solver(system.pattern, tolerance=1e-11, **options))
    assert solution.converged and solution.definite
    assert solution.soft.shape == system.rhs_soft.shape and solution.rigid.shape == system.rhs_rigid.shape
    assert error(solution, system.exact) < 1e-8
    assert solution.factorised == ("preconditioner" not in options)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    vertices=st.integers(17, 60),
    bodies=st.integers(0, 3),
    method=st.sampled_from(["cg", "direct"]),
)
def test_any_positive_system_is_solved(seed, vertices, bodies, method):
    system = System(seed, vertices=vertices, bodies=bodies)
    solution = system.solve(make_solver(system.pattern, method=method, tolerance=1e-10))
    assert solution.definite and solution.converged
    assert error(solution, system.exact) < 1e-6


@pytest.mark.parametrize("options", SOLVERS, ids=lambda o: "-".join(o.values()))
@pytest.mark.parametrize("where", ["soft", "rigid"])
def test_an_indefinite_system_is_reported(options, where):
    system = System(3, bodies=1, shift=30.0 if where == "soft" else 0.0)
    if where == "rigid":
        system.rigid[2, 2] -= 200.0
    assert np.linalg.eigvalsh(system.dense)[0] < 0.0
    solution = system.solve(make_solver(system.pattern, tolerance=1e-10, **options))
    assert not solution.definite
    assert np.all(np.isfinite(solution.soft)) and np.all(np.isfinite(solution.rigid))
    if solution.converged:
        assert error(solution, system.exact) < 1e-6


@pytest.mark.parametrize("backend", available_backends())
def test_the_inertia_agrees_with_the_eigenvalues(backend):
    """From clearly positive to clearly negative, with one eigenvalue crossing zero at a time."""
    system = System(5, bodies=0)
    values = np.linalg.eigvalsh(system.dense)
    factorisation = create_factorisation(backend, system.pattern)
    for shift in (0.0, 0.5 * values[0], 0.5 * (values[0] + values[1]), 0.5 * (values[3] + values[4])):
        blocks = system.blocks.copy()
        blocks[system.pattern.indptr[:-1]] -= shift * np.eye(3)
        try:
            positive = factorisation.factorise(blocks)
        except np.linalg.LinAlgError:
            positive = False
        assert positive == (shift < values[0])


@pytest.mark.parametrize("options", SOLVERS, ids=lambda o: "-".join(o.values()))
def test_a_singular_or_broken_system_is_reported(options):
    system = System(3, bodies=1)
    solver = make_solver(system.pattern, **options)
    system.rigid[:] = 0.0
    system.coupling[:] = 0.0
    assert not system.solve(solver).definite
    system = System(3, bodies=1)
    system.blocks[5] = np.nan
    solution = system.solve(solver)
    assert not (solution.definite and solution.converged)
    assert np.all(np.isfinite(solution.soft))
    good = System(4, bodies=1)
    assert error(good.solve(solver, tolerance=1e-10), good.exact) < 1e-6


@pytest.mark.parametrize("backend", available_backends())
def test_a_lagged_preconditioner_serves_a_changed_system(backend):
    system = System(7, bodies=1)
    solver = make_solver(system.pattern, backend=backend, tolerance=1e-9, refactor_cost=20.0)
    first = system.solve(solver)
    assert first.factorised and first.iterations == 1 + (backend == "pardiso")  # which is in single precision
    system.blocks *= 1.05
    system.add(10.0 * np.outer(_contact(system, 20), _contact(system, 20)), 20)
    second = system.solve(solver)
    assert not second.factorised and 1 < second.iterations <= 12 and second.converged
    assert error(second, system.exact) < 1e-7


def _contact(system: System, vertex: int) -> np.ndarray:
    g = np.zeros(len(system.dense))
    g[3 * vertex : 3 * vertex + 3] = (1.0, -0.5, 0.3)
    g[-6:-3] = (-1.0, 0.5, -0.3)
    return g


def test_a_useless_preconditioner_is_replaced_in_the_same_solve():
    first, second = System(1, bodies=1), System(2, bodies=1)
    solver = make_solver(first.pattern, tolerance=1e-10, refactor_cost=6.0)
    first.solve(solver)
    solution = second.solve(solver)
    single = available_backends()[0] == "pardiso"  # then it takes two iterations to 1e-10, else one
    assert solution.factorised and solution.iterations == 7 + single and solution.converged
    assert error(solution, second.exact) < 1e-8
    again = second.solve(solver)
    assert not again.factorised and again.iterations == 1 + single


class Rounded(QdldlFactorisation):
    """A factorisation in single precision for machines without a library that has one: all that goes in is rounded."""

    single = True

    def factorise(self, blocks):
        return super().factorise(blocks.astype(np.float32).astype(float))

    def solve(self, rhs):
        return super().solve(rhs.astype(np.float32).astype(float)).astype(np.float32).astype(float)


@pytest.fixture
def made(monkeypatch):
    """Let solvers begin in single precision on every machine; return the precision of what they make, in turn."""
    made = []

    def create(backend, pattern, *, single=False):
        made.append("single" if single else "double")
        return (Rounded if single else QdldlFactorisation)(pattern)

    monkeypatch.setattr("finqd.mechanics.linear.create_factorisation", create)
    return made


def _chain(stiffness: float) -> System:
    """Return a system of springs along a chain, held at its start, of condition about ``stiffness``."""
    system = System(1, bodies=0, vertices=40)
    system.blocks[:] = 0.0
    n = system.pattern.n_vertices
    for i in range(n - 1):
        slot = system.pattern.slots(np.array([[i, i + 1]]))[0]
        for a in range(2):
            for b in range(a, 2):
                system.blocks[slot[a, b]] += (1.0 if a == b else -1.0) * np.eye(3) * stiffness / n**2
    system.blocks[system.pattern.indptr[:-1]] += 1e-3 * np.eye(3)
    return system


def test_a_well_conditioned_system_is_served_in_single_precision(made):
    system = System(7, bodies=1)
    solver = make_solver(system.pattern, tolerance=1e-10)
    for _ in range(3):
        solver.forget()
        solution = system.solve(solver)
        assert solution.factorised and solution.converged and 1 < solution.iterations <= 4
        assert error(solution, system.exact) < 1e-8
    assert made == ["single"]


def test_what_single_precision_cannot_tell_from_indefinite_is_factorised_in_double(made):
    system = _chain(1e9)
    assert np.linalg.eigvalsh(system.dense)[0] > 0.0
    rounded = system.blocks.astype(np.float32).astype(float)
    assert np.linalg.eigvalsh(system.pattern.matrix(rounded).toarray())[0] < 0.0, "not as hard as it is meant to be"
    solution = system.solve(make_solver(system.pattern, tolerance=1e-8))
    assert solution.definite and solution.converged and made == ["single", "double"]
    assert error(solution, system.exact) < 1e-5


def test_an_indefinite_system_is_no_reason_for_double_precision_unless_it_lasts(made):
    good, bad = System(3, bodies=1), System(3, bodies=1, shift=30.0)
    solver = make_solver(good.pattern, tolerance=1e-8)
    for system, definite in ((good, True), (bad, False), (good, True), (bad, False)):
        solver.forget()
        assert system.solve(solver).definite == definite
    assert made == ["single"]
    solver.forget()
    assert not bad.solve(solver).definite
    assert made == ["single", "double"]
    solver.forget()
    assert good.solve(solver).converged


@pytest.mark.parametrize("cost", [1.0, 5.0, 20.0, 200.0])
def test_the_lagged_inverse_is_replaced_near_the_cheapest_moment(cost):
    """One stiff spring more a system: total cost within a third of the best fixed period, found by trying them all."""
    periods = range(1, 31)

    def run(period: int | None) -> float:
        system = System(1, bodies=1)
        solver = make_solver(system.pattern, tolerance=1e-8, refactor_cost=cost if period is None else 1e9)
        total = 0.0
        for step in range(30):
            vertex = 2 + step % 28
            system.add(10.0 * np.outer(_contact(system, vertex), _contact(system, vertex)), vertex)
            if period is not None and step % period == 0:
                solver.forget()
            solution = system.solve(solver)
            assert solution.converged
            total += solution.iterations + cost * solution.factorised
        return total

    assert run(None) <= 1.34 * min(run(period) for period in periods)


@pytest.mark.parametrize("options", SOLVERS, ids=lambda o: "-".join(o.values()))
def test_the_same_input_gives_the_same_bits(options):
    results = []
    for padding in (1, 3):  # other addresses, other alignment
        system = System(11, vertices=50, bodies=2)
        solver = make_solver(system.pattern, **options)
        system.solve(solver)
        shifted = np.empty(system.blocks.size + padding)[padding:]
        shifted[:] = 1.02 * system.blocks.reshape(-1)
        system.blocks = shifted.reshape(system.blocks.shape)
        solution = system.solve(solver)
        results.append(np.concatenate([solution.soft.reshape(-1), solution.rigid]))
    assert results[0].tobytes() == results[1].tobytes()


@pytest.mark.parametrize("options", SOLVERS, ids=lambda o: "-".join(o.values()))
def test_a_scene_of_rigid_bodies_alone_is_solved(options):
    pattern = BlockPattern.from_cliques(0, [])
    factor = np.random.default_rng(0).normal(size=(6, 6))
    rigid, rhs = factor @ factor.T + np.eye(6), np.arange(6.0)
    solution = make_solver(pattern, tolerance=1e-12, **options).solve(
        np.zeros((0, 3, 3)), np.zeros((0, 6)), rigid, np.zeros((0, 3)), rhs.reshape(1, 6)
    )
    assert solution.converged and solution.definite and solution.rigid.shape == (1, 6)
    np.testing.assert_allclose(solution.rigid.reshape(-1), np.linalg.solve(rigid, rhs), rtol=1e-8, atol=1e-10)


def test_a_zero_right_hand_side_gives_zero():
    system = System(1)
    system.rhs_soft[:] = 0.0
    system.rhs_rigid[:] = 0.0
    for options in SOLVERS:
        solution = system.solve(make_solver(system.pattern, **options))
        assert solution.converged and not solution.soft.any() and not solution.rigid.any()


def test_unknown_choices_are_refused_with_the_known_ones():
    pattern = System(1).pattern
    for options, known in (
        ({"method": "gmres"}, "cg, direct"),
        ({"preconditioner": "ilu"}, "block_jacobi"),
        ({"backend": "umfpack"}, "qdldl"),
    ):
        with pytest.raises(InputError, match=known):
            make_solver(pattern, **options)


def test_solvers_give_their_memory_back():
    import resource

    system = System(1, vertices=400, bodies=0)

    def run() -> int:
        for _ in range(20):
            system.solve(make_solver(system.pattern))
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    run()
    before = run()
    assert run() - before < 8 * 1024  # [kB]


@pytest.mark.kernel
@pytest.mark.parametrize("bodies", [0, 1, 2])
def test_kernels_agree_with_dense_products(bodies):
    system = System(4, bodies=bodies)
    rng = np.random.default_rng(0)
    x = rng.normal(size=len(system.dense))
    product = np.full(len(x), np.nan)
    pattern = system.pattern
    coupled_product(pattern.indptr, pattern.indices, system.blocks, system.coupling, system.rigid, x, product)
    np.testing.assert_allclose(product, system.dense @ x, rtol=1e-12, atol=1e-11)
    assert dot(x, product) == pytest.approx(x @ product, rel=1e-12)
    soft, rigid = x[: len(system.coupling)].copy(), x[len(system.coupling) :].copy()
    carried = np.empty(len(rigid))
    transposed_product(system.coupling, soft, carried)
    np.testing.assert_allclose(carried, system.coupling.T @ soft, atol=1e-12)
    expected = soft - system.coupling @ rigid
    subtract_product(system.coupling, rigid, soft)
    np.testing.assert_allclose(soft, expected, atol=1e-12)


@pytest.mark.kernel
@pytest.mark.parametrize("part", ["lower", "upper", "full"])
def test_rows_hold_one_triangle_of_the_matrix(part):
    system = System(4, bodies=0)
    rows = Rows(system.pattern, part)
    rows.fill(system.blocks)
    expected = {"lower": np.tril, "upper": np.triu, "full": np.asarray}[part](system.dense)
    np.testing.assert_array_equal(rows.as_columns().toarray().T, expected)
