"""The recording format: the recorder that writes it and the reader that reads it."""
