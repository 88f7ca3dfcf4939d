"""The command line; each file holds one command."""

from uika.cli.program import main, run

__all__ = ["main", "run"]
