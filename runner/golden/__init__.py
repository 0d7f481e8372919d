"""Golden runs: learning under test, compared with what was recorded when it was right."""
