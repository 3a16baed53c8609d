"""One comparison from its config to its report."""

from collections.abc import Sequence
from pathlib import Path

from causticmpi.compare.analysis import analyse
from causticmpi.compare.charts import require_matplotlib
from causticmpi.compare.execute import execute
from causticmpi.compare.load import load_plan
from causticmpi.compare.plan import Plan, only_scene
from causticmpi.compare.report import write_reports
from causticmpi.distributed.world import World
from causticmpi.errors import InputError


def compare(
    world: World,
    config: str,
    settings: Sequence[str],
    out: str | None,
    command: tuple[str, ...],
    references_only: bool = False,
    more: Sequence[Path] = (),
    scene: int | None = None,
) -> int:
    """Collective. Make what is missing, then have rank 0 measure and write; returns the exit code.

    settings: overrides of the config; out: instead of its output directory; more: see `write_reports`; scene: number,
    from 1, of the only one to run, without a report. Raises AgreedInputError for bad input. Stopped by a signal, it
    leaves a file `unfinished` (`unfinished-N` of scene N) and returns 0.
    """

    def read_plan() -> Plan:
        require_matplotlib()
        for directory in more:
            if not directory.is_dir():
                raise InputError(
                    "no such directory; allowed: one of PNGs, such as `causticmpi inspect` makes", directory
                )
        plan = load_plan(config, settings, out)
        return plan if scene is None else only_scene(plan, scene)

    outcome = execute(world, read_plan, command, references_only)
    if world.is_root:
        if outcome.signal:
            print(f"{outcome.plan.directory}: stopped by signal {outcome.signal}; start it again to go on", flush=True)
        elif not references_only and scene is None:
            print("measuring", flush=True)
            print(write_reports(outcome.plan, analyse(outcome.plan, outcome.references), more), flush=True)
    return 0
