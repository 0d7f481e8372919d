"""The recordings folder: runs, their locks and provenance, and the catalogue over them."""
