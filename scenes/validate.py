"""Splats against Mitsuba: `python -m scenes.validate -o report/`."""

import sys

from scenes.validation.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
