"""A phone's face, received over UDP, moves the avatar."""

from __future__ import annotations

import socket
import threading
import time

from uika.errors import UikaError
from uika.head import HeadModel, HeadParameters
from uika.motion.live_link import LARGEST, PORT, FacePacket, read_packet
from uika.motion.motion import MotionError
from uika.motion.read import for_head

_BUFFER = 64 * 1024  # bytes that the system keeps for us: older packets of a flood are lost there
_SILENT = 2.0  # seconds after which another sender may take over
_BACK = 1.0  # seconds: a packet that is older by less came late, by more its sender began anew
_PACE = 0.95  # share of the old value in the running mean of the time between packets


class LiveLinkFace:
    """Receives Live Link Face's packets in a thread of its own; close it with `stop`."""

    def __init__(self, head: HeadModel, port: int = PORT, address: str = "127.0.0.1") -> None:
        """Open the port and begin.

        Args:
            head: the head model to move.
            port: UDP port; 0 takes a free one.
            address: of this machine, on which to listen; 127.0.0.1 hears only this machine.

        Raises:
            UikaError: the port is taken, or the address is not this machine's.
        """
        self._head = head
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
            self._socket.bind((address, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise UikaError(f"cannot listen for Live Link Face on {address}:{port} ({error})") from error
        self._socket.settimeout(0.2)
        self.received = self.late = self.foreign = self.unusable = 0
        self._newest: FacePacket | None = None
        self._device, self._heard, self._last, self._gap = "", 0.0, 0.0, 0.0
        self._lock, self._stopped = threading.Lock(), threading.Event()
        self._complaint = ""
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def place(self) -> tuple[str, int]:
        """Address and port."""
        address, port = self._socket.getsockname()
        return address, port

    @property
    def status(self) -> str:
        """What is going on, for the user."""
        address, port = self.place
        if not self.received:
            return f"Live Link {address}:{port}: {self._complaint or 'no packet yet'}"
        silent = time.monotonic() - self._heard > _SILENT
        rate = f"{1 / self._gap:.0f} packets/s" if self._gap else "first packet"
        parts = [f"Live Link: {'silent' if silent else rate}"]
        counts = {"late": self.late, "of other senders": self.foreign, "unusable": self.unusable}
        parts += [f"{count} {what}" for what, count in counts.items() if count]
        return ", ".join(parts)

    def newest(self) -> HeadParameters | None:
        """The newest pose; None if it was handed out before."""
        with self._lock:
            found, self._newest = self._newest, None
        if found is None:
            return None
        motion = for_head(found.motion(), self._head)
        return motion.parameters(motion.expression.new_zeros(len(self._head.identity_basis)))[0]

    def stop(self) -> None:
        """Close the port."""
        self._stopped.set()
        self._thread.join(10)
        self._socket.close()

    def _work(self) -> None:
        while not self._stopped.is_set():
            try:
                data = self._socket.recv(LARGEST)
            except TimeoutError:
                continue
            except OSError:  # what the system reports of an earlier answer, or the socket is gone
                if self._stopped.wait(0.1):
                    return
                continue
            try:
                self._take(read_packet(data))
            except MotionError as error:
                self.unusable += 1
                self._complaint = f"a packet {error}"

    def _take(self, packet: FacePacket) -> None:
        now = time.monotonic()
        silent = now - self._heard > _SILENT
        if packet.device != self._device:
            if self._device and not silent:
                self.foreign += 1
                return
            self._device, self._gap = packet.device, 0.0
        elif not silent and 0 <= self._last - packet.seconds < _BACK:
            self.late += 1
            return
        if self._heard and not silent:
            gap = now - self._heard
            self._gap = _PACE * self._gap + (1 - _PACE) * gap if self._gap else gap
        self._heard, self._last = now, packet.seconds
        self.received += 1
        with self._lock:
            self._newest = packet
