"""Kernels of contact energies, forces and Hessians; what a contact is, `finqd.mechanics.contact_kernels` says.

Relative displacement of a contact: w = sum_a weight_a dx_a - dc - dphi x arm, so dgap = normal . w.
"""

import math

import numpy as np

from finqd.mechanics.compiled import njit
from finqd.mechanics.contact_kernels import face_point


@njit(cache=True)
def normal_energy(gap, stiffness, smoothing):
    r"""Return the penalty energy [J] of one contact.

    With p = -gap [m], k the stiffness [N/m] and s the smoothing length [m]: 0 for p <= 0; k p^3/(6 s) up to s; beyond,
    k (p^2/2 - p s/2 + s^2/6). Twice continuously differentiable; the force tends to k (p - s/2).
    """
    p = -gap
    if p <= 0.0:
        return 0.0
    if p < smoothing:
        return stiffness * p * p * p / (6.0 * smoothing)
    return stiffness * (0.5 * p * p - 0.5 * p * smoothing + smoothing * smoothing / 6.0)


@njit(cache=True)
def normal_force(gap, stiffness, smoothing):
    """Return the force [N] (>= 0) and its derivative with the penetration [N/m]; see `normal_energy`."""
    p = -gap
    if p <= 0.0:
        return 0.0, 0.0
    if p < smoothing:
        return stiffness * p * p / (2.0 * smoothing), stiffness * p / smoothing
    return stiffness * (p - 0.5 * smoothing), stiffness


@njit(cache=True)
def normal_contacts_energy(gap, stiffness, smoothing, count):
    """Return the summed penalty energy [J]."""
    energy = 0.0
    for c in range(count):
        energy += normal_energy(gap[c], stiffness[c], smoothing)
    return energy


@njit(cache=True)
def _add_row(
    faces, face_slots, face, weight, rigid, spin, force, matrix, gradient, rigid_gradient,
    blocks, coupling, rigid_matrix, want_gradient, want_hessian,
):
    """Add the force -> gradient and the 3 x 3 ``matrix`` -> Hessian of one contact.

    The relative displacement depends on the rigid unknowns through ``spin``: w = ... - dc + spin dphi.
    ``force`` is dE/dw, shape (3,).
    """
    k = faces.shape[1]
    if want_gradient and face >= 0:
        for a in range(k):
            n = faces[face, a]
            if n >= 0 and weight[a] != 0.0:
                for i in range(3):
                    gradient[n, i] += weight[a] * force[i]
    if want_gradient and rigid >= 0:
        for i in range(3):
            rigid_gradient[rigid, i] -= force[i]
            for j in range(3):
                rigid_gradient[rigid, 3 + i] += spin[j, i] * force[j]
    if not want_hessian:
        return
    if face >= 0:
        for a in range(k):
            if weight[a] == 0.0:  # most are: a sample lies on one piece of its face
                continue
            for b in range(k):
                slot = face_slots[face, a, b]
                ww = weight[a] * weight[b]
                if slot >= 0 and ww != 0.0:
                    for i in range(3):
                        for j in range(3):
                            blocks[slot, i, j] += ww * matrix[i, j]
    if rigid < 0:
        return
    ms = matrix @ spin
    sms = spin.T @ ms
    r0 = 6 * rigid
    for i in range(3):
        for j in range(3):
            rigid_matrix[r0 + i, r0 + j] += matrix[i, j]
            rigid_matrix[r0 + i, r0 + 3 + j] -= ms[i, j]
            rigid_matrix[r0 + 3 + j, r0 + i] -= ms[i, j]
            rigid_matrix[r0 + 3 + i, r0 + 3 + j] += sms[i, j]
    if face >= 0:
        for a in range(k):
            n = faces[face, a]
            if n >= 0 and weight[a] != 0.0:
                for i in range(3):
                    for j in range(3):
                        coupling[3 * n + i, r0 + j] -= weight[a] * matrix[i, j]
                        coupling[3 * n + i, r0 + 3 + j] += weight[a] * ms[i, j]


@njit(cache=True)
def _add_turning(faces, face, weight, rigid, turns, force, normal, arm, coupling, rigid_matrix):
    r"""Add what the turning of a rigid body does to a contact's Hessian at the normal force ``force`` [N].

    With the spin v and the motion u of the soft point relative to the centre of mass, the gap n . (x - c) changes in
    second order by n . (v x (v x r)) / 2 - n . (v x u) if the normal turns along, and by -n . (v x (v x r)) / 2 if it
    stays.
    """
    r0 = 6 * rigid
    along = normal[0] * arm[0] + normal[1] * arm[1] + normal[2] * arm[2]
    for i in range(3):
        for j in range(3):
            h = 0.5 * (normal[i] * arm[j] + arm[i] * normal[j])
            if i == j:
                h -= along
            rigid_matrix[r0 + 3 + i, r0 + 3 + j] -= turns * force * h
    if turns != 1:
        return
    cross = np.zeros((3, 3))
    cross[0, 1], cross[0, 2] = -normal[2], normal[1]
    cross[1, 0], cross[1, 2] = normal[2], -normal[0]
    cross[2, 0], cross[2, 1] = -normal[1], normal[0]
    for i in range(3):
        for j in range(3):
            h = force * cross[i, j]
            rigid_matrix[r0 + i, r0 + 3 + j] -= h
            rigid_matrix[r0 + 3 + j, r0 + i] -= h
            if face >= 0:
                for a in range(faces.shape[1]):
                    n = faces[face, a]
                    if n >= 0 and weight[a] != 0.0:
                        coupling[3 * n + i, r0 + 3 + j] += weight[a] * h


@njit(cache=True)
def add_normal(
    faces, face_slots, face, weight, gap, normal, arm, stiffness, rigid, turns, curve, count, smoothing,
    gradient, rigid_gradient, blocks, coupling, rigid_matrix, want_gradient, want_hessian, exact,
):
    """Add gradient and Hessian of the penalty, as wanted; return the energy [J].

    ``exact``: with the terms of the gap's second derivative (curvature, and turning of the rigid body), without which
    the Hessian is Gauss-Newton's and positive semidefinite.
    """
    energy = 0.0
    spin, matrix, force = np.empty((3, 3)), np.zeros((3, 3)), np.empty(3)
    for c in range(count):
        energy += normal_energy(gap[c], stiffness[c], smoothing)
        f, df = normal_force(gap[c], stiffness[c], smoothing)
        for i in range(3):
            force[i] = -f * normal[c, i]
            for j in range(3):
                matrix[i, j] = df * normal[c, i] * normal[c, j]
                if exact:
                    matrix[i, j] -= f * curve[c, i, j]
        # -dphi x arm = [arm] dphi
        spin[0, 0] = spin[1, 1] = spin[2, 2] = 0.0
        spin[0, 1], spin[0, 2] = -arm[c, 2], arm[c, 1]
        spin[1, 0], spin[1, 2] = arm[c, 2], -arm[c, 0]
        spin[2, 0], spin[2, 1] = -arm[c, 1], arm[c, 0]
        _add_row(
            faces, face_slots, face[c], weight[c], rigid[c], spin, force, matrix, gradient, rigid_gradient,
            blocks, coupling, rigid_matrix, want_gradient, want_hessian,
        )
        if want_hessian and exact and turns[c] != 0 and rigid[c] >= 0:
            _add_turning(faces, face[c], weight[c], rigid[c], turns[c], f, normal[c], arm[c], coupling, rigid_matrix)
    return energy


@njit(cache=True)
def elastic_slips(
    positions, rigid_shift, rigid_turn, faces, face, weight, start_point, start_arm, start_slip, normal, rigid, count,
    slips,
):
    """Write the trial elastic slip [m] of each frictional contact: tangential part of start_slip + relative motion.

    rigid_shift, rigid_turn: translation [m] and rotation vector [rad] of each rigid body since the step's start,
    shape (n_rigid, 3). A contact's rigid point has moved by shift + turn x start_arm: a ball that rolls does not slip.
    """
    x = np.empty(3)
    for c in range(count):
        for i in range(3):
            slips[c, i] = start_slip[c, i]
        if face[c] >= 0:
            face_point(positions, faces[face[c]], weight[c], x)
            for i in range(3):
                slips[c, i] += x[i] - start_point[c, i]
        if rigid[c] >= 0:
            v, r = rigid_turn[rigid[c]], start_arm[c]
            s = rigid_shift[rigid[c]]
            slips[c, 0] -= s[0] + v[1] * r[2] - v[2] * r[1]
            slips[c, 1] -= s[1] + v[2] * r[0] - v[0] * r[2]
            slips[c, 2] -= s[2] + v[0] * r[1] - v[1] * r[0]
        along = 0.0
        for i in range(3):
            along += slips[c, i] * normal[c, i]
        for i in range(3):
            slips[c, i] -= along * normal[c, i]


@njit(cache=True)
def friction_energy(slips, bound, stiffness, count):
    r"""Return the Huber potential [J] of Coulomb friction at fixed bounds mu N [N].

    k |s|^2/2 inside the cone (k |s| <= mu N), mu N |s| - (mu N)^2/(2 k) outside (the return mapping's potential; Simo
    and Hughes, Computational Inelasticity, 1998, ch. 2, for the plastic analogue).
    """
    energy = 0.0
    for c in range(count):
        s = math.sqrt(slips[c, 0] ** 2 + slips[c, 1] ** 2 + slips[c, 2] ** 2)
        k = stiffness[c]
        if k * s <= bound[c]:
            energy += 0.5 * k * s * s
        else:
            energy += bound[c] * s - 0.5 * bound[c] * bound[c] / k
    return energy


@njit(cache=True)
def add_friction(
    faces, face_slots, face, weight, slips, bound, stiffness, normal, start_arm, rigid, turn_jacobian, count,
    gradient, rigid_gradient, blocks, coupling, rigid_matrix, want_gradient, want_hessian,
):
    """Add gradient and Hessian (both exact, for the lagged normal forces) of `friction_energy`.

    turn_jacobian: d(turn)/d(phi) of each rigid body, shape (n_rigid, 3, 3).
    """
    spin, matrix, force, arm = np.zeros((3, 3)), np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for c in range(count):
        s = math.sqrt(slips[c, 0] ** 2 + slips[c, 1] ** 2 + slips[c, 2] ** 2)
        k = stiffness[c]
        sticks = k * s <= bound[c]
        h = k if sticks else bound[c] / s
        for i in range(3):
            force[i] = h * slips[c, i]
            for j in range(3):
                matrix[i, j] = -h * normal[c, i] * normal[c, j]
                if not sticks:
                    matrix[i, j] -= h * slips[c, i] * slips[c, j] / (s * s)
            matrix[i, i] += h
        if rigid[c] >= 0:
            arm[0, 0] = arm[1, 1] = arm[2, 2] = 0.0
            arm[0, 1], arm[0, 2] = -start_arm[c, 2], start_arm[c, 1]
            arm[1, 0], arm[1, 2] = start_arm[c, 2], -start_arm[c, 0]
            arm[2, 0], arm[2, 1] = -start_arm[c, 1], start_arm[c, 0]
            spin = arm @ turn_jacobian[rigid[c]]
        _add_row(
            faces, face_slots, face[c], weight[c], rigid[c], spin, force, matrix, gradient, rigid_gradient,
            blocks, coupling, rigid_matrix, want_gradient, want_hessian,
        )


@njit(cache=True)
def return_mapping(slips, bound, stiffness, count):
    """Shorten each elastic slip to the cone, |s| <= mu N / k, in place."""
    for c in range(count):
        s = math.sqrt(slips[c, 0] ** 2 + slips[c, 1] ** 2 + slips[c, 2] ** 2)
        limit = bound[c] / stiffness[c]
        if s > limit:
            for i in range(3):
                slips[c, i] *= limit / s
