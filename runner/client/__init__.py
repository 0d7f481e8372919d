"""The client of a server: push, pull and jobs."""
