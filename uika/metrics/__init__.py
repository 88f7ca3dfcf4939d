"""Image metrics."""

from uika.metrics.image import mask_iou, psnr

__all__ = ["mask_iou", "psnr"]
