"""Reading recordings: evaluations, series of metrics, tables at any step, differences and comparisons."""
