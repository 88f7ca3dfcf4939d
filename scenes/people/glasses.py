"""Glasses: two rims, a bridge and two temples as thin tubes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from uika.head import HeadModel, HeadParameters, joint_transforms, rest_joints

_RIM, _SIDES = 28, 6  # points around a lens, and around the tube
_BRIDGE, _TEMPLE = 6, 8  # points along these tubes
_NECK, _LEFT_EYE, _RIGHT_EYE = 1, 3, 4


@dataclass(frozen=True, eq=False)
class Glasses:
    """Glasses in world space, on the topology of `glasses_topology`."""

    points: np.ndarray  # [N,3] float32 metres
    colour: tuple[float, float, float]  # linear


@dataclass(frozen=True)
class GlassesStyle:
    """What distinguishes one pair from another."""

    lens: tuple[float, float]  # half width and half height, metres
    squareness: float  # exponent of the rim's superellipse: 2 is round, larger is squarer
    thickness: float  # radius of the tubes, metres
    colour: tuple[float, float, float]  # linear


def wear_glasses(
    style: GlassesStyle, head: HeadModel, params: HeadParameters, vertices: torch.Tensor, shape: torch.Tensor
) -> Glasses:
    """Put glasses on a head.

    Args:
        style: the glasses.
        head: the head model.
        params: pose of one frame, without batch dimensions.
        vertices: [V,3] unposed vertices of the person without expression, which decide the fit.
        shape: [K] identity, which decides where the eyes are.
    """
    joints = rest_joints(head, HeadParameters.zeros(head).replace(identity=shape))
    eyes = joints[[_LEFT_EYE, _RIGHT_EYE]].numpy()
    lines = _centre_lines(style, eyes, vertices.numpy())
    rest = np.concatenate([_tube(line, style.thickness, closed) for line, closed in lines]).astype(np.float32)
    transform = joint_transforms(head, params)[_NECK].numpy()
    return Glasses((rest @ transform[:3, :3].T + transform[:3, 3]).astype(np.float32), style.colour)


@lru_cache(maxsize=1)
def glasses_topology() -> tuple[np.ndarray, np.ndarray]:
    """Points [N,3] of some glasses and the triangles [F,3] uint32 that all glasses share."""
    style = GlassesStyle((0.025, 0.02), 2.0, 0.001, (0.0, 0.0, 0.0))
    eyes = np.array([[0.03, 0.0, 0.03], [-0.03, 0.0, 0.03]])
    ears = np.array([[0.08, 0.0, -0.06], [-0.08, 0.0, -0.06], [0.0, 0.0, 0.06]])
    points, faces, start = [], [], 0
    for line, closed in _centre_lines(style, eyes, ears):
        points.append(_tube(line, style.thickness, closed))
        rings = len(line)
        for ring in range(rings if closed else rings - 1):
            for side in range(_SIDES):
                a, b = ring * _SIDES + side, ring * _SIDES + (side + 1) % _SIDES
                c, d = (a + _SIDES) % (rings * _SIDES), (b + _SIDES) % (rings * _SIDES)
                faces += [[start + a, start + b, start + c], [start + b, start + d, start + c]]
        start += rings * _SIDES
    return np.concatenate(points).astype(np.float32), np.array(faces, np.uint32)


def _centre_lines(style: GlassesStyle, eyes: np.ndarray, vertices: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Centre lines [P,3] of the tubes and whether they are closed: rims, bridge, temples; left first."""
    middle = eyes.mean(0)
    near = vertices[(np.abs(vertices[:, 1] - middle[1]) < 0.02)] if len(vertices) > 3 else vertices
    bridge_near = near[np.abs(near[:, 0]) < 0.02] if len(near) > 3 else near
    front = (bridge_near[:, 2].max() if len(bridge_near) else eyes[:, 2].max() + 0.03) + 0.003
    angle = 2 * np.pi * np.arange(_RIM) / _RIM
    outline = np.stack((np.cos(angle), np.sin(angle)), -1)
    outline = np.sign(outline) * np.abs(outline) ** (2 / style.squareness) * style.lens
    lines: list[tuple[np.ndarray, bool]] = []
    for eye in eyes:
        x = eye[0] + outline[:, 0]
        # Lenses wrap around the face a little.
        rim = np.stack((x, middle[1] - 0.003 + outline[:, 1], front - 4.0 * (x - middle[0]) ** 2), -1)
        lines.append((rim, True))
    share = np.linspace(0, 1, _BRIDGE)[:, None]
    inner = [lines[0][0][_RIM // 2], lines[1][0][0]]
    arch = np.array([0.0, 0.004, 0.001]) * np.sin(np.pi * share)
    lines.append((inner[0] * (1 - share) + inner[1] * share + arch, False))
    share = np.linspace(0, 1, _TEMPLE)[:, None]
    for index, sign in ((0, 1.0), (1, -1.0)):
        hinge = lines[index][0][0 if sign > 0 else _RIM // 2]
        side = near[near[:, 0] * sign > 0] if len(near) > 3 else near
        reach = max(float((side[:, 0] * sign).max(initial=0.07)) - 0.006, abs(hinge[0]) + 0.002)
        ear = np.array([sign * reach, middle[1] + 0.004, -0.045])
        bow = np.array([sign * 0.006, 0.0, 0.0]) * np.sin(np.pi * share)
        lines.append((hinge * (1 - share) + ear * share + bow, False))
    return lines


def _tube(line: np.ndarray, radius: float, closed: bool) -> np.ndarray:
    """Rings of points [P*_SIDES,3] around a line [P,3]."""
    ahead = np.roll(line, -1, 0) - np.roll(line, 1, 0) if closed else np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    up = np.broadcast_to(np.array([0.0, 0.15, 1.0]) if closed else np.array([0.0, 1.0, 0.1]), line.shape)
    across = np.cross(ahead, up)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    other = np.cross(across, ahead)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * other[:, None]
    return (line[:, None] + radius * ring).reshape(-1, 3)
