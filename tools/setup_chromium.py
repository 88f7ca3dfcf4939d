"""Make sure that the browser tests find a Chromium: look for one, else install it by apt where this runs as root."""

import shutil

from tools import apt_get

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find() -> str | None:
    """Path of a Chromium or Chrome on the search path."""
    return next(filter(None, map(shutil.which, NAMES)), None)


def main() -> None:
    if find() is None:
        apt_get.install(("chromium",))
    program = find()
    print(f"Chromium: {program}" if program else "no Chromium: the browser tests are skipped; install 'chromium'")


if __name__ == "__main__":
    main()
