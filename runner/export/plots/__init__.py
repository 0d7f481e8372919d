"""Figures of metrics, comparisons and differences."""
