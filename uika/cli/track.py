"""The command `uika track`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from uika.io.files import check_output

if TYPE_CHECKING:
    from uika.tracking import Track as Tracked


@dataclass(frozen=True)
class Track:
    """Find how the head in a video moves.

    Example: uika track me.mp4 -o motion.npz --preview preview.mp4
    """

    video: Positional[Path]
    """A video with one face."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("motion.npz")
    """The motion file to write: .npz, .csv or .json with ARKit activations, or .bvh."""
    preview: Path | None = None
    """A video to write that shows frames and tracked head side by side."""
    estimator: Path | None = None
    """A correspondence estimator that places the landmarks anew in each frame; slow."""

    def run(self) -> int:
        """Track and save."""
        from uika.motion.write import check_motion_output, write_motion

        target = check_motion_output(self.output)
        picture = None if self.preview is None else check_output(self.preview, ".mp4")
        from uika.head import load_head
        from uika.tracking import track_video, write_preview

        head = load_head()
        place = None
        if self.estimator is not None:
            from uika.reconstruction.estimated_landmarks import EstimatedLandmarks

            place = EstimatedLandmarks(self.estimator, head)
        found = track_video(self.video, head, progress=True, place=place)
        write_motion(found.motion, target, head)
        if picture is not None:
            write_preview(found, self.video, picture, head, progress=True)
        print(f"wrote {target}: {describe(found)}")
        return 0


def describe(found: Tracked) -> str:
    """One sentence on a tracked video."""
    count, seconds = len(found.poses), sum(found.seconds.values())
    text = f"{count} frames in {seconds:.1f} s ({count / seconds:.0f} frames/s), {found.motion.fps:g} frames per second"
    if found.lost:
        text += f"; no face in {len(found.lost)} frames, filled in: {_spans(found.lost)}"
    return text


def _spans(indices: tuple[int, ...]) -> str:
    """Frame numbers as ranges, the first few of them."""
    spans: list[list[int]] = []
    for index in indices:
        if spans and index == spans[-1][1] + 1:
            spans[-1][1] = index
        else:
            spans.append([index, index])
    shown = [str(a) if a == b else f"{a}-{b}" for a, b in spans[:8]]
    return ", ".join(shown) + (" ..." if len(spans) > 8 else "")
