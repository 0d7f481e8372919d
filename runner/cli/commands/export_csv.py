"""`dualtaxi export csv`: steps, episodes and measures for spreadsheets."""

from runner.cli.commands.export_tables import csv as command

__all__ = ["command"]
