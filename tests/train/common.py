"""A small network and small people, so that a step takes a fraction of a second."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from uika.data import Sample
from uika.head import HeadParameters, load_head, look_at, pose_vertices, project, rasterize
from uika.model import PRESETS, BackboneConfig
from uika.train import Group, Setup, TrainConfig, train
from uika.train.logbook import read_log

SIZE = 64
MICRO = replace(
    PRESETS["tiny"],
    name="micro",
    image_size=SIZE,
    map_size=64,
    token_grid=8,
    backbone=BackboneConfig(dim=32, depth=2, heads=2, taps=(0, 1)),
    dim=32,
    heads=2,
    layers=2,
    outputs=(1, 1, 2, 2),
    dpt_projections=(8, 8, 8, 8),
    dpt_features=8,
    mlp_width=16,
)
CONFIG = TrainConfig(
    architecture=MICRO,
    steps=4,
    sources=2,
    targets=1,
    images=2,
    items=2,
    size=SIZE,
    fitted=0.0,
    augment=False,
    backgrounds=(1.0,),
    warmup=1,
    ema=0.9,
    save_every=2,
)
ALONE = Group(0, 1, torch.device("cpu"))


class PaintedPerson:
    """Views of the parametric head, painted by position, with exact labels."""

    def __init__(self, seed: int, views: int = 4, spoiled: bool = False) -> None:
        self._seed, self._views, self._spoiled = seed, views, spoiled

    def __len__(self) -> int:
        return self._views

    def sample(self, index: int) -> Sample:
        head = load_head().without_bust
        random = np.random.default_rng([self._seed, index])
        shape = torch.from_numpy(np.random.default_rng(self._seed).normal(size=len(head.identity_basis))).float()
        params = HeadParameters.zeros(head).replace(identity=shape)
        camera = look_at(float(random.uniform(-40, 40)), 0.0, 1.0, (0.0, -0.012, -0.03), fov_y=20.0, size=SIZE)
        vertices = pose_vertices(head, params)
        points, depth = project(vertices, camera)
        triangle, mix = rasterize(points, head.faces, SIZE, SIZE, depth=depth, cull="back")
        hit, at = triangle >= 0, triangle.clamp(min=0)
        corner_uv = head.uvs[head.uv_faces] * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
        paint = 0.5 + 0.4 * torch.sin(head.template[head.faces[at]] * 60 + self._seed)
        image = ((paint * mix[..., None]).sum(-2) * hit[..., None]).permute(2, 0, 1)
        if self._spoiled:
            image = image.masked_fill(hit, torch.nan)
        return Sample(
            key=f"{self._seed:03d}_{index:05d}_00",
            identity=f"{self._seed:03d}",
            timestep=index,
            camera_id="00",
            image=image,
            mask=hit.float(),
            camera=camera,
            parameters=params,
            uv=(corner_uv[at] * mix[..., None]).sum(-2) * hit[..., None],
            uv_valid=hit,
        )


class PaintedPeople:
    def __init__(self, count: int = 3) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> PaintedPerson:
        return PaintedPerson(index)


def run(folder: Path, config: TrainConfig = CONFIG, people=None, group: Group = ALONE, **setup) -> list[dict]:
    """Train and return the log."""
    setting = Setup(folder, **{"workers": 0, "progress": False, **setup})
    train(config, PaintedPeople() if people is None else people, setting, group)
    return read_log(folder)


def losses(log: list[dict]) -> list[float]:
    return [line["loss"] for line in log]


__all__ = ["ALONE", "CONFIG", "MICRO", "SIZE", "PaintedPeople", "PaintedPerson", "losses", "run"]
