"""Live Link Face's packets, and what comes over a network beside them."""

import socket
import struct
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from uika import UikaError, load_head
from uika.head.actions import ARKIT_ACTIONS
from uika.motion import MotionError
from uika.motion.live_link import FacePacket, read_packet, write_packet
from uika.viewer.live_link import LiveLinkFace


def packet(seconds: float, device: str = "PHONE-1", **actions: float) -> FacePacket:
    values = np.array([actions.get(name, 0.0) for name in ARKIT_ACTIONS], np.float32)
    return FacePacket(device, "me", seconds, values, (0.3, -0.2, 0.1))


@pytest.fixture
def face() -> Iterator[LiveLinkFace]:
    found = LiveLinkFace(load_head(), 0)
    yield found
    found.stop()


def send(face: LiveLinkFace, *packets: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in packets:
            sender.sendto(data, face.place)


def wait(condition: Callable[[], bool], seconds: float = 5.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_layout_is_the_published_one() -> None:
    """The bytes written out by hand: version, names with lengths, frame time and rate, 61 floats, all big-endian."""
    values = np.arange(61, dtype=np.float32) / 100
    values[52:55] = 0.3, -0.2, 0.1
    by_hand = (
        b"\x06\x00\x00\x00\x07PHONE-1\x00\x00\x00\x02me"
        + struct.pack(">ifii", 90, 0.5, 60, 1)
        + b"\x3d"
        + values.astype(">f4").tobytes()
    )
    found = read_packet(by_hand)
    assert (found.device, found.subject, found.seconds) == ("PHONE-1", "me", pytest.approx(90.5 / 60))
    named = dict(zip(ARKIT_ACTIONS, found.actions.tolist(), strict=True))
    # In packets left comes before right for jaw and mouth, as in Unreal's list of ARKit shapes.
    places = {"eyeBlinkLeft": 0, "jawForward": 14, "jawLeft": 15, "jawRight": 16, "jawOpen": 17, "mouthLeft": 21,
              "mouthRight": 22, "mouthSmileLeft": 23, "browInnerUp": 43, "tongueOut": 51}  # fmt: skip
    assert {name: round(100 * named[name]) for name in places} == places
    assert found.head == pytest.approx((0.3, -0.2, 0.1))
    again = read_packet(write_packet(found))
    assert np.allclose(again.actions, found.actions) and again.seconds == pytest.approx(found.seconds)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "is empty"),
        (b"\x07" + write_packet(packet(0))[1:], "version 7"),
        (write_packet(packet(0))[:100], "holds 61 values|damaged"),
        (write_packet(packet(0)) + b"1234", "61 are needed"),
        (b"\x06\xff\xff\xff\xff", "does not fit"),
        (b"\x06\x7f\xff\xff\xff", "does not fit"),
        (write_packet(packet(0))[:-4] + struct.pack(">f", float("nan")), "not finite"),
    ],
)
def test_other_packets_are_refused(data: bytes, says: str) -> None:
    with pytest.raises(MotionError, match=says):
        read_packet(data)


def test_a_face_arrives_once(face: LiveLinkFace) -> None:
    assert "no packet yet" in face.status and face.place[0] == "127.0.0.1"
    send(face, write_packet(packet(1.0, jawOpen=0.5, eyeBlinkLeft=7.0)))
    wait(lambda: face.received == 1)
    pose = face.newest()
    assert pose is not None and face.newest() is None
    names = load_head().expression_names
    assert float(pose.expression[names.index("jawOpen")]) == pytest.approx(0.5)
    assert float(pose.expression[names.index("eyeBlinkLeft")]) == 1.0  # limited
    assert float(pose.neck[1]) == pytest.approx(0.3, abs=0.05)


def test_late_foreign_and_damaged_packets_change_nothing(face: LiveLinkFace) -> None:
    first, second = packet(1.0, jawOpen=0.1), packet(1.1, jawOpen=0.2)
    send(face, write_packet(second), write_packet(first), write_packet(packet(9.0, "PHONE-2", jawOpen=0.9)))
    send(face, b"hello", b"\x05" + write_packet(first)[1:])
    wait(lambda: face.late + face.foreign + face.unusable == 4)
    assert (face.received, face.late, face.foreign, face.unusable) == (1, 1, 1, 2)
    pose = face.newest()
    assert pose is not None and float(pose.expression.max()) == pytest.approx(0.2)
    assert "1 late" in face.status and "1 of other senders" in face.status and "2 unusable" in face.status
    send(face, write_packet(packet(0.0, jawOpen=0.3)))  # more than a second back: the sender began anew
    wait(lambda: face.received == 2)


def test_the_rate_is_said(face: LiveLinkFace) -> None:
    for number in range(20):
        send(face, write_packet(packet(1 + number / 50)))
        time.sleep(0.02)
    wait(lambda: face.received == 20)
    assert 10 < int(face.status.split()[2]) < 60  # 50 a second, less where the machine is slow


def test_a_flood_leaves_the_newest(face: LiveLinkFace) -> None:
    start = time.perf_counter()
    send(face, *(write_packet(packet(2.0 + number / 60, jawOpen=number / 5000)) for number in range(5000)))
    spent = time.perf_counter() - start
    wait(lambda: face.newest() is None and face.received > 100)
    print(f"{face.received} of 5000 packets taken in {spent:.2f} s")
    send(face, write_packet(packet(200.0, jawOpen=0.77)))
    before = face.received
    wait(lambda: face.received > before or face._last == pytest.approx(200.0))
    pose = face.newest()
    assert pose is not None and float(pose.expression.max()) == pytest.approx(0.77)


def test_a_taken_port_is_one_sentence(face: LiveLinkFace) -> None:
    with pytest.raises(UikaError, match=f"cannot listen for Live Link Face on 127.0.0.1:{face.place[1]}"):
        LiveLinkFace(load_head(), face.place[1])
    with pytest.raises(UikaError, match="cannot listen"):
        LiveLinkFace(load_head(), 0, "203.0.113.7")
