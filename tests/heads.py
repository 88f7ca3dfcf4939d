"""A small synthetic head for tests: an ellipsoid with a UV seam, random bases and five joints."""

import math

import torch
from safetensors.torch import load_file

from tests.recorded import PARITY
from uika.head import HeadModel


def sphere_head(rows: int = 16, columns: int = 24, identities: int = 4, expressions: int = 3) -> HeadModel:
    """Latitude-longitude ellipsoid, 0.2 m high; its UV seam and doubled UV poles make uv_faces differ from faces."""
    generator = torch.Generator().manual_seed(0)
    vertices = [torch.tensor([0.0, -1.0, 0.0])]
    for row in range(1, rows):
        latitude = math.pi * (row / rows - 0.5)
        for column in range(columns):
            longitude = 2 * math.pi * (column / columns - 0.5)
            ring = math.cos(latitude)
            position = (math.sin(longitude) * ring, math.sin(latitude), math.cos(longitude) * ring)
            vertices.append(torch.tensor(position))
    vertices.append(torch.tensor([0.0, 1.0, 0.0]))
    template = torch.stack(vertices) * torch.tensor([0.08, 0.1, 0.09])
    V = len(template)

    def vertex(row: int, column: int) -> int:
        if row == 0:
            return 0
        return V - 1 if row == rows else 1 + (row - 1) * columns + column % columns

    faces, uv_faces = [], []
    for row in range(rows):
        for column in range(columns):
            corners = ((row, column), (row, column + 1), (row + 1, column + 1), (row + 1, column))
            if row > 0:
                faces.append([vertex(*corners[k]) for k in (0, 1, 2)])
                uv_faces.append([r * (columns + 1) + c for r, c in (corners[k] for k in (0, 1, 2))])
            if row < rows - 1:
                faces.append([vertex(*corners[k]) for k in (0, 2, 3)])
                uv_faces.append([r * (columns + 1) + c for r, c in (corners[k] for k in (0, 2, 3))])
    uvs = torch.tensor(
        [[0.05 + 0.9 * c / columns, 0.05 + 0.9 * r / rows] for r in range(rows + 1) for c in range(columns + 1)]
    )
    joints = torch.tensor([[0, -0.1, 0], [0, -0.06, 0], [0, -0.02, 0.02], [0.03, 0.03, 0.06], [-0.03, 0.03, 0.06]])
    height = template[:, 1]
    weights = torch.softmax(torch.stack([-80 * (height - y) ** 2 / 0.02 for y in (-0.1, -0.05, 0.0, 0.04, 0.05)], 1), 1)
    landmarks = torch.tensor([5, 40, 100])
    return HeadModel(
        id="synthetic-1",
        template=template,
        identity_basis=0.004 * torch.randn(identities, V, 3, generator=generator),
        expression_basis=0.003 * torch.randn(expressions, V, 3, generator=generator),
        expression_names=tuple(f"action{index}" for index in range(expressions)),
        faces=torch.tensor(faces),
        uvs=uvs,
        uv_faces=torch.tensor(uv_faces),
        joints=joints.float(),
        joint_identity=0.002 * torch.randn(identities, 5, 3, generator=generator),
        joint_expression=torch.zeros(expressions, 5, 3),
        lbs_weights=weights,
        pose_basis=None,
        masks={"face": (template[:, 2] > 0).float(), "scalp": (template[:, 1] > 0.05).float()},
        landmark_faces=landmarks,
        landmark_barycentrics=torch.tensor([[0.2, 0.3, 0.5]]).expand(3, 3).contiguous(),
        landmark_ids=torch.tensor([1, 33, 263]),
        landmark_weights=torch.ones(3),
    )


def released_parity() -> tuple[dict[str, torch.Tensor], HeadModel]:
    """The arrays of the released-model fixture and the head they describe; needs the parity folder."""
    data = load_file(PARITY / "flame_uv_lbs.safetensors")
    template, shapes = data["w/v_template"], data["w/shapedirs"].permute(2, 0, 1)
    regressor = data["w/J_regressor"]
    V = len(template)
    head = HeadModel(
        id="flame-synthetic",
        template=template,
        identity_basis=shapes[:20],
        expression_basis=shapes[20:],
        expression_names=tuple(f"expression{index}" for index in range(10)),
        faces=data["w/faces"],
        uvs=data["w/verts_uvs"],
        uv_faces=data["w/textures_idx"],
        joints=regressor @ template,
        joint_identity=regressor @ shapes[:20],
        joint_expression=regressor @ shapes[20:],
        lbs_weights=data["w/lbs_weights"],
        pose_basis=data["w/posedirs"].view(36, V, 3),
        masks={},
        landmark_faces=data["w/full_lmk_faces_idx"][0],
        landmark_barycentrics=data["w/full_lmk_bary_coords"][0],
        landmark_ids=torch.arange(5),
        landmark_weights=torch.ones(5),
    )
    return data, head
