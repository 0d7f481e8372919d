"""`dualtaxi export parquet`: steps, episodes and measures for data frames."""

from runner.cli.commands.export_tables import parquet as command

__all__ = ["command"]
