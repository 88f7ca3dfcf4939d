"""What an avatar was made from, and what a picture of it was made with."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from datetime import datetime, timezone

from uika._version import __version__
from uika.avatar import Avatar

CONSENT_GIVEN = "stated by the user"
CONSENT_UNKNOWN = "not stated"


def stamped(avatar: Avatar, *, consent: bool, time: datetime | None = None) -> Avatar:
    """The avatar with the time and the user's word on consent in its provenance.

    Args:
        avatar: the avatar; its provenance already names the program, the model and the photos' SHA-256 digests.
        consent: whether the user states that the person shown agrees.
        time: when it was made; None means now.
    """
    more = {"time": _text(time), "consent": CONSENT_GIVEN if consent else CONSENT_UNKNOWN}
    return dataclasses.replace(avatar, provenance={**avatar.provenance, **more})


def picture_provenance(avatar: Avatar, *, watermark: bool, time: datetime | None = None) -> dict[str, str]:
    """What pictures of an avatar carry: the avatar's own provenance and digest, the time and whether they are marked.

    Args:
        avatar: the avatar.
        watermark: whether the pictures carry the mark.
        time: when they were rendered; None means now.
    """
    return {
        **{f"avatar {name}" if name in ("program", "time") else name: text for name, text in avatar.provenance.items()},
        "avatar": fingerprint(avatar),
        "program": f"uika-drjit {__version__}",
        "time": _text(time),
        "watermark": "yes" if watermark else "no",
        "note": "synthetic picture of an avatar",
    }


def fingerprint(avatar: Avatar) -> str:
    """SHA-256 over the Gaussians and their binding."""
    digest = hashlib.sha256(avatar.head_id.encode())
    for name in ("means", "quats", "scales", "opacities", "colors", "triangle", "barycentric"):
        digest.update(getattr(avatar, name).contiguous().numpy().tobytes())
    return digest.hexdigest()


def as_text(found: object) -> Mapping[str, str]:
    """A mapping of texts from what a file held; empty if it is none."""
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else {}


def _text(time: datetime | None) -> str:
    return (datetime.now(timezone.utc) if time is None else time).astimezone(timezone.utc).isoformat(timespec="seconds")
