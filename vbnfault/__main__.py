"""Run the command line: `python -m vbnfault` is the command `vbnfault`."""

from .core.process import interrupts


def main() -> None:
    """Run the command line. From here to the end of the process no signal ends it with a traceback."""
    with interrupts.listening():
        try:
            from .cli import main as run  # imports much

            run()
        finally:
            interrupts.ignore(sigterm=True)  # the exit code is known, and Python ends


if __name__ == "__main__":
    main()
