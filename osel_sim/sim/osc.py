"""robosuite's OSC_POSE, compiled, for an arm of n joints.

Same torques as `robosuite.controllers.parts.arm.osc.OperationalSpaceController` with robosuite's default settings (fixed impedance, delta
input in the base frame, position and orientation uncoupled, null space towards the initial joints). robosuite inverts the mass matrix and takes
three pseudo-inverses a substep; all of them are of symmetric positive definite matrices, so Cholesky solves give the same numbers for a fraction
of the time (Khatib 1987 for the method).
"""

import functools

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.compiled import njit
from osel_sim.core.compiling import announced

Array = NDArray[np.float64]


@functools.cache
def prepare() -> None:
    """Compile all of this, or load it from numba's cache, before anything waits for it."""
    joints, speeds = 7, 9
    pose, jacobian, numbers = (np.zeros(3), np.eye(3).ravel()), np.zeros((3, speeds)), np.zeros(speeds)
    inertia, addresses = np.eye(1, speeds)[0], 1 - np.eye(joints, dtype=np.int32)  # a mass matrix of ones on its diagonal
    with announced("the control of the arm"):
        goal = goal_pose(np.zeros(6), np.ones(6), np.zeros(3), np.eye(3), np.eye(3))
        osc_torques(*goal, *pose, jacobian, jacobian, inertia, addresses, numbers, numbers, numbers, np.zeros(joints), (1.0, 1.0, 1.0, 1.0))


@njit(cache=True)
def _rotation(vector: Array) -> Array:
    """Rotation matrix of an axis-angle vector, by way of a single-precision quaternion: robosuite's `quat2mat` rounds, and so must we."""
    angle = np.sqrt(np.dot(vector, vector))
    if angle == 0.0:
        return np.eye(3)
    q = np.empty(4, dtype=np.float32)  # w, x, y, z
    q[0] = np.cos(angle / 2.0)
    for i in range(3):
        q[i + 1] = vector[i] / angle * np.sin(angle / 2.0)
    length = np.dot(q, q)
    q *= np.sqrt(2.0 / np.float64(length))
    p = np.outer(q, q)
    matrix = np.empty((3, 3))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1.0 - p[2, 2] - p[3, 3], p[1, 2] - p[3, 0], p[1, 3] + p[2, 0]
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = p[1, 2] + p[3, 0], 1.0 - p[1, 1] - p[3, 3], p[2, 3] - p[1, 0]
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = p[1, 3] - p[2, 0], p[2, 3] + p[1, 0], 1.0 - p[1, 1] - p[2, 2]
    return matrix


@njit(cache=True)
def goal_pose(action: Array, output_max: Array, position: Array, matrix: Array, base_matrix: Array) -> tuple[Array, Array]:
    """World goal (3,), (3, 3) of a delta action (6,) in [-1, 1], relative to the pose reached; `output_max` (6,) is what 1 means."""
    delta = np.empty(6)
    for i in range(6):
        delta[i] = min(max(action[i], -1.0), 1.0) * output_max[i]
    goal_position = position + base_matrix @ delta[:3]
    rotation = _rotation(delta[3:])
    goal_matrix = base_matrix @ (rotation @ (base_matrix.T @ matrix))
    return goal_position, goal_matrix


@njit(cache=True)
def _cholesky(matrix: Array) -> bool:
    """In place, lower triangle. False where the matrix is not (numerically) positive definite."""
    n = matrix.shape[0]
    for j in range(n):
        total = matrix[j, j]
        for k in range(j):
            total -= matrix[j, k] * matrix[j, k]
        if total <= 1e-14:
            return False
        pivot = np.sqrt(total)
        matrix[j, j] = pivot
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / pivot
    return True


@njit(cache=True)
def _solve(factor: Array, right: Array) -> None:
    """Solve in place for one right-hand side, given the Cholesky factor."""
    n = factor.shape[0]
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * right[k]
        right[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * right[k]
        right[i] = total / factor[i, i]


@njit(cache=True)
def _apply_inverse(matrix: Array, vector: Array) -> Array:
    """matrix^-1 vector; the pseudo-inverse at a singularity, as robosuite does."""
    factor, result = matrix.copy(), vector.copy()
    if _cholesky(factor):
        _solve(factor, result)
        return result
    return np.linalg.pinv(matrix) @ vector


@njit(cache=True)
def osc_torques(
    goal_position: Array,
    goal_matrix: Array,
    position: Array,
    matrix: Array,
    jacobian_position: Array,
    jacobian_rotation: Array,
    inertia: Array,
    addresses: NDArray[np.int32],
    joint_position: Array,
    joint_velocity: Array,
    bias: Array,
    initial_joint: Array,
    gains: tuple[float, float, float, float],
) -> Array:
    """Joint torques (n,), before the actuators' limits.

    Args:
        position, matrix: pose of the grip site in the world, (3,) and (9,).
        jacobian_position, jacobian_rotation: of the grip site, (3, nv) each; the arm's degrees of freedom come first.
        inertia: MuJoCo's `qM`; `addresses` (n, n) says where the arm's entries lie in it.
        bias: gravity, centrifugal and Coriolis torques (at least n,).
        initial_joint: posture (n,) that the null space pulls towards.
        gains: stiffness and damping of the pose, then of the null space.
    """
    n = initial_joint.shape[0]
    kp, kd, null_kp, null_kd = gains
    jacobian = np.empty((6, n))
    jacobian[:3] = jacobian_position[:, :n]
    jacobian[3:] = jacobian_rotation[:, :n]
    mass = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            mass[i, j] = inertia[addresses[i, j]]

    velocity = jacobian @ joint_velocity[:n]
    current = matrix.reshape(3, 3)
    force = np.empty(3)
    torque = np.zeros(3)
    for i in range(3):
        force[i] = kp * (goal_position[i] - position[i]) - kd * velocity[i]
        a, b = (i + 1) % 3, (i + 2) % 3
        for k in range(3):
            torque[i] += 0.5 * (current[a, k] * goal_matrix[b, k] - current[b, k] * goal_matrix[a, k])
        torque[i] = kp * torque[i] - kd * velocity[3 + i]

    factor = mass.copy()
    _cholesky(factor)
    solved = np.empty((6, n))  # J M^-1
    for i in range(6):
        row = jacobian[i].copy()
        _solve(factor, row)
        solved[i] = row
    mobility = solved @ jacobian.T  # J M^-1 J^T
    wrench = np.empty(6)
    wrench[:3] = _apply_inverse(mobility[:3, :3].copy(), force)
    wrench[3:] = _apply_inverse(mobility[3:, 3:].copy(), torque)

    posture = mass @ (null_kp * (initial_joint - joint_position[:n]) - null_kd * joint_velocity[:n])
    hidden = _apply_inverse(mobility, solved @ posture)
    torques: Array = jacobian.T @ (wrench - hidden) + posture + bias[:n]
    return torques
