"""`python -m uika`."""

import sys

from uika.cli import main

sys.exit(main())
