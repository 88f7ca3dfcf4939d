"""Splatting."""
