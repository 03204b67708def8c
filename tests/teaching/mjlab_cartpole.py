"""Trains mjlab's cart-pole by mjlab's own script, and resumes it, with a teacher of its falls.

Prints what was told, as JSON, in a last line for ``test_robots.py``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import torch
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.rl import MjlabOnPolicyRunner
from mjlab.scripts.train import TrainConfig, run_train
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, register_mjlab_task
from torch import Tensor

import proposer_rl as prl

ROBOTS = 512
TASK = "Taught-Cartpole"
terms: list[Term] = []
loaded: list[Any] = []


class Term(prl.LevelTerm):
    """How far the pole may lean."""

    def make_teacher(self) -> prl.Teacher:
        terms.append(self)
        self.told: list[tuple[int, bool]] = []  # steps, and whether the pole fell
        self.begun = torch.zeros(ROBOTS, dtype=torch.int64)
        self.env.lean = torch.ones(ROBOTS)
        space = prl.Parameters({"lean": (0.05, 1.0)}, bins=5)
        return prl.Teacher("terrain_levels", space, seed=self.env.cfg.seed, block=ROBOTS)

    def results(self, env_ids: Tensor) -> tuple[Tensor, Tensor]:
        steps = self.env.common_step_counter - self.begun[env_ids]
        fell = self.env.reset_terminated[env_ids]
        self.told += zip(steps.tolist(), fell.tolist(), strict=True)
        return steps, ~fell

    def set_levels(self, env_ids: Tensor, levels: Any) -> None:
        self.begun[env_ids] = self.env.common_step_counter
        self.env.lean[env_ids] = levels["lean"].float()


def fell(env: Any) -> Tensor:
    """Returns which poles lean too far, [n]."""
    angles: Tensor = env.scene["cartpole"].data.joint_pos[:, 1]
    return angles.abs() > env.lean


class Runner(prl.TaughtRunner, MjlabOnPolicyRunner):
    def load(self, *args: Any, **kwargs: Any) -> Any:
        infos = super().load(*args, **kwargs)
        env = self.env.unwrapped
        loaded.append([env.common_step_counter, terms[-1].state_dict()["proposals"]])
        return infos


def main(folder: Path) -> None:
    cfg = load_env_cfg("Mjlab-Cartpole-Balance")
    cfg.scene.num_envs, cfg.episode_length_s = ROBOTS, 1.0
    cfg.curriculum["lean"] = CurriculumTermCfg(func=Term)
    cfg.terminations["fell"] = TerminationTermCfg(func=fell)
    agent = load_rl_cfg("Mjlab-Cartpole-Balance")
    agent.max_iterations, agent.logger, agent.upload_model = 2, "tensorboard", False
    register_mjlab_task(TASK, cfg, cfg, agent, runner_cls=Runner)
    for name, resume in (("first", False), ("second", True)):
        config = TrainConfig.from_task(TASK)
        config.agent.resume, config.agent.load_run = resume, "first"
        run_train(TASK, config, folder / name)
    said = [
        {
            "told": term.told,
            "log": term.teacher.log(),
            "limit": term.env.max_episode_length,
            "steps": term.env.common_step_counter,
            "proposals": term.state_dict()["proposals"],
            "logged": [*term.env.curriculum_manager.reset()],
        }
        for term in terms
    ]
    print("\n" + json.dumps({"runs": said, "loaded": loaded}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
