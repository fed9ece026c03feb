"""Short drives: the same street scan after scan, with the car and the road users moving."""
