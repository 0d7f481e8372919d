"""Recordings: the format, the recorder that writes it and the reader that gives it back."""
