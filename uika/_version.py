"""Version of the project, read by the build and by avatar files."""

__version__ = "0.1.0"
