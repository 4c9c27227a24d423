"""``python -m vinesim``: the command line without its entry point."""

from vinesim.cli import main

main()
