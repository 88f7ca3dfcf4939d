"""Motions of other programs: FLAME parameters of trackers and ARKit activations of phones, read and written."""

from uika.exchange.arkit import read_csv, read_json, write_csv, write_json
from uika.exchange.flame import read_flame_params, write_flame_params
from uika.exchange.read import read_motion

__all__ = [
    "read_csv",
    "read_flame_params",
    "read_json",
    "read_motion",
    "write_csv",
    "write_flame_params",
    "write_json",
]
