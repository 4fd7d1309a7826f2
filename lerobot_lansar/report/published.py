"""Published results on CALVIN's original assets, to print beside one's own: data with their sources.

All are over the 1000 chains of the long-horizon benchmark.
"""

from dataclasses import dataclass, field

STATIC, GRIPPER = "static picture", "gripper picture"
ROBOT, SCENE, TASK = "robot state", "scene state (privileged)", "commanded task (34 numbers)"
"""What policies read. The scene state is the simulator's own, which a real robot does not have."""


@dataclass(frozen=True)
class Published:
    """One published row.

    Attributes:
        label: Name of the policy, or of its variant.
        in_a_row: Shares of chains with at least 1…5 commands fulfilled.
        reads: Its inputs beside language.
        split: Desks of the demonstrations, and of the evaluation; empty if the table has one split only.
        tasks: Task to (successes, attempts), where published.
    """

    label: str
    in_a_row: tuple[float, ...]
    reads: tuple[str, ...]
    split: str = ""
    tasks: dict[str, tuple[int, int]] = field(default_factory=dict)

    @property
    def average_length(self) -> float:
        """Sum of the five shares, rounded as they are."""
        return round(sum(self.in_a_row), 4)


@dataclass(frozen=True)
class Source:
    """A published table.

    Attributes:
        source: Where it was published.
        rows: Its rows.
        spread: Whether it ends with the rows' standard deviation.
    """

    source: str
    rows: tuple[Published, ...]
    spread: bool = False


def _shares(*percent: float) -> tuple[float, ...]:
    return tuple(round(value / 100, 6) for value in percent)


_CAMERAS = (STATIC, GRIPPER)
_LANSAR = (*_CAMERAS, ROBOT, SCENE)
_BEST = _shares(69.7, 46.7, 26.9, 17.1, 9.3)

_TABLE_5_2 = {
    "unstack_block": (7, 7),
    "turn_on_led": (114, 116),
    "move_slider_left": (154, 157),
    "close_drawer": (102, 104),
    "move_slider_right": (177, 181),
    "open_drawer": (221, 229),
    "turn_off_led": (94, 98),
    "place_in_drawer": (39, 41),
    "place_in_slider": (71, 81),
    "turn_off_lightbulb": (70, 87),
    "turn_on_lightbulb": (85, 113),
    "lift_pink_block_drawer": (3, 4),
    "push_into_drawer": (55, 87),
    "push_red_block_left": (41, 65),
    "push_pink_block_left": (39, 63),
    "push_blue_block_left": (33, 54),
    "push_pink_block_right": (29, 49),
    "rotate_pink_block_right": (30, 57),
    "lift_pink_block_table": (52, 101),
    "rotate_blue_block_right": (30, 60),
    "rotate_red_block_right": (31, 62),
    "push_red_block_right": (24, 60),
    "lift_pink_block_slider": (37, 93),
    "lift_red_block_table": (39, 103),
    "stack_block": (12, 35),
    "rotate_blue_block_left": (18, 58),
    "rotate_pink_block_left": (13, 43),
    "rotate_red_block_left": (15, 51),
    "lift_blue_block_table": (23, 86),
    "push_blue_block_right": (15, 57),
    "lift_red_block_drawer": (2, 8),
    "lift_blue_block_slider": (12, 96),
    "lift_blue_block_drawer": (1, 9),
    "lift_red_block_slider": (9, 89),
}

PUBLISHED: dict[str, Source] = {
    "thesis_5.1": Source(
        "LanSAR thesis, Tables 5.1 and 5.2",
        (Published("LanSAR", _BEST, _LANSAR, "ABCD→D", _TABLE_5_2),),
    ),
    "thesis_5.3": Source(
        "LanSAR thesis, Table 5.3",
        (
            Published("Baseline", _BEST, _LANSAR),
            Published("Prepend", _shares(59.0, 33.0, 16.3, 8.0, 2.7), _LANSAR),
            Published("No Space", _shares(65.9, 39.3, 20.7, 10.1, 4.0), (*_CAMERAS, ROBOT)),
            Published("No Image", _shares(12.2, 0.2, 0, 0, 0), (ROBOT, SCENE)),
        ),
    ),
    "thesis_5.4": Source(
        "LanSAR thesis, Table 5.4",
        (
            Published("not perturbed", _BEST, _LANSAR),
            Published("5 every 50", _shares(70.3, 45.8, 27.8, 16.0, 7.9), _LANSAR),
            Published("2.5 every 25", _shares(71.0, 46.7, 28.0, 16.2, 9.5), _LANSAR),
            Published("0.5 every 5", _shares(70.5, 47.8, 29.5, 17.6, 7.8), _LANSAR),
        ),
        spread=True,
    ),
    "thesis_5.5": Source(
        "LanSAR thesis, Table 5.5; inputs as its section 4.3.4 describes them",
        (
            Published("MCIL", _shares(37.3, 2.7, 0.17, 0, 0), (STATIC,), "ABCD→D"),
            Published("GR-1", _shares(94.9, 89.6, 84.4, 78.9, 73.1), (*_CAMERAS, ROBOT), "ABCD→D"),
            Published("HULC", _shares(88.9, 73.3, 58.7, 47.5, 38.3), _CAMERAS, "ABCD→D"),
            Published("LanSAR", _BEST, _LANSAR, "ABCD→D"),
            Published("MCIL", _shares(30.4, 1.3, 0.17, 0, 0), (STATIC,), "ABC→D"),
            Published("GR-1", _shares(85.4, 71.2, 59.6, 49.7, 40.1), (*_CAMERAS, ROBOT), "ABC→D"),
            Published("HULC", _shares(41.8, 16.5, 5.7, 1.9, 1.1), _CAMERAS, "ABC→D"),
            Published("LanSAR", _shares(62.0, 35.1, 17.8, 8.9, 4.0), _LANSAR, "ABC→D"),
        ),
    ),
}
"""Name, as in `--published`, to table."""
