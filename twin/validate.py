"""`twin validate`: measures the success rates of policies in a built scene, per lighting.

    twin validate scenes/demo --policy first plain my_module:act --lightings held-out night --worst --films

All policies drive the same episodes. Episodes that are in `validation/episodes.csv` are not driven again, so the same
command continues a stopped validation. `validation/validation.html` shows the results.
"""

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

from twin import commands, runtime
from twin.config import SAMPLED_LIGHTING, Condition
from twin.config_file import load_config
from twin.env.domain_randomization import condition_options, measured_parameters
from twin.env.env_factory import fingerprint
from twin.env.episode_lighting import check_lighting_names
from twin.env.route_segments import find_task
from twin.errors import InputError
from twin.evaluation.training_curves import read_test_counts, training_summaries
from twin.evaluation.trials import (
    EPISODE_COLUMNS,
    Trial,
    cells_csv,
    csv_text,
    read_trials,
    summarize,
    tally,
    trials_so_far,
    typical_episode,
    worst_episode,
)
from twin.files import (
    read_json,
    require_text,
    wrap_read_errors,
    write_bytes,
    write_json,
    write_text,
)
from twin.learn.policy import find_policy, load_policy, policy_digest
from twin.learn.policy_evaluation import CHUNK, EpisodeChunk, EpisodeResult, run_chunks, run_chunks_on_ray
from twin.loading import Twin, load_writable
from twin.report.policy_card import write_policy_cards
from twin.report.validation_report import failure_map, summary_lines, write_validation_page
from twin.runtime import exclusive_lock
from twin.scene import SceneDir

_FIRST_SEED, _PER_LIGHTING, _BLOCKS = 1_000_000_000, 1_000, 900_000  # see `lighting_seeds`
_SEARCH_SEED, _FINAL_SEED = 2_000_000, 3_000_000  # first seeds of the search for the worst lighting, and of its test
_SEARCH_LIGHTINGS, _SEARCH_EPISODES, _SEARCH_KEPT = 16, 4, 4  # first round: lightings, episodes in each, lightings kept
_MAX_PROCESSES = 1024


class Campaign:
    """Evaluation episodes of one scene and task, and the table that stores them."""

    def __init__(
        self, twin: Twin, task: str, path: Path, sources: dict[str, str], trust: bool, processes: int, ray: str | None
    ) -> None:
        """`path` is the table, `sources` are the policies' sources by name, and `ray` is the address of a Ray cluster;
        without it, this machine's worker processes are used."""
        self._scene, self.task, self.path = str(twin.scene.root.resolve()), task, path
        self._sources, self._trust, self._processes, self._ray = sources, trust, processes, ray
        self._done = {t.key: t for t in trials_so_far(path)}
        self._fresh = True

    def drive(self, wanted: Sequence[tuple[str, str, Iterable[int]]], what: str) -> list[Trial]:
        """Returns the trials of each (policy, lighting, seeds) in order; first drives those missing in the table."""
        keys = [(name, self.task, lighting, seed) for name, lighting, seeds in wanted for seed in seeds]
        chunks: list[tuple[str, EpisodeChunk]] = []
        for name, lighting, seeds in wanted:
            left = [seed for seed in seeds if (name, self.task, lighting, seed) not in self._done]
            for k in range(0, len(left), CHUNK):
                road, part = (self._scene, self.task), tuple(left[k : k + CHUNK])
                condition = Condition.parse(lighting)
                chunks.append((name, EpisodeChunk(*road, self._sources[name], self._trust, condition, part)))
        with runtime.bar(what, len(keys), "episode") as bar:
            bar.update(len(keys) - sum(len(chunk.seeds) for _, chunk in chunks))
            driven = self._run([chunk for _, chunk in chunks])
            for (name, chunk), outcomes in zip(chunks, driven, strict=True):
                drive = name, self.task, str(chunk.condition)
                trials = [
                    Trial(*drive, o.seed, o.cause, round(o.progress, 3), o.steps, round(o.trust, 4)) for o in outcomes
                ]
                self._append(trials)
                bar.update(len(trials))
        return [self._done[key] for key in keys]

    def _run(self, chunks: list[EpisodeChunk]) -> Iterator[list[EpisodeResult]]:
        if self._ray and chunks:
            return run_chunks_on_ray(chunks, self._ray)
        fresh, self._fresh = self._fresh, self._fresh and not chunks  # later rounds reuse the loaded scene and policies
        return run_chunks(chunks, self._processes, fresh)

    def _append(self, trials: Sequence[Trial]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists():
            write_text(self.path, csv_text(EPISODE_COLUMNS, []))
        with self.path.open("a", encoding="utf-8", newline="") as file:
            file.write(csv_text(EPISODE_COLUMNS, [t.row() for t in trials]).split("\n", 1)[1])
        self._done |= {t.key: t for t in trials}


def validate(
    root: Path,
    sources: Sequence[str],
    task: str,
    lightings: Sequence[str],
    episodes: int,
    worst: bool = False,
    trust: bool = False,
    processes: int = 1,
    ray: str | None = None,
    films: bool = False,
) -> dict:
    """Drives missing episodes and writes `validation/`; returns the contents of its `summary.json`.

    Raises:
        InputError: the policy, scene, task or lighting is unknown; the tables are of another build, or of other
            policies with the same names; an episode ends differently when it is filmed; or another process is writing
            the same tables.
    """
    twin = load_writable(root)
    folder = twin.scene.validation
    policies = _named(root, sources, trust)
    lightings = tuple(dict.fromkeys(lightings))
    check_lighting_names([Condition.parse(one).lighting for one in lightings], twin.field())
    with exclusive_lock(folder.with_name(".validation.lock"), f"policies are being driven for {folder}"):
        _drop_partial_row(folder / "episodes.csv")
        _drop_partial_row(folder / "worst.csv")
        _check_same(folder, twin, task, (*lightings, *([SAMPLED_LIGHTING] if worst else [])), policies)
        how = policies, trust, processes, ray
        todo = Campaign(twin, task, folder / "episodes.csv", *how)
        wanted = [(name, one, lighting_seeds(one, episodes)) for name in policies for one in lightings]
        driven = todo.drive(wanted, "validate")
        if worst:
            searched = Campaign(twin, task, folder / "worst.csv", *how)
            for name in policies:
                _search_worst_lighting(searched, name, episodes)
        results = _write_results(twin)
        if films:
            for name, source in policies.items():
                _write_films(root, folder, source, trust, [t for t in driven if t.policy == name])
            results = _write_results(twin)
        return results


def _write_results(twin: Twin) -> dict:
    """Writes `cells.csv`, `summary.json`, maps, the page and policy cards from the tables; returns the summary."""
    folder, trials = twin.scene.validation, read_trials(twin.scene.episodes_csv)
    write_text(twin.scene.cells_csv, cells_csv(tally(trials)))
    results = summarize(trials)
    results["training"] = training_summaries(twin.scene.root, dict.fromkeys(t.policy for t in trials))
    results["worst"] = _worst_lightings(folder / "worst.csv")
    results["robot_known"] = measured_parameters(twin.world().robot)
    results["films"] = _read_films(folder)
    write_json(folder / "summary.json", results)
    _draw_maps(twin, folder, trials)
    runs = dict.fromkeys(trained["run"] for trained in results["training"].values())
    curves = [(run, read_test_counts(twin.scene.root / "runs" / run)) for run in runs]
    write_validation_page(twin.scene, results, curves)
    write_policy_cards(twin.scene, [t.policy for t in trials])
    return results


def _worst_lightings(path: Path) -> list[dict]:
    """Results of the final episodes, in the worst lighting found: one cell per policy and task with a search."""
    trials = trials_so_far(path)
    cells = summarize([t for t in trials if t.seed >= _FINAL_SEED])["cells"]
    return [
        c | {"of": len({t.lighting for t in trials if (t.policy, t.task) == (c["policy"], c["task"])})} for c in cells
    ]


def _write_films(root: Path, folder: Path, source: str, trust: bool, trials: Sequence[Trial]) -> None:
    """Films the typical and the worst of a policy's episodes on a task; existing films are kept."""
    # Worker processes import this module, and need no films.
    from twin.film import film, film_name
    from twin.report.video_writer import last_frame_jpeg

    before = _read_films(folder)
    chosen: dict[Trial, list[str]] = {}
    for kind, trial in (("typical", typical_episode(trials)), ("worst", worst_episode(trials))):
        chosen.setdefault(trial, []).append(kind)
    mine = []
    for trial, which in chosen.items():
        path = folder / "films" / trial.policy / film_name(trial.task, trial.lighting, trial.seed)
        poster = path.with_suffix(".jpg")
        if not (path.exists() and poster.exists()):
            episode = film(
                root, trial.task, source, trial.seed, path, trust, **condition_options(Condition.parse(trial.lighting))
            )[1]
            if (episode.cause, len(episode.times) - 1) != (trial.cause, trial.steps):
                path.unlink()
                raise InputError(
                    f"{trial.policy}, {trial.task}, {trial.lighting}, seed {trial.seed}: driven again for its film, it "
                    f"ends by {episode.cause} after {len(episode.times) - 1} steps; expected {trial.cause} after "
                    f"{trial.steps}, as in {folder / 'episodes.csv'}: the policy's code changed, or another kind of "
                    f"machine drove it; move {folder} away to validate again"
                )
            write_bytes(poster, last_frame_jpeg(path))
        entry = {"policy": trial.policy, "task": trial.task, "lighting": trial.lighting, "seed": trial.seed}
        entry |= {"which": which, "cause": trial.cause, "progress_m": trial.progress, "of": len(trials)}
        files = {"file": path.relative_to(folder).as_posix(), "poster": poster.relative_to(folder).as_posix()}
        mine.append(entry | files)
    key = trials[0].policy, trials[0].task
    write_json(folder / "films" / "films.json", [one for one in before if (one["policy"], one["task"]) != key] + mine)


def _read_films(folder: Path) -> list[dict]:
    """The entries of `films.json` whose films were not deleted. Raises InputError for an invalid file."""
    path = folder / "films" / "films.json"
    if not path.exists():
        return []
    with wrap_read_errors(path, "delete it, and the films are recorded again"):
        films = [dict(one) for one in read_json(path)]
        for one in films:
            _ = [one[name] + "" for name in ("policy", "task", "lighting", "cause", "file", "poster")]
            _ = int(one["seed"]), int(one["of"]), float(one["progress_m"]), [name + "" for name in one["which"]]
        return [one for one in films if all((folder / one[name]).is_file() for name in ("file", "poster"))]


def lighting_seeds(lighting: str, episodes: int) -> range:
    """Seeds of a lighting's episodes, the same for every policy and different for every lighting.

    A seed also determines start, robot, weather and distractor objects. So episodes of several lightings with the same
    seed would be correlated, and a confidence interval over these lightings would be too narrow.
    """
    first = _FIRST_SEED + _PER_LIGHTING * (crc32(lighting.encode()) % _BLOCKS)
    return range(first, first + episodes)


def _search_worst_lighting(search: Campaign, policy: str, episodes: int) -> None:
    """Searches sampled lightings for a policy's worst one, and evaluates the policy there in new episodes.

    After each round, the lightings with the worst scores are kept and driven in twice as many further episodes.
    """
    seeds = range(_SEARCH_SEED, _SEARCH_SEED + _SEARCH_EPISODES)
    candidates = [f"{SAMPLED_LIGHTING}{k}" for k in range(_SEARCH_LIGHTINGS)]
    trials_by_lighting: dict[str, list[Trial]] = {name: [] for name in candidates}
    while len(candidates) > 1:
        wanted = [(policy, name, seeds) for name in candidates]
        trials = search.drive(wanted, f"search, worst of {len(candidates)} lightings")
        for trial in trials:
            trials_by_lighting[trial.lighting].append(trial)
        kept = _SEARCH_KEPT if len(candidates) > _SEARCH_KEPT else 1
        candidates = sorted(candidates, key=lambda name: _score(trials_by_lighting[name]))[:kept]
        seeds = range(seeds.stop, seeds.stop + 2 * len(seeds))
    # The minimum of many noisy scores is biased, so the lighting found is evaluated in independent episodes.
    final = range(_FINAL_SEED, _FINAL_SEED + episodes)
    search.drive([(policy, candidates[0], final)], f"test in {candidates[0]}")


def _score(trials: Sequence[Trial]) -> tuple[float, float]:
    return sum(t.success for t in trials) / len(trials), sum(t.progress for t in trials) / len(trials)


def _named(root: Path, sources: Sequence[str], trust: bool) -> dict[str, str]:
    """Maps the policies' names in tables to their sources; loads each policy once, to report errors early."""
    out: dict[str, str] = {}
    for source in sources:
        where = find_policy(root, source)
        name = load_policy(where, trust).name
        if out.setdefault(name, where) != where:
            raise InputError(f"two policies are named {name!r}: {out[name]} and {where}; rename one")
    return out


def _check_same(folder: Path, twin: Twin, task: str, lightings: Sequence[str], policies: dict[str, str]) -> None:
    """Records digests of policies and of roads (a task under a lighting).

    Raises InputError if any policy or road that is in the tables has changed.
    """
    path = folder / "validated.json"
    recorded: dict[str, Any] = {"roads": {}, "policies": {}, "sources": {}}
    before: dict[str, Path] = {}
    if path.exists():
        with wrap_read_errors(path, f"move {folder} away to validate again"):
            stored = dict(read_json(path))
            recorded |= {name: dict(stored[name]) for name in recorded if name in stored}
            before = {name: twin.scene.root / require_text(one) for name, one in recorded["sources"].items()}
    trials = [*trials_so_far(folder / "episodes.csv"), *trials_so_far(folder / "worst.csv")]
    driven = {_road(t.task, t.lighting): (t.task, t.lighting) for t in trials}
    for road, (of, lighting) in (driven | {_road(task, one): (task, one) for one in lightings}).items():
        try:
            digest = fingerprint(twin, of, Condition.parse(lighting))
        except InputError as error:
            if road not in driven:
                raise
            raise InputError(f"{folder} has episodes of {of} ({error}); move it away to validate again") from None
        if road in driven and recorded["roads"].get(road) != digest:
            raise InputError(
                f"{folder} has episodes of {of} under {lighting} that were driven before the scene, task, obstacles, "
                "photo or twin's sampling of episodes changed; move it away to validate again"
            )
        recorded["roads"][road] = digest
    driven_by = {t.policy for t in trials}
    others = {name: str(one) for name, one in before.items() if name not in policies and one.exists()}
    for name, source in (others | policies).items():
        digest = policy_digest(source)
        if name in driven_by and recorded["policies"].get(name) != digest:
            instead = ", or copy the policy to another name" if name in policies else " to validate again"
            raise InputError(
                f"policy {name!r}: {source} is not the file that was validated under this name; move {folder} away"
                + instead
            )
        recorded["policies"][name] = digest
    root = twin.scene.root.resolve()
    inside = {name: Path(one) for name, one in policies.items() if Path(one).is_relative_to(root)}
    recorded["sources"] |= {name: path.relative_to(root).as_posix() for name, path in inside.items()}
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, recorded)


def _road(task: str, lighting: str) -> str:
    """Key of a task under a lighting; all sampled lightings have the same key, since they come from the same field."""
    return f"{task}, {'drawn' if lighting.startswith(SAMPLED_LIGHTING) else lighting}"


def _draw_maps(twin: Twin, folder: Path, trials: Sequence[Trial]) -> None:
    world, config = twin.world(), load_config(twin.scene.config_file)
    for task in dict.fromkeys(t.task for t in trials):
        segment = find_task(task, world, config.task)
        mine = [t for t in trials if t.task == task]
        failure_map(folder / f"failures_{task}.png", mine, world.along(segment.route), (segment.start, segment.end))


def _drop_partial_row(path: Path) -> None:
    """Removes an incomplete last line, which a killed process may leave."""
    if path.exists():
        blob = path.read_bytes()
        if not blob.endswith(b"\n"):
            whole = blob[: blob.rfind(b"\n") + 1]
            os.truncate(path, len(whole)) if whole else path.unlink()  # a kill here must not lose the rows


def command(given: argparse.Namespace) -> None:
    """Runs `twin validate` with the options parsed by `twin.commands`."""
    for name, most in (("episodes", _PER_LIGHTING), ("processes", _MAX_PROCESSES)):
        if not 1 <= getattr(given, name) <= most:
            raise InputError(f"--{name} {getattr(given, name)}; expected 1 to {most}")
    how = (given.worst, given.trust, given.processes, given.ray, given.films)
    results = validate(given.scene, given.policy, given.task, given.lightings, given.episodes, *how)
    if not given.quiet:
        print("\n".join(summary_lines(results)))
        print(f"look at {SceneDir(given.scene).validation / 'validation.html'}")


if __name__ == "__main__":
    sys.exit(commands.main("validate"))
