"""The exported headers that tests of this folder look at."""

import header_harness
import pytest


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("headers")


@pytest.fixture(scope="module")
def tables(folder):
    """The tables by name; their headers lie in `folder`."""
    return header_harness.export(folder)
