"""A Proposer for another environment: on which mountain cars should a Solver train?

A level is a gravity, an engine's power and a start. The Solver, an MLP, is to master a weak engine,
with which chance hardly ever reaches the top. The Proposer mixes 20 kinds of levels, and is paid
for the gain on that target. Run: python examples/own_environment.py [seeds] [cycles] [solvers]
"""

from __future__ import annotations

import sys

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type
from torchrl.modules import MLP

import proposer_rl as prl
from proposer_rl.models import categorical, normal, proposer_actor_critic

KINDS = torch.cartesian_prod(torch.arange(1, 5) / 4, torch.arange(1, 6) * 0.35)  # gravity, power
TARGET = torch.tensor([16])  # gravity 1, power 0.7
COPIES, PROBLEMS, STEPS, UPDATES = 16, 16, 40, 20
LEARNING = prl.PPOSettings(horizon=2, epochs=8, gamma=1.0, learning_rate=3e-3)  # the Proposer's


class MountainCar(EnvBase):
    """Moore's car in a valley, a batch of them; an action holds for five physical steps."""

    def __init__(self, levels: TensorDictBase) -> None:
        super().__init__(batch_size=(batch := levels.batch_size))
        self.observation_spec = Composite(observation=Unbounded((*batch, 2)), shape=batch)
        self.action_spec, self.reward_spec = Categorical(3, batch), Unbounded((*batch, 1))
        self.set_levels(levels)

    def set_levels(self, levels: TensorDictBase) -> None:
        self.levels = levels

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        return self._state(self.levels["start"], torch.zeros(self.batch_size))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        place, speed = (tensordict["observation"] * torch.tensor([0.9, 0.07])).unbind(-1)
        engine = 0.001 * self.levels["power"] * (tensordict["action"] - 1)  # back, none, forth
        for _ in range(5):
            pull = 0.0025 * self.levels["gravity"] * torch.cos(3 * place)
            speed = (speed + engine - pull).clamp(-0.07, 0.07)
            place = (place + speed).clamp(-1.2, 0.6)
            speed = speed.where(place > -1.2, speed.clamp(min=0))
        state = self._state(place, speed)
        return state.set("reward", state["terminated"].float() - 0.01)

    def _state(self, place: torch.Tensor, speed: torch.Tensor) -> TensorDict:
        seen, top = torch.stack([place / 0.9, speed / 0.07], -1), (place >= 0.5).unsqueeze(-1)
        return TensorDict({"observation": seen, "terminated": top}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


def generate(kinds: torch.Tensor, generators: list[torch.Generator]) -> TensorDict:
    start = torch.stack([torch.rand(kinds.shape[1], generator=g) for g in generators])
    gravity, power = KINDS[kinds].unbind(-1)
    return TensorDict({"gravity": gravity, "power": power, "start": 0.2 * start - 0.6}, kinds.shape)


def sampler(kinds: torch.Tensor):
    return lambda n, g: generate(kinds[torch.randint(len(kinds), (1, n), generator=g)], [g])[0]


def solvers(copies: int, streams: prl.Streams) -> prl.PPO:
    with streams.as_default("weights"):
        network = prl.Population(lambda: MLP(2, 4, 2, 32), copies, batched=True)
    split = TensorDictModule(lambda x: x.split([3, 1], -1), ["x"], ["logits", "state_value"])
    head = TensorDictSequential(TensorDictModule(network, ["observation"], ["x"]), split)
    agent = prl.ActorCritic(head, distribution_class=categorical, copies=copies)
    env = MountainCar(sampler(TARGET)(PROBLEMS, torch.Generator()).expand(copies, PROBLEMS))
    return prl.PPO(env, agent, prl.PPOSettings(horizon=STEPS, epochs=8, learning_rate=4e-3))


def evaluate(solver: prl.ActorCritic, levels: TensorDict, _: object = None) -> TensorDict:
    """Whether the most probable actions lead to the top in time, [K, E]."""
    env = MountainCar(levels.expand(solver.copies, *levels.batch_size))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        after = env.rollout(STEPS, solver.actor(), break_when_any_done=False)["next"]
    return TensorDict({"return": after["terminated"].any(-2).squeeze(-1).float()}, env.batch_size)


def probe(solver: prl.ActorCritic, levels: TensorDict) -> torch.Tensor:
    """Probabilities of the first action, [K, C, 3]."""
    state = MountainCar(levels.expand(solver.copies, *levels.batch_size)).reset()
    return solver(state)["logits"].softmax(-1)


def proposer(streams: prl.Streams, settings=LEARNING, loss=None) -> prl.ProposerCurriculum:
    directions = ((KINDS - KINDS.mean(0)) / KINDS.std(0)).T  # more gravity, more power
    env = prl.SolverTrainingEnv(
        solvers(COPIES, streams),
        view=prl.SolverView(target=sampler(TARGET), evaluate=evaluate, probe=probe),
        proposals=prl.Mixture(directions, generate),
        reward=prl.performance_gain,
        episode_length=UPDATES,
        updates_per_step=UPDATES // 2,
    )
    with streams.as_default("weights"):
        head = prl.MixtureHead(32 + 2, len(directions), hidden=32)
        network = prl.ProposerNetwork(head, torch.nn.Linear(3, 32), context=32, numbers=2)
    agent = proposer_actor_critic(network, normal, ["probes", "validation_return", "progress"])
    learner = prl.PPO(env, agent, settings, advantage=prl.CopiesBaseline(gamma=1.0), loss=loss)
    return prl.ProposerCurriculum(learner, own_action="mode")


def train(curriculum: prl.Curriculum, streams: prl.Streams) -> torch.Tensor:
    """Success of a fresh Solver on the target along its training."""
    validation, success = sampler(TARGET)(64, streams.generator("validation")), []
    curriculum.improve(solver := solvers(1, streams), [streams])
    for update in range(UPDATES + 1):
        success.append(evaluate(solver.agent, validation)["return"].mean())
        stream = streams.within(update)
        solver.env.set_levels(proposed := curriculum.propose(solver, [stream]))
        curriculum.observe(proposed, solver.update([stream.generator("actions")]).rollout)
    return torch.stack(success)


def main(seeds: int = 1, cycles: int = 25, fresh: int = 5, file: str = "own_environment.png"):
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5), layout="constrained")
    curves = {"the Proposer's mixtures": [], "all kinds evenly": [], "the target": []}
    for seed in range(seeds):
        curriculum, gains = proposer(prl.Streams(seed)), []
        for cycle in range(cycles):
            outcome = curriculum.improve(solvers(1, s := prl.Streams(seed, cycle)), [s]).metrics
            gains.append(sum(outcome["total_gain"]) / COPIES)
            print(f"seed {seed}, cycle {cycle}: mean gain of the copies {gains[-1]:.2f}")
        left.plot(gains)
        others = (prl.SamplingCurriculum(sampler(kinds)) for kinds in (torch.arange(20), TARGET))
        for runs, method in zip(curves.values(), (curriculum.frozen(), *others), strict=True):
            runs += [train(method, prl.Streams(seed, "fresh", k)) for k in range(fresh)]
    for name, runs in curves.items():
        print(f"{name}: success {torch.stack(runs)[:, -1].mean():.2f} after {UPDATES} updates")
        right.plot(torch.stack(runs).mean(0), label=name)
    left.set(xlabel="cycle of the Proposer", ylabel="mean gain of the copies")
    right.set(xlabel="updates of a fresh Solver", ylabel="success on the target")
    right.legend(title="trained on")
    figure.savefig(file)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
