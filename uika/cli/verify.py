"""The command that says where a file comes from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from uika.errors import install_command


@dataclass(frozen=True)
class Verify:
    """Say what a picture, video, avatar or exported file shows of its origin; exit 1 if it shows nothing.

    Example: uika verify out.mp4
    """

    file: Positional[Path]
    """.png, .jpg, .mp4, .safetensors, .glb, .ply, .html or .npz."""

    def run(self) -> int:
        """Look and print."""
        from uika.safeguards import verify
        from uika.safeguards.watermark import THRESHOLD

        finding = verify(self.file)
        signed = self._credentials(finding.provenance)
        mark = finding.watermark
        if mark is not None:
            looked = f"score {mark.score:.1f} of {THRESHOLD:g} needed, {mark.frames} frames looked at"
            resized = "" if mark.scale == 1 or not mark.found else f", resized by {mark.scale:.2f}"
            print(f"watermark   {'found' if mark.found else 'not found'} ({looked}{resized})")
        print(f"provenance  {'found' if finding.provenance else 'not found'}")
        for name, text in sorted(finding.provenance.items()):
            print(f"  {name:<16} {text}")
        if mark is not None and finding.provenance.get("watermark") == "yes" and not mark.found:
            print("  the file says that it is marked, but the mark is not there: it was altered strongly")
        if signed:
            print(signed)
        elif not finding.found:
            print("nothing found; that does not prove that the file has another origin")
        return 0 if finding.found or signed else 1

    def _credentials(self, known: Mapping[str, str]) -> str:
        """What is signed in the file, as lines of text."""
        from uika.safeguards.content_credentials import KINDS, read_credentials

        try:
            found = read_credentials(self.file) if self.file.suffix.lower() in KINDS else None
        except ModuleNotFoundError as error:
            return f"credentials not read; run: {install_command(error.name or '')}"
        if found is None:
            return ""
        state = "valid" if found.valid else f"NOT valid: {', '.join(found.faults)}"
        trust = "" if found.trusted else " (a certificate on no list of trust)"
        lines = [
            f"credentials {state}",
            f"  signed by        {found.signer}{trust}",
            f"  made by          {found.program}",
        ]
        if found.provenance != known:
            lines += [f"  {name:<16} {text}" for name, text in sorted(found.provenance.items())]
        return "\n".join(lines)
