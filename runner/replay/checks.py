"""Checks that recorded steps can be used as indices; a module of its own, as it needs no compiled code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.errors import RecordingError


def check_steps(block: NDArray[np.void], mdp: Mdp, where: str, phase: str = "training") -> None:
    """Refuse recorded steps with a state or an action that the environment does not have.

    Args:
        block: the steps; not empty.
        mdp: the environment.
        where: the recording or archive, for the error.
        phase: of the steps, for the error.

    Raises:
        RecordingError: there is such a step.
    """
    bounds = {"state": mdp.states, "next_state": mdp.states, "action": mdp.joint_actions}
    for name, bound in bounds.items():
        if (found := int(block[name].max())) >= bound:
            step = int(block["step"][int(block[name].argmax())])
            raise RecordingError(
                f"{where}: found {name} {found} in {phase} step {step}, expected less than {bound}; "
                "`dualtaxi verify` checks the whole recording."
            )
