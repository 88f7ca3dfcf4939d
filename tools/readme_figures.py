"""Put the tables of `benchmarks/results/NAME.md` between the markers `<!-- figures: NAME -->` of README and docs.

The benchmarks' pictures that a page shows are copied to `docs/pictures`.
"""

import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MARKED = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> int:
    missing = []

    def table(match: re.Match[str]) -> str:
        path = ROOT / "benchmarks" / "results" / f"{match[2]}.md"
        if not path.is_file():
            missing.append(path)
            return match[0]
        lines = [line for line in path.read_text().strip().splitlines() if not line.startswith(("# ", "![]("))]
        return f"{match[1]}{chr(10).join(lines).strip()}\n{match[3]}"

    pages = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    shown = "".join(page.read_text() for page in pages)
    for picture in sorted((ROOT / "benchmarks" / "results").glob("*.png")):
        if f"pictures/{picture.name}" in shown:
            shutil.copy(picture, ROOT / "docs" / "pictures" / picture.name)
    for page in pages:
        page.write_text(MARKED.sub(table, page.read_text()))
    for path in missing:
        print(f"no {path.relative_to(ROOT)}: run the benchmark first", file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
