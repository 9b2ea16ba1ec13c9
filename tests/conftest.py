"""What tests of several files ask for."""

from pathlib import Path

import numpy as np
import pytest
from drive_logs import SOFT, columns

from twin import progress

_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def loud() -> None:
    """What a test reads of standard error does not depend on the tests before it: quiet is a state of the process."""
    progress.set_quiet(False)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real captures; tests that ask for it skip where it is absent."""
    if not _DATA.is_dir():
        pytest.skip(f"no real captures at {_DATA.parent.name}/{_DATA.name} beside the project")
    return _DATA


@pytest.fixture(scope="session")
def drive() -> dict[str, np.ndarray]:
    """Two and a half minutes on soft ground."""
    return columns(SOFT, 150.0, seed=1)
