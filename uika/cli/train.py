"""The `train` command."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from uika.errors import UikaError
from uika.io.files import check_folder

if TYPE_CHECKING:
    from uika.data.datasets import People
    from uika.train import TrainConfig

OVERFIT_GOAL = 35.0  # dB
_OF_CORRESPONDENCE = ("output", "part", "steps", "resume", "seed", "people", "learning_rate", "save_every")


@dataclass(frozen=True)
class Train:
    """Train a network; with several GPUs or machines start it by torchrun.

    Example: uika train --preset tiny --data synthetic -o out/tiny
    """

    output: Annotated[Path, arg(aliases=["-o"])]
    """The run's folder, with the model in the end."""
    data: tuple[str, ...] = ("synthetic",)
    """Folders of people, or "synthetic"."""
    preset: Literal["tiny", "base", "paper"] = "tiny"
    """Size of the network, and its training."""
    part: Literal["reconstructor", "estimator", "correspondence"] = "reconstructor"
    """Which network."""
    steps: int | None = None
    """Steps in all."""
    resume: bool = False
    """Go on from the newest checkpoint."""
    overfit: int = 0
    """Self-test: the same N heads at every step."""
    workers: int = 1
    """Processes that make data; 0 for none."""
    seed: int = 0
    """Of everything random."""
    people: int = 1000
    """Number of synthetic people."""
    sharding: Literal["ddp", "fsdp"] = "ddp"
    """Copies of the network, or one cut up."""
    device: str = "auto"
    """auto, cpu or cuda."""
    learning_rate: Annotated[float | None, arg(metavar="N")] = None
    """The highest; else the preset's own."""
    images: Annotated[int | None, arg(metavar="INT")] = None
    """Photos per step and process."""
    size: int | None = None
    """Side of photos and pictures in pixels."""
    save_every: Annotated[int | None, arg(metavar="INT")] = None
    """Steps from one checkpoint to the next."""
    init: Path | None = None
    """A model of the same kind to start from."""
    items: Annotated[Path | None, arg(metavar="PATH")] = None
    """Folder that keeps prepared items."""
    prepare: Annotated[str, arg(metavar="I/N")] = ""
    """Only fill it, for every Nth person."""
    lpips: Annotated[Path | None, arg(metavar="PATH")] = None
    """LPIPS weights, else gradients."""
    backbone: Annotated[Path | None, arg(metavar="PATH")] = None
    """DINOv3 weights, for base and paper."""
    estimator: Annotated[Path | None, arg(metavar="PATH")] = None
    """Finds the photos' UV coordinates."""

    def run(self) -> int:
        """Train."""
        check_folder(self.output)
        if self.part == "correspondence":
            return self._train_correspondence()
        from uika.model.weight_kind import ESTIMATORS, check_kind
        from uika.train import MODEL_FILE, SYNTHETIC, TRAINING, Setup, Stored, Synthetic, join_group, leave_group, train
        from uika.train.logbook import read_log

        if self.overfit < 0 or self.workers < 0 or self.people < 1:
            raise UikaError("overfit and workers must not be negative, people at least 1")
        names = ("steps", "learning_rate", "images", "size", "save_every")
        given: dict[str, Any] = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        config = replace(TRAINING[self.preset], part=self.part, seed=self.seed)
        if self.part == "estimator":
            # Maps are much cheaper than pictures of Gaussians; the released training has the same proportions.
            config = replace(config, images=3 * config.images, items=2 * config.items, size=max(256, config.size))
        config = replace(config, **given)
        if "images" in given:  # one head may not have more photos than a step has
            config = replace(config, sources=min(config.sources, config.images))
        if self.overfit:
            # The same pictures at every step, which alone count, and full speed soon: this shows that gradients arrive.
            losses = replace(config.losses, atlas=0.0, relief=0.0, change=0.0)
            config = replace(config, augment=False, fitted=0.0, losses=losses, ema=0.0, weight_decay=0.0)
            config = replace(config, backgrounds=(1.0,), scope="all", own=0, outline="mask")
            config = replace(config, warmup=min(20, config.warmup))
        if "steps" in given:
            config = replace(config, warmup=min(config.warmup, max(1, config.steps // 10)))
        if self.part == "reconstructor":
            from uika.avatar.rendering import check_renderer

            check_renderer()
        if SYNTHETIC in self.data and len(self.data) > 1:
            raise UikaError(f"data is either folders or '{SYNTHETIC}', not both; make folders with: uika synthesize")
        people: Stored | Synthetic
        if SYNTHETIC in self.data:
            people = Synthetic(self.output / "people", self.people, size=config.size, seed=self.seed)
        else:
            people = Stored([Path(name) for name in self.data])
        if self.estimator is not None:
            if self.part == "estimator":
                raise UikaError("--estimator helps to train the reconstructor; --init starts an estimator from another")
            check_kind(self.estimator, ESTIMATORS)
        if self.prepare:
            return self._prepare(config, people)
        group = join_group(self.device)
        try:
            setup = Setup(
                self.output,
                self.workers,
                self.resume,
                self.overfit,
                self.sharding,
                lpips=self.lpips,
                init=self.init,
                backbone=self.backbone,
                estimator=self.estimator,
                items=self.items,
            )
            train(config, people, setup, group)
        finally:
            leave_group()
        if not group.first:
            return 0
        print(f"wrote {self.output / MODEL_FILE} after {config.steps} steps with {len(people):,} people")
        if self.overfit and self.part == "reconstructor":
            psnr = read_log(self.output)[-1]["psnr"]
            print(f"overfit: {psnr:.1f} dB, {'reached' if psnr >= OVERFIT_GOAL else 'below'} {OVERFIT_GOAL:g} dB")
        return 0

    def _train_correspondence(self) -> int:
        """Train the small correspondence estimator on people that are made before."""
        for option in fields(self):
            if option.name not in _OF_CORRESPONDENCE and getattr(self, option.name) != option.default:
                raise UikaError(
                    f"--{option.name.replace('_', '-')} has no meaning for --part correspondence; leave it out"
                )
        from tqdm import tqdm

        from uika.data.surface_items import ItemSettings, make_items
        from uika.head import load_head
        from uika.train.surface_training import SurfaceTraining, train_surface

        given = {name: getattr(self, name) for name in ("steps", "learning_rate", "save_every")}
        config = replace(
            SurfaceTraining(seed=self.seed, people=self.people),
            **{name: value for name, value in given.items() if value is not None},
        )
        head, items = load_head(), self.output / "items"
        with tqdm(total=self.people, desc="people", unit="person") as bar:
            make_items(items, head, range(self.people), ItemSettings(), lambda _: bar.update())
        print(f"wrote {train_surface(self.output, items, head, config, self.resume)}")
        return 0

    def _prepare(self, config: TrainConfig, people: People) -> int:
        if self.items is None:
            raise UikaError("--prepare needs the folder to fill: --items DIR")
        from uika.data.synthesis import shard_part
        from uika.train import PreparedItems

        part, parts = shard_part(self.prepare, "--prepare")
        made = PreparedItems(self.items, people, config).prepare(part, parts)
        print(f"prepared {made:,} items of {len(people):,} people in {self.items}")
        return 0
