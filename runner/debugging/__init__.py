"""Questions about how a run learned: what if, when, why, which change."""
