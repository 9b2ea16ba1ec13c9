"""Protocol of the forecast experiment: places, days, trials, setups, and acceptance criteria (`protocol.toml`)."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twin.errors import InputError
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS

PROTOCOL = Path(__file__).with_name("protocol.toml")
_FIRST_LIGHTING = "{first}"


@dataclass(frozen=True)
class Protocol:
    """The fields of `protocol.toml`, which explains them."""

    version: int
    places: tuple[int, ...]
    days: int
    task: str
    quality: str
    episodes: int
    held_out_episodes: int
    trials: int
    setups: dict[str, tuple[str, ...]]
    """Name → options of `twin.train`; a place has one training per setup, under the setup's name."""
    wanted: dict[str, float]

    @property
    def name(self) -> str:
        """Name of the folder of results."""
        return f"version_{self.version}"

    def check_has(self, place: int) -> None:
        """Raises InputError: this is not a place of the protocol."""
        if place not in self.places:
            raise InputError(f"place {place}: the protocol has {', '.join(map(str, self.places))}; choose another one")

    def days_of(self, place: int) -> list[str]:
        """Names of the days of trials at a place."""
        return [f"day_{10 * place + k + 1}" for k in range(self.days)]

    def options_of(self, setup: str, lightings: list[str]) -> list[str]:
        """Options of a setup's training in a place that was filmed in `lightings`."""
        return [lightings[0] if one == _FIRST_LIGHTING else one for one in self.setups[setup]]


def read_protocol(path: Path = PROTOCOL) -> Protocol:
    """Reads a protocol.

    Raises:
        InputError: no such file, a missing or unknown field, or numbers with which no forecast can be scored.
    """
    try:
        table: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
        setups = {str(name): tuple(map(str, options)) for name, options in table.pop("setups").items()}
        wanted = {str(name): float(value) for name, value in table.pop("wanted").items()}
        places = tuple(map(int, table.pop("places")))
        protocol = Protocol(places=places, setups=setups, wanted=wanted, **table)
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {error}; expected the fields of benchmarks/forecast/protocol.toml") from None
    faults = [
        (
            len(set(places)) != len(places) or not places,
            f"places = {list(places)}; expected different numbers, 1 or more",
        ),
        (not 1 <= protocol.days <= 10, f"days = {protocol.days}; expected 1 to 10, the days of a place"),
        (len(setups) < MIN_POLICIES, f"{len(setups)} setups; expected {MIN_POLICIES} or more"),
        (protocol.trials < MIN_TRIALS, f"trials = {protocol.trials}; expected {MIN_TRIALS} or more"),
        (
            protocol.episodes < 1 or protocol.held_out_episodes < 1,
            f"episodes = {protocol.episodes}, held_out_episodes = {protocol.held_out_episodes}; expected 1 or more",
        ),
    ]
    for wrong, text in faults:
        if wrong:
            raise InputError(f"{path}: {text}")
    return protocol
