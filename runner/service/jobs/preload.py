"""What work in a process of its own needs: loaded once, and had by each of them from its start."""

from __future__ import annotations

import runner.analysis.diff
import runner.analysis.qtable
import runner.analysis.readings
import runner.service.computed  # noqa: F401
