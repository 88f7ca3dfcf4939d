"""Put the tables of `benchmarks/results/NAME.md` between the markers `<!-- figures: NAME -->` of README and docs.

The benchmarks' pictures that a page shows are copied to `docs/pictures`.
"""

import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MARKED = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


RESULTS = ROOT / "benchmarks" / "results"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


def table(name: str) -> str | None:
    """The tables of a result without its title and picture; None where it has not been made."""
    path = RESULTS / f"{name}.md"
    if not path.is_file():
        return None
    lines = path.read_text(encoding="utf-8").strip().splitlines()
    return "\n".join(line for line in lines if not line.startswith(("# ", "![]("))).strip()


def filled(text: str) -> str:
    """A page with the tables as they are now; where a result is missing, what stands there stays."""

    def block(match: re.Match[str]) -> str:
        found = table(match[2])
        return match[0] if found is None else f"{match[1]}{found}\n{match[3]}"

    return MARKED.sub(block, text)


def main() -> int:
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    for picture in sorted(RESULTS.glob("*.[jp][pn]g")):
        if any(f"pictures/{picture.name}" in text for text in texts.values()):
            shutil.copy(picture, ROOT / "docs" / "pictures" / picture.name)
    missing = set()
    for page, text in texts.items():
        page.write_text(filled(text), encoding="utf-8")
        missing |= {name for _, name, _ in MARKED.findall(text) if table(name) is None}
    for name in sorted(missing):
        print(f"no benchmarks/results/{name}.md: run the benchmark first", file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
