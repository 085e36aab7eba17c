"""What ``mj_setConst`` computes from masses and inertias, for thousands of envs at once, as products of matrices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

INERTIAL_FIELDS = ("body_mass", "body_inertia", "body_ipos", "dof_armature")
"""Fields that this class can follow. Others move the bodies of the reference pose, or what hangs on them."""
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, eq=False)
class InertialConstants:
    r"""Constants of a model in its reference pose, given each env's masses, centres of mass and inertias.

    The mass matrix in the reference pose is linear in a body's mass m, in m times its centre of mass c, in m times the
    products of c, and in its inertia; so are, in c and its products, the squares of the Jacobians of its centre:

    .. math::
        M = M_0 + \sum_b m_b \left(J^\top J\right)_b + \left(R^\top I R\right)_b, \qquad
        w_b = \tfrac{1}{3} \mathrm{tr}\left(J_b M^{-1} J_b^\top\right)

    So two products with constant matrices, and one inverse, give all weights of all envs. MuJoCo Warp's own
    ``set_const`` solves for one row of one body at a time, in hundreds of launches.

    Source:
        MuJoCo, ``mj_setConst``; a test compares the two.
    """

    squares: Tensor
    """Squared Jacobian of each body's centre of mass, by 1, c and the products of c. Shape (B, 10, V * V)."""
    turns: Tensor
    """Squared Jacobian of its rotation, about each axis of its inertia. Shape (B, 3, V * V)."""
    rest: Tensor
    """Constant part of the mass matrix: armature of actuators and whatever else does not change. Shape (V, V)."""
    inverse: Tensor
    """Inverse of the model's own mass matrix, to start from. Shape (V, V)."""
    subtree: Tensor
    """Whether a body, by column, hangs on another, by row, or is it. Shape (B, B)."""
    moving: Tensor
    """Bodies that move. Shape (B,)."""
    joints: Tensor
    """Averages the degrees of freedom that a joint has weights for in common. Shape (V, V)."""
    moment: Tensor
    """Moment arms of the actuators. Shape (U, V)."""

    @classmethod
    def of(cls, model: mujoco.MjModel, device: torch.device | str = "cpu") -> InertialConstants:
        """Look at a model once. Tensors are float32, computed in float64."""
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)  # in the reference pose
        of_bodies = [_squares_of(model, data, body) for body in range(model.nbody)]
        squares, turns = (np.array(part) for part in zip(*of_bodies, strict=True))
        mass_matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass_matrix)
        basis = _powers(torch.from_numpy(model.body_ipos)).numpy() * model.body_mass[:, None]
        known = np.einsum("bk,bkij->ij", basis, squares) + np.einsum("bk,bkij->ij", model.body_inertia, turns)
        rest = mass_matrix - known - np.diag(model.dof_armature)
        values = {
            "squares": squares.reshape(model.nbody, 10, -1),
            "turns": turns.reshape(model.nbody, 3, -1),
            "rest": rest,
            "inverse": np.linalg.inv(mass_matrix),
            "subtree": _subtree(model),
            "moving": model.body_weldid != 0,
            "joints": _averages(model),
            "moment": _moment(model, data),
        }
        return cls(**{name: torch.tensor(value, dtype=torch.float32, device=device) for name, value in values.items()})

    def __call__(self, fields: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Constants of each env.

        Args:
            fields: The four of :data:`INERTIAL_FIELDS`, each with a row for each of N envs.

        Returns:
            ``body_subtreemass`` (N, B), ``dof_invweight0`` (N, V), ``body_invweight0`` (N, B, 2) and, of models with
            actuators, ``actuator_acc0`` (N, U).
        """
        mass, centre = fields["body_mass"], fields["body_ipos"]
        powers = _powers(centre)
        inverse = self._inverse(mass, powers, fields["body_inertia"], fields["dof_armature"])
        flat, size = inverse.flatten(1), self.squares.shape[-1]
        along = (flat @ self.squares.reshape(-1, size).T).unflatten(-1, self.squares.shape[:2])
        about = (flat @ self.turns.sum(1).T) / 3
        along = (along * powers).sum(-1) / 3
        along, about = (
            torch.where(along < mujoco.mjMINVAL, about, along),
            torch.where(about < mujoco.mjMINVAL, along, about),
        )
        found = {
            "body_subtreemass": self.subtree_mass(mass),
            "dof_invweight0": inverse.diagonal(dim1=-2, dim2=-1) @ self.joints.T,
            "body_invweight0": torch.stack((along, about), -1) * self.moving.unsqueeze(-1),
        }
        if len(self.moment):
            found["actuator_acc0"] = torch.linalg.vector_norm(inverse @ self.moment.T, dim=-2)
        return found

    def subtree_mass(self, mass: Tensor) -> Tensor:
        """Mass of each body with all that hangs on it [kg]. Shape (N, B)."""
        return mass @ self.subtree.T

    def _inverse(self, mass: Tensor, powers: Tensor, inertia: Tensor, armature: Tensor) -> Tensor:
        """Inverse of each env's mass matrix, by iterations that a CUDA graph may hold. Shape (N, V, V).

        Source:
            Schulz 1933; Ben-Israel, Cohen 1966: it converges from any start within a factor of two.
        """
        size = self.squares.shape[-1]
        matrix = (mass.unsqueeze(-1) * powers).flatten(1) @ self.squares.reshape(-1, size)
        matrix = matrix + inertia.flatten(1) @ self.turns.reshape(-1, size)
        matrix = matrix.unflatten(-1, self.rest.shape) + self.rest + torch.diag_embed(armature)
        bound = (self.inverse @ matrix).abs().sum(-1).amax(-1)  # of the eigenvalues of the product
        inverse = self.inverse * (2 / (1 + bound))[:, None, None]
        for _ in range(_ITERATIONS):
            inverse = 2 * inverse - inverse @ (matrix @ inverse)
        return inverse


_ITERATIONS = 9
"""Each squares the error, which starts below 1 - 1 / (ratio of the masses): enough for masses a tenfold off."""


def _powers(centre: Tensor) -> Tensor:
    """1, c and the products of c. Shape (*B, 3) to (*B, 10)."""
    products = [centre[..., i] * centre[..., j] for i, j in _PAIRS]
    return torch.cat((torch.ones_like(centre[..., :1]), centre, torch.stack(products, -1)), -1)


def _squares_of(
    model: mujoco.MjModel, data: mujoco.MjData, body: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Squares of one body: shapes (10, V, V) and (3, V, V)."""
    along, about = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, along, about, data.xpos[body], body)
    turn, inertia_turn = data.xmat[body].reshape(3, 3), np.zeros(9)
    mujoco.mju_quat2Mat(inertia_turn, model.body_iquat[body])
    shift = [np.cross(about.T, turn[:, k]).T for k in range(3)]  # of the velocity, by a centre one metre along axis k
    square = [along.T @ along, *(along.T @ s + s.T @ along for s in shift)]
    square += [shift[i].T @ shift[j] + (shift[j].T @ shift[i] if i != j else 0) for i, j in _PAIRS]
    axes = turn @ inertia_turn.reshape(3, 3)
    turned = axes.T @ about
    return np.array(square), np.array([np.outer(row, row) for row in turned])


def _subtree(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Shape (B, B)."""
    subtree = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):
        subtree[model.body_parentid[body]] += subtree[body]
    return subtree


def _averages(model: mujoco.MjModel) -> NDArray[np.float64]:
    """A free joint has a weight for its place and one for its turn, others have one. Shape (V, V)."""
    average = np.eye(model.nv)
    for kind, first in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        threes = {mujoco.mjtJoint.mjJNT_FREE.value: (0, 3), mujoco.mjtJoint.mjJNT_BALL.value: (0,)}
        for shift in threes.get(kind, ()):
            average[first + shift : first + shift + 3, first + shift : first + shift + 3] = 1 / 3
    return average


def _moment(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Shape (U, V)."""
    moment = np.zeros((len(data.moment_rownnz), model.nv))
    for row, (count, first) in enumerate(zip(data.moment_rownnz, data.moment_rowadr, strict=True)):
        moment[row, data.moment_colind[first : first + count]] = data.actuator_moment[first : first + count]
    return moment
