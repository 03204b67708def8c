"""The base of tasks; see ``examples/own_task.py`` for a complete one.

K are Solvers, P the levels of one update, T its steps, E validation levels, C probes, N bins.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from textwrap import shorten
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical, MultiCategorical
from torchrl.envs import EnvBase

from proposer_rl.learning import (
    PPO,
    Replica,
    RolloutCollector,
    SolverSettings,
    first_episode_return,
    first_episode_success,
    graphs,
    mean_performance,
)
from proposer_rl.models import ActorCritic, Population, distribution_of, memory_actor_critic, normal
from proposer_rl.runs.records import LONGEST_TEXT, png, written
from proposer_rl.streams import Streams
from proposer_rl.task.protocols import (
    ComputeContext,
    Distribution,
    LevelResult,
    Levels,
    Space,
    check_distributions,
    for_copies,
    level_inputs,
    space_features,
)


class Task(ABC):
    """Trains Solvers in an environment and measures them; subclass it for your own task.

    A **performance** is the return and success of Solvers on levels. To **evaluate** is to compute
    it on each fixed evaluation level. **Metrics** summarize this (:meth:`measure`) or the training
    (:meth:`training_metrics`). **Records** show levels as pictures and text. **Facts** describe the
    task for readers.

    A subclass must define :meth:`environment`, :meth:`network` and a ``title``, and call this
    constructor. It may override everything else.

    Args:
        distributions: by name, for hand-designed curricula and for measuring.
        target: name of the distribution to be mastered.
        space: the levels among which a Proposer chooses.
        solver: the Solver's training.
        context: precision, cores, and whether a GPU replays graphs. A task makes its levels on the
            context's device; everything is computed where they are.
        measured_on: names of the distributions to measure Solvers on; None for all.
        levels: fixed evaluation levels E of each of them, the same in every run.
        seed: of these levels, and of the actions in evaluations.
        max_steps: step limit of an episode in evaluations; None for the horizon of the training's
            rollouts.
        episodes: played on each level to measure a performance.
        greedy: whether evaluations take the most probable actions, or sample them.
        measured: all further settings that must be equal for two runs' metrics to be comparable,
            for JSON.

    Attributes:
        title: of its runs.
        noun: a word for levels, in the plural.
        key: description of a record's picture.
        text_key: description of a record's text; None if it needs none.
        results: entries of a performance, ``"return"`` and, if it has a meaning, ``"success"``.
        exact_performance: whether :meth:`performance` draws nothing at random.
        exact_metrics: whether :meth:`measure` draws nothing at random.
        default_levels: name of the levels for :meth:`level_results` if none is given.
        batched: as in :class:`~proposer_rl.models.Population`.
        episodes_at_once: of each Solver in evaluations; None for all.
        observed: entries that are passed to the network, in order.
        memory: width of the network's memory (:func:`~proposer_rl.models.memory_actor_critic`);
            None for a network without.
        drop_finished: whether evaluations drop finished levels, as in
            :func:`~proposer_rl.learning.mean_performance`.
        replayed: parts that read nothing back from a GPU, and are replayed there as CUDA graphs:
            ``"rollouts"``, if the environment writes new levels into the memory of the old ones,
            and the methods ``"performance"``, ``"probe"`` and ``"measure"``.
        batch_size: levels P of an update of one Solver.
        evaluated_on: the fixed evaluation levels [E], by the distributions' names.

    Raises:
        ValueError: naming the key, if there is no distribution of a name.
    """

    title: str
    noun: str = "levels"
    key: str = "The level's numbers."
    text_key: str | None = None
    results: Sequence[str] = ("success", "return")
    exact_performance: bool = False
    batched: bool | None = None
    episodes_at_once: int | None = None
    observed: Sequence[str] = ("observation",)
    memory: int | None = None
    drop_finished: bool = False
    replayed: Sequence[str] = ()

    def __init__(
        self,
        *,
        distributions: Mapping[str, Distribution],
        target: str,
        space: Space,
        solver: SolverSettings,
        context: ComputeContext,
        measured_on: Sequence[str] | None = None,
        levels: int = 64,
        seed: int = 0,
        max_steps: int | None = None,
        episodes: int = 1,
        greedy: bool = False,
        measured: Mapping[str, Any] | None = None,
    ) -> None:
        names = list(distributions if measured_on is None else measured_on)
        check_distributions(distributions, target, names)
        self.precision = "fp32" if context.precision == "auto" else context.precision
        self.batch_size = solver.batch_size
        self.distributions: Mapping[str, Any] = dict(distributions)
        self.target: Any = distributions[target]
        self.space: Any = space
        self.solver = solver
        self.cores = context.cores
        self.max_steps = max_steps or solver.ppo.horizon
        self.episodes, self.greedy = episodes, greedy
        self.default_levels = names[0]
        self._levels, self._seed = levels, seed
        self._measured = dict(measured or {"levels": [levels, seed], "target": target})
        self.evaluated_on = {name: self.evaluation_levels(name) for name in names}
        entry = next(iter(self.evaluated_on[names[0]].values(True, True)), None)
        self.device = torch.device("cpu") if entry is None else entry.device
        self._compile = context.compile
        self._graphs = context.graphs and graphs.has_graphs(self.device)
        if self._graphs:
            for name in set(self.replayed) - {"rollouts"}:
                setattr(self, name, graphs.ReplayedOfAgents(getattr(self, name)))

    @abstractmethod
    def environment(self, levels: Levels) -> EnvBase:
        """Returns an environment that plays levels [*B] from its next reset on.

        Its method ``set_levels(levels [*B])`` replaces them from the next reset on. An episode's
        success is the entry ``success``, bool [*B, 1], or without one its termination.
        """

    def evaluation_environment(self, levels: Levels) -> EnvBase:
        """Returns the :meth:`environment` of evaluations and probes, one for each batch [K, E]."""
        return self.environment(levels)

    @abstractmethod
    def network(self) -> nn.Module:
        """Returns one Solver's network without buffers, with weights by torch's default generator.

        It maps the ``observed`` entries, [*B, ...] each, to logits [*B, A], or locations and
        log-scales [*B, D, 2] of continuous actions, and values [*B, 1]. With ``memory`` it is a
        network such as :class:`~proposer_rl.models.MemoryNetwork`. It is unused if
        :meth:`actor_critic` is overridden.
        """

    def actor_critic(self, population: Population, env: EnvBase) -> ActorCritic:
        """Returns K networks as the agent of an environment [K, P]."""
        distribution = distribution_of(env.full_action_spec["action"])
        if self.memory is not None:
            observed = self.observed, self.memory
            return memory_actor_critic(population, *observed, distribution_class=distribution)
        module = TensorDictModule(population, [*self.observed], ["logits", "state_value"])
        return ActorCritic(module, distribution_class=distribution, copies=population.copies)

    def learner(self, streams: Sequence[Streams]) -> PPO:
        """Returns PPO of K new Solvers, one for each stream, in their environment [K, P]."""
        copies, remaining = len(streams), iter(streams)

        def network() -> nn.Module:
            with next(remaining).as_default("weights"):
                return self.network()

        population = Population(network, copies, self.precision, self.cores, self.batched)
        env = self.environment(self._placeholders(copies, self.batch_size))
        ppo = PPO(env, self.actor_critic(population.to(self.device), env), self.solver.ppo)
        if self._compile:
            ppo.compile()
        return ppo.replay(rollouts="rollouts" in self.replayed) if self._graphs else ppo

    def spectators(self, learner: PPO | Replica) -> tuple[EnvBase, RolloutCollector]:
        """Returns an environment in which a learner's Solvers play levels [K, P] without training.

        Returns:
            The environment, and a collector of whole episodes in it. They are the learner's own if
            its rollouts begin with the episodes.
        """
        horizon = learner.settings.horizon
        if learner.settings.continue_episodes:
            horizon = max(self.max_steps, horizon)
        elif isinstance(learner, PPO):
            return learner.env, learner.collector
        env = self.environment(self._placeholders(learner.agent.copies or 1, self.batch_size))
        return env, RolloutCollector(env, learner.agent, horizon)

    def performance(
        self, agent: ActorCritic, levels: Levels, generator: torch.Generator
    ) -> TensorDictBase:
        """Returns the performance of K Solvers on levels [E] or [K, E]: a tensordict [K, E].

        ``return``, float [K, E], is the expected return of an episode or an estimate, and
        ``success`` the probability of success, if it has a meaning. The generator is on the CPU;
        exact evaluations do not use it.
        """
        performance = mean_performance(
            agent,
            self.evaluation_environment,
            for_copies(agent, levels),
            generator,
            max_steps=self.max_steps,
            episodes=self.episodes,
            greedy=self.greedy,
            at_once=self.episodes_at_once,
            drop_finished=self.drop_finished,
        )
        return performance if "success" in self.results else performance.exclude("success")

    @torch.no_grad()
    def probe(self, agent: ActorCritic, levels: Levels) -> Tensor:
        """Returns a Proposer's observations of K Solvers on levels [C]: float [K, C, ...].

        By default these are the policies in the first states: probabilities of n actions, or of
        each option of several choices, or means of continuous actions, [K, C, D].
        """
        copies = for_copies(agent, levels)
        if not copies.batch_size.numel():
            return torch.zeros(*copies.batch_size, self._actions, device=self.device)
        state = self.evaluation_environment(copies).reset()
        state.update(agent.no_memory(state))
        logits = agent(state)[agent.logits_key]
        continuous = agent.distribution_class is normal
        return logits[..., 0] if continuous else logits.softmax(-1).flatten(2)

    def probe_encoder(self, features: int) -> nn.Module:
        """Returns a network from probes [*B, ...] to [*B, features]; here a linear layer."""
        return nn.Linear(self._actions, features)

    def features(self, levels: Levels) -> Tensor:
        """Returns features of levels [K, n] for a model of outcomes: float [K, n, F], -1 to 1.

        By default they depend on the levels' coordinates, and the space needs ``locate(levels)``.
        """
        return space_features(self.space, levels)

    def inputs(self, levels: Levels) -> Tensor:
        """Returns a belief's inputs for levels [*B]: float64 [*B, D] on the CPU, -1 to 1.

        By default they are the levels' coordinates if the space has ``locate(levels)``; else D is
        0.
        """
        return level_inputs(self.space, levels)

    @property
    def metrics(self) -> list[str]:
        """Returns the names of the results of :meth:`measure`."""
        return [f"{name}_{result}" for name in self.evaluated_on for result in self.results]

    def measure(self, agent: ActorCritic) -> TensorDictBase:
        """Returns metrics of K Solvers by name, each float [K]: the columns of ``metrics.csv``.

        By default these are ``<name>_success`` and ``<name>_return``, means over the evaluation
        levels of each distribution.
        """
        means = {
            f"{name}_{result}": performance[result].mean(1)
            for name, performance in self.evaluate(agent).items()
            for result in self.results
        }
        return TensorDict(means, [agent.copies])

    def evaluate(self, agent: ActorCritic) -> Mapping[str, TensorDictBase]:
        """Returns the performance of K Solvers on every evaluation level, [K, E] by distribution.

        The random numbers of the actions are the same every time.
        """
        return {
            name: self.performance(agent, levels, self.stream("actions", name))
            for name, levels in self.evaluated_on.items()
        }

    def evaluation_levels(self, name: str) -> Levels:
        """Returns the fixed evaluation levels [E] of a distribution."""
        distribution = self.evaluation_distribution(name)
        return distribution.sample(self._levels, self.stream("levels", name))

    def evaluation_distribution(self, name: str) -> Distribution:
        """Returns the distribution from which evaluation levels are drawn."""
        distribution: Distribution = self.distributions[name]
        return distribution

    def stream(self, use: str, name: str) -> torch.Generator:
        """Returns the generator of a distribution's evaluation ``"levels"`` or ``"actions"``."""
        scope = {"levels": "evaluation", "actions": "episodes"}[use]
        return Streams(self._seed, scope, name).generator()

    def training_metrics(self, levels: Levels, rollout: TensorDictBase) -> TensorDictBase:
        """Returns columns of ``training.csv`` for levels [K, P] and rollout [K, P, T], each [K].

        By default these are means of entries that are axes of the space, for texts the share of
        each, and the means of success and return of first episodes.
        """
        means: dict[str, Tensor] = {}
        bins = getattr(self.space, "bins", {})
        for name in self._numbers(levels):
            if name in bins:
                means |= bins[name].means(name, levels[name])
            else:
                means[name] = levels[name].double().mean(-1)
        if "success" in self.results:
            means["train_success"] = first_episode_success(rollout).float().mean(-1)
        means["train_return"] = first_episode_return(rollout).mean(-1)
        return TensorDict(means, levels.batch_size[:1])

    def record(self, levels: Levels, rollout: TensorDictBase | None) -> list[dict[str, Any]]:
        """Returns records of levels [n], with a Solver's steps there [n, T], for JSON.

        A record has a ``picture``, a PNG in base64, and may have ``text``, lines for a terminal,
        and other entries.
        """
        texts = [
            [f"{name} {float(level[name]):.4g}" for name in self._numbers(levels)]
            for level in levels
        ]
        pictures = self.pictures(levels, rollout) or map(written, texts)
        return [{"picture": png(p), "text": t} for p, t in zip(pictures, texts, strict=True)]

    def pictures(
        self, levels: Levels, rollout: TensorDictBase | None
    ) -> Sequence[NDArray[np.uint8]]:
        """Returns pictures uint8 [H, W, 3] for :meth:`record`, which shows numbers without any."""
        return []

    @property
    def exact_metrics(self) -> bool:
        """Returns whether :meth:`measure` draws nothing at random."""
        return self.exact_performance

    @property
    def description(self) -> dict[str, Any]:
        """Returns the space's axes and the task's names, to compare states by, for JSON."""
        return {
            "kind": type(self).__qualname__,
            "axes": {name: list(values) for name, values in self.space.axes.items()},
            "distributions": list(self.distributions),
        }

    @property
    def about(self) -> dict[str, str]:
        """Returns facts about the task for readers, by their labels."""
        names = ", ".join(self.evaluated_on)
        return {"Measured on": f"{names}; {self._levels} fixed levels each"}

    @property
    def facts(self) -> dict[str, Any]:
        """Returns a description of the task for readers of a run, for JSON.

        - ``title``: of its runs, and ``levels``: a word for levels;
        - ``distributions``: names of those measured on; ``<name>_success`` are their columns;
        - ``space``: the axes of the Proposer's bins;
        - ``about``: texts by their labels; ``key`` and ``text_key``: descriptions of a record's
          picture and of its text;
        - ``measured``: all that must be equal for two runs' metrics to be comparable;
        - ``exact``: whether the metrics draw nothing at random.
        """
        return {
            "title": self.title,
            "levels": self.noun,
            "distributions": list(self.evaluated_on),
            "space": {name: list(values) for name, values in self.space.axes.items()},
            "about": {
                key: shorten(said, LONGEST_TEXT, placeholder=" ...")
                for key, said in self.about.items()
            },
            "key": self.key,
            **({"text_key": self.text_key} if self.text_key else {}),
            "measured": self._measured,
            "exact": self.exact_metrics,
        }

    def level_results(
        self, agent: ActorCritic, name: str, max_steps: int | None
    ) -> Sequence[LevelResult]:
        """Returns the results of K Solvers on each level of a named set, in the set's order.

        Args:
            agent: K Solvers.
            name: of the set; by default a distribution, whose evaluation levels are played as in
                :meth:`evaluate`.
            max_steps: step limit of every level; None for the task's choice, which by default is
                the only one.

        Raises:
            ValueError: if there is no such set, or Solvers cannot play its levels.
            StorageError: if a file cannot be read.
        """
        if name not in self.distributions:
            raise ValueError(f"--levels {name}: must be one of: {', '.join(self.distributions)}")
        if max_steps is not None:
            raise ValueError("--max-steps: the step limit of this task's levels is fixed")
        levels = self.evaluation_levels(name)
        performance = self.performance(agent, levels, self.stream("actions", name)).cpu()
        copies, count = performance.batch_size

        return [
            LevelResult(
                level=f"{name}_{i:03}",
                solver=k,
                about={},
                results={str(key): float(value) for key, value in performance[k, i].items()},
            )
            for i in range(count)
            for k in range(copies)
        ]

    @property
    def _actions(self) -> int:
        """Returns the count of a probe's numbers for one level."""
        env = self.evaluation_environment(self._placeholders(1, 1))
        spec = env.full_action_spec["action"]
        if isinstance(spec, MultiCategorical):
            return len(spec.nvec[0, 0]) * int(spec.nvec.max())
        return int(spec.n) if isinstance(spec, Categorical) else int(spec.shape[-1])

    def _placeholders(self, *shape: int) -> Levels:
        """Returns levels of a shape for an environment whose levels are set later."""
        return next(iter(self.evaluated_on.values()))[:1].expand(*shape)

    def _numbers(self, levels: Levels) -> list[str]:
        """Returns the axes of the space that are entries of the levels."""
        return [name for name in self.space.axes if name in levels.keys()]
