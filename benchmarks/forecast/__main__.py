"""Forecast experiment: how well the twin predicts success on simulated roads at places not used in development.

    python benchmarks/forecast WORK [--minutes 150] [--jobs 2] [--places 118 119] [--ray ADDRESS]
    python benchmarks/forecast --tables                     only scores the recorded results, in seconds

`protocol.toml` fixes every number in advance. `place_record.py` keeps every episode and trial in `results/`.
`place_scores.py` defines the scores. Steps at a place, made of commands of `twin` that resume where they stopped:

- film: generates the place from its number, and films it under its lightings.
- build: builds the twin; aligns the robot to a drive log and to a film by its camera; builds again with this robot.
- photos: adds each day's lighting to the twin, from one photo by the robot's camera. If the photo's pose is not found,
  held-out lightings, which no training uses, replace that day's lighting.
- train: trains one policy per setup (training options), and records the policies' digests before any of them drives.
- validate: drives every policy in the twin, under the lighting of each day and under held-out lightings.
- drive: drives every policy in the simulated reality, on each day, on the task that the twin exported.

WORK holds the scenes (5 GB a place). After a kill, or at the end of `--minutes`, the same command continues. A place of
70 m takes about three hours on two cores. No recorded row is removed. A place that cannot be filmed, built or trained
is recorded as failed, and the next place begins.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from place_record import EPISODES, FAILURE, HELD_OUT_CONDITION, PLACE, TRIALS, by_photo, freeze, keep
from place_scores import score, tables
from protocol import PROTOCOL, Protocol, read_protocol

from twin.command_line import run
from twin.errors import InputError, print_error
from twin.evaluation.training_curves import CHOICE_FILE
from twin.evaluation.trials import read_trials
from twin.files import read_json, write_json
from twin.loading import load_scene

sys.path.append(str(Path(__file__).parents[1]))
from record import write_record

RESULTS = Path(__file__).with_name("results")
_DISK_OF_A_PLACE = 8 * 2**30  # [bytes] that must be free before a step
_GRACE = 60.0  # [s] for a command to save its state


class TimeIsUp(Exception):
    """The time given by `--minutes` is over, or a signal asked to stop."""


class Refused(InputError):
    """A command ended with exit status 2: its input is bad, so it would end like this again."""


class Commands:
    """Runs `python -m twin.…` until a deadline."""

    def __init__(self, minutes: float) -> None:
        self._end = time.monotonic() + 60.0 * min(minutes, 1e6)
        self._running: set[subprocess.Popen] = set()

    def stop(self, *_: object) -> None:
        """Signal handler: moves the deadline to now, and ends running commands."""
        self._end = 0.0
        for process in tuple(self._running):
            process.send_signal(signal.SIGTERM)

    def __call__(self, *arguments: str | Path, cores: int = 1) -> int:
        """Returns the exit status. Raises TimeIsUp at the deadline, after the command has saved its state."""
        return self._run(arguments, cores)[0]

    def must(self, *arguments: str | Path, cores: int = 1) -> None:
        """Runs a command.

        Raises:
            Refused: it ended with exit status 2.
            InputError: it failed in another way.
        """
        status, message = self._run(arguments, cores)
        if status:
            text = f"{arguments[0]} ended with exit status {status}: {message}"
            raise Refused(text) if status == 2 else InputError(text)

    def _run(self, arguments: Sequence[str | Path], cores: int) -> tuple[int, str]:
        """Exit status and last error message of a command."""
        if time.monotonic() > self._end:
            raise TimeIsUp
        print("+", " ".join(map(str, arguments)), flush=True)
        environment = {**os.environ, "OMP_NUM_THREADS": str(cores)}
        command = [sys.executable, "-m", *map(str, arguments)]
        process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)
        self._running.add(process)
        errors: list[str] = []
        copy = threading.Thread(target=_copy_messages, args=(process, errors), daemon=True)
        copy.start()
        try:
            status = process.wait(max(0.0, self._end - time.monotonic()))
        except subprocess.TimeoutExpired:
            status = None
        finally:
            self._end_of(process)
            copy.join(_GRACE)
        if status is None or self._end == 0.0:
            raise TimeIsUp
        return status, errors[-1] if errors else "see its messages above"

    def _end_of(self, process: subprocess.Popen) -> None:
        """Ends a command that still runs, and lets it save its state."""
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(_GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._running.discard(process)


def _copy_messages(process: subprocess.Popen, errors: list[str]) -> None:
    """Copies a command's standard error, progress bars included, and appends its error messages to a list."""
    assert process.stderr
    tail = b""
    with process.stderr as stream:
        while data := os.read(stream.fileno(), 65536):
            sys.stderr.buffer.write(data)
            sys.stderr.buffer.flush()
            tail = (tail + data)[-8192:]
    lines = tail.decode(errors="replace").replace("\r", "\n").splitlines()
    errors += [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]


class PlaceRun:
    """One place of the protocol: its scene in `work`, and its record in `results`."""

    def __init__(self, protocol: Protocol, place: int, work: Path, results: Path, run: Commands, jobs: int) -> None:
        self.protocol, self.place, self.run, self.jobs = protocol, place, run, jobs
        self.scene = work / protocol.name / f"place_{place}"
        self.record = results / protocol.name / f"place_{place}"
        self.days = protocol.days_of(place)
        self._number = ("--place", str(place))
        self._robot = ("--place", str(place), "--robot", str(place), "--camera", str(place))

    def film(self) -> None:
        if not (self.scene / "scene.toml").exists():
            self.run.must("twin.reality", "film", *self._number, "--out", self.scene)

    def build(self) -> None:
        command = ("twin.build", self.scene, "--quality", self.protocol.quality)
        self.run.must(*command, cores=self.jobs)  # skips stages that are up to date
        for kind, name, figures in (("log", "drive.csv", "align.json"), ("onboard", "robot.mp4", "camera.json")):
            if not (self.scene / "alignment" / figures).exists():
                robot = self._robot if kind == "onboard" else self._robot[:4]
                self.run.must("twin.reality", kind, *robot, "--out", self.scene / name, cores=self.jobs)
                self.run.must("twin.align", self.scene, self.scene / name, cores=self.jobs)
        self.run.must(*command, cores=self.jobs)  # with the aligned robot
        self.run.must("twin.reality", "compare", self.scene, cores=self.jobs)

    def photos(self) -> None:
        """Adds the days' lightings, and records in the scene's `photos.json` which photos' poses were found."""
        done = dict(read_json(self._photos)) if self._photos.exists() else {}
        for day in (day for day in self.days if day not in done):
            photo = self.scene / "photos" / f"{day}.png"
            day_number = ("--day", day.removeprefix("day_"))
            self.run.must("twin.reality", "photo", *self._robot, *day_number, "--out", photo, cores=self.jobs)
            status = self.run("twin.relight", self.scene, photo, "--name", day, cores=self.jobs)
            if status not in (0, 2):
                raise InputError(f"{photo}: twin.relight ended with exit status {status}")
            done[day] = status == 0
            write_json(self._photos, done)

    def train(self) -> None:
        lightings = load_scene(self.scene).field().lightings_by_name.filmed().names

        def one(setup: str) -> None:
            if not (self._run_folder(setup) / CHOICE_FILE).exists():
                seed = 10 * self.place + list(self.protocol.setups).index(setup)
                options = ("--task", self.protocol.task, "--run", setup, "--seed", str(seed))
                setup_options = self.protocol.options_of(setup, list(lightings))
                self.run.must("twin.train", self.scene, *options, *setup_options, "--quiet")

        with ThreadPoolExecutor(self.jobs) as pool:
            list(pool.map(one, self.protocol.setups))
        freeze(self.record, {setup: self._run_folder(setup) for setup in self.protocol.setups})

    def validate(self, ray: str | None) -> None:
        spread = ("--ray", ray) if ray else ("--processes", str(self.jobs))
        policies = [self._run_folder(setup) for setup in self.protocol.setups]
        placed = read_json(self._photos)
        for lightings, episodes in (
            ([HELD_OUT_CONDITION], self.protocol.held_out_episodes),
            ([by_photo(day) for day in self.days if placed[day]], self.protocol.episodes),
        ):
            if lightings:
                count = ("--episodes", str(episodes))
                what = ("--task", self.protocol.task, "--policy", *policies, "--lightings", *lightings)
                self.run.must("twin.validate", self.scene, *what, *count, *spread)

    def drive(self) -> None:
        task = self.scene / f"{self.protocol.task}.json"
        self.run.must("twin.export", self.scene, "--task", self.protocol.task, "--task-file", task)
        days = [day.removeprefix("day_") for day in self.days]

        def one(setup: str) -> None:
            where = ("--scene", self.scene, *self._robot, "--day", *days, "--trials", str(self.protocol.trials))
            out = ("--out", self._real(setup).with_name(f"{setup}.csv"))
            self.run.must("twin.reality", "drive", "--policy", self._run_folder(setup), "--task", task, *where, *out)

        with ThreadPoolExecutor(self.jobs) as pool:
            list(pool.map(one, self.protocol.setups))

    def write_record(self) -> None:
        """Writes to the record all episodes and trials so far."""
        episodes = self.scene / "validation" / "episodes.csv"
        wanted = {HELD_OUT_CONDITION, *map(by_photo, self.days)}
        if episodes.exists():
            keep(self.record / EPISODES, [one for one in read_trials(episodes) if one.lighting in wanted])
        driven = [self._real(setup) for setup in self.protocol.setups if self._real(setup).exists()]
        if driven:
            keep(self.record / TRIALS, [one for path in driven for one in read_trials(path)])
            write_json(self.record / PLACE, self._facts())

    def _facts(self) -> dict[str, Any]:
        report = read_json(self.scene / "build" / "report.json")
        setup = read_json(self.scene / "real" / f"{next(iter(self.protocol.setups))}_setup.json")
        choices = {one: read_json(self._run_folder(one) / CHOICE_FILE) for one in self.protocol.setups}
        return {
            "place": self.place,
            "setup": setup,
            "photos_placed": read_json(self._photos),
            "build": {name: report[name] for name in ("seed", "versions", "field", "metric", "truth", "cautions")},
            "trainings": {name: {"steps": one["steps"], "chosen": one["chosen"]} for name, one in choices.items()},
        }

    @property
    def _photos(self) -> Path:
        return self.scene / "photos.json"

    def _run_folder(self, setup: str) -> Path:
        return self.scene / "runs" / setup

    def _real(self, setup: str) -> Path:
        return self.scene / "real" / f"{setup}_trials.csv"


def run_place(one: PlaceRun, ray: str | None) -> None:
    """Runs all steps of a place. Writes the record even if a step fails or the time is up.

    A place that cannot be filmed, built or trained is recorded as such, and not run again.
    """
    if (one.record / FAILURE).exists():
        print(f"place {one.place} has failed before; see {one.record / FAILURE}", flush=True)
        return
    try:
        for step, final in ((one.film, True), (one.build, True), (one.photos, False), (one.train, True)):
            try:
                _check_disk(one.scene)
                step()
            except Refused as error:
                if final:
                    one.record.mkdir(parents=True, exist_ok=True)
                    message = str(error).replace(f"{one.scene}/", "")  # records name no folder of a machine
                    write_json(one.record / FAILURE, {"step": step.__name__, "message": message})
                raise
        one.validate(ray)
        one.drive()
    finally:
        one.write_record()


def _check_disk(folder: Path) -> None:
    """Raises InputError: a full disk would end a command as bad input does, and the place would count as failed."""
    existing = next(parent for parent in folder.absolute().parents if parent.exists())
    free = shutil.disk_usage(existing).free
    if free < _DISK_OF_A_PLACE:
        raise InputError(f"{existing}: {free / 2**30:.1f} GiB are free (need {_DISK_OF_A_PLACE / 2**30:.0f} GiB)")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, nargs="?", help="folder of the scenes")
    parser.add_argument("--protocol", type=Path, default=PROTOCOL, help="default: protocol.toml beside this file")
    parser.add_argument("--results", type=Path, default=RESULTS, help="default: results beside this file")
    parser.add_argument(
        "--places", type=int, nargs="+", metavar="NUMBER", help="places of the protocol to run (default: all)"
    )
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="stop after this time; the same command continues"
    )
    parser.add_argument("--jobs", type=int, default=2, help="number of processes in parallel, each on one core")
    parser.add_argument("--ray", metavar="ADDRESS", help="Ray cluster that runs the validations")
    parser.add_argument("--tables", action="store_true", help="run nothing; score what is recorded")
    parser.set_defaults(resumes=True)
    return run(parser, _work)


def _work(given: argparse.Namespace) -> None:
    protocol = read_protocol(given.protocol)
    if not given.tables:
        if given.work is None:
            raise InputError("no folder of scenes; give WORK, or --tables")
        _run(protocol, given)
    found = score(protocol, given.results)
    (given.results / protocol.name).mkdir(parents=True, exist_ok=True)
    write_record(given.results / protocol.name / "scores.json", found, replace=None)
    print(tables(protocol, found))


def _run(protocol: Protocol, given: argparse.Namespace) -> None:
    places = given.places or protocol.places
    for place in places:
        protocol.check_has(place)
    commands = Commands(given.minutes)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, commands.stop)
    for place in places:
        try:
            run_place(PlaceRun(protocol, place, given.work, given.results, commands, given.jobs), given.ray)
        except TimeIsUp:
            print(f"stopped at place {place}; the same command continues", flush=True)
            return
        except InputError as error:
            print_error(error)


if __name__ == "__main__":
    sys.exit(main())
