"""Where avatars and pictures come from: provenance beside them, a watermark inside pictures, and reading both."""

from uika.safeguards.provenance import picture_provenance, stamped
from uika.safeguards.verification import Finding, verify
from uika.safeguards.watermark import Detection, detect, mark

__all__ = ["Detection", "Finding", "detect", "mark", "picture_provenance", "stamped", "verify"]
