"""Identity similarity by ArcFace (Deng et al. 2019), from an ONNX file that the user supplies; none comes along."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uika.errors import UikaError
from uika.metrics.alignment import aligned

SIDE = 112  # pixels of an aligned face
# Where ArcFace was trained to see the eyes, the nose and the corners of the mouth; left is the picture's left.
_PLACES = ((38.2946, 51.6963), (73.5318, 51.5014), (56.0252, 71.7366), (41.5493, 92.3655), (70.7299, 92.2041))
_IRISES, _NOSE, _MOUTH = (468, 473), 4, (61, 291)  # of the face mesh, in that order


class ArcFace:
    """Embeds faces."""

    def __init__(self, path: str | Path) -> None:
        """Read a network.

        Args:
            path: an ONNX file that takes [1,3,112,112] RGB in [-1,1] and gives one embedding [1,D], such as
                InsightFace's w600k_r50.onnx.

        Raises:
            UikaError: onnxruntime is missing, or the file is no such network.
        """
        try:
            import onnxruntime
        except ModuleNotFoundError as error:
            raise UikaError("CSIM needs the package 'onnxruntime'; run: pip install onnxruntime") from error
        if not Path(path).is_file():
            raise UikaError(f"{path}: no such ArcFace network (.onnx)")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own errors share no base class
            raise UikaError(f"{path}: cannot be read as an ONNX network") from error
        shape = self._session.get_inputs()[0].shape
        if list(shape[1:]) != [3, SIDE, SIDE]:
            raise UikaError(f"{path}: takes {shape} where ArcFace takes [1,3,{SIDE},{SIDE}]")

    def embed(self, image: Tensor, landmarks: Tensor) -> Tensor:
        """The unit embedding [D] of the face with `landmarks` [478,2] in a picture [H,W,3] in [0,1]."""
        face = aligned_face(image, landmarks) * 2 - 1
        name = self._session.get_inputs()[0].name
        values: NDArray[np.float32] = self._session.run(None, {name: face.permute(2, 0, 1)[None].numpy()})[0]
        return torch.nn.functional.normalize(torch.from_numpy(values.reshape(-1)).double(), dim=0)


def identity_similarity(network: ArcFace, first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> float:
    """CSIM: cosine between the embeddings of two faces, each a picture [H,W,3] and its landmarks [478,2]."""
    return float(network.embed(*first) @ network.embed(*second))


def aligned_face(image: Tensor, landmarks: Tensor) -> Tensor:
    """The face [112,112,3] turned, scaled and moved to where ArcFace expects it; black beyond the picture."""
    return aligned(image, landmarks[[*_IRISES, _NOSE, *_MOUTH]], torch.tensor(_PLACES), SIDE)
