"""What a teacher costs thousands of robots: the share of its calls in a run that learns."""

from __future__ import annotations

import time
from itertools import pairwise
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Normal

from proposer_rl import LevelTerm, Parameters, Teacher
from proposer_rl.tasks.robots import RobotEnv
from research.benchmarks.results import Options, Result, Row, Spread

RANGES = {"step": (0.0, 0.4), "slope": (-0.25, 0.25), "speed": (0.5, 1.5)}
LIMIT = 60
ROBOTS, METHODS = 4096, ("terrain_levels", "adr", "adaptive_mixture")
STAND = 9  # iterations until robots that all fell at first mostly stand
TOGETHER = 4  # iterations whose share is measured as one


class Terrain(LevelTerm):
    """Steps, slopes and commanded speeds for a :class:`Fleet`."""

    method = "terrain_levels"
    seed = 0

    def make_teacher(self) -> Teacher:
        """Returns a teacher of ten rows, to master the last."""
        space = Parameters(RANGES, bins={"step": 10}, target={"step": (0.36, 0.4)})
        block = self.env.num_envs  # as many as there are robots cost less at once
        return Teacher(self.method, space, seed=self.seed, device=self.env.device, block=block)

    def results(self, env_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Returns how well the robots followed the command, and whether they came far enough."""
        return self.env.returns[env_ids], self.env.success[env_ids]

    def set_levels(self, env_ids: Tensor, levels: Any) -> None:
        """Sets the terrain of some robots."""
        for name, entry in levels.items():
            self.env.level[name][env_ids] = entry.float()


class Fleet:
    """Robots each of which begins anew where its episode ends; the interface of ``rsl_rl``.

    Args:
        count: of the robots.
        term: that gives them their terrain.
        device: of all tensors.
    """

    num_actions, max_episode_length = RobotEnv.forces, LIMIT

    def __init__(self, count: int, term: type[LevelTerm] = Terrain, device: str = "cpu") -> None:
        self.num_envs, self.device, self.cfg = count, device, {"robots": count}
        self.level = {name: torch.zeros(count, device=device) for name in RANGES}
        levels = TensorDict(self.level, [count])
        self._robots = RobotEnv(levels, max_steps=LIMIT, device=device)
        self.episode_length_buf = torch.zeros(count, dtype=torch.int64, device=device)
        self.common_step_counter = 0
        self.returns = torch.zeros(count, device=device)
        self.success = torch.zeros(count, dtype=torch.bool, device=device)
        self.state = torch.zeros(count, RobotEnv.state_size, device=device)
        self.extras: dict[str, Any] = {}
        self.term = term(None, self)
        self._reset(torch.arange(count, device=device))

    def get_observations(self) -> TensorDict:
        """Returns what the robots see, [n, 8]."""
        seen = self._robots.observe(self.state, self.level)
        return TensorDict({"policy": seen}, [self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Moves the robots, and begins anew with those whose episode has ended."""
        made = self._robots.advance(self.state, actions.clamp(-1, 1), self.level, self._chance())
        self.state = made.state
        self.episode_length_buf += 1
        self.common_step_counter += 1
        self.returns += made.reward
        late = self.episode_length_buf >= LIMIT
        self.reset_buf = made.terminated | late
        self.success = made.success & late & ~made.terminated
        ended = self.reset_buf.nonzero().squeeze(1)
        if len(ended):
            self._reset(ended)
        self.extras["time_outs"] = late & ~made.terminated
        reward = LIMIT * made.reward
        return self.get_observations(), reward, self.reset_buf.long(), self.extras

    def _reset(self, env_ids: Tensor) -> None:
        told = self.term(self, env_ids)
        self.extras["log"] = {f"/curriculum/{name}": value for name, value in told.items()}
        self.state[env_ids] = self._robots.begin(self.level, self._chance())[env_ids]
        self.returns[env_ids] = 0
        self.episode_length_buf[env_ids] = 0

    def _chance(self) -> Tensor:
        return torch.rand(self.num_envs, RobotEnv.draws, device=self.device)


class _Timed:
    """A teacher, and the seconds that its calls have taken."""

    def __init__(self, teacher: Teacher) -> None:
        self._teacher, self.seconds = teacher, 0.0

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any) -> Any:
            start = time.perf_counter()
            result = getattr(self._teacher, name)(*arguments)
            self.seconds += time.perf_counter() - start
            return result

        return call


def _timed(name: str) -> type[Terrain]:
    class Term(Terrain):
        method = name

        def make_teacher(self) -> Any:
            return _Timed(super().make_teacher())

    return Term


class _Learner:
    """PPO with rsl_rl's numbers and Isaac Lab's network for flat ground."""

    def __init__(self, fleet: Fleet) -> None:
        self.fleet, self.seen = fleet, fleet.get_observations()["policy"]
        sizes = (RobotEnv.observation_size, 128, 128, 128)
        self.actor, self.critic = (
            nn.Sequential(
                *[part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ELU())],
                nn.Linear(sizes[-1], out),
            ).to(fleet.device)
            for out in (RobotEnv.forces, 1)
        )
        weights = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(weights, lr=1e-3)

    def step(self) -> None:
        """24 steps of all robots, and five epochs on them in four parts."""
        seen, acted, rewards, ends = [], [], [], []
        with torch.inference_mode():
            for _ in range(24):
                action = Normal(self.actor(self.seen), 1.0).sample()
                after, reward, done, _ = self.fleet.step(action)
                seen.append(self.seen)
                acted.append(action)
                rewards.append(reward)
                ends.append(done)
                self.seen = after["policy"]
            x, actions = torch.cat(seen), torch.cat(acted)
            values = self.critic(torch.cat([x, self.seen])).view(25, -1)
            before = Normal(self.actor(x), 1.0).log_prob(actions).sum(-1)
            ahead, gains = torch.zeros_like(values[0]), []
            for t in reversed(range(24)):
                goes_on = 0.99 * (1 - ends[t])
                error = rewards[t] + goes_on * values[t + 1] - values[t]
                ahead = error + 0.95 * goes_on * ahead
                gains.append(ahead)
            gain = torch.cat(gains[::-1])
            aims = gain + values[:-1].flatten()
        # What was made in inference mode takes no part in gradients.
        x, actions, before, gain, aims = (one.clone() for one in (x, actions, before, gain, aims))
        for _ in range(5):
            for some in torch.randperm(len(x), device=x.device).chunk(4):
                policy = Normal(self.actor(x[some]), 1.0)
                ratio = (policy.log_prob(actions[some]).sum(-1) - before[some]).exp()
                own = (gain[some] - gain[some].mean()) / gain[some].std()
                clipped = torch.minimum(ratio * own, ratio.clamp(0.8, 1.2) * own)
                missed = (self.critic(x[some]).squeeze(-1) - aims[some]).square()
                self.optimizer.zero_grad()
                (missed - clipped).mean().backward()
                self.optimizer.step()


def robots(options: Options) -> Result:
    """Steps of many robots and of PPO, with the teacher's calls timed within."""
    count = 64 if options.tiny else ROBOTS
    stand = 1 if options.tiny else STAND
    rows = []
    for method in METHODS:
        fleet = Fleet(count, _timed(method), options.device)
        learner = _Learner(fleet)
        learner.step()  # not timed: all robots get their first levels
        fall = [_seconds(fleet, learner) for _ in range(options.few)]
        for _ in range(options.few, stand):
            learner.step()
        # A proposal of as many levels as there are robots is due every few iterations.
        after = [_seconds(fleet, learner, TOGETHER) for _ in range(options.few)]
        for when, seconds in (("fall", fall), ("stand", after)):
            own, every = zip(*seconds, strict=True)
            rows.append(
                Row(
                    f"{method}, ask and tell, {count} robots that {when}",
                    f"an iteration of {median(every):.2f} s: 24 steps, PPO's five epochs",
                    Spread.of([one / all for one, all in seconds]),
                    "%",
                    target=0.01 if when == "stand" else None,
                    at_most=True,
                    samples={"all": [*every], "teacher": [*own]},
                )
            )
    return Result(rows)


def _seconds(fleet: Fleet, learner: _Learner, iterations: int = 1) -> tuple[float, float]:
    """Returns the seconds of an iteration that are the teacher's, and all, means of several."""
    teacher: Any = fleet.term.teacher
    teacher.seconds, start = 0.0, time.perf_counter()
    for _ in range(iterations):
        learner.step()
    return teacher.seconds / iterations, (time.perf_counter() - start) / iterations
