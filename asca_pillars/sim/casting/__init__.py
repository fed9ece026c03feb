"""Ray casting: the surface that every firing of the sensor hits."""
