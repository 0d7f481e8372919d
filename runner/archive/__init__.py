"""Archives: a run as Parquet tables that other tools read, and from which it is restored losslessly."""
