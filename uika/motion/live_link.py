"""Packets of Live Link Face, the app that sends a phone's face over UDP (version 6 of its layout).

A packet is: version (1 byte); device and subject, each a length (4 bytes) and UTF-8; frame number (4 bytes), part of
a frame (float), frames per second as a fraction (4 and 4 bytes); the number of values (1 byte, 61) and the values
(floats). All numbers are big-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from uika.head.actions import ARKIT_ACTIONS
from uika.motion.motion import Motion, MotionError
from uika.motion.recording import from_angles

VERSION = 6
PORT = 11111  # what the app sends to unless told otherwise
LARGEST = 4096  # bytes of a packet
_COUNT = 61  # values: 52 actions, then yaw, pitch and roll of the head and of both eyes
_LONGEST = 256  # bytes of a name
_SWAPPED = (("jawRight", "jawLeft"), ("mouthRight", "mouthLeft"))  # tables have right first, packets left first


def _packet_order() -> list[int]:
    """Where each value of a packet stands among `ARKIT_ACTIONS`."""
    names = list(ARKIT_ACTIONS)
    for one, other in _SWAPPED:
        a, b = names.index(one), names.index(other)
        names[a], names[b] = names[b], names[a]
    return [ARKIT_ACTIONS.index(name) for name in names]


_ORDER = _packet_order()


@dataclass(frozen=True, eq=False)
class FacePacket:
    """One face."""

    device: str
    subject: str
    seconds: float  # its time on the sender's clock
    actions: NDArray[np.float32]  # [52] in the order of `ARKIT_ACTIONS`
    head: tuple[float, float, float]  # yaw, pitch, roll, radians

    def motion(self) -> Motion:
        """One frame whose neck is turned as the head is."""
        still = torch.zeros(1, 3)
        turn = from_angles(torch.tensor([self.head]))
        actions = torch.from_numpy(self.actions)[None]
        return Motion(actions, still, turn, still, torch.zeros(1, 6), still, 60.0)


def read_packet(data: bytes) -> FacePacket:
    """A packet's content; activations are limited to 0..1.

    Raises:
        MotionError: it is no packet of this version, is cut short, or holds numbers that are not finite.
    """
    if not data or data[0] != VERSION:
        raise MotionError(f"is of version {data[0]}, not {VERSION}" if data else "is empty")
    try:
        device, at = _text(data, 1)
        subject, at = _text(data, at)
        frame, part, rate, denominator, count = struct.unpack_from("!ifiiB", data, at)
        values = np.frombuffer(data, ">f4", offset=at + 17)
    except (struct.error, ValueError) as error:
        raise MotionError(f"is damaged ({error})") from error
    if count != _COUNT or len(values) != _COUNT or rate <= 0 or denominator <= 0:
        raise MotionError(f"holds {count} values at {rate}/{denominator} frames per second; {_COUNT} are needed")
    if not np.isfinite(values).all() or not np.isfinite(part):
        raise MotionError("holds numbers that are not finite")
    actions = np.zeros(len(ARKIT_ACTIONS), np.float32)
    actions[_ORDER] = values[: len(ARKIT_ACTIONS)].clip(0, 1)
    yaw, pitch, roll = values[len(ARKIT_ACTIONS) : len(ARKIT_ACTIONS) + 3].clip(-np.pi, np.pi).tolist()
    return FacePacket(device, subject, (frame + part) * denominator / rate, actions, (yaw, pitch, roll))


def write_packet(packet: FacePacket, fps: int = 60) -> bytes:
    """The bytes that the app would send for a face; eyes look ahead."""
    whole, part = divmod(packet.seconds * fps, 1.0)
    names = b"".join(struct.pack("!i", len(name.encode())) + name.encode() for name in (packet.device, packet.subject))
    values = [*packet.actions[_ORDER].tolist(), *packet.head, *[0.0] * 6]
    return bytes([VERSION]) + names + struct.pack(f"!ifiiB{_COUNT}f", int(whole), part, fps, 1, _COUNT, *values)


def _text(data: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("!i", data, at)
    if not 0 <= length <= _LONGEST or at + 4 + length > len(data):
        raise ValueError("a name does not fit")
    return data[at + 4 : at + 4 + length].decode("utf-8", errors="replace"), at + 4 + length
