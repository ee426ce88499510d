"""Commands choose a precision and a cache of their own; tests keep theirs."""

from collections.abc import Callable

import pytest

from jaxnav.cli import EXIT_BAD_INPUT, main


@pytest.fixture(autouse=True)
def keep_the_settings_of_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxnav.commands.process.configure", lambda **_: None)


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The one line of a command that is refused."""

    def run(*words: object) -> str:
        assert main(list(map(str, words))) == EXIT_BAD_INPUT == 2
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        return err

    return run
