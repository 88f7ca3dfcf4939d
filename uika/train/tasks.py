"""The two trainings: what their networks make of an item, and which losses judge it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from uika.canonical.regions import regions
from uika.canonical.surface import canonical_binding, face_map, mirror_map
from uika.head import HeadModel, pose_gaussians, skin_points
from uika.metrics.lpips import Lpips
from uika.model import ESTIMATORS, Estimator, Reconstructor, SurfaceTexels, build
from uika.model.estimator_file import AnyEstimator
from uika.train.config import TrainConfig
from uika.train.item import Item
from uika.train.losses import alpha_loss, gradient_loss, l1, offset_loss, opacity_entropy, ssim_loss, variation


class Task(Protocol):
    """A network to train, and its losses."""

    @property
    def network(self) -> nn.Module:
        """Takes a list of items; gives a tuple of tensors for each."""

    @property
    def model(self) -> nn.Module:
        """The part of the network that is saved for use."""

    def terms(self, output: Sequence[Tensor], item: Item) -> dict[str, Tensor]:
        """Weighted losses of an output of the network; their sum is minimised."""

    def measures(self, output: Sequence[Tensor]) -> dict[str, Tensor]:
        """What is worth a histogram."""


class GaussianNetwork(nn.Module):
    """Items to Gaussians; the module that is distributed, so that its parameters are gathered on the way in."""

    def __init__(self, model: Reconstructor, head: HeadModel, estimator: AnyEstimator | None = None) -> None:
        """`head` decides the texels; `estimator`, which is not trained, finds the correspondence of the photos."""
        super().__init__()
        self.model = model
        # Not a part of this module, whose parameters are distributed, counted and saved.
        self._estimator = () if estimator is None else (estimator.eval().requires_grad_(False),)
        size = model.config.map_size
        self._binding = canonical_binding(head, model.config.canonical, size)
        self._mirror, self._regions = mirror_map(head, size), regions(head, self._binding)
        self._face = face_map(head, self._binding)

    def forward(self, items: Sequence[Item]) -> list[tuple[Tensor, ...]]:
        """Means, quats, scales, opacities, colours, offsets, the completed observation and its share [M] of each."""
        return [self._one(item) for item in items]

    def _one(self, item: Item) -> tuple[Tensor, ...]:
        device = item.images.device
        surface = SurfaceTexels(
            item.points[None],
            item.quats[None],
            item.scales[None],
            self._mirror.to(device),
            self._regions.to(device),
            item.prior if len(item.prior) else None,
            item.lift,
            item.shape,
            None if self._face is None else self._face.to(device),
        )
        photos = (item.images[None], item.masks[None], *self._located(item))
        views = self.model.encode(*photos)
        result = self.model.decode(views, self._binding.texel.to(device), surface)
        tensors = (result.means, result.quats, result.scales, result.opacities, result.colors, result.offsets)
        seen = torch.cat((result.aggregate, result.known), dim=1).flatten(2)[0, :, self._binding.texel.to(device)].mT
        return *(tensor[0].float() for tensor in tensors), seen[:, :3], seen[:, 3]

    def _located(self, item: Item) -> tuple[Tensor, Tensor]:
        """UV maps [1,V,2,S,S] of the photos and the trust [1,V,1,S,S] in them."""
        for estimator in self._estimator:
            with torch.no_grad():
                uv = estimator.to(item.images.device)(item.images[None]).float()
            person = item.masks[None]
            return torch.where(person > 0, uv, torch.nan), person
        return item.uv[None], item.weights[None]


class ReconstructionTask:
    """Photos to Gaussians, judged by pictures of them (paper section 3.4)."""

    def __init__(
        self,
        config: TrainConfig,
        head: HeadModel,
        perceptual: Lpips | None = None,
        estimator: AnyEstimator | None = None,
    ) -> None:
        """A fresh model of the preset; `perceptual` takes the place of the gradient loss, `estimator` that of fits."""
        self.model = build(config.model, config.seed)
        if config.model.scope != "all":
            for name in ("xyz", "opacity", "scaling", "rotation"):  # count for nothing
                self.model.gs_decoder.gs_net.out_layers[name].requires_grad_(False)
        self.network = GaussianNetwork(self.model, head, estimator)
        self._head = head
        self._binding = canonical_binding(head, config.model.canonical, self.model.config.map_size)
        self._losses, self._perceptual = config.losses, perceptual

    def terms(self, output: Sequence[Tensor], item: Item) -> dict[str, Tensor]:
        """Weighted losses, and `psnr` in dB for the log."""
        image, alpha = self.render(output, item)
        means, _, _, opacities, colors, offsets, observed, known = output
        weights = self._losses
        terms = {
            "l1": weights.l1 * l1(image, item.pictures),
            "ssim": weights.ssim * ssim_loss(image, item.pictures),
            "offset": weights.offset * offset_loss(offsets),
        }
        if self._perceptual is not None:
            terms["lpips"] = weights.lpips * self._perceptual(image, item.pictures)
        elif weights.gradient:
            terms["gradient"] = weights.gradient * gradient_loss(image, item.pictures)
        if weights.entropy:
            terms["entropy"] = weights.entropy * opacity_entropy(opacities)
        if weights.alpha:
            terms["alpha"] = weights.alpha * alpha_loss(alpha, item.coverage)
        if weights.atlas and len(item.texture):
            terms["atlas"] = weights.atlas * self._atlas(colors, item.texture, 1 - (1 - weights.atlas_seen) * known)
        if weights.change:
            terms["change"] = weights.change * ((colors - observed).abs() * known[:, None]).mean()
        if weights.relief:
            terms["relief"] = weights.relief * l1(means, item.relief)
        square = (image.detach() - item.pictures).square().mean(dim=1, keepdim=True)
        inside = (square * item.person).sum((1, 2, 3)) / item.person.sum((1, 2, 3)).clamp_min(1)
        return terms | {"psnr": _decibel(square.mean(dim=(1, 2, 3))), "psnr_masked": _decibel(inside)}

    def _atlas(self, colors: Tensor, texture: Tensor, weight: Tensor) -> Tensor:
        """Mean distance of colours [M,3] from the true ones where those are known, by a weight [M]."""
        truth = texture.flatten(1)[:, self._binding.texel.to(texture.device)].mT
        known = truth[:, 3:] * weight[:, None]
        return ((colors - truth[:, :3]).abs() * known).sum() / (3 * known.sum()).clamp_min(1)

    def render(self, output: Sequence[Tensor], item: Item) -> tuple[Tensor, Tensor]:
        """Pictures [D,3,S,S] and coverage [D,1,S,S] of Gaussians in an item's poses; equal poses share one call."""
        from drjit_splat import rasterization

        means, quats, scales, opacities, colors = output[:5]
        binding, device = self._binding, means.device
        images: list[Tensor | None] = [None] * len(item.pictures)
        alphas: list[Tensor | None] = [None] * len(item.pictures)
        for group in _same_poses(item.posed):
            if item.driving is None:
                placed = pose_gaussians(
                    means,
                    quats,
                    scales,
                    item.canonical,
                    item.posed[group[0]],
                    self._head.faces.to(device),
                    binding.triangle.to(device),
                    binding.barycentric.to(device),
                )
            else:
                self._head, self._binding = self._head.to(device=device), self._binding.to(device)
                centres = skin_points(means, self._head, item.driving[group[0]], self._binding)
                placed = (centres, quats, scales)
            size = item.pictures.shape[-1]
            cameras = (item.viewmats[group], item.Ks[group])
            seen, coverage, _ = rasterization(
                *placed, opacities, colors, *cameras, size, size, backgrounds=item.backgrounds[group]
            )
            for place, index in enumerate(group):
                images[index], alphas[index] = seen[place].permute(2, 0, 1), coverage[place].permute(2, 0, 1)
        return torch.stack([i for i in images if i is not None]), torch.stack([a for a in alphas if a is not None])

    def measures(self, output: Sequence[Tensor]) -> dict[str, Tensor]:
        """Attributes of the Gaussians."""
        _, _, scales, opacities, colors, offsets, *_ = output
        return {
            "offset_mm": 1000 * offsets.norm(dim=-1),
            "log10_scale": scales.clamp_min(1e-8).log10(),
            "opacity": opacities,
            "color": colors,
        }


class MapNetwork(nn.Module):
    """Items to correspondence maps."""

    def __init__(self, model: Estimator) -> None:
        """Wrap the estimator."""
        super().__init__()
        self.model = model

    def forward(self, items: Sequence[Item]) -> list[tuple[Tensor, ...]]:
        """UV maps [V,2,S,S] of each item."""
        return [(self.model(item.images[None])[0].float(),) for item in items]


class EstimatorTask:
    """Photos to correspondences, judged by exact ones (supplement A.1)."""

    def __init__(self, config: TrainConfig) -> None:
        """A fresh model of the preset."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.model = Estimator(ESTIMATORS[config.preset])
        self.network = MapNetwork(self.model)
        self._losses = config.losses

    def terms(self, output: Sequence[Tensor], item: Item) -> dict[str, Tensor]:
        """Weighted losses, and `error`, the mean distance in thousandths of the atlas, for the log."""
        (maps,) = output
        known = torch.isfinite(item.labels).all(1, keepdim=True) & (item.masks > 0)
        truth = torch.where(known, item.labels, 0.0)
        predicted = torch.where(known, maps, 0.0)
        share = known.float().mean().clamp_min(1e-6)
        distance = (predicted.detach() - truth).norm(dim=1).mean() / share
        return {
            "l1": self._losses.l1 * l1(predicted, truth),
            "variation": self._losses.variation * variation(maps),
            "error": 1000 * distance,
        }

    def measures(self, output: Sequence[Tensor]) -> dict[str, Tensor]:
        """The coordinates."""
        return {"uv": output[0]}


LOGGED = ("psnr", "psnr_masked", "error")  # terms that are no losses


@dataclass(frozen=True)
class Judgement:
    """Sum of the losses of an item, and each by name."""

    loss: Tensor
    terms: Mapping[str, float]


def judge(task: Task, output: Sequence[Tensor], item: Item) -> Judgement:
    """Losses of an output; one that is not finite is not rendered and has a loss that is not finite either."""
    if not all(bool(torch.isfinite(tensor).all()) for tensor in output):
        return Judgement(output[0].new_tensor(float("nan")), {})
    terms = task.terms(output, item)
    loss = torch.stack([value for name, value in terms.items() if name not in LOGGED]).sum()
    return Judgement(loss, {name: float(value.detach()) for name, value in terms.items()})


def make_task(
    config: TrainConfig, head: HeadModel, perceptual: Lpips | None = None, estimator: AnyEstimator | None = None
) -> Task:
    """The task of a config."""
    if config.part == "estimator":
        return EstimatorTask(config)
    return ReconstructionTask(config, head, perceptual, estimator)


def recompute_activations(task: Task) -> None:
    """Gradient checkpointing: blocks keep their inputs alone and run again in the backward pass."""
    from functools import partial

    from torch.utils.checkpoint import checkpoint

    for block in blocks(task.model):
        # As an attribute of the object, so that names of parameters stay as they are.
        block.forward = partial(checkpoint, block.forward, use_reentrant=False)  # type: ignore[method-assign]


def blocks(model: nn.Module) -> list[nn.Module]:
    """The repeated blocks of a model."""
    lists = [module for module in model.modules() if isinstance(module, nn.ModuleList)]
    return [block for each in lists for block in each if len(list(block.children())) > 1]


def _decibel(squares: Tensor) -> Tensor:
    """Mean PSNR of mean squared errors [D]."""
    return (-10 * torch.log10(squares.clamp_min(1e-10))).mean()


def _same_poses(posed: Tensor) -> list[list[int]]:
    groups: list[list[int]] = []
    for index, vertices in enumerate(posed):
        for group in groups:
            if torch.equal(posed[group[0]], vertices):
                group.append(index)
                break
        else:
            groups.append([index])
    return groups
