"""Drive a head from a video."""

from uika.tracking.decode import VideoError, video_frames
from uika.tracking.live import FaceFollower
from uika.tracking.preview import write_preview
from uika.tracking.track import Track, track_video

__all__ = ["FaceFollower", "Track", "VideoError", "track_video", "video_frames", "write_preview"]
