"""Commands choose a precision and a cache of their own; tests keep theirs."""

import pytest


@pytest.fixture(autouse=True)
def keep_the_settings_of_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxnav.commands.process.configure", lambda **_: None)
