"""What every package may use: values, names, files, formatting, optional packages, child processes."""
