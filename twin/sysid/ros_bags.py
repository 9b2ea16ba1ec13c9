"""Drive logs from bags, as tables: a row per joint state, with the newest values of the other topics."""

from pathlib import Path

import numpy as np

from twin.capture.bag import VALUES, choose_topics, open_bag
from twin.errors import InputError
from twin.types import Array


def read_bag(path: Path) -> dict[str, Array]:
    """The columns that `twin.sysid.logs` describes.

    Raises InputError: rosbags is not installed, the bag is unreadable, or a kind of message is missing.
    """
    with open_bag(path, "record it anew or give a .csv") as bag:
        chosen = choose_topics(bag.connections, path)
        rows: dict[str, list[tuple[float, ...]]] = {kind: [] for kind in chosen}
        kinds = {connection.id: kind for kind, connection in chosen.items()}
        # The beginning is subtracted as an integer: as a float it would be rounded to 0.2 µs.
        for connection, recorded, message in bag.messages(list(chosen.values())):
            kind = kinds[connection.id]
            values = VALUES[kind](message)
            if values is not None:
                rows[kind].append(((recorded - bag.begin) * 1e-9, *values))
    empty = [kind for kind, values in rows.items() if not values]
    if empty:
        raise InputError(f"{path}: no usable message of {', '.join(empty)}; expected some; record those topics")
    return _columns({kind: np.array(values) for kind, values in rows.items()})


_NAMES = {
    "commands": ("cmd_v", "cmd_yaw_rate"),
    "wheels": ("left_wheel_vel", "right_wheel_vel"),
    "poses": ("x", "y", "yaw"),
    "imu": ("acceleration_x", "acceleration_y"),
}


def _columns(tables: dict[str, Array]) -> dict[str, Array]:
    """A row per joint state, once every topic has had a message."""
    begin = max(table[0, 0] for table in tables.values())
    time = np.unique(tables["wheels"][:, 0])
    time = time[time >= begin]
    columns = {"time": time - (time[0] if len(time) else 0.0)}
    for kind, table in tables.items():
        newest = np.searchsorted(table[:, 0], time, side="right") - 1
        columns |= {name: table[newest, i + 1] for i, name in enumerate(_NAMES[kind])}
    return columns
