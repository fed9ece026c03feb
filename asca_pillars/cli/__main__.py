"""Entry point of `python -m asca_pillars.cli`, the command `asca`."""

from asca_pillars.cli.main import main

main()
