"""Archives: a run as columns of Parquet, which others read, and from which it is restored losslessly."""
