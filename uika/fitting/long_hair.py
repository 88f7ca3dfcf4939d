"""Hair that hangs beside the neck: displacements along normals cannot make it, so it is let down first.

The scalp below the temples falls as one curtain around the skull. How far it falls is read from the mattes: what the
curtain covers beside jaw and neck has to be hair there.
"""

from __future__ import annotations

import torch
from torch import Tensor

from uika.head import Camera, HeadModel, project, rasterize

# Heights are metres above the eyes' joints, depths metres in front of them.
TEMPLES = 0.05  # hair above stays on the skull
ENDS = (-0.07, -0.095, -0.12, -0.145, -0.17)  # heights of the curtain's lower end that are tried
LOBES = -0.04  # below, hair beside the face is hair that hangs
HAIRLINE, FRONT = 0.0123, -0.012  # where hair begins above the ears and beside the temples
NAPE, BEHIND_EAR = -0.07, -0.106  # where it begins at the nape, which lies behind the ears
EDGE = (0.001, 0.008)  # metres inside the hairline over which hair begins to hang
SIDE_LOW, NAPE_LOW = 0.02, -0.06  # roots that low fall all the way, above the ears and behind them
EAR_FRONT, EAR_BACK = -0.092, -0.114  # depths between which the one turns into the other
SHORTER = 0.2  # share by which hair beside the face is shorter than behind
FACE_FROM, FACE_TO = -0.075, -0.045  # depths between which it becomes so
COMBED_BACK = 0.02  # metres that hair beside the face lies farther back than its roots
STANDING = 0.97  # the curtain's radii relative to the skull's largest
FULL = 0.35  # share of the fall after which the curtain stands off fully
SIDE = 96  # pixels of the pictures in which it is compared
LEAST = 0.01  # of the head's area that must be won
ONE_SIDED = 0.01  # of it that must be won by not hanging on one side
MIDDLE = 0.05  # metres from the head's middle plane where its sides begin


def hanging_hair(head: HeadModel, vertices: Tensor, cameras: Camera, mattes: Tensor) -> Tensor:
    """Offsets [V,3] in metres of the curtain that explains the mattes best; zero for hair that does not hang.

    Args:
        head: the head model.
        vertices: [N,V,3] posed bald heads of N photos, at rest but for expressions.
        cameras: [N] their cameras.
        mattes: [N,S,S] head and hair without shoulders, in [0,1].
    """
    best, most = torch.zeros_like(head.template), LEAST
    cameras, small = _smaller(cameras, mattes)
    bands = [_below_lobes(head, cameras[n]) for n in range(len(vertices))]
    bald = [_covered(head, vertices[n], cameras[n]) for n in range(len(vertices))]
    x = head.template[:, :1]
    sides = (torch.ones_like(x), 1 - _ramp(-x, 0.0, MIDDLE), 1 - _ramp(x, 0.0, MIDDLE))
    for end in ENDS:
        whole = curtain(head, vertices[0], end)
        for n_side, share in enumerate(sides):
            won = -ONE_SIDED if n_side else 0.0
            for n in range(len(vertices)):
                added = _covered(head, vertices[n] + share * whole, cameras[n]) & ~bald[n] & bands[n]
                won += float((2 * small[n] - 1)[added].sum() / bald[n].sum().clamp(min=1)) / len(vertices)
            if won > most:
                best, most = share * whole, won
    return best


def overlap(head: HeadModel, vertices: Tensor, cameras: Camera, mattes: Tensor) -> float:
    """Mean over photos of the intersection over union of silhouettes and mattes; arguments as in `hanging_hair`."""
    cameras, small = _smaller(cameras, mattes)
    shares = []
    for n in range(len(vertices)):
        covered, shown = _covered(head, vertices[n], cameras[n]), small[n] > 0.5
        shares.append(float((covered & shown).sum() / (covered | shown).sum().clamp(min=1)))
    return sum(shares) / len(shares)


def curtain(head: HeadModel, vertices: Tensor, end: float) -> Tensor:
    """Offsets [V,3] in metres that let the hair on bald `vertices` [V,3] fall to `end`, in metres above the eyes."""
    eyes = head.joints[3:5].mean(0)
    _, y, z = (head.template - eyes).unbind(-1)
    behind = _ramp(z, EAR_FRONT, EAR_BACK)
    low = torch.lerp(torch.tensor(SIDE_LOW), torch.tensor(NAPE_LOW), behind)
    fall = ((TEMPLES - y) / (TEMPLES - low)).clamp(0, 1)
    reach = (TEMPLES - end) * (1 - SHORTER * _ramp(z, FACE_FROM, FACE_TO))
    down = (TEMPLES - fall * reach - y) * (fall > 0)

    scalp = vertices[head.masks["scalp"] > 0.5][:, [0, 2]]
    first, last = scalp.amin(0), scalp.amax(0)
    middle, radii = (first + last) / 2, STANDING * (last - first) / 2
    flat = vertices[:, [0, 2]] - middle
    distance = flat.norm(dim=-1, keepdim=True).clamp_min(1e-4)
    shell = distance / (flat / radii).norm(dim=-1, keepdim=True).clamp_min(1e-4)
    aside = flat / distance * (shell - distance).clamp_min(0) * _ramp(fall, 0.0, FULL)[:, None]
    back = -COMBED_BACK * fall * _ramp(z, FACE_FROM, FACE_TO)
    offset = torch.stack((aside[:, 0], down, aside[:, 1] + back), -1)
    above, nape = torch.minimum(y - HAIRLINE, FRONT - z), torch.minimum(BEHIND_EAR - z, y - NAPE)
    return _ramp(torch.maximum(above, nape), *EDGE)[:, None] * offset


def _smaller(cameras: Camera, mattes: Tensor) -> tuple[Camera, Tensor]:
    small = torch.nn.functional.interpolate(mattes[:, None].float(), (SIDE, SIDE), mode="area")[:, 0]
    return cameras.resized(SIDE, SIDE), small


def _ramp(x: Tensor, start: float, stop: float) -> Tensor:
    t = ((x - start) / (stop - start)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def _covered(head: HeadModel, vertices: Tensor, camera: Camera) -> Tensor:
    points, depth = project(vertices, camera)
    return rasterize(points, head.faces, camera.height, camera.width, depth=depth, cull="none")[0] >= 0


def _below_lobes(head: HeadModel, camera: Camera) -> Tensor:
    """Pixels [H,W] lower than the ear lobes, along the head's own vertical as the camera sees it."""
    eyes = head.joints[3:5].mean(0)
    levels = torch.stack((eyes, eyes)) + torch.tensor([[0.0, 0.0, 0.0], [0.0, LOBES, 0.0]])
    levels[:, 2] = head.joints[1, 2]
    points, _ = project(levels, camera)
    axis = points[1] - points[0]
    row, column = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    at = torch.stack((column, row), -1) + 0.5 - points[1]
    return at @ axis > 0
