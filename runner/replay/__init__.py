"""A recorded run replayed: Q-tables at any step of a job, and episodes of a loop in its environment."""
