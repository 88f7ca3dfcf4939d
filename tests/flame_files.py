"""Files in FLAME's format, made from the built-in head: the same keys and sizes, no licensed data."""

import pickle
import sys
import types
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from uika.head import HeadModel, load_head

VERTICES = 5023
MOVED_BY_JOINTS = ("jaw", "eyeLook", "mouthClose", "tongue")


@lru_cache(maxsize=1)
def flame_arrays() -> dict[str, np.ndarray]:
    """The arrays of a FLAME model file plus `vt` and `ft`."""
    head = load_head().without_bust
    mix, faces, uv_faces, uvs = _subdivided(head)

    def spread(values: torch.Tensor) -> np.ndarray:
        return np.asarray(mix @ values.double().numpy().reshape(len(head.template), -1))

    template = spread(head.template)
    kept = [i for i, name in enumerate(head.expression_names) if not name.startswith(MOVED_BY_JOINTS)]
    shapes = np.zeros((VERTICES, 3, 400))
    for k, mode in enumerate(head.identity_basis):
        shapes[:, :, k] = spread(mode)
    for k, index in enumerate(kept):
        shapes[:, :, 300 + k] = spread(head.expression_basis[index])
    weights = spread(head.lbs_weights)
    chin = spread(head.expression_basis[head.expression_names.index("jawOpen")])
    jaw = np.clip(np.linalg.norm(chin, axis=1) / 0.035, 0, 1) * (weights[:, 3:].sum(1) < 0.5)
    weights[:, 2] += jaw * weights[:, 1]
    weights[:, 1] *= 1 - jaw
    generator = np.random.default_rng(0)
    regressor = np.zeros((5, VERTICES))
    for joint, place in enumerate(head.joints.double().numpy()):
        near = np.argsort(np.linalg.norm(template - place, axis=1))[:200]
        system = np.concatenate((template[near].T, np.ones((1, len(near)))))
        regressor[joint, near] = np.linalg.lstsq(system, np.append(place, 1.0), rcond=None)[0]
    return {
        "v_template": template,
        "shapedirs": shapes,
        "posedirs": 1e-4 * generator.standard_normal((VERTICES, 3, 36)),
        "J_regressor": regressor,
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], dtype=np.uint32),
        "f": faces.astype(np.uint32),
        "vt": uvs,
        "ft": uv_faces.astype(np.uint32),
    }


def write_pickle(path: Path, arrays: dict[str, np.ndarray], protocol: int = 2) -> Path:
    """Pickle like the public file: `chumpy` shapes and template, a scipy-sparse regressor, notes that are no arrays."""
    from scipy import sparse

    module = types.ModuleType("chumpy.ch")
    package = types.ModuleType("chumpy")
    chumpy: Any = type("Ch", (), {"__module__": "chumpy.ch", "__qualname__": "Ch"})
    module.Ch = chumpy  # type: ignore[attr-defined]
    content: dict[str, Any] = {k: v for k, v in arrays.items() if k not in ("vt", "ft")}
    for name in ("v_template", "shapedirs"):
        wrapped = chumpy()
        wrapped.__dict__.update({"x": np.asfortranarray(content[name]), "_dirty_vars": set(), "_parents": None})
        content[name] = wrapped
    content["J_regressor"] = sparse.csc_matrix(content["J_regressor"])
    content["bs_style"] = "lbs"
    sys.modules.update({"chumpy": package, "chumpy.ch": module})
    try:
        path.write_bytes(pickle.dumps(content, protocol=protocol))
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]
    return path


def write_obj(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in arrays["v_template"]]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in arrays["vt"]]
    for face, uv in zip(arrays["f"].astype(int) + 1, arrays["ft"].astype(int) + 1, strict=True):
        lines.append("f " + " ".join(f"{p}/{t}" for p, t in zip(face, uv, strict=True)))
    path.write_text("\n".join(lines) + "\n")
    return path


def _subdivided(head: HeadModel) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Split edges of the built-in mesh until it has FLAME's number of vertices; `mix` [5023,V] says of what."""
    from scipy import sparse

    faces, uv_faces = head.faces.numpy().tolist(), head.uv_faces.numpy().tolist()
    uvs = head.uvs.double().numpy().tolist()
    rows: list[dict[int, float]] = [{v: 1.0} for v in range(len(head.template))]
    owners: dict[tuple[int, int], list[int]] = {}
    for f, face in enumerate(faces):
        for k in range(3):
            a, b = sorted((face[k], face[(k + 1) % 3]))
            owners.setdefault((a, b), []).append(f)
    touched: set[int] = set()
    for (a, b), pair in owners.items():
        if len(rows) == VERTICES:
            break
        if len(pair) != 2 or touched & set(pair):
            continue
        touched |= set(pair)
        new = len(rows)
        rows.append({a: 0.5, b: 0.5})
        for f in pair:
            face, uv = faces[f], uv_faces[f]
            k = next(k for k in range(3) if {face[k], face[(k + 1) % 3]} == {a, b})
            i, j, o = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            p, q, r = uv[k], uv[(k + 1) % 3], uv[(k + 2) % 3]
            middle = len(uvs)
            uvs.append([(uvs[p][0] + uvs[q][0]) / 2, (uvs[p][1] + uvs[q][1]) / 2])
            faces[f], uv_faces[f] = [i, new, o], [p, middle, r]
            faces.append([new, j, o])
            uv_faces.append([middle, q, r])
    entries = [(r, c, w) for r, row in enumerate(rows) for c, w in row.items()]
    r, c, w = zip(*entries, strict=True)
    mix = sparse.csr_matrix((w, (r, c)), shape=(VERTICES, len(head.template)))
    return mix, np.array(faces), np.array(uv_faces), np.array(uvs)
