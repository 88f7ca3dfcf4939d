"""What distinguishes one person from another, drawn at random from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from scenes.people.glasses import GlassesStyle
from uika.head import HeadModel

Cut = Literal["bald", "buzz", "short", "side", "afro", "curly", "bob", "long", "bun", "receding", "fringe"]
CUTS: tuple[Cut, ...] = ("bald", "buzz", "short", "side", "afro", "curly", "bob", "long", "bun", "receding", "fringe")
Beard = Literal["none", "stubble", "full", "goatee", "moustache"]
BEARDS: tuple[Beard, ...] = ("none", "stubble", "full", "goatee", "moustache")
_CUT_ODDS = {
    "masculine": (0.06, 0.14, 0.2, 0.17, 0.06, 0.08, 0.03, 0.05, 0.03, 0.12, 0.06),
    "feminine": (0.01, 0.02, 0.07, 0.1, 0.07, 0.1, 0.19, 0.2, 0.12, 0.0, 0.12),
}
_BEARD_ODDS = (0.4, 0.28, 0.16, 0.1, 0.06)
_GLASSES_ODDS = 0.14
# Linear hair colours: black, dark brown, brown, auburn, dark blond, blond, and what age turns them to.
_HAIR = (
    (0.012, 0.01, 0.009),
    (0.03, 0.017, 0.011),
    (0.075, 0.04, 0.022),
    (0.13, 0.045, 0.02),
    (0.2, 0.125, 0.06),
    (0.42, 0.29, 0.15),
)
_GREY = (0.42, 0.41, 0.4)
# Linear iris colours: dark brown, brown, hazel, green, grey, blue.
_IRIS = (
    (0.03, 0.014, 0.007),
    (0.09, 0.04, 0.015),
    (0.14, 0.09, 0.03),
    (0.11, 0.15, 0.06),
    (0.2, 0.24, 0.27),
    (0.1, 0.2, 0.36),
)
_FRAMES = (
    (0.012, 0.012, 0.013),
    (0.07, 0.03, 0.012),
    (0.35, 0.3, 0.2),
    (0.25, 0.25, 0.27),
    (0.12, 0.01, 0.015),
    (0.02, 0.04, 0.1),
)


@dataclass(frozen=True, eq=False)
class Person:
    """One person; colours are linear."""

    seed: int
    shape: torch.Tensor  # [K] identity coefficients
    melanin: float  # 0.06 (very light) to 1.3 (very dark)
    haemoglobin: float  # about 0.1 to 0.6
    age: float  # 0 (young) to 1 (old)
    masculine: float  # 0 to 1
    freckles: float  # 0 to 1
    lip_redness: float  # added haemoglobin of the lips
    iris: tuple[float, float, float]
    hair: tuple[float, float, float]
    cut: Cut
    beard: Beard
    brow_weight: float  # about 0.4 to 1.3, thickness and darkness of the brows
    make_up: float  # 0 to 1, mostly 0
    glasses: GlassesStyle | None


def sample_person(seed: int, head: HeadModel) -> Person:
    """The person of a seed; the same for the same seed and number of identity coefficients."""
    random = np.random.default_rng([seed, 7])
    masculine = float(random.beta(0.35, 0.35))
    man = masculine > 0.5
    melanin = float(random.choice([random.uniform(0.06, 0.3), random.uniform(0.2, 0.7), random.uniform(0.6, 1.3)]))
    age = float(random.beta(1.1, 1.8))
    shape = random.normal(size=len(head.identity_basis)) * random.uniform(0.75, 1.15)
    cut = CUTS[random.choice(len(CUTS), p=_CUT_ODDS["masculine" if man else "feminine"])]
    beard = BEARDS[random.choice(len(BEARDS), p=_BEARD_ODDS)] if man else "none"
    hair = _hair_colour(random, melanin, age)
    iris = _blend(_IRIS, random.uniform(0, 1.3) if melanin > 0.45 else random.uniform(0, 5))
    style = None
    if random.random() < _GLASSES_ODDS:
        style = GlassesStyle(
            lens=(random.uniform(0.021, 0.0265), random.uniform(0.015, 0.0225)),
            squareness=random.uniform(2.0, 5.0),
            thickness=random.uniform(0.0006, 0.0018),
            colour=_FRAMES[random.integers(len(_FRAMES))],
        )
    return Person(
        seed=seed,
        shape=torch.from_numpy(np.clip(shape, -2.6, 2.6)).float(),
        melanin=melanin,
        haemoglobin=random.uniform(0.15, 0.5),
        age=age,
        masculine=masculine,
        freckles=random.uniform(0.3, 1) if melanin < 0.3 and random.random() < 0.25 else 0.0,
        lip_redness=random.uniform(0.2, 0.7),
        iris=iris,
        hair=hair,
        cut=cut,
        beard=beard,
        brow_weight=random.uniform(0.75, 1.3) if man else random.uniform(0.45, 1.0),
        make_up=random.uniform(0.3, 1) if not man and random.random() < 0.35 else 0.0,
        glasses=style,
    )


def _hair_colour(random: np.random.Generator, melanin: float, age: float) -> tuple[float, float, float]:
    reach = 5.0 if melanin < 0.3 else 2.2 if melanin < 0.6 else 0.7
    natural = np.array(_blend(_HAIR, random.uniform(0, reach)))
    grey = float(np.clip(random.normal((age - 0.6) * 2.2, 0.35), 0, 1)) if age > 0.4 else 0.0
    if random.random() < 0.025:
        natural = random.uniform(0.02, 0.45, 3)  # dyed
    return tuple((natural * (1 - grey) + np.array(_GREY) * grey).tolist())


def _blend(palette: tuple[tuple[float, float, float], ...], place: float) -> tuple[float, float, float]:
    low = min(int(place), len(palette) - 2)
    share = min(place - low, 1.0)
    return tuple((np.array(palette[low]) * (1 - share) + np.array(palette[low + 1]) * share).tolist())
