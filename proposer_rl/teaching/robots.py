"""A teacher's levels in curriculum managers of Isaac Lab and mjlab, and in rsl_rl's checkpoints."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import is_tensor_collection
from torch import Tensor

from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.teacher import Teacher

NONE = -1  # the ticket of no level


class LevelTerm:
    """A term of a curriculum manager: asks a teacher for the levels of environments that reset.

    A class of one's own, which Isaac Lab wants to be a ``ManagerTermBase``, too, says what levels
    there are, what came of them and how they are played; the config names it:

        class Terrain(prl.LevelTerm, ManagerTermBase):
            def make_teacher(self): return prl.Teacher("adr", space, device=self.env.device)
            def results(self, env_ids): return walked, walked > 4.0
            def set_levels(self, env_ids, levels): ...

        cfg.curriculum["terrain"] = CurriculumTermCfg(func=Terrain)

    An episode counts if it has ended by itself; one that another reset cuts off is dropped. The
    manager logs the mean of each parameter over what the environments play.

    Args:
        cfg: of the term.
        env: with ``num_envs``, ``device``, ``episode_length_buf`` and, from the first step on,
            ``reset_buf``, bool [num_envs]. Its ``taught`` becomes the term.

    Attributes:
        env, teacher: as given and made.
        tickets: of what is played, int64 [num_envs].
    """

    def __init__(self, cfg: Any, env: Any) -> None:
        self.cfg, self.env, self._env = cfg, env, env  # ManagerTermBase reads _env
        self.teacher = self.make_teacher()
        self.tickets = torch.full((env.num_envs,), NONE, device=env.device)
        self._levels: Any = None
        if hasattr(env, "taught"):
            warnings.warn(
                "env.taught: was another term, whose teacher checkpoints leave out now; one "
                "teacher may have the parameters of both",
                stacklevel=2,
            )
        env.taught = self

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
        """Tells what came of environments, and sets their next levels.

        Args:
            env: the environment.
            env_ids: numbers, a mask or a slice; None for all.
        """
        ids = torch.arange(env.num_envs, device=env.device)[env_ids].reshape(-1)
        once, counts = ids.unique(return_counts=True)
        if len(once) < len(ids):
            raise ArgumentError(f"env_ids={int(once[counts > 1][0])}: is there more than once")
        tickets = self.tickets[ids]
        known = tickets != NONE
        counts_for = known & (env.episode_length_buf[ids] > 0)
        if counts_for.any():
            counts_for &= env.reset_buf[ids].bool()
            if counts_for.any():
                self.teacher.tell(tickets[counts_for], *self.results(ids[counts_for]))
        cut_off = tickets[known & ~counts_for]
        if len(cut_off):
            self.teacher.drop(cut_off)
        asked, levels = self.teacher.ask(len(ids))
        self.tickets[ids], levels = asked.to(env.device), levels.to(env.device)
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
        """Puts it back; what is played now counts for nothing."""
        self.teacher.drop()
        self.tickets.fill_(NONE)
        self.teacher.load_state_dict(state)
        self.teacher.drop()  # what others played


class TaughtRunner:
    """Keeps the teacher of an environment's :class:`LevelTerm` in the checkpoints of ``rsl_rl``.

    To be named before the runner, of ``rsl_rl`` or mjlab:

        class Runner(prl.TaughtRunner, OnPolicyRunner): ...

    Raises:
        ArgumentError: if it is named after one, which would then save no teacher.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for one in cls.__mro__[: cls.__mro__.index(TaughtRunner)]:
            if "save" in vars(one) and not issubclass(one, TaughtRunner):
                raise ArgumentError(f"{cls.__name__}: name TaughtRunner before {one.__name__}")

    @property
    def _term(self) -> LevelTerm | None:
        env = vars(self)["env"]
        term: LevelTerm | None = getattr(getattr(env, "unwrapped", env), "taught", None)
        return term

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Saves a checkpoint, whose ``infos`` have the teacher's state as ``teacher``.

        Raises:
            ArgumentError: if the environment has no term.
        """
        if self._term is None:
            raise ArgumentError("env: has no LevelTerm; name one in the config of its curriculum")
        parent: Any = super()
        parent.save(path, {**(infos or {}), "teacher": self._term.state_dict()})

    def load(self, path: str, *args: Any, **kwargs: Any) -> Any:
        """Loads one, and returns its ``infos``.

        An environment without a term, in which a policy is but played, needs no teacher.

        Raises:
            ArgumentError: if there is a term, and no teacher in the checkpoint.
        """
        parent: Any = super()
        infos = parent.load(path, *args, **kwargs)
        if self._term is None:
            return infos
        if "teacher" not in (infos or {}):
            raise ArgumentError(f"path={path}: has no teacher; another runner has saved it")
        self._term.load_state_dict(infos["teacher"])
        return infos


def _means(levels: Any) -> dict[str, Tensor]:
    """Returns the mean of each parameter of levels [n]."""
    named = levels.items() if is_tensor_collection(levels) else [("level", levels)]
    return {str(name): entry.float().mean() for name, entry in named}
