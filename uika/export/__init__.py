"""Avatars in the file formats of other programs."""

from uika.export.flat import read_splat, write_splat
from uika.export.gltf import glb_provenance, read_glb, write_glb
from uika.export.html import html_provenance, write_html
from uika.export.obj import write_obj
from uika.export.ply import write_bound_ply, write_ply, write_ply_sequence
from uika.export.rigged import write_rigged_glb
from uika.export.splats import Splats, posed_splats, thinned
from uika.export.spz import write_spz
from uika.export.tables import write_npz
from uika.export.vrm import write_vrm

__all__ = [
    "Splats",
    "glb_provenance",
    "html_provenance",
    "posed_splats",
    "read_glb",
    "read_splat",
    "thinned",
    "write_bound_ply",
    "write_glb",
    "write_html",
    "write_npz",
    "write_obj",
    "write_ply",
    "write_ply_sequence",
    "write_rigged_glb",
    "write_splat",
    "write_spz",
    "write_vrm",
]
