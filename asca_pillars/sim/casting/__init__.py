"""What every firing of the sensor hits."""
