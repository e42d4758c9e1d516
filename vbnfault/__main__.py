"""Run the command line: `python -m vbnfault` is the command `vbnfault`."""

from .cli import main

if __name__ == "__main__":
    main()
