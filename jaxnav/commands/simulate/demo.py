"""`jaxnav demo`: the paper's waypoints on rendered cameras, beside what people use otherwise.

Source: Liu, Schofield, Shan (2023), section III.
"""

from jaxnav.commands.process import configure_jax
from jaxnav.commands.simulate.arguments import Demo
from jaxnav.commands.simulate.demo_drives import drive_both, make_methods
from jaxnav.commands.simulate.demo_report import write_report
from jaxnav.commands.simulate.demo_scores import (
    RATES,
    lines,
    overall,
    overall_lines,
    summary_of,
)
from jaxnav.commands.simulate.rendered_world import RenderedWorld
from jaxnav.errors import visible
from jaxnav.files import output_folder, write_json


def run(args: Demo) -> int:
    """Drive every seed with both methods, write reports, and print a line for each drive."""
    configure_jax(float64=True, threads=1)
    world = RenderedWorld.load(args)
    ours, opencv = make_methods(args, world)
    out = output_folder(args.out)
    if world.params is not None:
        print(world.params.describe())
    summaries = []
    for seed in range(args.seed, args.seed + args.seeds):
        drives = drive_both(args, world, ours, opencv, seed)
        folder = out if args.seeds == 1 else output_folder(out / f"seed_{seed}")
        summary = summary_of(args, world, drives, seed)
        write_report(folder, world.setup, drives, summary)
        print("\n".join(lines(summary)), flush=True)
        summaries.append(summary)
    if args.seeds > 1:
        together = overall(summaries)
        write_json(out / "summary.json", together)
        print("\n".join(overall_lines(together)))
    else:
        print(RATES)
    print(f"report in {visible(out)}")
    return 0
