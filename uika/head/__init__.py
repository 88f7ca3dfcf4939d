"""The parametric head: its model, parameters, posing, cameras, rasterizer, UV atlas and Gaussian binding."""

from uika.head.atlas import Binding, uv_texels
from uika.head.binding import pose_gaussians, skin_points, surface_frames, surface_points, unpose_gaussians
from uika.head.camera import Camera, ellipse, look_at, orbit, project
from uika.head.files import load_head, save_arrays, save_head
from uika.head.model import JOINT_NAMES, JOINT_PARENTS, HeadError, HeadModel
from uika.head.parameters import HeadParameters
from uika.head.posing import joint_transforms, pose_vertices, rest_joints, shaped_vertices, vertex_normals
from uika.head.raster import rasterize
from uika.head.rotations import rodrigues

__all__ = [
    "JOINT_NAMES",
    "JOINT_PARENTS",
    "Binding",
    "Camera",
    "HeadError",
    "HeadModel",
    "HeadParameters",
    "ellipse",
    "joint_transforms",
    "load_head",
    "look_at",
    "orbit",
    "pose_gaussians",
    "pose_vertices",
    "project",
    "rasterize",
    "rest_joints",
    "rodrigues",
    "save_arrays",
    "save_head",
    "shaped_vertices",
    "skin_points",
    "surface_frames",
    "surface_points",
    "unpose_gaussians",
    "uv_texels",
    "vertex_normals",
]
