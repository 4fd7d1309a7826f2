"""Options of `lansar-report`, and what they ask for: one table from the command line, or several from a file."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..command import CommandError
from .published import PUBLISHED


@dataclass
class EvaluationConfig:
    """One evaluation of a table, in a file."""

    # Its name in tables.
    label: str
    # Its folder, or a list of folders that make one evaluation.
    eval_dir: list[str] | str
    # Its policy, where the evaluation does not know it or it has moved.
    policy_path: str | None = None
    # Its --seed, where the files do not tell.
    seed: int | None = None


@dataclass
class TableConfig:
    """One table of a report, in a file."""

    title: str
    evaluations: list[EvaluationConfig]
    # Published tables to print beside it.
    published: list[str] | str = field(default_factory=list)
    # Whether to show the success of each task.
    tasks: bool = True


@dataclass
class TrainingConfig:
    """One training's losses, in a file."""

    label: str
    # --output_dir of the training, or a log of it.
    train_dir: str


@dataclass
class ReportConfig:
    """Success rates of evaluations on the CALVIN desk, compared where there are several, and losses of trainings."""

    # Folder of an evaluation (episodes.jsonl, eval_info.json or both), finished or not, or a list of folders. Those of
    # one evaluation are merged, others are compared with the first.
    eval_dir: list[str] | str | None = None
    # Where to write report.html, report.json and report.md; by default eval_dir, if that is one folder.
    output_dir: Path | None = None
    # Name of the evaluation in tables, or a list with a name for each; by default what their policies' paths or their
    # folders do not share.
    labels: list[str] | str | None = None
    # Policy of these evaluations (--policy.path), a folder or a name on the hub, or a list with one for each folder.
    # Only needed where the evaluations do not know their policy, or it has moved.
    policy_path: list[str] | str | None = None
    # Seed of these evaluations; by default what their files say, or LeRobot's default, 1000.
    seed: int | None = None
    # Published tables to print beside: thesis_5.1, thesis_5.3, thesis_5.4, thesis_5.5 or a list of them.
    published: list[str] | str = field(default_factory=list)
    # Training whose losses to plot: its --output_dir, a log of it, or a list of these.
    train_dir: list[str] | str | None = None
    # Model on the hub (user/name) whose card gets the results; for a report of one evaluation.
    push_to_hub: str | None = None
    # Title of the report.
    title: str = "Evaluation on the CALVIN desk"
    # Several tables at once, in a file for --config_path; configs/thesis/tables.yaml is one.
    tables: list[TableConfig] = field(default_factory=list)
    # Trainings whose losses to plot, with labels, in such a file.
    trainings: list[TrainingConfig] = field(default_factory=list)


def as_list(value: Sequence[str] | str | None) -> list[str]:
    """An option that is one string, a list or nothing, as a list."""
    return [] if value is None else [value] if isinstance(value, str) else list(value)


def check(config: ReportConfig) -> None:
    """Raises CommandError if options contradict each other or name what is not there."""
    if config.eval_dir is not None and config.tables:
        raise CommandError("give either --eval_dir or a file with tables (--config_path), not both")
    if not (as_list(config.eval_dir) or config.tables or as_list(config.train_dir) or config.trainings):
        raise CommandError(
            "there is nothing to report: give --eval_dir (folders of evaluations), --train_dir (trainings) or a file "
            "with tables (--config_path)"
        )
    folders, policies = as_list(config.eval_dir), config.policy_path
    if isinstance(policies, list) and len(policies) != len(folders):
        raise CommandError(
            f"--policy_path lists {len(policies)} policies, but --eval_dir {len(folders)} folders: give one for each "
            "folder, in the same order, or a single one for all"
        )
    if config.tables and (policies is not None or config.labels is not None):
        raise CommandError("--policy_path and --labels go with --eval_dir; a file with tables has them in its rows")
    for names in (config.published, *(table.published for table in config.tables)):
        unknown = set(as_list(names)) - PUBLISHED.keys()
        if unknown:
            raise CommandError(
                f"--published: {', '.join(sorted(unknown))} is unknown; choose among {', '.join(PUBLISHED)}"
            )
    if as_list(config.published) and not folders:
        raise CommandError("--published goes with --eval_dir; a file with tables names it in each table")


def output_dir(config: ReportConfig) -> Path:
    """Where the report goes.

    Raises:
        CommandError: Several folders are reported and none is named for the report.
    """
    if config.output_dir is not None:
        return config.output_dir
    folders = as_list(config.eval_dir) or as_list(config.train_dir)
    if len(folders) != 1 or Path(folders[0]).is_file():
        raise CommandError("give the report its own folder, --output_dir: what it reports is not one folder")
    return Path(folders[0])
