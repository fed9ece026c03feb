"""The `asca` commands, one module per command."""
