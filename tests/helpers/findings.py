"""How tests look at what the doctor found."""

from collections.abc import Iterable

from jaxnav.commands.doctor.findings import Finding


def all_well(findings: Iterable[Finding]) -> bool:
    """Whether something was looked at, and nothing was found."""
    levels = [finding.level for finding in findings]
    return bool(levels) and set(levels) == {"ok"}


def the_problem(findings: Iterable[Finding], level: str) -> Finding:
    """The only finding that is not ok, of the level that is expected, with something to do."""
    (found,) = [finding for finding in findings if finding.level != "ok"]
    assert found.level == level, found
    assert found.do
    return found
