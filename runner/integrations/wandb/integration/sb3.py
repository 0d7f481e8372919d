"""`WandbCallback`, as wandb has it for Stable-Baselines3, which records into the run of `wandb.init`.

from runner.integrations import wandb
from runner.integrations.wandb.integration.sb3 import WandbCallback

run = wandb.init(project="sb3", config=config)
model.learn(total_timesteps=25_000, callback=WandbCallback(model_save_path=f"models/{run.id}"))
run.finish()
"""

from __future__ import annotations

import os
from pathlib import Path

from runner.errors import RunnerError
from runner.integrations import wandb
from runner.integrations.sb3 import Recording
from runner.integrations.tensorboard import not_forwarded

from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.logger import TensorBoardOutputFormat  # isort: skip
from stable_baselines3.common.vec_env import VecEnv  # isort: skip


class WandbCallback(Recording):
    """A callback that records what a model learns from, and what it logs, into the run that is open.

    The run ends with `wandb.finish`, so what is logged after `learn` is in it too. A model whose environments
    cannot be recorded learns without, with a warning.

    Args:
        verbose: as for other callbacks.
        model_save_path: a folder, in which `model.zip` is saved at the end of `learn`; None for none.
        model_save_freq: save it, and record the checkpoint `policy`, after this many steps of environments
            too; 0 for not.
        more: what else wandb's callback takes; it has no effect, as gradients are not recorded.

    Raises:
        RunnerError: no run is open.
    """

    def __init__(
        self,
        verbose: int = 0,
        model_save_path: str | os.PathLike[str] | None = None,
        model_save_freq: int = 0,
        **more: object,
    ) -> None:
        if wandb.run is None:
            raise RunnerError("WandbCallback: no run is open: call wandb.init() first")
        self._script = wandb.run.script
        super().__init__(**self._script.arguments, checkpoint_every=model_save_freq)
        self.verbose = verbose
        self._model_file = None if model_save_path is None else Path(model_save_path, "model.zip")
        self._stays_open = True
        if more.get("gradient_save_freq"):
            self._script.warn_once("WandbCallback: gradients are not recorded.")

    def begin(self, model: BaseAlgorithm, is_continued: bool) -> None:
        """Record the environments of a model from now on, unless the run records others already."""
        if self._envs is None and not self._script.waits_for_environment:
            return
        try:
            super().begin(model, is_continued)
        except Exception as error:
            self._script.record_values(error)
            return
        if self._script.waits_for_environment:
            self._script.begin_recorded(self.recorded._loop, self)

    def log(self, name: str, value: object) -> None:
        """Log a number or a text at the model's step, also where its environments are not recorded."""
        if not self._script.closed:
            self._script.log(name, value, self.num_timesteps)

    def release(self) -> None:
        """Record no more steps."""
        self._stays_open = False
        self._end()

    def record_evaluations(self, envs: VecEnv) -> None:
        """Record the environments of an `EvalCallback`, if the training is recorded."""
        if self._envs is not None:
            super().record_evaluations(envs)

    def _init_callback(self) -> None:
        for output in self.logger.output_formats:
            if isinstance(output, TensorBoardOutputFormat):
                not_forwarded.add(output.writer)
        self._write_into(self.log)

    def _on_training_end(self) -> None:
        super()._on_training_end()
        self._save()

    def _checkpoint(self) -> None:
        if self._envs is not None:
            super()._checkpoint()
        self._save()

    def _save(self) -> None:
        if self._model_file is not None:
            self._model_file.parent.mkdir(parents=True, exist_ok=True)
            self.model.save(self._model_file)
