from pathlib import Path

import pytest


@pytest.fixture
def configs():
    """The folder of configurations, which is not part of the installed packages."""
    return Path(__file__).parents[2] / "configs"
