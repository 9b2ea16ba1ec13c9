"""Where the real captures are."""

from pathlib import Path

import pytest

_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real captures; tests that ask for it skip where it is absent."""
    if not _DATA.is_dir():
        pytest.skip(f"no real captures at {_DATA.parent.name}/{_DATA.name} beside the project")
    return _DATA
