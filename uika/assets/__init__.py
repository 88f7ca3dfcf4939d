"""Files that come with the package: head and bust, the network's weights, the demo portrait; see LICENSES.md."""

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent
PORTRAIT = _FOLDER / "portrait.jpg"
HEAD = _FOLDER / "head.npz"
BUST = _FOLDER / "bust.npz"
FACE_DESCRIPTOR = _FOLDER / "face_descriptor.safetensors"
TINY_WEIGHTS = _FOLDER / "tiny.safetensors"
CORRESPONDENCE_WEIGHTS = _FOLDER / "correspondence.safetensors"
FACE_MODELS = _FOLDER / "face"
LANDMARK_BIAS = _FOLDER / "detector_bias.npz"
