"""`--env.task`: tasks, groups of tasks and the benchmark, as LeRobot's suites."""

from ..benchmark import LH_MTLC
from ..calvin import TASK_GROUPS, TASKS
from ..command import CommandError

ALL = "all"
"""Name of all groups together."""


def suites(task: str) -> dict[str, tuple[str, ...]]:
    """What `--env.task` stands for: the name of each suite, by which LeRobot groups its results, and its tasks.

    >>> suites("drawer, lift_red_block_table")
    {'drawer': ('open_drawer', 'close_drawer'), 'lift_red_block_table': ('lift_red_block_table',)}

    Args:
        task: Names separated by commas: `"lh_mtlc"`, tasks, groups of `TASK_GROUPS`, or `"all"` for all groups.

    Raises:
        CommandError: A name is unknown, or a task is named twice.
    """
    found: dict[str, tuple[str, ...]] = {}
    for name in (part.strip() for part in task.split(",")):
        for suite in TASK_GROUPS if name == ALL else (name,):
            if suite not in (LH_MTLC, *TASKS, *TASK_GROUPS):
                raise CommandError(
                    f"--env.task: {suite!r} is unknown; it is {LH_MTLC!r}, {ALL!r}, a group ({', '.join(TASK_GROUPS)}) "
                    f"or a task ({', '.join(TASKS)})"
                )
            tasks = TASK_GROUPS.get(suite, (suite,))
            twice = {named for listed in found.values() for named in listed} & set(tasks)
            if twice:
                raise CommandError(f"--env.task={task} names {', '.join(sorted(twice))} twice")
            found[suite] = tasks
    return found
