"""What the world is and what counts as success in it: bodies, engines, and one module a sport."""
