"""Levels of a teacher in Isaac Lab's and mjlab's curriculum managers, kept by rsl_rl."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import is_tensor_collection
from torch import Tensor

from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.teacher import Teacher

NONE = -1  # the ticket of no level


class LevelTerm:
    """Asks a teacher for the levels of environments that reset, as a curriculum manager's term.

    Subclass it, and for Isaac Lab also ``ManagerTermBase``, to define the levels, the result of an
    episode and how an environment plays a level; then name the class in the config:

        class Terrain(prl.LevelTerm, ManagerTermBase):
            def make_teacher(self): return prl.Teacher("adr", space, device=self.env.device)
            def results(self, env_ids): return walked, walked > 4.0
            def set_levels(self, env_ids, levels): ...

        cfg.curriculum["terrain"] = CurriculumTermCfg(func=Terrain)

    Only the results of whole episodes are told. Two kinds are dropped: episodes that another reset
    cuts off, and episodes whose length counter the runner changed, as
    ``learn(init_at_random_ep_len=True)`` does with the first of each environment: they are cut
    short, so that nearly all that ended by themselves would be failures.

    In a launch of several processes each draws levels of its own, by its ``RANK``. The manager logs
    the mean of each parameter over the levels that are played.

    Args:
        cfg: the term's config.
        env: an environment with ``num_envs``, ``device``, ``common_step_counter``,
            ``episode_length_buf`` and, after the first step, ``reset_buf``, bool [num_envs]. The
            term adds itself to its list ``taught``, which :class:`TaughtRunner` reads.

    Attributes:
        env, teacher: the environment and the teacher.
        tickets: tickets of the levels that are played, int64 [num_envs].
    """

    def __init__(self, cfg: Any, env: Any) -> None:
        self.cfg, self.env, self._env = cfg, env, env  # ManagerTermBase reads _env
        self.teacher = self.make_teacher()
        self._diverge()
        self.tickets = torch.full((env.num_envs,), NONE, device=env.device)
        self._begun = torch.zeros_like(self.tickets)  # common_step_counter at their reset
        self._levels: Any = None
        env.taught = [*getattr(env, "taught", ()), self]

    @abstractmethod
    def make_teacher(self) -> Teacher:
        """Returns the teacher."""

    @abstractmethod
    def results(self, env_ids: Tensor) -> tuple[Any, Any]:
        """Returns return and success of the episodes that have ended, [n] each.

        Success may be None for curricula that do not use it.
        """

    @abstractmethod
    def set_levels(self, env_ids: Tensor, levels: Any) -> None:
        """Makes environments int64 [n] play levels [n], from this reset on."""

    def reset(self, env_ids: Any = None) -> None:
        """Does nothing; the manager calls it after the term itself."""

    def __call__(self, env: Any, env_ids: Any) -> dict[str, Tensor]:
        """Tells the teacher the results of episodes, and sets the environments' next levels.

        Args:
            env: the environment.
            env_ids: numbers, a mask or a slice; None for all environments.
        """
        ids = torch.arange(env.num_envs, device=env.device)[env_ids].reshape(-1)
        tickets, steps = self.tickets[ids], env.common_step_counter - self._begun[ids]
        known = tickets != NONE
        whole = known & (steps > 0) & (env.episode_length_buf[ids] == steps)
        if whole.any():
            whole &= env.reset_buf[ids].bool()
            if whole.any():
                self.teacher.tell(tickets[whole], *self.results(ids[whole]))
        dropped = tickets[known & ~whole]
        if len(dropped):
            self.teacher.drop(dropped)
        asked, levels = self.teacher.ask(len(ids))
        self.tickets[ids], levels = asked.to(env.device), levels.to(env.device)
        self._begun[ids] = env.common_step_counter
        if self._levels is None:
            with torch.inference_mode(False):  # rsl_rl steps environments within it
                self._levels = levels.new_zeros(env.num_envs, *levels.shape[1:])
        self._levels[ids] = levels
        self.set_levels(ids, levels)
        played = self._levels[self.tickets != NONE]
        named = played.items() if is_tensor_collection(played) else [("level", played)]
        return {str(name): entry.float().mean() for name, entry in named}

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the teacher."""
        return self.teacher.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Loads a teacher's state, and drops the levels that are played now.

        All processes load what one of them saved, and go on with draws of their own.
        """
        self.teacher.drop()
        self.tickets.fill_(NONE)
        self.teacher.load_state_dict(state)
        self.teacher.drop()  # the levels that the environments of the saved state played
        self._diverge()

    def _diverge(self) -> None:
        self.teacher.diverge(int(os.environ.get("RANK", "0")))


class TaughtRunner:
    """Saves the teachers of an environment's :class:`LevelTerm` in ``rsl_rl``'s checkpoints.

    Make it the first base class, before a runner of ``rsl_rl`` or mjlab:

        class Runner(prl.TaughtRunner, OnPolicyRunner): ...

    Raises:
        ArgumentError: if it comes after the runner, whose checkpoints would have no teacher.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for one in cls.__mro__[: cls.__mro__.index(TaughtRunner)]:
            if "save" in vars(one) and not issubclass(one, TaughtRunner):
                raise ArgumentError(f"{cls.__name__}: name TaughtRunner before {one.__name__}")

    @property
    def _terms(self) -> Sequence[LevelTerm]:
        env = vars(self)["env"]
        terms: Sequence[LevelTerm] = getattr(getattr(env, "unwrapped", env), "taught", ())
        return terms

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Saves a checkpoint, with the teachers' states in ``infos`` as ``teachers``."""
        parent: Any = super()
        teachers = [term.state_dict() for term in self._terms]
        parent.save(path, {**(infos or {}), "teachers": teachers})

    def load(self, path: str, *args: Any, **kwargs: Any) -> Any:
        """Loads a checkpoint, and returns its ``infos``.

        An environment without a term, in which a policy only plays, needs no teacher.

        Raises:
            ArgumentError: if the checkpoint has fewer or more teachers than there are terms.
        """
        parent: Any = super()
        infos = parent.load(path, *args, **kwargs)
        saved = (infos or {}).get("teachers", ())
        if self._terms and len(saved) != len(self._terms):
            count = len(self._terms)
            raise ArgumentError(f"path={path}: has {len(saved)} teachers for {count} LevelTerms")
        for term, state in zip(self._terms, saved, strict=False):
            term.load_state_dict(state)
        return infos
