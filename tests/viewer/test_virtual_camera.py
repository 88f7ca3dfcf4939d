"""The avatar as a camera: what a device of `pyvirtualcam` is given, and what is said where there is none."""

import dataclasses
import time

import numpy as np
import pytest
import torch

from tests.avatars import painted_avatar
from tests.heads import sphere_head
from uika import UikaError, get_motion
from uika.cli import main
from uika.head import save_head
from uika.safeguards import detect
from uika.viewer import Viewer, VirtualCamera

pyvirtualcam = pytest.importorskip("pyvirtualcam", reason="no pyvirtualcam")
pytest.importorskip("viser", reason="no viser: install the extra 'view'")


class Device:
    """A backend as the package's users may register them; keeps what it is sent."""

    def __init__(self, *, width, height, fps, fourcc, device, **_):
        assert device is None
        self.size, self.closed = (height, width, 3), False
        self.sent: list[np.ndarray] = []
        Device.opened = self

    def send(self, frame):
        self.sent.append(frame.reshape(self.size).copy())

    def close(self):
        self.closed = True

    def device(self):
        return "made for a test"

    def native_fourcc(self):
        return None


@pytest.fixture
def device(monkeypatch):
    from pyvirtualcam import camera

    monkeypatch.setattr(camera, "BACKENDS", {})
    pyvirtualcam.register_backend("test", Device)


@pytest.fixture
def avatar(tmp_path, monkeypatch):
    head = sphere_head()
    save_head(head, tmp_path / "small.npz")
    monkeypatch.setenv("UIKA_HEAD", str(tmp_path / "small.npz"))
    monkeypatch.chdir(tmp_path)
    plain = painted_avatar(head, 64)
    made = dataclasses.replace(plain, colors=0.5 + 0.4 * torch.sin(80 * plain.means))
    made.save("a.safetensors")
    return made, head


def _wait(done, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not done() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert done()


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
def test_the_device_gets_marked_pictures_that_move(device, avatar):
    made, head = avatar
    camera = VirtualCamera(made, size=256)
    assert camera.name == "made for a test"
    with Viewer(made, head, get_motion("talk", head), 8400, virtual_camera=camera) as viewer:
        _wait(lambda: len(Device.opened.sent) >= 2)  # the second one is the first again
        first, again = Device.opened.sent[:2]
        assert np.array_equal(first, again) and first.shape == (256, 256, 3) and first.std() > 10
        assert detect([torch.from_numpy(first).float() / 255]).found
        before = len(Device.opened.sent)
        viewer._playing._play.value = True
        _wait(lambda: any(np.abs(p.astype(int) - first).max() > 8 for p in Device.opened.sent[before:]))
    assert Device.opened.closed


def test_no_device_is_one_sentence(avatar, capsys, monkeypatch):
    from pyvirtualcam import camera

    def missing(**_):
        raise RuntimeError("no such device")

    monkeypatch.setattr(camera, "BACKENDS", {"test": missing})
    with pytest.raises(UikaError, match="no such device"):
        VirtualCamera(avatar[0])
    assert main(["view", "a.safetensors", "--virtual-camera"]) == 2
    err = capsys.readouterr().err
    assert "no virtual camera can be opened" in err and "v4l2loopback" in err and err.count("\n") == 1
