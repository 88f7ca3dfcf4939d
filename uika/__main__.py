"""`python -m uika`."""

from uika.cli import run

run()
