"""Splats compared with Mitsuba: coverage, depth, normals, correspondences, colours and gradients."""
