"""The catalogue: an index over recordings folders, filters over it, what uses the disk, and removal.

    runs = look([Path("recordings")], lambda index: index.select(parse("status:finished seed:<3")))

The index is never the only copy of anything; it can be deleted at any time.
"""
