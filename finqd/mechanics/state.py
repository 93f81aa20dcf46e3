"""What changes in time: positions and velocities of a scene, and what a step reports."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from finqd.mechanics.rotation_kernels import rotation_matrix


@dataclass(frozen=True, kw_only=True)
class Direction:
    """A change of all unknowns: ``soft`` [m], shape (n_vertices, 3); ``rigid``, shape (n_rigid, 6).

    A rigid row is the translation of the centre of mass [m] and the spin [rad], a rotation vector in the world frame
    that is applied from the left.
    """

    soft: np.ndarray
    rigid: np.ndarray


@dataclass(frozen=True, kw_only=True)
class State:
    """A scene at one moment. Arrays are never written to after construction.

    positions, velocities: soft vertices [m], [m/s], shape (n_vertices, 3)
    rigid_positions, rigid_velocities: centres of mass [m], [m/s], shape (n_rigid, 3)
    rigid_rotations: body frame to world, shape (n_rigid, 3, 3)
    angular_momenta: about the centres of mass, world frame [kg m^2/s], shape (n_rigid, 3)
    progress: share of its time that each driven motion has run, shape (n_motions,), in [0, 1]
    step: length of the step that led here [s], 0 at the start
    previous: the state one step earlier, where a stepper needs it (that one without a ``previous`` of its own)
    """

    time: float
    positions: np.ndarray
    velocities: np.ndarray
    rigid_positions: np.ndarray
    rigid_rotations: np.ndarray
    rigid_velocities: np.ndarray
    angular_momenta: np.ndarray
    progress: np.ndarray
    step: float = 0.0
    previous: State | None = None

    def moved(self, direction: Direction, share: float = 1.0) -> State:
        """Return the state with positions and rotations moved by ``share`` of ``direction``.

        Where nothing soft moves, the array of its positions stays the same one: what is known of it is found again.
        """
        rotations = self.rigid_rotations
        if len(rotations):
            rotations = np.stack(
                [rotation_matrix(share * d[3:]) @ r for d, r in zip(direction.rigid, rotations, strict=True)]
            )
        return replace(
            self,
            positions=self.positions + share * direction.soft if direction.soft.any() else self.positions,
            rigid_positions=self.rigid_positions + share * direction.rigid[:, :3],
            rigid_rotations=rotations,
        )


@dataclass(kw_only=True)
class StepReport:
    """What one attempt at a step did.

    rigid_iterations: of rigid bodies alone, which need no matrix of soft ones
    residual: largest force that is left unbalanced [N]; where: what it acts on
    residuals: the history over the iterations [N]
    error: estimate of the step's own error [m], NaN where the stepper makes none
    next_dt: how long the stepper would make the next step (or this one, tried again) [s], None if it has no opinion
    error_rejections: 1 if only its error speaks against the step; error_overruns: 1 if it stands in spite of its error
    substeps: how many shorter steps the stepper took inside this one
    """

    converged: bool = False
    reason: str = ""
    iterations: int = 0
    quasi_iterations: int = 0
    rigid_iterations: int = 0
    line_searches: int = 0
    factorisations: int = 0
    cg_iterations: int = 0
    projections: int = 0
    friction_updates: int = 0
    residual: float = float("nan")
    where: str = ""
    residuals: list[float] | None = None
    error: float = float("nan")
    next_dt: float | None = None
    error_rejections: int = 0
    error_overruns: int = 0
    substeps: int = 0

    def add_work(self, other: StepReport) -> None:
        """Add what another attempt at the same step cost."""
        counted = (
            "iterations", "quasi_iterations", "rigid_iterations", "line_searches", "factorisations", "cg_iterations",
            "projections", "friction_updates",
        )
        for name in counted:
            setattr(self, name, getattr(self, name) + getattr(other, name))
