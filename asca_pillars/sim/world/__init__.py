"""Streets, and the objects placed on them."""
