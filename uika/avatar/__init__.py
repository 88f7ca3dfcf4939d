"""Avatars: their file, their pictures, and the posing of their Gaussians."""

from uika.avatar.avatar import Avatar, AvatarError

__all__ = ["Avatar", "AvatarError"]
