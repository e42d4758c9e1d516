"""Run the command line and turn errors into one sentence and an exit code.

Exit codes: 0 done, 1 a failed run, 2 bad input, 130 interrupted by Ctrl-C (143 by SIGTERM, 129 by SIGHUP), 141 if
the reader of standard output left. A user's mistake never shows a traceback.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from .. import __version__
from ..core.errors import InputError, VbnfaultError
from ..core.process import interrupts, streams

app = typer.Typer(
    name="vbnfault",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_INTERRUPTED = "interrupted; the files written so far stay, and the same command continues the work"


def main() -> None:
    """Run the command that the arguments name, and exit with its code."""
    if len(os.environ.get("COLUMNS", "")) > 4:  # no terminal is that wide; tables would fill the memory with blanks
        del os.environ["COLUMNS"]
    # numpy's products of matrices are small. A thread of OpenBLAS that waits for the next one keeps a core busy and
    # takes it from render threads. The library reads this when numpy is imported; to change it later is not safe.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    streams.warn_in_sentences()
    with interrupts.listening(), streams.steady():
        code = _outcome()
    sys.exit(code)


def _outcome() -> int:
    """Run the command, print the sentence of an error or an interrupt, and return the exit code.

    Within this function a signal raises nothing, only within `_interruptible`.
    """
    try:
        return _interruptible()
    except (interrupts.Stopped, KeyboardInterrupt, typer.Abort) as stop:
        interrupts.ignore()  # a second Ctrl-C while Python ends
        if not streams.is_unread(stop):
            typer.echo(f"vbnfault: {_INTERRUPTED}", err=True)
        return interrupts.exit_code(stop)
    except VbnfaultError as error:
        if isinstance(error, interrupts.Interrupted):
            interrupts.ignore()
        typer.echo(f"vbnfault: {error}", err=True)
        return error.exit_code
    except OSError as error:  # one that no command expects, such as a full disk under standard output
        where = f"{error.filename}: " if error.filename else ""
        typer.echo(f"vbnfault: {where}{error.strerror or error}", err=True)
        return 1
    except MemoryError:
        typer.echo("vbnfault: not enough memory", err=True)
        return 1
    except Exception as error:
        # click's own usage errors (bad option, missing argument) know how to print themselves
        show = getattr(error, "show", None)
        if show is None:
            raise
        show()
        return int(getattr(error, "exit_code", 2))


def _interruptible() -> int:
    """Run the command so that a signal ends it, and return its exit code."""
    with interrupts.interruptible():
        interrupts.check()  # a signal may have arrived before
        return _exit_code()


def _exit_code() -> int:
    """Run the command and return its exit code."""
    code = app(standalone_mode=False)  # a command's typer.Exit comes back as its exit code
    return code if isinstance(code, int) else 0


def _print_version(wanted: bool) -> None:
    """Print the version and exit, if the option is given."""
    if wanted:
        typer.echo(f"vbnfault {__version__}")
        raise typer.Exit


@app.callback()
def _before_every_command(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Make labelled, fault-injected camera images for vision-based navigation near comets."""
    try:
        os.getcwd()
    except OSError:
        raise InputError("the working folder does not exist any more; change to another one") from None
