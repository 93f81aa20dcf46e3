"""Conformance of elasticity, steppers and contact models: laws that hold whatever the method."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import registry
from finqd.errors import InputError, MeshError
from finqd.mechanics.material import Material

if TYPE_CHECKING:
    from finqd.mechanics.state import State
    from finqd.mechanics.system import System
    from finqd.mesh import Mesh
    from finqd.scene import Scene

RUBBER = Material(youngs_modulus=1e6, poisson_ratio=0.45, density=1000.0)
SIZE = (0.03, 0.02, 0.01)  # of the test box [m]
ELEMENTS = ("hex8", "wedge6", "tet4", "tet10", "hex20")
GRAVITY = 9.81  # [m/s^2]
SINKING_LIMIT = 1e-4  # how far a resting body may sink into a plane [m]


# -- elasticity --------------------------------------------------------------------------------------------------------


def check_takes_some_element(kind: str, name: str) -> None:
    """At least one element type is supported; the others are refused with InputError or MeshError."""
    assert list(_potentials(name)), f"{name!r} takes none of {', '.join(ELEMENTS)}"


def check_rest_costs_nothing(kind: str, name: str) -> None:
    """At rest there is neither energy nor force."""
    for element, mesh, potential in _potentials(name):
        gradient = np.zeros_like(mesh.vertices)
        energy = potential.add_gradient(mesh.vertices, gradient)
        assert abs(energy) < 1e-14 * _energy_scale(), f"{element}: {energy:.3g} J at rest"
        assert np.abs(gradient).max() < 1e-9 * _force_scale(), f"{element}: {np.abs(gradient).max():.3g} N at rest"


def check_rigid_motion_costs_nothing(kind: str, name: str) -> None:
    """However far a body is turned and moved as a whole, it stores no energy and feels no force.

    A law that says ``small_rotation`` of itself is held to that for any motion, and for turns to second order only.
    """
    if getattr(registry.load(kind, name), "small_rotation", False):
        _check_small_turns_cost_nothing(name)
        return
    for element, mesh, potential in _potentials(name):
        for angle in (0.5, 2.0, 3.1):
            moved = mesh.vertices @ _rotation(angle).T + (0.3, -0.2, 0.1)
            gradient = np.zeros_like(moved)
            energy = potential.add_gradient(moved, gradient)
            assert abs(energy) < 1e-12 * _energy_scale(), f"{element}: {energy:.3g} J when turned by {angle} rad"
            assert np.abs(gradient).max() < 1e-7 * _force_scale(), f"{element}: a force when turned by {angle} rad"


def _check_small_turns_cost_nothing(name: str) -> None:
    """Translations cost nothing; a turn by a small angle t costs force of order t^2, energy of order t^4."""
    for element, mesh, potential in _potentials(name):
        moved, gradient = mesh.vertices + (0.3, -0.2, 0.1), np.zeros_like(mesh.vertices)
        energy = potential.add_gradient(moved, gradient)
        assert abs(energy) < 1e-12 * _energy_scale(), f"{element}: {energy:.3g} J when shifted"
        assert np.abs(gradient).max() < 1e-7 * _force_scale(), f"{element}: a force when shifted"
        for angle in (1e-2, 1e-3):
            gradient = np.zeros_like(moved)
            energy = potential.add_gradient(mesh.vertices @ _rotation(angle).T, gradient)
            limit = 10.0 * angle**4 * _energy_scale()  # at 0.01 rad a thousandth of a second-order term
            assert abs(energy) < limit, f"{element}: {energy:.3g} J when turned by {angle} rad: not of fourth order"
            limit = 10.0 * angle**2 * _force_scale()
            assert np.abs(gradient).max() < limit, f"{element}: a force of first order when turned by {angle} rad"


def check_gradient_is_of_the_energy(kind: str, name: str) -> None:
    """The gradient agrees with central differences of the energy, in a turned and strained state; forces balance."""
    for element, mesh, potential in _potentials(name):
        positions, gradient = _strained(mesh), np.zeros_like(mesh.vertices)
        energy = potential.add_gradient(positions, gradient)
        assert np.isclose(energy, potential.energy(positions), rtol=1e-12), f"{element}: two energies of one state"
        assert energy > 0.0, f"{element}: a strained body stores {energy:.3g} J"
        for direction in _directions(mesh):
            h = 1e-6 * min(SIZE)
            ahead, behind = (potential.energy(positions + step * direction) for step in (h, -h))
            slope, given = (ahead - behind) / (2 * h), float(np.vdot(gradient, direction))
            off = abs(given - slope) / np.abs(gradient).max()
            assert off < 1e-5, f"{element}: the energy's slope is {slope:.8g} N, the gradient's {given:.8g} N"
        balance = np.abs(gradient.sum(axis=0)).max()
        assert balance < 1e-9 * np.abs(gradient).sum(), f"{element}: inner forces add up to {balance:.3g} N"


def check_hessian_is_of_the_gradient(kind: str, name: str) -> None:
    """The Hessian is symmetric and agrees with central differences of the gradient; the projected one has no negative
    eigenvalue.
    """
    for element, mesh, potential in _potentials(name):
        positions = _strained(mesh)
        exact = _dense_hessian(potential, positions, projected=False)
        scale = np.abs(exact).max()
        assert np.abs(exact - exact.T).max() < 1e-9 * scale, f"{element}: the Hessian is not symmetric"
        for direction in _directions(mesh):
            h = 1e-6 * min(SIZE)
            ahead, behind = np.zeros_like(positions), np.zeros_like(positions)
            potential.add_gradient(positions + h * direction, ahead)
            potential.add_gradient(positions - h * direction, behind)
            off = exact @ direction.ravel() - (ahead - behind).ravel() / (2 * h)
            error = np.abs(off).max() / scale
            assert error < 1e-5, f"{element}: the Hessian is off by {error:.3g} of its largest entry"
        for state in (mesh.vertices, positions, _squeezed(mesh)):
            lowest = np.linalg.eigvalsh(_dense_hessian(potential, state, projected=True))[0]
            assert lowest > -1e-8 * scale, f"{element}: projected, the lowest eigenvalue is {lowest:.3g} N/m"


def check_knows_its_place_in_the_scene(kind: str, name: str) -> None:
    """With ``first_vertex`` the same body acts on later vertices, and adds to what is there already."""
    for element, mesh, potential in _potentials(name):
        shift, positions = 5, _strained(mesh)
        shifted = registry.create("elasticity", name).potential(mesh, RUBBER, first_vertex=shift)
        padded = np.concatenate([np.full((shift, 3), 7.0), positions])
        alone, together = np.zeros_like(positions), np.ones_like(padded)
        potential.add_gradient(positions, alone)
        shifted.add_gradient(padded, together)
        off = np.abs(together[shift:] - 1.0 - alone).max() / np.abs(alone).max()
        assert off < 1e-9, f"{element}: with first_vertex the gradient is another one, by {off:.3g}"
        assert np.all(together[:shift] == 1.0), f"{element}: it writes to another body's vertices"


ELASTICITY = (
    check_takes_some_element, check_rest_costs_nothing, check_rigid_motion_costs_nothing,
    check_gradient_is_of_the_energy, check_hessian_is_of_the_gradient, check_knows_its_place_in_the_scene,
)


# -- steppers ----------------------------------------------------------------------------------------------------------


def check_falls_freely(kind: str, name: str) -> None:
    """A free body falls g t^2 / 2, up to the first order of the step, and keeps its shape; halving the step halves the
    error at least. A stepper without inertia of soft bodies says so (``inertia = False``), and lets rigid ones fall.
    """
    if not _has_inertia(name):
        return _rigid_body_falls(name)
    duration, errors = 0.1, []
    exact = 0.5 * GRAVITY * duration**2
    for dt in (0.01, 0.005):
        moves = [state.positions for state in _simulated(_box_scene(), duration=duration, time_step=dt, stepper=name)]
        fall = moves[0] - moves[-1]
        assert np.ptp(fall[:, 2]) < 1e-6 * exact, f"a freely falling body is strained by {np.ptp(fall[:, 2]):.3g} m"
        assert np.abs(fall[:, :2]).max() < 1e-6 * exact, "it falls sideways"
        errors.append(abs(fall[:, 2].mean() - exact))
        assert errors[-1] < 0.505 * GRAVITY * duration * dt, f"it falls {fall[:, 2].mean():.6g} m, not {exact:.6g} m"
    assert errors[1] < 0.55 * errors[0] + 1e-9, f"half the step does not halve the error: {errors} m"


def _has_inertia(name: str) -> bool:
    return getattr(registry.load("stepper", name), "inertia", True)


def _rigid_body_falls(name: str) -> None:
    from finqd.objects import load_object
    from finqd.scene import Scene

    scene, duration, dt = Scene(gravity=(0.0, 0.0, -GRAVITY)), 0.1, 0.01
    scene.add_rigid(load_object("cube"), position=(0.0, 0.0, 0.1))
    fall = 0.1 - float(_simulated(scene, duration=duration, time_step=dt, stepper=name)[-1].rigid_positions[0, 2])
    exact = 0.5 * GRAVITY * duration**2
    assert abs(fall - exact) < 0.505 * GRAVITY * duration * dt, f"a rigid body falls {fall:.6g} m, not {exact:.6g} m"


def check_holds_what_is_fixed(kind: str, name: str) -> None:
    """Fixed vertices stay where they are, to the last bit; the free end of a cantilever comes down."""
    scene = _box_scene()
    body = scene.soft_bodies[0]
    body.fix("xmin")
    states = _simulated(scene, duration=0.05, time_step=0.01, stepper=name)
    moves = states[-1].positions - states[0].positions
    assert np.all(moves[body.vertices("xmin")] == 0.0), "a fixed vertex moved"
    assert np.all(moves[body.vertices("xmax"), 2] < 0.0), "the free end of a cantilever does not sag"


def check_repeats_itself(kind: str, name: str) -> None:
    """The same scene gives the same bits again, and no step writes into a state that was handed out."""
    ends = []
    for _ in range(2):
        copies: list[np.ndarray] = []
        scene = _box_scene()
        if not _has_inertia(name):
            scene.soft_bodies[0].fix("xmin")
        states = _simulated(scene, duration=0.05, time_step=0.01, stepper=name, copies=copies)
        ends.append(states[-1].positions)
        for state, copy in zip(states, copies, strict=True):
            assert np.array_equal(state.positions, copy), "a step wrote into the state that it started from"
    assert np.array_equal(ends[0], ends[1]), "the same scene gave another result"


def check_obeys_damping(kind: str, name: str) -> None:
    """Drag of the mass gives a fall its final speed, and a strain relaxes by exp(-t / beta) where beta is long.

    A stepper without inertia has nothing to damp; one that declares ``stiffness_damping = False`` refuses the latter.
    """
    if not _has_inertia(name):
        return
    rate, time = 20.0, 0.1
    states = _simulated(_box_scene(rayleigh_mass=rate), duration=time, time_step=2e-3, stepper=name)
    speed, exact = -float(states[-1].velocities[:, 2].mean()), GRAVITY / rate * (1.0 - np.exp(-rate * time))
    assert abs(speed / exact - 1.0) < 0.1, f"against drag it falls with {speed:.3g} m/s, not with {exact:.3g} m/s"
    relaxing = _box_scene(rayleigh_stiffness=0.1)
    body = relaxing.soft_bodies[0]
    relaxing.gravity = np.zeros(3)
    body.start_positions *= (1.02, 1.0, 1.0)
    if not getattr(registry.load("stepper", name), "stiffness_damping", True):
        try:
            _simulated(relaxing, duration=0.01, time_step=0.01, stepper=name)
        except InputError:
            return
        raise AssertionError("it declares that it has no damping by the stiffness, and takes a material with it")
    end = _simulated(relaxing, duration=0.05, time_step=2.5e-3, stepper=name)[-1]
    left = (float(np.ptp(end.positions[:, 0])) / SIZE[0] - 1.0) / 0.02
    assert abs(left / np.exp(-0.5) - 1.0) < 0.1, f"after half the time constant {left:.2f} of a strain is left"


def check_goes_on_from_a_checkpoint(kind: str, name: str) -> None:
    """A simulation that is stopped and taken up again ends with the same bits: all that steps depend on is kept."""
    from pathlib import Path
    from tempfile import TemporaryDirectory

    from finqd.simulate import simulate

    class Stopped(Exception):
        pass

    def stop(system: System, state: State) -> None:
        if state.time > 0.025:
            raise Stopped

    def box_on_plane() -> Scene:
        scene = _box_scene(height=0.0)
        scene.add_plane()
        if kind == "stepper" and not _has_inertia(name):
            scene.soft_bodies[0].fix("zmax")
        return scene

    options: dict[str, Any] = {"duration": 0.05, "time_step": 0.01, kind: name}
    if kind == "stepper":
        options["contact"] = {"name": "penalty", "stiffness_N_mm3": 1.0}  # those with substeps need few for that
    whole = _simulated(box_on_plane(), **options)[-1]
    with TemporaryDirectory() as folder:
        kept: dict[str, Any] = {"checkpoint": Path(folder) / "run.npz", "checkpoint_every": 0.0}
        try:
            simulate(box_on_plane(), watch=stop, **kept, **options)
        except Stopped:
            end = _simulated(box_on_plane(), **kept, **options)[-1]
    assert end.positions.tobytes() == whole.positions.tobytes(), "a run that was stopped ends elsewhere"
    assert end.velocities.tobytes() == whole.velocities.tobytes(), "a run that was stopped ends at another speed"


STEPPER = (
    check_falls_freely, check_holds_what_is_fixed, check_repeats_itself, check_obeys_damping,
    check_goes_on_from_a_checkpoint,
)


# -- contact -----------------------------------------------------------------------------------------------------------


def check_soft_body_rests_on_a_plane(kind: str, name: str) -> None:
    """A soft box that lies on a plane sinks no deeper than a tenth of a millimetre, and stays."""
    scene = _box_scene(height=0.0)
    scene.add_plane()
    states = _simulated(scene, duration=0.4, time_step=0.01, contact=name)
    _assert_rests([float(state.positions[:, 2].min()) for state in states])


def check_rigid_body_rests_on_a_plane(kind: str, name: str) -> None:
    """So does a rigid cube."""
    from finqd.objects import load_object
    from finqd.scene import Scene

    cube = load_object("cube")
    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_plane()
    scene.add_rigid(cube, position=(0.0, 0.0, cube.rest_height), rotation=cube.rest_rotation)
    states = _simulated(scene, duration=0.4, time_step=0.01, contact=name)
    _assert_rests(
        [float((cube.vertices @ s.rigid_rotations[0].T + s.rigid_positions[0])[:, 2].min()) for s in states]
    )


def check_lets_go_of_what_is_apart(kind: str, name: str) -> None:
    """What does not touch is not held: a box above a plane falls as if the plane were not there."""
    ends = []
    for with_plane in (False, True):
        scene = _box_scene()
        if with_plane:
            scene.add_plane()
        ends.append(_simulated(scene, duration=0.05, time_step=0.01, contact=name)[-1].positions)
    assert np.abs(ends[0] - ends[1]).max() < 1e-9, "a plane 0.1 m below acts on a falling box"


CONTACT = (
    check_soft_body_rests_on_a_plane, check_rigid_body_rests_on_a_plane, check_lets_go_of_what_is_apart,
    check_goes_on_from_a_checkpoint,
)


# -- how it is done ----------------------------------------------------------------------------------------------------


def _potentials(name: str) -> Iterator[tuple[str, Mesh, Any]]:
    from finqd.mesh_shapes import box_mesh

    plugin = registry.create("elasticity", name)
    for element in ELEMENTS:
        mesh = box_mesh(SIZE, (2, 2, 1), element, distort=0.2)
        try:
            yield element, mesh, plugin.potential(mesh, RUBBER)
        except (InputError, MeshError):
            continue


def _energy_scale() -> float:
    """Return the energy of a strain of 1 over the box [J]."""
    return RUBBER.youngs_modulus * float(np.prod(SIZE))


def _force_scale() -> float:
    return _energy_scale() / max(SIZE)


def _rotation(angle: float) -> np.ndarray:
    from finqd.mechanics.rotation_kernels import rotation_matrix

    return rotation_matrix(angle * np.array([2.0, -1.0, 2.0]) / 3.0)


def _strained(mesh: Mesh) -> np.ndarray:
    """Return positions that are turned by 0.8 rad and strained by a few per cent, at random."""
    noise = np.random.default_rng(1).uniform(-1.0, 1.0, mesh.vertices.shape)
    return mesh.vertices @ _rotation(0.8).T + 0.02 * min(SIZE) * noise


def _squeezed(mesh: Mesh) -> np.ndarray:
    """Return the box pressed together by 30 %, where an exact Hessian is often indefinite."""
    return mesh.vertices * (0.7, 1.0, 1.0)


def _directions(mesh: Mesh) -> np.ndarray:
    return np.random.default_rng(2).uniform(-1.0, 1.0, (3, *mesh.vertices.shape))


def _dense_hessian(potential: Any, positions: np.ndarray, *, projected: bool) -> np.ndarray:
    from finqd.mechanics.pattern import BlockPattern

    pattern = BlockPattern.from_cliques(len(positions), potential.cliques)
    blocks = pattern.new_blocks()
    slots = tuple(pattern.slots(clique) for clique in potential.cliques)
    potential.add_hessian(positions, slots, blocks, projected=projected)
    return pattern.matrix(blocks).toarray()


def _box_scene(height: float = 0.1, **constants: float) -> Scene:
    from finqd.mesh_shapes import box_mesh
    from finqd.scene import Scene

    scene = Scene(gravity=(0.0, 0.0, -GRAVITY))
    lifted = np.eye(4)
    lifted[2, 3] = height
    scene.add_soft(box_mesh(SIZE, (3, 2, 1)).transformed(lifted), replace(RUBBER, **constants))
    return scene


def _simulated(scene: Scene, *, copies: list[np.ndarray] | None = None, **arguments: Any) -> list[State]:
    """Return the start and the state after every step; ``copies`` collects their positions as they were then."""
    from finqd.simulate import simulate

    states: list[State] = []

    def watch(system: System, state: State) -> None:
        for one in (state,) if states else (system.initial_state(), state):
            states.append(one)
            if copies is not None:
                copies.append(one.positions.copy())

    trajectory = simulate(scene, watch=watch, **arguments)
    assert trajectory.status == "ok", f"the simulation is {trajectory.status}: {trajectory.reason}"
    return states


def _assert_rests(heights: list[float]) -> None:
    assert min(heights) > -SINKING_LIMIT, f"it sinks {-1e3 * min(heights):.3g} mm into the plane"
    assert max(heights) < SINKING_LIMIT, f"it lifts off by {1e3 * max(heights):.3g} mm"
    assert np.ptp(heights[-10:]) < 0.1 * SINKING_LIMIT, f"it does not come to rest: {np.ptp(heights[-10:]):.3g} m"
