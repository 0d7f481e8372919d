"""Tianshou: the environments of its vectors, in this process or in others, as one run.

recording = runner.integrations.tianshou.Recording(lambda: gymnasium.make("CartPole-v1"), name="dqn")
envs = SubprocVectorEnv([recording.train] * 4)
"""

from __future__ import annotations

from runner.integrations.libraries import Workers, require_tested

require_tested("tianshou", "tianshou", ("2.0", "2.0"))


class Recording(Workers):
    """Records the environments of a `DummyVectorEnv`, `SubprocVectorEnv` or another vector as one run.

        with runner.integrations.tianshou.Recording(make, name="dqn", seed=0) as recording:
            envs = SubprocVectorEnv([recording.train] * 4)
            ...
            envs.close()

    Each environment is recorded as the function makes it, before the wrappers of vectors change anything.
    """
