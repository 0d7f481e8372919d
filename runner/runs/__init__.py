"""The recordings folder: its runs, their labels and locks, and the catalogue over them."""
