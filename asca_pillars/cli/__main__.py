"""`python -m asca_pillars.cli` is the command `asca`."""

from asca_pillars.cli.main import main

main()
