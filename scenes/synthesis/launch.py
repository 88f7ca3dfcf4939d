"""One launch for several views: a lane for each pixel that can see the subject, whichever camera it belongs to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from scenes.arrays import flat
from scenes.variant import load_mitsuba
from uika.head import Camera, project

_MOST_LANES = 2_000_000  # of a launch of several views; bounds the memory for its results
_NEAR = 1e-3  # metres; what comes closer can fill the frame

Box = tuple[int, int, int, int]  # x0, y0, width, height in pixels


@dataclass(frozen=True, eq=False)
class Launch:
    """The pixels of the boxes of some cameras, camera after camera, row after row."""

    cameras: tuple[Camera, ...]
    boxes: tuple[Box, ...]
    _x: Any  # [lanes] pixel column
    _y: Any
    _numbers: list[Any]  # 16 values of each lane's camera, see `_table`

    def rays(self, offset: tuple[float, float]) -> tuple[Any, Any]:
        """The rays through one point of each pixel, and the axis along which its camera looks."""
        mi = load_mitsuba()
        import drjit as dr

        fx, fy, cx, cy = self._numbers[:4]
        right, down, forward, origin = (mi.Vector3f(self._numbers[4 + 3 * k : 7 + 3 * k]) for k in range(4))
        x, y = mi.Float(self._x) + offset[0], mi.Float(self._y) + offset[1]
        direction = dr.normalize(right * ((x - cx) / fx) + down * ((y - cy) / fy) + forward)
        return mi.Ray3f(mi.Point3f(origin), direction), forward

    def cut(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """The pixels [lanes,...] of one image [H,W,...] per camera."""
        parts = [
            image[y0 : y0 + height, x0 : x0 + width].reshape(width * height, *image.shape[2:])
            for image, (x0, y0, width, height) in zip(images, self.boxes, strict=True)
        ]
        return np.concatenate(parts)

    def images(
        self, layers: Mapping[str, Sequence[Any]], around: Mapping[str, np.generic | Sequence[np.ndarray]]
    ) -> list[dict[str, np.ndarray]]:
        """Images of each camera.

        Args:
            layers: name -> C device arrays [lanes].
            around: name -> what stands outside the boxes, a number or an image per camera, of the type that the images
                shall have; 0 of the layers' type where not named.

        Returns:
            For each camera: name -> [H,W] if C is 1, else [H,W,C].
        """
        import drjit as dr

        dr.eval(list(layers.values()))
        columns = {name: [np.array(layer) for layer in parts] for name, parts in layers.items()}
        result: list[dict[str, np.ndarray]] = []
        first = 0
        for index, (camera, (x0, y0, width, height)) in enumerate(zip(self.cameras, self.boxes, strict=True)):
            last = first + width * height
            images = {}
            for name, parts in columns.items():
                outside = around.get(name, parts[0].dtype.type(0))
                filling = outside if isinstance(outside, np.generic) else outside[index]
                image = np.empty((camera.height, camera.width, len(parts)), filling.dtype)
                image[...] = filling
                for channel, part in enumerate(parts):
                    image[y0 : y0 + height, x0 : x0 + width, channel] = part[first:last].reshape(height, width)
                images[name] = image[..., 0] if len(parts) == 1 else image
            result.append(images)
            first = last
        return result


def launches(cameras: Sequence[Camera], subject: torch.Tensor) -> Iterator[Launch]:
    """Split cameras into launches; pixels from which no ray meets the convex hull of `subject` [V,3] get no lane."""
    boxes = [_box(camera, subject) for camera in cameras]
    start = lanes = 0
    for index, (_, _, width, height) in enumerate(boxes):
        if lanes and lanes + width * height > _MOST_LANES:
            yield _launch(cameras[start:index], boxes[start:index])
            start, lanes = index, 0
        lanes += width * height
    yield _launch(cameras[start:], boxes[start:])


def _launch(cameras: Sequence[Camera], boxes: Sequence[Box]) -> Launch:
    mi = load_mitsuba()
    import drjit as dr
    from drjit.llvm.ad import ArrayXf

    areas = np.array([width * height for _, _, width, height in boxes], np.uint32)
    owner = np.repeat(np.arange(len(boxes), dtype=np.uint32), areas)
    first = (np.cumsum(areas) - areas).astype(np.uint32)
    view = mi.UInt32(flat(owner))
    x0, y0, width = (mi.UInt32(flat(np.array([box[k] for box in boxes], np.uint32))) for k in range(3))
    lane = dr.arange(mi.UInt32, len(owner)) - dr.gather(mi.UInt32, mi.UInt32(flat(first)), view)
    # Unused lanes at the end of a packet read 0, by which nothing may be divided.
    across = dr.maximum(dr.gather(mi.UInt32, width, view), 1)
    table = mi.Float(flat(np.stack([_table(camera) for camera in cameras])))
    numbers = dr.gather(ArrayXf, table, view, shape=(16, len(owner)))
    return Launch(
        tuple(cameras),
        tuple(boxes),
        dr.gather(mi.UInt32, x0, view) + lane % across,
        dr.gather(mi.UInt32, y0, view) + lane // across,
        [numbers[k] for k in range(16)],
    )


def _table(camera: Camera) -> np.ndarray:
    """16 numbers: focal lengths, principal point, the rows of the rotation and the position."""
    K, viewmat = camera.K.double().numpy(), camera.viewmat.double().numpy()
    lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    position = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return np.concatenate((lens, viewmat[:3, :3].ravel(), position)).astype(np.float32)


def _box(camera: Camera, subject: torch.Tensor) -> Box:
    """The pixels that can see the subject."""
    xy, z = project(subject.double(), camera)
    if float(z.min()) <= _NEAR:
        return 0, 0, camera.width, camera.height
    limit = torch.tensor([camera.width, camera.height])
    low = torch.minimum((xy.amin(0) - 1).floor().long().clamp_min(0), limit)
    high = torch.minimum((xy.amax(0) + 1).ceil().long().clamp_min(0), limit)
    (x0, y0), (width, height) = low.tolist(), (high - low).tolist()
    # One pixel that sees nothing, since Dr.Jit has no use for empty arrays.
    return (x0, y0, width, height) if width > 0 and height > 0 else (0, 0, 1, 1)
