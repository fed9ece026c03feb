"""Work over many machines: shards, what happens to one whose worker dies, and Ray, which runs them."""
