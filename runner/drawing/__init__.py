"""The grid of a scene as text and SVG."""
