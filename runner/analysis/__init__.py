"""What recordings tell: verification, tables at any step, and comparison. It reads, and writes nothing."""
