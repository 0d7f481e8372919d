"""Raise the threshold of Python's garbage collector; import this module first.

Imports create many objects that stay, so Python searches them after 50,000 new objects instead of 700.
"""

import gc

gc.set_threshold(50_000)
