"""The grid of a scene as text and SVG, and the colours of everything that is drawn."""
