"""Published datasets as one layout whose scans stay where they are."""
