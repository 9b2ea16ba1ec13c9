"""Shows a training as a run of Weights & Biases (wandb.ai), if the package `wandb` is installed.

The run gets the training's configuration, and curves over its steps: those of `episodes.csv`, `log.csv` and
`tests.json` as `episodes/...`, `log/...` and `tests/...`. At the end, it gets the plot of the success rate and a film
of the selected policy. A resumed training continues its run. wandb's own environment variables apply: with
`WANDB_MODE=offline`, the run is only written to `runs/<name>/wandb`.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.logger import KVWriter

from twin.errors import InputError
from twin.files import read_json, wrap_read_errors, write_json
from twin.learn.distillation import has_state

if TYPE_CHECKING:
    import wandb

ID_FILE = "wandb.json"
"""File in the training's folder with project and id of its run of Weights & Biases, by which the run is continued."""

_STEP = "step"


class WandbRun(KVWriter):
    """Writes to a run of Weights & Biases; can be used as an output of stable-baselines3's logger."""

    def __init__(self, run: "wandb.Run") -> None:
        self._run = run
        # Steps are logged as their own metric. wandb's built-in steps must not decrease, but a training's steps do when
        # it was killed and continues from its last saved state.
        run.define_metric(_STEP)
        run.define_metric("*", step_metric=_STEP)

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Logs those values that are numbers."""
        numbers = {
            name: value.item() if isinstance(value, np.generic) else value
            for name, value in key_values.items()
            if isinstance(value, int | float | np.number) and "wandb" not in (key_excluded.get(name) or ())
        }
        self._run.log(numbers | {_STEP: step})

    def close(self) -> None:
        """Does nothing: `wandb_run` closes the run."""

    def show(self, step: int, curve: Path, film: Path, caption: str) -> None:
        """Logs the plot of the success rate (.png), and a film (.mp4) with its caption."""
        import wandb

        video = wandb.Video(str(film), caption=caption, format="mp4")
        self._run.log({"success": wandb.Image(str(curve)), "film": video, _STEP: step})


@contextmanager
def wandb_run(project: str, folder: Path, config: Mapping[str, Any]) -> Iterator[WandbRun]:
    """Opens the run of the training in `folder`, and closes it at the end; an exception marks it as failed.

    Args:
        project: Name of the project, or `entity/project`.
        folder: The training's folder, in which a folder `wandb` and the file `ID_FILE` are created.

    Raises:
        InputError: wandb is not installed, or it reports an error, for example that nobody is logged in.
    """
    try:
        import wandb
    except ImportError:
        raise InputError("--wandb needs the package wandb: pip install 'twin[wandb]'") from None
    entity, _, name = project.rpartition("/")
    try:
        run = wandb.init(
            entity=entity or None,
            project=name,
            name=folder.name,
            id=_earlier_id(folder, project),
            resume="allow",
            dir=str(folder),
            config=dict(config),
            settings=wandb.Settings(console="off"),  # otherwise wandb captures the progress bar
        )
    except wandb.Error as error:
        cure = "run wandb login, or set WANDB_MODE=offline"
        raise InputError(f"--wandb {project}: {' '.join(str(error).split())}; {cure}") from None
    with run:
        write_json(folder / ID_FILE, {"project": project, "id": run.id})
        yield WandbRun(run)


def _earlier_id(folder: Path, project: str) -> str | None:
    """Id of the run that a saved training continues; None: there is none, so a new run begins."""
    path = folder / ID_FILE
    if not path.exists() or not has_state(folder / "state"):
        return None
    with wrap_read_errors(path, "delete it; a new run of Weights & Biases then begins"):
        before = read_json(path)
        return str(before["id"]) if before["project"] == project else None
