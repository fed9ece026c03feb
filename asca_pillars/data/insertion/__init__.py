"""Inserting stored objects into a training frame: GT-Aug, and RS-Aug with its free space."""
