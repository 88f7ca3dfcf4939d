"""Updates a second of the viewer: posed and packed, sent, and drawn in a browser.

Run `python -m benchmarks.viewer` with nothing beside it; writes `benchmarks/results/viewer.{json,md}`. The browser is a
headless Chromium that draws in software on the same cores, so a browser with a graphics card has less to wait for.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness import markdown, save
from tests.chromium import Page, page
from uika.assets import PORTRAIT
from uika.avatar import Avatar
from uika.export import thinned
from uika.head import HeadModel, load_head
from uika.motion import Motion
from uika.motion.presets import get_motion
from uika.reconstruction import reconstruct
from uika.viewer import LiveSplats, Viewer
from uika.viewer.painting import BROWSER, HERE

CASES = ((50_000, HERE), (50_000, BROWSER), (10**9, HERE), (10**9, BROWSER))
SIZE = (960, 540)  # of the page
FPS = 60.0  # of the motion: more than the viewer sends
PRESSES = 12
# Counts the uploads of whole avatars and of pictures, and the draws that are the first to show one.
COUNTER = """
(() => {
  const seen = window.seen = { drawn: 0, fresh: false, key: 0, waits: [] };
  const gl = WebGL2RenderingContext.prototype;
  const large = (value) => (value instanceof Uint32Array && value.length > 50000) ||
    ((value instanceof ImageBitmap || value instanceof HTMLImageElement) && value.width > 300);
  for (const name of ["texSubImage2D", "texImage2D"]) {
    const upload = gl[name];
    gl[name] = function (...values) { seen.fresh ||= values.some(large); return upload.apply(this, values); };
  }
  for (const name of ["drawElementsInstanced", "drawElements", "drawArrays"]) {
    const draw = gl[name];
    gl[name] = function (...values) {
      draw.apply(this, values);
      if (!seen.fresh) return;
      seen.fresh = false;
      seen.drawn++;
      if (seen.key) { seen.waits.push(performance.now() - seen.key); seen.key = 0; }
    };
  }
  window.addEventListener("keydown", () => { seen.key = performance.now(); }, true);
})()
"""


def posing(avatar: Avatar, motion: Motion, head: HeadModel, count: int = 100) -> list[float]:
    """Milliseconds of each pose, packed as the page takes it."""
    live, params, spans = LiveSplats(avatar, head), motion.parameters(avatar.identity), []
    for index in range(count):
        start = time.perf_counter()
        live.pose(params[index % len(motion)])
        spans.append(1e3 * (time.perf_counter() - start))
    return spans[10:]


def playing(tab: Page, viewer: Viewer, seconds: float) -> dict[str, float]:
    """Poses sent and drawn while the motion plays."""
    tab.switch("play")
    tab.wait("seen.drawn > 3", 60)
    drawn, sent, start = tab.run("seen.drawn"), viewer.updates, time.perf_counter()
    time.sleep(seconds)
    drawn, sent = tab.run("seen.drawn") - drawn, viewer.updates - sent
    span = time.perf_counter() - start
    assert sent, "the motion does not play"
    tab.switch("play")
    return {"sent/s": round(sent / span, 1), "drawn/s": round(drawn / span, 1)}


def answering(tab: Page) -> list[float]:
    """Milliseconds from a key press on the jaw slider to the drawing of what it changed."""
    time.sleep(3.0)
    tab.run("document.querySelector('[role=slider]').focus()")
    for press in range(PRESSES):
        before = tab.run("seen.waits.length")
        tab.key(*(("End", 35) if press % 2 == 0 else ("Home", 36)))
        deadline = time.perf_counter() + 10
        while tab.run("seen.waits.length") == before and time.perf_counter() < deadline:
            time.sleep(0.02)
        time.sleep(0.5)
    return tab.run("seen.waits")


def measure(avatar: Avatar, motion: Motion, head: HeadModel, who: str, seconds: float) -> dict[str, object]:
    """One row of the table."""
    spans = posing(avatar, motion, head)
    with (
        tempfile.TemporaryDirectory() as folder,
        Viewer(avatar, head, motion, 8300) as viewer,
        page(Path(folder), *SIZE) as tab,
    ):
        tab.call("Page.addScriptToEvaluateOnNewDocument", source=COUNTER)
        tab.open(viewer.url)
        tab.wait("document.querySelectorAll('[role=slider]').length >= 6 && window.seen && seen.drawn > 0")
        if who == HERE:
            tab.run(f"[...document.querySelectorAll('input')].find((input) => input.value === {BROWSER!r}).click()")
            tab.press(who, "[role=option]")
        rates, waits = playing(tab, viewer, seconds), answering(tab)
    row: dict[str, object] = {
        "Gaussians": len(avatar),
        "drawn by": who,
        "pose and pack, ms": round(statistics.median(spans), 1),
        "posed/s": round(1e3 / statistics.median(spans)),
        **rates,
        "key to picture, ms": round(statistics.median(waits)),
    }
    print(row, flush=True)
    return row


def main(argv: Sequence[str] | None = None) -> int:
    """Measure all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=8.0, help="of playing, for each row")
    arguments = parser.parse_args(argv)
    head = load_head()
    avatar = reconstruct([PORTRAIT], head).avatar
    motion = get_motion("talk", head, FPS)
    rows = [measure(thinned(avatar, n), motion, head, who, arguments.seconds) for n, who in CASES]
    text = "\n".join(
        (
            f"A page of {SIZE[0]}x{SIZE[1]} in headless Chromium without a graphics card: what the browser draws, it",
            f"draws in software on the same cores. The motion asks for {FPS:g} poses a second; 30 are sent at most.",
            "Key to picture: median over key presses on the jaw slider.",
            "",
            markdown(rows),
        )
    )
    save("viewer", "Viewer", text, {"rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
