"""The command line: parsing, and errors as one sentence each."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from uika.errors import UikaError, UikaWarning, install_command

HEAD_VARIABLE = "UIKA_HEAD"
_WRONG_INPUT, _UNEXPECTED, _INTERRUPTED = 2, 1, 130
_PATIENCE = 1.5  # seconds from an interrupt to the end
_said = threading.Event()
_is_process = threading.Event()  # whether this process runs one command and nothing else


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments without the program's name; None takes those of the process.

    Returns:
        The exit code: 0 done, 1 something unexpected (or `doctor` found something missing), 2 unusable input, 130
        interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    _said.clear()
    chosen_head = os.environ.get(HEAD_VARIABLE)
    try:
        arguments = _choose_head([argument for argument in arguments if argument != "--debug"])
        if arguments in ([], ["-h"], ["--help"]):
            return _overview(asked=bool(arguments))
        command = _parse(arguments)
        with warnings_as_sentences():
            return int(command.run())
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:
        _say_interrupted()
        if _is_process.is_set():
            _end()
        return _INTERRUPTED
    except Exception as error:
        if debug:
            traceback.print_exc()
        code, sentence = _explain(error)
        hint = "" if code == _WRONG_INPUT or debug else " (--debug shows where)"
        print(f"uika: {sentence}{hint}", file=sys.stderr)
        return code
    finally:
        _set_head(chosen_head)


def run() -> NoReturn:
    """Run one command as the process, and end the process with its exit code; an interrupt ends it within seconds."""
    # Idle OpenMP threads would spin on the cores that Dr.Jit needs; read once, when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # numpy is used for many small products only, which its threads would slow down.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _watch_for_interrupts()
    _is_process.set()
    sys.exit(main())


@contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Doubts about the input are one line each on stderr; other warnings stay what they are."""
    with warnings.catch_warnings():
        plain = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            if issubclass(category, UikaWarning):
                print(f"uika: warning: {message}", file=sys.stderr)
            else:
                plain(message, category, *place, **more)

        warnings.showwarning = show
        warnings.simplefilter("always", UikaWarning)
        yield


def _say_interrupted() -> None:
    if not _said.is_set():
        _said.set()
        print("\ninterrupted", file=sys.stderr, flush=True)


def _end() -> NoReturn:
    """Leave at once: threads and processes of loaders would be waited for, or abort and be complained of."""
    if threading.current_thread() is threading.main_thread() and hasattr(signal, "SIGCHLD"):
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    for child in multiprocessing.active_children():
        child.kill()
    os._exit(_INTERRUPTED)


def _watch_for_interrupts() -> None:
    """Python answers a signal when the operator at hand returns: end the process if that takes too long."""
    # The tracker of shared memory tidies up behind a process that left at once, and need not say so.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

    def watch() -> None:
        while received := os.read(reader, 1):
            if received[0] == signal.SIGINT:
                time.sleep(_PATIENCE)
                _say_interrupted()
                _end()

    threading.Thread(target=watch, daemon=True).start()


def _choose_head(arguments: list[str]) -> list[str]:
    """Take `--head FILE` out of the arguments and make that head model the one that is loaded."""
    if "--head" not in arguments:
        return arguments
    at = arguments.index("--head")
    if at + 1 == len(arguments):
        raise UikaError("--head needs the head file to use, for example: --head flame.npz")
    _set_head(arguments[at + 1])
    return arguments[:at] + arguments[at + 2 :]


def _set_head(path: str | None) -> None:
    if path is None:
        os.environ.pop(HEAD_VARIABLE, None)
    else:
        os.environ[HEAD_VARIABLE] = path


def _overview(asked: bool) -> int:
    _need_tyro()
    from uika.cli.commands import Command
    from uika.cli.help import overview

    print(overview(Command), file=sys.stdout if asked else sys.stderr)
    return 0 if asked else _WRONG_INPUT


def _parse(arguments: list[str]) -> Any:
    tyro = _need_tyro()
    from uika.cli.commands import Command

    return tyro.cli(Command, prog="uika", args=arguments, config=(tyro.conf.OmitArgPrefixes,))


def _need_tyro() -> Any:
    try:
        import tyro
    except ModuleNotFoundError as error:
        raise UikaError(f"the command line needs tyro; run: {install_command('tyro')}") from error
    return tyro


def _explain(error: Exception) -> tuple[int, str]:
    """Exit code and sentence."""
    text = " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError) and (command := install_command(error.name or "")):
        return _WRONG_INPUT, f"this needs the package '{error.name}'; run: {command}"
    if isinstance(error, OSError) and error.strerror:
        return _WRONG_INPUT, f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, (ValueError, OSError)):
        return _WRONG_INPUT, text
    return _UNEXPECTED, f"unexpected {type(error).__name__}: {text}" if text else f"unexpected {type(error).__name__}"
