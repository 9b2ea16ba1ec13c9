"""Verb: how often policies succeed in a built scene, lighting by lighting.

    python -m twin.validate scenes/demo --task straight --policy scenes/demo/runs/first --episodes 100
    python -m twin.validate scenes/demo --policy first plain my_module:act --lightings held-out night --worst --films

A policy is a run (its name or folder), a checkpoint of one, an ONNX file or `module:function`. All drive the same
episodes. What is in `validation/episodes.csv` already is not driven again, so a validation that was stopped goes on.
`validation/validation.html` shows it all.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

from twin import cli, runtime
from twin.config import HELD_OUT, RANDOMISED
from twin.env.domain_randomization import asked, known_of
from twin.env.suite import fingerprint
from twin.errors import InputError
from twin.evaluation.training_curves import read_episodes, trainings
from twin.evaluation.trials import EPISODE_COLUMNS, Trial, cells_text, csv_text, read_trials, tally
from twin.files import damaged, digest_file, digest_json, read_json, write_bytes, write_json, write_text
from twin.learn.policy import JSON, find_policy, load_policy
from twin.learn.policy_evaluation import CHUNK, EpisodeChunk, EpisodeResult, campaign
from twin.loading import Twin, load_scene
from twin.report.validation_report import Curve, write_validation_page
from twin.report.validation_summary import failure_map, lines, summary, typical_episode, worst_episode
from twin.runtime import alone
from twin.scene import SceneDir

DEFAULT_LIGHTINGS = (HELD_OUT, HELD_OUT + RANDOMISED)
"""As the place was filmed but for its light; and nearer to what a road does."""

_FIRST_SEED, _PER_LIGHTING, _BLOCKS = 1_000_000_000, 1_000, 900_000  # of validation; see `seeds_of`
_SEARCH_SEED, _PROOF_SEED = 2_000_000, 3_000_000  # of the search for the worst light, and of the proof that it is bad
_MOST_PROCESSES = 1024
_LIGHTS, _LOOKS, _FINALISTS = 16, 4, 4  # lights drawn, episodes in each, and how many are looked at more closely

Key = tuple[str, str, str, int]


class Campaign:
    """Episodes driven and to be driven of one scene and task, and the table they go to."""

    def __init__(
        self,
        twin: Twin,
        task: str,
        path: Path,
        policies: dict[str, tuple[str, bool]],
        processes: int,
        ray: str | None = None,
    ) -> None:
        """
        Args:
            twin: A built scene.
            task: See `twin.load`.
            path: The table.
            policies: Source and trust by name.
            processes: How many drive here.
            ray: Address of a Ray cluster that drives instead.
        """
        self._scene, self.task, self.path, self._policies = str(twin.scene.root.resolve()), task, path, policies
        self._processes, self._ray = processes, ray
        self._done = {_key(t): t for t in read_trials(path)} if path.exists() and _has_rows(path) else {}

    def drive(self, wanted: Sequence[tuple[str, str, Iterable[int]]], what: str) -> list[Trial]:
        """Trials of (policy, lighting, seeds), in that order; what is not in the table yet is driven and added."""
        keys = [(name, self.task, lighting, seed) for name, lighting, seeds in wanted for seed in seeds]
        chunks: list[tuple[str, EpisodeChunk]] = []
        for name, lighting, seeds in wanted:
            left = [seed for seed in seeds if (name, self.task, lighting, seed) not in self._done]
            for k in range(0, len(left), CHUNK):
                source, trust = self._policies[name]
                chunk = EpisodeChunk(self._scene, self.task, source, trust, lighting, tuple(left[k : k + CHUNK]))
                chunks.append((name, chunk))
        with runtime.bar(what, len(keys), "episode") as bar:
            bar.update(len(keys) - sum(len(chunk.seeds) for _, chunk in chunks))
            driven = self._campaign([chunk for _, chunk in chunks])
            for (name, chunk), outcomes in zip(chunks, driven, strict=True):
                trials = [
                    Trial(
                        name,
                        self.task,
                        chunk.lighting,
                        o.seed,
                        o.cause,
                        round(o.progress, 3),
                        o.steps,
                        round(o.trust, 4),
                    )
                    for o in outcomes
                ]
                self._append(trials)
                bar.update(len(trials))
        return [self._done[key] for key in keys]

    def _campaign(self, chunks: list[EpisodeChunk]) -> Iterator[list[EpisodeResult]]:
        if self._ray and chunks:
            from twin.learn.policy_evaluation import campaign_on_ray

            return campaign_on_ray(chunks, self._ray)
        return campaign(chunks, self._processes)

    def _append(self, trials: Sequence[Trial]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists():
            write_text(self.path, csv_text(EPISODE_COLUMNS, []))
        with self.path.open("a", encoding="utf-8", newline="") as file:
            file.write(csv_text(EPISODE_COLUMNS, [t.row() for t in trials]).split("\n", 1)[1])
        self._done |= {_key(t): t for t in trials}


def validate(
    root: Path,
    sources: Sequence[str],
    task: str = "straight",
    lightings: Sequence[str] = DEFAULT_LIGHTINGS,
    episodes: int = 100,
    worst: bool = False,
    trust: bool = False,
    processes: int = 1,
    ray: str | None = None,
    films: bool = False,
) -> dict:
    """Drives what is missing and writes `validation/`; returns what is in its `summary.json`.

    Raises:
        InputError: a policy, the scene, the task or a lighting is not to be had; or names of other policies or another
            build are in the table; or an episode of the table ends otherwise when it is driven again to be filmed;
            or another process is at it.
    """
    twin = load_scene(root)
    folder = twin.scene.validation
    policies = _policies(root, sources, trust)
    lightings = tuple(dict.fromkeys(lightings))
    with alone(folder.with_name(".validation.lock"), f"policies are being driven for {folder}"):
        _mend(folder / "episodes.csv")
        _mend(folder / "worst.csv")
        _check_same(folder, twin, task, (*lightings, *(["drawn_"] if worst else [])), policies)
        todo = Campaign(twin, task, folder / "episodes.csv", policies, processes, ray)
        wanted = [(name, one, seeds_of(one, episodes)) for name in policies for one in lightings]
        driven = todo.drive(wanted, "validate")
        if worst:
            searched = Campaign(twin, task, folder / "worst.csv", policies, processes, ray)
            for name in policies:
                _search(searched, name, episodes)
        said = _write(twin)
        if films:
            for name, (source, _) in policies.items():
                _film(root, folder, source, trust, [t for t in driven if t.policy == name])
            said = _write(twin)
        return said


def _write(twin: Twin) -> dict:
    """Tells what is in the tables: `cells.csv`, `summary.json`, maps and page; returns the summary."""
    folder, trials = twin.scene.validation, read_trials(twin.scene.episodes_csv)
    write_text(twin.scene.cells_csv, cells_text(tally(trials)))
    said = summary(trials)
    said["training"] = trainings(twin.scene.root, dict.fromkeys(t.policy for t in trials))
    said["worst"] = _worst_lights(folder / "worst.csv")
    said["robot_known"] = known_of(twin.world().robot)
    films = folder / "films" / "films.json"
    said["films"] = _filmed(films)
    write_json(folder / "summary.json", said)
    _draw_maps(twin, folder, trials)
    runs = dict.fromkeys(trained["run"] for trained in said["training"].values())
    curves = [Curve(run, *read_episodes(twin.scene.root / "runs" / run)) for run in runs]
    write_validation_page(twin.scene, said, curves)
    return said


def _worst_lights(path: Path) -> list[dict]:
    """A cell for every policy and task that the worst light was searched for: its fresh episodes in that light."""
    trials = read_trials(path) if path.exists() and _has_rows(path) else []
    cells = summary([t for t in trials if t.seed >= _PROOF_SEED])["cells"]
    return [
        c | {"of": len({t.lighting for t in trials if (t.policy, t.task) == (c["policy"], c["task"])})} for c in cells
    ]


def _film(root: Path, folder: Path, source: str, trust: bool, trials: Sequence[Trial]) -> None:
    """Films the typical and the worst of a policy's episodes on a task; what is filmed already is kept."""
    from twin.film import film, film_name
    from twin.report.video_writer import last_frame

    noted = folder / "films" / "films.json"
    before = _filmed(noted)
    chosen: dict[Trial, list[str]] = {}
    for kind, trial in (("typical", typical_episode(trials)), ("worst", worst_episode(trials))):
        chosen.setdefault(trial, []).append(kind)
    mine = []
    for trial, which in chosen.items():
        path = folder / "films" / trial.policy / film_name(trial.task, trial.lighting, trial.seed)
        poster = path.with_suffix(".jpg")
        if not poster.exists():
            episode = film(root, trial.task, source, trial.seed, path, trust, **asked(trial.lighting))[1]
            if (episode.cause, len(episode.times) - 1) != (trial.cause, trial.steps):
                path.unlink()
                raise InputError(
                    f"{trial.policy}, {trial.task}, {trial.lighting}, seed {trial.seed}: driven again to be filmed it "
                    f"ends by {episode.cause} after {len(episode.times) - 1} steps; expected {trial.cause} after "
                    f"{trial.steps}, as in {folder / 'episodes.csv'}: the policy's code changed, or another kind of "
                    f"machine drove it; move {folder} away to validate anew"
                )
            write_bytes(poster, last_frame(path))
        told = {"policy": trial.policy, "task": trial.task, "lighting": trial.lighting, "seed": trial.seed}
        told |= {"which": which, "cause": trial.cause, "progress_m": trial.progress, "of": len(trials)}
        files = {"file": path.relative_to(folder).as_posix(), "poster": poster.relative_to(folder).as_posix()}
        mine.append(told | files)
    key = trials[0].policy, trials[0].task
    write_json(noted, [one for one in before if (one["policy"], one["task"]) != key] + mine)


def _filmed(path: Path) -> list[dict]:
    """What `films.json` has; nothing where there is none. Raises InputError: not one that `_film` wrote."""
    if not path.exists():
        return []
    with damaged(path, "delete it, and the films are noted again"):
        films = [dict(one) for one in read_json(path)]
        for one in films:
            _ = [one[name] + "" for name in ("policy", "task", "lighting", "cause", "file", "poster")]
            _ = int(one["seed"]), int(one["of"]), float(one["progress_m"]), [name + "" for name in one["which"]]
    return films


def seeds_of(lighting: str, episodes: int) -> range:
    """Of a lighting's episodes, the same for every policy.

    Another lighting has others: a seed decides start, robot, weather and bystanders, too, so that one seed in ten
    lightings would be hardly more than one episode, and an interval that counts ten too narrow.
    """
    first = _FIRST_SEED + _PER_LIGHTING * (crc32(lighting.encode()) % _BLOCKS)
    return range(first, first + episodes)


def _search(search: Campaign, policy: str, episodes: int) -> None:
    """Drives a policy in many drawn lights, and in fresh episodes in the one of them in which it fares worst.

    Few episodes in every light, as many again in the worst of them: successive halving. The way driven breaks ties.
    """
    seeds = range(_SEARCH_SEED, _SEARCH_SEED + _LOOKS)
    lights = [f"drawn_{k}" for k in range(_LIGHTS)]
    looks: dict[str, list[Trial]] = {name: [] for name in lights}
    while len(lights) > 1:
        trials = search.drive([(policy, light, seeds) for light in lights], f"worst light of {len(lights)}")
        for trial in trials:
            looks[trial.lighting].append(trial)
        fared = {name: _fared(looks[name]) for name in lights}
        lights = sorted(lights, key=lambda name: fared[name])[: _FINALISTS if len(lights) > _FINALISTS else 1]
        seeds = range(seeds.stop, seeds.stop + 2 * len(seeds))
    # What was worst by chance among many is less bad than it looked: so it is driven in anew.
    proof = range(_PROOF_SEED, _PROOF_SEED + episodes)
    search.drive([(policy, lights[0], proof)], f"{lights[0]} anew")


def _fared(trials: Sequence[Trial]) -> tuple[float, float]:
    return sum(t.success for t in trials) / len(trials), sum(t.progress for t in trials) / len(trials)


def _policies(root: Path, sources: Sequence[str], trust: bool) -> dict[str, tuple[str, bool]]:
    """Source by the name it has in tables; each is loaded once, so that what is wrong is said at once."""
    out: dict[str, tuple[str, bool]] = {}
    for source in sources:
        where = find_policy(root, source)
        name = load_policy(where, trust).name
        if out.get(name, (where, trust)) != (where, trust):
            raise InputError(f"two policies are named {name!r}: {out[name][0]} and {where}; rename one")
        out[name] = (where, trust)
    return out


def _check_same(
    folder: Path, twin: Twin, task: str, lightings: Sequence[str], policies: dict[str, tuple[str, bool]]
) -> None:
    """Notes which policies the tables are of, and which roads (a task under a lighting); refuses others so named."""
    path = folder / "validated.json"
    noted: dict[str, Any] = {"roads": {}, "policies": {}}
    if path.exists():
        with damaged(path, f"move {folder} away to validate anew"):
            there = dict(read_json(path))
            noted |= {name: dict(there[name]) for name in noted if name in there}
    tables = [folder / "episodes.csv", folder / "worst.csv"]
    trials = [trial for table in tables if table.exists() and _has_rows(table) for trial in read_trials(table)]
    driven = {t.policy for t in trials} | {_road(t.task, t.lighting) for t in trials}
    for lighting in lightings:
        road, digest = _road(task, lighting), fingerprint(twin, task, lighting)
        if road in driven and noted["roads"].get(road) != digest:
            raise InputError(
                f"{folder} has episodes of {task} under {lighting} from before the scene was built anew, its task, "
                "obstacles or photo changed, or twin draws episodes otherwise; move it away to validate anew"
            )
        noted["roads"][road] = digest
    for name, (source, _) in policies.items():
        digest = _digest(Path(source), source)
        if name in driven and noted["policies"].get(name) != digest:
            raise InputError(
                f"policy {name!r} was validated as another file than {source} is now; move {folder} away, or "
                "copy the policy to another name"
            )
        noted["policies"][name] = digest
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, noted)


def _road(task: str, lighting: str) -> str:
    """What episodes were driven on; all drawn lights are one's, as they come from one field."""
    return f"{task}, {'drawn' if lighting.startswith('drawn_') else lighting}"


def _digest(path: Path, source: str) -> str:
    """Of a policy's files; of a callable, whose code nobody can know, of its name."""
    if path.is_dir():
        return digest_file(path / JSON)  # which has the digest of the weights
    return digest_file(path) if path.is_file() else digest_json(source)


def _draw_maps(twin: Twin, folder: Path, trials: Sequence[Trial]) -> None:
    from twin.config_file import load_config
    from twin.env.route_segments import find_task

    world, config = twin.world(), load_config(twin.scene.config_file)
    for task in dict.fromkeys(t.task for t in trials):
        stretch = find_task(task, world, config.task)
        mine = [t for t in trials if t.task == task]
        failure_map(folder / f"failures_{task}.png", mine, world, (stretch.start, stretch.end))


def _key(trial: Trial) -> Key:
    return trial.policy, trial.task, trial.lighting, trial.seed


def _mend(path: Path) -> None:
    """Cuts off a last line that was being written when the process was killed."""
    if path.exists():
        blob = path.read_bytes()
        if not blob.endswith(b"\n"):
            whole = blob[: blob.rfind(b"\n") + 1]
            path.write_bytes(whole) if whole else path.unlink()


def _has_rows(path: Path) -> bool:
    return path.read_bytes().count(b"\n") > 1


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    parser = cli.Parser(prog="python -m twin.validate", description="How often policies succeed.")
    parser.add_argument("scene", type=Path, help="folder of a built scene")
    parser.add_argument("--policy", nargs="+", required=True, help="runs, ONNX files or module:function")
    parser.add_argument("--task", default="straight", help="straight, right_turn, route, or one of scene.toml")
    parser.add_argument(
        "--lightings",
        nargs="+",
        default=list(DEFAULT_LIGHTINGS),
        help="names, mixtures a:b:0.3, held-out, any; any of them with +randomised (default: %(default)s)",
    )
    parser.add_argument("--episodes", type=int, default=100, help="per policy and lighting; 100 unless given")
    parser.add_argument("--worst", action="store_true", help="search for the light in which each policy fares worst")
    parser.add_argument("--films", action="store_true", help="film each policy's typical and worst episode")
    parser.add_argument("--trust", action="store_true", help="load policy files that may run code")
    parser.add_argument("--processes", type=int, default=1, help="on this machine; one uses two cores")
    parser.add_argument("--ray", metavar="ADDRESS", help="drive on a Ray cluster; auto: the one on this machine")
    parser.add_argument("--quiet", action="store_true", help="no progress, no table")
    return cli.run(parser, _main, arguments)


def _main(given: argparse.Namespace) -> None:
    for name, most in (("episodes", _PER_LIGHTING), ("processes", _MOST_PROCESSES)):
        if not 1 <= getattr(given, name) <= most:
            raise InputError(f"--{name} {getattr(given, name)}; expected 1 to {most}")
    how = (given.worst, given.trust, given.processes, given.ray, given.films)
    said = validate(given.scene, given.policy, given.task, given.lightings, given.episodes, *how)
    if not given.quiet:
        print("\n".join(lines(said)))
        print(f"look at {SceneDir(given.scene).validation / 'validation.html'}")


if __name__ == "__main__":
    sys.exit(main())
