"""Fixtures and options that tests of several files use."""

import os

# Two workers share the cores, and a thread of OpenMP that waits for another keeps its core busy: with two threads each,
# the tests take a third longer. Processes that the tests start inherit this.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

from pathlib import Path

import numpy as np
import pytest
from drive_logs import SOFT, columns

from twin import runtime

_LONGEST = (
    *("test_real_places.py", "test_robustness.py", "test_end_to_end.py", "test_alignment.py", "test_validate.py"),
    *("test_side_roads.py", "test_wheel.py", "test_env.py", "test_vector_env_gpu.py", "test_training.py"),
    *("test_sfm.py", "test_vector_env.py"),
)
"""Files that take minutes, or the better part of one, and so are begun with."""

_DATA = Path(__file__).parents[2] / "shared" / "data"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the slow files first; otherwise one core would be idle while the other finishes them."""
    order = {name: k for k, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.fixture(autouse=True)
def loud() -> None:
    """Ends quiet mode, which is global to the process: a test that reads standard error must not depend on earlier
    tests.
    """
    runtime.set_quiet(False)


@pytest.fixture
def quiet(loud: None) -> None:
    """Quiet mode, for files whose tests show progress."""
    runtime.set_quiet(True)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real captures; tests that ask for it skip where it is absent."""
    if not _DATA.is_dir():
        pytest.skip(f"no real captures at {_DATA.parent.name}/{_DATA.name} beside the project")
    return _DATA


@pytest.fixture(scope="session")
def drive() -> dict[str, np.ndarray]:
    """A drive of two and a half minutes on soft ground."""
    return columns(SOFT, 150.0, seed=1)
