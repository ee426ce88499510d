"""`jaxnav faults`: drive with every fault of the matrix, and print a table."""

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.drive.arguments import Faults
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files
from jaxnav.drive.flags import names
from jaxnav.errors import BadInput
from jaxnav.files import write_json
from jaxnav.vehicles.conformance.faults import HEADER, Result, Trial, line, run_trial
from jaxnav.vehicles.conformance.matrix import MATRIX

EXIT_BROKEN = 1


def run(args: Faults) -> int:
    """Drive with every fault and print the results; 1 where a promise was not kept."""
    configure_jax(float64=args.float64, threads=1)
    trial = Trial(**given_files(args, ("rig", "markers", "vehicle"), or_qcars=True))
    suiting = [row for row in MATRIX if row.suits(trial)]
    rows = [row for row in suiting if not args.only or any(p in row.name for p in args.only)]
    if not rows:
        known = ", ".join(row.name for row in suiting)
        raise BadInput("--only", f"names no fault: there are {known}")
    results: list[Result] = []
    print(HEADER)
    with progress_bar(rows, unit="fault", disable=args.headless) as bar:
        for row in bar:
            bar.set_postfix_str(row.name)
            results.append(run_trial(row, trial))
            bar.write(line(results[-1]))
    if args.json is not None:
        write_json(args.json, {"faults": [_as_json(result) for result in results]})
    broken = sum(bool(result.broken) for result in results)
    print(f"{len(results) - broken} of {len(results)} faults came to what they must")
    return EXIT_BROKEN if broken else 0


def _as_json(result: Result) -> dict[str, object]:
    return {
        "fault": result.row.name,
        "seen": [*names(result.faults), *names(result.rejects)],
        "worst_health": result.worst.name,
        "error_m": result.error_m,
        "error_after_m": result.error_after_m,
        "recovered_s": result.recovered_s,
        "restarts": result.restarts,
        "ways": result.ways_m,
        "broken": list(result.broken),
    }
