"""What the tests of the stages share."""

from __future__ import annotations

import nets
import pytest


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A folder with two lines that never meet, and their trains."""
    folder = tmp_path_factory.mktemp("line")
    nets.separate(folder)
    return folder
