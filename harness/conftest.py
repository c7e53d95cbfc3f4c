"""What several of the tests here start from."""

import pytest

import run
from harness.testing import SMALL
from run import Config


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """A run of 4 epochs that nothing stopped."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    run.train(Config(**SMALL, epochs=4, out=str(folder)))
    return folder
