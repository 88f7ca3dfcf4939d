"""Pictures of synthetic people with what each pixel shows, prepared once and kept as whole numbers on disk.

A person is a file of tensors that training reads picture by picture, without decoding. It depends on the settings and
the person's number alone, and appears under its name when it is complete, so that a run that was cut off goes on with
the next person.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

from uika.data.encode import decode_colour, decode_mask, decode_uv
from uika.data.identity import Recording, record_identity
from uika.data.sample import DataError
from uika.errors import UikaError
from uika.head import HeadModel
from uika.io.files import check_folder, replacing, write_tensors
from uika.model.surface_codes import bound, vertex_codes
from uika.photo import matte
from uika.photo.networks import person_mask

SETTINGS_FILE = "items.json"
CODE_STEP = 1e-4  # of a stored code
_LIFTED = 0.003  # metres of hair from which a pixel shows hair
_SURE_PIXELS = 5  # inside the face's edge, from which the matte's solver is told that a pixel is the person
_CUT_EVERY = 3  # pictures, of which one is cut out by the matting code, which takes longer than all else
_SOURCE = 256  # pixels of the rendered picture


@dataclass(frozen=True)
class ItemSettings:
    """What the items show. Two folders with the same values hold the same files."""

    seed: int = 20
    size: int = 160  # pixels
    views: int = 9
    moments: tuple[int, ...] = (4,)  # of a performance whose every fourth moment is a key expression

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 32 <= self.size <= _SOURCE or not 1 <= self.views <= 64 or not self.moments or min(self.moments) < 0:
            raise UikaError(f"items need 32 to {_SOURCE} pixels, 1 to 64 views and moments from 0 on, not {self}")


class SurfaceItem(NamedTuple):
    """One picture of S x S pixels."""

    image: Tensor  # [3,S,S] uint8, in front of its backdrop
    mask: Tensor  # [S,S] uint8, exact
    matte: Tensor  # [S,S] uint8, as the matting code found it in every third picture, else `mask`
    code: Tensor  # [4,S,S] int16, `uika.model.surface_codes` in `CODE_STEP`; 0 where not `shown`
    shown: Tensor  # [S,S] uint8: 0 no part of the head, 1 skin, 2 hair


class SurfaceItems:
    """The items of the people in a folder."""

    def __init__(self, folder: Path, people: Sequence[int] | None = None) -> None:
        """Look for people; None takes all that are there.

        Raises:
            UikaError: there are none.
        """
        found = sorted(folder.glob("[0-9]*.safetensors"))
        wanted = None if people is None else {_name(index) for index in people}
        self.files = [path for path in found if wanted is None or path.name in wanted]
        if not self.files:
            raise UikaError(f"{folder}: holds no items; make them first")
        self.settings = read_settings(folder)
        self._each = self.settings.views * len(self.settings.moments)

    def __len__(self) -> int:
        """The number of pictures."""
        return self._each * len(self.files)

    def __getitem__(self, index: int) -> SurfaceItem:
        """Read one picture.

        Raises:
            DataError: its file is damaged.
        """
        path, row = self.files[index // self._each], index % self._each
        try:
            with safe_open(path, framework="pt") as file:
                return SurfaceItem(*(file.get_slice(name)[row] for name in SurfaceItem._fields))
        except (OSError, SafetensorError, IndexError) as error:
            raise DataError(f"{path}: cannot be read; remove it and make it again ({error})") from error


def read_settings(folder: Path) -> ItemSettings:
    """The settings of the items in a folder.

    Raises:
        UikaError: they cannot be read.
    """
    try:
        values = json.loads((folder / SETTINGS_FILE).read_text())
        return ItemSettings(**{**values, "moments": tuple(values["moments"])})
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UikaError(f"{folder / SETTINGS_FILE}: cannot be read ({error})") from error


def make_items(
    folder: Path,
    head: HeadModel,
    people: Sequence[int],
    settings: ItemSettings,
    said: Callable[[int], None] = lambda _: None,
) -> int:
    """Make the people that are missing; `said` hears of each. Returns how many were made.

    Raises:
        UikaError: the folder holds items made with other settings, or cannot be written.
    """
    check_folder(folder)
    head = head.without_bust
    file = folder / SETTINGS_FILE
    if file.exists() and read_settings(folder) != settings:
        raise UikaError(f"{file}: the folder holds items made with other settings; choose another folder")
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(asdict(settings)) + "\n")
    made = 0
    for person in people:
        target = folder / _name(person)
        if target.exists():
            continue
        rows = list(person_items(head, person, settings))
        columns = zip(SurfaceItem._fields, zip(*rows, strict=True), strict=True)
        tensors = {name: torch.stack(parts) for name, parts in columns}
        write_tensors(target, tensors, {"head": head.id})
        made += 1
        said(person)
    return made


def person_items(head: HeadModel, person: int, settings: ItemSettings) -> Iterator[SurfaceItem]:
    """The pictures of one synthetic person, moment after moment."""
    head = head.without_bust
    recording = Recording(settings.views, max(settings.moments) + 1, _SOURCE)
    first = min(settings.moments)
    shared, moments = record_identity(head, settings.seed, person, recording, start=first)
    with np.load(io.BytesIO(shared["canonical"]), allow_pickle=False) as canonical:
        lift = torch.from_numpy(canonical["static_offset"][0]).norm(dim=-1)
    for moment, recorded in enumerate(moments, start=first):
        if moment not in settings.moments:
            continue
        for view, (entry, files) in enumerate(recorded.views):
            name, cut = entry["file_path"], (view + person) % _CUT_EVERY == 0
            image, mask = decode_colour(files["file_path"], name), decode_mask(files["fg_mask_path"], name)
            uv, valid = decode_uv(files["uv_path"], name)
            yield _item(head, lift, image, mask, torch.from_numpy(uv), torch.from_numpy(valid), settings.size, cut)


def _item(
    head: HeadModel, lift: Tensor, image: np.ndarray, mask: np.ndarray, uv: Tensor, valid: Tensor, size: int, cut: bool
) -> SurfaceItem:
    planes = torch.from_numpy(np.concatenate((image, mask[..., None]), -1)).permute(2, 0, 1)[None].float()
    planes = functional.interpolate(planes, size=(size, size), mode="bilinear", antialias=True)[0].round().byte()
    small = functional.interpolate(uv.permute(2, 0, 1)[None], size=(size, size), mode="nearest-exact")[0]
    known = functional.interpolate(valid[None, None].float(), size=(size, size), mode="nearest-exact")[0, 0] > 0
    triangle, mix = bound(head, small[:, known].mT)
    corners = head.faces[triangle]
    code, shown = torch.zeros(4, size, size, dtype=torch.int16), torch.zeros(size, size, dtype=torch.uint8)
    code[:, known] = ((vertex_codes(head)[corners] * mix[..., None]).sum(1) / CODE_STEP).round().to(torch.int16).mT
    shown[known] = 1 + ((lift[corners] * mix).sum(-1) > _LIFTED).byte()
    face = torch.zeros(size, size)
    face[known] = (head.masks["face"][corners] * mix).sum(-1)
    found = _found_matte(planes[:3], face > 0.5) if cut else planes[3]
    return SurfaceItem(planes[:3], planes[3], found, code, shown)


def _found_matte(image: Tensor, face: Tensor) -> Tensor:
    """The matte [S,S] that the matting code finds in a picture [3,S,S] whose face [S,S] is known."""
    pixels = image.permute(1, 2, 0).contiguous().numpy()
    sure = functional.avg_pool2d(face[None, None].float(), _SURE_PIXELS, 1, _SURE_PIXELS // 2)[0, 0] > 0.999
    if not bool(sure.any()):
        rough = person_mask(pixels)
        return torch.from_numpy((255 * rough).round().astype(np.uint8))
    alpha = matte.solve(pixels, matte.trimap(person_mask(pixels), sure.numpy()))
    return torch.from_numpy((255 * alpha).round().astype(np.uint8))


def _name(person: int) -> str:
    return f"{person:06d}.safetensors"
