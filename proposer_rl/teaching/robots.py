"""A teacher's levels in curriculum managers of Isaac Lab and mjlab, and in rsl_rl's checkpoints."""

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
    """A term of a curriculum manager: asks a teacher for the levels of environments that reset.

    Subclass it, and for Isaac Lab also ``ManagerTermBase``, to say what levels there are, how an
    episode went and how an environment plays a level; then name the class in the config:

        class Terrain(prl.LevelTerm, ManagerTermBase):
            def make_teacher(self): return prl.Teacher("adr", space, device=self.env.device)
            def results(self, env_ids): return walked, walked > 4.0
            def set_levels(self, env_ids, levels): ...

        cfg.curriculum["terrain"] = CurriculumTermCfg(func=Terrain)

    Results count of episodes that ended by themselves and were played from their first step. Two
    kinds are dropped: episodes that another reset cuts off, and those whose length the runner has
    changed on the way, as ``learn(init_at_random_ep_len=True)`` does with the first of each
    environment. These are dropped however they end: of those that are cut short, only failures
    would be left to count.

    In a launch of several processes each draws levels of its own (``RANK`` says which it is). The
    manager logs the mean of each parameter over the levels that are played.

    Args:
        cfg: of the term.
        env: with ``num_envs``, ``device``, ``common_step_counter``, ``episode_length_buf`` and,
            from the first step on, ``reset_buf``, bool [num_envs]. The term adds itself to the
            environment's list ``taught``, which :class:`TaughtRunner` reads.

    Attributes:
        env, teacher: as given and made.
        tickets: of the levels that are played, int64 [num_envs].
    """

    def __init__(self, cfg: Any, env: Any) -> None:
        self.cfg, self.env, self._env = cfg, env, env  # ManagerTermBase reads _env
        self.teacher = self.make_teacher()
        self.teacher.diverge(_rank())
        self.tickets = torch.full((env.num_envs,), NONE, device=env.device)
        self._begun = torch.zeros_like(self.tickets)  # common_step_counter when they were asked for
        self._levels: Any = None
        env.taught = [*getattr(env, "taught", ()), self]

    @abstractmethod
    def make_teacher(self) -> Teacher:
        """Returns the teacher, of one student."""

    @abstractmethod
    def results(self, env_ids: Tensor) -> tuple[Any, Any]:
        """Returns return and success of the episodes that have ended, [n] each.

        Success may be None, where the curriculum reads none.
        """

    @abstractmethod
    def set_levels(self, env_ids: Tensor, levels: Any) -> None:
        """Makes environments int64 [n] play levels [n] from this reset on."""

    def reset(self, env_ids: Any = None) -> None:
        """Does nothing: a manager calls it after the term itself."""

    def __call__(self, env: Any, env_ids: Any) -> dict[str, Tensor]:
        """Tells the teacher how episodes went, and sets the next levels of their environments.

        Args:
            env: the environment.
            env_ids: numbers, a mask or a slice; None for all.
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
        return _means(self._levels[self.tickets != NONE])

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the teacher."""
        return self.teacher.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Loads a teacher's state; results of the levels that are played now do not count.

        Only one process saves, and all load what it saved: each goes on with draws of its own.
        """
        self.teacher.drop()
        self.tickets.fill_(NONE)
        self.teacher.load_state_dict(state)
        self.teacher.drop()  # what the environments that saved it played
        self.teacher.diverge(_rank())


class TaughtRunner:
    """Keeps the teachers of an environment's :class:`LevelTerm` in the checkpoints of ``rsl_rl``.

    Name it before the runner, of ``rsl_rl`` or mjlab:

        class Runner(prl.TaughtRunner, OnPolicyRunner): ...

    Raises:
        ArgumentError: if it is named after the runner, whose checkpoints would have no teacher.
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
        """Saves a checkpoint, whose ``infos`` have the teachers' states as ``teachers``."""
        parent: Any = super()
        teachers = [term.state_dict() for term in self._terms]
        parent.save(path, {**(infos or {}), "teachers": teachers})

    def load(self, path: str, *args: Any, **kwargs: Any) -> Any:
        """Loads one, and returns its ``infos``.

        An environment without a term, in which a policy only plays, needs no teacher.

        Raises:
            ArgumentError: if the checkpoint has not one teacher for each term.
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


def _rank() -> int:
    return int(os.environ.get("RANK", "0"))


def _means(levels: Any) -> dict[str, Tensor]:
    """Returns the mean of each parameter of levels [n]."""
    named = levels.items() if is_tensor_collection(levels) else [("level", levels)]
    return {str(name): entry.float().mean() for name, entry in named}
