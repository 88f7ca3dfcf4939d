"""Motions of a head: presets, smoothing, retargeting, and files of this and other programs (FLAME, ARKit)."""

from uika.motion.arkit import read_csv, read_json, write_csv, write_json
from uika.motion.bvh import read_bvh, write_bvh
from uika.motion.flame import read_flame_params, write_flame_params
from uika.motion.motion import Motion, MotionError, load_motion, save_motion
from uika.motion.read import read_motion
from uika.motion.write import write_motion

__all__ = [
    "Motion",
    "MotionError",
    "load_motion",
    "read_bvh",
    "read_csv",
    "read_flame_params",
    "read_json",
    "read_motion",
    "save_motion",
    "write_bvh",
    "write_csv",
    "write_flame_params",
    "write_json",
    "write_motion",
]
