"""The routes under `/api/v1`: parse, call one function, answer."""
