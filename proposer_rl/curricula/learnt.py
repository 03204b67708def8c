"""What a Proposer has learnt, put aside and taken up again by another run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tensordict import TensorDict

from proposer_rl.learning import agent_weights, load_agent
from proposer_rl.models import ActorCritic
from proposer_rl.runs.checkpoint import CheckpointError, State, load_checkpoint, load_latest
from proposer_rl.runs.folder import PROPOSER
from proposer_rl.settings import ArgumentError


def learnt_proposer(agent: ActorCritic) -> dict[str, Any]:
    """A Proposer's weights and what it observes, as its curriculum's state has them."""
    return {"proposer": agent_weights(agent).to_dict(), "observed": agent.in_keys}


def load_proposer(agent: ActorCritic, checkpoint: str, observes: Sequence[str]) -> None:
    """Give a Proposer the weights of one that has learnt with the same network.

    Args:
        agent: the Proposer.
        checkpoint: of a run, its ``proposer.pt``, or its folder.
        observes: what the Proposer observes beside the probes.

    Raises:
        ArgumentError: if the checkpoint holds no such Proposer, or cannot be read.
    """
    try:
        learnt = _with_proposer(_curriculum_state(Path(checkpoint)))
        observed = [name for name in learnt["observed"] if name != "probes"]
        load_agent(agent, TensorDict(learnt["proposer"]))
    except CheckpointError as error:
        raise ArgumentError(f"checkpoint={checkpoint}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ArgumentError(
            f"checkpoint={checkpoint}: holds no Proposer with the network of these settings"
        ) from error
    if observed != list(observes):
        raise ArgumentError(
            f"checkpoint={checkpoint}: its Proposer has learnt with observes={observed}, not "
            f"{list(observes)}"
        )


def _with_proposer(state: State) -> State:
    """The state of the part that has a Proposer, where curricula hold others, as filtering does."""
    inner = (_with_proposer(part) for part in reversed(state.get("parts", [])))
    return state if "proposer" in state else next(filter(None, inner), {})


def _curriculum_state(path: Path) -> State:
    """The curriculum's part of a checkpoint, or of a run's newest one, or what it left of it."""
    if not path.exists():
        raise CheckpointError("there is no such file or folder")
    latest = load_latest(path / "checkpoints") if path.is_dir() else load_checkpoint(path)
    if latest is None and (path / PROPOSER).exists():
        latest = load_checkpoint(path / PROPOSER)
    if latest is None:
        raise CheckpointError(f"the folder holds no checkpoints and no {PROPOSER}")
    state: State = latest[1]["curriculum"]
    return state
