"""The models that a reconstruction can use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from uika.assets import TINY_WEIGHTS
from uika.errors import UikaError

if TYPE_CHECKING:
    from uika.model import Reconstructor


class LoadedModel(NamedTuple):
    """A network, its name for the avatar's provenance, and whether it is run or only says what the photos show."""

    network: Reconstructor
    name: str
    run: bool


def check_model(model: str | Path) -> None:
    """Refuse a model that `reconstruct` could not use, before other work starts.

    Raises:
        UikaError: it is neither a built-in name nor an existing file.
    """
    if str(model) not in ("tiny", "none") and not Path(model).is_file():
        raise UikaError(f"{model}: no such model; use 'tiny', 'none' or the path of a trained model (.safetensors)")


def load_model(model: str | Path) -> LoadedModel:
    """The model of a name or file that `reconstruct` takes.

    Raises:
        ValueError: the name or file cannot be used.
    """
    from uika.model import build, load_checkpoint

    check_model(model)
    if str(model) == "tiny":
        return LoadedModel(load_checkpoint(TINY_WEIGHTS), "tiny", True)
    if str(model) == "none":
        return LoadedModel(build("tiny").eval(), "none", False)
    network = load_checkpoint(model)
    return LoadedModel(network, f"{network.config.name} ({Path(model).name})", True)
