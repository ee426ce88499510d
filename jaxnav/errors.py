"""What a person gets for bad input: one line, exit code 2."""

_LONGEST = 1000  # characters of a line: what a file holds may be quoted in it


class BadInput(ValueError):
    """Input that a person can correct. The message is one line naming file and key, or flag.

    Args:
        where: the file, with its key where there is one (`rig.yaml: cameras[1].lens`), or the flag.
        problem: what is wrong and what is expected.
    """

    def __init__(self, where: object, problem: str):
        one_line = " ".join(f"{where}: {problem}".split())
        if len(one_line) > _LONGEST:
            one_line = f"{one_line[:_LONGEST]}..."
        ValueError.__init__(self, one_line)
