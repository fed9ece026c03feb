"""Work over many machines: shards, their recovery when a worker dies, and Ray, which runs them."""
