"""Recorded outputs of other programs, which lie beside the checkout and are no part of the repository."""

from pathlib import Path

import pytest

PARITY = Path(__file__).resolve().parents[2] / "shared" / "parity"
recorded = pytest.mark.skipif(not PARITY.is_dir(), reason="no recorded outputs beside the checkout")
