"""Recordings in other forms: pictures, plots, and what other viewers read."""
