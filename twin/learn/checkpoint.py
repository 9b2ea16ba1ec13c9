"""Saved states of a training: everything that SAC holds, in files that run no code when they are loaded.

`state.json` is written last and names the complete folder `state_<steps>`, so a training that is killed at any time
leaves one complete state. Tensors are safetensors, the rest of the replay buffer is npz, everything else JSON.
"""

import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from safetensors.torch import save as tensor_bytes

from twin.files import (
    load_arrays,
    read_json,
    regular_file,
    remove,
    save_arrays,
    wrap_read_errors,
    write_bytes,
    write_json,
)
from twin.learn.replay_buffer import FrameReplayBuffer
from twin.learn.sac import PixelSAC

_JSON, _TENSORS, _REPLAY = "state.json", "tensors.safetensors", "replay.npz"


def save_state(folder: Path, model: PixelSAC, more: dict[str, Any]) -> None:
    """Writes a state, and then removes the previous one.

    Args:
        model: With a `FrameReplayBuffer`.
        more: JSON-able values that `load_state` returns.

    Raises:
        OSError: the disk is full; the previous state is intact.
    """
    assert isinstance(model.replay_buffer, FrameReplayBuffer)
    name = f"state_{model.num_timesteps:09d}"
    remove(folder / name)
    (folder / name).mkdir(parents=True)
    try:
        write_bytes(folder / name / _TENSORS, tensor_bytes(_tensors(model)))
        arrays, replay = model.replay_buffer.state()
        save_arrays(folder / name / _REPLAY, arrays)
    except OSError:  # the disk is full: make room for the error's log
        remove(folder / name)
        raise
    counts = {"steps": model.num_timesteps, "updates": model._n_updates, "episodes": model._episode_num}
    rng = {"action_space": model.action_space.np_random.bit_generator.state}
    write_json(folder / _JSON, {"folder": name, **counts, "replay": replay, "rng": rng, "more": more})
    for old in folder.glob("state_*"):
        if old.name != name:
            shutil.rmtree(old)


def has_state(folder: Path) -> bool:
    return (folder / _JSON).exists()


def saved_steps(folder: Path) -> int:
    """Control steps of the saved state."""
    with wrap_read_errors(folder / _JSON, "train anew under another name"):
        return int(read_json(folder / _JSON)["steps"])


def load_state(folder: Path, model: PixelSAC) -> dict[str, Any]:
    """Restores the saved state in a new model; returns `more`.

    Raises InputError: files are missing, damaged, or of another network.
    """
    assert isinstance(model.replay_buffer, FrameReplayBuffer)
    with wrap_read_errors(folder, "train anew under another name"):
        head = read_json(folder / _JSON)
        state = folder / Path(head["folder"]).name
        tensors = load_file(regular_file(state / _TENSORS))
        model.replay_buffer.set_state(load_arrays(state / _REPLAY), head["replay"])
        _set_tensors(model, tensors)
        int(head["steps"]), int(head["updates"]), int(head["episodes"]), dict(head["more"])
        model.action_space.np_random.bit_generator.state = head["rng"]["action_space"]
    model.num_timesteps, model._n_updates, model._episode_num = head["steps"], head["updates"], head["episodes"]
    return head["more"]


def _optimizers(model: PixelSAC) -> dict[str, torch.optim.Optimizer]:
    assert model.ent_coef_optimizer is not None
    return {"actor": model.actor.optimizer, "critic": model.critic.optimizer, "entropy": model.ent_coef_optimizer}


def _modules(model: PixelSAC) -> dict[str, torch.nn.Module]:
    return {"policy": model.policy, "steady": model.averaged_actor, "teller": model.state_head}


def _tensors(model: PixelSAC) -> dict[str, torch.Tensor]:
    assert model.log_ent_coef is not None
    out = {"log_ent_coef": model.log_ent_coef.detach(), "rng": torch.get_rng_state()}
    for name, module in _modules(model).items():
        out |= {f"{name}.{key}": value for key, value in module.state_dict().items()}
    for name, optimizer in _optimizers(model).items():
        for i, values in optimizer.state_dict()["state"].items():
            out |= {f"optimizer.{name}.{i}.{key}": value for key, value in values.items()}
    if torch.cuda.is_available():
        out["rng.cuda"] = torch.cuda.get_rng_state()
    # Copies, since the shared encoder has several names and safetensors does not store shared tensors.
    return {name: value.detach().cpu().clone().contiguous() for name, value in out.items()}


def _set_tensors(model: PixelSAC, tensors: dict[str, torch.Tensor]) -> None:
    assert model.log_ent_coef is not None
    for name, module in _modules(model).items():
        own = {n.removeprefix(f"{name}."): value for n, value in tensors.items() if n.startswith(f"{name}.")}
        module.load_state_dict(own)
    with torch.no_grad():
        model.log_ent_coef.copy_(tensors["log_ent_coef"])
    for name, optimizer in _optimizers(model).items():
        state: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"optimizer.{name}."):
                i, field = key.removeprefix(f"optimizer.{name}.").split(".")
                state.setdefault(int(i), {})[field] = value
        optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
    torch.set_rng_state(tensors["rng"])
    if "rng.cuda" in tensors and torch.cuda.is_available():
        torch.cuda.set_rng_state(tensors["rng.cuda"])
