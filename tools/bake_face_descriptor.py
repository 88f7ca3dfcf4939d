"""Write the built-in face descriptor: `python -m tools.bake_face_descriptor MODEL_FOLDER`.

MODEL_FOLDER is the folder `model` of the npm package `@vladmandic/face-api` (MIT), which holds Davis King's network
`dlib_face_recognition_resnet_model_v1` (CC0) in 8 bits. The numbers are kept as they are; filters become [O,I,H,W].
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from safetensors.numpy import save

from uika.assets import FACE_DESCRIPTOR
from uika.io.files import replacing

NAME = "face_recognition_model"


def main(folder: Path) -> None:
    (group,) = json.loads((folder / f"{NAME}-weights_manifest.json").read_text())
    data = np.frombuffer((folder / group["paths"][0]).read_bytes(), np.uint8)
    tensors, ranges, start = {}, {}, 0
    for entry in group["weights"]:
        shape, stored = entry["shape"], entry.get("quantization", {"dtype": entry["dtype"], "scale": 1.0, "min": 0.0})
        kind = np.dtype(stored["dtype"])
        size = int(np.prod(shape)) * kind.itemsize
        values = data[start : start + size].view(kind).reshape(shape)
        start += size
        name = entry["name"].replace("/", ".")
        tensors[name] = np.ascontiguousarray(values.transpose(3, 2, 0, 1) if len(shape) == 4 else values)
        ranges[name] = [stored["scale"], stored["min"]]
    if start != len(data):
        raise ValueError(f"{folder}: holds {len(data)} bytes where its manifest speaks of {start}")
    with replacing(FACE_DESCRIPTOR) as temporary:
        temporary.write_bytes(save(tensors, {"ranges": json.dumps(ranges)}))
    print(f"wrote {FACE_DESCRIPTOR}: {len(tensors)} tensors, {FACE_DESCRIPTOR.stat().st_size:,} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
