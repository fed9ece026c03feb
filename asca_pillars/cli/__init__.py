"""What each `asca` command does, one module per command."""
