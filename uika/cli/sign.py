"""The command that signs pictures and films."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from uika.errors import UikaError


@dataclass(frozen=True)
class Sign:
    """Write signed Content Credentials (C2PA) into a copy of a picture or film that this program made.

    Example: uika sign me.mp4 --certificate chain.pem --key key.pem -o signed.mp4
    """

    file: Positional[Path]
    """The .png or .mp4."""
    certificate: Path
    """The signer's certificate and those above it, PEM."""
    key: Path
    """The signer's private key, PEM without a password."""
    output: Annotated[Path, arg(aliases=["-o"])]
    """The file to write, of the same kind."""

    def run(self) -> int:
        """Sign and say as whom."""
        from uika.safeguards import verify
        from uika.safeguards.content_credentials import read_credentials, sign

        provenance = verify(self.file).provenance
        if not provenance:
            raise UikaError(f"{self.file}: has no provenance of this program to sign; give a file that it wrote")
        sign(self.file, self.certificate, self.key, provenance, self.output)
        made = read_credentials(self.output)
        print(f"wrote {self.output}: signed by {made.signer if made else 'nobody'}")
        return 0
