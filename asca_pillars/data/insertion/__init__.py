"""Insertion of stored objects into training frames: GT-Aug, and RS-Aug with free space."""
