"""The contracts of the eight plugin kinds: reading this file is the plugin manual.

A plugin is a frozen dataclass. Its fields are its options in JSON, each with a default, a unit in the name where it
has one (``size_mm``) and, where a range applies, ``typing.Annotated`` with a ``pydantic.Field``; its docstring's
first line is what ``finqd plugins`` prints. It is registered under the entry-point group ``finqd.<kind>``
and named in a design file: ``"mesher": {"name": "swept", "size_mm": 4}`` or just ``"mesher": "swept"``.

Everything that passes between plugins is SI and is one of the plain data classes named here. A plugin imports
``finqd.*`` but never another plugin. Compiled kernels take ``njit`` from ``finqd.mechanics.compiled``: Numba's own
would miss that a kernel of finqd's which they call has changed with an update.

The finger frame, which geometry, meshers and actuation share: the origin lies on the inner (contact side) edge of the
finger's base; x points away from the gripper's axis, y from the base towards the tip, z along the
finger's thickness, with the finger symmetric about z = 0. The part of the solid in the plane y = 0 is the
*base*: it is clamped to the gripper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

if TYPE_CHECKING:
    import numpy as np

    from finqd.design import Design
    from finqd.mechanics.material import Material
    from finqd.mechanics.pattern import BlockPattern
    from finqd.mechanics.state import Direction, State, StepReport
    from finqd.mechanics.system import Derivatives, System
    from finqd.mesh import Mesh
    from finqd.scene import Motion, Scene
    from finqd.solid import Solid
    from finqd.trajectory import Trajectory

KINDS = ("geometry", "mesher", "elasticity", "stepper", "contact", "actuation", "fitness", "features")


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One number of a finger (or of the gripper) that a design file holds and a search varies.

    ``low`` to ``high`` is the search range; ``allowed_low`` to ``allowed_high`` is what a design file may hold (a value
    outside the search range but inside the allowed one is taken with a warning). All in ``unit``; ``""`` for a count.
    """

    name: str
    unit: str
    low: float
    high: float
    allowed_low: float
    allowed_high: float
    integer: bool = False
    symbol: str = ""
    description: str = ""

    @property
    def key(self) -> str:
        """The JSON key: the name with its unit, as in ``length_mm``."""
        return f"{self.name}_{self.unit}" if self.unit else self.name


class Geometry(Protocol):
    """A finger type: declares its parameters and builds one finger's solid."""

    finger_parameters: ClassVar[tuple[Parameter, ...]]

    def check(self, finger: Mapping[str, float]) -> str | None:
        """Return None, or one sentence saying which values contradict each other (``finger`` as for `build`).

        The sentence names parameters by JSON key: "contact_wall_mm + back_wall_mm must stay below ...".
        """

    def build(self, finger: Mapping[str, float]) -> Solid:
        """Return the finger's solid in the finger frame [m].

        ``finger`` maps parameter names (``length``, without unit) to SI values. Raises ``InputError`` where `check`
        would return a sentence.
        """


class Mesher(Protocol):
    """Turns a solid into a volume mesh. Runs in a process of its own, which can be killed."""

    def mesh(self, solid: Solid) -> Mesh:
        """Return the mesh of ``solid``, with node set ``base`` and face set ``contact``. Raises ``MeshError``."""


class ElasticPotential(Protocol):
    """The elastic energy of one soft body, as a function of all positions of the scene."""

    #: vertex ids (scene numbering) that each element couples: one (n_elements, k) array a block
    cliques: tuple[np.ndarray, ...]

    def energy(self, positions: np.ndarray) -> float:
        """Return the elastic energy [J]; ``positions`` [m], (n_vertices, 3). May be inf for an inverted element."""

    def add_gradient(self, positions: np.ndarray, gradient: np.ndarray) -> float:
        """Add dE/dpositions [N] to ``gradient``, shape (n_vertices, 3), and return the energy [J].

        Also asked at trial states that are then rejected: inf (or NaN) is a fair answer for an inverted element.
        """

    def add_hessian(
        self, positions: np.ndarray, slots: tuple[np.ndarray, ...], blocks: np.ndarray, *, projected: bool = False
    ) -> None:
        """Add the Hessian [N/m] to ``blocks``, shape (n_blocks + 1, 3, 3).

        ``slots[b][e, i, j]`` is the index into ``blocks`` of the pair (node i, node j) of element e of block b
        (see `finqd.mechanics.pattern`; pairs below the diagonal all lead to the last block, which is not read).
        ``projected``: each element's matrix is made positive semidefinite; otherwise it is the exact second derivative.
        """


class Elasticity(Protocol):
    """Element formulation and constitutive law.

    A class may declare ``small_rotation: ClassVar[bool] = True``: turning a body far costs energy. Any plugin of the
    kinds elasticity, stepper and contact may have ``effects``, effect -> on or off and why, which a result then says.
    """

    def potential(self, mesh: Mesh, material: Material, *, first_vertex: int = 0) -> ElasticPotential:
        """Return the potential of a body whose vertex 0 is vertex ``first_vertex`` of the scene."""


class ContactPotential(Protocol):
    """All contacts and frictions of a scene, with their history. Positions and poses are those of a `State`.

    soft_forces: normal force on each soft body at the last committed state [N], shape (n_soft,)
    relagged_forces: the same at the state of the last `relag`
    penetration: largest at the last committed state [m]

    One that knows when bodies first come within reach of each other may say so: ``met_pairs()`` returns times [s] by
    the names of two bodies, ``(a, b)``; ``(a, a)`` are a body's own faces.

    One that couples vertices of different faces, as contact of soft bodies with each other does, has in addition
    ``couplings(state)``: it is asked before each `add_hessian`, and returns the pairs of vertices, (n, 2), that the
    Hessian at ``state`` needs and the last bound pattern does not have (`BlockPattern.lacks`). Then `bind` is called
    anew, with a pattern that has them as well. Patterns never shrink, and each growth costs a symbolic factorisation:
    pairs that are merely near are best asked for together.
    """

    soft_forces: np.ndarray
    relagged_forces: np.ndarray
    penetration: float

    def bind(self, pattern: BlockPattern) -> None:
        """Look up where in the Hessian's blocks the contacts go."""

    def begin_step(self, state: State) -> None:
        """Fix what is lagged over a step (reference points, normals, friction bounds) at its start."""

    def relag(self, state: State, *, whole: bool = False) -> float:
        """Renew the friction bounds at ``state``; return which share of them, in sum, has changed (0 to 2).

        They may be relaxed, if that helps them to come to rest; ``whole``: they must not be.
        """

    def energy(self, state: State) -> float:
        """Return contact and friction energy [J]."""

    def add_gradient(self, state: State, derivatives: Derivatives) -> float:
        """Add the gradient to ``derivatives``, return the energy [J].

        Coulomb friction has no potential: its bounds are lagged, and at fixed bounds it is one.
        """

    def add_hessian(self, state: State, derivatives: Derivatives, *, projected: bool = False) -> None:
        """Add the Hessian to ``derivatives``; ``projected``: a positive semidefinite one."""

    def step_limit(self, state: State, direction: Direction) -> float:
        """Return the largest share (0, 1] of ``direction`` in which no contact can tunnel through."""

    def commit(self, state: State) -> None:
        """Accept ``state`` as the end of the step: return mapping of the elastic slip, forces, penetrations."""

    def history(self) -> dict[str, np.ndarray]:
        """Return by name what later steps depend on beside the state, between `commit` and the next `begin_step`."""

    def restore(self, history: dict[str, np.ndarray]) -> None:
        """Go on as after the commit from which ``history`` is: the same bits follow."""


class Contact(Protocol):
    """Contact and friction model."""

    def potential(self, scene: Scene) -> ContactPotential:
        """Return the potential of every pair in the scene that can touch."""


class Stepper(Protocol):
    """One step in time.

    A class may declare ``inertia: ClassVar[bool] = False``: soft bodies have none. Then they need not fall freely, and
    the material's damping has nothing to do. It may declare ``stiffness_damping: ClassVar[bool] = False``: it refuses
    materials with that. All others obey ``system.damping``, as what steps by `finqd.mechanics.incremental` does.
    """

    def step(self, system: System, state: State, dt: float) -> tuple[State, StepReport]:
        """Return the state ``dt`` [s] later and a report; a step that fails says so there and returns ``state``."""


class Actuation(Protocol):
    """How the finger bases are driven."""

    def motions(self, placements: Sequence[np.ndarray]) -> Sequence[Motion]:
        """Return the closing motion of each finger base.

        ``placements``: finger frame to gripper frame, one (4, 4) matrix a finger; the gripper's axis is z, up.
        """


class Fitness(Protocol):
    """Turns the grasps of one design into one number and a continuous margin."""

    def score(self, trajectories: Mapping[str, Trajectory]) -> FitnessResult:
        """Return fitness in [0, 1] and per-object verdicts. A failed simulation counts as not held."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What became of one object."""

    held: bool
    drop: float  # how far the object fell relative to the gripper [m]
    margin: float  # 1: no drop at all, 0: on the threshold, -1: lost; continuous between


@dataclass(frozen=True, kw_only=True)
class FitnessResult:
    """Fitness of a design: share of objects held, mean margin, and the verdict on each object."""

    fitness: float
    margin: float
    verdicts: Mapping[str, Verdict]


class Features(Protocol):
    """Descriptors of a design for the quality-diversity map."""

    names: ClassVar[tuple[str, ...]]  #: keys of what `measure` returns, with units: ``("workspace_mm2",)``

    def measure(self, design: Design, solids: Sequence[Solid]) -> dict[str, float]:
        """Return the features, in the units that their names end in."""
