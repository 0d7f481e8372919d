"""Q-tables of a recorded run at any step, replayed from its snapshots and steps."""
