"""Image and face metrics; what each means is in docs/evaluation.md."""

from uika.metrics.faces import expression_distance, fit_faces, keypoint_distance, pose_distance
from uika.metrics.flip_error import flip, flip_map
from uika.metrics.image import mask_iou, psnr, ssim

__all__ = [
    "expression_distance",
    "fit_faces",
    "flip",
    "flip_map",
    "keypoint_distance",
    "mask_iou",
    "pose_distance",
    "psnr",
    "ssim",
]
