"""A page on this machine that shows an avatar and moves it live."""

from uika.viewer.camera import CameraFace
from uika.viewer.controls import Controls
from uika.viewer.live import LiveSplats
from uika.viewer.live_link import LiveLinkFace
from uika.viewer.page import Viewer
from uika.viewer.virtual_camera import VirtualCamera

__all__ = ["CameraFace", "Controls", "LiveLinkFace", "LiveSplats", "Viewer", "VirtualCamera"]
