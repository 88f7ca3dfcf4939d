"""The models that a reconstruction can use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from uika.assets import CORRESPONDENCE_WEIGHTS, TINY_WEIGHTS
from uika.errors import UikaError

if TYPE_CHECKING:
    from torch import Tensor

    from uika.head import Binding, HeadModel
    from uika.model import Precision, Reconstructor
    from uika.model.estimator_file import AnyEstimator
    from uika.model.released import ReleasedModel
    from uika.model.surface_estimator import SurfaceEstimator

# Who says what a pixel shows: the fitted head; an estimator; the fitted head, in whose fit an estimator had a say.
Correspondence = Literal["fit", "network", "both"]
DEFAULT_CORRESPONDENCE: Correspondence = "fit"
_NAMES = ("tiny", "none")


class LoadedModel(NamedTuple):
    """A network, its name for the avatar's provenance, and what it runs on."""

    network: Reconstructor
    name: str
    run: bool  # or only say what the photos show
    estimator: AnyEstimator | None = None  # finds or helps to find the correspondence, else the fitted head does
    released: ReleasedModel | None = None  # the network with its tables, if it is the authors'
    correspondence: Correspondence = "fit"

    @property
    def sight(self) -> SurfaceEstimator | None:
        """The estimator that has a say in the fit, if one has."""
        from uika.model.surface_estimator import SurfaceEstimator

        helps = self.correspondence == "both" and isinstance(self.estimator, SurfaceEstimator)
        return self.estimator if helps else None  # type: ignore[return-value]

    @property
    def on_template(self) -> bool:
        """Whether Gaussians start on the mean head, so that a photo needs no identity."""
        return self.network.config.canonical == "template"

    @property
    def needs_fit(self) -> bool:
        """Whether heads must be fitted to the photos."""
        return self.estimator is None or not self.on_template

    def takes_bust(self, head: HeadModel) -> bool:
        """Whether avatars get the head's bust: it hangs on a fitted head."""
        return head.bust is not None and not self.on_template

    def template(self, head: HeadModel) -> tuple[Binding, Tensor]:
        """Where the Gaussians of a model on the template sit, and the points [M,3] that they start from.

        Raises:
            CheckpointError: the weights were made for another head model.
        """
        from uika.canonical.surface import template_texels

        if self.released is not None:
            from uika.model.released_binding import template_binding

            return template_binding(self.released, head, self.name), self.released.points
        surface, binding = template_texels(head, self.network.config.map_size)
        return binding, surface.points[0]


def check_model(
    model: str | Path,
    estimator: str | Path | None = None,
    backbone: str | Path | None = None,
    correspondence: Correspondence | None = None,
    precision: Precision = "float32",
) -> None:
    """Refuse files that `reconstruct` could not use, from their headers, before other work starts.

    Raises:
        UikaError: the model is neither a built-in name nor an existing file, or a file is of no use for it.
        CheckpointError: a file holds something else than its place asks for.
    """
    if str(model) not in _NAMES and not Path(model).is_file():
        raise UikaError(f"{model}: no such model; use 'tiny', 'none' or the path of a trained model (.safetensors)")
    from uika.model.weight_kind import ESTIMATORS, MODELS, check_kind

    kind = "model" if str(model) in _NAMES else check_kind(model, MODELS)
    if estimator is not None:
        check_kind(estimator, ESTIMATORS)
        if correspondence == "fit":
            raise UikaError(f"--estimator {estimator}: --correspondence fit asks no estimator; leave one of them out")
    if kind == "released model" and correspondence not in (None, "network"):
        raise UikaError(f"{model}: released weights need an estimator; leave --correspondence {correspondence} out")
    if backbone is not None:
        if kind != "released model":
            raise UikaError(
                f"--backbone {backbone}: model '{model}' brings its own backbone; only released weights take another"
            )
        check_kind(backbone, ("backbone",))
    if precision != "float32" and kind != "released model":
        raise UikaError(f"--precision {precision}: model '{model}' is small and runs in float32; leave it out")


def load_model(
    model: str | Path,
    estimator: str | Path | None = None,
    backbone: str | Path | None = None,
    correspondence: Correspondence | None = None,
    precision: Precision = "float32",
) -> LoadedModel:
    """The model of a name or file that `reconstruct` takes; `precision` is that of released weights.

    `correspondence` None stands for "network" with an estimator's file, else for the default; without a file, "network"
    and "both" take the estimator that comes with the program.

    Raises:
        ValueError: a name or file cannot be used.
    """
    import torch

    from uika.model import build, load_checkpoint
    from uika.model.estimator_file import read_estimator
    from uika.model.surface_estimator import SurfaceEstimator
    from uika.model.weight_kind import weight_kind

    check_model(model, estimator, backbone, correspondence, precision)
    if str(model) not in _NAMES and weight_kind(model) == "released model":
        from uika.model import released

        kind = torch.bfloat16 if precision == "bfloat16" else torch.float32
        whole = released.load(model, dtype=kind, estimator=estimator, backbone=backbone)
        name = f"released ({Path(model).name})" + (f" in {precision}" if precision != "float32" else "")
        return LoadedModel(whole.network, name, True, whole.estimator, whole, "network")
    way = correspondence or ("network" if estimator is not None else DEFAULT_CORRESPONDENCE)
    located = None if way == "fit" else read_estimator(estimator or CORRESPONDENCE_WEIGHTS)
    if way == "both" and not isinstance(located, SurfaceEstimator):
        raise UikaError(f"{estimator}: does not say how sure it is; use it with --correspondence network")
    if str(model) == "tiny":
        return LoadedModel(load_checkpoint(TINY_WEIGHTS), "tiny", True, located, correspondence=way)
    if str(model) == "none":
        return LoadedModel(build("tiny").eval(), "none", False, located, correspondence=way)
    network = load_checkpoint(model)
    name = f"{network.config.name} ({Path(model).name})"
    return LoadedModel(network, name, True, located, correspondence=way)


def check_loaded(loaded: LoadedModel, head: HeadModel, estimator: str | Path | None = None) -> None:
    """Refuse weights that were made for another head model.

    Args:
        loaded: the model.
        head: the head model.
        estimator: the estimator's file, if it was given.

    Raises:
        CheckpointError: the sentence says which weights, and which head they need.
    """
    from uika.model.estimator_file import check_estimator_head

    head = head.without_bust
    if estimator is not None:
        check_estimator_head(estimator, head)
    elif loaded.estimator is not None and loaded.released is None:
        check_estimator_head(CORRESPONDENCE_WEIGHTS, head)
    if loaded.on_template:
        loaded.template(head)
