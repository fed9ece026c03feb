"""What the sensor measures of each hit."""
