"""The catalogue: an index over recordings folders, filters, disk usage and removal of runs.

    runs = look([Path("recordings")], lambda index: index.select(parse('status == "finished" and seed < 3')))

The index holds nothing of its own: it can be deleted at any time.
"""
