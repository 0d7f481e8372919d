"""Tabular environments as arrays, with their scenes and names."""
