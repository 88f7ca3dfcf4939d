"""What a training run of a scene can be told."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

SH_DEGREES = 3


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a run; the rates are those of 3D Gaussian Splatting (Kerbl et al. 2023), schedules follow `steps`.

    Attributes:
        steps: number of photos that are learned from, one a step.
        strategy: how Gaussians are added and removed.
        max_splats: most Gaussians; of "mcmc" its target.
        random_splats: Gaussians to start with where the data set has no points.
        sh_degree: of the harmonics at the end; one degree more every tenth of the run.
        ssim_weight: share of 1 - SSIM in the loss, the rest is L1.
        coarse_to_fine: learn from pictures of a quarter and a half of the size first.
        random_background: put transparent pictures on a colour drawn anew at every step; else on white.
        appearance: learn an affine map of colours for each photo, for exposures that differ.
        refine_poses: learn corrections of the cameras.
        seed: of everything that is drawn.
        every: each so many-th photo is held out.
        checkpoint_every: steps between checkpoints.
    """

    steps: int = 7000
    strategy: Literal["default", "mcmc"] = "default"
    max_splats: int = 200_000
    random_splats: int = 20_000
    sh_degree: int = 3
    ssim_weight: float = 0.2
    coarse_to_fine: bool = True
    random_background: bool = False
    appearance: bool = False
    refine_poses: bool = False
    seed: int = 0
    every: int = 8
    checkpoint_every: int = 500

    def check(self) -> None:
        """Raise ValueError naming the first value that is out of range."""
        ranges: dict[str, tuple[float, float]] = {
            "steps": (1, 10_000_000),
            "max_splats": (1, 100_000_000),
            "random_splats": (1, 100_000_000),
            "sh_degree": (0, SH_DEGREES),
            "ssim_weight": (0, 1),
            "seed": (0, 2**31 - 1),
            "every": (2, 1_000_000),
            "checkpoint_every": (1, 10_000_000),
        }
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must lie between {low:g} and {high:g}, not {getattr(self, name)}")
        if self.strategy not in ("default", "mcmc"):
            raise ValueError(f"strategy must be default or mcmc, not {self.strategy!r}")

    @classmethod
    def of(cls, values: dict[str, Any]) -> TrainConfig:
        """From a dictionary.

        Raises:
            ValueError: a name is unknown or a value is of another type or out of range.
        """
        known = {field.name: type(field.default) for field in fields(cls)}
        for name, value in values.items():
            if name not in known or not isinstance(value, (int, float) if known[name] is float else known[name]):
                raise ValueError(f"the settings have {name}={value!r}, which no run can use")
        config = cls(**values)
        config.check()
        return config

    def shrink(self, step: int, side: int) -> int:
        """By how much the pictures' sides are divided at a step, for a shorter side of `side` pixels."""
        if not self.coarse_to_fine:
            return 1
        wanted = 4 if step < 0.1 * self.steps else 2 if step < 0.3 * self.steps else 1
        while wanted > 1 and side // wanted < 64:
            wanted //= 2
        return wanted

    def degree(self, step: int) -> int:
        """Degree of the harmonics that are rendered at a step."""
        return min(self.sh_degree, 10 * step // self.steps)
