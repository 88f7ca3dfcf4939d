"""Fit a head's bust to photos: the torso's turn in each, its shape, and clothes as a displacement that meets the matte.

The cameras carry the head's pose, so the torso gets a rotation of its own in every photo. Its outline is compared with
the person's matte along rays from a point in the chest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from uika.fitting.bust_mesh import BustMesh
from uika.fitting.outline_rays import Array, directions, far_crossings, first_exits, same_crossings
from uika.head import Camera, HeadModel, HeadParameters, pose_vertices, rest_joints, shaped_vertices
from uika.head.axis_angle import axis_angle, rotation
from uika.head.rotations import rodrigues

RAYS = 216
BELOW_NECK = 0.07  # metres from the joint between torso and neck down to where the rays start
RIM = 0.02  # metres above the cut that ends the bust in which its outline says nothing
SPREADS = (0.08, 0.08, 0.05, 0.05, 0.03, 0.03)  # metres, step by step, by which clothes may differ from a bare torso
TURN_SPREAD = (0.2, 0.35, 0.15)  # radians about x, y and z, around the likely turn
UPRIGHT = (0.8, 0.5, 0.8)  # share of the turn, about x, y and z, that would make an upright torso face the camera
INDEPENDENT = 40  # rays that tell as much as all of them
STEP = 1e-3  # difference for Gauss-Newton's derivatives
ROUNDS = 5  # of displacement
MAX_OFFSET, MIN_OFFSET = 0.1, -0.08  # metres of clothes


@dataclass(frozen=True)
class TorsoFit:
    """offset [V,3] metres on the unposed head with its bust; turns [N,3] axis-angle of the torso in each photo."""

    offset: Tensor
    turns: Tensor


@dataclass(frozen=True)
class _View:
    """One photo: where its matte ends along the rays from `centre` [2], and which turn is likely."""

    index: int
    viewmat: Array  # [4,4]
    focal: float  # pixels
    principal: Array  # [2] pixels
    pivot: Array  # [3] metres, the joint between torso and neck
    likely: Array  # [3]
    centre: Array
    reach: Array  # [R] pixels, NaN where nothing is known

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels [...,2] and depths [...] of points [...,3]."""
        local = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        return self.focal * local[..., :2] / local[..., 2:] + self.principal, local[..., 2]


def torso_parameters(head: HeadModel, parameters: HeadParameters, turns: Tensor) -> HeadParameters:
    """Parameters [...] with the torso turned by `turns` [...,3] (axis-angle, radians) under a head that stays."""
    joints = rest_joints(head, parameters)
    arm = joints[..., 1, :] - joints[..., 0, :]
    shift = arm - (rodrigues(turns) @ arm[..., None])[..., 0]
    return parameters.replace(rotation=turns, neck=-turns, translation=shift)


def fit_torso(
    head: HeadModel,
    parameters: HeadParameters,
    static_offset: Tensor,
    cameras: Camera,
    mattes: Tensor,
    inside: Tensor,
) -> TorsoFit:
    """Fit the bust of a head to photos whose head is fitted.

    Args:
        head: a head model with a bust.
        parameters: [N] of its head, one identity, joints at rest.
        static_offset: [H,3] metres, hair on the head alone.
        cameras: [N] of wider crops that show the shoulders.
        mattes: [N,S,S] of the person in them, in [0,1].
        inside: [N,S,S] how far each pixel lies in its photo.
    """
    return _TorsoFitter(head, parameters, static_offset, cameras, mattes, inside).run()


class _TorsoFitter:
    def __init__(
        self,
        head: HeadModel,
        parameters: HeadParameters,
        static_offset: Tensor,
        cameras: Camera,
        mattes: Tensor,
        inside: Tensor,
    ) -> None:
        self.head, self.mesh = head, BustMesh(head)
        self.neutral = parameters[0].replace(expression=torch.zeros_like(parameters.expression[0]))
        self.offset = self.mesh.continued(static_offset)
        self.rays = directions(RAYS)
        self.weight = head.lbs_weights[self.mesh.used, 0].double().numpy()[:, None]
        self.low = head.template[self.mesh.used, 1].numpy() < float(head.template[:, 1].min()) + RIM
        self.root, self.pivot = rest_joints(head, self.neutral)[:2].double().numpy()
        whole = pose_vertices(head, parameters, self.offset)[:, : self.mesh.first].double().numpy()
        self.rest = shaped_vertices(head, self.neutral, self.offset)[self.mesh.used].double().numpy()
        self.views = [
            self._view(n, cameras[n], mattes[n].numpy(), inside[n].numpy(), whole[n]) for n in range(len(mattes))
        ]

    def run(self) -> TorsoFit:
        turns, shape = np.stack([view.likely for view in self.views]), np.zeros(len(self.mesh.modes))
        for spread in SPREADS:
            turns, shape = self._step(turns, shape, spread)
        offset = self.mesh.shaped(self.offset, shape)
        normals = self.mesh.smooth_normals(shaped_vertices(self.head, self.neutral, offset))
        rest, along = self._shaped(shape), normals.double().numpy()
        height = np.zeros(len(normals))
        for _ in range(ROUNDS):
            lifted = rest.copy()
            lifted[: len(height)] += height[:, None] * along
            demands = [self._demand(view, turns[view.index], lifted, along) for view in self.views]
            vertex, wanted, pull = (np.concatenate(part) for part in zip(*demands, strict=True))
            weight = np.bincount(vertex, pull, len(height))
            gap = np.bincount(vertex, pull * wanted, len(height)) / weight.clip(1e-9)
            target = (height + gap).clip(MIN_OFFSET, MAX_OFFSET)
            height = self.mesh.membrane(target, weight / len(self.views)).clip(MIN_OFFSET, MAX_OFFSET)
        return TorsoFit(self.mesh.lifted(offset, height, normals), torch.tensor(turns, dtype=torch.float32))

    def _shaped(self, shape: Array) -> Array:
        """The mesh's vertices [U,3] at rest with modes added."""
        result = self.rest.copy()
        result[: self.mesh.count] += np.tensordot(shape, self.mesh.modes, 1)
        return result

    def _view(self, index: int, camera: Camera, matte: Any, inside: Any, head: Array) -> _View:
        viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
        likely = np.array(UPRIGHT) * axis_angle(viewmat[:3, :3].T @ np.diag([1.0, -1.0, -1.0]))
        view = _View(index, viewmat, K[0, 0], K[:2, 2], self.pivot, likely, np.zeros(2), np.zeros(RAYS))
        chest = self.root - self.pivot - [0.0, BELOW_NECK, 0.0]
        centre = view.project(self.pivot + rotation(likely) @ chest)[0]
        reach = first_exits(matte, inside, centre, self.rays)
        # Where the head reaches farther than the bust, the matte says nothing about the bust.
        bust = far_crossings(view.project(self._turned(self.rest, likely))[0], self.mesh.edges, centre, self.rays)[0]
        points = view.project(head)[0] - centre
        sector = (np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi) / (2 * np.pi) * RAYS).astype(int) % RAYS
        above = np.zeros(RAYS)
        np.maximum.at(above, sector, np.hypot(*points.T))
        return replace(view, centre=centre, reach=np.where(above < bust, reach, np.nan))

    def _turned(self, rest: Array, turn: Array) -> Array:
        """Skinning by `torso_parameters`: the torso turns about the joint of a neck whose other end stays."""
        return rest + self.weight * ((rest - self.pivot) @ (rotation(turn) - np.eye(3)).T)

    def _gaps(self, view: _View, rest: Array, turn: Array) -> tuple[Array, Array, Array]:
        """How far the matte reaches beyond the model along each ray [R], metres or NaN, and which crossing it is."""
        pixels, depth = view.project(self._turned(rest, turn))
        radius, edge, share = far_crossings(pixels, self.mesh.edges, view.centre, self.rays)
        ends = self.mesh.edges[edge]
        known = np.isfinite(view.reach) & (radius > 0) & ~self.low[ends].all(1)
        gap = (view.reach - radius) * depth[ends].mean(1) / view.focal
        return np.where(known, gap, np.nan), edge, share

    def _step(self, turns: Array, shape: Array, spread: float) -> tuple[Array, Array]:
        """One step of robust Gauss-Newton on turns and shape."""
        count, modes = turns.size, len(shape)
        prior = np.concatenate([1 / np.tile(TURN_SPREAD, len(turns)), np.ones(modes)])
        likely = np.stack([view.likely for view in self.views])
        matrix = np.diag(prior**2)
        gradient = prior**2 * np.concatenate([(turns - likely).ravel(), shape])
        rest = self._shaped(shape)
        shifted = [self._shaped(shape + STEP * unit) for unit in np.eye(modes)]
        for view in self.views:
            turn = turns[view.index]
            gap, edge, _ = self._gaps(view, rest, turn)
            good = np.flatnonzero(np.isfinite(gap))
            ends, rays = self.mesh.edges[edge[good]], self.rays[good]
            pixels, depth = view.project(self._turned(rest, turn))
            radius = same_crossings(pixels, ends, view.centre, rays)
            moves = [(rest, turn + STEP * unit) for unit in np.eye(3)] + [(moved, turn) for moved in shifted]
            columns = [
                same_crossings(view.project(self._turned(*moved))[0], ends, view.centre, rays) - radius
                for moved in moves
            ]
            slope = -np.stack(columns, -1) / STEP * (depth[ends].mean(1) / view.focal)[:, None]
            if not len(good):
                continue
            residual, jacobian = gap[good] / spread, slope / spread
            # Neighbouring rays see the same fold of cloth: all together weigh as few independent ones.
            weight = INDEPENDENT / RAYS / (1 + residual**2) ** 2
            place = np.concatenate([np.arange(3) + 3 * view.index, count + np.arange(modes)])
            matrix[np.ix_(place, place)] += jacobian.T @ (weight[:, None] * jacobian)
            gradient[place] += jacobian.T @ (weight * residual)
        step = -np.linalg.solve(matrix, gradient)
        return turns + step[:count].reshape(turns.shape).clip(-0.3, 0.3), shape + step[count:].clip(-1, 1)

    def _demand(self, view: _View, turn: Array, rest: Array, normals: Array) -> tuple[Any, Array, Array]:
        """Vertices of the bust at the outline, how far they should move along their normals (metres), how surely."""
        gap, edge, share = self._gaps(view, rest, turn)
        known = np.flatnonzero(np.isfinite(gap))
        ends = self.mesh.edges[edge[known]]
        pull = np.stack((1 - share[known], share[known]), 1)
        flat = (normals @ (view.viewmat[:3, :3] @ rotation(turn)).T)[:, :2]
        flat /= np.linalg.norm(flat, axis=1, keepdims=True).clip(1e-9)
        own = ends < len(normals)
        outward = (flat[ends.clip(max=len(normals) - 1)] * self.rays[known][:, None]).sum(-1)
        good = own & (outward > 0.3)
        wanted = gap[known][:, None] / outward.clip(0.5)
        return ends[good], wanted[good], pull[good]
