"""The command `uika weights`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Weights:
    """List the pretrained weight files: purpose, licence, source, place, and whether what lies there is whole.

    Example: uika weights
    """

    verify: bool = True
    """Compare digests, which reads the files whole."""

    def run(self) -> int:
        """Print the list; nothing is fetched."""
        from uika.io.weights import FOLDER_VARIABLE, check_weights, folder

        print(f"weights lie in {folder()} ({FOLDER_VARIABLE} names another folder); nothing is fetched by itself")
        found = check_weights(verify=self.verify)
        for status in found:
            file = status.file
            print(f"\n{file.name}  {status.state}  {file.gigabytes:g} GB")
            lines = {"for": file.purpose, "unlocks": file.command, "licence": file.licence, "from": file.source}
            print("\n".join(f"  {name:<8} {text}" for name, text in lines.items()))
        return int(any(status.state == "damaged" for status in found))
