"""How the command line talks: progress, warnings, errors and exit codes.

Results go to files, messages to standard error. A terminal gets a progress bar, a program JSON lines, a pipe
silence.
"""

from __future__ import annotations

import _thread
import json
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any, Literal

import click

from polymerge_core.errors import OptionError, PolymergeError

ProgressMode = Literal["auto", "json", "none"]

#: Exit codes: done, bad data, wrong usage, interrupted.
DONE, BAD_DATA, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130

_STEPS = 1000

#: What libraries say to programmers; a user of the command line can do nothing about it.
_LIBRARY_NEWS = (DeprecationWarning, PendingDeprecationWarning, FutureWarning, ResourceWarning)


class ProgressReport:
    """Shows how far a run has come.

    Parameters
    ----------
    mode : {"auto", "json", "none"}
        ``auto`` draws a bar on a terminal and is silent elsewhere; ``json`` prints one object a line.
    """

    def __init__(self, mode: ProgressMode) -> None:
        self._mode = mode if mode != "auto" or sys.stderr.isatty() else "none"
        self._shown = (-1, "")
        self._bar: Any = None

    def __call__(self, fraction: float, message: str) -> None:
        """Report a fraction between 0 and 1 and what is being done."""
        if self._mode == "none":
            return
        step = int(fraction * _STEPS)
        # A line for each percent is enough for a program, a frame for each permille for an eye.
        now = (step // 10 if self._mode == "json" else step, message)
        if now == self._shown:
            return
        self._shown = now
        if self._mode == "json":
            click.echo(json.dumps({"fraction": round(fraction, 4), "message": message}), err=True)
            return
        if self._bar is None:
            self._bar = click.progressbar(length=_STEPS, file=sys.stderr, show_eta=False, item_show_func=str)
        self._bar.update(step - self._bar.pos, current_item=message)

    def part(self, start: float, end: float) -> Callable[[float, str], None]:
        """Return a report for one part of the run, whose own fraction goes from 0 to 1."""
        return lambda fraction, message: self(start + (end - start) * fraction, message)

    def close(self) -> None:
        """End the bar, so that what is printed next starts on a line of its own."""
        if self._bar is not None:
            self._bar.render_finish()
            self._bar = None


def watch_stdin() -> None:
    """Interrupt the run, as Ctrl-C does, as soon as standard input closes."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # Whoever is started in the background by a shell ignores Ctrl-C, and an interrupt would do nothing.
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def wait() -> None:
        try:
            while os.read(sys.stdin.fileno(), 4096):
                pass
        except (OSError, ValueError):
            pass  # a standard input that cannot be read is a closed one
        _thread.interrupt_main()

    threading.Thread(target=wait, daemon=True, name="watch-stdin").start()


def run(command: click.Command, arguments: list[str] | None = None) -> int:
    """Run a command; print what goes wrong on one line; return the exit code.

    Parameters
    ----------
    command : click.Command
        The command line.
    arguments : list of str, optional
        ``sys.argv[1:]`` by default.

    Returns
    -------
    int
        0 done, 1 bad data, 2 wrong usage or option value, 130 interrupted.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            for category in _LIBRARY_NEWS:
                warnings.simplefilter("ignore", category)
            warnings.showwarning = lambda message, *_args, **_kwargs: say(f"warning: {message}")
            command.main(arguments, prog_name="polymerge", standalone_mode=False)
            sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, BrokenPipeError):
            # Whoever read our standard output has left; the interpreter must not try to flush it at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return BAD_DATA
        message, code = _explain(error)
        if code is None:
            raise
        say(message)
        return code
    return DONE


def _explain(error: BaseException) -> tuple[str, int | None]:
    """Return what to tell the user about an error, and the exit code; None where the traceback is wanted."""
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        return "interrupted; nothing half-written was left behind", INTERRUPTED
    if isinstance(error, click.ClickException):
        usage = isinstance(error, click.UsageError)
        hint = " (see --help)" if usage else ""
        return f"error: {error.format_message()}{hint}", WRONG_USAGE if usage else BAD_DATA
    if isinstance(error, PolymergeError):
        return f"error: {error}", WRONG_USAGE if isinstance(error, OptionError) else BAD_DATA
    if isinstance(error, MemoryError):
        return "error: not enough memory; merge the data in parts or with a higher min_score", BAD_DATA
    fault = f"error: {type(error).__name__}: {error}; this is a fault of PolyMerge, please report it"
    wanted = bool(os.environ.get("POLYMERGE_TRACEBACK"))
    return f"{fault} (POLYMERGE_TRACEBACK=1 shows where)", None if wanted else BAD_DATA


def say(message: str) -> None:
    """Print a message on one line of standard error."""
    click.echo(" ".join(message.split()), err=True)
