"""Items made once and kept on disk: a training then reads them in milliseconds.

`settings.json` says what they were made with, `000012/2-1.safetensors` is the second item of person 12 with two photos.
Each is a function of the settings and its name alone, appears under its name when it is complete, and equals what
`ItemMaker` makes of the same draw, bit for bit.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from uika.data import DataError
from uika.data.datasets import People
from uika.errors import UikaError
from uika.head import HeadParameters, load_head
from uika.io.files import check_folder, replacing, write_tensors
from uika.train.config import TrainConfig
from uika.train.dataset import ItemMaker
from uika.train.item import Item
from uika.train.sampler import Draw

SETTINGS = "settings.json"
_DRIVING = "driving."
# What of a config decides on items.
_FIELDS = (
    "part",
    "seed",
    "size",
    "targets",
    "atlas_views",
    "own",
    "fitted",
    "photographed",
    "outline",
    "facing",
    "backgrounds",
    "augment",
)


class PreparedItems(torch.utils.data.Dataset[Item]):
    """Draws -> items; several draws of a training share one of `config.variants` items."""

    def __init__(self, folder: Path, people: People, config: TrainConfig) -> None:
        """Open or begin a folder; what is missing in it is made when asked for.

        Raises:
            UikaError: the folder holds items made with other values or of other people.
        """
        self._folder = check_folder(folder)
        self._people, self._config = people, config
        self._maker = ItemMaker(people, config)
        own = _settings(people, config)
        file = folder / SETTINGS
        if not file.exists():
            with replacing(file) as temporary:
                temporary.write_text(json.dumps(own, indent=1) + "\n")
        try:
            found = json.loads(file.read_text())
        except (OSError, ValueError) as error:
            raise UikaError(f"{file}: cannot be read; choose another folder for items ({error})") from error
        for name, value in own.items():
            if found.get(name) != value:
                raise UikaError(
                    f"{file}: its items were made with {name} {found.get(name)}, not {value}; choose another folder"
                )

    def __getitem__(self, draw: Draw) -> Item:
        """Read the item of a draw, and make it before if it is new.

        Raises:
            DataError: nobody near this person can be used.
        """
        kept = self.kept(draw)
        path = self.path(kept.person, kept.sources, draw.seed % self._config.variants)
        try:
            return read_item(path)
        except FileNotFoundError:
            item = self._maker[kept]
            write_item(path, item)
            return item

    def kept(self, draw: Draw) -> Draw:
        """The draw whose item stands for a draw."""
        variant = draw.seed % self._config.variants
        seed = np.random.default_rng([self._config.seed, draw.person, draw.sources, variant]).integers(2**62)
        return replace(draw, step=0, seed=int(seed))

    def path(self, person: int, sources: int, variant: int) -> Path:
        """Where an item lies."""
        return self._folder / f"{person:06d}" / f"{sources}-{variant}.safetensors"

    def prepare(self, part: int = 0, parts: int = 1) -> int:
        """Make the items of the people `part`, `part + parts`, ... that are missing; their number."""
        made = 0
        for person in range(part, len(self._people), parts):
            for sources in range(1, self._config.sources + 1):
                for variant in range(self._config.variants):
                    if not self.path(person, sources, variant).exists():
                        self[Draw(0, person, sources, variant)]
                        made += 1
        return made


def write_item(path: Path, item: Item) -> None:
    """Write an item, losslessly."""
    # Copies, for an exact item's `relief` is its `points`, and the format keeps no tensors that share memory.
    tensors = {name: value.contiguous().clone() for name, value in vars(item).items() if isinstance(value, Tensor)}
    if item.driving is not None:
        tensors |= {_DRIVING + name: value.contiguous().clone() for name, value in vars(item.driving).items()}
    # One entry: the order of several is chance, and equal items shall be equal files.
    write_tensors(path, tensors, {"made from": json.dumps([item.keys, item.notes])})


def read_item(path: Path) -> Item:
    """Read an item.

    Raises:
        FileNotFoundError: there is none.
        DataError: the file is damaged; the message names it.
    """
    if not path.exists():
        raise FileNotFoundError(path)
    try:
        with safe_open(path, framework="pt") as file:
            keys, notes = (tuple(names) for names in json.loads(file.metadata()["made from"]))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - it is no mapping
        driving = {name.removeprefix(_DRIVING): tensors.pop(name) for name in list(tensors) if _DRIVING in name}
        return Item(keys, notes, **tensors, driving=HeadParameters(**driving) if driving else None)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: is no item or damaged; remove it ({error})") from error


def _settings(people: People, config: TrainConfig) -> dict[str, Any]:
    """What decides on the items, as JSON would give it back."""
    first = people[0].sample(0).image.contiguous().numpy()
    own = {name: getattr(config, name) for name in _FIELDS}
    own |= {"first_image": hashlib.sha256(first.tobytes()).hexdigest()[:16]}
    model = config.model
    own |= {"canonical": model.canonical, "map_size": model.map_size, "opacity": model.gaussians.init_opacity}
    own |= {"uv": asdict(model.uv), "head": load_head().without_bust.id, "atlas": bool(config.losses.atlas)}
    return json.loads(json.dumps(own))
