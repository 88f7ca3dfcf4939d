"""Make `uika/assets/face/*.tflite` from the models inside a mediapipe wheel: `python tools/bake_face_models.py WHEEL`.

Three models are taken as they are. The face mesh with attention holds operations that only mediapipe's own runtime
knows; it is cut at them into the part before, which sees the picture, and the part behind, which sees the three crops
of its features. What lies between is computed by `uika.photo.face_mesh`, from the numbers written beside the models.
"""

from __future__ import annotations

import argparse
import json
import zipfile
from pathlib import Path

import flatbuffers
from ai_edge_litert import schema_py_generated as schema
from flatbuffers import flexbuffers

ROOT = Path(__file__).resolve().parent.parent / "uika" / "assets" / "face"
MODULES = "mediapipe/modules/"
COPIED = {
    "face_detection/face_detection_short_range.tflite": "detection_short.tflite",
    "face_detection/face_detection_full_range_sparse.tflite": "detection_full.tflite",
    "selfie_segmentation/selfie_segmentation.tflite": "selfie.tflite",
}
MESH = "face_landmark/face_landmark_with_attention.tflite"
CUSTOM = ("Landmarks2TransformMatrix", "TransformTensorBilinear", "TransformLandmarks")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path, help="mediapipe-0.10.14-*.whl")
    wheel = zipfile.ZipFile(parser.parse_args().wheel)
    ROOT.mkdir(parents=True, exist_ok=True)
    for source, name in COPIED.items():
        (ROOT / name).write_bytes(wheel.read(MODULES + source))
    content = wheel.read(MODULES + MESH)
    crops, features, parts, places, flag = described(content)
    mesh = parts[0]
    write(ROOT / "mesh.tflite", content, None, [mesh, features, flag])
    write(ROOT / "mesh_parts.tflite", content, crops, parts[1:])
    (ROOT / "mesh_parts.json").write_text(json.dumps(places) + "\n")
    for path in sorted(ROOT.iterdir()):
        print(f"{path.name}: {path.stat().st_size:,} bytes")


def opened(content: bytes) -> schema.ModelT:
    return schema.ModelT.InitFromObj(schema.Model.GetRootAsModel(content, 0))


def kind(model: schema.ModelT, operator: schema.OperatorT) -> str:
    name = model.operatorCodes[operator.opcodeIndex].customCode
    return "" if name is None else name.decode()


def described(content: bytes) -> tuple[list[int], int, list[int], list[dict[str, object]], int]:
    """Tensors where the model is cut: crops, features, landmarks (mesh first), what is known of crops, presence."""
    model = opened(content)
    graph = model.subgraphs[0]
    made = {int(o): operator for operator in graph.operators for o in operator.outputs}
    crops = [operator for operator in graph.operators if kind(model, operator) == CUSTOM[1]]
    matrices = [made[int(operator.inputs[1])] for operator in crops]
    placed = [operator for operator in graph.operators if kind(model, operator) == CUSTOM[2]]
    landmarks = made[int(made[int(matrices[0].inputs[0])].inputs[0])]  # behind its scale
    mesh, flag = int(made[int(landmarks.outputs[0])].inputs[0]), int(graph.outputs[-1])
    places = []
    for operator in matrices:
        options = flexbuffers.Loads(bytes(operator.customOptions))
        places.append(
            {
                "corners": [options["left_rotation_idx"], options["right_rotation_idx"]],
                "landmarks": options["subset_idxs"],
                "scale": options["scale_x"],
                "size": options["output_width"],
            }
        )
    parts = [int(operator.inputs[0]) for operator in placed]  # lips, left eye, left iris, right eye, right iris
    return [int(o.outputs[0]) for o in crops], int(crops[0].inputs[0]), [mesh, *parts], places, flag


def write(path: Path, content: bytes, inputs: list[int] | None, outputs: list[int]) -> None:
    """The part of a model between `inputs` (None: its own) and `outputs`, without what nothing of it needs."""
    model = opened(content)
    graph = model.subgraphs[0]
    start = {int(tensor) for tensor in (graph.inputs if inputs is None else inputs)}
    wanted, kept = set(outputs), []
    for operator in reversed(graph.operators):
        made = {int(tensor) for tensor in operator.outputs}
        if made & wanted and not made & start:
            kept.append(operator)
            wanted |= {int(tensor) for tensor in operator.inputs if tensor >= 0}
    graph.operators = kept[::-1]
    used = sorted({int(t) for o in kept for t in (*o.inputs, *o.outputs) if t >= 0} | start | set(outputs))
    place = {tensor: index for index, tensor in enumerate(used)}
    graph.tensors = [graph.tensors[tensor] for tensor in used]
    for operator in kept:
        operator.inputs = [place.get(int(t), -1) for t in operator.inputs]
        operator.outputs = [place[int(t)] for t in operator.outputs]
    graph.inputs = [place[int(t)] for t in (graph.inputs if inputs is None else inputs)]
    graph.outputs = [place[t] for t in outputs]
    buffers = sorted({tensor.buffer for tensor in graph.tensors} | {0})
    for tensor in graph.tensors:
        tensor.buffer = buffers.index(tensor.buffer)
    model.buffers = [model.buffers[index] for index in buffers]
    codes = sorted({operator.opcodeIndex for operator in kept})
    for operator in kept:
        operator.opcodeIndex = codes.index(operator.opcodeIndex)
    model.operatorCodes = [model.operatorCodes[index] for index in codes]
    assert not any(kind(model, operator) for operator in kept)
    model.metadata, model.metadataBuffer, model.signatureDefs = [], [], []
    builder = flatbuffers.Builder(len(content))
    builder.Finish(model.Pack(builder), b"TFL3")
    path.write_bytes(bytes(builder.Output()))


if __name__ == "__main__":
    main()
