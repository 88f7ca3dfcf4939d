"""What is being done is told on stderr, in one line on a terminal."""

import io
import sys

import pytest

from uika.io.progress import steps


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("names", [("reading",), ("reading", "writing"), ("a", "b", "c")])
def test_steps_are_lines_of_a_log(names: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with steps() as say:
        for name in names:
            say(name)
    found = capsys.readouterr()
    assert found.out == "" and found.err.splitlines() == [f"{name} ..." for name in names]


@pytest.mark.parametrize("fails", [False, True])
def test_a_terminal_has_one_line_that_is_gone_at_the_end(fails: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    try:
        with steps() as say:
            say("reading")
            say("writing")
            if fails:
                raise KeyError("damage")
    except KeyError:
        pass
    text = terminal.getvalue()
    assert "\n" not in text and "reading ..." in text and text.endswith("\r\x1b[K")
