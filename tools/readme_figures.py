"""Put the measured tables of `benchmarks/results/NAME.md` between the README's markers `<!-- figures: NAME -->`."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MARKED = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def main(readme: Path = ROOT / "README.md") -> int:
    missing = []

    def table(match: re.Match[str]) -> str:
        path = ROOT / "benchmarks" / "results" / f"{match[2]}.md"
        if not path.is_file():
            missing.append(path)
            return match[0]
        return f"{match[1]}{path.read_text().strip()}\n{match[3]}"

    readme.write_text(MARKED.sub(table, readme.read_text()))
    for path in missing:
        print(f"no {path.relative_to(ROOT)}: run the benchmark first", file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
