"""Version of the distribution `drjit-splat`, read by its build and by `drjit-splat --version`."""

__version__ = "0.1.0"
