"""The light that a picture or film is asked to be under."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from uika.errors import UikaError

if TYPE_CHECKING:
    from torch import Tensor

    from uika.avatar import Avatar
    from uika.head import HeadModel


def under_light(avatar: Avatar, head: HeadModel, light: str | None, photo: Path | None) -> Avatar:
    """The avatar under a named light, an environment's (.hdr) or a photo's; itself where neither is given.

    Raises:
        UikaError: both are given, the light is neither "studio" nor a .hdr file, or a file cannot be used.
    """
    if light is None and photo is None:
        return avatar
    if light is not None and photo is not None:
        raise UikaError("give --light or --light-from, not both")
    from uika.avatar.relighting import relit, studio_light

    if photo is not None:
        return relit(avatar, head, _of_photo(photo, head))
    if light == "studio":
        return relit(avatar, head, studio_light())
    if light is None or Path(light).suffix.lower() != ".hdr":
        raise UikaError(f"--light {light}: give 'studio' or a Radiance picture (.hdr)")
    import torch

    from uika.head.light import from_environment
    from uika.io.radiance_hdr import read_hdr

    return relit(avatar, head, from_environment(torch.from_numpy(read_hdr(light))))


def _of_photo(photo: Path, head: HeadModel) -> Tensor:
    from uika.reconstruction import photo_light

    return photo_light(photo, head)
