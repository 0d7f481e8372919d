"""A run as a single file, to hand to a colleague: packed, and unpacked with nothing in it believed."""
