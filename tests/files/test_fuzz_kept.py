"""The failures once found by the long run (`make fuzz`) stay fixed: its kept cases, one by one."""

import pytest

from tests.fuzz.judge import small_programs
from tests.fuzz.kept import kept_cases, replayed


@pytest.fixture(scope="module")
def beside(tmp_path_factory):
    """Where sound files are made once."""
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("place", kept_cases(), ids=lambda place: place.name)
def test_what_failed_once_is_told_in_a_line_or_does_not_matter(place, beside, monkeypatch):
    # Commands choose a precision and a cache for their process; tests keep theirs.
    monkeypatch.setattr("jax.config.update", lambda name, value: None)
    scratch = beside / place.name
    scratch.mkdir()
    with small_programs():
        assert replayed(place, scratch) is None
